"""Leakage while valves shut a cylinder from its pump: the two chambers balance each other.

The pump is cut off, so each chamber is a closed volume with leaks. From the begin of a hold on,

    m_A dx + V_A (dp_A/K - alpha p_0 d(1/p_A)) = -G I - e_A I_A,
   -m_B dx + V_B (dp_B/K - alpha p_0 d(1/p_B)) = +G I - e_B I_B,

with the piston's areas m_A and m_B in the unit of the pump's flow, the volumes V of oil, their bulk modulus K and free
air alpha. I integrates a power of p_A - p_B - z over time, I_A and I_B the pressures. A leaking piston moves oil from A
to B; a leaking rod seal takes oil from one side alone, and the piston then gives way: a check valve may fill the other
side. All holds together are one linear regression, each side of a hold about its mean, with the priors of the oil
(`priors.toml`, `held_oil`) as further readings. The onset of the leak and z, the zero of p_A - p_B, are the likeliest;
a leak that has made the pressures equal shows z. The three leaks are hypotheses, each weighed by its probability.

Source: Merritt, Hydraulic Control Systems, 1967, section 6.3 (continuity of the chambers).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.blocks import cost_of_zero
from sealscope.diagnosis.priors import priors
from sealscope.recordings.motion import runs_of
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

#: First reading of a hold after so many seconds, how much longer the next takes, and fewest readings.
FIRST, GROWS, FEWEST_READINGS = 0.05, 1.2, 8
#: Rate that is enough for pressures that valves shut in [Hz].
FASTEST = 100.0
#: Zeros that are tried, over what is believed of one [deviations], and how many between the best one's neighbours;
#: onsets that are tried within a hold.
CLOSER, ONSETS = 17, 4
ZEROS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
#: Signs of a leak's flow in the balances of sides A and B, past the piston and of either side to the outside.
PISTON, OUTSIDE = (1.0, -1.0), {"A": (1.0, 0.0), "B": (0.0, 1.0)}
#: Deviation of a leak that no reading tells of.
UNKNOWN = 1e30
#: Turns of a fit and the change of its variance that ends them; what is added to a matrix.
TURNS, TOLERANCE, RIDGE = 20, 1e-3, 1e-12


class CylinderSides(NamedTuple):
    """A cylinder in the unit of a balance: areas of both sides with the sign of x, and the ends of the stroke [m]."""

    area_A: float
    area_B: float
    low: float
    high: float


class LockedHold(NamedTuple):
    """Samples of one hold: time [s], absolute pressures [Pa] and position [m], (n,) each; `edges` of its readings."""

    t: Array
    p_A: Array
    p_B: Array
    x: Array
    edges: NDArray[np.intp]

    def mean(self, values: Array) -> Array:
        """Average samples (..., n) over the readings, (..., k)."""
        sums = np.add.reduceat(values, self.edges[:-1], axis=-1)
        return np.asarray(sums / np.diff(self.edges))


def find_locked_holds(channels: Sequence[Array], rests: NDArray[np.bool_], rate: float) -> list[LockedHold]:
    """Find the holds of a recording: rests of the pump (n - 1,), from when valves have shut.

    `channels`: time, absolute pressures of A and B, and position, (n,) each. A hold that is short, or has missing
    samples, is left out.
    """
    believed, holds = priors("inference")["held_oil"], list[LockedHold]()
    for first, length in runs_of(rests).tolist():
        begin, end = first + max(1, round(believed["settles"] * rate)), first + length + 1
        if end - begin < believed["shortest"] * rate:
            continue
        every = max(1, int(rate / FASTEST))
        count = (end - begin) // every
        t, p_A, p_B, x = (
            values[begin : begin + count * every].reshape(count, every).mean(axis=1) for values in channels
        )
        edges, width = [0], FIRST * rate / every
        while edges[-1] + max(round(width), 1) < count:
            edges.append(edges[-1] + max(round(width), 1))
            width *= GROWS
        edges[-1] = count
        if len(edges) > FEWEST_READINGS and np.isfinite([p_A, p_B, x]).all():
            holds.append(LockedHold(t, p_A, p_B, x, np.array(edges)))
    return holds


class HeldLeaks(NamedTuple):
    """Leaks of a recording's holds, past the `piston` and to the outside of A and B, each with its deviation."""

    piston: float
    deviation: float
    outside_A: float
    deviation_A: float
    outside_B: float
    deviation_B: float


