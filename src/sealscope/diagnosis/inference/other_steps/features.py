"""Steps that no balance shows: of the duty's size and pace, of the noise of a sensor, of hum.

Each is a row of data: a number a block, whose step names a cause. Its scatter from block to block is its noise, so that
`onset.step_test` asks the same question of it as of a coefficient. A leak moves none of them: the command is the
operator's, the noise stands above the ringing, which a leak damps, and in p_A + p_B the ringing cancels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Array, Recording

_BELIEVED = beliefs("inference.other_steps")["features"]
BLOCKS, ORDER = _BELIEVED["blocks"], _BELIEVED["order"]
#: What commands the motion, and what moves, in the order of preference.
COMMANDS, MOTIONS = ("x_d", "u", "omega", "theta"), ("x", "theta", "omega", "u")
#: Bins of a spectrum beyond the main lobe of a line, by a Hann window.
_BESIDE = (3.0, 4.0, 5.0)
_Blocks = dict[str, Array]


class Feature(NamedTuple):
    """A number for each block: its name, what a step of it means, channels that it needs, how blocks (K, n) give it."""

    name: str
    cause: Cause
    needs: frozenset[str]
    of: Callable[[_Blocks, float], Array | None]


def _size(names: tuple[str, ...], blocks: _Blocks, rate: float) -> Array | None:
    """Return the range of the first recorded of some channels, without its farthest 2 % on either side."""
    name = next((own for own in names if own in blocks), None)
    if name is None:
        return None
    low, high = np.nanpercentile(blocks[name], [2.0, 98.0], axis=1)
    return np.asarray(np.log(high - low))


def _noise(sign: float, blocks: _Blocks, rate: float) -> Array:
    """Return the noise of both sensors together (1), or of one beside the other's (-1).

    Of each the median square, for a jump at a reversal is no noise.
    """
    noise = (np.diff(blocks[name], ORDER, axis=1) for name in ("p_A", "p_B"))
    own, other = (np.log(np.nanmedian(values**2, axis=1)) for values in noise)
    return np.asarray(own + sign * other)


def _hum(hertz: float, blocks: _Blocks, rate: float) -> Array | None:
    """Return the power of p_A + p_B in a line, over that beside it: ringing is wider than a line."""
    length = blocks["p_A"].shape[1]
    bins = np.array([0.0, *_BESIDE, *np.negative(_BESIDE)])
    if not hertz + _BESIDE[-1] * rate / length < 0.45 * rate:
        return None
    values = blocks["p_A"] + blocks["p_B"]
    turns = np.outer(np.arange(length), hertz / rate + bins / length)
    window = np.hanning(length)[:, None] * np.exp(-2j * np.pi * turns)
    power = np.log(np.abs((values - values.mean(axis=1, keepdims=True)) @ window) ** 2)
    return np.asarray(power[:, 0] - power[:, 1:].mean(axis=1))


def _sense(blocks: _Blocks, rate: float) -> Array | None:
    """Return whether p_A - p_B goes with the flow into A (1) or against it (-1): friction takes work."""
    name = next((own for own in ("omega", "u", "theta", "x") if own in blocks), None)
    if name is None:
        return None
    flow = blocks[name] if name in ("omega", "u") else np.gradient(blocks[name], axis=1)
    difference = blocks["p_A"] - blocks["p_B"]
    return np.asarray(np.sign(np.nanmean((difference - np.nanmean(difference)) * flow, axis=1)))


_BOTH = frozenset({"p_A", "p_B"})
#: A duty of another size changes command and motion alike; a leak one of them, in an open or in a closed loop.
DUTY = (
    Feature("size of the command", "changed duty", frozenset(), partial(_size, COMMANDS)),
    Feature("size of the motion", "changed duty", frozenset(), partial(_size, MOTIONS)),
)
FEATURES = (
    Feature("sense of p_A - p_B", "sensor fault", _BOTH, _sense),
    Feature("noise of the pressures", "sensor fault", _BOTH, partial(_noise, +1.0)),
    Feature("noise of p_A beside that of p_B", "sensor fault", _BOTH, partial(_noise, -1.0)),
    *(Feature(f"hum of {hz:g} Hz", "sensor fault", _BOTH, partial(_hum, hz)) for hz in _BELIEVED["mains"]),
)


@np.errstate(divide="ignore")
def _cycles_length(recording: Recording) -> int:
    """Return the samples of a block: whole cycles, where the duty repeats."""
    even, cycle = len(recording) // int(BLOCKS), find_cycle(recording)
    if cycle is None:
        return even
    samples = cycle * recording.rate
    return round(max(1, math.ceil(even / samples)) * samples)


def features(recording: Recording, wanted: Sequence[Feature] = FEATURES) -> list[tuple[Feature, Information]]:
    """Return what the blocks of a recording say of features, those left out that its channels do not show."""
    # without a position command and motion are the drive's, which a leak moves within a cycle as well
    length = _cycles_length(recording) if wanted is DUTY and "x" in recording else len(recording) // BLOCKS
    if length <= ORDER + 1:
        return []
    count = len(recording) // length
    blocks = {name: values[: count * length].reshape(count, length) for name, values in recording.channels.items()}
    if recording.bridged is not None:
        missing = recording.bridged[: count * length].reshape(count, length)
        blocks = {name: np.where(missing, np.nan, values) for name, values in blocks.items()}
    time = recording.t[0] + (np.arange(count) + 0.5) * length / recording.rate
    wander, shown = beliefs("inference")["features"]["wander"], []
    for feature in wanted:
        values = feature.of(blocks, recording.rate) if feature.needs <= blocks.keys() else None
        if values is not None and np.isfinite(values).all() and np.ptp(values) > 0.0:
            shown.append((feature, Information(time, np.eye(count), values, slope=wander, walk=wander)))
    return shown
