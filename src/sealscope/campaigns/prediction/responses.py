"""How detectors' changes answer to leaks: under instrument noise, on machines of a bench, or in a campaign's rows.

`noise_responses` simulates one run of each size and lays the noise of many leak-free records over all of them;
`bench_responses` runs machines drawn from a bench without a leak and with every size, so that the leak's effect is
compared under the same drifts and the same noise; `measured_responses` reads the rows of a campaign that has been run.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from sealscope.campaigns.cases.bound import in_lpm
from sealscope.campaigns.cases.case import CampaignCase
from sealscope.campaigns.cases.machines import experiment_of
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.execution.store import read_rows
from sealscope.campaigns.plans.duty import closing_values
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.prediction.detection import ChangeDetector, Responses, counted
from sealscope.diagnosis.calibration.scorers import Look, side_bounds
from sealscope.diagnosis.rms_change.blocks import QUANTITIES, mean_squares
from sealscope.errors import InputError, SealscopeError, SimulationFailed
from sealscope.parameters import Rig
from sealscope.physics.rig import OUTPUTS
from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.recordings.recording import Array
from sealscope.signals.details import Details, details
from sealscope.signals.filters import IntArray
from sealscope.simulation.courses import command_or_target
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import From, Leak
from sealscope.simulation.instruments import decimate, record
from sealscope.simulation.integrate import Trajectory, oversampling, trajectory
from sealscope.simulation.sensitivity import clean_channels
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.units import LITRE_PER_MINUTE

ProgressCallback = Callable[[str, float], None]
_T = TypeVar("_T")
#: Most machines drawn: days of work.
MOST_DRAWS = 100_000

#: Blocks of a half over which the noise is taken as independent.
BLOCKS = 16
#: Sizes of leaks that each machine of a bench is run with [L/min].
BENCH_SIZES = (0.002, 0.008, 0.032, 0.128)
#: Fewest machines or records for a scatter, and the largest share of the machines that may fail.
FEWEST, MOST_FAILED = 8, 0.25


def in_parallel(jobs: Sequence[Callable[[], _T]], label: str, progress: ProgressCallback) -> list[_T]:
    """Return the results of the jobs in their order.

    Compiled kernels run outside the interpreter's lock, so threads serve.
    """
    results: list[_T] = []
    progress(label, 0.0)
    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in futures:
                results.append(future.result())
                progress(label, len(results) / len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results


def _filtered(experiment: Experiment) -> Trajectory:
    """Return the leak-free trajectory at the recording's samples, pressures behind the anti-alias filter."""
    path, factor = trajectory(experiment, ()), oversampling(experiment)
    n = round(experiment.duration * experiment.rate)
    rows = path.rows[: n * factor : factor].copy()
    for name in PRESSURES:
        rows[:, OUTPUTS.index(name)] = decimate(path[name], factor, n)
    return Trajectory(path.t[: n * factor : factor], rows, path.method, path.step)


def instrument_noise(experiment: Experiment, records: int, seed: int) -> Array:
    """Return what the instruments add to the chamber pressures, (r, c, n) [Pa], in `records` leak-free records.

    It is the readings of the rig's own instruments less the truth, without samples that would be lost or stuck.
    """
    whole = {f"sensors.{name}.{fault}_rate": 0.0 for name in CHAMBERS for fault in ("stuck", "drop")}
    rig = experiment.rig.with_overrides(whole, source="varied for a prediction")
    times = experiment.sample_times()
    path, u = _filtered(experiment), experiment.commanded.volts(times)
    clean = np.stack([path[name] for name in CHAMBERS])
    noise = []
    for state in np.random.SeedSequence(seed).generate_state(records, np.uint32):
        reading = record(rig, path, u, 1, int(state))
        noise.append(np.stack([reading[name] for name in CHAMBERS]) - clean)
    return np.stack(noise)


