"""The 41 tests of Appendix C run on the simulated rig, reduced to the RMS of the details before and after.

The same tests are run with their leak, with nothing leaking, and with nothing leaking on a rig that drifts. Records are
reduced at once and not kept: all of them would fill gigabytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Literal

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, details, mean_squares
from sealscope.signals.filters import reach
from sealscope.simulation.changes import ParameterDrift
from sealscope.simulation.commands import tabulated
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.engine.context import Context, first_table, simulated_run
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, ThesisTable
from sealscope.thesis.engine.texts import note, texts_of
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, UNITS, Condition, DataSheet, experiment_values
from sealscope.units import PSI

#: Length of the part without and of the part with the leak [s]; a quick reproduction takes the shorter one.
HALF, QUICK_HALF = 90.0, 40.0
#: What is left out of each record's beginning [s]: the rig starts at standstill, the thesis's was running.
SETTLING = 5.0
#: What happens at half time, and the seed of the first test of each kind of runs.
Runs = Literal["leak", "no-leak", "drift"]
_SEEDS: Mapping[Runs, int] = {"leak": 0, "no-leak": 1000, "drift": 2000}
#: RMS without and with what happened at half time, by chamber and quantity.
Pairs = Mapping[str, Mapping[str, tuple[float, ...]]]


def drawn_drifts(number: int, half: float, draw: int = 0) -> tuple[ParameterDrift, ...]:
    """Draw the drifts of a test's rig at half time: each share uniform within its bounds, up or down, independent."""
    random, drifting = np.random.default_rng([_SEEDS["drift"], draw, number]), texts_of("cases.toml")["drifts"].values()
    shares = [random.uniform(*part["shares"]) for part in drifting]
    signed_shares = random.choice([-1.0, 1.0], size=len(shares)) * shares
    return tuple(
        ParameterDrift(name, tabulated(np.array([half, half]), np.array([0.0, share])))
        for part, share in zip(drifting, signed_shares, strict=True)
        for name in part["parameters"]
    )


def leak_test(
    condition: Condition, half: float, seed: int, leak: bool = True, drifts: tuple[ParameterDrift, ...] = ()
) -> Experiment:
    """Build the run of a test: its command and throttles on the identified rig, its mean leak from half time on."""
    return Experiment.of(
        rig=BENCH_RIG,
        command=condition.command,
        set=experiment_values(condition),
        duration=2 * half,
        leak=f"{condition.mean_leak_lpm:g} L/min from {half:g} s" if leak else None,
        drifts=drifts,
        seed=seed,
    )


def experiments(kind: Runs, half: float, quick: bool) -> list[tuple[Condition, Experiment]]:
    """Build the runs of the tests of Appendix C; of a drift two draws each, one where it is `quick`."""
    runs = []
    for draw, condition in product(range(2 if kind == "drift" and not quick else 1), APPENDIX_C):
        drifts = drawn_drifts(condition.number, half, draw) if kind == "drift" else ()
        seed = _SEEDS[kind] + 100 * draw + condition.number
        runs.append((condition, leak_test(condition, half, seed, kind == "leak", drifts)))
    return runs


def _at_half_time(experiment: Experiment) -> str:
    """Describe the change at half time in words."""
    if experiment.leaks:
        return "leak opened"
    end = np.array(experiment.duration)
    factors = [f"{drift.parameter} x {1.0 + float(drift.shape.value_at(end)):.3f}" for drift in experiment.drifts]
    return ", ".join(factors) or "nothing"


def detail_rms(recording: Recording, parts: Sequence[tuple[float, float]]) -> dict[str, dict[str, tuple[float, ...]]]:
    """Compute the RMS of d1..d4 [psi] and d3d4 [psi^2] of both chambers within each part (from, to) [s].

    A part is narrowed by the transform's reach on both sides, so that no coefficient saw anything outside of it.
    """
    before, after = reach("db8", 4)[-1]
    bounds = np.round(np.array(parts) * recording.rate).astype(int) + np.array([before, -after])
    result = {}
    for chamber in CHAMBERS:
        squares = mean_squares(details(recording[chamber] / PSI), bounds.ravel())[::2]
        result[chamber] = {q: tuple(rms.tolist()) for q, rms in zip(QUANTITIES, np.sqrt(squares).T, strict=True)}
    return result


