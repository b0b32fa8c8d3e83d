"""Many cases of a plan at a time: simulated side by side, scored from the RMS of the details about the onset.

The scores are the same functions of the same samples as those of a recording (`scorers.Sides`); nothing else of a
record is there, so that a plan is refused where something asks for more. The solver's step of a case comes from a few
seconds of its machine.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from sealscope.campaigns.cases.case import CampaignCase, digest, world
from sealscope.campaigns.cases.machines import sized_once, sizing_run, unsized
from sealscope.campaigns.cases.row import CaseRow, error_text
from sealscope.campaigns.cases.scoring import score_sides
from sealscope.campaigns.plans.detectors import plan_detector
from sealscope.campaigns.plans.duty import fault_of
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.scorers import Sides, side_bounds
from sealscope.errors import InputError, SealscopeError
from sealscope.physics.solvers.limits import longest_step
from sealscope.recordings.chambers import CHAMBERS
from sealscope.signals.filters import IntArray
from sealscope.simulation.batch.batch import simulate_batch
from sealscope.simulation.batch.run import refuse, with_sizes
from sealscope.simulation.bench.profile import Profile, load_profile
from sealscope.simulation.courses import numbers_under
from sealscope.simulation.experiment import LONGEST_STEP, Experiment, choose_method
from sealscope.simulation.integrate import FINEST, oversampling, steps_per_output, trajectory

#: Runs of a batch, after each of which the rows are on disk.
RUNS = 256
#: Mode of rows of batches: they are not mixed with those of another mode, whose noise differs.
IN_BATCHES = "in batches"
#: Machines of a cell on which its step is chosen, and how long [s] each of them runs for that: the first window that
#: `integrate` checks, and two more.
SCOUTS, SCOUTED = 4, 4.0


def bounds_of(plan: SimulatedPlan) -> IntArray:
    """Compute the samples (2, 2) of a record that the scorers compare."""
    rate = plan.rig.daq.sample_rate
    return side_bounds(round(plan.duration_s * rate), rate, round(plan.onset_s * rate))


def check_plan(plan: SimulatedPlan, cases: Sequence[CampaignCase]) -> None:
    """Raise InputError for a request of a plan that no batch can carry out."""

    def no(rule: str) -> InputError:
        return InputError(f"a plan in batches must have {rule}; run it without --batch ({plan.place})")

    for name in plan.detectors:
        if plan_detector(name).scorer is None:
            raise no(
                f"detectors of the RMS on both sides of the onset alone, got {name!r}, which needs whole recordings"
            )
    if plan.keep_recordings:
        raise no("keep_recordings = false, got true")
    if np.diff(bounds_of(plan)).min() < 1:
        raise no(f"records with details on both sides of the onset, got {plan.duration_s:g} s with {plan.onset_s:g} s")
    for group in plan.records:
        if group.law == "mixture":
            raise no("leaks of one law each, got a mixture")
        fault = fault_of(group.fault, plan.onset_s) if group.fault else None
        if fault is not None and fault.row.of_sensor:
            raise no(f"no fault of a sensor, got {group.fault!r}")
    for case in {repr(case.levels): case for case in reversed(cases)}.values():  # one of each cell
        try:
            experiment = unsized(plan, case)
        except SealscopeError:  # then its row says so
            continue
        if experiment.rate != plan.rig.daq.sample_rate:
            raise no(f"one sampling rate, {plan.rig.daq.sample_rate:g} Hz, got {experiment.rate:g} Hz by a factor")
        try:
            refuse(experiment, 0)
        except InputError as error:
            raise no(f"runs that can stand side by side, got: {error}") from None


def in_batches(plan: SimulatedPlan, cases: Sequence[CampaignCase], threads: int) -> Generator[CaseRow, None, None]:
    """Yield the rows of the cases, batch by batch; a case that cannot be carried out costs no other.

    A row derives from its case alone, whatever stands beside it.
    """
    profile = load_profile(plan.profile) if plan.profile else None
    step_of = step_chooser(plan, profile)
    for start in range(0, len(cases), RUNS):
        started, batch = time.process_time(), cases[start : start + RUNS]
        pairs: list[tuple[CampaignCase, Experiment]] = []
        rows: list[CaseRow] = []
        for case in batch:
            try:
                experiment = unsized(plan, case, profile)
                pairs.append((case, replace(experiment, step=step_of(case, experiment))))
            except Exception as error:
                rows.append(CaseRow.from_case(case, error=error_text(error)))
        rows += _carried_out(plan, pairs, threads)
        seconds = round((time.process_time() - started) / len(batch), 4)
        yield from (replace(row, seconds=seconds) for row in rows)


def _carried_out(plan: SimulatedPlan, pairs: Sequence[tuple[CampaignCase, Experiment]], threads: int) -> list[CaseRow]:
    """Carry out one batch; where it fails, its halves, down to the run that is to blame."""
    if not pairs:
        return []
    bounds, rows = bounds_of(plan), []
    try:
        experiments = _sized([experiment for _, experiment in pairs], threads)
        batch = simulate_batch(experiments, bounds=bounds.ravel() / plan.rig.daq.sample_rate, threads=threads)
        for (case, _), rms, flow in zip(pairs, batch.rms, batch.mean_leak_lpm, strict=True):
            sides = Sides.from_squares(dict(zip(CHAMBERS, rms[:, [0, 2]] ** 2, strict=True)), bounds)
            scores = score_sides(sides, plan.detectors, plan.views)
            rows.append(CaseRow.from_case(case, flow_lpm=float(flow) if case.leak_lpm else 0.0, scores=scores))
        return rows
    except Exception as error:
        if len(pairs) == 1:
            return [CaseRow.from_case(pairs[0][0], error=error_text(error))]
    middle = len(pairs) // 2
    return _carried_out(plan, pairs[:middle], threads) + _carried_out(plan, pairs[middle:], threads)


def _sized(experiments: Sequence[Experiment], threads: int) -> list[Experiment]:
    """Choose steps that resolve the experiments' leaks, and size these side by side as `sized_once` does."""
    sized = list(experiments)
    leaky = [k for k, experiment in enumerate(experiments) if experiment.leaks]
    if not leaky:
        return sized
    short = [sizing_run(experiments[k]) for k in leaky]
    try:
        sizes = simulate_batch(short, threads=threads).coefficients.tolist()
    except SealscopeError:
        if len(experiments) > 1:  # halving finds the one that is to blame
            raise
        sizes = [leak.coefficient for leak in sized_once(replace(experiments[0], step=None))]
    for k, size in zip(leaky, sizes, strict=True):
        experiment = with_sizes(experiments[k], size)
        laminar = experiment.leaks[0].law == "laminar"
        numbers = numbers_under(experiment.rig, experiment.load)
        limit = longest_step(numbers, size if laminar else 0.0, 0.0 if laminar else size)
        if experiment.step is not None and experiment.step > limit:
            experiment = replace(experiment, step=dividing_step(experiment.rate * oversampling(experiment), limit))
        sized[k] = experiment
    return sized