def halves(n: int, rate: float) -> tuple[IntArray, IntArray]:
    """Return bounds (BLOCKS + 1,) of the blocks before and after the middle, over the samples that scorers compare."""
    sides = side_bounds(n, rate, n // 2)
    first, second = (np.linspace(start, stop, BLOCKS + 1).astype(np.int64) for start, stop in sides)
    return first, second


def _block_squares(runs: Sequence[Array], noise: Array, rate: float) -> tuple[Array, Array]:
    """Return the mean squares of the details in every block.

    Before the middle without a leak (r, c, B, 5), after it in each run (m + 1, r, c, B, 5). `runs`: noise-free
    pressures (c, n), the first without a leak; the transform is linear, so that each run and each noise (r, c, n) is
    transformed once.
    """
    first, second = halves(runs[0].shape[1], rate)
    shape = (len(noise), len(CHAMBERS), BLOCKS, len(QUANTITIES))
    before, after = np.empty(shape), np.empty((len(runs), *shape))

    def part(transformed: Details, bounds: IntArray) -> Array:
        return transformed.values[:, bounds[0] : bounds[-1]]

    def squares(transformed: Details, values: Array, bounds: IntArray) -> Array:
        cut = Details(
            values, values[0], transformed.edges, transformed.wavelet, transformed.transform, transformed.edge
        )
        return mean_squares(cut, bounds - bounds[0])

    for c in range(len(CHAMBERS)):
        free = details(runs[0][c])
        earlier = part(free, first).copy()
        later = [part(free, second).copy(), *(part(details(run[c]), second).copy() for run in runs[1:])]
        for k in range(len(noise)):
            transformed = details(noise[k, c])
            before[k, c] = squares(transformed, earlier + part(transformed, first), first)
            for i, clean in enumerate(later):
                after[i, k, c] = squares(transformed, clean + part(transformed, second), second)
    return before, after


def _variance(squares: Array) -> Array:
    """Return the relative variance over the records of a half's mean square, (..., c, 5).

    `squares`: of its blocks (..., r, c, B, 5).
    """
    variance = squares.var(axis=-4, ddof=1).mean(axis=-2) / BLOCKS
    return np.asarray(variance / squares.mean(axis=(-4, -2)) ** 2)


def noise_responses(
    experiment: Experiment,
    sizes: Sequence[float],
    detectors: Sequence[ChangeDetector],
    noise: Array,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Responses, float]:
    """Return the responses to leaks of about these `sizes` [L/min] from the middle on, under the `noise` alone.

    `noise` (r, c, n) [Pa]; also returned is the mean pressure difference [Pa] that drives the leaks. A half's mean
    square is the mean of its blocks', whose noise is independent (the filters reach over a thousandth of a block), so
    ``Var(change) = 1/4 sum_halves Var(mean square) / (mean square)^2`` with the variance of each block taken over the
    records: `BLOCKS` times the freedom that the records' changes alone would give.
    """
    middle, rate = experiment.duration / 2.0, experiment.rate
    runs, flows = [clean_channels(experiment)], []
    later = slice(runs[0].shape[1] // 2, None)

    def driving(run: Array) -> float:
        return float(np.mean(np.abs(run[0, later] - run[1, later])))

    dp = driving(runs[0])
    for number, size in enumerate(sizes, start=1):
        progress(number / (len(sizes) + 2))
        G = size * LITRE_PER_MINUTE / dp
        runs.append(clean_channels(experiment, (Leak("laminar", coefficient=G, opening=From(middle)),)))
        flows.append(in_lpm(G, driving(runs[-1])))
    progress((len(sizes) + 1) / (len(sizes) + 2))
    before, after = _block_squares(runs, noise, rate)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_before, log_after = (0.5 * np.log(squares.mean(axis=-2)) for squares in (before, after))
        mean = (log_after - log_before).mean(axis=1)
        scatter = np.sqrt(0.25 * (_variance(before) + _variance(after)))
        error = (log_after - log_after[0]).std(axis=1, ddof=1) / np.sqrt(len(noise))
    chosen = [(CHAMBERS.index(detector.chamber), QUANTITIES.index(detector.quantity)) for detector in detectors]

    def columns(table: Array) -> Array:
        return np.stack([table[:, c, q] for c, q in chosen], axis=1)

    freedom = 2 * BLOCKS * (len(noise) - 1)
    responses = Responses(np.array(flows), columns(mean), columns(scatter), len(noise), freedom, error=columns(error))
    return responses, dp


def _bench_plan(experiment: Experiment, profile: str, false_alarm: float) -> SimulatedPlan:
    """Return the campaign that the draws belong to: the experiment's rig on that bench, the leak from the middle on."""
    return SimulatedPlan(
        name="prediction",
        title="records of a prediction",
        rig=experiment.rig,
        profile=profile,
        duration_s=experiment.duration,
        onset_s=experiment.duration / 2.0,
        false_alarm=false_alarm,
        promise="average",
        confidence=0.95,
        seed=0,
        detectors=(),
        keep_recordings=False,
        records=(),
    )


def fixed_levels(experiment: Experiment) -> dict[str, str | float]:
    """Return what a draw must not change: the command, the throttles and every value that the caller set."""
    rows = [
        row
        for row in experiment.rig.table()
        if row.source.startswith("set by") or row.name in ("line.orifices", "line.closed_A", "line.closed_B")
    ]
    return {"command": str(experiment.command), **{row.name: row.value for row in rows}}


def _changes(experiment: Experiment, detectors: Sequence[ChangeDetector]) -> tuple[Array, float]:
    """Return each detector's signed change on a simulated record, and the mean leak [L/min] it had."""
    simulated = simulate_with_truth(experiment)
    look = Look(simulated.recording, experiment.duration / 2.0)
    return np.array([detector.change(look) for detector in detectors]), simulated.truth.mean_leak_lpm


def bench_responses(
    experiment: Experiment,
    profile: str,
    draws: int,
    seed: int,
    false_alarm: float,
    detectors: Sequence[ChangeDetector],
    progress: ProgressCallback = lambda label, share: None,
    sizes: Sequence[float] = BENCH_SIZES,
) -> Responses:
    """Return the responses over `draws` machines of the bench, with noise, drift and differences of machines.

    Raises InputError for too few draws or an unknown profile, SimulationFailed where more than a quarter of the
    machines cannot be simulated with this command.
    """
    if not FEWEST <= draws <= MOST_DRAWS:
        raise InputError(f"draws must be {FEWEST} to {MOST_DRAWS} machines, got {draws}")
    plan, levels = _bench_plan(experiment, profile, false_alarm), fixed_levels(experiment)
    problems: list[str] = []

    def draw(number: int) -> tuple[Array, Array] | None:
        """Return changes (m + 1, d) of one machine without a leak and with each size, and its mean leaks (m,)."""
        machine, noise = (int(state) for state in np.random.SeedSequence((seed, number)).generate_state(2, np.uint64))
        changes, flows = [], []
        try:
            for size in (0.0, *sizes):
                case = CampaignCase("prediction", machine, noise, "judge", size, "laminar", "", levels, 0)
                change, flow = _changes(replace(experiment_of(plan, case), x_0=experiment.x_0), detectors)
                changes.append(change)
                flows.append(flow)
        except InputError:
            raise
        except SealscopeError as error:
            problems.append(str(error))
            return None
        return np.stack(changes), np.array(flows[1:])

    label = f"{draws} machines of the bench"
    drawn = in_parallel([partial(draw, number) for number in range(draws)], label, progress)
    machines = [machine for machine in drawn if machine is not None]
    if len(problems) > MOST_FAILED * draws or len(machines) < FEWEST:
        raise SimulationFailed(f"{len(problems)} of {draws} machines of the bench could not be run: {problems[0]}")
    changes = np.stack([change for change, _ in machines])
    flows = np.mean([flow for _, flow in machines], axis=0)
    if not math.isfinite(float(flows.sum())) or np.any(np.diff(flows) <= 0):
        raise SimulationFailed("the leaks put in must rise in size, got mean flows that do not")
    return counted(flows, [changes[:, k] for k in range(changes.shape[1])], paired=True)


def _same_duty(row: CaseRow, command: str, rig: Rig) -> bool:
    """Return whether a row was run with this command and the rig's throttles; what did not vary counts as equal."""
    levels = row.levels
    if "command" in levels and str(command_or_target(str(levels["command"]))) != command:
        return False
    if "closed" not in levels:
        return True
    throttled = rig.line.orifices == "present"
    here = {
        "line.closed_A": rig.line.closed_A if throttled else 0.0,
        "line.closed_B": rig.line.closed_B if throttled else 0.0,
    }
    there = closing_values(levels["closed"])
    return all(abs(float(there[name]) - value) < 1e-9 for name, value in here.items())


def _scored_change(row: CaseRow, detector: ChangeDetector) -> float:
    """Return the change of the log RMS behind a row's scores, whichever side was scored; NaN where none was."""
    for side, sign in (("fell", -1.0), ("rose", 1.0)):
        score = row.scores.get(f"{detector.quantity} of {detector.chamber} {side}")
        if score is not None and score[0] is not None:
            return sign * score[0]
    return math.nan


def _change_table(rows: Iterable[CaseRow], detectors: Sequence[ChangeDetector]) -> Array:
    return np.array([[_scored_change(row, detector) for detector in detectors] for row in rows], dtype=np.float64)


def measured_responses(
    folder: Path, command: str, rig: Rig, duration: float, detectors: Sequence[ChangeDetector]
) -> Responses:
    """Return the responses from the rows in a campaign's folder that have this duty and length.

    Sizes are the mean leaks [L/min] that the records really had. A detector whose change was not scored in a row has
    no prediction. Raises InputError where too few rows fit.
    """
    rows = [
        row
        for row in read_rows(folder).values()
        if row.error is None
        and not row.fault
        and abs(float(row.place.get("duration_s", duration)) - duration) < 1.0
        and _same_duty(row, command, rig)
    ]
    groups: dict[float, list[CaseRow]] = {}
    for row in rows:
        groups.setdefault(row.leak_lpm, []).append(row)
    free = groups.pop(0.0, [])
    sizes = sorted(size for size, members in groups.items() if len(members) >= FEWEST)
    if len(free) < FEWEST or not sizes:
        most = max((len(members) for members in groups.values()), default=0)
        raise InputError(
            f"a campaign must hold {FEWEST} leak-free rows or more and as many of a leak with this command, throttles "
            f"and length, got {len(free)} and {most} ({folder})"
        )
    flows = [float(np.mean([row.flow_lpm or row.leak_lpm for row in groups[size]])) for size in sizes]
    tables = [_change_table(free, detectors), *(_change_table(groups[size], detectors) for size in sizes)]
    return counted(np.array(flows), tables, paired=False)
