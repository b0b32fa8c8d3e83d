"""Tests of steps that no balance shows: of the duty's size, of the noise of a sensor, of hum.

Each is of a number a block, whose scatter from block to block is its noise. A leak moves none of them: the command is
the operator's, the noise stands above the ringing, which a leak damps, and in p_A + p_B the ringing cancels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from sealscope.diagnosis.inference.onset import Information, StepTest, two_sided
from sealscope.diagnosis.priors import priors
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Array, Recording

_PRIORS = priors("inference.changes")["features"]
BLOCKS, ORDER = _PRIORS["blocks"], _PRIORS["order"]
#: What commands the motion, and what moves, in the order of preference.
COMMANDS, MOTIONS = ("u", "omega", "theta"), ("x", "theta", "omega", "u")
#: Bins of a spectrum beyond the main lobe of a line, by a Hann window.
_BESIDE: list[float] = _PRIORS["beside"]


def duty_tests(recording: Recording) -> list[StepTest]:
    """Return the tests of the size of command and motion, two where the channels show both; none where one stays.

    A duty of another size changes them alike; a leak one of them, in an open or in a closed loop.
    """
    length, cycle = len(recording) // BLOCKS, find_cycle(recording)
    if "x" in recording and cycle is not None:
        # whole cycles: without a position both are the drive's, which a leak moves within a cycle as well
        samples = cycle * recording.rate
        length = round(max(1, math.ceil(length / samples)) * samples)
    sizes = []
    for names in (COMMANDS, MOTIONS):
        if name := next((channel for channel in names if channel in recording), None):
            values = _blocks(recording, length)[name]
            if not np.isfinite(values).any(axis=1).all():
                return []
            low, high = np.nanpercentile(values, [2.0, 98.0], axis=1)
            sizes.append(np.log(high - low))
    tests = [_test(recording, size, length) for size in sizes]
    return [test for test in tests if test is not None] if None not in tests else []


def sensor_tests(recording: Recording) -> list[tuple[str, StepTest]]:
    """Return the tests of what changes with a sensor alone, by what it is."""
    if not {"p_A", "p_B"} <= recording.channels.keys():
        return []
    length = len(recording) // BLOCKS
    blocks = _blocks(recording, length)
    if np.isnan(blocks["p_A"]).all(axis=1).any():  # not known in all blocks
        return []
    features = _features(blocks, recording.rate)
    return [(name, test) for name, sizes in features if (test := _test(recording, sizes, length)) is not None]


def _blocks(recording: Recording, length: int) -> dict[str, Array]:
    """Return the channels in blocks (K, length), missing samples as NaN."""
    count = len(recording) // length
    blocks = {name: values[: count * length].reshape(count, length) for name, values in recording.channels.items()}
    if recording.bridged is None:
        return blocks
    missing = recording.bridged[: count * length].reshape(count, length)
    return {name: np.where(missing, np.nan, values) for name, values in blocks.items()}


def _features(blocks: Mapping[str, Array], rate: float) -> Iterator[tuple[str, Array]]:
    """Yield a number a block of each feature, by its name."""
    p_A, p_B = blocks["p_A"], blocks["p_B"]
    if name := next((channel for channel in ("omega", "u", "theta", "x") if channel in blocks), None):
        # whether p_A - p_B goes with the flow into A (1) or against it (-1): friction takes work
        flow = blocks[name] if name in ("omega", "u") else np.gradient(blocks[name], axis=1)
        difference = p_A - p_B - np.nanmean(p_A - p_B)
        yield "sense of p_A - p_B", np.sign(_of_rows(np.nanmean, difference * flow))
    # the median square, for a jump at a reversal is no noise
    noise_A, noise_B = (np.log(_of_rows(np.nanmedian, np.diff(p, ORDER, axis=1) ** 2)) for p in (p_A, p_B))
    yield "noise of the pressures", noise_A + noise_B
    yield "noise of p_A beside that of p_B", noise_A - noise_B
    length = p_A.shape[1] // 2
    values = (p_A + p_B)[:, : 2 * length].reshape(-1, 2, length)
    bins = np.array([0.0, *_BESIDE, *np.negative(_BESIDE)])
    for hertz in _PRIORS["mains"]:
        if hertz + _BESIDE[-1] * rate / length < _PRIORS["highest"] * rate:
            turns = np.outer(np.arange(length), hertz / rate + bins / length)
            window = np.hanning(length)[:, None] * np.exp(-2j * np.pi * turns)
            power = np.log((np.abs((values - values.mean(axis=2, keepdims=True)) @ window) ** 2).mean(axis=1))
            # a line over what is beside it: ringing is wider
            yield f"hum of {hertz:g} Hz", power[:, 0] - power[:, 1:].mean(axis=1)


def _of_rows(statistic: Callable[..., Array], values: Array) -> Array:
    """Compute a statistic of the known values of each row (K, n); NaN for a row without any."""
    known = np.isfinite(values).any(axis=1)
    results = np.full(len(values), np.nan)
    results[known] = statistic(values[known], axis=1)
    return results


def _test(recording: Recording, values: Array, length: int) -> StepTest | None:
    """Return the test of a number a block; None where it says nothing."""
    if not np.isfinite(values).all() or not np.ptp(values) > 0.0:
        return None
    time = recording.t[0] + (np.arange(len(values)) + 0.5) * length / recording.rate
    wander = priors("inference")["features"]["wander"]
    return two_sided(Information(time, np.eye(len(values)), values, slope=wander, walk=wander))
