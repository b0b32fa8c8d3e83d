"""Simulate many cases of a plan side by side, and score them from the RMS of the wavelet details around the onset.

A batch stores nothing else of a record, so a plan that needs more is refused. The solver's step of a case is chosen on
short runs of machines with the same levels of the factors.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from sealscope.campaigns.cases.case import CampaignCase, digest, shared_inputs
from sealscope.campaigns.cases.machines import experiment_with_flow_leak, size_leaks_on_short_run, sizing_experiment
from sealscope.campaigns.cases.row import CaseRow, error_text
from sealscope.campaigns.cases.scoring import score_details
from sealscope.campaigns.plans.detectors import parse_detector_name
from sealscope.campaigns.plans.duty import parse_plan_fault
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.scorers import log_rms_of_squares, split_bounds
from sealscope.errors import InputError, SealscopeError
from sealscope.physics.solvers.limits import longest_step
from sealscope.recordings.chambers import CHAMBERS
from sealscope.signals.filters import IntArray
from sealscope.simulation.batch.batch import simulate_batch
from sealscope.simulation.batch.run import refuse_unbatchable, with_leak_coefficient
from sealscope.simulation.experiment import LONGEST_STEP, Experiment, choose_method
from sealscope.simulation.integrate import MAX_STEP_REFINEMENT, integrate_run, oversampling, steps_per_output
from sealscope.simulation.targets_and_loads import loaded_rig_numbers

#: Number of runs in a batch; the rows are stored after each batch.
BATCH_SIZE = 256
#: Mode of rows from batches. Their noise differs from that of single runs, so the two are not combined.
IN_BATCHES = "in batches"
#: The solver's step of a cell (a combination of levels) is chosen on a few "scout" machines: their number, and the
#: length [s] of their runs, which have two of the windows in which `integrate_run` checks its error.
N_SCOUT_MACHINES, SCOUT_SECONDS = 4, 4.0


def scored_bounds(plan: SimulatedPlan) -> IntArray:
    """Compute the usable samples before and after the planned onset: (2, 2), a row [begin, end) for each side."""
    rate = plan.rig.daq.sample_rate
    return split_bounds(round(plan.duration_s * rate), rate, round(plan.onset_s * rate))


def check_plan(plan: SimulatedPlan, cases: Sequence[CampaignCase]) -> None:
    """Check that batches can simulate and score all cases of a plan; raise InputError otherwise.

    The rules on single runs (`refuse_unbatchable`) are tested on the first case of each combination of levels, leak and
    fault.
    """

    def refusal(rule: str) -> InputError:
        """Build the error for a plan that breaks a `rule` of batches."""
        return InputError(f"a plan in batches must have {rule}; run it without --batch ({plan.place})")

    for name in plan.detectors:
        if parse_detector_name(name).scorer is None:
            raise refusal(
                f"detectors that need only the RMS before and after the onset, got {name!r}, which needs the recording"
            )
    if plan.keep_recordings:
        raise refusal("keep_recordings = false, got true")
    if np.diff(scored_bounds(plan)).min() < 1:
        lengths = f"a duration of {plan.duration_s:g} s and an onset at {plan.onset_s:g} s"
        raise refusal(f"details before and after the onset, got {lengths}")
    for group in plan.records:
        if group.law == "mixture":
            raise refusal("leaks of one law each, got a mixture")
        fault = parse_plan_fault(group.fault, plan.onset_s) if group.fault else None
        if fault is not None and fault.row.is_sensor_fault:
            raise refusal(f"no fault of a sensor, got {group.fault!r}")
    # reversed: of equal cases the first remains
    first_cases = {repr((case.levels, case.leak_lpm, case.fault)): case for case in reversed(cases)}
    for case in first_cases.values():
        try:
            experiment = experiment_with_flow_leak(plan, case)
        except SealscopeError:  # the row of the case will state the error
            continue
        rate = plan.rig.daq.sample_rate
        if experiment.rate != rate:
            raise refusal(f"one sampling rate, {rate:g} Hz, got {experiment.rate:g} Hz by a factor")
        try:
            refuse_unbatchable(experiment, row=0)  # `row`: number of the run in the message
        except InputError as error:
            raise refusal(f"runs that can be simulated side by side, got: {error}") from None


def iter_batch_rows(plan: SimulatedPlan, cases: Sequence[CampaignCase], threads: int) -> Generator[CaseRow, None, None]:
    """Simulate the cases of a plan batch by batch, and yield a row with the scores, or the error, for each case.

    A row depends on other cases of its batch only where the common search for leakage coefficients converges badly
    (`simulate_batch`). In each batch, the cases whose experiment cannot be built come first.
    """
    choose_step = make_step_chooser(plan)
    for start in range(0, len(cases), BATCH_SIZE):
        start_time, batch = time.process_time(), cases[start : start + BATCH_SIZE]
        pairs: list[tuple[CampaignCase, Experiment]] = []
        rows: list[CaseRow] = []
        for case in batch:
            try:
                experiment = experiment_with_flow_leak(plan, case)
                pairs.append((case, replace(experiment, step=choose_step(case, experiment))))
            except Exception as error:  # a defect of one case must not end the campaign
                rows.append(CaseRow.from_case(case, error=error_text(error)))
        rows += _run_batch(plan, pairs, threads)
        seconds = round((time.process_time() - start_time) / len(batch), 4)
        yield from (replace(row, seconds=seconds) for row in rows)


def _run_batch(plan: SimulatedPlan, pairs: Sequence[tuple[CampaignCase, Experiment]], threads: int) -> list[CaseRow]:
    """Simulate and score one batch of cases, each with its experiment, and return their rows.

    If the batch fails, its two halves are run separately, and so on, until only the failing cases have an error.
    """
    if not pairs:
        return []
    bounds, rows = scored_bounds(plan), []
    try:
        experiments = _size_leaks([experiment for _, experiment in pairs], threads)
        batch = simulate_batch(experiments, bounds=bounds.ravel() / plan.rig.daq.sample_rate, threads=threads)
        for (case, _), rms, flow in zip(pairs, batch.rms, batch.mean_leak_lpm, strict=True):
            # of the three intervals between bounds, 0 and 2 are the two parts, and 1 is the gap between them
            squares = dict(zip(CHAMBERS, rms[:, [0, 2]] ** 2, strict=True))  # mean squares by chamber
            scores = score_details(log_rms_of_squares(squares, bounds), plan)
            rows.append(CaseRow.from_case(case, flow_lpm=float(flow) if case.leak_lpm else 0.0, scores=scores))
        return rows
    except Exception as error:
        if len(pairs) == 1:
            return [CaseRow.from_case(pairs[0][0], error=error_text(error))]
    middle = len(pairs) // 2
    return _run_batch(plan, pairs[:middle], threads) + _run_batch(plan, pairs[middle:], threads)


def _size_leaks(experiments: Sequence[Experiment], threads: int) -> list[Experiment]:
    """Find the leak coefficients that give the planned mean flows, in short runs; return the completed experiments.

    Each has at most one leak (`check_plan`). A solver's step that is unstable with the leak is shortened. If the short
    runs fail, the error is raised; only a single experiment is tried again, with a step that `integrate_run` chooses.
    """
    sized_experiments = list(experiments)
    leaky = [k for k, experiment in enumerate(experiments) if experiment.leaks]
    if not leaky:
        return sized_experiments
    short_runs = [sizing_experiment(experiments[k]) for k in leaky]
    try:
        coefficients = simulate_batch(short_runs, threads=threads).coefficients.tolist()
    except SealscopeError:
        if len(experiments) > 1:  # `_run_batch` then bisects the batch to find the failing experiment
            raise
        coefficients = [leak.coefficient for leak in size_leaks_on_short_run(replace(experiments[0], step=None))]
    for k, coefficient in zip(leaky, coefficients, strict=True):
        experiment = with_leak_coefficient(experiments[k], coefficient)
        # coefficients of a laminar leak and of an orifice
        G, C = (coefficient, 0.0) if experiment.leaks[0].law == "laminar" else (0.0, coefficient)
        limit = longest_step(loaded_rig_numbers(experiment.rig, experiment.load), G, C)
        if experiment.step is not None and experiment.step > limit:
            experiment = replace(experiment, step=_dividing_step(experiment, limit))
        sized_experiments[k] = experiment
    return sized_experiments


def make_step_chooser(plan: SimulatedPlan) -> Callable[[CampaignCase, Experiment], float]:
    """Build the function that chooses the solver's step [s] of a case from the case and its experiment.

    All cases with the same levels of the factors (a cell) share the search. `N_SCOUT_MACHINES` machines are drawn for
    the cell, and on a short run of each, `integrate_run` chooses the longest step that passes its check of the error. A
    case gets the shortest of the steps chosen for machines with its own solver, shortened to the longest stable one of
    its machine, but to no less than about `LONGEST_STEP` / `MAX_STEP_REFINEMENT`.
    """
    shared = digest(shared_inputs(plan))

    @cache
    def cell_steps(*levels: tuple[str, str | float]) -> dict[str, float]:
        """Compute the shortest step [s] chosen on the machines drawn for a cell; return it for each solver.

        `levels`: pairs (factor, level) of the cell. A solver is missing if no machine with it could be simulated.
        """
        steps: dict[str, float] = {}
        for number in range(N_SCOUT_MACHINES):
            content: dict[str, Any] = {"use": "calibrate", "leak_lpm": 0.0, "levels": dict(levels), "replicate": number}
            seed = int(digest([shared, dict(levels), f"scout {number}"])[:15], 16)  # 15 hex digits: 60 bits
            try:
                scout = CampaignCase(id="", machine_seed=seed, noise_seed=0, **content)
                method, step = _choose_method_and_step(experiment_with_flow_leak(plan, scout))
            except SealscopeError:  # this machine cannot follow the cell's command
                continue
            steps[method] = min(step, steps.get(method, math.inf))
        return steps

    def choose_step(case: CampaignCase, experiment: Experiment) -> float:
        """Choose the solver's step [s] of a case: the step of its cell, limited to the longest stable step."""
        step = cell_steps(*case.levels.items()).get(choose_method(experiment.rig, experiment.method))
        if step is None:  # no machine drawn for the cell has the case's solver
            _, step = _choose_method_and_step(experiment)
        stable_step = longest_step(loaded_rig_numbers(experiment.rig, experiment.load))
        limit = max(stable_step, LONGEST_STEP / MAX_STEP_REFINEMENT)
        return step if step <= limit else _dividing_step(experiment, limit)

    return choose_step


def _dividing_step(experiment: Experiment, limit: float) -> float:
    """Compute the longest step [s] <= `limit` [s] that divides the time between a run's outputs into equal parts."""
    rate = experiment.rate * oversampling(experiment)
    return 1.0 / (rate * steps_per_output(rate, limit))


def _choose_method_and_step(experiment: Experiment) -> tuple[str, float]:
    """Choose the solver's method and step [s] by running the first `SCOUT_SECONDS` of an experiment without leaks."""
    duration = min(experiment.duration, SCOUT_SECONDS)
    run = integrate_run(replace(experiment, duration=duration, leaks=()), leaks=())
    return run.method, run.step
