"""Where values stand in a picture: paths, bands and ticks of every chart that is drawn as SVG."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sealscope.recordings.recording import Array


class Scale(NamedTuple):
    """Places in a box of `width` x `height`, from the ends of both axes; those of a logarithmic x are in decades."""

    width: float
    height: float
    x_ends: tuple[float, float]
    y_ends: tuple[float, float]
    log: bool = False

    def x(self, values: Array | float) -> Array:
        """Return how far from the left values stand."""
        start, stop = self.x_ends
        at = np.log10(values) if self.log else np.asarray(values)
        return np.asarray((at - start) / (stop - start) * self.width)

    def y(self, values: Array | float) -> Array:
        """Return how far from the top values stand."""
        low, high = self.y_ends
        return np.asarray(self.height * (high - np.asarray(values)) / (high - low))

    def path(self, x: Array, y: Array, digits: int = 1) -> str:
        """Return the line through points (n,), broken where y is missing."""
        drawn = np.isfinite(y)
        begins = drawn & ~np.append(False, drawn[:-1])
        points = zip(begins[drawn], self.x(x[drawn]), self.y(y[drawn]), strict=True)
        return "".join(f"{'M' if first else 'L'}{a:.{digits}f} {b:.{digits}f}" for first, a, b in points)

    def band(self, x: Array, low: Array, high: Array) -> str:
        """Return the area between two lines (n,) where both are known."""
        there = np.isfinite(low) & np.isfinite(high)
        around = np.append(x[there], x[there][::-1]), np.append(high[there], low[there][::-1])
        return self.path(*around) + "Z" if there.any() else ""

    def ticks(self, across: int, up: int) -> dict[str, list[tuple[float, str]]]:
        """Return places and texts of ticks on both axes, about so many of them."""
        at_x = log_ticks(*self.x_ends) if self.log else ticks(*self.x_ends, across)
        return {
            "x_ticks": [(round(float(self.x(value)), 2), f"{value:g}") for value in at_x],
            "y_ticks": [(round(float(self.y(value)), 2), f"{value:g}") for value in ticks(*self.y_ends, up)],
        }


def ticks(low: float, high: float, about: int) -> list[float]:
    """Return round values (1, 2 or 5 times a power of ten apart) between low and high, `about` so many."""
    raw = (high - low) / about
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(next(m for m in (1, 2, 5, 10) if m * power >= raw * 0.999) * power)
    first = int(np.ceil(low / step - 1e-9))
    return [float(f"{i * step:.12g}") for i in range(first, int(np.floor(high / step + 1e-9)) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return 1, 2 and 5 times the powers of ten between two decades."""
    values = [float(f"{m}e{power}") for power in range(math.floor(low), math.ceil(high) + 1) for m in (1, 2, 5)]
    return [value for value in values if low <= math.log10(value) <= high]
