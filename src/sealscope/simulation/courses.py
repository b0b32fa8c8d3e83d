"""Courses other than voltages: the position target of a piston, and the force of a load over t, x or v."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import NUMBER, UNSIGNED, Command, Sine, parse_command, plain_text, recorded
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
#: Most rows of a table of force over position or velocity: each is looked at in every stage of every step.
MOST_ROWS = 200
#: A force over s that is linear between bends: (a, b), then (s_k, c_k): a + b s + sum of c_k max(s - s_k, 0).
Bends = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Position:
    """A target for the piston: x = course(t) [m] from mid-stroke, followed by a controller; `words`: its text."""

    course: Command
    words: str

    def value_at(self, t: Array) -> Array:
        """Compute the target [m] at times t [s]."""
        return self.course.volts(t)

    def __str__(self) -> str:
        return f"position {self.words}"


@dataclass(frozen=True)
class Force:
    """A load besides the rig's own: F = course(t) [N] against +x; `words`: its text.

    `over_x`, `over_v`: what is linear between bends over position [m] and velocity [m/s] of the piston is added.
    """

    course: Command
    words: str
    over_x: Bends = ()
    over_v: Bends = ()

    def value_at(self, t: Array) -> Array:
        """Compute the force [N] at times t [s], without its part over the piston's position and velocity."""
        return self.course.volts(t)

    def tables(self) -> tuple[Array, Array] | None:
        """Build the bends over position and velocity for `physics.cylinder.force_over`; None without any."""
        if not (self.over_x or self.over_v):
            return None
        x, v = (np.array(bends or ((0.0, 0.0),), dtype=np.float64) for bends in (self.over_x, self.over_v))
        return x, v

    def __str__(self) -> str:
        return f"load {self.words}"


def numbers_under(rig: Rig, load: Force | None) -> RigNumbers:
    """Build the numbers of a rig under a load."""
    from sealscope.physics.rig import rig_numbers

    numbers = rig_numbers(rig)
    return numbers if load is None else numbers._replace(pushed=load.tables() or (True,))


def state_under(rig: Rig, load: Force | None, x: float) -> Array:
    """Compute the state of a rig at t = 0 with its piston at standstill at x [m] under a load."""
    from sealscope.physics.cylinder import force_over
    from sealscope.physics.standstill import initial_state

    force, tables = (0.0, None) if load is None else (float(load.value_at(np.zeros(()))), load.tables())
    if tables is not None:
        force = float(force + force_over(x, tables[0]) + force_over(0.0, tables[1]))
    return initial_state(rig, x, force)


def bends_of(s: Array, F: Array) -> Bends:
    """Build the bends of a force through the points (s, F), s rising, constant beyond the first and the last."""
    slopes = np.concatenate([[0.0], np.diff(F) / np.diff(s), [0.0]])
    return (float(F[0]), 0.0), *zip(s.tolist(), np.diff(slopes).tolist(), strict=True)


def _course(words: str, units: Mapping[str, float], what: str) -> Command:
    """Read a command whose size has one of `units`, in SI."""
    names = "|".join(sorted(units, key=len, reverse=True))
    sized = re.compile(rf"({UNSIGNED})\s*\[?({names})\b\]?")
    if not sized.search(words):
        example = f"step 100 {next(iter(units))}"
        raise InputError(f"{what} must have its unit ({', '.join(units)}), such as '{example}', got {words!r}")
    plain = sized.sub(lambda match: repr(float(match[1]) * units[match[2]]), words)
    if re.fullmatch(NUMBER, plain.strip()):
        return Sine(0.0, 0.0, 0.0, float(plain))
    try:
        return parse_command(plain)
    except InputError as error:
        raise InputError(
            str(error).replace("command must be", f"{what} must be").replace(repr(plain), repr(words))
        ) from None


def parse_position(text: str) -> Position | None:
    """Read a target such as ``position 50 mm sin(2t)`` or ``position step 100 mm at 1 s``.

    The words are those of `parse_command`, with a length in mm, cm or m; ``position file LOG`` is the channel x of a
    recording. None where the text is no target.
    """
    words = plain_text(text, "command")
    if not words.lower().startswith("position "):
        return None
    words = words[len("position ") :]
    if words.lower().startswith("file "):
        from sealscope.recordings import read

        path = words[5:].strip()
        recording = read(path)
        if "x" not in recording or recording.units["x"] != "m":
            raise InputError(f"a recorded position must have the channel x with a unit of length, got {path} without")
        return Position(recorded(recording.t - recording.t[0], recording["x"], path), words)
    return Position(_course(words, _LENGTHS, "position"), words)


