"""Courses over time of what is no voltage: the position that a piston is to take, the force of a load."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import NUMBER, UNSIGNED, Command, Recorded, Sine, parse_command, plain_text
from sealscope.storage.opening import open_regular
from sealscope.units import to_si

_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_FORCES = {"N": 1.0, "kN": 1e3}


@dataclass(frozen=True)
class Position:
    """A target for the piston: x = course(t) [m] from mid-stroke, followed by a controller; `words` as it was given."""

    course: Command
    words: str

    def at(self, t: Array) -> Array:
        """Return the target [m] at times t [s]."""
        return self.course.volts(t)

    def __str__(self) -> str:
        return f"position {self.words}"


@dataclass(frozen=True)
class Force:
    """A load beside the rig's own: F = course(t) [N] against +x; `words` as it was given."""

    course: Command
    words: str

    def at(self, t: Array) -> Array:
        """Return the force [N] at times t [s]."""
        return self.course.volts(t)

    def __str__(self) -> str:
        return f"load {self.words}"


def _course(words: str, units: Mapping[str, float], what: str) -> Command:
    """Return the words of a command whose size has one of `units` as a command in SI."""
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
        return Position(Recorded(recording.t - recording.t[0], recording["x"], path), words)
    return Position(_course(words, _LENGTHS, "position"), words)


def command_or_target(text: str) -> Command | Position:
    """Read what a machine is asked for: a target for its piston, or else a command for its drive."""
    return parse_position(text) or parse_command(text)


def _recorded_force(path: str) -> Recorded:
    """Return the force over time of a text table with the columns ``t [s]`` and ``F [N]``, each in any unit of its own.

    The first row is at t = 0; linear between the rows, the last value afterwards.
    """
    with open_regular(path, "a recorded load") as file:
        head = file.readline(4096).decode("utf-8-sig", "replace")
        named = [re.fullmatch(r"\s*(\w+)\s*\[([^\]]+)\]\s*", cell) for cell in head.split(",")]
        columns = {match[1]: (k, match[2]) for k, match in enumerate(named) if match}
        if not {"t", "F"} <= columns.keys():
            raise InputError(
                f"a recorded load must have the columns t [s] and F [N], got {head.strip()[:80]!r} ({path})"
            )
        try:
            table = np.loadtxt(file, delimiter=",", usecols=[columns["t"][0], columns["F"][0]], ndmin=2)
        except ValueError as error:
            raise InputError(f"a recorded load must hold numbers, got a table of which {error} ({path})") from None
    t = to_si(table[:, 0], columns["t"][1], "s", name="t", place=path)
    return Recorded(t - t[:1], to_si(table[:, 1], columns["F"][1], "N", name="F", place=path), path)


def parse_force(text: str) -> Force:
    """Read a load such as ``2 kN``, ``500 N sin(2t) + 100 N``, ``step 2 kN at 3 s`` in the words of `parse_command`.

    ``file LOAD.csv`` is a recorded one: columns ``t [s]`` and ``F [N]``.
    """
    words = plain_text(text, "load")
    if words.lower().startswith("file "):
        return Force(_recorded_force(words[5:].strip()), words)
    return Force(_course(words, _FORCES, "load"), words)
