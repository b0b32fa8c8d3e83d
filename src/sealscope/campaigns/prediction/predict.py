"""Predict the smallest leak that `diagnose` finds on a rig, before anyone measures.

Leak-free records of a rig, its instruments and a command are simulated; the detectors that make the verdict state what
each of them would have shown (`Passage.findable_lpm`, from the information of their blocks). Beside it stand the
thesis's rules (`rules`), which are given the onset, and the Cramer-Rao bound of the pressures. With a bench, every
record is a machine of its own that drifts as the bench says.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from sealscope.campaigns.cases.bound import in_lpm, leak_bound, smallest_found, unknown_of
from sealscope.campaigns.cases.case import CampaignCase
from sealscope.campaigns.cases.machines import experiment_of
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.scorers import Sides
from sealscope.campaigns.prediction.report import BoundFigures, DutyRow, FindableLeak, PredictionReport
from sealscope.campaigns.prediction.rules import DetectionTarget, change_of, smallest_leaks
from sealscope.diagnosis.diagnose import Examination
from sealscope.errors import InputError, SealscopeError, SimulationFailed
from sealscope.parameters import Rig
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.bench.machines import centred_start
from sealscope.simulation.commands import Command
from sealscope.simulation.courses import Position, command_or_target
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import From, Leak
from sealscope.simulation.instruments import record
from sealscope.simulation.integrate import oversampling, trajectory
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.units import LITRE_PER_MINUTE

ProgressCallback = Callable[[str, float], None]
_T = TypeVar("_T")
#: Detectors that make the verdict of `diagnose`, and the channels that each is given.
_JUDGES = {
    "volume balance": ("u", "theta", "omega", "x", "p_A", "p_B", "p_1", "p_2"),
    "pressure response": ("u", "p_A", "p_B"),
}
#: Probability of detection that `Passage.findable_lpm` states.
_FINDABLE = 0.9
#: The commands of the thesis's tests that are compared, and the closings of both throttles (None: no throttles).
STANDARD_COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)")
STANDARD_CLOSINGS = (None, 0.5)
#: Sizes of leaks that the thesis's rules are tried on [L/min], and on machines of a bench.
SIZES, BENCH_SIZES = (0.001, 0.002, 0.004, 0.008, 0.032, 0.128), (0.002, 0.008, 0.032, 0.128)
#: Leak-free records that the detectors are asked about, and records of each size for the rules.
RECORDS, RULE_RECORDS = 3, 24
#: Shortest record of a prediction [s]: each half must hold whole cycles of the slowest standard command.
SHORTEST = 20.0
#: How much of a command is looked at to centre its sweep [s].
LONGEST_LOOK = 1000.0
#: Fewest and most machines drawn from a bench, and the largest share of them that may fail.
FEWEST, MOST_DRAWS, MOST_FAILED = 8, 100_000, 0.25


def with_closing(rig: Rig, closing: float | None) -> Rig:
    """Return the rig without throttles, or with both closed by this share."""
    values: dict[str, float | str] = {"orifices": "absent"}
    if closing is not None:
        values = {"orifices": "present", "closed_A": closing, "closed_B": closing}
    return rig.with_overrides(values, source="varied for a prediction")


def closing_text(rig: Rig) -> str:
    """Return how the rig is throttled, as text."""
    if rig.line.orifices == "absent":
        return "none"
    a, b = (100.0 * closed for closed in (rig.line.closed_A, rig.line.closed_B))
    return f"{a:g} %" if a == b else f"{a:g} % at A, {b:g} % at B"


def experiment_for(rig: Rig, command: Command | str, duration: float, x_0: float | None = None) -> Experiment:
    """Return the leak-free experiment; `x_0` [m] by default such that the sweep's middle is at mid-stroke.

    Raises InputError for a record too short for a prediction, a target for the piston, and a valve-controlled rig.
    """
    if rig.valve.spool == "present":
        raise InputError(f"a prediction must be of a pump-controlled rig (valve.spool = absent), got {rig.name}")
    if not duration >= SHORTEST:
        raise InputError(f"duration must be >= {SHORTEST:g} s for a prediction, got {duration:g} s")
    parsed = command_or_target(command) if isinstance(command, str) else command
    if isinstance(parsed, Position):
        raise InputError(f"a prediction must be of a command in volts ('3 sin(4t)'), got a target ({parsed})")
    start = centred_start(rig, parsed, min(duration, LONGEST_LOOK)) if x_0 is None else x_0
    return Experiment(rig=rig, command=parsed, duration=duration, x_0=start)


def predict(
    experiment: Experiment,
    target: DetectionTarget | None = None,
    *,
    commands: Iterable[str] = STANDARD_COMMANDS,
    closings: Iterable[float | None] = STANDARD_CLOSINGS,
    bench: str = "",
    draws: int = 24,
    progress: ProgressCallback = lambda label, share: None,
) -> PredictionReport:
    """Predict for an experiment (`experiment_for`) the smallest leak that each detector finds, and the bound.

    The `commands` under every one of the `closings` are compared under instrument noise alone. `bench`: name or file
    of a profile of machines and drifts, of which `draws` machines are simulated; without it the rig is taken as it
    stands. Raises InputError for values that break a rule, SimulationFailed where the experiment itself cannot be
    simulated, or more than a quarter of the bench's machines.
    """
    target = target or DetectionTarget()
    if bench:
        records, sizes, changes = _of_bench(
            experiment, target, bench, draws, partial(progress, "machines of the bench")
        )
    else:
        records, sizes, changes = _of_rig(experiment, target, partial(progress, "records simulated"))
    found = _findable(records, experiment.rig, target)
    progress("records simulated", 1.0)
    bound = _bound(experiment, target, records[0], partial(progress, "bound"))
    duties = [(command, with_closing(experiment.rig, closing)) for command in commands for closing in closings]
    jobs = [partial(_duty, rig, command, experiment.duration, target) for command, rig in duties]
    return PredictionReport(
        rig=experiment.rig.name,
        overrides=experiment.describe()["overrides"],
        command=str(experiment.command),
        orifices=closing_text(experiment.rig),
        duration_s=experiment.duration,
        sample_rate_hz=experiment.rate,
        start_position_m=experiment.x_0,
        false_alarm=target.false_alarm,
        detection=target.detection,
        pressure_difference=_driving(records[0]),
        origin=f"machines and drifts of the profile {bench}" if bench else "instrument noise alone, no drift",
        records=len(records),
        largest=float(sizes.max(initial=0.0)),
        leaks=found,
        rules=smallest_leaks(sizes, changes, target, alike=not bench),
        bound=bound,
        duties=tuple(_in_parallel(jobs, partial(progress, "commands compared"))),
    )


def _driving(record: Recording) -> float:
    return float(np.mean(np.abs(record["p_A"] - record["p_B"])))


def _findable(records: Sequence[Recording], rig: Rig, target: DetectionTarget) -> tuple[FindableLeak, ...]:
    """Return the step of the leak that each judging detector finds, in the share `detection` of the records.

    It is stated for a probability of 0.9; as ``(threshold^(1/2) + z) s`` it scales to another.
    """
    from scipy.special import ndtri

    leaks = []
    examinations = [Examination(own, false_alarm_probability=target.false_alarm, rig=rig) for own in records]
    for name, channels in _JUDGES.items():
        sizes, reason = [], ""
        for examination in examinations:
            evidence = examination.through(channels).evidence(name)
            step = None if evidence.passage is None else evidence.passage.findable_lpm
            reason = reason or (evidence.reason if step is None else "")
            root = math.sqrt(max(evidence.threshold or 0.0, 0.0))
            ratio = (root + float(ndtri(target.detection))) / (root + float(ndtri(_FINDABLE)))
            sizes.append(math.inf if step is None else step * max(ratio, 0.0))
        smallest = float(np.quantile(sizes, target.detection, method="higher"))
        known = math.isfinite(smallest)
        leaks.append(FindableLeak(name, channels, smallest if known else None, "" if known else reason))
    return tuple(leaks)


def _changes(record: Recording, rules: Sequence[str]) -> Array:
    sides = Sides.of(record, float(record.t[0]) + record.duration / 2.0)
    return np.array([change_of(rule, sides) for rule in rules])


def _of_rig(
    experiment: Experiment, target: DetectionTarget, report: Callable[[float], None]
) -> tuple[list[Recording], Array, list[Array]]:
    """Return leak-free records, the sizes of the leaks [L/min], and the changes of the rules without a leak and with.

    Each size is simulated once, and read by the rig's instruments many times, with samples neither lost nor stuck.
    """
    whole = {f"sensors.{name}.{fault}_rate": 0.0 for name in ("p_A", "p_B") for fault in ("stuck", "drop")}
    rig = experiment.rig.with_overrides(whole, source="varied for a prediction")
    volts, factor = experiment.commanded.volts(experiment.sample_times()), oversampling(experiment)
    records: list[Recording] = []
    flows, changes = [], []
    for number, size in enumerate((0.0, *SIZES) if target.rules else (0.0,)):
        leaks: tuple[Leak, ...] = ()
        if size:
            G = size * LITRE_PER_MINUTE / _driving(records[0])
            leaks = (Leak("laminar", coefficient=G, opening=From(experiment.duration / 2.0)),)
        path = trajectory(replace(experiment, leaks=leaks), leaks)
        seeds = np.random.SeedSequence((target.seed, number)).generate_state(max(RECORDS, RULE_RECORDS), np.uint32)
        made = [record(rig, path, volts, factor, int(seed)) for seed in seeds[: None if target.rules else RECORDS]]
        if size:
            later = slice(len(made[0]) // 2, None)
            flows.append(in_lpm(G, float(np.mean(np.abs(made[0]["p_A"] - made[0]["p_B"])[later]))))
        else:
            records = made[:RECORDS]
        changes.append(np.stack([_changes(own, target.rules) for own in made]))
        report(0.9 * (number + 1) / (len(SIZES) + 1))
    return records, np.array(flows), changes


def _of_bench(
    experiment: Experiment, target: DetectionTarget, profile: str, draws: int, report: Callable[[float], None]
) -> tuple[list[Recording], Array, list[Array]]:
    """Return the same of machines drawn from a bench, each without a leak and with every size under the same drifts."""
    if not FEWEST <= draws <= MOST_DRAWS:
        raise InputError(f"draws must be {FEWEST} to {MOST_DRAWS} machines, got {draws}")
    plan = SimulatedPlan(
        name="prediction", title="", rig=experiment.rig, profile=profile, duration_s=experiment.duration,
        onset_s=experiment.duration / 2.0, false_alarm=target.false_alarm, promise="average", confidence=0.95, seed=0,
        detectors=(), keep_recordings=False, records=(),
    )  # fmt: skip
    levels, problems = fixed_levels(experiment), []

    def draw(number: int) -> tuple[Recording, Array, Array] | None:
        machine, noise = (
            int(state) for state in np.random.SeedSequence((target.seed, number)).generate_state(2, np.uint64)
        )
        runs = []
        try:
            for size in (0.0, *BENCH_SIZES):
                case = CampaignCase("prediction", machine, noise, "judge", size, "laminar", "", levels, 0)
                runs.append(simulate_with_truth(replace(experiment_of(plan, case), x_0=experiment.x_0)))
        except InputError:
            raise
        except SealscopeError as error:
            problems.append(str(error))
            return None
        changes = np.stack([_changes(run.recording, target.rules) for run in runs])
        return runs[0].recording, np.array([run.truth.mean_leak_lpm for run in runs[1:]]), changes

    drawn = _in_parallel([partial(draw, number) for number in range(draws)], report)
    machines = [machine for machine in drawn if machine is not None]
    if len(problems) > MOST_FAILED * draws or len(machines) < FEWEST:
        raise SimulationFailed(f"{len(problems)} of {draws} machines of the bench could not be run: {problems[0]}")
    changes = np.stack([own for _, _, own in machines], axis=1)
    return [own for own, _, _ in machines], np.mean([flows for _, flows, _ in machines], axis=0), list(changes)


def fixed_levels(experiment: Experiment) -> dict[str, str | float]:
    """Return what a draw must not change: the command, the throttles and every value that the caller set."""
    throttles = ("line.orifices", "line.closed_A", "line.closed_B")
    rows = [row for row in experiment.rig.table() if row.source.startswith("set by") or row.name in throttles]
    return {"command": str(experiment.command), **{row.name: row.value for row in rows}}


def _bound(
    experiment: Experiment, target: DetectionTarget, record: Recording, report: Callable[[float], None]
) -> BoundFigures:
    """Return the bound of the change between the halves, which has twice the variance of one half's."""
    half = replace(experiment, duration=experiment.duration / 2.0)
    bound = leak_bound(half, unknown=unknown_of(experiment.rig), progress=report)
    deviations = (math.sqrt(2.0) * in_lpm(own or bound.known, _driving(record)) for own in (bound.known, bound.unknown))
    known, unknown = (smallest_found(own, target.false_alarm, target.detection) for own in deviations)
    return BoundFigures(known, unknown, bound.unknown_parameters)


def _duty(rig: Rig, command: str, duration: float, target: DetectionTarget) -> DutyRow:
    """Return one line of the comparison; what cannot be simulated is said in its note."""
    try:
        record = simulate_with_truth(replace(experiment_for(rig, command, duration), seed=target.seed)).recording
        return DutyRow(command, closing_text(rig), _findable([record], rig, target))
    except SealscopeError as error:
        return DutyRow(command, closing_text(rig), (), str(error))


def _in_parallel(jobs: Sequence[Callable[[], _T]], report: Callable[[float], None]) -> list[_T]:
    """Return the results of the jobs in their order; compiled kernels run outside the interpreter's lock."""
    results: list[_T] = []
    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in futures:
                results.append(future.result())
                report(len(results) / len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
