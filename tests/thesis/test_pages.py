"""Thesis products as pictures, files and the page."""

from __future__ import annotations

import csv
import io
import re
import sys
import xml.etree.ElementTree as ET
from base64 import b64encode
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from sealscope.errors import MissingExtra
from sealscope.thesis.engine.build import ItemStatus
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, Figure, FigureCurve, Image, Number, Panel, Role, ThesisTable
from sealscope.thesis.pages.files import figure_rows, publish
from sealscope.thesis.pages.page import VERDICTS, format_cell, write_thesis_page
from sealscope.thesis.pages.plot_style import STYLES, caption, typeset
from sealscope.thesis.pages.plots import MAX_SVG_BYTES, UNRESOLVED, draw, drawn_points

from ..refusals import refusal
from ..reporting.pages import Reader

pytest.importorskip("matplotlib", reason="figures need the extra 'report'")

T = np.linspace(0.0, 10.0, 501)


def make(context: object, item: Item) -> tuple[()]:
    return ()


def figure(name: str = "fig-4.22", resolved: bool | None = True, curves: int = 2) -> Figure:
    roles: tuple[Role, ...] = ("A", "B", "no leak", "leak")
    made = tuple(FigureCurve(T, np.sin(T + k), f"curve {k}", roles[k % 4]) for k in range(curves))
    panel = Panel("t [s]", "p_A [MPa]", made, marks=((5.0, "leak opens"),))
    numbers = (Number("range of p_A", 0.125, "MPa"),)
    title = "Pressures in the chambers, p_A and p_B"
    return Figure(name, title, (panel,), numbers, ("claim-4.3",), resolved, "A note.")


@cache
def drawn(resolved: bool | None = True) -> tuple[bytes, bytes]:
    """The two pictures of a figure, drawn once."""
    return draw(figure(resolved=resolved))


def texts(svg: bytes) -> str:
    return " ".join("".join(node.itertext()) for node in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text"))


def png_size(png: bytes) -> tuple[int, int]:
    return int.from_bytes(png[16:20]), int.from_bytes(png[20:24])


# figures


def test_a_figure_carries_number_units_legend_and_mark_as_text() -> None:
    svg, png = drawn()
    result = texts(svg)
    for words in ("t [s]", "curve 0", "curve 1", "leak opens"):
        assert words in result
    assert "".join(result.split()).count("pA") == 2  # symbols are set letter by letter: the y label and the caption
    assert ET.fromstring(svg).findtext("{http://www.w3.org/2000/svg}title") == (
        "Fig. 4.22. Pressures in the chambers, p_A and p_B"
    )
    assert UNRESOLVED.upper() not in result
    assert png_size(png)[0] == 1440


def test_the_same_figure_gives_the_same_bytes() -> None:
    assert draw(figure()) == drawn()


def test_only_an_unresolved_figure_is_marked_on_its_face() -> None:
    known, unknown, unresolved = map(drawn, (True, None, False))
    assert known == unknown
    assert UNRESOLVED.upper() not in texts(known[0]) and UNRESOLVED.upper() in texts(unresolved[0])
    assert unresolved[1] != known[1]


@pytest.mark.slow
def test_the_mark_does_not_cover_the_legend() -> None:
    panels = tuple(Panel("t [s]", "p [MPa]", figure().panels[0].curves) for _ in range(2))
    svg, _ = draw(Figure("fig-1.1", "Two", panels, resolved=False))
    heights = {
        "".join(node.itertext()): float(node.get("y") or re.findall(r"[\d.]+", node.get("transform", "0 0"))[1])
        for node in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")
    }
    assert heights["curve 0"] - heights[UNRESOLVED.upper()] > 8


@pytest.mark.slow
def test_long_records_stay_small_and_keep_their_peaks() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(90_000) / 500
    panels = []
    for k in range(5):
        y = rng.standard_normal(t.size)
        y[40_000 + k] = 60.0
        panels.append(
            Panel(
                "t [s]",
                f"d{k + 1} [psi]",
                (FigureCurve(t, y, "no leak", "no leak"), FigureCurve(t, -y, "leak", "leak")),
            )
        )
    svg, png = draw(Figure("fig-5.5", "Details", tuple(panels)))
    assert len(svg) <= MAX_SVG_BYTES
    assert len(png) < 400_000
    x, y = drawn_points(panels[0].curves[0])
    assert x.size < 3000
    assert y.max() == 60.0


@pytest.mark.slow
def test_images_log_axes_points_and_stems_are_drawn() -> None:
    values = np.outer(np.arange(5), np.arange(6)).astype(float)
    panels = (
        Panel("t [s]", "f [Hz]", image=Image(np.arange(6.0), 1 + np.arange(5.0), values, "amplitude [1]"), log_y=True),
        Panel("n", "a", (FigureCurve(np.arange(5.0), np.ones(5), "stems", kind="stems"),)),
        Panel("n", "a", (FigureCurve(np.arange(5.0), np.arange(5.0), "points", "measured", "points"),), title="(d)"),
    )
    svg, _ = draw(Figure("fig-3.4", "Three", panels))
    assert "amplitude [1]" in texts(svg)
    assert b"image/png;base64" in svg  # the picture of greys


def lightness(colour: str) -> float:
    return sum(w * int(colour[k : k + 2], 16) / 255 for w, k in ((0.299, 1), (0.587, 3), (0.114, 5)))


@pytest.mark.parametrize(
    "together",
    [("A", "B"), ("no leak", "leak"), ("as_published", "converged"), ("measured", "simulated"),
     ("25 %", "50 %", "75 %")],
)  # fmt: skip
def test_what_is_drawn_together_differs_in_grey(together: tuple[Role, ...]) -> None:
    greys = sorted(lightness(STYLES[role].colour) for role in together)
    assert min(np.diff(greys)) > 0.08
    assert len({STYLES[role].dashes for role in together}) > 1 or together == ("as_published", "converged")


def test_every_role_has_a_style() -> None:
    assert set(STYLES) == set(get_args(Role))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("fig-4.22", "Fig. 4.22. Flow"),
        ("table-4.3-f", "Table 4.3 f). Flow"),
        ("fig-4.13-printed", "Fig. 4.13 (printed). Flow"),
        ("eq-3.4", "Eq. 3.4. Flow"),
        ("appendix-c", "Flow"),
        ("chapter-4-volumes", "Flow"),
    ],
)
def test_captions_have_the_thesis_number(name: str, words: str) -> None:
    assert caption(name, "Flow.") == words


