"""Text of messages and terminals: counts, lists of names, and paragraphs without terminal control characters."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import fill

from sealscope.errors import printable

#: Width of a line in columns.
WIDTH = 80


def paragraph(text: str, head: str = "", indent: int | None = None, width: int = WIDTH) -> str:
    """Wrap a text to lines of at most `width` columns, the first of which begins with the text `head`.

    Lines after the first are indented by `indent` columns, by default the length of `head`. Words are not broken.
    Unprintable characters in the text are replaced.
    """
    indentation = " " * (len(head) if indent is None else indent)
    return fill(
        printable(text, kept="\n\t"),  # `fill` turns these two into blanks
        width,
        initial_indent=head,
        subsequent_indent=indentation,
        break_long_words=False,
        break_on_hyphens=False,
    )


def paragraphs(rows: Iterable[tuple[str, str | None]], columns: int) -> list[str]:
    """Format pairs (label, text) as paragraphs, the label in the first `columns` characters; omit missing texts."""
    return [paragraph(text, f"  {label}".ljust(columns), indent=columns) for label, text in rows if text]


def format_count(count: int, noun: str) -> str:
    """Return the count and the noun, in the plural unless the count is 1: ``1 gap``, ``2 gaps``, ``3 stretches``."""
    ending = "" if count == 1 else "es" if noun.endswith(("s", "ch")) else "s"
    return f"{count} {noun}{ending}"


def join_names(names: Iterable[str], most: int = 12) -> str:
    """Join up to `most` names, each cut to `WIDTH` characters, with the number of further names: ``a, b and 3 more``.

    The text is "none" if there are no names.
    """
    names = list(names)
    joined = ", ".join(name if len(name) <= WIDTH else f"{name[: WIDTH - 3]}..." for name in names[:most])
    if len(names) > most:
        return f"{joined} and {len(names) - most} more"
    return joined or "none"
