"""Before anyone measures: the smallest leak that each detector will find on this rig, and the bound beside it.

A record of T seconds has the leak from its middle on. The rig is simulated with leaks of rising size; the instruments'
own noise is laid over it many times; the scorers judge the records as a campaign's would. With a bench, every record
is a machine of its own that drifts as the bench says, and the scatter holds both.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from sealscope.campaigns.prediction.bound import (
    UNKNOWN,
    LeakBound,
    in_lpm,
    leak_bound,
    noise_covariance,
    smallest_found,
)
from sealscope.campaigns.prediction.detection import THESIS_DETECTORS, ChangeDetector, Responses, predict
from sealscope.campaigns.prediction.noise_responses import instrument_noise, responses
from sealscope.campaigns.prediction.report import BoundFigures, CommandRow, Outlook
from sealscope.errors import InputError, SealscopeError
from sealscope.parameters import Rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.bench.machines import centred_start
from sealscope.simulation.commands import Command, parse_command
from sealscope.simulation.experiment import Experiment

Progress = Callable[[str, float], None]
_T = TypeVar("_T")

#: The commands of the thesis's tests that a plan compares, and the closings of both throttles (None: no throttles).
STANDARD_COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)")
STANDARD_CLOSINGS = (None, 0.25, 0.50, 0.75)
#: Sizes of leaks that are simulated [L/min]; a prediction never goes beyond the largest.
SIZES = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)
TABLE_SIZES = (0.001, 0.004, 0.012, 0.032)
#: Shortest record planned for [s]: each half must hold whole cycles of the slowest standard command.
SHORTEST = 20.0
#: How much of a command is looked at to centre its sweep [s].
LONGEST_LOOK = 1000.0
#: Noise records laid over the run: for the rig's own command, and for each row of the table.
NOISES, TABLE_NOISES = 48, 8
#: Most values of noise kept in memory (8 bytes each).
MOST_NOISE = 3e7


def with_closing(rig: Rig, closing: float | None) -> Rig:
    """The rig without throttles, or with both closed by this share."""
    if closing is None:
        return rig.with_overrides({"orifices": "absent"}, source="varied for a plan")
    values: dict[str, float | str] = {"orifices": "present", "closed_A": closing, "closed_B": closing}
    return rig.with_overrides(values, source="varied for a plan")


def closing_words(rig: Rig) -> str:
    """How the rig is throttled, in words."""
    if rig.line.orifices == "absent":
        return "none"
    a, b = (100.0 * closed for closed in (rig.line.closed_A, rig.line.closed_B))
    return f"{a:g} %" if a == b else f"{a:g} % at A, {b:g} % at B"


def _in_parallel(jobs: Sequence[Callable[[], _T]], words: str, progress: Progress) -> list[_T]:
    """Results of the jobs in their order; compiled kernels run outside the interpreter's lock, so threads serve."""
    results: list[_T] = []
    progress(words, 0.0)
    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in futures:
                results.append(future.result())
                progress(words, len(results) / len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results


def bound_figures(bound: LeakBound, dp: float, false_alarm: float, detection: float) -> BoundFigures:
    """The bound of one half as mean leaks [L/min] under the pressure difference `dp` [Pa], and of the change between
    two such halves, whose variance is twice as large."""
    known, unknown = in_lpm(bound.known, dp), in_lpm(bound.unknown or bound.known, dp)
    change_known, change_unknown = (math.sqrt(2.0) * one for one in (known, unknown))
    smallest_known, smallest_unknown = (
        smallest_found(one, false_alarm, detection) for one in (change_known, change_unknown)
    )
    return BoundFigures(
        half_s=bound.duration,
        known=known,
        unknown=unknown,
        change_known=change_known,
        change_unknown=change_unknown,
        smallest_known=smallest_known,
        smallest_unknown=smallest_unknown,
        unknown_parameters=bound.unknown_parameters,
    )


@dataclass(frozen=True)
class Wish:
    """What a plan is asked for: the false-alarm rate, the probability of detection, the detectors, the noise's seed.

    Raises InputError for probabilities outside 0..1, no detector or a negative seed.
    """

    false_alarm: float = 0.01
    detection: float = 0.9
    detectors: tuple[ChangeDetector, ...] = THESIS_DETECTORS
    seed: int = 0

    def __post_init__(self) -> None:
        smallest_found(1.0, self.false_alarm, self.detection)
        if not self.detectors:
            raise InputError("a plan must have one detector or more, got none")
        if self.seed < 0:
            raise InputError(f"seed must be >= 0, got {self.seed}")


def experiment_for(rig: Rig, command: Command | str, duration: float, x_0: float | None = None) -> Experiment:
    """The leak-free experiment of a plan; `x_0` [m] by default such that the sweep's middle is at mid-stroke.

    Raises InputError for a record too short to plan for.
    """
    if not duration >= SHORTEST:
        raise InputError(f"duration must be >= {SHORTEST:g} s for a plan, got {duration:g} s")
    parsed = parse_command(command) if isinstance(command, str) else command
    start = centred_start(rig, parsed, min(duration, LONGEST_LOOK)) if x_0 is None else x_0
    return Experiment(rig=rig, command=parsed, duration=duration, x_0=start)


def command_row(rig: Rig, command: str, duration: float, noise: Array, wish: Wish) -> CommandRow:
    """One line of the comparison: every detector's smallest leak, and the bound's with all else known.

    What cannot be simulated (a command over the converter's range, a stop, vacuum) is told in the row's note.
    """
    throttles = closing_words(rig)
    try:
        experiment = experiment_for(rig, command, duration)
        found, dp = responses(experiment, TABLE_SIZES, wish.detectors, noise)
        bound = bound_figures(leak_bound(half_of(experiment)), dp, wish.false_alarm, wish.detection)
    except SealscopeError as error:
        return CommandRow(command, throttles, {}, None, str(error))
    predicted = predict(found, wish.detectors, wish.false_alarm, wish.detection)
    sizes = {one.detector: one.smallest for one in predicted}
    return CommandRow(command, throttles, sizes, bound.smallest_known)


def half_of(experiment: Experiment) -> Experiment:
    """The experiment at half its length: what the bound is made from."""
    return replace(experiment, duration=experiment.duration / 2.0)


def outlook(
    experiment: Experiment,
    wish: Wish = Wish(),
    *,
    commands: Iterable[str] = STANDARD_COMMANDS,
    closings: Iterable[float | None] = STANDARD_CLOSINGS,
    bench: str = "",
    draws: int = 24,
    results: Path | None = None,
    progress: Progress = lambda words, share: None,
) -> Outlook:
    """The plan for an experiment (`experiment_for`): every detector's smallest leak, the bound, and the `commands`
    under every one of the `closings` compared under instrument noise alone.

    `bench`: name or file of a profile of machines and drifts, of which `draws` machines are simulated; `results`: the
    folder of a campaign whose rows tell instead; without either the rig is taken as it stands. Raises InputError for
    values that break a rule, SimulationFailed where the experiment itself cannot be simulated.
    """
    rig = experiment.rig
    if bench and results is not None:
        raise InputError("a plan must come from a bench or from a campaign's results, got both")
    noise_covariance(rig)
    told = partial(progress, "this command")
    told(0.0)
    measured = _elsewhere(experiment, wish, bench, draws, results, progress)
    noise = instrument_noise(experiment, _affordable(experiment, NOISES), wish.seed)
    found, dp = responses(experiment, SIZES, wish.detectors, noise, lambda share: told(0.5 * share))
    found = measured or found
    bound = leak_bound(half_of(experiment), unknown=UNKNOWN, progress=lambda share: told(0.5 + 0.5 * share))
    told(1.0)
    some = noise[:TABLE_NOISES]
    places = [(command, with_closing(rig, closing)) for command in commands for closing in closings]
    jobs = [partial(command_row, where, command, experiment.duration, some, wish) for command, where in places]
    rows = _in_parallel(jobs, "commands compared", progress) if jobs else []
    described = experiment.describe()
    return Outlook(
        rig=rig.name,
        overrides=described["overrides"],
        command=str(experiment.command),
        orifices=closing_words(rig),
        duration_s=experiment.duration,
        sample_rate_hz=experiment.rate,
        start_position_m=experiment.x_0,
        false_alarm=wish.false_alarm,
        detection=wish.detection,
        pressure_difference=dp,
        noise={name: math.sqrt(value) for name, value in zip(CHAMBERS, np.diag(noise_covariance(rig)), strict=True)},
        origin=_origin(bench, results),
        records=found.records,
        largest=float(found.sizes[-1]),
        detectors=predict(found, wish.detectors, wish.false_alarm, wish.detection),
        bound=bound_figures(bound, dp, wish.false_alarm, wish.detection),
        commands=tuple(rows),
        largest_compared=TABLE_SIZES[-1],
    )


def _elsewhere(
    experiment: Experiment, wish: Wish, bench: str, draws: int, results: Path | None, progress: Progress
) -> Responses | None:
    """Responses from a campaign's rows or from machines of a bench; None where instrument noise alone shall tell."""
    if results is not None:
        from sealscope.campaigns.prediction.measured_responses import measured_responses

        command = str(experiment.command)
        return measured_responses(results, command, experiment.rig, experiment.duration, wish.detectors)
    if not bench:
        return None
    from sealscope.campaigns.prediction.bench_responses import bench_responses

    def spread(jobs: Sequence[Callable[[], _T]]) -> list[_T]:
        return _in_parallel(jobs, f"{draws} machines of the bench", progress)

    return bench_responses(experiment, bench, draws, wish.seed, wish.false_alarm, wish.detectors, spread)


def _origin(bench: str, results: Path | None) -> str:
    """Where the scatter comes from, in words."""
    if results is not None:
        return f"rows of the campaign in {results}"
    return f"machines and drifts of the profile {bench}" if bench else "instrument noise alone, no drift"


def _affordable(experiment: Experiment, records: int) -> int:
    """Fewer noise records where they are long, so that they stay within `MOST_NOISE` values."""
    return max(TABLE_NOISES, min(records, int(MOST_NOISE / (2.0 * experiment.duration * experiment.rate))))
