"""Commands: the voltage that a test sends to the servo drive, as data."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array, Recording
from sealscope.units import parse_quantity


def number_text(value: float) -> str:
    """Format a number as the shortest text that reads back exactly."""
    return repr(float(value)).removesuffix(".0")


class Command(Protocol):
    """A command: volts as a function of time, and its text, which `parse_command` reads."""

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s] (any shape); 0 before t = 0."""
        ...

    def __str__(self) -> str: ...


@dataclass(frozen=True)
class Sine:
    """u = offset + amplitude sin(omega t + phase); `omega` [rad/s]."""

    amplitude: float
    omega: float
    phase: float = 0.0
    offset: float = 0.0

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        return self.offset + self.amplitude * np.sin(self.omega * t + self.phase)

    def __str__(self) -> str:
        phase, offset = (
            f" {'-' if value < 0 else '+'} {number_text(abs(value))}" if value else ""
            for value in (self.phase, self.offset)
        )
        return f"{number_text(self.amplitude)} sin({number_text(self.omega)}t{phase}){offset}"


@dataclass(frozen=True)
class MultiSine:
    """u = the sum of two sines or more, the last of which may have an offset."""

    parts: tuple[Sine, ...]

    def __post_init__(self) -> None:
        if len(self.parts) < 2 or any(sine.offset for sine in self.parts[:-1]):
            raise InputError(f"a multi-sine must be of two sines or more, an offset in the last alone, got {self}")

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        return np.asarray(sum(sine.volts(t) for sine in self.parts))

    def __str__(self) -> str:
        return " + ".join(map(str, self.parts))


@dataclass(frozen=True)
class Trapezoid:
    """u rises evenly from 0 to `level` within `rise` [s], stays, and falls back likewise, every `period` [s]."""

    level: float
    rise: float
    period: float

    def __post_init__(self) -> None:
        if not 0.0 < 4.0 * self.rise <= self.period:
            raise InputError(
                f"a trapezoid must rise within a quarter of its period, got {self.rise:g} s of {self.period:g} s"
            )

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        since = np.mod(np.maximum(t, 0.0), self.period)
        up, down = since / self.rise, (since - 0.5 * self.period) / self.rise
        return np.asarray(self.level * (np.clip(up, 0.0, 1.0) - np.clip(down, 0.0, 1.0)))

    def __str__(self) -> str:
        level, rise, period = map(number_text, (self.level, self.rise, self.period))
        return f"trapezoid {level} within {rise} s every {period} s"


@dataclass(frozen=True)
class Alternating:
    """Sines in turn, each for a whole number of its periods from its own zero, again and again: (periods, sine)."""

    parts: tuple[tuple[int, Sine], ...]

    def __post_init__(self) -> None:
        for periods, sine in self.parts:
            if not (periods >= 1 and sine.omega > 0 and sine.phase == 0 and sine.offset == 0):
                raise InputError(f"a duty in turn must be of periods >= 1 of sines from zero, got {periods} of {sine}")

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        lengths = np.array([2.0 * np.pi * periods / sine.omega for periods, sine in self.parts])
        ends = np.cumsum(lengths)
        since = np.mod(t, ends[-1])
        part = np.minimum(np.searchsorted(ends, since, side="right"), ends.size - 1)
        amplitude = np.array([sine.amplitude for _, sine in self.parts])
        omega = np.array([sine.omega for _, sine in self.parts])
        u = amplitude[part] * np.sin(omega[part] * (since - (ends - lengths)[part]))
        return np.asarray(np.where(t >= 0, u, 0.0))

    def __str__(self) -> str:
        return ", ".join(f"{periods} periods of {sine}" for periods, sine in self.parts)


