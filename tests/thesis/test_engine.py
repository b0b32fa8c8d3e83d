"""The loop of the reproduction: the list of items, what is kept between calls, when it is out of date, and calls
that are broken off, fail or lose a process."""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sealscope.errors import UnreadableFile
from sealscope.storage.plain_values import convert_type
from sealscope.storage.rows import lock_rows, read_rows, store_rows
from sealscope.thesis.engine import build, context
from sealscope.thesis.engine.build import ItemRow, ItemStatus, drop_curves, reproduce
from sealscope.thesis.engine.context import simulate_run
from sealscope.thesis.engine.items import Item, load_items, select_items
from sealscope.thesis.engine.products import Claim, Figure, FigureCurve, Image, Number, Panel, ThesisTable
from sealscope.thesis.sheet import MISSING

from ..refusals import refusal
from ..waiting import until


def nothing(context: object, item: Item) -> tuple[()]:
    return ()


def maker(name: str, module: str = "fakes.chapter") -> Any:
    """A maker of the fake chapter, as it stands now."""
    return getattr(importlib.import_module(module), name)


def bare(name: str, *needs: str, chapter: int = 4) -> Item:
    """An item that is listed and never made."""
    return Item(name, chapter, "table", f"Item {name}", nothing, needs=needs)


def item(name: str, make: str, *needs: str, **sheet: bool) -> Item:
    return Item(name, 4, "table", f"Item {name}", maker(make), needs=needs, **sheet)


def worked(tmp_path: Path) -> list[str]:
    """Which items were made, in order."""
    log = tmp_path / "log"
    return log.read_text().split() if log.exists() else []


def states(outcome: dict[str, ItemStatus]) -> dict[str, str]:
    return {name: status.state for name, status in outcome.items()}


# registry


def test_select_by_id_chapter_wildcard_and_all() -> None:
    items = (bare("t-1"), bare("fig-5.1"), bare("fig-5.2", chapter=5), bare("chapter-5-claims"))
    patterns = ("all", "chapter-5", "chapter-5-*", "fig-5.*", "t-1")
    assert {pattern: [one.id for one in select_items(items, [pattern])] for pattern in patterns} == {
        "all": ["t-1", "fig-5.1", "fig-5.2", "chapter-5-claims"],
        "chapter-5": ["fig-5.2"],
        "chapter-5-*": ["chapter-5-claims"],
        "fig-5.*": ["fig-5.1", "fig-5.2"],
        "t-1": ["t-1"],
    }


def test_an_unknown_id_names_the_closest() -> None:
    with refusal("'fig-5.9'", "fig-5.1"):
        select_items((bare("fig-5.1"), bare("t-1")), ["fig-5.9"])


def test_ids_are_unique_file_names_and_what_is_needed_exists_without_a_circle() -> None:
    items = load_items()
    assert len({of.id for of in items}) == len(items)
    assert all(re.fullmatch(r"[a-z0-9]+([-.][a-z0-9]+)*", of.id) for of in items)
    order = list(TopologicalSorter({of.id: of.needs for of in items}).static_order())
    assert set(order) == {of.id for of in items}
    assert {of.chapter for of in items} == {3, 4, 5, 6}


def test_what_is_needed_is_made_first(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "doubled", "t-3"), item("t-2", "table"), item("t-3", "doubled", "t-2"))
    assert states(reproduce(["t-1"], "out", items=items, jobs=1)) == dict.fromkeys(("t-1", "t-2", "t-3"), "made")
    assert worked(tmp_path) == ["t-2", "t-3", "t-1"]


# kept results


def test_a_second_call_makes_nothing(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "doubled", "t-1"))
    first = reproduce(["all"], "out", items=items, jobs=1)
    second = reproduce(["all"], "out", items=items, jobs=1)
    assert states(first) == {"t-1": "made", "t-2": "made"}
    assert states(second) == {"t-1": "kept", "t-2": "kept"}
    assert worked(tmp_path) == ["t-1", "t-2"]
    (table,) = second["t-2"].products
    assert isinstance(table, ThesisTable)
    assert table.rows == ((2,),)


