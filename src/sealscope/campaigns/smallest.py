"""Plan a recording: the command, load and duration that find a leak of a size on a rig.

Leak-free recordings of the rig with its instruments are simulated under each duty; the information of their blocks says
which step of the leak's conductance `diagnose` finds in them, by the same test that judges (`StepTest.findable`),

    findable = (threshold^(1/2) + z_detection) s,

s the deviation of a step at the median onset, the threshold that of the likelihood ratio at the false-alarm
probability. A seal is a conductance: duties are compared by it, and sizes stated as the flow that it passes under the
first duty. Whether a step of the piston's leak is separable from one of the pump's is the Fisher information of both at
once, all other terms free.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns, solve
from sealscope.diagnosis.inference.terms import PUMP
from sealscope.diagnosis.inference.volumes.detector import VolumeBalance
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.machine import healthy_leakage
from sealscope.errors import InputError, SealscopeError
from sealscope.paragraphs import paragraph
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.bench.machines import centred_start
from sealscope.simulation.courses import Position, command_or_target, parse_force
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment
from sealscope.units import LITRE_PER_MINUTE

#: Commands and constant loads that are tried beside the machine's own duty.
COMMANDS, LOADS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)"), ("", "100 N", "2 kN")
#: Durations that are tried [s], and that at which duties are compared.
DURATIONS, COMPARED = (20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 270.0, 400.0, 600.0), 60.0
#: Records of a duty whose median is stated, and how much of a command is looked at to centre its sweep [s].
RECORDS, _LONGEST_LOOK = 3, 1000.0


class PlannedDuty(NamedTuple):
    """A command [V] and a load, in words, "" for none."""

    command: str
    load: str = ""

    def __str__(self) -> str:
        return self.command + (f" under {self.load}" if self.load else "")


#: The duty of a machine whose own is not stated.
USUAL = PlannedDuty(COMMANDS[0])


class Findable(NamedTuple):
    """The smallest leak that recordings of a duty and a `duration` [s] find.

    `conductance`: the smallest step of the leak that is found, `separable`: the smallest that can be told from a step
    of the pump's, both [m^3/(s Pa)] and infinite where there is none; `pressure`: mean |p_A - p_B| [Pa]; `note`: the
    reason for missing figures.
    """

    duty: PlannedDuty
    duration: float
    conductance: float
    separable: float
    pressure: float
    note: str = ""


class RecordingPlan(NamedTuple):
    """The recording to make, and all duties compared; `target` conductance [m^3/(s Pa)], None for none.

    `chosen`: of the shortest duration that finds it, or the best that was tried; `separating`: the same of what is
    separable from the pump; `usual` pressure [Pa], at which flows are stated.
    """

    rig: str
    target: float | None
    chosen: Findable
    separating: Findable
    compared: tuple[Findable, ...]
    usual: float
    false_alarm: float
    detection: float

    @property
    def finds(self) -> bool:
        """True if the chosen recording finds the target."""
        return self.target is None or self.chosen.conductance <= self.target

    def lpm(self, conductance: float) -> float | None:
        """Convert a conductance to the flow at the usual pressure [L/min], None for one that is not finite."""
        return conductance * self.usual / LITRE_PER_MINUTE if np.isfinite(conductance) else None

    def as_dict(self) -> dict[str, Any]:
        """Convert the plan to plain JSON values, sizes in L/min at the usual pressure."""

        def plain(findable: Findable) -> dict[str, Any]:
            sizes = {
                "smallest_leak_lpm": self.lpm(findable.conductance),
                "separable_from_pump_lpm": self.lpm(findable.separable),
            }
            driving = findable.pressure if np.isfinite(findable.pressure) else None
            return {
                **findable.duty._asdict(),
                "duration_s": findable.duration,
                **sizes,
                "pressure_Pa": driving,
                "note": findable.note,
            }

        return {
            "rig": self.rig,
            "wanted_lpm": None if self.target is None else self.lpm(self.target),
            "finds": self.finds,
            "usual_pressure_Pa": self.usual,
            "false_alarm_probability": self.false_alarm,
            "detection_probability": self.detection,
            "recording": plain(self.chosen),
            "separating_from_pump": plain(self.separating),
            "compared": [plain(findable) for findable in self.compared],
        }

    def text(self) -> str:
        """Format the plan as lines of text, the answer first."""
        chosen, separating, usual_pressure = self.chosen, self.separating, f"at {self.usual / 1e6:.2g} MPa"
        target = "" if self.target is None else f"{self.lpm(self.target):.2g} L/min {usual_pressure}: "
        doubt = "" if self.finds else "not found; the best is "
        lines = [
            f"{target}{doubt}{chosen.duty} for {chosen.duration:g} s "
            f"finds {self._size(chosen.conductance)} {usual_pressure}",
            f"  in {100 * self.detection:g} % of recordings, {100 * self.false_alarm:g} % false alarms; rig {self.rig}",
            "  separated from a leak of the pump: "
            + (
                f"{separating.duty} for {separating.duration:g} s, {self._size(separating.separable)}"
                if np.isfinite(separating.separable)
                else "no; record the pump's ports p_1 and p_2 behind throttles"
            ),
            f"  {'other duties, ' + f'{self.compared[0].duration:g} s':<34}{'found':>14}{'separable':>18}",
        ]
        comparable = [row for row in self.compared if not row.note]
        lines += [
            f"  {row.duty!s:<34}{self._size(row.conductance):>14}{self._size(row.separable):>18}" for row in comparable
        ]
        notes = [row for row in self.compared if row.note]
        lines += [paragraph(f"left out: {row.duty}: {row.note}", "  ", 4) for row in notes[:1]]
        return "\n".join(lines)

    def _size(self, conductance: float) -> str:
        flow = self.lpm(conductance)
        return "-" if flow is None else f"{flow:.2g} L/min"


def experiment_of(rig: Rig, duty: PlannedDuty, duration: float, seed: int = 0) -> Experiment:
    """Build the leak-free experiment of a duty, its sweep centred; raise InputError for a text that is no command."""
    command = command_or_target(duty.command)
    if isinstance(command, Position):
        raise InputError(f"a plan must be of a command in volts ('3 sin(4t)'), got a target ({command})")
    start = centred_start(rig, command, min(duration, _LONGEST_LOOK))
    load = parse_force(duty.load) if duty.load else None
    return Experiment(rig=rig, command=command, duration=duration, x_0=start, load=load, seed=seed)


def findable(
    rig: Rig, duty: PlannedDuty, duration: float, *, false_alarm: float = 0.01, detection: float = 0.9
) -> Findable:
    """Compute the smallest leak that recordings of a duty find; the note says why where there is none."""
    steps, separable_steps, pressures = [], [], []
    try:
        for seed in range(RECORDS):
            recording = simulate_experiment(experiment_of(rig, duty, duration, seed)).recording
            step, separable, pressure = _detectable_in(recording, rig, false_alarm, detection)
            steps.append(step)
            separable_steps.append(separable)
            pressures.append(pressure)
    except SealscopeError as error:
        return Findable(duty, duration, np.inf, np.inf, np.nan, str(error))
    step, separable, pressure = (float(np.median(values)) for values in (steps, separable_steps, pressures))
    return Findable(duty, duration, step, separable, pressure)


def _detectable_in(recording: Recording, rig: Rig, false_alarm: float, detection: float) -> tuple[float, float, float]:
    """Compute the conductance found, that separable from the pump, and the mean pressure, of a leak-free recording."""
    detector = VolumeBalance(rig)
    if reason := detector.usable(recording):
        raise InputError(f"no balance: {reason}")
    balance = detector.balance(recording)
    if balance is None or balance.test is None:
        raise InputError("no balance: too short, or no block says anything of a leak")
    within: float = priors("decision")["questions"]["within"]
    share = false_alarm * (1.0 - within if healthy_leakage(rig) > 0.0 else 1.0)
    size = balance.size.scale
    step = balance.test.findable(share, detection) * size
    ratio = _free_over_known(balance.blocks, balance.columns)
    return step, step * ratio, balance.mean_pressure()


def _free_over_known(blocks: Blocks, columns: Sequence[Columns]) -> float:
    """Compute the deviation of a leak's step at mid-record with the pump's step free, over that with it known.

    Infinite where no term of the pump is in the balance.
    """
    column = columns[0]
    if PUMP not in column.names or len(columns) > 1:
        return np.inf
    gram, late = (blocks.gram[first:, 0].sum(axis=0) for first in (0, len(blocks) // 2))
    levels, steps = np.array(column.nuisance), np.array([column.leak, column.names.index(PUMP)])
    cross = late[np.ix_(levels, steps)]
    information = late[np.ix_(steps, steps)] - cross.T @ solve(gram[np.ix_(levels, levels)], cross)
    lone, free = information[0, 0], information[0, 0] - information[0, 1] ** 2 / max(information[1, 1], 1e-300)
    return float(np.sqrt(lone / free)) if free > 1e-9 * lone else np.inf


def plan_recording(
    rig: Rig,
    find: float | None = None,
    *,
    usual: PlannedDuty = USUAL,
    duties: Iterable[PlannedDuty] | None = None,
    false_alarm: float = 0.01,
    detection: float = 0.9,
    progress: Callable[[str, float], None] = lambda label, share: None,
) -> RecordingPlan:
    """Find the shortest recording that finds a leak of `find` [m^3/s] at the pressure of the usual duty.

    Without `find`: the recording of `COMPARED` seconds that finds the smallest. Raises InputError where the usual duty
    cannot be simulated or judged.
    """
    choices = [PlannedDuty(command, load) for load in LOADS for command in COMMANDS] if duties is None else list(duties)
    tried = [usual, *(duty for duty in choices if duty != usual)]
    compared = []
    for k, duty in enumerate(tried):
        compared.append(findable(rig, duty, COMPARED, false_alarm=false_alarm, detection=detection))
        if compared[0].note:
            raise InputError(f"the usual duty must have a balance, got none of {usual}: {compared[0].note}")
        progress("duties compared", (k + 1) / len(tried))
    pressure = compared[0].pressure
    target = None if find is None else find / pressure
    best = []
    for name in ("conductance", "separable"):
        best_duty = min(compared, key=lambda best_duty: float(getattr(best_duty, name)))
        if target is not None and np.isfinite(getattr(best_duty, name)):
            guess = (
                COMPARED * (getattr(best_duty, name) / target) ** 2
            )  # a deviation falls with the root of the duration
            for duration in [seconds for seconds in DURATIONS if seconds >= 0.5 * guess] or DURATIONS[-1:]:
                best_duty = findable(rig, best_duty.duty, duration, false_alarm=false_alarm, detection=detection)
                if getattr(best_duty, name) <= target:
                    break
        best.append(best_duty)
    return RecordingPlan(rig.name, target, best[0], best[1], tuple(compared), pressure, false_alarm, detection)
