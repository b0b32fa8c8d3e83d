"""Write the thesis's products as files: figures as SVG, PNG and CSV; tables and claims as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import astuple, fields
from itertools import zip_longest
from pathlib import Path

from sealscope.storage.atomic import atomic_write
from sealscope.storage.folders import make_inner_folder
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, Figure, Product, ThesisTable
from sealscope.thesis.pages.plots import draw, drawn_points


def publish(item: Item, products: Sequence[Product | Claim], folder: Path) -> tuple[str, ...]:
    """Write an item's products into `folder` as files; return their paths, relative to the folder.

    A figure becomes `figures/ID.svg` and `.png`, and `tables/ID.csv`; a table `tables/ID.csv`; an item's claims
    `tables/ID.csv`, or `tables/ID-claims.csv` if a figure or table has that name.
    """
    for name in ("figures", "tables"):
        make_inner_folder(folder, name)
    files: list[str] = []

    def write_bytes(name: str, content: bytes) -> None:
        """Write the file `name` below the folder, and add it to the list of files."""
        with atomic_write(folder / name) as temporary:
            temporary.write_bytes(content)
        files.append(name)

    def write_rows(name: str, rows: Iterable[Sequence[object]]) -> None:
        """Write rows as the CSV file `name` below the folder, and add it to the list of files."""
        with atomic_write(folder / name) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
        files.append(name)

    for product in products:
        if isinstance(product, Figure):
            svg, png = draw(product)
            write_bytes(f"figures/{product.id}.svg", svg)
            write_bytes(f"figures/{product.id}.png", png)
            write_rows(f"tables/{product.id}.csv", figure_rows(product))
        elif isinstance(product, ThesisTable):
            write_rows(f"tables/{product.id}.csv", (product.columns, *product.rows))
    claims = [product for product in products if isinstance(product, Claim)]
    if claims:
        has_table = f"tables/{item.id}.csv" in files
        heads = [field.name for field in fields(Claim)]
        write_rows(f"tables/{item.id}{'-claims' if has_table else ''}.csv", (heads, *map(astuple, claims)))
    return tuple(files)


def figure_rows(figure: Figure) -> Iterable[Sequence[object]]:
    """Yield the heads, then the rows of a table of a figure's points: x, y of each curve, x, y, value of each image."""
    heads: list[str] = []
    columns: list[list[str]] = []
    for number, panel in enumerate(figure.panels, 1):
        panel_text = f"panel {number}" if len(figure.panels) > 1 else ""
        for curve in panel.curves:
            suffix = ", ".join(text for text in (curve.label, panel_text) if text)
            heads += [f"{panel.x_label}; {suffix}", f"{panel.y_label}; {suffix}"]
            columns += [[f"{value:.7g}" for value in values] for values in drawn_points(curve)]
        if panel.image is not None:
            image = panel.image
            heads += [f"{label}; {panel_text}" for label in (panel.x_label, panel.y_label, image.label)]
            cells = [(x, y, image.values[j, i]) for j, y in enumerate(image.y) for i, x in enumerate(image.x)]
            columns += [[f"{cell[k]:.7g}" for cell in cells] for k in range(3)]
    yield [head.removesuffix("; ") for head in heads]  # "; " ends a head without curve label and panel number
    yield from zip_longest(*columns, fillvalue="")