def test_symbols_are_set_as_symbols() -> None:
    assert typeset("p_A [MPa]") == r"$p_{\mathrm{A}}$ [MPa]"
    assert typeset("omega [rad/s]") == r"$\omega$ [rad/s]"
    assert typeset("q_leak [m^3/s]") == r"$q_{\mathrm{leak}}$ [m³/s]"
    assert typeset("V_1 [cm3]") == r"$V_{\mathrm{1}}$ [cm³]"
    assert typeset("RMS of d3d4 and d1") == "RMS of $d_3 d_4$ and $d_1$"
    assert typeset("plain words, 25 % closed") == "plain words, 25 % closed"


# files


def test_publish_writes_figures_tables_and_claims(tmp_path: Path) -> None:
    claims = [Claim(f"claim-{k}", "section 1", "It is.", "so", "so", "holds", "why") for k in range(2)]
    table = ThesisTable("table-4.2-a", "T", ("quantity", "p_A [MPa]"), (("range", 0.125), ("none", None)))
    item = Item("table-4.2-a", 4, "case", "T", make)
    files = publish(item, (figure(), table, *claims), tmp_path)
    assert files == (
        "figures/fig-4.22.svg", "figures/fig-4.22.png", "tables/fig-4.22.csv", "tables/table-4.2-a.csv",
        "tables/table-4.2-a-claims.csv",
    )  # fmt: skip
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")} == set(files)
    rows = list(csv.reader((tmp_path / "tables" / "table-4.2-a.csv").read_text().splitlines()))
    assert rows == [["quantity", "p_A [MPa]"], ["range", "0.125"], ["none", ""]]
    assert len(list(csv.DictReader((tmp_path / "tables" / "table-4.2-a-claims.csv").open()))) == 2


def test_a_figures_numbers_are_what_it_plots() -> None:
    rows = list(figure_rows(figure()))
    assert rows[0] == ["t [s]; curve 0", "p_A [MPa]; curve 0", "t [s]; curve 1", "p_A [MPa]; curve 1"]
    assert len(rows) == 1 + T.size
    assert float(str(rows[251][1])) == pytest.approx(np.sin(T[250]), rel=1e-6)