@dataclass(frozen=True, eq=False)
class Polyline:
    """A course that is linear between points, and constant before the first and after the last.

    `t`, `y`: (n,) times [s] that do not fall, and values; of two points at one time the later holds from there on.
    `words`: what it is called, in the form that parsers read. Of two equal ones all three are the same.
    """

    t: Array
    y: Array
    words: str

    def value_at(self, t: Array) -> Array:
        """Compute the values at times t [s] (any shape)."""
        return np.interp(t, self.t, self.y)

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        return self.value_at(t)

    def bends(self) -> tuple[float, ...]:
        """List the times [s] of its jumps and bends; none for a table too long to follow each."""
        return tuple(map(float, np.unique(self.t))) if self.t.size < _LONGEST_FOLLOWED else ()

    def onset(self) -> float:
        """Find the time [s] from which it differs from 0: 0 for a start beyond 0, infinity for a course of zeros."""
        first = int(np.argmax(self.y > 0)) if np.any(self.y > 0) else -1
        return math.inf if first < 0 else float(self.t[first - 1]) if first else 0.0

    @property
    def rise(self) -> tuple[float, float] | None:
        """Begin and end [s] of a linear rise from 0 to 1, None for another course."""
        return (float(self.t[0]), float(self.t[1])) if self.y.tolist() == [0.0, 1.0] else None

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Polyline):
            return NotImplemented
        return self.words == other.words and np.array_equal(self.t, other.t) and np.array_equal(self.y, other.y)

    def __hash__(self) -> int:
        return hash((self.words, self.t.size))

    def __str__(self) -> str:
        return self.words


_LONGEST_FOLLOWED = 1000


def polyline(points: Sequence[tuple[float, float]], words: str) -> Polyline:
    """Make the course through points (t, y)."""
    t, y = np.array(points, dtype=np.float64).T
    return Polyline(t, y, words)


def tabulated(t: Array, y: Array, what: str = "a table") -> Polyline:
    """Make the course through the points of a table; raise InputError for falling times and infinite values."""
    if t.ndim != 1 or t.shape != y.shape or t.size < 1 or np.any(np.diff(t) < 0):
        raise InputError(f"{what} must have one value for each time, and its times must rise")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(y))):
        raise InputError(f"times and values of {what} must be finite, got NaN or infinity")
    return Polyline(t, y, f"table of {t.size} points over {t[0]:g}..{t[-1]:g} s")


def step(level: float, start: float = 0.0) -> Polyline:
    """Make u = 0 before `start` [s], `level` [V] from then on."""
    return polyline([(start, 0.0), (start, level)], f"step {number_text(level)} at {number_text(start)} s")


def ramp(level: float, start: float, stop: float) -> Polyline:
    """Make u that rises linearly from 0 at `start` [s] to `level` [V] at `stop` [s] and stays there."""
    if not stop > start:
        raise InputError(f"a ramp must stop after it starts, got {start:g} s to {stop:g} s")
    words = f"ramp {number_text(level)} from {number_text(start)} s to {number_text(stop)} s"
    return polyline([(start, 0.0), (stop, level)], words)


@dataclass(frozen=True)
class Chirp:
    """u = amplitude sin(2 pi (f_0 t + (f_1 - f_0) t^2 / (2 T))).

    The frequency goes from f_0 to f_1 [Hz] over T [s] and stays at f_1 afterwards.
    """

    amplitude: float
    f_0: float
    f_1: float
    duration: float

    def __post_init__(self) -> None:
        if not (self.f_0 >= 0 and self.f_1 >= 0 and self.duration > 0):
            raise InputError(f"a chirp must have frequencies >= 0 Hz and a duration > 0 s, got {self}")

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        within = np.minimum(t, self.duration)
        cycles = self.f_0 * within + (self.f_1 - self.f_0) * within**2 / (2.0 * self.duration)
        return self.amplitude * np.sin(2.0 * np.pi * (cycles + self.f_1 * (t - within)))

    def __str__(self) -> str:
        amplitude, f_0, f_1, duration = map(number_text, (self.amplitude, self.f_0, self.f_1, self.duration))
        return f"chirp {amplitude} from {f_0} Hz to {f_1} Hz over {duration} s"


#: SplitMix64: the step from state to state, and by which shifts and factors a state is mixed.
GOLDEN, MIX = 0x9E3779B97F4A7C15, ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB))


