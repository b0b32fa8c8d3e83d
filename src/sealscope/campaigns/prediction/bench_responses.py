"""How detectors answer to leaks on machines drawn from a bench: each draw is run without a leak and with every size, so
that the leak's effect is seen beside the same drifts and the same noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sealscope.campaigns.cases.case import Case
from sealscope.campaigns.cases.machines import experiment_of
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.prediction.detection import ChangeDetector, Responses, counted
from sealscope.diagnosis.calibration.scorers import Look
from sealscope.errors import InputError, SealscopeError, SimulationFailed
from sealscope.recordings.recording import Array
from sealscope.simulation.experiment import Experiment

#: Sizes of leaks that each machine is run with [L/min].
BENCH_SIZES = (0.002, 0.008, 0.032, 0.128)
#: Fewest machines for a scatter, and the largest share of them that may fail.
FEWEST, MOST_FAILED = 8, 0.25


def bench_plan(experiment: Experiment, profile: str, false_alarm: float) -> SimulatedPlan:
    """The campaign that the draws belong to: the experiment's rig on that bench, the leak from the middle on."""
    return SimulatedPlan(
        name="plan",
        title="records of a plan",
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


def stated(experiment: Experiment) -> dict[str, str | float]:
    """What a draw must not change: the command, the throttles and every value that the caller set."""
    rows = [
        row
        for row in experiment.rig.table()
        if row.source.startswith("set by") or row.name in ("line.orifices", "line.closed_A", "line.closed_B")
    ]
    return {"command": str(experiment.command), **{row.name: row.value for row in rows}}


def _signed(experiment: Experiment, detectors: Sequence[ChangeDetector]) -> tuple[Array, float]:
    from sealscope.simulation.simulate import simulate_with_truth

    made = simulate_with_truth(experiment)
    look = Look(made.recording, experiment.duration / 2.0)
    return np.array([detector.change(look) for detector in detectors]), made.truth.mean_leak_lpm


def one_draw(
    plan: SimulatedPlan,
    experiment: Experiment,
    seed: tuple[int, int],
    sizes: Sequence[float],
    detectors: Sequence[ChangeDetector],
) -> tuple[Array, Array]:
    """Changes (m + 1, d) of one machine without a leak and with each size, and the mean leaks [L/min] (m,) it had."""
    changes, flows = [], []
    for size in (0.0, *sizes):
        case = Case("plan", *seed, "judge", size, "laminar", "", stated(experiment), 0)
        made, flow = _signed(replace(experiment_of(plan, case), x_0=experiment.x_0), detectors)
        changes.append(made)
        flows.append(flow)
    return np.stack(changes), np.array(flows[1:])


def bench_responses(
    experiment: Experiment,
    profile: str,
    draws: int,
    seed: int,
    false_alarm: float,
    detectors: Sequence[ChangeDetector],
    in_parallel: Callable[[Sequence[Callable[[], tuple[Array, Array] | None]]], list[tuple[Array, Array] | None]],
    sizes: Sequence[float] = BENCH_SIZES,
) -> Responses:
    """Means and scatters over `draws` machines of the bench; both contain noise, drift and differences of machines.

    Raises InputError for too few draws or an unknown profile, SimulationFailed where more than a quarter of the
    machines cannot be simulated with this command.
    """
    if draws < FEWEST:
        raise InputError(f"draws must be >= {FEWEST} machines, got {draws}")
    plan = bench_plan(experiment, profile, false_alarm)
    problems: list[str] = []

    def job(number: int) -> Callable[[], tuple[Array, Array] | None]:
        machine, noise = (int(one) for one in np.random.SeedSequence((seed, number)).generate_state(2, np.uint64))

        def work() -> tuple[Array, Array] | None:
            try:
                return one_draw(plan, experiment, (machine, noise), sizes, detectors)
            except InputError:
                raise
            except SealscopeError as error:
                problems.append(str(error))
                return None

        return work

    found = [one for one in in_parallel([job(number) for number in range(draws)]) if one is not None]
    if len(problems) > MOST_FAILED * draws or len(found) < FEWEST:
        raise SimulationFailed(f"{len(problems)} of {draws} machines of the bench could not be run: {problems[0]}")
    changes = np.stack([one[0] for one in found])
    flows = np.mean([one[1] for one in found], axis=0)
    if not math.isfinite(float(flows.sum())) or np.any(np.diff(flows) <= 0):
        raise SimulationFailed("the leaks put in must rise in size, got mean flows that do not")
    return counted(flows, [changes[:, k] for k in range(changes.shape[1])], paired=True)
