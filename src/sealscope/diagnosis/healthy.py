"""Healthy recordings: the summaries that detectors make of them, and what they tell, computed once and kept on disk.

A healthy recording is given as samples, or as the summaries that were stored when the machine was commissioned.
A detector summarises a healthy recording in a record (`Summary`), whose fields are the only statement of what is
stored: they are written to a machine's file as a table (`table`), checked by their types when they are read
(`commissioned.machine_file`), and restored from it (`restore`).

Detectors summarise a healthy recording, and its own changes are tested, each time that another recording is judged
beside it. The results depend on the samples of the recording, the assumed rig and the sources of this package only:
the name of a result's file is a hash of these. The files lie beside the compiled code, in the folder of these sources
(`compiled.cache_directory`), so that those of older sources are removed with it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from sealscope.compiled import cache_directory
from sealscope.recordings.recording import Array, Recording, compute_once, keep_with_recording
from sealscope.storage.kept_results import MISSING, SUFFIX, keep_result, plain_json, remove_oldest, restore_result

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Largest magnitude of a stored number, so that products of two numbers do not overflow.
MAX_NUMBER = 1e100
#: Largest magnitude of the logarithm of a number that is neither zero nor infinite (double precision).
MAX_LOGARITHM = 750.0
#: First and last time that `datetime` can represent, about the years 1 and 9999 [s since 1970].
_FIRST_TIME, _LAST_TIME = -6.2e10, 2.5e11


class Stored(NamedTuple):
    """Rule for a stored value: `make_schema` makes its schema from pydantic's module of schemas, when first read."""

    make_schema: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return self.make_schema(core_schema)


def stored_array(*shape: int) -> Stored:
    """Make the rule for an array of finite numbers below 1e100 in magnitude, of any shape if none is given."""

    def check_array(value: Any) -> Any:
        """Return the value unchanged; raise ValueError if it is no such array."""
        if not isinstance(value, np.ndarray):
            raise ValueError("must be an array of numbers")
        if not (np.abs(value) < MAX_NUMBER).all():
            raise ValueError(f"must hold finite numbers with a magnitude below {MAX_NUMBER:g}")
        if shape and value.shape != shape:
            raise ValueError(f"must be of the shape {shape}, got {value.shape}")
        return value

    return Stored(lambda core: core.no_info_plain_validator_function(check_array))


#: Types of stored values: any number, one of at least 0, one above 0, a time [s since 1970], texts, and an array.
Number = Annotated[float, Stored(lambda core: core.float_schema(gt=-MAX_NUMBER, lt=MAX_NUMBER, strict=True))]
Magnitude = Annotated[float, Stored(lambda core: core.float_schema(ge=0.0, lt=MAX_NUMBER, strict=True))]
Positive = Annotated[float, Stored(lambda core: core.float_schema(gt=0.0, lt=_LAST_TIME, strict=True))]
Time = Annotated[float, Stored(lambda core: core.float_schema(gt=_FIRST_TIME, lt=_LAST_TIME, strict=True))]
Texts = Annotated[list[str], Stored(lambda core: core.list_schema(core.str_schema(strict=True), fail_fast=True))]
Values = Annotated[Array, stored_array()]


@dataclass(frozen=True, eq=False)
class Summary:
    """A detector's summary of a healthy recording, for the comparison with others; unknown entries are None.

    A subclass is a frozen dataclass, whose fields have types of stored values. `method`: name under which it is stored,
    that of its detector.
    """

    method: ClassVar[str]

    @classmethod
    def restore(cls, table: Mapping[str, Any]) -> Self:
        """Restore a summary from its `table`, in which unknown entries are missing; further ones are ignored."""
        return cls(**{entry.name: table[entry.name] for entry in fields(cls) if entry.name in table})

    def table(self) -> dict[str, Any]:
        """Return the known entries by their names."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def check(self) -> None:
        """Check the entries against each other; raise ValueError if they do not fit."""


_T = TypeVar("_T")
_S = TypeVar("_S", bound=Summary)
_T_co = TypeVar("_T_co", covariant=True)


@dataclass(frozen=True, eq=False)
class SummarisedRecording:
    """A healthy recording reduced to the detectors' summaries, without its samples."""

    file: str  # name of the recording
    digest: str  # SHA-256 of its chamber pressures in hexadecimal digits, equal for copies of a recording
    units: Mapping[str, str]  # unit of each channel
    rate: float  # sampling rate [Hz]
    seconds: float  # duration [s]
    start_s: float | None  # time of its first sample [s since 1970], None if unknown
    summaries: Mapping[str, Mapping[str, Any]]  # table of the summary by each detector (`Summary.table`), by its name
    # pressure, oil, noise and problems, for display (`commissioned.summary.describe_recording`)
    about: Mapping[str, Any] = field(default_factory=dict)
    # surprisal, -log(p-value), of each test for a change within it, by the key of the test (`healthy_surprisals`)
    statistics: Mapping[str, float] = field(default_factory=dict)

    def summary(self, kind: type[_S]) -> _S | None:
        """Restore the summary of a `kind`; None if the recording has none."""
        table = self.summaries.get(kind.method)
        return None if table is None else kind.restore(table)


