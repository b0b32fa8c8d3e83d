"""Rated flow, overlaps and stiffness of a valve-controlled machine from the balance of volumes of its chambers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.control.identification.balance import BLOCK, Balanced
from sealscope.control.identification.estimate import Estimate, least_squares
from sealscope.physics.valve import spool_series
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

Array = NDArray[np.float64]
EDGES = ("o_PA", "o_AT", "o_PB", "o_BT")
#: Half length of the averages at a block's ends [s], parts of a sample in which the spool is followed, blocks whose
#: errors may follow each other, fewest blocks of a side, and how often densities are taken anew.
_HALF, _PARTS, _LAGS, _FEWEST, _TURNS = 0.01, 4, 12, 40, 2
#: What the laws leave out of an overlap, as a share of the spool's stroke: how it moves between samples.
_LEFT_OUT = 6e-6


@dataclass(frozen=True)
class Edges:
    """Estimates from the balance; the piston's conductance [m^3/(s Pa)]; A_A/A_B over that of the rig."""

    balance: Balanced
    piston: Estimate
    ratio: Estimate


@dataclass(frozen=True)
class _Chamber:
    """Blocks of one chamber of one recording, and what flows in them but for the spool's place.

    `sign` 1.0 of A, -1.0 of B; `way` (m,) place of the spool [m]; `into`, `out` (m,) [Pa^0.5] the orifice law of both
    edges with the density of what comes in; each in `_PARTS` parts of a sample. `swept` (blocks,) [m^3], `pressed`
    [m^3 Pa], `over` [Pa s].
    """

    sign: float
    way: Array
    into: Array
    out: Array
    swept: Array
    pressed: Array
    over: Array
    ends: NDArray[np.intp]
    offsets: NDArray[np.intp]
    part: float

    def flowed(self, gain: float, into: float, out: float) -> Array:
        """Return what the edges let in less what they let out within each block [m^3].

        `gain` [m^2/(s Pa^0.5)] of both; overlaps [m].
        """
        flow = np.maximum(self.way - into, 0.0) * self.into - np.maximum(-self.way - out, 0.0) * self.out
        total = np.concatenate([[0.0], np.cumsum(flow.reshape(-1, _PARTS).sum(axis=1))]) * (gain * self.part)
        return np.diff(total[self.ends[:, None] + self.offsets].mean(axis=1))


def edges_balanced(recordings: Sequence[Recording], rig: Rig) -> Edges | str:
    """Return what the balance of volumes of the chambers tells of a valve, or why it tells nothing.

    Over each block and in each chamber: integral of Q_in rho_in/rho - Q_out = A dx + (1/K) integral of V dp + G
    integral of (p_A - p_B), signs turned for B. An edge passes Q_N/(sqrt(dp_N) x_max) (way - overlap)+ and the orifice
    law of its pressures; the spool follows the command, held from sample to sample, as the rig's says. Areas and
    volumes are the rig's as stated; found are Q_N, the overlaps, K, G, and by what factor the areas have another ratio.
    """
    v = rig.valve
    K = rig.fluid.K_oil
    start = [v.Q_N, 1.0 / K, 1e-14, 1.0, *(max(abs(getattr(v, name)), 1e-6) for name in EDGES)]
    for _ in range(_TURNS):
        pairs = [_chambers(recording, rig, K) for recording in recordings]
        chambers = [pair[side] for side in range(2) for pair in pairs]
        if sum(len(chamber.swept) for chamber in chambers) < 2 * _FEWEST:
            return f"the balance of volumes needs {_FEWEST * BLOCK:g} s of recordings or more"
        q, covariance, rest = least_squares(_residual(chambers, 1.0 / (math.sqrt(v.dp_N) * v.x_max)), start, _LAGS)
        start = q.tolist()
        if q[1] > 0:
            K = float(1.0 / q[1])
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates = [Estimate("valve.Q_N", float(q[0]), float(sd[0]))]
    if q[1] > 0:
        estimates.append(Estimate("fluid.K_oil", float(1.0 / q[1]), float(sd[1] / q[1] ** 2)))
    for name, lap, deviation in zip(EDGES, q[4:], sd[4:], strict=True):
        estimates.append(Estimate(f"valve.{name}", float(lap), math.hypot(float(deviation), _LEFT_OUT * v.x_max)))
    balance = Balanced(tuple(estimates), float(np.sqrt(np.mean(rest**2))), len(rest))
    piston, ratio = (Estimate(name, float(q[k]), float(sd[k])) for k, name in ((2, "piston"), (3, "ratio")))
    return Edges(balance, piston, ratio)


