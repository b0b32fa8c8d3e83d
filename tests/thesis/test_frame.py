"""The frame of the reproduction: the registry, what is kept between calls, and when it is good no longer."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sealscope.thesis
from sealscope.errors import InputError
from sealscope.thesis.engine import kept, registry, sources
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, Curve, Figure, Image, Number, Panel, Table
from sealscope.thesis.engine.reproduce import Outcome, reproduce
from sealscope.thesis.engine.store import Store, held
from sealscope.thesis.sheet import MISSING


def item(name: str, make: str, *needs: str, needs_sheet: bool = False) -> Item:
    return Item(name, 4, "table", f"Item {name}", f"fakes.chapter:{make}", needs=needs, needs_sheet=needs_sheet)


def worked(tmp_path: Path) -> list[str]:
    """Which items were made, in order."""
    log = tmp_path / "log"
    return log.read_text().split() if log.exists() else []


def states(outcome: Outcome) -> dict[str, str]:
    return {entry.item.id: entry.state for entry in outcome.entries}


# registry


def test_select_by_id_chapter_wildcard_and_all() -> None:
    items = (item("t-1", "table"), item("fig-5.1", "table"), Item("fig-5.2", 5, "figure", "", "fakes.chapter:table"))
    chosen = {
        word: [one.id for one in registry.select(items, [word])] for word in ("all", "chapter-5", "fig-5.*", "t-1")
    }
    assert chosen == {
        "all": ["t-1", "fig-5.1", "fig-5.2"],
        "chapter-5": ["fig-5.2"],
        "fig-5.*": ["fig-5.1", "fig-5.2"],
        "t-1": ["t-1"],
    }


def test_an_unknown_id_names_the_closest() -> None:
    with pytest.raises(InputError, match=r"got 'fig-5\.9'; closest: fig-5\.1"):
        registry.select((item("fig-5.1", "table"), item("t-1", "table")), ["fig-5.9"])


@pytest.mark.parametrize(
    ("items", "words"),
    [
        ((item("t-1", "table"), item("t-1", "table")), "t-1 twice"),
        ((item("t-1", "table", "t-2"),), "t-2 (t-1)"),
        ((item("t-1", "table", "t-2"), item("t-2", "table", "t-1")), "t-1 -> t-2 -> t-1"),
        ((item("T 1", "table"),), "'T 1'"),
    ],
)
def test_a_registry_that_contradicts_itself_is_refused(items: tuple[Item, ...], words: str) -> None:
    with pytest.raises(ValueError, match="must") as error:
        registry.check(items)
    assert words in str(error.value)


def test_what_is_needed_comes_first() -> None:
    items = (item("t-1", "table", "t-3"), item("t-2", "table"), item("t-3", "table", "t-2"))
    assert [one.id for one in registry.with_needed(items, items[:1])] == ["t-2", "t-3", "t-1"]


def test_the_real_registry_lists_every_module_and_every_maker_is_there() -> None:
    offering = set()
    for module in pkgutil.walk_packages(sealscope.thesis.__path__, "sealscope.thesis."):
        if hasattr(importlib.import_module(module.name), "ITEMS"):
            offering.add(module.name.removeprefix("sealscope.thesis."))
    assert offering == set(registry.MODULES)
    items = registry.collect()
    assert {3, 4, 5} <= {one.chapter for one in items}
    for one in items:
        name, function = one.make.split(":")
        assert callable(getattr(importlib.import_module(name), function)), one.make


# kept results


def test_a_second_call_makes_nothing(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "doubled", "t-1"))
    first = reproduce(["all"], "out", registry=items, jobs=1)
    second = reproduce(["all"], "out", registry=items, jobs=1)
    assert states(first) == {"t-1": "made", "t-2": "made"}
    assert states(second) == {"t-1": "kept", "t-2": "kept"}
    assert worked(tmp_path) == ["t-1", "t-2"]
    (table,) = second.products(second.entries[1])
    assert isinstance(table, Table)
    assert table.rows == ((2,),)


def test_an_edited_source_makes_its_items_and_those_that_need_them_anew(
    fakes: Path, edit: Callable[[str, str], None]
) -> None:
    other = fakes.with_name("other.py")
    other.write_text(fakes.read_text())
    items = (item("t-1", "table"), item("t-2", "doubled", "t-1"), Item("t-3", 5, "table", "", "fakes.other:table"))
    reproduce(["all"], "out", registry=items, jobs=1)
    edit("FACTOR = 1", "FACTOR = 10")
    again = reproduce(["all"], "out", registry=items, jobs=1)
    assert states(again) == {"t-1": "made", "t-2": "made", "t-3": "kept"}
    (table,) = again.products(again.entries[1])
    assert isinstance(table, Table)
    assert table.rows == ((20,),)


def test_changed_inputs_and_quick_make_anew(fakes: Path, tmp_path: Path) -> None:
    one = item("t-1", "table")
    reproduce(["all"], "out", registry=(one,), jobs=1)
    changed = Item(**{**one.__dict__, "inputs": (("rate", 500.0),)})
    assert states(reproduce(["all"], "out", registry=(changed,), jobs=1)) == {"t-1": "made"}
    assert states(reproduce(["all"], "out", registry=(changed,), jobs=1, quick=True)) == {"t-1": "made"}
    assert states(reproduce(["all"], "out", registry=(changed,), jobs=1, quick=True)) == {"t-1": "kept"}


def test_a_damaged_kept_file_is_made_anew(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"),)
    reproduce(["all"], "out", registry=items, jobs=1)
    (tmp_path / "out" / "kept" / "drawn" / "t-1.json").unlink()
    (tmp_path / "out" / "kept" / "items" / "t-1.npz").write_bytes(b"PK broken")
    assert states(reproduce(["all"], "out", registry=items, jobs=1)) == {"t-1": "made"}


def test_only_the_asked_items_and_their_needs_are_made(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "doubled", "t-1"), item("t-3", "table"))
    assert states(reproduce(["t-2"], "out", registry=items, jobs=1)) == {
        "t-1": "made",
        "t-2": "made",
        "t-3": "not made",
    }


def test_a_maker_may_ask_only_for_what_it_named(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "unknown_need"))
    outcome = reproduce(["all"], "out", registry=items, jobs=1)
    assert outcome.entries[1].reason == "t-2 must name t-1 among its needs to ask for its products"


def test_a_folder_in_use_is_refused(fakes: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "out")
    with held(store.kept / "lock"), pytest.raises(InputError, match="one call at a time"):
        reproduce(["all"], "out", registry=(item("t-1", "table"),), jobs=1)


def test_products_and_runs_survive_the_file(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 5)
    curve, image = Curve(t, t**2, "x", "A"), Image(t, t, np.eye(5), "z")
    panel = Panel("t [s]", "x", (curve,), "a", ((0.5, "here"),), image, (0.0, 1.0), log_y=True)
    numbers = (Number("n", float("nan"), "Pa"), Number("m", "text"))
    figure = Figure("fig-1", "One", (panel,), numbers, ("claim-1",), False, "note")
    claim = Claim("claim-1", "section 1", "It is.", "so", "so", "holds", "why")
    table = Table("t-1", "T", ("a", "b"), ((1, 2.5), ("x", None), (np.float64(0.5), True)))
    kept.save(tmp_path / "one.npz", (figure, claim, table))
    again = kept.load(tmp_path / "one.npz")
    assert again is not None
    assert again[1] == claim
    assert (again[2].id, again[2].rows) == ("t-1", ((1, 2.5), ("x", None), (0.5, True)))
    panel = again[0].panels[0]
    assert (panel.x_label, panel.marks, panel.x_range, panel.log_y) == ("t [s]", ((0.5, "here"),), (0.0, 1.0), True)
    np.testing.assert_array_equal(panel.curves[0].y, t**2)
    np.testing.assert_array_equal(panel.image.values, np.eye(5))
    assert np.isnan(again[0].numbers[0].value)
    assert again[0].resolved is False


def test_what_cannot_be_kept_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="must hold texts, numbers and arrays, got object"):
        kept.save(tmp_path / "one.npz", (object(),))
    with pytest.raises(TypeError, match="must hold numbers"):
        kept.save(tmp_path / "one.npz", (np.array([object()]),))
    assert list(tmp_path.iterdir()) == []


def test_the_sources_of_a_module_are_those_it_imports() -> None:
    found = {path.name for path in sources.reached("sealscope.thesis.engine.runs")}
    assert {"runs.py", "simulate.py", "experiment.py", "restrictors.py", "thesis.toml", "context.py"} <= found
    assert not {"chapter5.py", "page.py", "verdict.py"} & found
    assert {path.name for path in sources.reached("sealscope.thesis.engine.registry")} == {
        "registry.py",
        "errors.py",
        "items.py",
    } | {path.name for path in sources.reached("sealscope.thesis.engine.items")}


def test_without_the_sheet_items_that_need_it_are_left_out(
    fakes: Path, tmp_path: Path, write_sheet: Callable[..., Path]
) -> None:
    items = (item("t-1", "measured", needs_sheet=True), item("t-2", "perhaps_measured"), item("t-3", "table"))
    without = reproduce(["all"], "out", registry=items, jobs=1)
    assert states(without) == {"t-1": "left out", "t-2": "made", "t-3": "made"}
    assert without.entries[0].reason == MISSING
    sheet = write_sheet(tmp_path / "sheet")
    given = reproduce(["all"], "out", registry=items, jobs=1, sheet=sheet)
    assert states(given) == {"t-1": "made", "t-2": "made", "t-3": "kept"}
    write_sheet(sheet, 1.0)
    changed = reproduce(["all"], "out", registry=items, jobs=1, sheet=sheet)
    assert states(changed) == {"t-1": "made", "t-2": "made", "t-3": "kept"}
    (table,) = changed.products(changed.entries[0])
    assert isinstance(table, Table)
    assert table.rows == ((2.0,),)


def test_equal_runs_are_simulated_once_and_kept_exactly(
    fakes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sealscope.thesis.engine import runs

    calls = []
    real = runs.simulated
    monkeypatch.setattr(runs, "simulated", lambda *given: calls.append(given) or real(*given))
    first = reproduce(["fig-4.1"], "out", registry=(item("fig-4.1", "simulated"), item("fig-4.2", "simulated")), jobs=1)
    second = reproduce(["all"], "out", registry=(item("fig-4.1", "simulated"), item("fig-4.2", "simulated")), jobs=1)
    assert len(calls) == 1
    (fresh,), (loaded,) = first.products(first.entries[0]), second.products(second.entries[1])
    assert isinstance(fresh, Figure)
    assert isinstance(loaded, Figure)
    np.testing.assert_array_equal(fresh.panels[0].curves[0].y, loaded.panels[0].curves[0].y)
    assert fresh.resolved is True