def test_other_sources_make_everything_anew(fakes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    items = (item("t-1", "table"), item("t-2", "doubled", "t-1"))
    reproduce(["all"], "out", items=items, jobs=1)
    monkeypatch.setattr(build, "sources_key", lambda: "of an edited package")
    assert states(reproduce(["t-1"], "out", items=items, jobs=1)) == {"t-1": "made", "t-2": "not made"}


def test_changed_inputs_and_quick_make_anew(fakes: Path, tmp_path: Path) -> None:
    one = item("t-1", "table")
    reproduce(["all"], "out", items=(one,), jobs=1)
    changed = Item(**{**one.__dict__, "inputs": {"rate": 500.0}})
    assert states(reproduce(["all"], "out", items=(changed,), jobs=1)) == {"t-1": "made"}
    assert states(reproduce(["all"], "out", items=(changed,), jobs=1, quick=True)) == {"t-1": "made"}
    assert states(reproduce(["all"], "out", items=(changed,), jobs=1, quick=True)) == {"t-1": "kept"}


def test_a_lost_drawing_is_made_anew(fakes: Path, tmp_path: Path) -> None:
    def publish(of: Item, products: object, folder: Path) -> tuple[str, ...]:
        (folder / "drawn.txt").write_text(of.id)
        return ("drawn.txt",)

    items = (item("t-1", "table"),)
    reproduce(["all"], "out", items=items, jobs=1, publish=publish)
    assert states(reproduce(["all"], "out", items=items, jobs=1, publish=publish)) == {"t-1": "kept"}
    (tmp_path / "out" / "drawn.txt").unlink()
    assert states(reproduce(["all"], "out", items=items, jobs=1, publish=publish)) == {"t-1": "made"}
    assert (tmp_path / "out" / "drawn.txt").read_text() == "t-1"


def test_a_damaged_row_is_one_line_with_its_place(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "table"))
    reproduce(["all"], "out", items=items, jobs=1)
    rows = tmp_path / "out" / "kept" / "rows.jsonl"
    whole = rows.read_bytes()
    rows.write_bytes(whole[:-9])  # the last was being written when the power went
    assert states(reproduce(["all"], "out", items=items, jobs=1)) == {"t-1": "kept", "t-2": "made"}
    assert rows.read_bytes() == whole
    for damage in (b"PK" + whole, whole.replace(b'"columns"', b'"colours"'), b"[" * 10**5 + b"\n"):
        rows.write_bytes(damage)
        with refusal("rows.jsonl, line 1", error=UnreadableFile):
            reproduce(["all"], "out", items=items, jobs=1)


def test_only_the_asked_items_and_their_needs_are_made(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "doubled", "t-1"), item("t-3", "table"))
    assert states(reproduce(["t-2"], "out", items=items, jobs=1)) == {
        "t-1": "made",
        "t-2": "made",
        "t-3": "not made",
    }


def test_a_maker_may_ask_only_for_what_it_named(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "unknown_need"))
    outcome = reproduce(["all"], "out", items=items, jobs=1)
    assert outcome["t-2"].reason == "t-2 must list t-1 in `needs` to use the products of t-1"


def test_a_folder_in_use_is_refused(fakes: Path, tmp_path: Path) -> None:
    (tmp_path / "out" / "kept").mkdir(parents=True)
    with lock_rows(tmp_path / "out" / "kept", "x"), refusal("one process"):
        reproduce(["all"], "out", items=(item("t-1", "table"),), jobs=1)


def test_products_survive_the_file_but_for_what_is_drawn(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 5)
    panel = Panel("t [s]", "x", (FigureCurve(t, t**2, "x", "A"),), image=Image(t, t, np.eye(5), "z"))
    numbers = (Number("n", float("inf"), "Pa"), Number("m", "text"))
    figure = Figure("fig-1", "One", (panel,), numbers, ("claim-1",), False, "note")
    claim = Claim("claim-1", "section 1", "It is.", "so", "so", "holds", "why")
    table = ThesisTable("t-1", "T", ("a", "b"), ((1, 2.5), ("x", None), (np.float64(0.1), math.inf)))
    row = ItemRow("one", "key", tuple(map(drop_curves, (figure, claim, table))), ("a.svg",))
    with pytest.raises(ValueError, match="float"):
        list(store_rows(tmp_path, (of for of in [row]), "x"))
    list(store_rows(tmp_path, (of for of in [row]), "x", allow_nan=True))
    again = read_rows(tmp_path, lambda tree: convert_type(ItemRow, tree), "x", json.loads)["one"]
    assert again.files == ("a.svg",)
    assert again.products[1] == claim
    assert asdict(again.products[0]) == asdict(drop_curves(figure))
    assert (again.products[2].id, again.products[2].rows) == ("t-1", ((1, 2.5), ("x", None), (0.1, math.inf)))


def test_without_the_sheet_items_that_need_it_are_left_out(
    fakes: Path, tmp_path: Path, write_sheet: Callable[..., Path]
) -> None:
    items = (
        item("t-1", "measured", needs_sheet=True),
        item("t-2", "perhaps_measured", uses_sheet=True),
        item("t-3", "table"),
    )
    without = reproduce(["all"], "out", items=items, jobs=1)
    assert states(without) == {"t-1": "left out", "t-2": "made", "t-3": "made"}
    assert without["t-1"].reason == MISSING
    sheet = write_sheet(tmp_path / "sheet")
    given = reproduce(["all"], "out", items=items, jobs=1, sheet=sheet)
    assert states(given) == {"t-1": "made", "t-2": "made", "t-3": "kept"}
    write_sheet(sheet, 1.0)
    changed = reproduce(["all"], "out", items=items, jobs=1, sheet=sheet)
    assert states(changed) == {"t-1": "made", "t-2": "made", "t-3": "kept"}
    (table,) = changed["t-1"].products
    assert isinstance(table, ThesisTable)
    assert table.rows == ((2.0,),)


