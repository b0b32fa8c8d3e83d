"""Small curves as SVG paths for the campaign's page: fractions from 0 to 1 over a size or another fraction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
WIDTH, HEIGHT = 460.0, 300.0


@dataclass(frozen=True)
class PlotCurve:
    """A line y over x, both 0..1 upwards, with a band where it has one."""

    label: str
    x: Array
    y: Array
    low: Array | None = None
    high: Array | None = None


@dataclass(frozen=True)
class CurvePlot:
    """Paths, points and ticks in a box of WIDTH x HEIGHT; `shade`: which of six line styles each path has."""

    title: str
    x_label: str
    y_label: str
    paths: tuple[tuple[str, str, int], ...]
    bands: tuple[str, ...]
    points: tuple[tuple[float, float, float, float], ...]
    marks: tuple[tuple[float, str, float], ...]
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]
    width: float = WIDTH
    height: float = HEIGHT


def draw(
    title: str,
    x_label: str,
    y_label: str,
    curves: Sequence[PlotCurve],
    points: Sequence[tuple[float, float, float, float]],
    marks: Sequence[tuple[float, str]],
    *,
    log: bool,
) -> CurvePlot:
    """Lay out curves, points (x, y, low, high) and marked places (x, label); x logarithmic, or linear from 0 to 1."""
    span = (0.0, 1.0)
    if log:
        every = [*(float(x) for curve in curves for x in (curve.x[0], curve.x[-1])), *(point[0] for point in points)]
        span = (math.log10(min(every)) - 0.02, math.log10(max(every)) + 0.02)

    def across(x: float) -> float:
        at = math.log10(x) if log else x
        return round((at - span[0]) / (span[1] - span[0]) * WIDTH, 2)

    def up(y: float) -> float:
        return round((1.0 - y) * HEIGHT, 2)

    def path(x: Array, y: Array, first: str = "M") -> str:
        return "".join(
            f"{first if k == 0 else 'L'}{across(a)} {up(b)}" for k, (a, b) in enumerate(zip(x, y, strict=True))
        )

    paths, bands = [], []
    for shade, curve in enumerate(curves):
        x, y, low, high = _thinned(curve)
        paths.append((curve.label, path(x, y), shade % 6))
        if low is not None and high is not None:
            bands.append(path(x, high) + path(x[::-1], low[::-1], "L") + "Z")
    laid_marks = tuple((across(x), label, 14.0 + 14.0 * k) for k, (x, label) in enumerate(marks))
    return CurvePlot(
        title,
        x_label,
        y_label,
        tuple(paths),
        tuple(bands),
        tuple((across(x), up(y), up(high), up(low)) for x, y, low, high in points),
        laid_marks,
        tuple((across(x), f"{x:g}") for x in (_log_ticks(span) if log else [0.0, 0.2, 0.4, 0.6, 0.8, 1.0])),
        tuple((up(y), f"{y:g}") for y in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)),
    )


def _thinned(curve: PlotCurve, most: int = 400) -> tuple[Array, Array, Array | None, Array | None]:
    """Return at most so many points of a curve, its ends among them."""
    n = curve.x.size
    kept = np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(np.int64))
    low = None if curve.low is None else curve.low[kept]
    high = None if curve.high is None else curve.high[kept]
    return curve.x[kept], curve.y[kept], low, high


def _log_ticks(span: tuple[float, float]) -> list[float]:
    """Return 1, 2 and 5 times the powers of ten within a span of decades."""
    ticks = []
    for power in range(math.floor(span[0]), math.ceil(span[1]) + 1):
        ticks += [float(f"{m}e{power}") for m in (1, 2, 5) if span[0] <= math.log10(m) + power <= span[1]]
    return ticks
