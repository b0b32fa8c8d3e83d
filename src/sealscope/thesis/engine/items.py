"""Cases, figures, tables and claims under the thesis's own numbers, and how each is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["case", "figure", "table", "claims"]


@dataclass(frozen=True)
class Item:
    """What can be reproduced, as data.

    `id`: the thesis's own number, such as "fig-4.22"; `make`: "module:function", a maker
    `(context, item) -> tuple of Figure, Table and Claim`; `inputs`: what the maker reads, by name; `needs_sheet`: it
    cannot be made without the thesis's data sheet; `needs`: ids of the items whose products it asks for.
    """

    id: str
    chapter: int
    kind: Kind
    title: str
    make: str
    inputs: tuple[tuple[str, str | float | tuple[str | float, ...]], ...] = ()
    needs_sheet: bool = False
    needs: tuple[str, ...] = ()

    def input(self, name: str) -> str | float | tuple[str | float, ...]:
        """The input called `name`; KeyError where the item has none."""
        return dict(self.inputs)[name]


State = Literal["made", "drawn", "kept", "left out", "failed", "not made"]


@dataclass(frozen=True)
class Entry:
    """What became of an item in a results folder.

    `state`: made now, only drawn anew, kept from an earlier call, left out or failed (`reason` says why), or not made
    (not asked for, or made by other sources); `files`: what was drawn of it, relative to the folder.
    """

    item: Item
    state: State
    reason: str = ""
    seconds: float = 0.0
    files: tuple[str, ...] = ()

    @property
    def there(self) -> bool:
        """Whether its products can be shown."""
        return self.state in ("made", "drawn", "kept")
