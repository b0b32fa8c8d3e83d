"""What a case of a batch is told from a few seconds of its machine: the solver's step, and the operating point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from sealscope.campaigns.cases import Case, digest, world
from sealscope.campaigns.machines import unsized
from sealscope.campaigns.plan import Plan
from sealscope.diagnosis.baseline.operating_point import operating_point
from sealscope.diagnosis.calibration.thresholds import Place
from sealscope.errors import SealscopeError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.simulation.commands import Sine
from sealscope.simulation.simulate import oversampling, trajectory

if TYPE_CHECKING:
    from sealscope.simulation.bench.profile import Profile
    from sealscope.simulation.experiment import Experiment

#: Machines of a cell on which its step is chosen, and how long [s] each of them runs for that: the first window that
#: `integrate` checks, and two more.
SCOUTS, SCOUTED = 4, 4.0
#: Shortest run [s] that tells an operating point, and the periods of a sine that it holds; the later half is looked at.
LEAST_SECONDS, PERIODS = 4.0, 2


class Steps:
    """Steps [s] of a plan's cases, each derived from what the case is, so that no other case can change it."""

    def __init__(self, plan: Plan, profile: Profile | None = None) -> None:
        self._plan, self._profile = plan, profile
        self._world = digest(world(plan))
        self._cells: dict[str, dict[str, float]] = {}

    def of(self, case: Case, experiment: Experiment) -> float:
        """The step of a case: what `integrate` chooses by error on `SCOUTS` machines of its cell with seeds of their
        own (the finest of those with its method), no longer than its own machine allows."""
        from sealscope.physics.rig import rig_numbers
        from sealscope.physics.solvers.limits import longest_step
        from sealscope.simulation.integrate import FINEST, LONGEST_STEP, choose_method

        method = choose_method(experiment.rig, experiment.method)
        found = self._cell(case.levels).get(method) or chosen_step(experiment)
        limit = max(longest_step(rig_numbers(experiment.rig)), LONGEST_STEP / FINEST)
        return found if found <= limit else stepped(experiment.rate * oversampling(experiment), limit)

    def _cell(self, levels: Mapping[str, str | float]) -> dict[str, float]:
        """Method -> step of a cell of the factors."""
        key = digest(dict(levels))
        if key not in self._cells:
            steps: dict[str, float] = {}
            for number in range(SCOUTS):
                seed = int(digest([self._world, dict(levels), f"scout {number}"])[:15], 16)
                scout = Case("", seed, 0, "calibrate", 0.0, "laminar", "", levels, number)
                try:
                    method, step = _chosen(unsized(self._plan, scout, self._profile))
                except SealscopeError:  # a machine of the bench that cannot do this duty
                    continue
                steps[method] = min(step, steps.get(method, math.inf))
            self._cells[key] = steps
        return self._cells[key]


def stepped(rate: float, limit: float) -> float:
    """The longest step [s] within `limit` [s] that divides the interval of outputs at `rate` [Hz]."""
    from sealscope.simulation.integrate import steps_per_output

    return 1.0 / (rate * steps_per_output(rate, limit))


def chosen_step(experiment: Experiment) -> float:
    """The step [s] that `integrate` chooses by error over the first seconds of an experiment."""
    return _chosen(experiment)[1]


def _chosen(experiment: Experiment) -> tuple[str, float]:
    path = trajectory(replace(experiment, duration=min(experiment.duration, SCOUTED), leaks=()), ())
    return path.method, path.step


def place_of_run(experiment: Experiment) -> Place:
    """Where the record of an experiment with a stated step and sized leaks is made: what `place_of` tells of the
    recording, here without its instruments.

    Command and cycle are those of the whole record. Under a sine, pressure level and direction are told from whole
    periods of a short run before any leak, later drifts apart; under another command, or with another fault, from a
    run of full length.
    """
    command = experiment.commanded
    samples = round(experiment.duration * experiment.rate)
    duration = samples / experiment.rate
    if experiment.faults or not isinstance(command, Sine) or not (command.amplitude and command.omega):
        return Place(operating_point(_clean(experiment, 0.0, duration, with_command=True)), duration)
    period = 2.0 * math.pi / abs(command.omega)
    length = min(max(LEAST_SECONDS, PERIODS * period), experiment.duration)
    looked = max(1, int(length / 2.0 / period)) * period
    point = operating_point(_clean(experiment, max(0.0, length - looked), length))
    rms, cycle = _of_command(command, samples, experiment.rate)
    return Place(replace(point, command_rms=rms, cycle=cycle), duration)


def _clean(experiment: Experiment, start: float, stop: float, *, with_command: bool = False) -> Recording:
    """x, p_A and p_B as they truly are (and u) at the record's samples start <= t < stop [s]."""
    whole = stop >= experiment.duration
    short = experiment if whole else replace(experiment, duration=stop, leaks=())
    path = trajectory(short, short.leaks)
    factor = oversampling(short)
    kept = slice(round(start * short.rate) * factor, round(stop * short.rate) * factor, factor)
    channels = {name: path[name][kept] for name in ("x", *CHAMBERS)}
    if with_command:
        channels["u"] = experiment.commanded.volts(path.t[kept])
    return Recording(path.t[kept], channels, CHANNEL_UNITS, short.rate)


@lru_cache(maxsize=1024)
def _of_command(command: Sine, samples: int, rate: float) -> tuple[float, float | None]:
    """Rms [V] and cycle [s] of a command over the record."""
    t = np.arange(samples) / rate
    u = command.volts(t)
    return float(np.sqrt(np.mean(u**2))), find_cycle(Recording(t, {"u": u}, CHANNEL_UNITS, rate))