@dataclass(frozen=True)
class PseudoRandom:
    """Pseudo-random binary command: +amplitude or -amplitude, drawn anew every `hold` [s] from `seed`.

    The sign of slot k is a bit of SplitMix64 at its k-th state (Steele, Lea, Flood, OOPSLA 2014): any slot is known at
    once, however many stand before it.
    """

    amplitude: float
    hold: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.hold > 0:
            raise InputError(f"a pseudo-random command must hold each value for > 0 s, got {self.hold:g} s")

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        slot = np.clip(np.floor(t / self.hold), 0.0, 2.0**63).astype(np.uint64)
        start = np.random.SeedSequence(self.seed).generate_state(1, np.uint64)
        z = start + (slot + np.uint64(1)) * np.uint64(GOLDEN)
        for shift, factor in MIX:
            z = (z ^ (z >> np.uint64(shift))) * np.uint64(factor)
        signs = np.where((z ^ (z >> np.uint64(31))) >> np.uint64(63), 1.0, -1.0)
        return np.where(t >= 0, self.amplitude * signs, 0.0)

    def __str__(self) -> str:
        return f"prbs {number_text(self.amplitude)} every {number_text(self.hold)} s seed {self.seed}"


def recorded(t: Array, u: Array, origin: str = "recorded") -> Polyline:
    """Make a recorded course: linear between its samples, its last value afterwards."""
    if t.size < 2 or np.any(np.diff(t) == 0):
        raise InputError(f"a recorded course must have two samples or more, one at a time, got {t.size} ({origin})")
    return replace(tabulated(t, u, f"a recorded course ({origin})"), words=f"file {origin}")


def recorded_command(recording: Recording, origin: str) -> Polyline:
    """Make a command of the channel `u` of a recording; its first sample is at t = 0."""
    return recorded(recording.t - recording.t[0], recording["u"], origin)


#: Samples of a command that are looked at together, so that a long one does not fill the memory.
_CHECKED_AT_ONCE = 1_000_000


def check_command(command: Command, t: Array, limit: float) -> None:
    """Raise InputError where the command leaves +-`limit` [V], the converter's range.

    That, or no number, at any of the times `t` [s].
    """
    for start in range(0, t.size, _CHECKED_AT_ONCE):
        part = t[start : start + _CHECKED_AT_ONCE]
        u = command.volts(part)
        bad = ~(np.abs(u) <= limit * (1 + 1e-12))
        if bad.any():
            k = int(np.argmax(bad))
            raise InputError(
                f"command must stay within +-{limit:g} V, got {u[k]:.4g} V at t = {part[k]:.4g} s ({command})"
            )


#: Patterns in texts of commands, leaks and faults: a number without and with a sign, and a time ("90", "90 s",
#: "1.5[min]").
UNSIGNED = r"(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
NUMBER = rf"[-+]?{UNSIGNED}"
TIME = rf"{UNSIGNED}\s*(?:\[\s*\w+\s*\]|(?:s|ms|min|h)\b)?"
_N, _T = NUMBER, rf"[-+]?{TIME}"
_SIGNED = rf"[-+]\s*{UNSIGNED}"
_FORMS: tuple[tuple[str, Callable[[list[str | None]], Command]], ...] = (
    (
        rf"trapezoid\s+({_N})\s*v?\s+within\s+({_T})\s+every\s+({_T})",
        lambda g: Trapezoid(_number(g[0], 0.0), seconds(g[1]), seconds(g[2])),
    ),
    (rf"step\s+({_N})\s*v?(?:\s+at\s+({_T}))?", lambda g: step(_number(g[0], 0.0), seconds(g[1]))),
    (
        rf"ramp\s+({_N})\s*v?\s+(?:from\s+({_T})\s+)?(?:to|over)\s+({_T})",
        lambda g: ramp(_number(g[0], 0.0), seconds(g[1]), seconds(g[2])),
    ),
    (
        rf"chirp\s+({_N})\s*v?\s+from\s+({_N})\s*(?:hz)?\s+to\s+({_N})\s*(?:hz)?\s+over\s+({_T})",
        lambda g: Chirp(_number(g[0], 0.0), _number(g[1], 0.0), _number(g[2], 0.0), seconds(g[3])),
    ),
    (
        rf"prbs\s+({_N})\s*v?\s+every\s+({_T})(?:\s+seed\s+(\d+))?",
        lambda g: PseudoRandom(_number(g[0], 0.0), seconds(g[1]), int(g[2] or 0)),
    ),
)