def pressure_range(values: Array) -> float:
    """Compute the 5 to 95 % range of a pressure."""
    return float(np.ptp(np.percentile(values, [5.0, 95.0])))


#: Chamber, quantity, half and head of the RMS columns.
_RMS_COLUMNS = [
    (chamber, name, k, f"{chamber} {name} {when} [{UNITS[name]}]")
    for chamber in CHAMBERS
    for name in QUANTITIES
    for k, when in enumerate(("no leak", "leak"))
]
COLUMNS = (
    *("test", "input", "closed [%]", "at half time", "mean leak [L/min]", "p_A range [MPa]", "p_B range [MPa]"),
    *(head for *_, head in _RMS_COLUMNS),
)


def row_of(
    condition: Condition, happened: str, mean_leak_lpm: float, ranges_MPa: Sequence[float], rms: Pairs
) -> tuple[Cell, ...]:
    """Build the row of a test under `COLUMNS`; `sheet_of` reads the RMS back."""
    values = (rms[chamber][name][k] for chamber, name, k, _ in _RMS_COLUMNS)
    return (condition.number, condition.command, condition.closed_pct, happened, mean_leak_lpm, *ranges_MPa, *values)


def column(table: ThesisTable, head: str) -> Array:
    """Return the numbers of one column of a table, NaN where there is none."""
    place = table.columns.index(head)
    return np.array([np.nan if row[place] is None else float(row[place]) for row in table.rows])  # type: ignore[arg-type]


def sheet_of(table: ThesisTable) -> DataSheet:
    """Read the RMS columns of a table of such rows as a sheet, in the table's order."""
    values = np.array([column(table, head) for *_, head in _RMS_COLUMNS]).reshape(len(CHAMBERS), len(QUANTITIES), 2, -1)
    return DataSheet({c: {q: values[k, j].T for j, q in enumerate(QUANTITIES)} for k, c in enumerate(CHAMBERS)})


def runs_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the 41 tests with their leak from half time on, without a change there, or with a drift.

    With the leak the first test of each condition is proved by halving the step, except in a quick reproduction.
    """
    half, kind = QUICK_HALF if context.quick else HALF, item.inputs["runs"]
    rows, proved = [], dict[tuple[str, float], bool | None]()
    for condition, experiment in experiments(kind, half, context.quick):
        prove = kind == "leak" and not context.quick and condition.group not in proved
        run = simulated_run(experiment, prove)
        if prove:
            proved[condition.group] = run.resolved
        rms = detail_rms(run.recorded, ((SETTLING, half), (half, 2 * half)))
        before = (run.t >= SETTLING) & (run.t < half)
        ranges = [pressure_range(run.outputs[chamber][before]) / 1e6 for chamber in CHAMBERS]
        rows.append(row_of(condition, _at_half_time(experiment), run.mean_leak_lpm, ranges, rms))
    proof = (
        "No run is proved (quick)." if context.quick else "One test of each condition is proved by halving the step."
    )
    drifts = texts_of("cases.toml")["drifts"]
    bounds = {
        name: "{:g} to {:g} %".format(*(100 * share for share in part["shares"])) for name, part in drifts.items()
    }
    detail_note = note(f"runs-{kind}", proof=proof, **bounds)
    notes = note("runs", rig=BENCH_RIG, half=half, quick=" (quick)" if context.quick else "", of=detail_note)
    return (item.table(rows, notes, COLUMNS, resolved=all(proved.values()) if proved else None),)


def simulated_sheet(context: Context, runs: Runs) -> tuple[ThesisTable, DataSheet]:
    """Return the table of the simulated tests (`leak`, `no-leak` or `drift`), and the sheet in it."""
    table = first_table(context, f"appendix-c-{runs}")
    return table, sheet_of(table)
