"""Position targets of the piston, and loads on it over time, position or velocity, as data and as text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import (
    NUMBER,
    UNSIGNED,
    Command,
    Sine,
    normalize_blanks,
    parse_command,
    sampled_signal,
)
from sealscope.storage.opening import open_regular
from sealscope.units import to_si

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.physics.rig import RigNumbers

_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_FORCES = {"N": 1.0, "kN": 1e3}
_SPEEDS = {"mm/s": 1e-3, "cm/s": 1e-2, "m/s": 1.0}
_STIFFNESSES = {"N/mm": 1e3, "kN/mm": 1e6, "N/m": 1.0, "kN/m": 1e3}
_DAMPINGS = {"N s/mm": 1e3, "kN s/mm": 1e6, "N s/m": 1.0, "kN s/m": 1e3}
#: Most rows of a table of force over position or velocity: every stage of every step evaluates them all.
MAX_LOAD_ROWS = 200
_NO_FORCE = Sine(amplitude=0.0, omega=0.0)
#: A force over position or velocity, (a, b), (s_1, c_1), ..., as in `piecewise_linear_force`.
Breakpoints = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Position:
    """A target for the piston: `signal`, a command whose `volts` are metres from mid-stroke, and its text `words`."""

    signal: Command
    words: str

    def value_at(self, t: Array) -> Array:
        """Compute the target position [m] at times t [s]."""
        return self.signal.volts(t)

    def __str__(self) -> str:
        return f"position {self.words}"


@dataclass(frozen=True)
class Force:
    """An additional load on the piston against +x: F = signal(t) + f(x) + g(v) [N].

    `signal`: a command whose `volts` are newtons; `words`: text of the load; `over_x`, `over_v`: the piecewise linear
    functions f of the piston's position x [m] and g of its velocity v [m/s], () for none.
    """

    signal: Command
    words: str
    over_x: Breakpoints = ()
    over_v: Breakpoints = ()

    def value_at(self, t: Array) -> Array:
        """Compute the part of the load [N] that depends on time only, at times t [s]."""
        return self.signal.volts(t)

    def tables(self) -> tuple[Array, Array] | None:
        """Build the tables (n, 2) of f and g for `piecewise_linear_force`; None if the load is over time only."""
        if not (self.over_x or self.over_v):
            return None
        no_load: Breakpoints = ((0.0, 0.0),)
        return np.array(self.over_x or no_load), np.array(self.over_v or no_load)

    def __str__(self) -> str:
        return f"load {self.words}"


def loaded_rig_numbers(rig: Rig, load: Force | None) -> RigNumbers:
    """Build the parameters of the compiled model for a rig with an additional `load`, if any.

    Their `pushed` has the tables of the load, or one element, True, if the load is over time only (`rates`).
    """
    from sealscope.physics.rig import rig_numbers

    numbers = rig_numbers(rig)
    return numbers if load is None else numbers._replace(pushed=load.tables() or (True,))


def loaded_standstill_state(rig: Rig, load: Force | None, x: float) -> Array:
    """Compute the model's state (14,) at rest at `x` [m], under an additional `load`, if any, at t = 0."""
    from sealscope.physics.cylinder import piecewise_linear_force
    from sealscope.physics.standstill import initial_state

    force = 0.0 if load is None else float(load.value_at(np.zeros(())))
    if load is not None and (tables := load.tables()) is not None:
        over_x, over_v = tables
        force = float(force + piecewise_linear_force(x, over_x) + piecewise_linear_force(0.0, over_v))
    return initial_state(rig, x, force)


def breakpoints_through(s: Array, F: Array) -> Breakpoints:
    """Convert points (s, F) of a load to `Breakpoints`, linear between the points and constant beyond the outer ones.

    `s` (n,), rising: positions [m] or velocities [m/s]; `F` (n,) [N].
    """
    slopes = np.concatenate([[0.0], np.diff(F) / np.diff(s), [0.0]])
    return (float(F[0]), 0.0), *zip(s.tolist(), np.diff(slopes).tolist(), strict=True)


