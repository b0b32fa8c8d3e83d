"""The Recording: labelled time series with units, a rate and a history; the one meeting point of the whole project.

A Recording is what a rig's data logger would have written. Where it came from (a simulator, a file, a stream) is told
by its provenance and by nothing else; the truth of a simulation is never part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from threading import Lock
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError

Array = NDArray[np.float64]
_T = TypeVar("_T")

#: Channel names (the thesis's symbols) and the unit each has inside Sealscope; `docs/nomenclature.md` explains them.
CHANNEL_UNITS: Mapping[str, str] = MappingProxyType(
    {
        "u": "V",
        "omega": "rad/s",
        "theta": "rad",
        "x": "m",
        "p_1": "Pa",
        "p_2": "Pa",
        "p_A": "Pa",
        "p_B": "Pa",
        "q_leak": "m^3/s",
    }
)

#: Unit of a mapped channel that came without one: raw counts of a converter.
COUNTS = "count"


def _frozen(values: Any) -> Array:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass
class _Result:
    """A result that is computed once, whichever thread is first."""

    lock: Lock = field(default_factory=Lock)
    value: Any = None
    known: bool = False


@dataclass(frozen=True, eq=False)
class Recording:
    """Channels sampled on one time base.

    `t`: (n,) time [s]; `channels`: name -> (n,) values, NaN where a sample is missing; `units`: name -> unit, the SI
    unit of `CHANNEL_UNITS` or `COUNTS`; `rate`: nominal sampling rate [Hz]; `provenance`: plain JSON values that say
    where the data come from; `history`: one line for each processing step. Arrays are copied and read-only.

    Raises InputError when lengths differ, a unit is missing or the rate is not positive.
    """

    t: Array
    channels: Mapping[str, Array]
    units: Mapping[str, str]
    rate: float
    provenance: Mapping[str, Any] = field(default_factory=dict)
    history: tuple[str, ...] = ()
    _results: dict[Hashable, _Result] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        t = _frozen(self.t)
        channels = {name: _frozen(values) for name, values in self.channels.items()}
        if t.ndim != 1:
            raise InputError(f"t must be one-dimensional, got shape {t.shape}")
        for name, values in channels.items():
            if values.shape != t.shape:
                raise InputError(f"channel {name} must have as many samples as t ({t.size}), got shape {values.shape}")
            if name not in self.units:
                raise InputError(f"channel {name} must have a unit, got none")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise InputError(f"rate must be > 0 Hz, got {self.rate}")
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "channels", MappingProxyType(channels))
        object.__setattr__(self, "units", MappingProxyType({name: self.units[name] for name in channels}))
        object.__setattr__(self, "rate", float(self.rate))
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        object.__setattr__(self, "history", tuple(self.history))

    def __getitem__(self, name: str) -> Array:
        try:
            return self.channels[name]
        except KeyError:
            have = ", ".join(self.channels) or "none"
            raise InputError(f"channel {name} is not in this recording; it has {have}") from None

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def duration(self) -> float:
        """Number of samples over the nominal rate [s]."""
        return self.t.size / self.rate

    def between(self, start: float, stop: float) -> Recording:
        """The samples with start <= t < stop [s]."""
        inside = (self.t >= start) & (self.t < stop)
        return replace(
            self,
            t=self.t[inside],
            channels={name: values[inside] for name, values in self.channels.items()},
            history=(*self.history, f"cut to {start:g} s <= t < {stop:g} s"),
        )

    def samples(self, chosen: slice) -> Recording:
        """The samples of a slice, times as they are."""
        return replace(
            self,
            t=self.t[chosen],
            channels={name: values[chosen] for name, values in self.channels.items()},
            history=(*self.history, f"cut to samples {chosen.start} to {chosen.stop}"),
        )

    def only(self, names: Iterable[str]) -> Recording:
        """The same recording with the named channels alone."""
        part = replace(self, channels={name: self[name] for name in names})
        object.__setattr__(part, "_results", self._results)
        return part


def remembered(
    recording: Recording, key: Hashable, compute: Callable[[Recording], _T], channels: Iterable[str] | None = None
) -> _T:
    """Return `compute(recording)`, computed once for a recording and a `key`, and kept as long as the recording is.

    `channels`: those that the result depends on (default: all that the recording has). The views that
    `Recording.only` makes share results which depend on the same channels.
    """
    names = frozenset(recording.channels if channels is None else channels)
    result = recording._results.setdefault((key, names), _Result())
    with result.lock:
        if not result.known:
            result.value, result.known = compute(recording), True
        value: _T = result.value
    return value
