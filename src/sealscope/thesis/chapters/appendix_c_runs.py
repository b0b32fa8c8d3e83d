"""The 41 tests of Appendix C run on the simulated rig, reduced to the RMS of the details before and after.

The same tests are run with their leak, with nothing leaking, and with nothing leaking on a rig that drifts. Records are
reduced at once and not kept: all of them would fill gigabytes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from sealscope.parameters import Rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import details
from sealscope.signals.filters import reach
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import record
from sealscope.simulation.integrate import Trajectory, oversampling, sized_leaks, trajectory
from sealscope.simulation.leaks import from_time
from sealscope.simulation.simulate import prove, simulate_with_truth
from sealscope.thesis.engine.context import Context, first_table
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, ThesisTable
from sealscope.thesis.engine.texts import note
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, QUANTITIES, UNITS, Condition, DataSheet, experiment_values
from sealscope.units import PSI

#: Length of the part without and of the part with the leak [s]; a quick reproduction takes the shorter one.
HALF, QUICK_HALF = 90.0, 40.0
#: What is left out of each record's beginning [s]: the rig starts at standstill, the thesis's was running.
SETTLING = 5.0
#: How far friction, bulk modulus and noise drift between the halves of a leak-free test: least and greatest share.
FRICTION_DRIFT, BULK_DRIFT, NOISE_DRIFT = (0.04, 0.08), (0.03, 0.03), (0.04, 0.04)
#: Length of the run that a leak is sized on [s]; the mean over the test itself differs from it by 0.2 % at most.
_SIZING = 30.0
_DRIFT_SEED = 2000
#: RMS without and with what happened at half time, by chamber and quantity.
Pairs = Mapping[str, Mapping[str, tuple[float, ...]]]
#: A test as a row of the table, and whether its run passed the halving test (None: not made).
Simulated = tuple[tuple[Cell, ...], bool | None]


@dataclass(frozen=True)
class RigDrift:
    """Factors on friction, bulk modulus and noise of a rig that has drifted."""

    friction: float
    bulk: float
    noise: float

    def values(self, rig: Rig) -> dict[str, float]:
        """Return the drifted parameters by name, SI."""
        factors = {
            **dict.fromkeys(("friction.F_pr", "friction.F_cfr", "friction.F_v"), self.friction),
            "fluid.K_oil": self.bulk,
            **dict.fromkeys(("sensors.common_noise", "sensors.p_A.noise", "sensors.p_B.noise"), self.noise),
        }
        return {name: float(rig[name]) * factor for name, factor in factors.items()}


def draw_rig_drift(number: int, draw: int = 0) -> RigDrift:
    """Draw the drift of a test: each share uniform within its bounds, up or down with equal chance, independent."""
    random = np.random.default_rng([_DRIFT_SEED, draw, number])
    shares = [random.uniform(*bounds) for bounds in (FRICTION_DRIFT, BULK_DRIFT, NOISE_DRIFT)]
    signs = random.choice([-1.0, 1.0], size=3)
    return RigDrift(*(float(1.0 + sign * share) for sign, share in zip(signs, shares, strict=True)))


def detail_series(recording: Recording, chamber: str) -> dict[str, Array]:
    """Return d1..d4 [psi] and d3d4 [psi^2] of a chamber's pressure."""
    d = details(recording[chamber] / PSI)
    return {**{f"d{level}": d[level] for level in range(1, 5)}, "d3d4": d.product()}


def detail_rms(recording: Recording, parts: tuple[tuple[float, float], ...]) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return the RMS of d1..d4 [psi] and d3d4 [psi^2] of both chambers' pressures within each part (from, to) [s].

    A part is narrowed by the transform's reach on both sides, so that no coefficient saw anything outside of it.
    """
    before, after = (int(samples) for samples in reach("db8", 4)[-1])
    rate = recording.rate
    slices = [slice(round(start * rate) + before, round(stop * rate) - after) for start, stop in parts]
    return {
        chamber: {
            name: tuple(float(np.sqrt(np.mean(np.square(values[part])))) for part in slices)
            for name, values in detail_series(recording, chamber).items()
        }
        for chamber in CHAMBERS
    }


def pressure_range(values: Array) -> float:
    """Return the 5 to 95 % range of a pressure."""
    return float(np.ptp(np.percentile(values, [5.0, 95.0])))


def _range_MPa(t: Array, outputs: Mapping[str, Array] | Trajectory, stop: float) -> tuple[float, ...]:
    """Range of both chambers' true pressures [MPa] from the settled start to `stop` [s]."""
    part = (t >= SETTLING) & (t < stop)
    return tuple(pressure_range(outputs[chamber][part]) / 1e6 for chamber in CHAMBERS)


def _experiment(condition: Condition, duration: float, leak: str | None = None, seed: int = 0) -> Experiment:
    values = experiment_values(condition)
    return Experiment.of(rig=BENCH_RIG, command=condition.command, set=values, leak=leak, duration=duration, seed=seed)


def _recorded(experiment: Experiment, path: Trajectory) -> Recording:
    """Record a trajectory with the rig's instruments and the noise of the experiment's seed."""
    volts = experiment.commanded.volts(experiment.sample_times())
    return record(experiment.rig, path, volts, oversampling(experiment), experiment.seed)


def _leak_free_paths(duration: float) -> Callable[[Condition], Trajectory]:
    """Return what simulates an operating condition without a leak, each once for this call: a path is large."""

    @cache
    def path(command: str, closed_pct: float) -> Trajectory:
        return trajectory(_experiment(Condition(0, command, closed_pct, 0.0, ""), duration), ())

    return lambda condition: path(*condition.group)


