"""Steps that no balance shows: of the duty's size and pace, of the noise of a sensor, of hum.

Each is a row of data: a number a block, whose step names a cause. Its scatter from block to block is its noise, so that
`onset.step_test` asks the same question of it as of a coefficient. A leak moves none of them: the command is the
operator's, the noise stands above the ringing, which a leak damps, and in p_A + p_B the ringing cancels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.terms import priors
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.recording import Array, Recording

#: Blocks of a recording.
BLOCKS = 40
#: Differences by which noise is told from motion and ringing: the response goes with this power of the frequency.
ORDER = 6
#: Frequencies of the mains [Hz], and pieces of a block whose power is averaged.
MAINS, PIECES = (50.0, 60.0), 4
#: What commands the motion, and what moves, in the order of preference.
COMMANDS, MOTIONS = ("x_d", "u", "omega", "theta"), ("x", "theta", "omega", "u")


Of = Callable[[dict[str, Array], float], Array | None]


class Feature(NamedTuple):
    """A number for each block: its name, what a step of it means, and how it is computed of blocks (K, n)."""

    name: str
    cause: Cause
    of: Of


def _size(names: tuple[str, ...]) -> Of:
    """Return the range of the first recorded of some channels, without its farthest 2 % on either side."""

    def size(blocks: dict[str, Array], rate: float) -> Array | None:
        name = next((own for own in names if own in blocks), None)
        if name is None:
            return None
        low, high = np.nanpercentile(blocks[name], [2.0, 98.0], axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(high - low))

    return size


def _noise(sign: float) -> Of:
    """Return the noise of both sensors together (1), or of one beside the other's (-1)."""

    def noise(blocks: dict[str, Array], rate: float) -> Array | None:
        if not {"p_A", "p_B"} <= blocks.keys():
            return None
        own, other = (_log_power(np.diff(blocks[name], ORDER, axis=1)) for name in ("p_A", "p_B"))
        return np.asarray(own + sign * other)

    return noise


def _hum(hertz: float) -> Of:
    def hum(blocks: dict[str, Array], rate: float) -> Array | None:
        if not {"p_A", "p_B"} <= blocks.keys() or not hertz < 0.45 * rate:
            return None
        length = blocks["p_A"].shape[1] // PIECES
        values = (blocks["p_A"] + blocks["p_B"])[:, : PIECES * length].reshape(-1, PIECES, length)
        window = np.hanning(length) * np.exp(-2j * np.pi * hertz / rate * np.arange(length))
        power = np.abs((values - values.mean(axis=2, keepdims=True)) @ window) ** 2
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(power.mean(axis=1)))

    return hum


def _sense(blocks: dict[str, Array], rate: float) -> Array | None:
    """Return whether p_A - p_B goes with the flow into A (1) or against it (-1): friction takes work."""
    name = next((own for own in ("omega", "u", "theta", "x") if own in blocks), None)
    if name is None or not {"p_A", "p_B"} <= blocks.keys():
        return None
    flow = blocks[name] if name in ("omega", "u") else np.gradient(blocks[name], axis=1)
    difference = blocks["p_A"] - blocks["p_B"]
    return np.asarray(np.sign(np.nanmean((difference - np.nanmean(difference)) * flow, axis=1)))


def _log_power(values: Array) -> Array:
    """Return the logarithm of the median square of each block: a jump at a reversal is no noise."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.nanmedian(values**2, axis=1)))


#: A duty of another size changes command and motion alike; a leak one of them, in an open or in a closed loop.
DUTY = (
    Feature("size of the command", "changed duty", _size(COMMANDS)),
    Feature("size of the motion", "changed duty", _size(MOTIONS)),
)
FEATURES = (
    Feature("sense of p_A - p_B", "sensor fault", _sense),
    Feature("noise of the pressures", "sensor fault", _noise(1.0)),
    Feature("noise of p_A beside that of p_B", "sensor fault", _noise(-1.0)),
    *(Feature(f"hum of {hertz:g} Hz", "sensor fault", _hum(hertz)) for hertz in MAINS),
)


def features(recording: Recording, wanted: Sequence[Feature] = FEATURES) -> list[tuple[Feature, Information]]:
    """Return what the blocks of a recording say of features, those left out that its channels do not show."""
    length = len(recording) // BLOCKS
    if length <= ORDER + 1:
        return []
    blocks = {name: values[: BLOCKS * length].reshape(BLOCKS, length) for name, values in recording.channels.items()}
    if recording.bridged is not None:
        missing = recording.bridged[: BLOCKS * length].reshape(BLOCKS, length)
        blocks = {name: np.where(missing, np.nan, values) for name, values in blocks.items()}
    time = recording.t[0] + (np.arange(BLOCKS) + 0.5) * length / recording.rate
    wander, shown = priors()["features"]["wander"].value, []
    for feature in wanted:
        values = feature.of(blocks, recording.rate)
        if values is not None and np.count_nonzero(np.isfinite(values)) == BLOCKS and np.ptp(values) > 0.0:
            shown.append((feature, Information(time, np.eye(BLOCKS), values, slope=wander, walk=wander)))
    return shown
