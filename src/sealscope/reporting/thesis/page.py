"""The page of a reproduction: one HTML file with every figure, table and claim, an index and a search."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from sealscope.reporting import template
from sealscope.reporting.thesis.plot_style import caption
from sealscope.reporting.thesis.plots import UNRESOLVED
from sealscope.thesis.engine.items import Entry
from sealscope.thesis.engine.products import Claim, Figure, Product, Table, Verdict

THESIS = "Understanding Effect and Diagnosis of Internal Leakage in Hydrostatic Actuation Systems"
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
CHAPTERS = {
    3: "Chapter 3: transforms and wavelets",
    4: "Chapter 4: the model and its simulation",
    5: "Chapter 5 and Appendix C: leaks, details and their RMS",
    6: "Chapter 6: what follows",
}
#: A longer table is folded away until somebody opens it.
_LONG_TABLE = 45


@dataclass(frozen=True)
class Shown:
    """One figure or table as the page shows it."""

    id: str
    heading: str
    product: Figure | Table
    picture: str
    links: tuple[tuple[str, str], ...]
    claims: tuple[Claim, ...]
    words: str


def write_thesis_page(
    folder: Path,
    shown: Iterable[tuple[Entry, Sequence[Product | Claim]]],
    *,
    quick: bool = False,
    sheet: bool = False,
) -> Path:
    """Write `index.html` into `folder` from every entry and its products, whose files lie in the folder; give its path.

    `quick`: made with shorter runs; `sheet`: the measured sheet was given. Raises InputError where it cannot be
    written.
    """
    target = folder / "index.html"
    return template.write(target, render_thesis_page(folder, shown, quick=quick, sheet=sheet))


def render_thesis_page(
    folder: Path,
    shown: Iterable[tuple[Entry, Sequence[Product | Claim]]],
    *,
    quick: bool = False,
    sheet: bool = False,
) -> str:
    """The page as text, with nothing outside it but links to the files beside it."""

    entries: list[Entry] = []
    found: list[tuple[Entry, Figure | Table, str]] = []
    claims: dict[str, Claim] = {}
    for entry, products in shown:
        entries.append(entry)
        for product in products:
            if isinstance(product, Claim):
                claims.setdefault(product.id, product)
            elif entry.item.id != "claims":  # the claims have a section of their own
                picture = _picture(folder, product.id) if isinstance(product, Figure) else ""
                found.append((entry, _light(product), picture))
    by_chapter: dict[int, list[Shown]] = {}
    for entry, product, picture in found:
        by_chapter.setdefault(entry.item.chapter, []).append(_shown(entry, product, picture, claims))
    script = template.packaged("templates/thesis.js")
    absent = [entry for entry in entries if not entry.there]
    bearing: dict[str, list[str]] = {}
    for _, product, _ in found:
        for name in product.claims:
            bearing.setdefault(name, []).append(product.id)
    return template.render(
        "thesis.html.j2",
        thesis=THESIS,
        chapters=[(number, CHAPTERS.get(number, f"Chapter {number}"), some) for number, some in by_chapter.items()],
        claims=list(claims.values()),
        bearing={name: ids for name, ids in bearing.items() if name in claims},
        counts=[(verdict, sum(one.verdict == verdict for one in claims.values())) for verdict in VERDICTS],
        slug=_slug,
        tone=_TONES,
        claims_csv=_claims_csv(entries),
        absent=_grouped(absent),
        absent_count=len(absent),
        total=len(entries),
        unresolved=UNRESOLVED,
        quick=quick,
        sheet=sheet,
        cell=cell,
        is_number=_is_number,
        long_table=_LONG_TABLE,
        thesis_css=template.packaged("templates/thesis.css"),
        script=script,
        script_hash=template.script_hash(script),
    )


_TONES = {
    "holds": "ok",
    "holds in part": "open",
    "does not hold": "leak",
    "cannot be tested": "none",
}


def _slug(verdict: str) -> str:
    return verdict.replace(" ", "-")


def _claims_csv(entries: Sequence[Entry]) -> str:
    files = [name for entry in entries if entry.item.id == "claims" for name in entry.files if name.endswith(".csv")]
    return files[0] if files else ""


def _light(product: Figure | Table) -> Figure | Table:
    """A figure without the arrays that its picture shows."""
    if isinstance(product, Table):
        return product
    return Figure(product.id, product.title, (), product.numbers, product.claims, product.resolved, product.notes)


def _shown(entry: Entry, product: Figure | Table, picture: str, claims: dict[str, Claim]) -> Shown:
    about = tuple(claims[name] for name in product.claims if name in claims)
    stem = f"/{product.id}."
    links = tuple((Path(name).suffix[1:].upper(), name) for name in entry.files if stem in f"/{name}")
    heading = caption(product.id, product.title)
    numbers = [one.name for one in product.numbers] if isinstance(product, Figure) else list(product.columns)
    words = " ".join([product.id, heading, product.notes, *numbers, *(f"{one.id} {one.claim}" for one in about)])
    return Shown(product.id, heading, product, picture, links, about, words.casefold())


def _picture(folder: Path, name: str) -> str:
    """The figure's picture as a data URI: SVG or PNG, whichever is smaller; empty where neither is there."""
    kinds = (("svg+xml", folder / "figures" / f"{name}.svg"), ("png", folder / "figures" / f"{name}.png"))
    found = [(path.read_bytes(), kind) for kind, path in kinds if path.is_file()]
    if not found:
        return ""
    content, kind = min(found, key=lambda one: len(one[0]))
    return f"data:image/{kind};base64,{b64encode(content).decode()}"


def _grouped(entries: Sequence[Entry]) -> list[tuple[str, list[Entry]]]:
    """Entries that are not shown, by what became of them and why."""
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        why = {"not made": "not made yet, or from other sources", "left out": f"left out: {entry.reason}"}.get(
            entry.state, ""
        )
        groups.setdefault(why or f"failed: {entry.reason}", []).append(entry)
    return list(groups.items())


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def cell(value: Any) -> str:
    """A table's value as text: numbers to five digits, a dash for none."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, float):
        text = f"{value:.5g}" if abs(value) < 1e5 else f"{value:.4g}"
        return text.replace("e-0", "e-").replace("e+0", "e+").replace("-", "−")
    return str(value)