def step_chooser(plan: SimulatedPlan, profile: Profile | None = None) -> Callable[[CampaignCase, Experiment], float]:
    """Build the function that chooses a case's step [s] from the case alone, independent of all others.

    It is what `integrate` chooses by error on `SCOUTS` machines of the case's cell with seeds of their own, the finest
    of those with its method, and no longer than its own machine allows.
    """
    shared = digest(world(plan))

    @cache
    def of_cell(*levels: tuple[str, str | float]) -> dict[str, float]:
        """Compute method -> step of a cell of the factors."""
        steps: dict[str, float] = {}
        for number in range(SCOUTS):
            content: dict[str, Any] = {"use": "calibrate", "leak_lpm": 0.0, "levels": dict(levels), "replicate": number}
            seed = int(digest([shared, dict(levels), f"scout {number}"])[:15], 16)
            try:
                method, step = _choose_method(
                    unsized(plan, CampaignCase(id="", machine_seed=seed, noise_seed=0, **content), profile)
                )
            except SealscopeError:  # a machine of the bench that cannot do this duty
                continue
            steps[method] = min(step, steps.get(method, math.inf))
        return steps

    def step_of(case: CampaignCase, experiment: Experiment) -> float:
        method = choose_method(experiment.rig, experiment.method)
        step = of_cell(*case.levels.items()).get(method) or _choose_method(experiment)[1]
        limit = max(longest_step(numbers_under(experiment.rig, experiment.load)), LONGEST_STEP / FINEST)
        return step if step <= limit else dividing_step(experiment.rate * oversampling(experiment), limit)

    return step_of


def dividing_step(rate: float, limit: float) -> float:
    """Compute the longest step [s] within `limit` [s] that divides the interval of outputs at `rate` [Hz]."""
    return 1.0 / (rate * steps_per_output(rate, limit))


def _choose_method(experiment: Experiment) -> tuple[str, float]:
    """Find the method and step [s] that `integrate` chooses over the first seconds of an experiment."""
    path = trajectory(replace(experiment, duration=min(experiment.duration, SCOUTED), leaks=()), ())
    return path.method, path.step
