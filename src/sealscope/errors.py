"""Errors that a caller can act on, and printable texts.

Each message is one line that names the rule, the value and the place, for example
``charge_pressure must be > 0 Pa, got -3.0 (rigs/lab.toml)``.
"""

from __future__ import annotations

#: Most characters that are kept of a long message: at its beginning, which states the rule, and at its end, which
#: states the place.
_MAX_BEGINNING, _MAX_END = 1500, 2500


def printable(text: str, kept: str = "", instead: str = "\N{REPLACEMENT CHARACTER}") -> str:
    """Replace unprintable characters, which may control a terminal, by `instead`, except the characters in `kept`."""
    return "".join(character if character.isprintable() or character in kept else instead for character in text)


def escape_text(text: str, kept: str = "") -> str:
    r"""Escape unprintable characters as Python writes them, such as \x1b, except the characters in `kept`."""
    return "".join(letter if letter.isprintable() or letter in kept else repr(letter)[1:-1] for letter in text)


class SealscopeError(Exception):
    """Base class of the errors that Sealscope raises on purpose; the message is one line.

    Line breaks become blanks, and the middle of a very long message is omitted.
    """

    def __init__(self, message: object = "") -> None:
        """Format the message as one line, and omit the middle of a very long one."""
        line = " ".join(str(message).splitlines())
        if len(line) > _MAX_BEGINNING + _MAX_END:
            line = f"{line[:_MAX_BEGINNING]} ... {line[-_MAX_END:]}"
        super().__init__(line)


class InputError(SealscopeError, ValueError):
    """A value, an option or a file that the caller gave breaks a rule, which the message states."""


class UnreadableFile(InputError):  # noqa: N818 (says what happened)
    """A file cannot be read as a recording; the other files of the same call still can."""


class SimulationFailed(SealscopeError, ArithmeticError):  # noqa: N818 (says what happened)
    """A simulation diverged, or its time step proved to be too large; no result is returned."""


class MissingExtra(SealscopeError, ImportError):  # noqa: N818 (says what happened)
    """An optional library is needed; the message names the extra that installs it."""
