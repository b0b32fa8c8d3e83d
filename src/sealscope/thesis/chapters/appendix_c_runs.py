"""Simulate the 41 tests of Appendix C and reduce each to the RMS of the wavelet details in its two halves.

The tests are simulated with their leak, without any leak, and without a leak on a rig whose parameters drift. Only
the RMS is stored, because the recordings would take gigabytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Literal

import numpy as np

from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, details, mean_squares, reach
from sealscope.simulation.changes import ParameterDrift
from sealscope.simulation.commands import polyline_from_table
from sealscope.simulation.experiment import Experiment, throttle_values
from sealscope.thesis.engine.context import Context, first_table, simulate_run
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, ThesisTable
from sealscope.thesis.engine.texts import format_note, load_texts
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, UNITS, Condition, DataSheet
from sealscope.units import PSI

#: Length of the part without and of the part with the leak [s]; a quick reproduction takes the shorter one.
HALF, QUICK_HALF = 90.0, 40.0
#: Beginning of each record that is left out [s]: the simulated rig starts at standstill, the thesis's was running.
SETTLING = 5.0
#: Kind of runs, by what changes at half time, and a number for each kind to which the seeds of its tests are added.
Runs = Literal["leak", "no-leak", "drift"]
_SEEDS: Mapping[Runs, int] = {"leak": 0, "no-leak": 1000, "drift": 2000}
#: RMS before and after half time, by chamber and quantity.
RmsPairs = Mapping[str, Mapping[str, tuple[float, ...]]]


def draw_drifts(number: int, half: float, draw: int = 0) -> tuple[ParameterDrift, ...]:
    """Draw random steps of the rig's parameters at the time `half` [s] of a test, which simulate drift.

    The parameters of an entry under `drifts` in `cases.toml` step together, by a relative size drawn uniformly from the
    entry's range and with a random sign. The draw depends on the test's `number` and on `draw` (0, 1, ...) only.
    """
    rng = np.random.default_rng([_SEEDS["drift"], draw, number])
    drifts = load_texts("cases.toml")["drifts"].values()
    sizes = [rng.uniform(*drift["shares"]) for drift in drifts]
    changes = rng.choice([-1.0, 1.0], size=len(sizes)) * sizes
    # two points of a polyline at the same time are a step
    return tuple(
        ParameterDrift(name, polyline_from_table(np.array([half, half]), np.array([0.0, change])))
        for drift, change in zip(drifts, changes, strict=True)
        for name in drift["parameters"]
    )


def leak_test(
    condition: Condition, half: float, seed: int, *, leak: bool = True, drifts: tuple[ParameterDrift, ...] = ()
) -> Experiment:
    """Build the experiment of one test of Appendix C, with its leak open in the second half.

    `half`: half the duration [s]; `seed`: seed of the noise; `drifts`: changes of the rig's parameters within the test.
    """
    return Experiment.of(
        rig=BENCH_RIG,
        command=condition.command,
        set=throttle_values(condition.closed_pct / 100.0),
        duration=2 * half,
        leak=f"{condition.mean_leak_lpm:g} L/min from {half:g} s" if leak else None,
        drifts=drifts,
        seed=seed,
    )


def build_experiments(kind: Runs, half: float, quick: bool) -> list[tuple[Condition, Experiment]]:
    """Build the experiments of all tests of Appendix C; with drift, two draws of each test, or one if `quick`."""
    runs = []
    for draw, condition in product(range(2 if kind == "drift" and not quick else 1), APPENDIX_C):
        drifts = draw_drifts(condition.number, half, draw) if kind == "drift" else ()
        seed = _SEEDS[kind] + 100 * draw + condition.number  # there are fewer than 100 tests, so all seeds differ
        runs.append((condition, leak_test(condition, half, seed, leak=kind == "leak", drifts=drifts)))
    return runs


def _describe_change(experiment: Experiment) -> str:
    """Describe the change in the middle of a test: "leak opened", "nothing", or drifts as "fluid.K_oil x 0.970"."""
    if experiment.leaks:
        return "leak opened"
    end = np.array(experiment.duration)
    factors = [f"{drift.parameter} x {1.0 + float(drift.shape.value_at(end)):.3f}" for drift in experiment.drifts]
    return ", ".join(factors) or "nothing"


def part_detail_rms(recording: Recording, parts: Sequence[tuple[float, float]]) -> RmsPairs:
    """Compute the RMS of the wavelet details d1..d4 [psi] and d3d4 [psi^2] of both pressures in parts of a recording.

    `parts`: begin and end [s] of each part. Samples whose details depend on samples outside the part are left out.
    """
    before, after = reach("db8", 4)[-1]  # numbers of earlier and later samples on which d4 depends
    bounds = np.round(np.array(parts) * recording.rate).astype(int) + np.array([before, -after])
    result = {}
    for chamber in CHAMBERS:
        # every second interval between the bounds is a part; the others lie between two parts
        squares = mean_squares(details(recording[chamber] / PSI), bounds.ravel())[::2]
        result[chamber] = {q: tuple(rms.tolist()) for q, rms in zip(QUANTITIES, np.sqrt(squares).T, strict=True)}
    return result


def pressure_range(values: Array) -> float:
    """Compute the range of a pressure, in its unit, as the difference between its 95 % and 5 % quantiles."""
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


def make_row(
    condition: Condition, change: str, mean_leak_lpm: float, ranges_MPa: Sequence[float], rms: RmsPairs
) -> tuple[Cell, ...]:
    """Build the row of a test in a table with `COLUMNS`; `change`: at half time; `ranges_MPa`: in the first half."""
    values = (rms[chamber][name][k] for chamber, name, k, _ in _RMS_COLUMNS)
    return (condition.number, condition.command, condition.closed_pct, change, mean_leak_lpm, *ranges_MPa, *values)


def column(table: ThesisTable, head: str) -> Array:
    """Return the numbers in the column of a table with the head `head`; NaN for empty cells."""
    k = table.columns.index(head)
    return np.array([np.nan if row[k] is None else float(row[k]) for row in table.rows])  # type: ignore[arg-type]


def parse_sheet(table: ThesisTable) -> DataSheet:
    """Build the data sheet from a table of simulated tests, with one test per row and the columns `COLUMNS`."""
    # shape: (chambers, `QUANTITIES`, 2, tests), where 2 stands for the halves of a test: a leak opens at half time
    values = np.array([column(table, head) for *_, head in _RMS_COLUMNS]).reshape(len(CHAMBERS), len(QUANTITIES), 2, -1)
    return DataSheet({c: {q: values[k, j].T for j, q in enumerate(QUANTITIES)} for k, c in enumerate(CHAMBERS)})


def runs_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Simulate the 41 tests of Appendix C, and tabulate the RMS of their wavelet details in both halves.

    With the leak, the first test of each operating condition (command and closing) is proved by half the solver's step.
    A quick reproduction proves none, and has shorter halves.
    """
    half, kind = QUICK_HALF if context.quick else HALF, item.inputs["runs"]
    rows = []
    proved: dict[tuple[str, float], bool | None] = {}  # operating condition -> True if halving the step changed little
    for condition, experiment in build_experiments(kind, half, context.quick):
        prove = kind == "leak" and not context.quick and condition.group not in proved
        run = simulate_run(experiment, prove)
        if prove:
            proved[condition.group] = run.resolved
        rms = part_detail_rms(run.recorded, ((SETTLING, half), (half, 2 * half)))
        is_before = (run.t >= SETTLING) & (run.t < half)
        ranges = [pressure_range(run.outputs[chamber][is_before]) / 1e6 for chamber in CHAMBERS]
        rows.append(make_row(condition, _describe_change(experiment), run.mean_leak_lpm, ranges, rms))
    proof = "One test of each condition is proved by halving the step."
    if context.quick:
        proof = "No run is proved (quick)."
    bounds = {}  # name of a drift -> text of the sizes from which it is drawn
    for name, drift in load_texts("cases.toml")["drifts"].items():
        low, high = drift["shares"]
        bounds[name] = f"{100 * low:g} to {100 * high:g} %"
    detail_note = format_note(f"runs-{kind}", proof=proof, **bounds)
    notes = format_note("runs", rig=BENCH_RIG, half=half, quick=" (quick)" if context.quick else "", of=detail_note)
    return (item.table(rows, notes, COLUMNS, resolved=all(proved.values()) if proved else None),)


def simulated_sheet(context: Context, runs: Runs) -> tuple[ThesisTable, DataSheet]:
    """Return the simulated tests of Appendix C of the kind `runs`, as a table and as a data sheet."""
    table = first_table(context, f"appendix-c-{runs}")
    return table, parse_sheet(table)
