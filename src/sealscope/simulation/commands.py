"""Commands: the voltage sent to the servo drive as a function of time, as data and as text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.units import parse_quantity


def format_number(value: float) -> str:
    """Format a number as the shortest text that is parsed back to exactly the same number."""
    return repr(float(value)).removesuffix(".0")


class Command(Protocol):
    """A command to the servo drive: a voltage over time. Its `str` is the text for `parse_command`, if there is one."""

    def volts(self, t: Array) -> Array:
        """Compute the voltage u [V] at times t >= 0 [s], for an array t of any shape."""
        ...

    def __str__(self) -> str: ...


@dataclass(frozen=True)
class Sine:
    """The command u = offset + amplitude sin(omega t + phase) [V]; `omega` [rad/s], `phase` [rad]."""

    amplitude: float
    omega: float
    phase: float = 0.0
    offset: float = 0.0

    def volts(self, t: Array) -> Array:
        """Compute the sine's voltage u [V] at times t [s]."""
        from sealscope.physics.sine import sine_wave

        return sine_wave(t, self.amplitude, self.omega, self.phase, self.offset)

    def __str__(self) -> str:
        phase, offset = _format_addend(self.phase), _format_addend(self.offset)
        return f"{format_number(self.amplitude)} sin({format_number(self.omega)}t{phase}){offset}"


#: Command of an experiment or plan that states none, one of the thesis's.
DEFAULT_COMMAND = Sine(amplitude=3.0, omega=4.0)


def _format_addend(value: float) -> str:
    """Format a number that follows another one in a sum, such as " + 2" or " - 0.5"; return "" for 0."""
    return f" {'-' if value < 0 else '+'} {format_number(abs(value))}" if value else ""


@dataclass(frozen=True)
class MultiSine:
    """The sum of two or more sines, of which only the last may have an offset."""

    parts: tuple[Sine, ...]

    def __post_init__(self) -> None:
        if len(self.parts) < 2 or any(sine.offset for sine in self.parts[:-1]):
            raise InputError(f"a multi-sine must have two sines or more, with an offset in the last only, got {self}")

    def volts(self, t: Array) -> Array:
        """Compute the voltage u [V] at times t [s]."""
        return np.asarray(sum(sine.volts(t) for sine in self.parts))

    def __str__(self) -> str:
        return " + ".join(map(str, self.parts))


@dataclass(frozen=True)
class Trapezoid:
    """A periodic command that rises from 0 to `level` [V] within `rise` [s], and falls as fast half a period later."""

    level: float
    rise: float
    period: float

    def __post_init__(self) -> None:
        if not 0.0 < 4.0 * self.rise <= self.period:
            raise InputError(
                f"a trapezoid must rise within a quarter of its period, got {self.rise:g} s of {self.period:g} s"
            )

    def volts(self, t: Array) -> Array:
        """Compute the voltage u [V] of the trapezoid at times t [s]; 0 before t = 0."""
        time_in_period = np.mod(np.maximum(t, 0.0), self.period)
        rise, fall = time_in_period / self.rise, (time_in_period - 0.5 * self.period) / self.rise  # completed fractions
        return np.asarray(self.level * (np.clip(rise, 0.0, 1.0) - np.clip(fall, 0.0, 1.0)))

    def __str__(self) -> str:
        level, rise, period = map(format_number, (self.level, self.rise, self.period))
        return f"trapezoid {level} within {rise} s every {period} s"


@dataclass(frozen=True)
class Alternating:
    """Several sines in turn, repeated without end; `parts`: for each sine the number of its periods, and the sine."""

    parts: tuple[tuple[int, Sine], ...]

    def __post_init__(self) -> None:
        for periods, sine in self.parts:
            if not (periods >= 1 and sine.omega > 0 and sine.phase == 0 and sine.offset == 0):
                raise InputError(
                    "sines in turn must have periods >= 1, a frequency > 0 and neither phase nor offset, got "
                    f"{periods} periods of {sine}"
                )

    def volts(self, t: Array) -> Array:
        """Compute the voltage u [V] of the sine that is active at each of the times t [s]; 0 before t = 0."""
        durations = np.array([2.0 * np.pi * periods / sine.omega for periods, sine in self.parts])  # of each part [s]
        ends = np.cumsum(durations)
        time_in_cycle = np.mod(t, ends[-1])
        part = np.minimum(np.searchsorted(ends, time_in_cycle, side="right"), ends.size - 1)  # mod may round to the end
        amplitude = np.array([sine.amplitude for _, sine in self.parts])
        omega = np.array([sine.omega for _, sine in self.parts])
        u = amplitude[part] * np.sin(omega[part] * (time_in_cycle - (ends - durations)[part]))
        return np.asarray(np.where(t >= 0, u, 0.0))

    def __str__(self) -> str:
        return ", ".join(f"{periods} periods of {sine}" for periods, sine in self.parts)


