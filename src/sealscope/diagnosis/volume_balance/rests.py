"""Rests and end stops, which the balance passes over: nothing moves, or the pump turns on against a relief valve."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: Nothing moves where the mean speed over `_STILL_SECONDS` [s] is under this share of the usual speed in motion.
_STILL, _STILL_SECONDS = 0.005, 0.2
#: The piston is at a stop where it stands within this share of its range of an end while the pump turns on, under a
#: pressure difference of over so many times the usual one in motion.
_AT_END, _PRESSED = 0.01, 1.5
#: Samples are passed over where they are more than this share of all.
_WORTH = 0.02


def in_motion(samples: Mapping[str, Array], rate: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Return which samples (m,) are neither rest nor end stop, and which are end stops; None where nearly all move.

    What is missing is taken for motion: its block is left out.
    """
    x = np.asarray(samples["x"], dtype=np.float64)
    dp = np.abs(samples["p_A"] - samples["p_B"])
    turns = np.gradient(samples["theta"]) if "theta" in samples else np.asarray(samples["omega"], dtype=np.float64)
    known = np.isfinite(x + dp + turns)
    if np.count_nonzero(known) < 2:
        return None
    if not known.all():
        at = np.arange(x.size)
        x, dp, turns = (np.interp(at, at[known], values[known]) for values in (x, dp, turns))
    width = max(1, round(_STILL_SECONDS * rate))
    piston_rests, pump_rests = _rests(np.gradient(x), width), _rests(turns, width)
    near = _AT_END * np.ptp(x)
    at_end = (x < x.min() + near) | (x > x.max() - near)
    usual = float(np.median(dp[~piston_rests])) if not piston_rests.all() else np.inf
    stopped = piston_rests & ~pump_rests & at_end & (dp > _PRESSED * usual)
    stopped = _about(stopped, 2 * width) & at_end & (dp > _PRESSED * usual) | stopped
    stopped &= known
    passed = ((piston_rests & pump_rests) | stopped) & known
    return (~passed, stopped) if np.mean(passed) > _WORTH else None


def _about(chosen: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """Return the samples within `width` of a chosen one."""
    sums = np.cumsum(np.pad(chosen.astype(np.int64), (width + 1, width)))
    return np.asarray(sums[2 * width + 1 :] > sums[: -2 * width - 1])


def _rests(speed: Array, width: int) -> NDArray[np.bool_]:
    """Return where the mean of abs(speed) over `width` samples is next to nothing."""
    mean = _mean(np.abs(_mean(speed, width)), width)
    return np.asarray(mean < _STILL * float(np.quantile(mean, 0.9)))


def _mean(values: Array, width: int) -> Array:
    """Return the mean over `width` samples about each, with zeros beyond the ends."""
    sums = np.cumsum(np.pad(values, (width - width // 2, width // 2)))
    return np.asarray((sums[width:] - sums[:-width]) / width)