class HeldLevel(NamedTuple):
    """A leak's coefficient with its deviations, by noise and by the priors of the oil, and its log likelihood."""

    value: float
    deviation: float
    by_oil: float
    likelihood: float


@dataclass(frozen=True, eq=False)
class HeldChambers:
    """The chambers of a cylinder in the holds of a recording.

    Parameters
    ----------
    holds : sequence of LockedHold
    sides : CylinderSides
    begin, end : float
        Of the recording [s].
    charge : float
        Absolute pressure that check valves keep at least [Pa].
    """

    holds: Sequence[LockedHold]
    sides: CylinderSides
    begin: float
    end: float
    charge: float

    @cached_property
    def readings(self) -> float:
        """Number of independent readings."""
        independent: float = priors("inference")["held_oil"]["independent"]
        return independent * 2.0 * len(self.holds)

    def _regression(self, feeds: bool) -> tuple[Array, Array, Array]:
        """Return the left side (r,) of the readings, the columns (r, 4) of the oil, and the widths of its priors.

        The left side is the volume displaced by the piston, less the compression expected by the priors. The columns
        are deviations from these: of the compressibility, of the dead volumes of A and B, and of free air. The rows
        are the readings of each hold, side A before side B, about their means. `feeds`: at the charge pressure check
        valves replace the displaced oil.
        """
        believed, stroke = priors("inference")["held_oil"], self.sides.high - self.sides.low
        give, dead, air = believed["compressibility"], believed["dead"], believed["air"]
        targets, columns = [], []
        for hold in self.holds:
            for side, area, p in ((0, self.sides.area_A, hold.p_A), (1, -self.sides.area_B, hold.p_B)):
                end = self.sides.low if area > 0.0 else self.sides.high
                unused = abs(area) * dead * stroke
                volume = abs(area) * abs(float(hold.x.mean()) - end) + unused
                oil = np.zeros((len(hold.edges) - 1, 4))
                oil[:, 0], oil[:, 1 + side] = volume * hold.mean(p), unused * hold.mean(p)
                oil[:, 3] = -volume * P_ATM * hold.mean(1.0 / p)
                columns.append(oil - oil.mean(axis=0))
                steps = -area * np.diff(hold.x, prepend=hold.x[0])
                targets.append(_centred(hold.mean(np.cumsum(steps * self._closed(p) if feeds else steps))))
        oil, wide = np.vstack(columns), give * believed["dead_deviation"] / dead
        width = np.array([give * believed["deviation"], wide, wide, air])
        return np.concatenate(targets) - oil @ [give, 0.0, 0.0, air], oil, width

    def _closed(self, p: Array) -> NDArray[np.bool_]:
        """Flag the samples (n,) of a chamber's pressure above that of the charge: no check valve feeds it."""
        return np.asarray(p > self.charge * (1.0 + priors("inference")["held_oil"]["charge"]))

    def _piston_flows(self, zero: float, exponent: float = 1.0) -> list[Array]:
        """Return the flow of a leak of one past the piston in the samples (n,) of each hold."""
        differences = [hold.p_A - hold.p_B - zero for hold in self.holds]
        return [np.sign(difference) * np.abs(difference) ** exponent for difference in differences]

    def _outside_flows(self, side: str) -> list[Array]:
        """Return the flow of a leak of one from a side to the outside in the samples (n,) of each hold."""
        pressures = [hold.p_A if side == "A" else hold.p_B for hold in self.holds]
        return [np.maximum(p - P_ATM, 0.0) * self._closed(p) for p in pressures]

    def _fit(self, columns: Sequence[Array], feeds: bool = False) -> tuple[Array, Array, Array, float]:
        """Fit columns (r,) beside the oil: coefficients, covariances by noise and by the oil, and the variance."""
        target, oil, width = self._regression(feeds)
        design, count = np.column_stack([*columns, oil]), len(columns)
        scale = np.sqrt((design**2).sum(axis=0))
        scale[~(scale > 0.0)] = 1.0
        inflation = max(len(target) / self.readings, 1.0)
        free = max(self.readings - count, 1.0)
        least = self._least(oil)
        variance = max(float(target @ target) / len(target), least)
        for _ in range(TURNS):
            prior = np.concatenate([np.zeros(count), variance * inflation / width**2])
            matrix = (design.T @ design + np.diag(prior)) / np.outer(scale, scale)
            matrix.flat[:: len(scale) + 1] += RIDGE
            inverse = np.linalg.inv(matrix) / np.outer(scale, scale)
            solved = inverse @ (design.T @ target)
            left = target - design @ solved
            cost = float(left @ left) + float(prior @ solved**2)
            before, variance = variance, max(cost / len(target) * self.readings / free, least)
            if abs(variance - before) <= TOLERANCE * before:
                break
        covariance = variance * inflation * inverse
        gain = covariance[:count, count:] @ np.linalg.pinv(covariance[count:, count:])
        by_oil = gain @ covariance[count:, :count]
        return solved[:count], covariance[:count, :count] - by_oil, by_oil, variance

    def _least(self, oil: Array) -> float:
        """Return the least variance of a reading: the terms describe the compressed volume to within a share."""
        believed = priors("inference")["held_oil"]
        compressed = oil @ [believed["compressibility"], 0.0, 0.0, believed["air"]]
        share: float = believed["misfit"]
        return max(share**2 * float(compressed @ compressed) / len(oil), float(np.finfo(float).tiny))

    def level(self, onset: float, zero: float, exponent: float = 1.0) -> HeldLevel:
        """Fit a leak past the piston from `onset` [s] on, by a power of p_A - p_B about its zero [Pa]."""
        flows = self._piston_flows(zero, exponent)
        return self._level(self._leak_columns(flows, PISTON, np.array([onset])), cost_of_zero(zero))

    def outside(self, side: str, onset: float) -> HeldLevel:
        """Fit a leak of one side to the outside from `onset` [s] on."""
        flows = self._outside_flows(side)
        return self._level(self._leak_columns(flows, OUTSIDE[side], np.array([onset])), 0.0, feeds=True)

    def _level(self, column: Array, cost: float, feeds: bool = False) -> HeldLevel:
        values, noise, oil, variance = self._fit([*column.T] if column.any() else [], feeds)
        value, deviation, by_oil = 0.0, UNKNOWN, 0.0
        if len(values):
            value, deviation, by_oil = float(values[0]), float(noise[0, 0]) ** 0.5, float(max(oil[0, 0], 0.0)) ** 0.5
        if value < 0.0:  # nothing flows in, and a leak past the piston goes with the pressure
            value, variance = 0.0, self._fit([], feeds)[3]
        return HeldLevel(value, deviation, by_oil, -0.5 * self.readings * float(np.log(variance)) - 0.5 * cost)

    @cached_property
    def onsets(self) -> Array:
        """Onsets that are tried [s]: the begin of the recording, between the holds, and within each."""
        onsets = [self.begin]
        for k, hold in enumerate(self.holds):
            onsets += [0.5 * (self.holds[k - 1].t[-1] + hold.t[0])] if k else []
            onsets += list(np.linspace(hold.t[0], hold.t[-1], ONSETS + 2)[1:-1])
        return np.array(onsets)

    @cached_property
    def _priors(self) -> Array:
        """Logarithm of the prior of each onset: half of all leaks are there from the start."""
        return np.asarray(np.log(np.append(0.5, np.full(len(self.onsets) - 1, 0.5 / max(len(self.onsets) - 1, 1)))))

    def _leak_columns(self, flows: Sequence[Array], signs: tuple[float, float], onsets: Array) -> Array:
        """Return the columns (r, o) of a leak since each of the onsets (o,), by its flow in the samples of each hold.

        `signs`: those of its flow in the balances of sides A and B.
        """
        parts = []
        for hold, flow in zip(self.holds, flows, strict=True):
            steps = 0.5 * (flow[1:] + flow[:-1]) * np.diff(hold.t)
            integral = np.concatenate([[0.0], np.cumsum(steps)])
            before = np.interp(onsets, hold.t, integral)
            readings = hold.mean((hold.t >= onsets[:, None]) * (integral - before[:, None])).T
            readings -= readings.mean(axis=0)
            parts += [sign * readings for sign in signs]
        return np.vstack(parts)

    def _scan(self, columns: Array, feeds: bool = False) -> Array:
        """Return the log-likelihood (o,) of a leak of each column (r, o), at least zero, beside the oil."""
        target, oil, width = self._regression(feeds)
        variance = self._fit([], feeds)[3]
        inflation = max(len(target) / self.readings, 1.0)
        believed = np.diag(np.sqrt(variance * inflation) / width)
        basis = np.linalg.qr(np.vstack([oil, believed]) / np.linalg.norm(np.vstack([oil, believed]), axis=0))[0]
        zeros = np.zeros((len(width), 1 + columns.shape[1]))
        rest = np.vstack([np.column_stack([target, columns]), zeros])
        rest -= basis @ (basis.T @ rest)
        left, rest = rest[:, 0], rest[:, 1:]
        square, lead = (rest**2).sum(axis=0), np.maximum(left @ rest, 0.0)
        known = square > RIDGE * max(float(square.max()), np.finfo(float).tiny)
        gain = np.where(known, lead**2 / np.where(known, square, 1.0), 0.0)
        least = self._least(oil) * len(target)
        return np.asarray(-0.5 * self.readings * np.log(np.maximum(float(left @ left) - gain, least)))

    @cached_property
    def piston(self) -> tuple[float, float]:
        """Likeliest onset [s] of a leak past the piston, and zero of p_A - p_B [Pa]."""
        tried = np.unique(np.concatenate([-ZEROS, ZEROS])) * priors("inference")["zero"]["pressure"]
        best = self._likeliest_zero(tried)
        between = np.linspace(tried[max(best[1] - 1, 0)], tried[min(best[1] + 1, len(tried) - 1)], CLOSER)
        onset, place, _ = self._likeliest_zero(between)
        return float(self.onsets[onset]), float(between[place])

    def _likeliest_zero(self, zeros: Array) -> tuple[int, int, float]:
        """Return the likeliest onset and zero, as indices, with the likelihood."""
        found = []
        for place, zero in enumerate(zeros):
            columns = self._leak_columns(self._piston_flows(float(zero)), PISTON, self.onsets)
            likelihoods = self._scan(columns) + self._priors - 0.5 * cost_of_zero(float(zero))
            onset = int(likelihoods.argmax())
            found.append((onset, place, float(likelihoods[onset])))
        return max(found, key=lambda candidate: candidate[2])

    @cached_property
    def leaks(self) -> HeldLeaks:
        """Mean leaks past the piston and to the outside, each by the probability that it is the one."""
        begin, zero = self.piston
        found = [(self.level(begin, zero), int(np.abs(self.onsets - begin).argmin()))]
        for side, signs in OUTSIDE.items():
            columns = self._leak_columns(self._outside_flows(side), signs, self.onsets)
            onset = int((self._scan(columns, feeds=True) + self._priors).argmax())
            found.append((self.outside(side, float(self.onsets[onset])), onset))
        logarithms = np.array([level.likelihood + self._priors[onset] for level, onset in found])
        shares = np.exp(logarithms - logarithms.max())
        shares /= shares.sum()
        numbers = []
        for share, (level, onset) in zip(shares, found, strict=True):
            lasts = (self.end - self.onsets[onset]) / max(self.end - self.begin, np.finfo(float).tiny)
            numbers += [float(share * lasts) * level.value, float(lasts) * level.deviation]
        return HeldLeaks(*numbers)


def _centred(values: Array) -> Array:
    return np.asarray(values - values.mean())
