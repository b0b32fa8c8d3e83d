"""The page of a reproduction: one HTML file with every figure, table and claim, an index and a search."""

from __future__ import annotations

import math
from base64 import b64encode
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

from sealscope.reporting import template
from sealscope.thesis.engine.build import ItemStatus
from sealscope.thesis.engine.products import Claim, Figure, ThesisTable, Verdict
from sealscope.thesis.pages.plot_style import caption
from sealscope.thesis.pages.plots import UNRESOLVED

THESIS = "Understanding Effect and Diagnosis of Internal Leakage in Hydrostatic Actuation Systems"
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
CHAPTERS = {
    3: "Chapter 3: transforms and wavelets",
    4: "Chapter 4: the model and its simulation",
    5: "Chapter 5 and Appendix C: leaks, details and their RMS",
    6: "Chapter 6: what follows",
}
_TONES = {"holds": "ok", "holds in part": "open", "does not hold": "leak", "cannot be tested": "none"}
#: A longer table is folded away until somebody opens it.
_LONG_TABLE = 45


class PageProduct(NamedTuple):
    """A figure or table as the page shows it."""

    id: str
    heading: str
    product: Figure | ThesisTable
    picture: str
    links: list[tuple[str, str]]
    claims: list[Claim]
    search_text: str


def write_thesis_page(
    folder: Path, statuses: Sequence[ItemStatus], *, quick: bool = False, sheet: bool = False
) -> Path:
    """Write `index.html` into `folder` from the status of every item; return its path.

    It refers to nothing outside it but the drawn files, which lie in the folder. `quick`: made with shorter runs;
    `sheet`: the measured sheet was given. Raises InputError where the page cannot be written.
    """
    entries: list[tuple[ItemStatus, Figure | ThesisTable, str]] = []
    claims: dict[str, Claim] = {}
    for status in statuses:
        for product in status.products:
            if isinstance(product, Claim):
                claims.setdefault(product.id, product)
            elif isinstance(product, Figure):
                entries.append((status, product, _picture(folder, product.id)))
            elif status.item.id != "claims":  # the claims have a section of their own
                entries.append((status, product, ""))
    chapters: dict[int, list[PageProduct]] = defaultdict(list)
    bearing: dict[str, list[str]] = defaultdict(list)
    for status, product, picture in entries:
        chapters[status.item.chapter].append(_page_product(status, product, picture, claims))
        for name in product.claims:
            bearing[name].append(product.id)
    absent: dict[str, list[ItemStatus]] = defaultdict(list)
    for status in statuses:
        if status.state not in ("made", "kept"):
            why = f"{status.state}: {status.reason}"
            absent["not made yet, or from other sources" if status.state == "not made" else why].append(status)
    claims_files = [name for status in statuses if status.item.id == "claims" for name in status.files]
    page = template.render(
        "thesis.html.j2",
        package="sealscope.thesis.pages",
        scripts=["templates/thesis.js"],
        title="The thesis reproduced",
        thesis=THESIS,
        chapters=[
            (number, CHAPTERS.get(number, f"Chapter {number}"), products) for number, products in chapters.items()
        ],
        claims=list(claims.values()),
        bearing=bearing,
        counts=[(verdict, sum(claim.verdict == verdict for claim in claims.values())) for verdict in VERDICTS],
        slug=lambda verdict: verdict.replace(" ", "-"),
        tone=_TONES,
        claims_csv=next((name for name in claims_files if name.endswith(".csv")), ""),
        absent=list(absent.items()),
        absent_count=sum(map(len, absent.values())),
        total=len(statuses),
        unresolved=UNRESOLVED,
        quick=quick,
        sheet=sheet,
        cell=cell,
        is_number=lambda value: isinstance(value, int | float) and not isinstance(value, bool),
        long_table=_LONG_TABLE,
    )
    return template.write(folder / "index.html", page)


def _page_product(
    status: ItemStatus, product: Figure | ThesisTable, picture: str, claims: dict[str, Claim]
) -> PageProduct:
    its_claims = [claims[name] for name in product.claims if name in claims]
    links = [(Path(name).suffix[1:].upper(), name) for name in status.files if f"/{product.id}." in f"/{name}"]
    heading = caption(product.id, product.title)
    numbers = [number.name for number in product.numbers] if isinstance(product, Figure) else list(product.columns)
    text = " ".join(
        [product.id, heading, product.notes, *numbers, *(f"{claim.id} {claim.claim}" for claim in its_claims)]
    )
    return PageProduct(product.id, heading, product, picture, links, its_claims, text.casefold())


def _picture(folder: Path, name: str) -> str:
    """Return the figure's picture as a data URI: SVG or PNG, whichever is smaller; empty where neither exists."""
    kinds = (("svg+xml", folder / "figures" / f"{name}.svg"), ("png", folder / "figures" / f"{name}.png"))
    pictures = [(path.read_bytes(), kind) for kind, path in kinds if path.is_file()]
    if not pictures:
        return ""
    content, kind = min(pictures, key=lambda picture: len(picture[0]))
    return f"data:image/{kind};base64,{b64encode(content).decode()}"


def cell(value: Any) -> str:
    """Format a table's value: numbers to five digits, a dash for none."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, float):
        text = f"{value:.5g}" if abs(value) < 1e5 else f"{value:.4g}"
        return text.replace("e-0", "e-").replace("e+0", "e+").replace("-", "−")
    return str(value)