# the page


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a page of all kinds of items."""
    folder = tmp_path_factory.mktemp("published")
    claims = tuple(
        Claim(f"claim-4.{k}", "section 4", f"Claim <{k}> of p_A", "sheet", "simulation", verdict, "why")
        for k, verdict in enumerate(VERDICTS)
    )
    long = ThesisTable("table-4.2-a", "Cases", ("name", "p_A [MPa]"), tuple((f"row {k}", k * 1e-7) for k in range(60)))
    made: list[ItemStatus] = []
    for item, products in (
        (Item("fig-4.22", 4, "figure", "F", make), (figure(resolved=False),)),
        (Item("table-4.2-a", 4, "case", "T", make), (long,)),
        (Item("chapter-4-claims", 4, "claims", "C", make), claims),
    ):
        made.append(ItemStatus(item, "made", products=products, files=publish(item, products, folder)))
    made.append(ItemStatus(Item("table-5.1", 5, "table", "Rates", make), "left out", "needs the data sheet"))
    made.append(ItemStatus(Item("fig-5.1", 5, "figure", "Broken", make), "failed", "RuntimeError: <no>"))
    write_thesis_page(folder, made, quick=True)
    return folder


@pytest.fixture(scope="module")
def page(published: Path) -> str:
    return (published / "index.html").read_text(encoding="utf-8")


def test_the_page_is_well_formed_and_self_contained(page: str, published: Path) -> None:
    checker = Reader(page)
    assert len(checker.ids) == len(set(checker.ids))
    assert {"fig-4.22", "table-4.2-a", "claim-4.3", "claims", "absent", "chapter-4"} <= set(checker.ids)
    for address in checker.targets:
        if address.startswith("#"):
            assert address[1:] in checker.ids
        elif not address.startswith("data:image/"):
            assert (published / address).is_file(), address
    assert "http" not in re.sub(r"data:image/[^\"]+", "", page).replace("http-equiv", "")


def test_the_page_shows_marks_verdicts_reasons_and_numbers(page: str) -> None:
    assert page.count(UNRESOLVED) == 2  # in the words at the top, and over the figure
    for verdict in VERDICTS:
        assert f'id="only-{verdict.replace(" ", "-")}"' in page
        assert f"#only-{verdict.replace(' ', '-')}:checked" in page  # the filter works without scripts
    assert "left out: needs the data sheet" in page
    assert "failed: RuntimeError: &lt;no&gt;" in page
    assert "Claim &lt;0&gt; of p_A" in page
    assert "Quick run" in page
    assert 'href="#claim-4.3">claim-4.3</a>' in page
    assert 'see <a href="#fig-4.22">' in page


def test_the_search_knows_ids_titles_and_claims(page: str) -> None:
    words = re.findall(r'<article id="fig-4\.22" data-kind="item" data-words="([^"]*)"', page)
    assert len(words) == 1
    for wanted in ("fig-4.22", "pressures in the chambers", "claim &lt;3&gt; of p_a", "range of p_a"):
        assert wanted in words[0]


def test_the_pages_script_is_the_one_its_policy_allows(page: str) -> None:
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    assert len(scripts) == 1
    digest = b64encode(sha256(scripts[0].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page


def test_an_empty_folder_gives_a_page_that_says_so(tmp_path: Path) -> None:
    page = write_thesis_page(tmp_path, [ItemStatus(Item("fig-1.1", 4, "figure", "F", make), "not made")])
    text = page.read_text(encoding="utf-8")
    assert "0 of 1 items" in text
    assert "not made yet, or from other sources (1)" in text


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (0.1234567, "0.12346"), (-1.5e-7, "−1.5e−7"), (41, "41"), ("41/41", "41/41"),
     (123456.0, "1.235e+5")],
)  # fmt: skip
def test_cells(value: object, text: str) -> None:
    assert format_cell(value) == text


def test_the_svg_of_the_page_is_the_smaller_picture(page: str, published: Path) -> None:
    sizes = {kind: (published / "figures" / f"fig-4.22.{kind}").stat().st_size for kind in ("svg", "png")}
    kind = "svg+xml" if sizes["svg"] < sizes["png"] else "png"
    assert f'src="data:image/{kind};base64,' in page
    assert io.BytesIO(page.encode()).getbuffer().nbytes < 400_000


def test_without_the_drawing_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with refusal("sealscope[report]", error=MissingExtra):
        draw(figure())