def command_or_target(text: str) -> Command | Position:
    """Read a target for the piston, or else a command for the drive."""
    return parse_position(text) or parse_command(text)


def _recorded_force(path: str, words: str) -> Force:
    """Read the force of a text table: column ``F [N]`` over ``t [s]``, ``x [m]`` or ``v [m/s]``, in any unit.

    Linear between the rows. Over time the first row is at t = 0; where there are times, positions are not looked at.
    Beyond the first and the last row their forces hold.
    """
    with open_regular(path, "a recorded load") as file:
        head = file.readline(4096).decode("utf-8-sig", "replace")
        headings = [re.fullmatch(r"\s*(\w+)\s*\[([^\]]+)\]\s*", cell) for cell in head.split(",")]
        columns = {match[1]: (k, match[2]) for k, match in enumerate(headings) if match}
        over = [name for name in ("t", "x", "v") if name in columns]
        if "F" not in columns or not over or over == ["x", "v"]:
            raise InputError(
                "a recorded load must have the columns t [s] and F [N], or F [N] with one of x [m] and v [m/s], got "
                f"{head.strip()[:80]!r} ({path})"
            )
        try:
            table = np.loadtxt(file, delimiter=",", usecols=[columns[over[0]][0], columns["F"][0]], ndmin=2)
        except ValueError as error:
            raise InputError(f"a recorded load must hold numbers, got a table of which {error} ({path})") from None
    unit = {"t": "s", "x": "m", "v": "m/s"}[over[0]]
    s = to_si(table[:, 0], columns[over[0]][1], unit, name=over[0], place=path)
    F = to_si(table[:, 1], columns["F"][1], "N", name="F", place=path)
    if over[0] == "t":
        return Force(recorded(s - s[:1], F, path), words)
    if s.size > 1 and s[0] > s[-1]:
        s, F = s[::-1], F[::-1]
    if not (2 <= s.size <= MOST_ROWS and np.all(np.diff(s) > 0) and np.all(np.isfinite(table))):
        raise InputError(
            f"a load over {over[0]} must have 2 to {MOST_ROWS} rows of finite numbers whose {over[0]} rises, got "
            f"{s.size} rows ({path})"
        )
    return Force(_NO_FORCE, words, **{f"over_{over[0]}": bends_of(s, F)})


_NO_FORCE = Sine(0.0, 0.0)


def _any_of(units: Mapping[str, float]) -> str:
    return "|".join(re.escape(unit).replace("\\ ", r"\s*") for unit in sorted(units, key=len, reverse=True))


def _over(letter: str, slopes: Mapping[str, float], places: Mapping[str, float]) -> re.Pattern[str]:
    start = rf"(?:\s+from\s+([-+]?{UNSIGNED})\s*\[?({_any_of(places)})\b\]?)?"
    return re.compile(rf"(?:^|([-+]))\s*({UNSIGNED})\s*\[?({_any_of(slopes)})\b\]?\s+over\s+{letter}\b{start}\s*")


_OVER = {"x": (_STIFFNESSES, _LENGTHS), "v": (_DAMPINGS, _SPEEDS)}


def parse_force(text: str) -> Force:
    """Read a load such as ``2 kN``, ``500 N sin(2t) + 100 N``, ``step 2 kN at 3 s`` in the words of `parse_command`.

    Terms over the piston's position or velocity may be added: ``200 N/mm over x``, ``5 kN/mm over x from 50 mm`` (none
    before it), ``2 kN s/m over v``. ``file LOAD.csv`` is a recorded one: column ``F [N]`` over ``t [s]``, ``x [m]`` or
    ``v [m/s]``.
    """
    words = plain_text(text, "load")
    if words.lower().startswith("file "):
        return _recorded_force(words[5:].strip(), words)
    rest, over = words, {}
    for letter, (slopes, places) in _OVER.items():
        pattern, line, bends = _over(letter, slopes, places), 0.0, []
        for sign, number, unit, place, place_unit in pattern.findall(rest):
            slope = float(f"{sign}{number}") * slopes[_spelled(unit, slopes)]
            if place:
                bends.append((float(place) * places[place_unit], slope))
            else:
                line += slope
        if pattern.search(rest):
            over[f"over_{letter}"] = ((0.0, line), *bends)
        rest = pattern.sub("", rest)
    if over:
        rest = re.sub(r"^\s*\+|[+]\s*$", "", rest).strip()
    return Force(_NO_FORCE if over and not rest else _course(rest, _FORCES, "load"), words, **over)


def _spelled(unit: str, units: Mapping[str, float]) -> str:
    return next(known for known in units if known.replace(" ", "") == unit.replace(" ", ""))
