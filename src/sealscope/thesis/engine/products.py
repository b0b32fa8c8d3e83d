"""Products of a reproduction: figures and tables as plain data, which `pages` draws and prints."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import PlainValidator

from sealscope.recordings.recording import Array

#: What a curve stands for. `thesis.pages.plot_style` gives each role a line, a grey and a colour, readable without
#: the colour.
Role = Literal[
    "command", "A", "B", "literal", "converged", "no leak", "leak", "measured", "simulated",
    "25 %", "50 %", "75 %", "reference", "other",
]  # fmt: skip
#: A value of a table; None: no value.
Cell = float | int | str | None
Values = Annotated[Array, PlainValidator(np.asarray)]


@dataclass(frozen=True, eq=False)
class FigureCurve:
    """One series of points (x, y), in the panel's units."""

    x: Values
    y: Values
    label: str
    role: Role = "other"
    kind: Literal["line", "points", "stems"] = "line"


@dataclass(frozen=True, eq=False)
class Image:
    """Values (rows over y, columns over x) drawn as greys, such as a spectrogram."""

    x: Values
    y: Values
    values: Values
    label: str


@dataclass(frozen=True, eq=False)
class Panel:
    """One set of axes; labels carry the unit in brackets, such as "p_A [MPa]"."""

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
    """One number behind a figure."""

    name: str
    value: float | str
    unit: str = ""


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure under the thesis's own number.

    `claims`: ids of the claims it bears on; `resolved`: whether every run in it passed the halving test (None:
    nothing simulated); a figure that did not is marked on its face.
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
    """A table: `columns` with units in brackets, `rows` of text and numbers."""

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
    """One testable sentence of the thesis, in our words, and its verdict.

    `where` it stands, what the data `sheet` says, what the `simulation` says, the verdict, and `why`.
    """

    id: str
    where: str
    claim: str
    sheet: str
    simulation: str
    verdict: Verdict
    why: str


def verdict_of(tests: Iterable[bool | None]) -> Verdict:
    """Judge a claim by the tests of its parts.

    `holds` where every test passed, `does not hold` where none did, `holds in part` between; tests that could not be
    made (None) do not count, and without any other the claim `cannot be tested`.
    """
    results = {bool(test) for test in tests if test is not None}
    if len(results) == 1:
        return "holds" if True in results else "does not hold"
    return "holds in part" if results else "cannot be tested"


def thinned(x: Array, y: Array, most: int = 4000) -> tuple[Array, Array]:
    """Thin a curve to about `most` points: the least and the greatest of each stretch, so that peaks survive."""
    if x.size <= most:
        return x, y
    size = int(np.ceil(2 * x.size / most))
    used = x.size // size * size
    blocks = y[:used].reshape(-1, size)
    start = np.arange(blocks.shape[0]) * size
    picks = np.sort(np.concatenate([start + blocks.argmin(axis=1), start + blocks.argmax(axis=1)]))
    return x[picks], y[picks]
