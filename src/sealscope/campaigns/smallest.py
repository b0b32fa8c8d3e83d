"""Plan a recording: the command, load and duration with which `diagnose` detects a leak of a given size on a rig.

Leak-free recordings of the rig and its instruments are simulated under each duty, a combination of a command and a
load. The smallest step of the leak's conductance that is detected with the probability `detection` follows from the
test that `diagnose` uses (`StepTest.detectable_step`),

    detectable step = (threshold^(1/2) + z_detection) s,

with the standard error s of a step (its median over all onsets), the threshold of the likelihood ratio at the
false-alarm probability, and the normal quantile z_detection. Flows are stated at the mean pressure difference of the
usual duty. The smallest step that can be told from a step of the pump's leakage follows from the Fisher information of
both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.hold.plan import PlannedHold, plan_hold
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.equations.terms import PUMP
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.diagnosis.verdict.machine_sizes import healthy_leakage
from sealscope.errors import InputError, SealscopeError
from sealscope.paragraphs import paragraph
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.bench.machines import centred_start
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment
from sealscope.simulation.targets_and_loads import Position, command_or_target, parse_force
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

_FALSE_ALARM: float = DECISION.false_alarm.probability
#: Commands and constant loads that are tried in addition to the machine's usual duty.
COMMANDS, LOADS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)"), ("", "100 N", "2 kN")
#: Durations [s] that are tried, and the duration at which duties are compared.
DURATIONS, COMPARISON_SECONDS = (20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 270.0, 400.0, 600.0), 60.0
#: Number of simulated recordings of a duty, whose median is stated.
N_RECORDS = 3
#: Length [s] of the command's beginning from which the sweep of the piston is centred.
_MAX_CENTRING_SECONDS = 1000.0


def has_shut_off(rig: Rig) -> bool:
    """Return True if a rig has shut-off valves between cylinder and pump, whose openings are stated, not assumed."""
    sources = [rig.entry(name).source for name in ("line.open_A", "line.open_B")]
    return rig.line.orifices == "present" and not any(source.startswith(("absent", "assumed")) for source in sources)


class PlannedDuty(NamedTuple):
    """The duty of a recording: its command, a text such as '3 sin(4t)' [V], and its load, such as '2 kN', or ""."""

    command: str
    load: str = ""

    def __str__(self) -> str:
        return self.command + (f" under {self.load}" if self.load else "")


class DetectableLeak(NamedTuple):
    """The smallest leaks that are detected with the wanted probability in recordings of one duty and `duration` [s].

    - `conductance` [m^3/(s Pa)]: smallest step of the leak's conductance that is detected, inf if none is
    - `separable` [m^3/(s Pa)]: smallest step that can also be told from a step of the pump's leakage, inf if none can
    - `pressure` [Pa], `flow` [m^3/s]: mean |p_A - p_B|, and mean flow of the pump
    - `note`: reason why the numbers could not be computed, "" if they could
    """

    duty: PlannedDuty
    duration: float
    conductance: float = np.inf
    separable: float = np.inf
    pressure: float = np.nan
    flow: float = 0.0
    note: str = ""


class RecordingPlan(NamedTuple):
    """A planned recording, and the duties (commands and loads) that were compared for it.

    - `target` [m^3/(s Pa)]: conductance of the leak to detect, None to detect the smallest possible leak
    - `for_detection`: the shortest recording that detects this leak, or the last one tried if none does; without a
      target, the best of `compared`
    - `for_separation`: likewise, the shortest recording that also tells this leak from a leak of the pump
    - `compared`: results of all duties, the usual duty first
    - `usual_pressure` [Pa]: mean pressure difference under the usual duty, at which flows are stated
    - `false_alarm`, `detection`: wanted probabilities of an alarm without the leak and with it
    - `hold`: a planned hold test, with valves shut, None if none was planned
    """

    rig: str
    target: float | None
    for_detection: DetectableLeak
    for_separation: DetectableLeak
    compared: tuple[DetectableLeak, ...]
    usual_pressure: float
    false_alarm: float
    detection: float
    hold: PlannedHold | None = None

    @property
    def finds(self) -> bool:
        """True if the planned recording detects the leak that was asked for (`target`), or if none was asked for."""
        return self.target is None or self.for_detection.conductance <= self.target

    def lpm(self, conductance: float) -> float | None:
        """Compute the flow [L/min] of a leak with a conductance [m^3/(s Pa)] at the usual pressure; None for inf."""
        return conductance * self.usual_pressure / LITRE_PER_MINUTE if np.isfinite(conductance) else None

    def as_dict(self) -> dict[str, Any]:
        """Convert the planned recording to plain JSON values, with leaks as flows [L/min] at the usual pressure."""

        def leak_dict(leak: DetectableLeak) -> dict[str, Any]:
            """Convert the smallest leaks under one duty to JSON values."""
            return {
                **leak.duty._asdict(),
                "duration_s": leak.duration,
                "smallest_leak_lpm": self.lpm(leak.conductance),
                "separable_from_pump_lpm": self.lpm(leak.separable),
                "pressure_Pa": leak.pressure if np.isfinite(leak.pressure) else None,
                "note": leak.note,
            }

        return {
            "rig": self.rig,
            "wanted_lpm": None if self.target is None else self.lpm(self.target),
            "finds": self.finds,
            "usual_pressure_Pa": self.usual_pressure,
            "false_alarm_probability": self.false_alarm,
            "detection_probability": self.detection,
            "recording": leak_dict(self.for_detection),
            "separating_from_pump": leak_dict(self.for_separation),
            "hold": None if self.hold is None else self.hold.as_dict(),
            "compared": [leak_dict(leak) for leak in self.compared],
        }

    def text(self) -> str:
        """Format the planned recording as lines of text: its duty, its smallest leak, and a table of all duties."""
        best, separating = self.for_detection, self.for_separation
        at_pressure = f"at {self.usual_pressure / 1e6:.2g} MPa"
        target = "" if self.target is None else f"{self.lpm(self.target):.2g} L/min {at_pressure}: "
        not_found = "" if self.finds else "not found; the best is "
        separation = "no; record the pump's ports p_1 and p_2 behind throttles"
        if np.isfinite(separating.separable):
            separation = f"{separating.duty} for {separating.duration:g} s, {self._format_flow(separating.separable)}"
        lines = [
            f"{target}{not_found}{best.duty} for {best.duration:g} s "
            f"finds {self._format_flow(best.conductance)} {at_pressure}",
            f"  in {100 * self.detection:g} % of recordings, {100 * self.false_alarm:g} % false alarms; rig {self.rig}",
            f"  separated from a leak of the pump: {separation}",
            *([] if self.hold is None else [f"  or {self.hold.text()}"]),
            f"  {'other duties, ' + f'{self.compared[0].duration:g} s':<34}{'found':>14}{'separable':>18}",
        ]
        lines += [
            f"  {row.duty!s:<34}{self._format_flow(row.conductance):>14}{self._format_flow(row.separable):>18}"
            for row in self.compared
            if not row.note
        ]
        failed = [row for row in self.compared if row.note]  # the first is printed
        lines += [paragraph(f"left out: {row.duty}: {row.note}", head="  ", indent=4) for row in failed[:1]]
        return "\n".join(lines)

    def _format_flow(self, conductance: float) -> str:
        """Format the result of `lpm`; '-' if the leak is infinite."""
        flow = self.lpm(conductance)
        return "-" if flow is None else f"{flow:.2g} L/min"


def duty_experiment(rig: Rig, duty: PlannedDuty, duration: float, seed: int = 0) -> Experiment:
    """Build a leak-free experiment of `duration` [s] with the command and load `duty`.

    The piston starts where its motion is centred in the stroke. `seed`: seed of the sensor noise. Raises InputError if
    the command is a target of the position and not a voltage.
    """
    command = command_or_target(duty.command)
    if isinstance(command, Position):
        raise InputError(f"a plan's command must be a voltage ('3 sin(4t)'), got a target ({command})")
    start = centred_start(rig, command, min(duration, _MAX_CENTRING_SECONDS))
    load = parse_force(duty.load) if duty.load else None
    return Experiment(rig=rig, command=command, duration=duration, x_0=start, load=load, seed=seed)


def detectable_leak(
    rig: Rig, duty: PlannedDuty, duration: float, *, false_alarm: float = _FALSE_ALARM, detection: float = 0.9
) -> DetectableLeak:
    """Compute the smallest leak that is detected in recordings with the command and load `duty`, of `duration` [s].

    The numbers are medians of `N_RECORDS` simulated recordings. `false_alarm`, `detection`: probability of an alarm
    without and with the leak. If the recording or its volume balance fails, the leak is inf, with the reason in `note`.
    """
    steps = []
    try:
        for seed in range(N_RECORDS):
            recording = simulate_experiment(duty_experiment(rig, duty, duration, seed)).recording
            steps.append(_detectable_steps(recording, rig, false_alarm, detection))
    except SealscopeError as error:
        return DetectableLeak(duty, duration, note=str(error))
    return DetectableLeak(duty, duration, *np.median(steps, axis=0).tolist())


def _detectable_steps(
    recording: Recording, rig: Rig, false_alarm: float, detection: float
) -> tuple[float, float, float, float]:
    """Compute from a leak-free recording the smallest step of the leakage conductance that would be detected.

    Returns `conductance`, `separable`, `pressure` and `flow` of `DetectableLeak`. Raises InputError if the volume
    balance cannot be computed.
    """
    detector = VolumeBalance(rig)
    if reason := detector.usable(recording):
        raise InputError(f"no balance: {reason}")
    balance = detector.balance(recording)
    if balance is None or balance.test is None:
        raise InputError("no balance: the recording is too short, or no block tells anything about a leak")
    # without healthy recordings, the fraction `within` of the false-alarm probability is reserved for the comparison
    # with the healthy leakage that the rig states, if it states one
    level_fraction: float = DECISION.questions.within
    step_false_alarm = false_alarm * (1.0 - level_fraction if healthy_leakage(rig) > 0.0 else 1.0)
    scale = balance.size.scale  # from flows that are computed with the machine's assumed sizes to the true ones
    step = balance.test.detectable_step(step_false_alarm, detection) * scale
    separable_step = step * _separation_ratio(balance.blocks, balance.columns)
    return step, separable_step, balance.mean_pressure(), balance.mean_flow * scale


def _separation_ratio(blocks: Blocks, columns: Sequence[ColumnRoles]) -> float:
    """Compute the factor by which an unknown step of the pump's leakage raises the standard error of the leak's step.

    It is sqrt(I_11 / (I_11 - I_12^2 / I_22)), with the Fisher information I (2, 2) of the leak's step (1) and the
    pump's step (2), both at the middle block of the recording, given the unknown constant coefficients of the volume
    balance. `columns`: for each equation of the balance, the roles of its columns. The factor is inf if the balance has
    several equations or no column for the pump's leakage, or if the two steps cannot be told apart.
    """
    roles = columns[0]
    if PUMP not in roles.names or len(columns) > 1:
        return np.inf
    middle = len(blocks) // 2
    gram = blocks.gram[:, 0].sum(axis=0)  # 0: the only equation
    gram_after_step = blocks.gram[middle:, 0].sum(axis=0)  # products of a step's column, which is 0 before the step
    constants, steps = list(roles.nuisance), [roles.leak, roles.names.index(PUMP)]
    # Fisher information of both steps with the constant terms integrated out
    cross = gram_after_step[np.ix_(steps, constants)]
    after_step = Gaussian.from_gram(gram_after_step).among(steps)
    information = Gaussian.from_gram(gram).among(constants).integrate_out(cross, after_step).precision
    known_pump = information[0, 0]
    unknown_pump = known_pump - information[0, 1] ** 2 / max(information[1, 1], 1e-300)  # 1e-300: no division by 0
    is_separable = unknown_pump > 1e-9 * known_pump  # beyond rounding
    return float(np.sqrt(known_pump / unknown_pump)) if is_separable else np.inf


def plan_recording(
    rig: Rig,
    find: float | None = None,
    *,
    usual: PlannedDuty,
    false_alarm: float = _FALSE_ALARM,
    detection: float = 0.9,
    held: float | None = None,
    progress: Callable[[str, float], None] = lambda label, fraction: None,
) -> RecordingPlan:
    """Find the shortest recording that detects a leak with a flow of `find` [m^3/s].

    The `usual` duty and all combinations of `COMMANDS` and `LOADS` are compared in recordings of `COMPARISON_SECONDS`.
    The best is then tried for rising `DURATIONS`, from half of the predicted one, until the leak is detected; and
    likewise for telling it from a leak of the pump.

    - `find`: flow at the mean |p_A - p_B| of the `usual` duty; None to find the smallest leak in `COMPARISON_SECONDS`
    - `false_alarm`, `detection`: probabilities of an alarm without the leak and with it
    - `held` [N]: force that the cylinder holds in a hold test, with its valves shut; None for the last of `LOADS` if
      the rig has such valves, and otherwise for no hold
    - `progress`: called with a label and the completed fraction

    Raises InputError if the usual duty cannot be simulated or judged.
    """
    choices = [PlannedDuty(command, load) for load in LOADS for command in COMMANDS]
    compared_duties = [usual, *(duty for duty in choices if duty != usual)]
    compared = []
    for k, duty in enumerate(compared_duties):
        compared.append(detectable_leak(rig, duty, COMPARISON_SECONDS, false_alarm=false_alarm, detection=detection))
        if compared[0].note:
            raise InputError(f"the usual duty must give a volume balance, got none for {usual}: {compared[0].note}")
        progress("duties compared", (k + 1) / len(compared_duties))
    usual_pressure = compared[0].pressure
    target = None if find is None else find / usual_pressure
    planned = []  # for detection, then for separation from a leak of the pump
    for field in ("conductance", "separable"):
        best = min(compared, key=lambda leak: float(getattr(leak, field)))
        if target is not None and np.isfinite(getattr(best, field)):
            # a step's standard error falls with the square root of the duration; far shorter ones are not tried
            predicted_duration = COMPARISON_SECONDS * (getattr(best, field) / target) ** 2
            durations = [seconds for seconds in DURATIONS if seconds >= 0.5 * predicted_duration] or DURATIONS[-1:]
            for duration in durations:
                best = detectable_leak(rig, best.duty, duration, false_alarm=false_alarm, detection=detection)
                if getattr(best, field) <= target:
                    break
        planned.append(best)
    detecting, separating = planned
    if held is None and has_shut_off(rig):
        held = parse_quantity(LOADS[-1], "N", name="load")
    hold = None
    if held is not None:
        cylinder, encoder = rig.cylinder, rig.sensors.x
        length = 0.5 * cylinder.L + HOLD.column.dead
        hold = plan_hold(
            held, cylinder.A_A, length, encoder.resolution, noise=encoder.noise, find=find, detection=detection
        )
    return RecordingPlan(
        rig.name, target, detecting, separating, tuple(compared), usual_pressure, false_alarm, detection, hold
    )
