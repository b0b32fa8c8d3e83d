"""How thesis figures look: a style for each role, matplotlib's settings, and labels with the thesis's symbols."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sealscope.thesis.engine.products import Role


@dataclass(frozen=True)
class Style:
    """How a role is drawn: colour (its lightness is the grey it prints as), dashes, width [pt], marker."""

    colour: str
    dashes: tuple[float, ...] = ()
    width: float = 1.1
    marker: str = "o"
    filled: bool = True


STYLES: dict[Role, Style] = {
    "command": Style("#59616b", (6, 1.5, 1, 1.5), 1.0),
    "A": Style("#0d4f8b", (), 1.2),
    "B": Style("#e08a2c", (5, 1.6), 1.2, "s", False),
    "literal": Style("#d99a5b", (), 0.8, "s", False),
    "converged": Style("#0b2f55", (), 1.3),
    "no leak": Style("#7f8a95", (), 1.1, "o", False),
    "leak": Style("#8f1d14", (5, 1.5), 1.3, "D"),
    "measured": Style("#111418", (), 1.0, "o"),
    "simulated": Style("#4f93cf", (4, 1.5), 1.2, "s", False),
    "25 %": Style("#79aeda", (5, 1.5), 1.1, "^"),
    "50 %": Style("#2f73b5", (5, 1.5, 1, 1.5), 1.2, "s"),
    "75 %": Style("#0b2f55", (1.2, 1.2), 1.5, "D"),
    "reference": Style("#59616b", (3, 2), 0.8, "x"),
    "other": Style("#1b1f24", (), 1.0, "o"),
}
#: Line styles that tell curves of one role in one panel apart.
SAME_ROLE: tuple[tuple[float, ...], ...] = ((), (5, 1.5), (1.2, 1.2), (6, 1.5, 1, 1.5), (3, 1, 1, 1, 1, 1))

SETTINGS = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "#444b52",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-4, 5),
    "grid.color": "#e1e4e7",
    "grid.linewidth": 0.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "legend.columnspacing": 1.4,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "svg.fonttype": "none",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "mathtext.fontset": "dejavusans",
}


def caption(figure_id: str, title: str) -> str:
    """Return the thesis's number and the title, such as "Fig. 4.22. Pressures in the chambers"."""
    kind, _, number = figure_id.partition("-")
    prefix = {"fig": "Fig.", "table": "Table", "eq": "Eq."}.get(kind)
    title = title.rstrip(".")
    if prefix is None or not number[:1].isdigit():
        return title
    number, _, part = number.partition("-")
    letter = f" {part})" if len(part) == 1 else f" ({part})" if part else ""
    return f"{prefix} {number}{letter}. {title}"


def typeset(label: str) -> str:
    """Set the thesis's symbols in a label as symbols: p_A, d3, omega, m^3/s; all other words stay."""
    text = label.replace("$", r"\$")
    text = re.sub(r"\bd3d4\b", r"$d_3 d_4$", text)
    text = re.sub(r"\bd([1-9])\b", r"$d_\1$", text)
    text = re.sub(
        r"(?<![\w$])(omega|theta|[A-Za-z])_([A-Za-z0-9]{1,4})(?![\w$])",
        lambda m: f"${_GREEK.get(m[1], m[1])}_{{\\mathrm{{{m[2]}}}}}$",
        text,
    )
    text = re.sub(r"(?<![\w$\\])(omega|theta)(?![\w$])", lambda m: f"${_GREEK[m[1]]}$", text)
    text = re.sub(r"\b([cm]?m)([23])\b", lambda m: m[1] + m[2].translate(_RAISED), text)
    text = re.sub(r"\^(-?\d+)(?![\d.])", lambda m: m[1].translate(_RAISED), text)
    return re.sub(r"\^(-?\d+\.\d+)", r"$^{\1}$", text)


_GREEK = {"omega": r"\omega", "theta": r"\theta"}
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
