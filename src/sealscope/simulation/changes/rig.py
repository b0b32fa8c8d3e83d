"""A rig that changes within a run: what changes, and the short blocks over which its numbers are held."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.physics.rig import RigNumbers

#: Longest time [s] over which a changing number is held, and the shortest (unless something jumps within it).
LONGEST_BLOCK, SHORTEST_BLOCK = 0.5, 0.05


@dataclass(frozen=True)
class Effect:
    """One number of the rig that changes: value = (own value + sum of `added`) x product of the others.

    `change(t)` at times t [s]: what is added, or the factor; `resolution`: most that it may change from one block to
    the next; `jumps`: times [s] at which it may jump or bend.
    """

    field: str
    change: Callable[[Array], Array]
    resolution: float
    added: bool = False
    jumps: tuple[float, ...] = ()


class Schedule:
    """The rig's numbers over a run, constant within blocks: `bounds` (n + 1,) output indices, one number set a block.

    A block is at most 0.5 s long, and so short (down to 0.05 s) that no effect moves by more than its resolution; a
    jump falls on a block's boundary, within one output interval. Within a block a number has its value at the middle.
    Neighbours with the same numbers are one block.
    """

    def __init__(self, effects: Sequence[Effect], base: RigNumbers, n_out: int, rate: float) -> None:
        jumps = np.array([jump for effect in effects for jump in effect.jumps], dtype=np.float64)
        jumps = np.ceil(jumps[np.isfinite(jumps)] * rate * (1.0 - 1e-12))
        jumps = jumps[(jumps > 0) & (jumps < n_out)]
        cell = max(1, round(LONGEST_BLOCK * rate))
        self.bounds = np.array([0, n_out], dtype=np.int64)
        self.numbers = [base]
        if not effects:
            return
        self.bounds = np.unique(np.r_[np.arange(0, n_out, cell), n_out, jumps.astype(np.int64)])
        self.bounds = self._refined(effects, rate)
        middles: Array = np.asarray(0.5 * (self.bounds[:-1] + self.bounds[1:]) / rate, dtype=np.float64)
        values = values_of(effects, base, middles)
        table = np.array(list(values.values()))
        new = np.r_[True, np.any(table[:, 1:] != table[:, :-1], axis=0)]
        self.bounds = np.r_[self.bounds[:-1][new], n_out]
        # a run has one kind of numbers throughout: what the compiler leaves out is left out from its beginning
        fields: dict[str, Any] = {}
        if any(field.startswith("G_ext") and np.any(found > 0) for field, found in values.items()):
            fields["open_circuit"] = (True,)
        if "air" in values and np.any(values["air"] > 0):
            fields["aerated"] = (True,)
        whole = base._replace(**fields)
        rows = table[:, new].T.tolist()
        self.numbers = [whole._replace(**dict(zip(values, row, strict=True))) for row in rows]

    def _refined(self, effects: Sequence[Effect], rate: float) -> np.ndarray:
        """The bounds with each cell cut so that no effect moves further than its resolution from block to block."""
        starts, stops = self.bounds[:-1], self.bounds[1:]
        inside = 1e-6 / rate  # from inside the cell: a jump at its bound is no slope
        parts = np.ones(starts.size)
        for effect in effects:
            moved = np.abs(effect.change(stops / rate - inside) - effect.change(starts / rate + inside))
            parts = np.maximum(parts, np.ceil(moved / effect.resolution - 1e-9))
        least = max(1, round(SHORTEST_BLOCK * rate))
        parts = np.minimum(parts, np.maximum(1, (stops - starts) // least)).astype(np.int64)
        cuts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(starts, stops, parts, strict=True) if n > 1]
        return np.unique(np.r_[self.bounds, np.rint(np.concatenate([*cuts, self.bounds[:0]])).astype(np.int64)])

    def within(self, first: int, last: int) -> Iterator[tuple[int, int, RigNumbers]]:
        """Parts (start, stop, numbers) of the outputs first <= k < last."""
        k = int(np.searchsorted(self.bounds, first, side="right")) - 1
        while first < last:
            stop = min(int(self.bounds[k + 1]), last)
            yield first, stop, self.numbers[k]
            first, k = stop, k + 1


def values_of(effects: Sequence[Effect], base: RigNumbers, t: Array) -> dict[str, Array]:
    """The numbers of `base` that change, by name, at times t [s]."""
    values: dict[str, Array] = {}
    for effect in sorted(effects, key=lambda one: not one.added):  # sums before products
        own = values.get(effect.field)
        if own is None:
            own = np.full(t.size, float(getattr(base, effect.field)))
        change = effect.change(t)
        values[effect.field] = own + change if effect.added else own * change
    return values