def _residual(chambers: Sequence[_Chamber], per_flow: float) -> Callable[[Array], Array]:
    """Return what is left over of all blocks, as a share of what a piston sweeps in one; `per_flow`: gain over Q_N."""
    swept = float(np.sqrt(np.mean(np.concatenate([chamber.swept for chamber in chambers]) ** 2))) or 1.0

    def residual(q: Array) -> Array:
        Q_N, softness, G, ratio, *laps = q
        gain = Q_N * per_flow
        missing = []
        for chamber in chambers:
            own = (gain, *laps[:2]) if chamber.sign > 0 else (ratio * gain, *laps[2:])
            leaked = chamber.sign * G * chamber.over
            missing.append(chamber.flowed(*own) - chamber.swept - softness * chamber.pressed - leaked)
        return np.concatenate(missing) / swept

    return residual


def _chambers(recording: Recording, rig: Rig, K: float) -> tuple[_Chamber, _Chamber]:
    c, v, rate = rig.cylinder, rig.valve, recording.rate
    x, p_A, p_B, p_P, p_T = (recording[name] for name in ("x", "p_A", "p_B", "p_1", "p_2"))
    length, half = max(4, round(BLOCK * rate)), max(1, round(_HALF * rate))
    offsets = np.arange(-half, half + 1)
    ends = np.arange(half, len(recording) - half, length)
    x_ends = x[ends[:, None] + offsets].mean(axis=1)
    way = spool_series(recording["u"], v, rate, _PARTS)
    over = np.array([0.5 * (p_A - p_B)[a : b + 1][1:].sum() + 0.5 * (p_A - p_B)[a:b].sum() for a, b in _pairs(ends)])

    def law(dp: Array) -> Array:
        return np.asarray(dp / np.sqrt(np.sqrt(dp * dp + v.dp_lam**2)))

    def chamber(p: Array, sign: float, area: float, V_0: float) -> _Chamber:
        moves = c.volumes == "position"
        V = V_0 + (sign * area * x_ends if moves else 0.0 * x_ends)
        p_ends = p[ends[:, None] + offsets].mean(axis=1)
        middle = 0.5 * (p[1:] + p[:-1]) * (sign * area * np.diff(x) if moves else 0.0)
        by_parts = np.array([middle[a:b].sum() for a, b in _pairs(ends)])
        inside, supply, back = (_between(values) for values in (p, p_P, p_T))
        denser = np.exp((supply - inside) / K) if moves and c.balance == "mass" else 1.0
        return _Chamber(
            sign,
            sign * way,
            law(supply - inside) * denser,
            law(inside - back),
            sign * area * np.diff(x_ends),
            np.diff(V * p_ends) - by_parts,
            over / rate,
            ends,
            offsets,
            1.0 / (rate * _PARTS),
        )

    return chamber(p_A, 1.0, c.A_A, c.V + c.V_hose_A), chamber(p_B, -1.0, c.A_B, c.V - c.V_rod + c.V_hose_B)


def _pairs(ends: NDArray[np.intp]) -> list[tuple[int, int]]:
    return list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))


def _between(values: Array) -> Array:
    """Return values evenly between the samples, in the middles of the parts of each."""
    shares = (np.arange(_PARTS) + 0.5) / _PARTS
    return np.asarray((values[:-1, None] + np.diff(values)[:, None] * shares).ravel())
