"""Build a chart as SVG shapes and labels in a frame, from values of its axes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sealscope.recordings.recording import Array

#: SVG path of each symbol, relative to its position, by the first word of its style.
SYMBOLS = {
    "point": "m-3 0a3 3 0 1 0 6 0a3 3 0 1 0-6 0z",
    "bound": "m-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0zm4 4v12m-3.5-4l3.5 4l3.5-4",
    "beyond": "m0-4l5 9h-10z",
    "absent": "m-3-3l6 6m0-6l-6 6",
}
#: Smallest side of a box in pixels, so that it is visible.
_MIN_BOX = 2.0


class SvgPath(NamedTuple):
    """A shape of a picture: name of its style in the style sheet, its SVG path, and its tooltip, "" for none."""

    style: str
    path: str
    title: str = ""


class SvgText(NamedTuple):
    """A text whose `anchor` ("start", "middle" or "end") is at `x`, `y`, in pixels from the frame's top left corner.

    It reads upwards if `turned`.
    """

    x: float
    y: float
    text: str
    anchor: str = "middle"
    turned: bool = False


@dataclass(frozen=True)
class Picture:
    """A chart as SVG shapes and texts, in a frame of `width` x `height` pixels, in styles of the page's style sheet.

    `x_ends`, `y_ends`: values at the ends of the axes; `log`: True for a logarithmic x axis, whose `x_ends` are decimal
    logarithms, such as (-2, 1) for 0.01 to 10; `margins`: space outside the frame in pixels: left, above, right, below;
    `shapes`, `labels`: shapes, drawn in this order, and texts, drawn over them.
    """

    width: float
    height: float
    x_ends: tuple[float, float]
    y_ends: tuple[float, float]
    log: bool = False
    margins: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    shapes: list[SvgPath] = field(default_factory=list)
    labels: list[SvgText] = field(default_factory=list)

    @property
    def view_box(self) -> str:
        """The SVG viewBox, which includes frame and margins."""
        left, top, right, bottom = self.margins
        return f"{-left:g} {-top:g} {left + self.width + right:g} {top + self.height + bottom:g}"

    @property
    def styles(self) -> set[str]:
        """Names of the styles of all shapes in the picture."""
        return {shape.style for shape in self.shapes}

    def x(self, values: Array | float) -> Array:
        """Convert values of the x axis to distances from the left side of the frame, in pixels."""
        start, stop = self.x_ends
        positions = np.log10(values) if self.log else np.asarray(values)
        return np.asarray((positions - start) / (stop - start) * self.width)

    def y(self, values: Array | float) -> Array:
        """Convert values of the y axis to distances from the top of the frame, in pixels."""
        low, high = self.y_ends
        return np.asarray(self.height * (high - np.asarray(values)) / (high - low))

    def draw(self, style: str, path: str, title: str = "") -> None:
        """Add an SVG path, in pixels from the frame's top left corner; `title`: tooltip, "" for none."""
        self.shapes.append(SvgPath(style, path, title))

    def line(self, style: str, x: Array, y: Array, title: str = "", digits: int = 1) -> None:
        """Draw a line through points (n,) of the axes, interrupted at NaN; `digits`: decimals of the coordinates."""
        self.draw(style, self._path(x, y, digits), title)

    def _path(self, x: Array, y: Array, digits: int = 1) -> str:
        """Format the line through points (n,) of the axes as an SVG path."""
        is_drawn = np.isfinite(y)
        is_first = is_drawn & ~np.append(False, is_drawn[:-1])  # the point before is not drawn: a new piece begins
        points = zip(is_first[is_drawn], self.x(x[is_drawn]), self.y(y[is_drawn]), strict=True)
        return "".join(f"{'M' if first else 'L'}{left:.{digits}f} {top:.{digits}f}" for first, left, top in points)

    def area(self, style: str, x: Array, low: Array, high: Array) -> None:
        """Draw the area between the lines `low` and `high` (n,) over `x` (n,); points with NaN are left out."""
        is_known = np.isfinite(low) & np.isfinite(high)
        if is_known.any():
            # along the upper line, and back along the lower one
            outline = np.append(x[is_known], x[is_known][::-1]), np.append(high[is_known], low[is_known][::-1])
            self.draw(style, self._path(*outline) + "z")

    def box(self, style: str, begin: float, end: float, low: float | None = None, high: float | None = None) -> None:
        """Draw a box from `begin` to `end` on the x axis and `low` to `high` on the y axis, None for the axis's end."""
        left, top = float(self.x(begin)), 0.0 if high is None else float(self.y(high))
        bottom = self.height if low is None else float(self.y(low))
        right, bottom = max(float(self.x(end)), left + _MIN_BOX), max(bottom, top + _MIN_BOX)
        self.draw(style, f"M{left:.1f} {top:.1f}H{right:.1f}V{bottom:.1f}H{left:.1f}z")

    def mark(self, style: str, x: float) -> None:
        """Draw a vertical line at the value `x` across the frame."""
        self.draw(style, f"M{self.x(x):.1f} 0V{self.height:g}")

    def level(self, style: str, y: float) -> None:
        """Draw a horizontal line at the value `y` across the frame."""
        self.draw(style, f"M0 {self.y(y):.1f}H{self.width:g}")

    def symbol(self, style: str, x: float, down: float, title: str = "") -> None:
        """Draw the symbol that the first word of `style` names, at the value `x` and `down` pixels below the top."""
        self.draw(style, f"M{self.x(x):.1f} {down:.1f}{SYMBOLS[style.split(maxsplit=1)[0]]}", title)

    def point(self, style: str, x: float, y: float, ends: tuple[float, float], title: str = "") -> None:
        """Draw a point at the values `x` and `y`, and a vertical line between the two y values `ends`, its interval."""
        self.draw("whisker", f"M{self.x(x):.1f} {self.y(ends[0]):.1f}V{self.y(ends[1]):.1f}")
        self.symbol(style, x, float(self.y(y)), title)

    def frame(self, count: int) -> None:
        """Draw the frame, and about `count` horizontal grid lines with their values on the left."""
        for value in ticks(*self.y_ends, count):
            self.level("grid", value)
            # 6 pixels left of the frame; 4 pixels down bring the middle of the digits to the line
            self.labels.append(SvgText(-6.0, float(self.y(value)) + 4.0, f"{value:g}", "end"))
        self.draw("frame", f"M0 0H{self.width:g}V{self.height:g}H0z")

    def below(self, x: float, text: str, anchor: str = "middle") -> None:
        """Write a text below the frame, with its "start", "middle" or "end" (`anchor`) at the value `x`."""
        self.labels.append(SvgText(float(self.x(x)), self.height + 16.0, text, anchor))


def ticks(low: float, high: float, count: int) -> list[float]:
    """List about `count` round values from `low` to `high` > `low`, multiples of 1, 2 or 5 times a power of ten."""
    min_step = (high - low) / count
    power = 10.0 ** np.floor(np.log10(min_step))
    # 0.999 and 1e-9: rounding errors must not change the step or leave out an end
    step = float(next(m for m in (1, 2, 5, 10) if m * power >= min_step * 0.999) * power)
    first = int(np.ceil(low / step - 1e-9))
    last = int(np.floor(high / step + 1e-9))
    return [float(f"{i * step:.12g}") for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """List the values 1, 2 and 5 times a power of ten that lie between 10^low and 10^high."""
    values = [float(f"{m}e{power}") for power in range(math.floor(low), math.ceil(high) + 1) for m in (1, 2, 5)]
    return [value for value in values if low <= math.log10(value) <= high]