def seconds(text: str | None) -> float:
    """Compute the time [s] of a match of `TIME`; 0 for None."""
    return 0.0 if text is None else parse_quantity(text.lower(), "s", name="a time")


def _number(text: str | None, default: float) -> float:
    if text is None:
        return default
    value = float(text.replace(" ", ""))
    if not math.isfinite(value):
        raise InputError(f"a number in a command must be finite, got {text}")
    return value


_LONGEST_TEXT = 1000


def plain_text(text: str, what: str) -> str:
    """Reduce the blanks in the text of an option to single ones, except in a path after ``file``.

    Raises InputError for one of more than 1000 characters.
    """
    if len(text) > _LONGEST_TEXT:
        raise InputError(f"{what} must be of at most {_LONGEST_TEXT} characters, got {len(text)}")
    if file := re.fullmatch(r"(?:(position)\s+)?(file)\s+(.*)", text.strip(), re.IGNORECASE):
        return " ".join(filter(None, file.groups()))
    return " ".join(text.split())


_SINES = re.compile(rf"\s*([-+])?\s*({_N})?\s*\*?\s*sin\(\s*({_N})?\s*\*?\s*t\s*({_SIGNED})?\s*\)", re.IGNORECASE)


def _sines(text: str) -> Sine | MultiSine | None:
    """Read a sine or a sum of sines, the offset after the last; None for another text."""
    parts: list[Sine] = []
    end = 0
    while (match := _SINES.match(text, end)) is not None and (match[1] or not parts):
        sign = -1.0 if match[1] == "-" else 1.0
        parts.append(Sine(sign * _number(match[2], 1.0), _number(match[3], 1.0), _number(match[4], 0.0)))
        end = match.end()
    rest = re.fullmatch(rf"\s*({_SIGNED})?\s*v?", text[end:], re.IGNORECASE)
    if rest is None or not parts:
        return None
    parts[-1] = replace(parts[-1], offset=_number(rest[1], 0.0))
    return parts[0] if len(parts) == 1 else MultiSine(tuple(parts))


def parse_command(text: str) -> Command:
    """Read a command from text.

    Raises InputError that shows the forms when the text is none of them.
    """
    stripped = text.strip()
    if stripped.lower().startswith("file "):
        from sealscope.recordings import read

        path = stripped[5:].strip()
        return recorded_command(read(path), path)
    stripped = plain_text(text, "command")
    if "period" in stripped.lower():
        form = r"\s*(\d{1,6})\s+periods?\s+of\s+(.*)"
        parts = [re.fullmatch(form, part, re.IGNORECASE) for part in stripped.split(",")]
        turns = [(int(part[1]), parse_command(part[2])) for part in parts if part]
        if len(turns) == len(parts) and all(isinstance(sine, Sine) for _, sine in turns):
            return Alternating(tuple(turns))  # type: ignore[arg-type]
    if (sines := _sines(stripped)) is not None:
        return sines
    for pattern, make in _FORMS:
        match = re.fullmatch(pattern, stripped, re.IGNORECASE)
        if match:
            return make(list(match.groups()))
    raise InputError(
        "command must be like '3 sin(4t)', '3 sin(4t) + 1 sin(9t)', '6 periods of 5 sin(2t), 10 periods of 3 sin(4t)' "
        "(in turn, again and again), 'step 5 at 1 s', 'ramp 5 from 1 s to 3 s', 'trapezoid 3 within 1 s every 8 s', "
        "'chirp 3 from 0.1 Hz to 5 Hz over 60 s', 'prbs 2 every 0.5 s seed 1' or 'file LOG' (channel u of a "
        f"recording), got {text!r}"
    )
