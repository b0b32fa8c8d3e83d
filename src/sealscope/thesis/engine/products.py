"""Products of a reproduction: figures and tables as plain data, which `pages` draws and prints."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import PlainValidator

from sealscope.recordings.recording import Array

#: Meaning of a curve. `thesis.pages.plot_style` gives each role a line style that is readable without colour.
Role = Literal[
    "command", "A", "B", "as_published", "converged", "no leak", "leak", "measured", "simulated",
    "25 %", "50 %", "75 %", "reference", "other",
]  # fmt: skip
#: A value of a table; None: no value.
Cell = float | int | str | None
#: An array that pydantic converts from a list.
Values = Annotated[Array, PlainValidator(np.asarray)]


@dataclass(frozen=True, eq=False)
class FigureCurve:
    """One series of points (x, y) in a panel of a figure; `role`: its meaning, which determines the line style."""

    x: Values
    y: Values
    label: str
    role: Role = "other"
    kind: Literal["line", "points", "stems"] = "line"


@dataclass(frozen=True, eq=False)
class Image:
    """Values over x and y that a panel shows in greys, for example a spectrogram.

    `values`: a row for each y, a column for each x; `label`: meaning of the values, with their unit.
    """

    x: Values
    y: Values
    values: Values
    label: str


@dataclass(frozen=True, eq=False)
class Panel:
    """One set of axes of a figure, with curves, or an image, or both.

    Labels have the unit in brackets, such as "p_A [MPa]". `marks`: (x, text) of vertical lines; `x_range`: limits of
    the x axis, None for the limits of the curves.
    """

    x_label: str
    y_label: str
    curves: tuple[FigureCurve, ...] = ()
    title: str = ""
    marks: tuple[tuple[float, str], ...] = ()
    image: Image | None = None
    x_range: tuple[float, float] | None = None
    log_x: bool = False
    log_y: bool = False


@dataclass(frozen=True)
class Number:
    """One number, or a short text, that a figure reports in addition to its curves; `unit`: "" for no unit."""

    name: str
    value: float | str
    unit: str = ""


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure that reproduces one of the thesis; `id` contains the thesis's number.

    `claims`: ids of claims that it supports or refutes; `resolved`: True if all its simulated runs passed the test
    with half the solver's step, False if one did not (the figure is then marked), None if nothing was tested.
    """

    id: str
    title: str
    panels: tuple[Panel, ...]
    numbers: tuple[Number, ...] = ()
    claims: tuple[str, ...] = ()
    resolved: bool | None = None
    notes: str = ""


@dataclass(frozen=True, eq=False)
class ThesisTable:
    """A table that reproduces one of the thesis, or summarises results; `claims`, `resolved`: as in `Figure`.

    `columns`: heads, with units in brackets; `rows`: texts and numbers, None for an empty cell.
    """

    id: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    claims: tuple[str, ...] = ()
    resolved: bool | None = None
    notes: str = ""


Product = Figure | ThesisTable
Verdict = Literal["holds", "holds in part", "does not hold", "cannot be tested"]


@dataclass(frozen=True)
class Claim:
    """One testable sentence of the thesis, in our words, and the verdict on it.

    `where`: place in the thesis; `claim`: the sentence; `sheet`: text of the findings on the data sheet of Appendix C;
    `simulation`: text of the findings in simulation; `why`: reason for the verdict.
    """

    id: str
    where: str
    claim: str
    sheet: str
    simulation: str
    verdict: Verdict
    why: str


def claim_verdict(tests: Iterable[bool]) -> Verdict:
    """Judge a claim by the results of tests of its parts: all, some, none passed, or no test could be made."""
    results = set(map(bool, tests))
    if len(results) == 1:
        return "holds" if True in results else "does not hold"
    return "holds in part" if results else "cannot be tested"


def thin_curve(x: Array, y: Array, max_points: int = 4000) -> tuple[Array, Array]:
    """Thin a curve (x, y) of more than `max_points` points to the minimum and maximum of each block of points.

    Points after the last whole block are left out. A shorter curve is returned unchanged.
    """
    if x.size <= max_points:
        return x, y
    block_size = int(np.ceil(2 * x.size / max_points))  # two points of each block
    n_used = x.size // block_size * block_size
    blocks = y[:n_used].reshape(-1, block_size)
    first = np.arange(blocks.shape[0]) * block_size
    indices = np.sort(np.concatenate([first + blocks.argmin(axis=1), first + blocks.argmax(axis=1)]))
    return x[indices], y[indices]
