"""Names of channels that an instrument's heading gives apart from its columns: a table of channels, a row of labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sealscope.recordings.formats.headings.labels import Label

#: What a table of channels calls its first column, and the column of the names that a user has typed.
_CHANNEL = frozenset({"ch", "ch.", "channel", "kanal"})
_TYPED = ("signal name", "comment", "label", "name", "tag", "kommentar", "bezeichnung")
#: First cells of a row of labels, one for each column, as Tektronix writes it above `TIME,CH1,CH2`.
LABEL_ROWS = frozenset({"label", "labels"})
_LONGEST = 80


def described(labels: Sequence[Label], rows: Sequence[Sequence[str]]) -> list[Label]:
    """Return the labels, those with the names that the rows above them give; the columns' own names stay known, too.

    A channel's name may say its unit where the column's heading does not. `rows`: cells of the lines above the heading,
    and of rows of labels in it.
    """
    names: dict[str, str] = {}
    typed: int | None = None
    for row in rows:
        cells = [cell.strip().strip('"').strip() for cell in row]
        keys = [cell.casefold() for cell in cells]
        if not cells:
            continue
        if keys[0] in _CHANNEL:
            typed = next((keys.index(name) for name in _TYPED if name in keys[1:]), None)
        elif keys[0] in LABEL_ROWS:
            for label, cell in zip(labels[1:], cells[1:], strict=False):
                names.setdefault(_key(label), cell)
        elif typed is not None and typed < len(cells):
            names.setdefault(_plain(cells[0]), cells[typed])
    return [_named(label, names.get(_key(label), "")) for label in labels]


def _plain(text: str) -> str:
    return text.replace(" ", "").casefold()


def _key(label: Label) -> str:
    """Return a column's own name, which stands last where a row of labels was joined to it."""
    return _plain(label.name.rpartition(" ")[2] or label.name)


def _named(label: Label, name: str) -> Label:
    if not name or len(name) > _LONGEST or _plain(name) == _key(label):
        return label
    typed = Label.parse(name)
    own = label.name.rpartition(" ")[2]
    return replace(label, name=typed.name, unit=label.unit or typed.unit, called=own)