def _parse_signal(text: str, units: Mapping[str, float], what: str) -> Command:
    """Parse a signal over time that is written like a command but with units, such as "step 100 mm at 1 s".

    `units`: allowed units, with factors to SI; `what`: noun for messages.
    """
    number_with_unit = re.compile(rf"({UNSIGNED})\s*\[?({_unit_pattern(units)})\b\]?")
    if not number_with_unit.search(text):
        example = f"step 100 {next(iter(units))}"
        raise InputError(f"{what} must have its unit ({', '.join(units)}), such as '{example}', got {text!r}")
    in_si = number_with_unit.sub(lambda match: repr(float(match[1]) * units[match[2]]), text)
    in_si = re.sub(r"^-\s+", "-", in_si.strip())  # a number may have blanks after its sign
    if re.fullmatch(NUMBER, in_si):
        return Sine(amplitude=0.0, omega=0.0, offset=float(in_si))  # a constant
    try:
        return parse_command(in_si)
    except InputError as error:  # let the message name this quantity, and quote the text with its units
        message = str(error).replace("command must be", f"{what} must be").replace(repr(in_si), repr(text))
        raise InputError(message) from None


def parse_position(text: str) -> Position | None:
    """Parse a position target, such as ``position 50 mm sin(2t)`` or ``position step 100 mm at 1 s``.

    The signal is written as in `parse_command`, in mm, cm or m; ``position file LOG`` takes channel x of a recording.
    Returns None for a text that does not begin with ``position``.
    """
    normalized = normalize_blanks(text, "command")
    if not normalized.lower().startswith("position "):
        return None
    signal = normalized[len("position ") :]
    if signal.lower().startswith("file "):
        from sealscope.recordings import read

        path = signal[len("file ") :].strip()
        recording = read(path)
        if "x" not in recording or recording.units["x"] != "m":
            raise InputError(f"a recorded position must have the channel x with a unit of length, got none ({path})")
        return Position(sampled_signal(recording.t, recording["x"], path), signal)
    return Position(_parse_signal(signal, _LENGTHS, "position"), signal)


def command_or_target(text: str) -> Command | Position:
    """Parse a text as a position target if it begins with ``position``, else as a command for the drive."""
    return parse_position(text) or parse_command(text)


def _read_force(path: str, words: str) -> Force:
    """Read a load from a CSV file with the column ``F [N]`` and one of ``t [s]``, ``x [m]``, ``v [m/s]``, in any unit.

    The load is linear between the rows and constant beyond them. Times are moved so that the first is 0; beside them,
    columns of x and v are ignored. `words`: text of the load. Raises InputError for any other table.
    """
    with open_regular(path, "a recorded load") as file:
        first_line = file.readline(4096).decode("utf-8-sig", "replace")
        headings = [re.fullmatch(r"\s*(\w+)\s*\[([^\]]+)\]\s*", cell) for cell in first_line.split(",")]
        indices = {match[1]: k for k, match in enumerate(headings) if match}
        units = {match[1]: match[2] for match in headings if match}
        arguments = [name for name in ("t", "x", "v") if name in units]  # columns on which F may depend
        if "F" not in units or not arguments or arguments == ["x", "v"]:
            raise InputError(
                "a recorded load must have the columns t [s] and F [N], or F [N] with one of x [m] and v [m/s], got "
                f"{first_line.strip()[:80]!r} ({path})"
            )
        try:
            table = np.loadtxt(file, delimiter=",", usecols=[indices[arguments[0]], indices["F"]], ndmin=2)
        except ValueError as error:
            raise InputError(f"a recorded load must have numbers only, got an error: {error} ({path})") from None
    argument = arguments[0]
    unit = {"t": "s", "x": "m", "v": "m/s"}[argument]
    s = to_si(table[:, 0], units[argument], unit, name=argument, place=path)
    F = to_si(table[:, 1], units["F"], "N", name="F", place=path)
    if argument == "t":
        return Force(sampled_signal(s, F, path), words)
    if s.size > 1 and s[0] > s[-1]:  # x or v falls from row to row: reversed, it rises
        s, F = s[::-1], F[::-1]
    if not (2 <= s.size <= MAX_LOAD_ROWS and np.all(np.diff(s) > 0) and np.all(np.isfinite(table))):
        raise InputError(
            f"a load over {argument} must have 2 to {MAX_LOAD_ROWS} rows of finite numbers whose {argument} rises, got "
            f"{s.size} rows ({path})"
        )
    return Force(_NO_FORCE, words, **{f"over_{argument}": breakpoints_through(s, F)})


