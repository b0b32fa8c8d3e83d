"""A record of p_A - p_B cut into blocks, in each of which the parameters of its machine stand still."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.pressure_model.model import DrivenModel
from sealscope.recordings.recording import Array


@dataclass(frozen=True, eq=False)
class Blocks:
    """The blocks of a record and the model of its machine.

    dp (n,) [Pa]; blocks between `edges` (b + 1,) [samples], of which those `seen` (b,) count.
    """

    model: DrivenModel
    dp: Array
    edges: NDArray[np.int64]
    seen: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.edges.size - 1

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Length (b,) of each block [samples]."""
        return np.diff(self.edges)

    @property
    def seconds(self) -> float:
        """Length of a block [s]."""
        return float(np.median(self.lengths)) / self.model.rate

    @property
    def parts(self) -> list[slice]:
        """The samples of each block."""
        return [slice(int(first), int(end)) for first, end in zip(self.edges[:-1], self.edges[1:], strict=True)]

    @cached_property
    def segment(self) -> NDArray[np.int64]:
        """The block (n,) that a sample is in; what is outside belongs to the first and the last."""
        lengths = self.lengths.copy()
        lengths[0] += self.edges[0]
        lengths[-1] += self.dp.size - self.edges[-1]
        return np.repeat(np.arange(self.count, dtype=np.int64), lengths)

    def run(self, paths: Array, start: Array | None = None) -> Array:
        """Return dp [Pa] (runs, n) with the parameters `paths` (runs, b, 14) of each block.

        `start` (5,): the state at the first sample, at rest under the load by default.
        """
        return self.model.run(paths, self.segment, None if start is None else np.tile(start, (len(paths), 1)))

    def misfits(self, shown: Array) -> Array:
        """Return the sum of squares (..., b) of what is left of dp beside a constant a block; 0 where none counts.

        `shown` (..., n): dp of the model [Pa].
        """
        first, end = self.edges[0], self.edges[-1]
        rest = self.dp[first:end] - shown[..., first:end]
        sums, squares = (np.add.reduceat(each, self.edges[:-1] - first, axis=-1) for each in (rest, rest**2))
        return np.asarray((squares - sums**2 / self.lengths) * self.seen)
