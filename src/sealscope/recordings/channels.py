"""The channels of a recording: names (the thesis's symbols), SI units, meanings, and statistics of their long arrays.

Statistics are computed stretch by stretch: no copy of a whole channel, and each stretch stays in the cache. The reader
of times, the inspection of a recording and its overview must not need more memory than the recording itself.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Channel -> its unit inside Sealscope, and what it measures; `docs/nomenclature.md` explains the names.
_CHANNELS = {
    "u": ("V", "command"),
    "omega": ("rad/s", "motor speed"),
    "theta": ("rad", "motor angle"),
    "x": ("m", "piston position"),
    "p_1": ("Pa", "pressure at pump port 1"),
    "p_2": ("Pa", "pressure at pump port 2"),
    "p_A": ("Pa", "pressure in chamber A"),
    "p_B": ("Pa", "pressure in chamber B"),
    "q_leak": ("m^3/s", "leakage flow"),
    "q_comp": ("m^3/s", "leakage flow that the controller makes good"),
    "q_pump": ("m^3/s", "flow to the cylinder by a meter"),
    "q_supply": ("m^3/s", "flow to the valve by a meter in its supply line"),
    "valve": ("V", "valve direction"),
    "T_oil": ("K", "oil temperature"),
}
CHANNEL_UNITS: Mapping[str, str] = MappingProxyType({name: unit for name, (unit, _) in _CHANNELS.items()})
#: What each channel, and the time, measures.
LONG_NAMES: Mapping[str, str] = MappingProxyType({"t": "time"} | {name: text for name, (_, text) in _CHANNELS.items()})
#: Channels of flow meters.
METERS = ("q_pump", "q_supply")
#: Channels from which the flow to the cylinder is computed, best first: pump angle, speed, flow meters, command.
FLOW_SOURCES = ("theta", "omega", *METERS, "u")
#: Channels that change slowly, over minutes, in which constant or mostly missing values are not defects.
SLOW = frozenset({"T_oil"})
#: Unit of a channel whose column states none: raw counts of a converter.
COUNTS = "count"

#: Beginning of the history line that lists the unused columns of a file.
UNUSED = "columns not used"
#: Changes up to this fraction of a reading's largest value are rounding errors: the reading does not move.
ROUNDING = 1e-9
#: A longer channel is thinned to this many samples, or up to twice as many, to estimate its quantisation step.
_QUANTUM_SAMPLES = 2**15


def flow_source(channels: Container[str]) -> str | None:
    """Choose the best of `FLOW_SOURCES` for computing the flow to the cylinder; None if all are absent."""
    return next((name for name in FLOW_SOURCES if name in channels), None)


def smallest_step(values: Array) -> float:
    """Find the smallest step of sorted `values` (n > 0,) that exceeds `ROUNDING` times their range; 0 if none does."""
    steps = np.diff(values)
    steps = steps[steps > ROUNDING * (values[-1] - values[0])]
    return float(steps.min()) if steps.size else 0.0


def estimate_quantum(values: Array) -> float:
    """Estimate the quantisation step of finite values (n > 0,), thinned if they are many; 0 if all are equal."""
    return smallest_step(np.unique(values[:: max(1, values.size // _QUANTUM_SAMPLES)]))


CHAMBERS = ("p_A", "p_B")
#: The pump's ports and the chambers, in the order of the instruments.
PRESSURES = ("p_1", "p_2", *CHAMBERS)

#: Units in which pressures are displayed.
DISPLAY_UNITS = ("bar", "MPa", "kPa", "psi")


def chambers_of(recording: Container[str]) -> tuple[str, ...]:
    """List the names of the chamber pressures that a recording contains, p_A before p_B."""
    return tuple(name for name in CHAMBERS if name in recording)


_STRETCH = 2**16  # samples of a stretch: half a MiB of doubles


def iter_stretches(count: int, overlap: int = 0) -> Iterator[slice]:
    """Yield the slices of `count` samples in stretches; each ends `overlap` samples after the next one's beginning."""
    for first in range(0, count - overlap, _STRETCH):
        yield slice(first, min(first + _STRETCH, count - overlap) + overlap)


class Intervals(NamedTuple):
    """Intervals between successive times [s]; 0 and 0 s without any."""

    number: int
    n_changes: int  # number of intervals other than 0
    shortest: float  # NaN if a time is missing
    longest: float


def summarize_intervals(t: NDArray[np.float64]) -> Intervals:
    """Summarize the intervals between successive times `t` (n,) [s]."""
    n_changes, extremes = 0, list[tuple[float, float]]()
    for stretch in iter_stretches(t.size, overlap=1):
        steps = np.diff(t[stretch])
        n_changes += int(np.count_nonzero(steps))
        extremes.append((float(steps.min()), float(steps.max())))
    shortest, longest = np.array(extremes).T if extremes else (np.zeros(1), np.zeros(1))
    return Intervals(max(0, t.size - 1), n_changes, float(shortest.min()), float(longest.max()))


def finite_range(values: NDArray[np.float64]) -> tuple[float, float] | None:
    """Find the smallest and the largest finite one of values (n,); None if none is finite."""
    extremes = []
    for stretch in iter_stretches(values.size):
        part = values[stretch]
        lowest, highest = float(part.min()), float(part.max())
        if not np.isfinite(highest - lowest):
            part = part[np.isfinite(part)]
            if not part.size:
                continue
            lowest, highest = float(part.min()), float(part.max())
        extremes.append((lowest, highest))
    return (min(lowest for lowest, _ in extremes), max(highest for _, highest in extremes)) if extremes else None


def take_finite(values: NDArray[Any]) -> NDArray[Any]:
    """Take the finite ones of values (n,), which are the array itself if all are."""
    is_finite = np.isfinite(values)
    return values if is_finite.all() else values[is_finite]


def largest_steps(values: NDArray[np.float64], count: int) -> list[int]:
    """Find the indices of the `count` largest steps from sample to sample of finite values (n,), the largest last."""
    candidates: list[tuple[float, int]] = []
    for stretch in iter_stretches(values.size, overlap=1):
        sizes = np.abs(np.diff(values[stretch]))
        largest = np.argpartition(sizes, -count)[-count:] if sizes.size > count else np.arange(sizes.size)
        candidates += [(float(sizes[index]), stretch.start + int(index)) for index in largest]
    return [index for _, index in sorted(candidates)[-count:]]