def test_equal_runs_are_simulated_once(fakes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setattr(context, "simulate_run", lambda *of: calls.append(of) or simulate_run(*of))
    drawn: dict[str, Any] = {}

    def publish(of: Item, products: Any, folder: Path) -> tuple[str, ...]:
        drawn[of.id] = products[0]
        return ()

    runs = tmp_path / "out" / "kept" / "runs"
    runs.mkdir(parents=True)
    (runs / "planted.run").write_bytes(b"a pickle of somebody else")
    items = tuple(item(f"fig-4.{k}", "simulated") for k in range(2))
    made = reproduce(["all"], "out", items=items, jobs=1, publish=publish)
    assert len(calls) == 1
    assert not runs.exists()
    fresh, loaded = (drawn[name].panels[0].curves[0].y for name in ("fig-4.0", "fig-4.1"))
    np.testing.assert_array_equal(fresh, loaded)
    assert [of.products[0].resolved for of in made.values()] == [True, True]


# calls that do not end well


def test_an_interrupt_leaves_what_was_finished(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "interrupted"), item("t-3", "table"))
    with pytest.raises(KeyboardInterrupt):
        reproduce(["all"], "out", items=items, jobs=1)
    assert worked(tmp_path) == ["t-1"]
    (tmp_path / "log.go").touch()
    assert states(reproduce(["all"], "out", items=items, jobs=1)) == {"t-1": "kept", "t-2": "made", "t-3": "made"}
    assert worked(tmp_path) == ["t-1", "t-2", "t-3"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)] if hasattr(signal, "SIGKILL") else []
)
def test_a_killed_call_is_taken_up_where_it_stopped(fakes: Path, tmp_path: Path, how: int) -> None:
    names = [f"t-{number}" for number in range(8)]
    script = tmp_path / "call.py"
    script.write_text(
        "from fakes.chapter import slow\nfrom sealscope.thesis.engine.build import reproduce\n"
        "from sealscope.thesis.engine.items import Item\n"
        "if __name__ == '__main__':\n"
        f"    items = tuple(Item(n, 4, 'table', 'Item ' + n, slow) for n in {names!r})\n"
        "    reproduce(['all'], 'out', items=items, jobs=2)\n"
    )
    paths = os.pathsep.join([str(fakes.parent.parent), *sys.path])
    call = subprocess.Popen(
        [sys.executable, str(script)], env={**os.environ, "PYTHONPATH": paths}, cwd=tmp_path, stderr=subprocess.DEVNULL
    )
    rows = tmp_path / "out" / "kept" / "rows.jsonl"

    def has_three_rows() -> bool:
        assert call.poll() is None, "it ended before it could be killed"
        return rows.is_file() and rows.read_bytes().count(b"\n") >= 3

    until(has_three_rows)
    call.send_signal(how)
    call.wait(20)
    time.sleep(1.0)  # workers of a killed parent end with it
    finished = {json.loads(line)["id"] for line in rows.read_bytes().splitlines()}
    assert 3 <= len(finished) < 8
    again = reproduce(["all"], "out", items=tuple(item(name, "slow") for name in names), jobs=2)
    assert {name for name, state in states(again).items() if state == "kept"} == finished
    assert {name for name, state in states(again).items() if state == "made"} == set(names) - finished


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=[pytest.mark.slow, pytest.mark.long])])
def test_a_failure_is_told_and_the_others_go_on(fakes: Path, tmp_path: Path, jobs: int) -> None:
    items = (item("t-0", "broken"), item("t-1", "table"), item("t-2", "doubled", "t-0"), item("t-3", "doubled", "t-1"))
    outcome = reproduce(["all"], "out", items=items, jobs=jobs)
    assert states(outcome) == {"t-0": "failed", "t-1": "made", "t-2": "failed", "t-3": "made"}
    assert outcome["t-0"].reason == "RuntimeError: no such curve"
    assert outcome["t-2"].reason == "needs t-0, which failed"
    assert "second line" in (tmp_path / "out" / "kept" / "rows.jsonl").read_text()


def test_what_cannot_be_stored_fails_alone(fakes: Path, tmp_path: Path) -> None:
    outcome = reproduce(["all"], "out", items=(item("t-0", "odd"), item("t-1", "table")), jobs=1)
    assert states(outcome) == {"t-0": "failed", "t-1": "made"}
    assert outcome["t-0"].reason.startswith("TypeError: ")


@pytest.mark.slow
@pytest.mark.long
def test_a_process_that_dies_takes_only_its_item(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "dies"), *(item(f"t-{number}", "table") for number in range(2, 6)))
    outcome = reproduce(["all"], "out", items=items, jobs=2)
    assert states(outcome) == {"t-1": "failed", "t-2": "made", "t-3": "made", "t-4": "made", "t-5": "made"}
    assert outcome["t-1"].reason == "the process that made it died"