def with_leak(half: float, quick: bool) -> Iterator[Simulated]:
    """Simulate the tests as they were: the leak opens at half time.

    The first test of each condition is proved by halving the step, except in a quick reproduction.
    """
    proved: set[tuple[str, float]] = set()
    for condition in APPENDIX_C:
        leak = f"{condition.mean_leak_lpm:g} L/min from {SETTLING:g} s"
        sized = sized_leaks(_experiment(condition, SETTLING + _SIZING, leak))
        leaks = tuple(replace(leak, opening=from_time(half)) for leak in sized)
        experiment = replace(_experiment(condition, 2 * half, seed=condition.number), leaks=leaks)
        simulated = simulate_with_truth(experiment)
        resolved = None
        if not quick and condition.group not in proved:
            proved.add(condition.group)
            resolved = prove(replace(experiment, allow_unresolved=True)).resolved
        rms, truth = detail_rms(simulated.recording, ((SETTLING, half), (half, 2 * half))), simulated.truth
        ranges = _range_MPa(truth.t, truth.outputs, half)
        yield row_of(condition, "leak opened", truth.mean_leak_lpm, ranges, rms), resolved


def without_leak(half: float, quick: bool) -> Iterator[Simulated]:
    """Simulate the same tests with no leak: nothing happens at half time; the noise alone differs."""
    paths = _leak_free_paths(2 * half)
    for condition in APPENDIX_C:
        path, experiment = paths(condition), _experiment(condition, 2 * half, seed=1000 + condition.number)
        rms = detail_rms(_recorded(experiment, path), ((SETTLING, half), (half, 2 * half)))
        yield row_of(condition, "nothing", 0.0, _range_MPa(path.t, path, half), rms), None


def with_drift(half: float, quick: bool) -> Iterator[Simulated]:
    """Simulate the same tests with no leak on a rig that drifts.

    The second half comes from a rig with other friction, bulk modulus and noise (`draw_rig_drift`), two draws of each
    test, one where it is `quick`.
    """
    length = SETTLING + half
    paths, part = _leak_free_paths(length), ((SETTLING, length),)
    for draw, condition in itertools.product(range(1 if quick else 2), APPENDIX_C):
        first = _experiment(condition, length, seed=_DRIFT_SEED + 100 * draw + condition.number)
        path, drift = paths(condition), draw_rig_drift(condition.number, draw)
        rig = first.rig.with_overrides(drift.values(first.rig), source="drifted")
        second = replace(first, rig=rig, seed=first.seed + 50_000)
        before = detail_rms(_recorded(first, path), part)
        after = detail_rms(_recorded(second, trajectory(second, ())), part)
        rms = {c: {name: (*before[c][name], *after[c][name]) for name in QUANTITIES} for c in CHAMBERS}
        happened = f"friction x {drift.friction:.3f}, K x {drift.bulk:.3f}, noise x {drift.noise:.3f}"
        yield row_of(condition, happened, 0.0, _range_MPa(path.t, path, length), rms), None


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
    """Return a test as a row under `COLUMNS`; `sheet_of` reads the RMS back."""
    of, values = condition, (rms[chamber][name][k] for chamber, name, k, _ in _RMS_COLUMNS)
    return (of.number, of.command, of.closed_pct, happened, mean_leak_lpm, *ranges_MPa, *values)


def column(table: ThesisTable, head: str) -> Array:
    """Return the numbers of one column of a table, NaN where there is none."""
    place = table.columns.index(head)
    return np.array([np.nan if row[place] is None else float(row[place]) for row in table.rows])  # type: ignore[arg-type]


def sheet_of(table: ThesisTable) -> DataSheet:
    """Read the RMS columns of a table of such rows as a sheet, in the table's order."""
    values = np.array([column(table, head) for *_, head in _RMS_COLUMNS]).reshape(len(CHAMBERS), len(QUANTITIES), 2, -1)
    return DataSheet({c: {q: values[k, j].T for j, q in enumerate(QUANTITIES)} for k, c in enumerate(CHAMBERS)})


def runs_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the 41 tests with their leak from half time on, with nothing happening there, or with a drift."""
    half, name = QUICK_HALF if context.quick else HALF, item.inputs["runs"]
    proof = (
        "No run is proved (quick)." if context.quick else "One test of each condition is proved by halving the step."
    )
    parts = {"friction": FRICTION_DRIFT, "bulk": BULK_DRIFT, "noise": NOISE_DRIFT}
    bounds = {part: f"{100 * low:g} to {100 * high:g} %" for part, (low, high) in parts.items()}
    of = note(f"runs-{name}", proof=proof, **bounds)
    notes = note("runs", rig=BENCH_RIG, half=half, quick=" (quick)" if context.quick else "", of=of)
    rows, tested = zip(*_RUNS[name](half, context.quick), strict=True)
    outcomes = [passed for passed in tested if passed is not None]
    return (item.table(rows, notes, COLUMNS, resolved=all(outcomes) if outcomes else None),)


def simulated_sheet(context: Context, runs: str) -> tuple[ThesisTable, DataSheet]:
    """Return the table of the simulated tests (`leak`, `no-leak` or `drift`), and the sheet in it."""
    table = first_table(context, f"appendix-c-{runs}")
    return table, sheet_of(table)


#: What simulates each kind of runs.
_RUNS = {"leak": with_leak, "no-leak": without_leak, "drift": with_drift}
