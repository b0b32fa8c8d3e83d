"""What passes pump and piston while one side of a single rod carries the load, where the load swings between the sides.

    D d(theta) = G integral(p_A - p_B) dt + A_s dx + C_s dp_s + (1/K) (A_s x dp_s + integral of D omega dp) + q T

over a stretch of T seconds in which side s has the higher pressure throughout: a leak, the motion, the oil stored in
the side as the piston stands in the middle and elsewhere, what is compressed as the pump delivers there, and a steady
flow, which zeros of the transducers make. As the load changes over both sides are open to the supply, or neither is,
and what the pump delivers then is in no balance: so it is left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.inference.cycle_balance.series import (
    COMES_BACK,
    KNOTS,
    ZERO,
    CycleFlows,
    integral,
)
from sealscope.diagnosis.inference.cycle_balance.shaft import shaft_shown, shows
from sealscope.physics.leakage import orifice_over_laminar
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: A side carries while p_A - p_B, averaged over so long [s], is over this share of its rms; a stretch begins and ends
#: so long [s] after and before that, and lasts so long at least, and at most, where it is cut.
_MEANS, _CARRIES, _MARGIN, _SHORTEST, _LONGEST = 0.02, 0.5, 0.1, 0.8, 3.0
#: Fewest stretches on either side of a step.
_BESIDE = 3


def stretch_flows(recording: Recording, rig: Rig) -> CycleFlows | str:
    """Return the balance over stretches of a recording with both chamber pressures and the shaft, or why none is."""
    counted, rate = shaft_shown(recording), recording.rate
    if counted not in ("theta", "omega") or not shows(recording, "x", "m"):
        return "position, and the shaft's angle or speed, are needed where the load changes sides"
    displacement, x = rig.pump.q_b / (2.0 * np.pi), recording["x"]
    theta = recording["theta"] if counted == "theta" else integral(recording["omega"], rate)
    dp = _smooth(recording["p_A"] - recording["p_B"], rate)
    ends = _stretches(dp, rate)
    ends = ends[~np.array([touched(recording, pair)[0] for pair in ends], dtype=bool)] if len(ends) else ends
    if len(ends) < FEWEST:
        return f"a side carries for {_SHORTEST:g} s or more {len(ends)} times, {FEWEST} are needed"

    def grown(values: Array) -> Array:
        """Return by how much values (m,) grow over each stretch."""
        slow = _smooth(values, rate)
        return np.asarray(slow[ends[:, 1]] - slow[ends[:, 0]])

    turned, moved, pressed = displacement * grown(theta), grown(x), grown(integral(dp, rate))
    along, on_A = 1.0 if float(turned @ moved) >= 0.0 else -1.0, pressed > 0.0
    area, side = along * np.where(on_A, rig.cylinder.A_A, rig.cylinder.A_B), np.where(on_A, 1.0, -1.0)
    lasts, rise = (ends[:, 1] - ends[:, 0]) / rate, np.where(on_A, grown(recording["p_A"]), grown(recording["p_B"]))
    t = recording.t[ends].mean(axis=1)
    delivered = np.gradient(theta) * displacement * dp
    columns = np.stack(
        [
            area * moved,
            np.where(on_A, rise, 0.0),
            np.where(on_A, 0.0, rise),
            side * area * grown(integral(x, rate)) / lasts * rise,
            side * grown(np.cumsum(np.maximum(delivered, 0.0))),
            lasts,
        ],
        axis=1,
    )
    lost = turned - columns[:, 0]
    at = np.linspace(t[0], t[-1], KNOTS)
    drifting = np.stack([np.interp(t, at, row) for row in np.eye(KNOTS)], axis=1)
    # a step is allowed for where it explains most: else a large one would pass for an error of the balance
    steps = np.tri(t.size, k=-1).T[_BESIDE - 1 : t.size - _BESIDE]
    fits = [_fitted(columns, np.column_stack([drifting, step]) * pressed[:, None], lost) for step in steps]
    every, scale, fitted, deviation = min(fits, key=lambda fit: fit[-1])
    own = columns / scale[: columns.shape[1]]
    widths, turns = np.linalg.eigh(np.linalg.pinv((every / scale).T @ (every / scale))[: len(own.T), : len(own.T)])
    errors = own @ turns * np.sqrt(np.maximum(widths, 0.0)) * deviation
    lost -= own @ fitted[: len(own.T)]
    seconds = float(np.median(lasts))
    pumped = float(np.mean(np.abs(np.diff(theta)))) * rate * displacement
    if not deviation < COMES_BACK * pumped * seconds:
        return f"volumes do not balance while a side carries: {deviation / (pumped * seconds):.1%} is left"
    sense = 1.0 if float(lost @ pressed) >= 0.0 else -1.0
    size = np.abs(dp)
    lower = np.minimum(recording["p_A"], recording["p_B"])
    return CycleFlows(
        t=t,
        seconds=seconds,
        flow=sense * lost / seconds,
        dp=pressed / seconds,
        size=np.full(t.size, float(size.mean())),
        filled=grown(integral(lower, rate)) / lasts,
        pumped=pumped,
        shared=errors / seconds,
        share=1.0,
        counted=counted,
        halves=False,
        by_orifice=orifice_over_laminar(size),
        zero=ZERO / float(np.mean(np.abs(pressed)) / seconds),
        over="stretches",
    )


def _fitted(columns: Array, leaking: Array, lost: Array) -> tuple[Array, Array, Array, float]:
    """Return all columns (n, c), the scale of each, their coefficients over it, and the deviation of what is left."""
    every = np.concatenate([columns, leaking], axis=1)
    scale = np.sqrt(np.mean(every**2, axis=0)) + np.finfo(float).tiny
    fitted, *_ = np.linalg.lstsq(every / scale, lost, rcond=None)
    left = lost - every / scale @ fitted
    return every, scale, fitted, float(np.sqrt(left @ left / max(1, left.size - scale.size)))


def _smooth(values: Array, rate: float) -> Array:
    """Return the means over `_MEANS` about each sample of values (n,), over fewer at the ends."""
    half = max(1, round(0.5 * _MEANS * rate))
    sums = np.concatenate([[0.0], np.cumsum(values - values[0])])
    at = np.arange(values.size)
    first, last = np.maximum(at - half, 0), np.minimum(at + half + 1, values.size)
    return np.asarray(values[0] + (sums[last] - sums[first]) / (last - first))


def _stretches(dp: Array, rate: float) -> NDArray[np.int64]:
    """Return the first and last samples (k, 2) of stretches in which a side carries, by dp (n,) smoothed."""
    carried = np.where(np.abs(dp) > _CARRIES * np.sqrt(np.mean(dp**2)), np.sign(dp), 0.0)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(carried)) + 1, [dp.size]])
    margin = round(_MARGIN * rate)
    pairs = []
    for begin, end in zip((edges[:-1] + margin).tolist(), (edges[1:] - 1 - margin).tolist(), strict=True):
        if carried[begin - margin] and end - begin >= _SHORTEST * rate:
            bounds = np.linspace(begin, end, max(1, round((end - begin) / rate / _LONGEST)) + 1).astype(np.int64)
            pairs += list(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
