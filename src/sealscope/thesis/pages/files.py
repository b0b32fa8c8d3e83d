"""Thesis products as files: figures as SVG and PNG with their numbers as CSV, tables and claims as CSV."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import astuple, fields
from itertools import zip_longest
from pathlib import Path

from sealscope.storage.atomic import atomic_write
from sealscope.storage.folders import inner_folder
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, Figure, Product, ThesisTable
from sealscope.thesis.pages.plots import draw, visible

_NAME = re.compile(r"[a-z0-9]+([-.][a-z0-9]+)*")


def publish(item: Item, products: Sequence[Product | Claim], folder: Path) -> tuple[str, ...]:
    """Write an item's products into `folder`; return the files written, relative to it.

    `figures/ID.svg`, `figures/ID.png`, `tables/ID.csv`; claims go to `tables/ID.csv` of their item
    (`tables/ID-claims.csv` where a table has that name). Raises ValueError for an id that is no file name.
    """
    for name in ("figures", "tables"):
        inner_folder(folder, name)
    files: list[str] = []

    def put_file(name: str, content: bytes) -> None:
        with atomic_write(folder / name) as temporary:
            temporary.write_bytes(content)
        files.append(name)

    def put_rows(name: str, rows: Iterable[Sequence[object]]) -> None:
        with atomic_write(folder / name) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
        files.append(name)

    for product in products:
        if not isinstance(product, Claim) and not _NAME.fullmatch(product.id):
            raise ValueError(f"an id must be of a-z, 0-9, '.' and '-', got {product.id!r} ({item.id})")
        if isinstance(product, Figure):
            svg, png = draw(product)
            put_file(f"figures/{product.id}.svg", svg)
            put_file(f"figures/{product.id}.png", png)
            put_rows(f"tables/{product.id}.csv", figure_rows(product))
        elif isinstance(product, ThesisTable):
            put_rows(f"tables/{product.id}.csv", (product.columns, *product.rows))
    claims = [product for product in products if isinstance(product, Claim)]
    if claims:
        has_table = f"tables/{item.id}.csv" in files
        heads = [field.name for field in fields(Claim)]
        put_rows(f"tables/{item.id}{'-claims' if has_table else ''}.csv", (heads, *map(astuple, claims)))
    return tuple(files)


def figure_rows(figure: Figure) -> Iterable[Sequence[object]]:
    """Yield what a figure plots: columns (x, y) for each curve, (x, y, value) for an image, as drawn."""
    heads: list[str] = []
    columns: list[list[str]] = []
    for number, panel in enumerate(figure.panels, 1):
        place = f"panel {number}" if len(figure.panels) > 1 else ""
        for curve in panel.curves:
            tail = ", ".join(word for word in (curve.label, place) if word)
            heads += [f"{panel.x_label}; {tail}", f"{panel.y_label}; {tail}"]
            columns += [[_short(value) for value in values] for values in visible(curve, panel.x_range)]
        if panel.image is not None:
            image = panel.image
            heads += [f"{label}; {place}" for label in (panel.x_label, panel.y_label, image.label)]
            cells = [(x, y, image.values[j, i]) for j, y in enumerate(image.y) for i, x in enumerate(image.x)]
            columns += [[_short(cell[k]) for cell in cells] for k in range(3)]
    yield [head.removesuffix("; ") for head in heads]
    yield from zip_longest(*columns, fillvalue="")


def _short(value: float) -> str:
    return f"{value:.7g}"