#: A healthy recording, as samples or as summaries.
Healthy = Recording | SummarisedRecording


class Learner(Protocol[_T_co]):
    """A detector that summarises healthy recordings.

    A built-in one names the type of its summaries, a `Summary`, as `summary_type`; those of a plug-in are tables.
    """

    name: str

    def learn(self, recording: Recording) -> _T_co | None:
        """Summarise a healthy recording; None if that is impossible."""


def summary_table(detector: Learner[Any], healthy: Healthy) -> Mapping[str, Any] | None:
    """Return the table of a detector's summary of a healthy recording, stored or computed; None if it has none.

    A built-in detector computes it once for each content of a recording and each assumed rig (`learn_once`).
    """
    if isinstance(healthy, SummarisedRecording):
        return healthy.summaries.get(detector.name)
    if not hasattr(detector, "summary_type"):
        return detector.learn(healthy)  # type: ignore[no-any-return]

    def tabulate(recording: Recording) -> Mapping[str, Any] | None:
        """Summarise a recording as a table."""
        summary: Summary | None = detector.learn(recording)
        return None if summary is None else summary.table()

    return learn_once(healthy, (detector.name, "summary"), tabulate, getattr(detector, "rig", None))


def healthy_summaries(detector: Learner[_T_co], recordings: Sequence[Healthy]) -> list[_T_co]:
    """Collect a detector's summaries of recordings, stored or computed by its `learn`; some may have none."""
    tables: Iterable[Any] = (summary_table(detector, recording) for recording in recordings)
    kind: Any = getattr(detector, "summary_type", None)
    return [table if kind is None else kind.restore(table) for table in tables if table is not None]


#: Most results that are kept.
MAX_RESULTS = 5000
#: Packages on which results depend, beside those on whose sources the name of the cache folder depends.
_PACKAGES = ("recordings", "evaluation")


@cache
def results_folder() -> Path | None:
    """Create the folder of the results of these sources, and return its path; None if nothing is cached."""
    directory = cache_directory()
    if directory is None:
        return None
    sources, root = sha256(), Path(__file__).parents[1]
    for package in _PACKAGES:
        for file in sorted(file for file in (root / package).rglob("*") if file.suffix in (".py", ".toml")):
            sources.update(file.read_bytes())
    folder = directory / f"learnt-{sources.hexdigest()[:16]}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError:
        return None
    remove_oldest(folder, MAX_RESULTS)
    return folder


def learn_once(
    recording: Recording, key: tuple[str, ...], compute: Callable[[Recording], _T], rig: Rig | None = None
) -> _T:
    """Return `compute(recording)`, computed once for each content of a recording, `key` and `rig`.

    The result is cached with the recording, and kept on disk if its values are plain (`storage.kept_results`).
    """

    def restore_or_compute(samples: Recording) -> _T:
        """Restore the result from disk, or compute and keep it."""
        assumed = None if rig is None else rig.as_dict()
        return _restore_or_compute(
            lambda: json.dumps([_compute_digest(samples), key, assumed], default=str), lambda: compute(samples)
        )

    return compute_once(recording, (*key, rig), restore_or_compute)


def keep_once(content: Any, compute: Callable[[], _T]) -> _T:
    """Return `compute()`, kept on disk by the plain values `content` on which alone it depends."""
    return _restore_or_compute(lambda: plain_json(content), compute)


def _restore_or_compute(content: Callable[[], str], compute: Callable[[], _T]) -> _T:
    """Restore a result from disk by the text `content()` on which it depends, or compute and keep it."""
    folder = results_folder()
    if folder is None:
        return compute()
    file = folder / (sha256(content().encode()).hexdigest() + SUFFIX)
    result = restore_result(file)
    if result is MISSING:
        result = compute()
        keep_result(file, result)
    return result  # type: ignore[no-any-return]


@keep_with_recording
def _compute_digest(recording: Recording) -> str:
    """Compute the SHA-256 of all that a recording holds, samples, units, rate, origin and history, in hexadecimal."""
    content = sha256(recording.t.tobytes())
    for values in recording.channels.values():
        content.update(values.tobytes())
    if recording.bridged is not None:
        content.update(recording.bridged.tobytes())
    description = [dict(recording.units), recording.rate, dict(recording.provenance), recording.history]
    content.update(json.dumps(description, default=str).encode())
    return content.hexdigest()
