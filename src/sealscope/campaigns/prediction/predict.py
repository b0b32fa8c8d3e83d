"""Predict the smallest leak that each detector will find on a rig, with the Cramer-Rao bound beside it.

A record of T seconds has the leak from its middle on. The rig is simulated with leaks of rising size; the instruments'
own noise is laid over it many times; the scorers judge the records as a campaign's would. With a bench, every record
is a machine of its own that drifts as the bench says, and the scatter holds both. The detectors that make the verdict
of `diagnose` are asked what they would find (`judges`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from sealscope.campaigns.cases.bound import (
    LeakBound,
    in_lpm,
    leak_bound,
    noise_covariance,
    smallest_found,
    unknown_of,
)
from sealscope.campaigns.prediction.detection import THESIS_DETECTORS, ChangeDetector, Responses, smallest_leaks
from sealscope.campaigns.prediction.judges import judge_predictions
from sealscope.campaigns.prediction.report import BoundFigures, CommandRow, PredictionReport
from sealscope.campaigns.prediction.responses import (
    ProgressCallback,
    bench_responses,
    in_parallel,
    instrument_noise,
    measured_responses,
    noise_responses,
)
from sealscope.errors import InputError, SealscopeError
from sealscope.parameters import Rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.bench.machines import centred_start
from sealscope.simulation.commands import Command
from sealscope.simulation.courses import Position, command_or_target
from sealscope.simulation.experiment import Experiment

#: The commands of the thesis's tests that are compared, and the closings of both throttles (None: no throttles).
STANDARD_COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)")
STANDARD_CLOSINGS = (None, 0.25, 0.50, 0.75)
#: Sizes of leaks that are simulated [L/min]; a prediction never goes beyond the largest.
SIZES = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)
TABLE_SIZES = (0.001, 0.004, 0.012, 0.032)
#: Shortest record of a prediction [s]: each half must hold whole cycles of the slowest standard command.
SHORTEST = 20.0
#: How much of a command is looked at to centre its sweep [s].
LONGEST_LOOK = 1000.0
#: Noise records laid over the run: for the rig's own command, and for each row of the table.
NOISES, TABLE_NOISES = 48, 8
#: Most values of noise held in memory (8 bytes each).
MOST_NOISE = 3e7


@dataclass(frozen=True)
class DetectionTarget:
    """What a prediction is made for: false-alarm and detection probability, the detectors, the noise's seed.

    Raises InputError for probabilities outside 0..1, no detector or a negative seed.
    """

    false_alarm: float = 0.01
    detection: float = 0.9
    detectors: tuple[ChangeDetector, ...] = THESIS_DETECTORS
    seed: int = 0

    def __post_init__(self) -> None:
        smallest_found(1.0, self.false_alarm, self.detection)
        if not self.detectors:
            raise InputError("a prediction must have one detector or more, got none")
        if self.seed < 0:
            raise InputError(f"seed must be >= 0, got {self.seed}")


def with_closing(rig: Rig, closing: float | None) -> Rig:
    """Return the rig without throttles, or with both closed by this share."""
    if closing is None:
        return rig.with_overrides({"orifices": "absent"}, source="varied for a prediction")
    values: dict[str, float | str] = {"orifices": "present", "closed_A": closing, "closed_B": closing}
    return rig.with_overrides(values, source="varied for a prediction")


def closing_text(rig: Rig) -> str:
    """Return how the rig is throttled, as text."""
    if rig.line.orifices == "absent":
        return "none"
    a, b = (100.0 * closed for closed in (rig.line.closed_A, rig.line.closed_B))
    return f"{a:g} %" if a == b else f"{a:g} % at A, {b:g} % at B"


def bound_figures(bound: LeakBound, dp: float, target: DetectionTarget) -> BoundFigures:
    """Return the bound of one half as mean leaks [L/min] under the pressure difference `dp` [Pa].

    The change between two such halves has twice the variance.
    """
    known, unknown = in_lpm(bound.known, dp), in_lpm(bound.unknown or bound.known, dp)
    change = math.sqrt(2.0) * known, math.sqrt(2.0) * unknown
    smallest = [smallest_found(deviation, target.false_alarm, target.detection) for deviation in change]
    return BoundFigures(
        half_s=bound.duration,
        known_lpm=known,
        unknown_lpm=unknown,
        change_known_lpm=change[0],
        change_unknown_lpm=change[1],
        smallest_known_lpm=smallest[0],
        smallest_unknown_lpm=smallest[1],
        unknown_parameters=bound.unknown_parameters,
    )


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


def _command_row(rig: Rig, command: str, duration: float, noise: Array, target: DetectionTarget) -> CommandRow:
    """Return one line of the comparison: every detector's smallest leak, and the bound's with all else known.

    What cannot be simulated (a command over the converter's range, a stop, vacuum) is said in the row's note.
    """
    throttles = closing_text(rig)
    try:
        experiment = experiment_for(rig, command, duration)
        responses, dp = noise_responses(experiment, TABLE_SIZES, target.detectors, noise)
        bound = bound_figures(leak_bound(_half_of(experiment)), dp, target)
    except SealscopeError as error:
        return CommandRow(command, throttles, {}, None, str(error))
    predictions = smallest_leaks(responses, target.detectors, target.false_alarm, target.detection)
    sizes = {prediction.detector: prediction.smallest for prediction in predictions}
    return CommandRow(command, throttles, sizes, bound.smallest_known_lpm)


def _half_of(experiment: Experiment) -> Experiment:
    """Return the experiment at half its length: what the bound is made from."""
    return replace(experiment, duration=experiment.duration / 2.0)


def predict(
    experiment: Experiment,
    target: DetectionTarget = DetectionTarget(),
    *,
    commands: Iterable[str] = STANDARD_COMMANDS,
    closings: Iterable[float | None] = STANDARD_CLOSINGS,
    bench: str = "",
    draws: int = 24,
    results: Path | None = None,
    progress: ProgressCallback = lambda label, share: None,
) -> PredictionReport:
    """Predict for an experiment (`experiment_for`) every detector's smallest leak, and the bound.

    The `commands` under every one of the `closings` are compared under instrument noise alone. `bench`: name or file
    of a profile of machines and drifts, of which `draws` machines are simulated; `results`: the folder of a campaign
    whose rows are used instead; without either the rig is taken as it stands. Raises InputError for values that break
    a rule, SimulationFailed where the experiment itself cannot be simulated.
    """
    rig = experiment.rig
    if bench and results is not None:
        raise InputError("a prediction must come from a bench or from a campaign's results, got both")
    deviations = np.sqrt(np.diag(noise_covariance(rig))).tolist()
    report = partial(progress, "this command")
    report(0.0)
    elsewhere = _elsewhere(experiment, target, bench, draws, results, progress)
    noise = instrument_noise(experiment, _affordable(experiment), target.seed)
    alone, dp = noise_responses(experiment, SIZES, target.detectors, noise, lambda share: report(0.5 * share))
    responses = elsewhere or alone
    bound = leak_bound(
        _half_of(experiment), unknown=unknown_of(experiment.rig), progress=lambda share: report(0.5 + 0.5 * share)
    )
    report(1.0)
    judging = partial(progress, "judging detectors")
    judges = judge_predictions(experiment, target.false_alarm, target.detection, target.seed, judging)
    duties = [(command, with_closing(rig, closing)) for command in commands for closing in closings]
    jobs = [
        partial(_command_row, throttled, command, experiment.duration, noise[:TABLE_NOISES], target)
        for command, throttled in duties
    ]
    rows = in_parallel(jobs, "commands compared", progress) if jobs else []
    return PredictionReport(
        rig=rig.name,
        overrides=experiment.describe()["overrides"],
        command=str(experiment.command),
        orifices=closing_text(rig),
        duration_s=experiment.duration,
        sample_rate_hz=experiment.rate,
        start_position_m=experiment.x_0,
        false_alarm=target.false_alarm,
        detection=target.detection,
        pressure_difference=dp,
        noise=dict(zip(CHAMBERS, deviations, strict=True)),
        origin=_origin(bench, results),
        records=responses.records,
        largest=float(responses.sizes[-1]),
        detectors=smallest_leaks(responses, target.detectors, target.false_alarm, target.detection),
        bound=bound_figures(bound, dp, target),
        commands=tuple(rows),
        largest_compared=TABLE_SIZES[-1],
        judges=judges,
    )


def _elsewhere(
    experiment: Experiment,
    target: DetectionTarget,
    bench: str,
    draws: int,
    results: Path | None,
    progress: ProgressCallback,
) -> Responses | None:
    """Return responses from a campaign's rows or machines of a bench; None where neither is asked for."""
    if results is not None:
        command = str(experiment.command)
        return measured_responses(results, command, experiment.rig, experiment.duration, target.detectors)
    if not bench:
        return None
    return bench_responses(experiment, bench, draws, target.seed, target.false_alarm, target.detectors, progress)


def _origin(bench: str, results: Path | None) -> str:
    """Return where the scatter comes from, as text."""
    if results is not None:
        return f"rows of the campaign in {results}"
    return f"machines and drifts of the profile {bench}" if bench else "instrument noise alone, no drift"


def _affordable(experiment: Experiment) -> int:
    """Return the number of noise records: fewer where they are long, to stay within `MOST_NOISE` values."""
    return max(TABLE_NOISES, min(NOISES, int(MOST_NOISE / (2.0 * experiment.duration * experiment.rate))))