@dataclass(frozen=True, eq=False)
class Polyline:
    """A signal over time that is linear between points, and constant before the first and after the last.

    `t` (n,): times [s], which never decrease; `y` (n,): values. Two points at one time are a jump. `words`: text of the
    signal, such as "step 5 at 1 s".
    """

    t: Array
    y: Array
    words: str

    def value_at(self, t: Array) -> Array:
        """Compute the signal's values at times t [s], for an array t of any shape."""
        return np.interp(t, self.t, self.y)

    def volts(self, t: Array) -> Array:
        """Compute the signal's values as voltages u [V] at times t [s]."""
        return self.value_at(t)

    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] of the points, where slope or value jump; () for 1000 or more (`_MAX_BREAKPOINTS`)."""
        return tuple(map(float, np.unique(self.t))) if self.t.size < _MAX_BREAKPOINTS else ()

    def onset(self) -> float:
        """Find the time [s] at which the signal begins to rise above 0: 0 if it starts above, inf if it never does."""
        if not np.any(self.y > 0):
            return math.inf
        first_positive = int(np.argmax(self.y > 0))
        return float(self.t[first_positive - 1]) if first_positive else 0.0

    @property
    def rise(self) -> tuple[float, float] | None:
        """Start and stop [s] of the rise if the signal is one linear rise or jump from 0 to 1, else None."""
        return (float(self.t[0]), float(self.t[1])) if self.y.tolist() == [0.0, 1.0] else None

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Polyline):
            return NotImplemented
        return self.words == other.words and np.array_equal(self.t, other.t) and np.array_equal(self.y, other.y)

    def __hash__(self) -> int:
        return hash((self.words, self.t.size))

    def __str__(self) -> str:
        return self.words


#: Points from which on a polyline does not list its breakpoints: a run is divided there, and too many would slow it.
_MAX_BREAKPOINTS = 1000


def polyline(points: Sequence[tuple[float, float]], text: str) -> Polyline:
    """Make the signal that is linear between the points (t [s], y); `text`: its `words`."""
    t, y = np.array(points, dtype=np.float64).T
    return Polyline(t, y, text)


def polyline_from_table(t: Array, y: Array, what: str = "a table") -> Polyline:
    """Make the polyline through the points of a table, with the values `y` at the times `t` [s].

    `what`: name of the table in messages. Raises InputError for an empty table, another number of values than of times,
    a time before the previous one (equal times are a jump), or a number that is not finite.
    """
    if t.ndim != 1 or t.shape != y.shape or t.size < 1 or np.any(np.diff(t) < 0):
        raise InputError(f"{what} must have one value for each time, and its times must not fall")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(y))):
        raise InputError(f"times and values of {what} must be finite, got NaN or infinity")
    return Polyline(t, y, f"table of {t.size} points over {t[0]:g}..{t[-1]:g} s")


def step(level: float, start: float = 0.0) -> Polyline:
    """Make the command that jumps from 0 to `level` [V] at `start` [s]."""
    return polyline([(start, 0.0), (start, level)], f"step {format_number(level)} at {format_number(start)} s")


def ramp(level: float, start: float, stop: float) -> Polyline:
    """Make the command that rises linearly from 0 at `start` [s] to `level` [V] at `stop` [s] and stays there."""
    if not stop > start:
        raise InputError(f"a ramp must stop after it starts, got {start:g} s to {stop:g} s")
    text = f"ramp {format_number(level)} from {format_number(start)} s to {format_number(stop)} s"
    return polyline([(start, 0.0), (stop, level)], text)


@dataclass(frozen=True)
class Chirp:
    """A sine whose frequency changes linearly from f_0 to f_1 [Hz] over `duration` T [s], and then stays at f_1.

    u = amplitude sin(2 pi (f_0 t + (f_1 - f_0) t^2 / (2 T))) [V] up to t = T.
    """

    amplitude: float
    f_0: float
    f_1: float
    duration: float

    def __post_init__(self) -> None:
        if not (self.f_0 >= 0 and self.f_1 >= 0 and self.duration > 0):
            raise InputError(f"a chirp must have frequencies >= 0 Hz and a duration > 0 s, got {self}")

    def volts(self, t: Array) -> Array:
        """Compute the voltage u [V] of the chirp at times t [s]."""
        sweep_time = np.minimum(t, self.duration)
        cycles = self.f_0 * sweep_time + (self.f_1 - self.f_0) * sweep_time**2 / (2.0 * self.duration)
        return self.amplitude * np.sin(2.0 * np.pi * (cycles + self.f_1 * (t - sweep_time)))

    def __str__(self) -> str:
        amplitude, f_0, f_1, duration = map(format_number, (self.amplitude, self.f_0, self.f_1, self.duration))
        return f"chirp {amplitude} from {f_0} Hz to {f_1} Hz over {duration} s"


#: SplitMix64: increment of the state, and the (shift, factor) pairs and last shift that mix it into a random number.
GOLDEN, MIX, LAST_SHIFT = 0x9E3779B97F4A7C15, ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)), 31


@dataclass(frozen=True)
class PseudoRandom:
    """A pseudo-random binary command: +amplitude or -amplitude [V], drawn anew every `hold` [s] from `seed`.

    The sign in interval k is the highest bit of SplitMix64's k-th random number (Steele, Lea, Flood, OOPSLA 2014).
    """

    amplitude: float
    hold: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.hold > 0:
            raise InputError(f"a pseudo-random command must hold each value for > 0 s, got {self.hold:g} s")

    def volts(self, t: Array) -> Array:
        """Compute the voltage u [V] of the pseudo-random command at times t [s]; 0 before t = 0."""
        interval = np.clip(np.floor(t / self.hold), 0.0, 2.0**63).astype(np.uint64)  # clipped to what the type holds
        first_state = np.random.SeedSequence(self.seed).generate_state(1, np.uint64)
        state = first_state + (interval + np.uint64(1)) * np.uint64(GOLDEN)  # each interval adds the increment once
        for shift, factor in MIX:
            state = (state ^ (state >> np.uint64(shift))) * np.uint64(factor)
        random_bits = state ^ (state >> np.uint64(LAST_SHIFT))
        signs = np.where(random_bits >> np.uint64(63), 1.0, -1.0)  # by the highest bit
        return np.where(t >= 0, self.amplitude * signs, 0.0)

    def __str__(self) -> str:
        return f"prbs {format_number(self.amplitude)} every {format_number(self.hold)} s seed {self.seed}"


def sampled_signal(t: Array, u: Array, origin: str = "recorded") -> Polyline:
    """Make the polyline through the samples `u` (n,) of a recorded signal at the times `t` (n,) [s], moved to t[0] = 0.

    `origin`: name of the signal in messages and text. Raises InputError for fewer than two samples, times that do not
    rise, or a number that is not finite.
    """
    if t.size < 2 or np.any(np.diff(t) == 0):
        raise InputError(f"a recorded signal must have two samples or more, one at a time, got {t.size} ({origin})")
    return replace(polyline_from_table(t - t[0], u, f"a recorded signal ({origin})"), words=f"file {origin}")


#: Samples of a command that are checked at once, which bounds the memory.
_CHECK_CHUNK = 1_000_000


def check_command(command: Command, t: Array, limit: float) -> None:
    """Raise InputError unless a command is within +-`limit` [V], and not NaN, at the times `t` [s]."""
    for start in range(0, t.size, _CHECK_CHUNK):
        times = t[start : start + _CHECK_CHUNK]
        u = command.volts(times)
        is_beyond = ~(np.abs(u) <= limit * (1 + 1e-12))  # True for NaN
        if is_beyond.any():
            k = int(np.argmax(is_beyond))
            raise InputError(
                f"command must stay within +-{limit:g} V, got {u[k]:.4g} V at t = {times[k]:.4g} s ({command})"
            )


#: Patterns of a number without and with a sign, and of a time ("90", "90 s", "1.5[min]").
UNSIGNED = r"(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
NUMBER = rf"[-+]?{UNSIGNED}"
TIME = rf"{UNSIGNED}\s*(?:\[\s*\w+\s*\]|(?:s|ms|min|h)\b)?"
_N, _T = NUMBER, rf"[-+]?{TIME}"
_SIGNED = rf"[-+]\s*{UNSIGNED}"
#: Pattern of each form of a command but sines, the kinds of its groups (n: number, t: time, s: seed), and the function
#: that makes the command from their values.
_FORMS: tuple[tuple[str, str, Callable[..., Command]], ...] = (
    (rf"trapezoid\s+({_N})\s*v?\s+within\s+({_T})\s+every\s+({_T})", "ntt", Trapezoid),
    (rf"step\s+({_N})\s*v?(?:\s+at\s+({_T}))?", "nt", step),
    (rf"ramp\s+({_N})\s*v?\s+(?:from\s+({_T})\s+)?(?:to|over)\s+({_T})", "ntt", ramp),
    (rf"chirp\s+({_N})\s*v?\s+from\s+({_N})\s*(?:hz)?\s+to\s+({_N})\s*(?:hz)?\s+over\s+({_T})", "nnnt", Chirp),
    (rf"prbs\s+({_N})\s*v?\s+every\s+({_T})(?:\s+seed\s+(\d+))?", "nts", PseudoRandom),
)


def parse_seconds(text: str | None) -> float:
    """Parse a time in seconds from a text such as "90", "90 s" or "1.5[min]"; return 0 for None."""
    return 0.0 if text is None else parse_quantity(text.lower(), "s", name="a time")


def _parse_number(text: str | None, default: float = 0.0) -> float:
    """Parse a number in the text of a command, `default` for None; raise InputError if it is not finite."""
    if text is None:
        return default
    value = float(text.replace(" ", ""))
    if not math.isfinite(value):
        raise InputError(f"a number in a command must be finite, got {text}")
    return value


#: Parsers of the groups in `_FORMS` by their kind.
_PARSERS: Mapping[str, Callable[[str | None], float]] = {
    "n": _parse_number,
    "t": parse_seconds,
    "s": lambda text: int(text or 0),
}
_MAX_CHARACTERS = 1000


def normalize_blanks(text: str, what: str) -> str:
    """Strip a text, and replace runs of blanks in it by single blanks, except in a path after ``file``.

    Raises InputError for a text of more than 1000 characters; `what`: noun for the message, such as "command".
    """
    if len(text) > _MAX_CHARACTERS:
        raise InputError(f"{what} must have at most {_MAX_CHARACTERS} characters, got {len(text)}")
    if file := re.fullmatch(r"(?:(position)\s+)?(file)\s+(.*)", text.strip(), re.IGNORECASE):
        return " ".join(filter(None, file.groups()))
    return " ".join(text.split())


_SINES = re.compile(rf"\s*([-+])?\s*({_N})?\s*\*?\s*sin\(\s*({_N})?\s*\*?\s*t\s*({_SIGNED})?\s*\)", re.IGNORECASE)


def _parse_sines(text: str) -> Sine | MultiSine | None:
    """Parse a sine such as "3 sin(4t)", or a sum of sines, with or without an offset; return None for other texts.

    An amplitude or frequency that is not stated is 1.
    """
    parts: list[Sine] = []
    end = 0
    # each sine but the first must have a sign, match[1]
    while (match := _SINES.match(text, end)) is not None and (match[1] or not parts):
        sign, amplitude, omega, phase = match.groups()
        factor = -1.0 if sign == "-" else 1.0
        parts.append(Sine(factor * _parse_number(amplitude, 1.0), _parse_number(omega, 1.0), _parse_number(phase)))
        end = match.end()
    offset = re.fullmatch(rf"\s*({_SIGNED})?\s*v?", text[end:], re.IGNORECASE)
    if offset is None or not parts:
        return None
    parts[-1] = replace(parts[-1], offset=_parse_number(offset[1]))
    return parts[0] if len(parts) == 1 else MultiSine(tuple(parts))


def parse_command(text: str) -> Command:
    """Parse a command such as "3 sin(4t)", "step 5 at 1 s" or "file LOG" (channel u); InputError lists all forms."""
    stripped = text.strip()
    if stripped.lower().startswith("file "):
        from sealscope.recordings import read

        path = stripped[len("file ") :].strip()
        recording = read(path)
        return sampled_signal(recording.t, recording["u"], path)
    stripped = normalize_blanks(text, "command")
    if "period" in stripped.lower():  # sines in turn, such as "6 periods of 5 sin(2t), 10 periods of 3 sin(4t)"
        form = r"\s*(\d{1,6})\s+periods?\s+of\s+(.*)"
        matches = [re.fullmatch(form, part, re.IGNORECASE) for part in stripped.split(",")]
        parts = [(int(match[1]), parse_command(match[2])) for match in matches if match]
        if len(parts) == len(matches) and all(isinstance(sine, Sine) for _, sine in parts):
            return Alternating(tuple(parts))  # type: ignore[arg-type]
    if (sines := _parse_sines(stripped)) is not None:
        return sines
    for pattern, kinds, make in _FORMS:
        if match := re.fullmatch(pattern, stripped, re.IGNORECASE):
            return make(*(_PARSERS[kind](group) for kind, group in zip(kinds, match.groups(), strict=True)))
    raise InputError(
        "command must be like '3 sin(4t)', '3 sin(4t) + 1 sin(9t)', '6 periods of 5 sin(2t), 10 periods of 3 sin(4t)' "
        "(in turn, again and again), 'step 5 at 1 s', 'ramp 5 from 1 s to 3 s', 'trapezoid 3 within 1 s every 8 s', "
        "'chirp 3 from 0.1 Hz to 5 Hz over 60 s', 'prbs 2 every 0.5 s seed 1' or 'file LOG' (channel u of a "
        f"recording), got {text!r}"
    )
