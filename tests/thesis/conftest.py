"""What makers may ask for, a small chapter of makers, and a made-up data sheet of the right form."""

from __future__ import annotations

import csv
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sealscope.recordings.channels import CHAMBERS
from sealscope.signals.details import QUANTITIES
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.chapters.appendix_c_runs import COLUMNS, make_row
from sealscope.thesis.engine.context import SimulatedRun, simulate_run
from sealscope.thesis.engine.items import Item, load_items
from sealscope.thesis.engine.products import Claim, Figure, Product, ThesisTable
from sealscope.thesis.sheet import APPENDIX_C, FILES, Condition, DataSheet, read_sheet

#: The folder of the measured sheet beside this checkout.
FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data"
needs_sheet = pytest.mark.skipif(
    not (FOLDER / FILES["p_A"]).is_file(), reason="../shared/data/appendix_c_pa.csv is absent"
)


ITEMS: dict[str, Item] = {item.id: item for item in load_items()}


class Kept:
    """A context that keeps its runs in memory and hands out the products that it was given."""

    quick = True

    def __init__(
        self,
        products: dict[str, tuple[Product | Claim, ...]] | None = None,
        sheet: DataSheet | None = None,
        runs: dict[tuple[str, bool], SimulatedRun] | None = None,
    ) -> None:
        self.products, self.sheet, self.runs = products or {}, sheet, {} if runs is None else runs

    def run(self, experiment: Experiment, *, prove: bool = True) -> SimulatedRun:
        of = experiment.key(), prove
        if of not in self.runs:
            self.runs[of] = simulate_run(experiment, prove)
        return self.runs[of]

    def product(self, item: str) -> tuple[Product | Claim, ...]:
        return self.products[item]


def numbers(figure: Figure) -> dict[str, float]:
    """The numbers behind a figure by name."""
    return {number.name: float(number.value) for number in figure.numbers}


def made_sheet(
    seed: int, shifts: dict[tuple[str, str], float] | None = None, scatter: float = 0.05, n: int = 41
) -> DataSheet:
    """A sheet whose log changes scatter about the stated shifts (0 elsewhere)."""
    random = np.random.default_rng(seed)
    rms: dict[str, dict[str, np.ndarray]] = {}
    for chamber in CHAMBERS:
        rms[chamber] = {}
        for name in QUANTITIES:
            before = np.exp(random.normal(0.5, 0.2, n))
            change = random.normal((shifts or {}).get((chamber, name), 0.0), scatter, n)
            rms[chamber][name] = np.column_stack([before, before * np.exp(change)])
    return DataSheet(rms)


def table_with(sheet: DataSheet, item: str, range_MPa: Callable[[Condition], float]) -> ThesisTable:
    """The table of the simulated tests, resolved, with the values of a sheet and a range of both pressures."""
    rows = []
    for k, condition in enumerate(APPENDIX_C):
        rms = {c: {q: tuple(sheet.rms[c][q][k].tolist()) for q in QUANTITIES} for c in CHAMBERS}
        rows.append(make_row(condition, "", condition.mean_leak_lpm, (range_MPa(condition),) * 2, rms))
    return ITEMS[item].table(rows, "", COLUMNS, resolved=True)


@pytest.fixture(scope="session")
def measured_sheet() -> DataSheet:
    """The measured sheet; for tests that are marked `needs_sheet`."""
    return read_sheet(FOLDER)[0]


CHAPTER = """
import os, time
from pathlib import Path
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.engine.products import Claim, FigureCurve, Figure, Panel, ThesisTable

def _note(item):
    with open(os.environ["FAKE_LOG"], "a") as log:
        log.write(item.id + "\\n")


def table(context, item):
    _note(item)
    return (ThesisTable(item.id, item.title, ("a", "b [Pa]"), ((1, 2.5), ("x", None))),)


def doubled(context, item):
    _note(item)
    tables = context.product(item.needs[0])
    return (ThesisTable(item.id, item.title, ("a",), ((2 * tables[0].rows[0][0],),)),)


def slow(context, item):
    time.sleep(0.4)
    _note(item)
    return (ThesisTable(item.id, item.title, ("a",), ((1,),)),)


def broken(context, item):
    _note(item)
    raise RuntimeError("no such curve\\nsecond line")


def odd(context, item):
    return (ThesisTable(item.id, item.title, ("a",), ((object(),),)),)


def interrupted(context, item):
    if not Path(os.environ["FAKE_LOG"] + ".go").exists():
        raise KeyboardInterrupt
    _note(item)
    return (ThesisTable(item.id, item.title, ("a",), ((1,),)),)


def dies(context, item):
    os._exit(3)


def unknown_need(context, item):
    return context.product("t-1")


def measured(context, item):
    _note(item)
    return (ThesisTable(item.id, item.title, ("d3",), ((float(context.sheet.rms["p_A"]["d3"][0, 0]),),)),)


def perhaps_measured(context, item):
    _note(item)
    return (ThesisTable(item.id, item.title, ("there",), ((context.sheet is not None,),)),)


def simulated(context, item):
    _note(item)
    run = context.run(Experiment.of(command="3 sin(4t)", duration=2.0))
    curve = FigureCurve(run.t, run.outputs["p_A"] / 1e6, "p_A", "A")
    return (Figure(item.id, item.title, (Panel("t [s]", "p_A [MPa]", (curve,)),), resolved=run.resolved),)
"""


@pytest.fixture
def fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A chapter of makers that note each time they work; gives its file."""
    package = tmp_path / "path" / "fakes"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "chapter.py").write_text(CHAPTER)
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "log"))
    monkeypatch.delenv("SEALSCOPE_SHEET", raising=False)
    monkeypatch.chdir(tmp_path)
    for name in [name for name in sys.modules if name.split(".")[0] == "fakes"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    return package / "chapter.py"


def _write_sheet(folder: Path, shift: float = 0.0) -> Path:
    """A sheet of the right form with made-up values."""
    folder.mkdir(exist_ok=True)
    for name in FILES.values():
        rows = []
        for test in APPENDIX_C:
            amplitude, rest = test.command.split(" sin(")
            row = {
                "mean_leak_lpm": test.mean_leak_lpm,
                "input_amplitude_v": amplitude,
                "input_omega_rad_s": rest.removesuffix("t)") or "1",
                "orifice_closed_pct": test.closed_pct,
                "leakage_level": test.level,
            }
            row |= {f"{one}_{when}": 1.0 + shift for one in QUANTITIES for when in ("no_leak", "leak")}
            rows.append(row)
        with (folder / name).open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    return folder


@pytest.fixture
def write_sheet() -> Callable[..., Path]:
    """Write a made-up sheet into a folder (second argument: what its values are above 1) and give the folder."""
    return _write_sheet
