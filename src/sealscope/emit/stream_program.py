"""The kernels of a stream as a program for controllers, and which of its state outlasts a power cut."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sealscope.compiled import law
from sealscope.diagnosis.live.kernel.stream import (
    REASONS,
    RESULTS,
    StreamSettings,
    stream_kernels,
    stream_layout,
)
from sealscope.emit.c99 import Precision
from sealscope.emit.program import Program, StateField
from sealscope.emit.specialise import specialise

#: Entry functions of the program, for C and Structured Text alike.
ENTRIES = ("start", "add_sample", "advance", "results", "acknowledge", "resume")
#: Fields of the state that hold what was learned: they are saved before a power cut, and after learning.
LEARNED_FIELDS = (
    *(
        "angle_sign",
        "has_sign",
        "usual_precision",
        "n_weighted",
        "slow_sums",
        "model_sums",
        "model_values",
        "model_leak_products",
    ),
    *("model_numbers", "steps_unit", "steps_count", "steps_level", "steps_level_variance", "steps_squares"),
    *("steps_log_variances", "steps_log_weights", "leak_size", "leak_deviation", "alarm"),
)
#: Names, units and meanings of the results, by name.
RESULT_UNITS = {
    "q": ("m^3/s", "leakage of pump and piston together, mean of the last blocks"),
    "q_low": ("m^3/s", "its 95 % interval, lower end"),
    "q_high": ("m^3/s", "its 95 % interval, upper end"),
    "q_leak": ("m^3/s", "leak since its onset; 0 without an alarm"),
    "q_leak_low": ("m^3/s", "its 95 % interval, lower end"),
    "q_leak_high": ("m^3/s", "its 95 % interval, upper end"),
    "q_bound": ("m^3/s", "95 % bound of a leak that raised no alarm"),
    "score": ("1", "log evidence of a step of the leakage"),
    "threshold": ("1", "score that raises an alarm, by the stated rate"),
    "alarm": ("1", "1 since the score exceeded the threshold"),
    "since": ("s", "time since the leak's onset"),
    "conductance": ("m^3/(s Pa)", "conductance between the chambers, pump and piston together"),
    "misfit": ("1", "variance of the last block's rows over the usual one"),
    "blocks": ("1", "blocks that were estimated"),
    "reason": ("1", "why there is no estimate: " + "; ".join(f"{k} {text}" for k, text in REASONS.items() if text)),
}
assert tuple(RESULT_UNITS) == RESULTS


class StreamProgram(NamedTuple):
    """The program of a stream for one machine."""

    settings: StreamSettings
    program: Program

    @property
    def precision(self) -> Precision:
        """Precision of the program's real numbers."""
        return "single" if self.settings.basis else "double"

    @property
    def state_bytes(self) -> int:
        """Size of the state in C [bytes]."""
        real = 4 if self.settings.basis else 8
        return sum((real if field.kind == "real" else 4) * (field.size or 1) for field in self.program.fields)

    @property
    def learned_fields(self) -> tuple[StateField, ...]:
        """Fields that outlast a power cut."""
        fields = {field.name: field for field in self.program.fields}
        return tuple(fields[name] for name in LEARNED_FIELDS)

    @property
    def n_learned(self) -> int:
        """Number of numbers in these fields."""
        return sum(field.size or 1 for field in self.learned_fields)

    @property
    def layout_hash(self) -> int:
        """Number (31 bits) by which a saved state is recognised as one of this program."""
        text = repr((self.settings, self.learned_fields))
        return zlib.crc32(text.encode()) & 0x7FFFFFFF

    @property
    def checksum(self) -> str:
        """Hash over settings and functions, 16 hex digits."""
        return hashlib.sha256(repr((self.settings, self.program)).encode()).hexdigest()[:16]


#: Constants of the kernels in single precision: limits of rounding, least and largest numbers.
SINGLE_CONSTANTS: Mapping[str, float] = MappingProxyType(
    {"RIDGE": 1e-7, "ROUNDING": 1e-7, "TINY": 1e-30, "MOST_EXPLAINED": 1.0 - 1e-6, "MAX_READING": 1e12, "BEYOND": 1e32}
)


@lru_cache(maxsize=8)
def stream_program(settings: StreamSettings) -> StreamProgram:
    """Specialise the kernels of a stream to a program whose state includes the results.

    With a basis in its settings, the program is one for single precision.
    """
    kernels, layout = stream_kernels(settings), stream_layout(settings)
    fields = {name: (dtype, offset) for name, (dtype, offset, *_) in (layout.fields or {}).items()}
    fields["results"] = np.dtype(("f8", (len(RESULTS),))), layout.itemsize
    formats, offsets = zip(*fields.values(), strict=True)
    with_results = np.dtype({"names": [*fields], "formats": [*formats], "offsets": [*offsets]})
    write_results = kernels.write_results

    @law
    def results(m: Any) -> None:
        """Compute the results of the blocks so far."""
        write_results(m, m.results)

    channels = dict.fromkeys(("p_A", "p_B", "flow", "x"), "real")
    entries: dict[str, tuple[Any, dict[str, Any]]] = {
        name: (getattr(kernels, name), {"m": "state"}) for name in ENTRIES if hasattr(kernels, name)
    }
    entries["add_sample"] = (kernels.add_sample, {"m": "state", **channels})
    entries["results"] = (results, {"m": "state"})
    return StreamProgram(settings, specialise(with_results, entries, SINGLE_CONSTANTS if settings.basis else None))


def result_rows() -> Sequence[tuple[str, str, str]]:
    """Return name, unit and meaning of each result, in the order of the program."""
    return [(name, *RESULT_UNITS[name]) for name in RESULTS]
