"""The style of the thesis's figures: line styles by role, and labels with the thesis's symbols."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import NamedTuple


class Style(NamedTuple):
    """Line style of all curves with the same role, i.e. meaning; `dashes`: lengths of dashes and gaps, () for solid."""

    colour: str
    dashes: tuple[float, ...] = ()
    width: float = 1.1
    marker: str = "o"
    filled: bool = True


_ROWS = tomllib.loads(Path(__file__).with_name("styles.toml").read_text(encoding="utf-8"))
#: Style by role.
STYLES = {role: Style(**{**row, "dashes": tuple(row.get("dashes", ()))}) for role, row in _ROWS.items()}
SETTINGS = Path(__file__).with_name("thesis.mplstyle")


def caption(figure_id: str, title: str) -> str:
    """Format a caption from the id and the title of a product, such as "Fig. 4.22. Pressures in the chambers".

    The end of an id such as "fig-4.2-a" is written "a)", or in brackets if it is a word. The caption is the title alone
    if the id does not begin with the number of a figure, table or equation.
    """
    kind, _, number_and_part = figure_id.partition("-")
    prefix = {"fig": "Fig.", "table": "Table", "eq": "Eq."}.get(kind)
    title = title.rstrip(".")
    if prefix is None or not number_and_part[:1].isdigit():
        return title
    number, _, part = number_and_part.partition("-")
    part_text = f" {part})" if len(part) == 1 else f" ({part})" if part else ""
    return f"{prefix} {number}{part_text}. {title}"


def typeset(label: str) -> str:
    """Convert the symbols in a label, such as p_A, d3, omega and m^3/s, to matplotlib's mathematical notation."""
    text = label.replace("$", r"\$")
    text = re.sub(r"\bd3d4\b", r"$d_3 d_4$", text)
    text = re.sub(r"\bd([1-9])\b", r"$d_\1$", text)
    # symbols with a subscript, then Greek letters without; not within a word or a formula between $
    text = re.sub(
        r"(?<![\w$])(omega|theta|[A-Za-z])_([A-Za-z0-9]{1,4})(?![\w$])",
        lambda m: f"${_GREEK.get(m[1], m[1])}_{{\\mathrm{{{m[2]}}}}}$",
        text,
    )
    text = re.sub(r"(?<![\w$\\])(omega|theta)(?![\w$])", lambda m: f"${_GREEK[m[1]]}$", text)
    # areas and volumes such as cm3, whole exponents, then decimal exponents
    text = re.sub(r"\b([cm]?m)([23])\b", lambda m: m[1] + m[2].translate(_RAISED), text)
    text = re.sub(r"\^(-?\d+)(?![\d.])", lambda m: m[1].translate(_RAISED), text)
    return re.sub(r"\^(-?\d+\.\d+)", r"$^{\1}$", text)


_GREEK = {"omega": r"\omega", "theta": r"\theta"}
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
