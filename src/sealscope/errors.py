"""The errors a caller can act on, and texts fit to print.

Each message is one line that names the rule, the value and the place, for example
``charge_pressure must be > 0 Pa, got -3.0 (rigs/lab.toml)``.
"""

from __future__ import annotations

#: Most characters of a message at its beginning, where the rule stands, and at its end, where the place does.
_BEGINNING, _END = 1500, 2500


def printable(text: str, kept: str = "", instead: str = "\N{REPLACEMENT CHARACTER}") -> str:
    """Return a text without what a terminal would obey, whatever a file's name or header brought; `kept` stays."""
    return "".join(sign if sign.isprintable() or sign in kept else instead for sign in text)


class SealscopeError(Exception):
    """Base of every error that Sealscope raises on purpose; its text is one line, fit to print.

    Line breaks of a text from outside become blanks, and the middle of a very long one is left out.
    """

    def __init__(self, message: object = "") -> None:
        line = " ".join(str(message).splitlines())
        if len(line) > _BEGINNING + _END:
            line = f"{line[:_BEGINNING]} ... {line[-_END:]}"
        super().__init__(line)


class InputError(SealscopeError, ValueError):
    """A value, an option or a file from outside breaks a rule."""


class UnreadableFile(InputError):  # noqa: N818 (says what happened)
    """A file cannot be read as a recording; the other files of the same call still can."""


class SimulationFailed(SealscopeError, ArithmeticError):  # noqa: N818 (says what happened)
    """A run diverged, or proved to be under-resolved; no result is returned."""


class MissingExtra(SealscopeError, ImportError):  # noqa: N818 (says what happened)
    """An optional library is needed; the message names the extra that installs it."""
