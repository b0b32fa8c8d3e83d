"""Write the page of a reproduction: one HTML file with all figures, tables and claims, an index and a search."""

from __future__ import annotations

import math
from base64 import b64encode
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

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
#: Tone (class of the style sheet) of each verdict.
_TONES = {"holds": "ok", "holds in part": "open", "does not hold": "leak", "cannot be tested": "none"}
#: A table with more rows is collapsed.
_MAX_OPEN_ROWS = 45


def write_thesis_page(
    folder: Path, statuses: Sequence[ItemStatus], *, quick: bool = False, sheet: bool = False
) -> Path:
    """Write the page of a reproduction, `index.html` in `folder`, from the statuses of all items; return its path.

    The page links to nothing but the files in the folder. `quick`: True if shorter runs were made; `sheet`: True if
    the measured data sheet was given. Raises InputError if the page cannot be written.
    """
    claims: dict[str, Claim] = {}
    products = [(status, product) for status in statuses for product in status.products]
    for _, product in products:
        if isinstance(product, Claim):
            claims.setdefault(product.id, product)
    chapters: dict[int, list[dict[str, Any]]] = defaultdict(list)
    products_by_claim: dict[str, list[str]] = defaultdict(list)
    for status, product in products:
        if isinstance(product, Claim) or (isinstance(product, ThesisTable) and status.item.id == "claims"):
            continue  # claims and their table have a section of their own
        chapters[status.item.chapter].append(_page_product(status, product, folder, claims))
        for name in product.claims:
            products_by_claim[name].append(product.id)
    absent: dict[str, list[ItemStatus]] = defaultdict(list)  # items without products, by reason
    for status in statuses:
        if status.state == "not made":
            absent["not made yet, or from other sources"].append(status)
        elif status.state not in ("made", "kept"):
            absent[f"{status.state}: {status.reason}"].append(status)
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
        products_by_claim=products_by_claim,
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
        format_cell=format_cell,
        is_number=lambda value: isinstance(value, int | float) and not isinstance(value, bool),
        max_open_rows=_MAX_OPEN_ROWS,
    )
    return template.write(folder / "index.html", page)


def _page_product(
    status: ItemStatus, product: Figure | ThesisTable, folder: Path, claims: dict[str, Claim]
) -> dict[str, Any]:
    """Build the template's values for a figure or table from its files in `folder`; `claims`: all claims by id.

    `picture` is the figure as a data URI, "" for a table; `search_text` is the text in which the page's search looks.
    """
    picture = _encode_picture(folder, product.id) if isinstance(product, Figure) else ""
    product_claims = [claims[name] for name in product.claims if name in claims]
    # (format, path) of the product's files, named by its id; "/" and "." exclude longer names that contain the id
    links = [(Path(name).suffix[1:].upper(), name) for name in status.files if f"/{product.id}." in f"/{name}"]
    heading = caption(product.id, product.title)
    value_names = [number.name for number in product.numbers] if isinstance(product, Figure) else list(product.columns)
    claim_texts = [f"{claim.id} {claim.claim}" for claim in product_claims]
    text = " ".join([product.id, heading, product.notes, *value_names, *claim_texts])
    return {
        "id": product.id,
        "heading": heading,
        "product": product,
        "picture": picture,
        "links": links,
        "claims": product_claims,
        "search_text": text.casefold(),
    }


def _encode_picture(folder: Path, name: str) -> str:
    """Encode a figure's SVG or PNG file, whichever is smaller, as a data URI; return "" if neither exists."""
    paths = {"svg+xml": folder / "figures" / f"{name}.svg", "png": folder / "figures" / f"{name}.png"}
    pictures = {kind: path.read_bytes() for kind, path in paths.items() if path.is_file()}
    if not pictures:
        return ""
    kind = min(pictures, key=lambda kind: len(pictures[kind]))
    return f"data:image/{kind};base64,{b64encode(pictures[kind]).decode()}"


def format_cell(value: Any) -> str:
    """Format a value for the page: a float with five significant digits, four from 1e5 on, None and nan as a dash."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, float):
        text = f"{value:.5g}" if abs(value) < 1e5 else f"{value:.4g}"
        return text.replace("e-0", "e-").replace("e+0", "e+").replace("-", "−")
    return str(value)