def _unit_pattern(units: Mapping[str, float]) -> str:
    """Build a regular expression that matches any of the `units`, written with or without their blanks."""
    longest_first = sorted(units, key=len, reverse=True)  # else "N" would match the beginning of "N/m"
    return "|".join(re.escape(unit).replace("\\ ", r"\s*") for unit in longest_first)


#: Units of the slope and of the start of a load over x or v.
_TERM_UNITS = {"x": (_STIFFNESSES, _LENGTHS), "v": (_DAMPINGS, _SPEEDS)}


def parse_force(text: str) -> Force:
    """Parse the text of a load, such as ``2 kN``, ``500 N sin(2t) + 100 N`` or ``step 2 kN at 3 s``.

    A signal over time is written as in `parse_command`. Terms over the piston's position or velocity may be added:
    ``200 N/mm over x``, ``5 kN/mm over x from 50 mm`` (0 below 50 mm), ``2 kN s/m over v``. ``file LOAD.csv`` is a
    table of ``F [N]`` over ``t [s]``, ``x [m]`` or ``v [m/s]``.
    """
    normalized = normalize_blanks(text, "load")
    if normalized.lower().startswith("file "):
        return _read_force(normalized[len("file ") :].strip(), normalized)
    over_x, signal = _extract_terms(normalized, "x")
    over_v, signal = _extract_terms(signal, "v")
    if over_x or over_v:
        # remove the plus that joined the signal to a term before it; a lone plus stays, and is refused
        signal = re.sub(r"^\+(?=.)", "", signal.strip())
        if not signal:
            return Force(_NO_FORCE, normalized, over_x, over_v)
    return Force(_parse_signal(signal, _FORCES, "load"), normalized, over_x, over_v)


def _extract_terms(text: str, letter: str) -> tuple[Breakpoints, str]:
    """Parse the terms over x or v (`letter`) in the text of a load, such as "200 N/mm over x from 50 mm".

    Returns the `Breakpoints` of their sum, () without a term, and the text without the terms.
    """
    slope_units, start_units = _TERM_UNITS[letter]
    factors = {unit.replace(" ", ""): factor for unit, factor in slope_units.items()}  # the text may lack blanks
    number = rf"({UNSIGNED})\s*\[?({_unit_pattern(slope_units)})\b\]?"
    start_and_unit = rf"(?:\s+from\s+([-+]?{UNSIGNED})\s*\[?({_unit_pattern(start_units)})\b\]?)?"
    pattern = re.compile(rf"(?:^|([-+]))\s*{number}\s+over\s+{letter}\b{start_and_unit}\s*")
    terms = pattern.findall(text)
    if not terms:
        return (), text
    common_slope = 0.0  # sum of the slopes of the terms without a start
    breakpoints = []
    for sign, magnitude, unit, start, start_unit in terms:
        slope = float(f"{sign}{magnitude}") * factors[unit.replace(" ", "")]
        if start:
            breakpoints.append((float(start) * start_units[start_unit], slope))
        else:
            common_slope += slope
    # (force at 0, slope at first), then (position or velocity, change of the slope) for each term with a start
    return ((0.0, common_slope), *breakpoints), pattern.sub("", text)
