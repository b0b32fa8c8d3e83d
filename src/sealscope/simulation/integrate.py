"""Integrate the rig over an experiment: inputs at the nodes of the steps, choice of the step, and checks.

A step is chosen by error or stated; either way short windows of the run are integrated again at half the step, and a
run that moves further than it may is refused.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.arguments import Method
from sealscope.simulation.changes import Effect, Schedule
from sealscope.simulation.closed_loop import Feedback, outputs_per_sample
from sealscope.simulation.commands import Sine, check_command
from sealscope.simulation.courses import Force, numbers_under, state_under
from sealscope.simulation.experiment import LONGEST_STEP, PRESSURE_TOLERANCE, Experiment, choose_method
from sealscope.simulation.instruments import FILTER_REACH
from sealscope.simulation.leaks import Leak
from sealscope.simulation.sizing import leak_flow, mean_while_open, size_leaks
from sealscope.units import LITRE_PER_MINUTE, P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.physics.rig import RigNumbers

Progress = Callable[[float], None]
#: Step [s] that suits the thesis's rig: error in p_A under 10 Pa rms (docs/decisions/0004-solvers.md).
DEFAULT_STEP = {"rk4": 5e-4, "imex": 1e-3}
#: How many times finer than `LONGEST_STEP` a step that is chosen by error may become.
FINEST = 20
#: Lowest gauge pressure [Pa] the model is valid for where the oil does not boil (`fluid.p_vap`): it holds no tension.
VACUUM = -P_ATM
#: The share by which a detail's RMS in a recording (truth and noise together) may be off.
DETAIL_TOLERANCE = 1e-3
#: What moves in windows, times this, stands for the whole run; a difference to half the step is at least 14/15 of the
#: error of a method of order four.
SAFETY = 1.2
#: Lengths [s] of the first window and of the later ones, and where these begin as shares of the run.
FIRST_WINDOW, LATER_WINDOW = 2.0, 1.0
LATER = (0.5, 0.9)
LEVELS = 4
_BLOCK_STEPS = 4096
_OVERSAMPLING = 4


@dataclass(frozen=True)
class Trajectory:
    """Result of an integration: (n,) times [s] and (n, 21) outputs in the order of `sealscope.physics.state.OUTPUTS`.

    `error`: the estimated rms error [Pa] of the pressures, NaN where it was not checked. `volts`: (n,) a controller's
    voltages [V], None where the command is known beforehand; `compensated`: (n,) the leakage flow [m^3/s] that it says
    it makes good, None where it says nothing.
    """

    t: Array
    rows: Array
    method: str
    step: float
    error: float = math.nan
    volts: Array | None = None
    compensated: Array | None = None

    def __getitem__(self, name: str) -> Array:
        from sealscope.physics.state import OUTPUTS

        return self.rows[:, OUTPUTS.index(name)]


class RunInputs:
    """The inputs of a run: command and leakage of an experiment; `leaks` have their coefficients."""

    def __init__(self, experiment: Experiment, leaks: tuple[Leak, ...]) -> None:
        self._leaks = experiment.flowing(leaks)
        # of a target, the controller's voltage takes the place of this (`Feedback`)
        self._command = experiment.commanded if experiment.target is None else Sine(0.0, 0.0)
        self._duration, self._limit = experiment.duration, experiment.rig.daq.u_max

    def at_nodes(self, start: Array, offsets: Array) -> tuple[Array, Array, Array]:
        """Compute command [V], G [m^3/(s Pa)] and C [m^3/(s Pa^0.5)] at times start[:, None] + offsets [s]."""
        t = start[:, None] + offsets
        return self._within_limit(self._command.volts(t), t), *self._leakage(t)

    def largest(self, t: Array) -> tuple[float, float]:
        """Compute the largest G and C at times t [s]."""
        G, C = self._leakage(t)
        return float(G.max(initial=0.0)), float(C.max(initial=0.0))

    def _leakage(self, t: Array) -> tuple[Array, Array]:
        G, C = np.zeros(t.shape), np.zeros(t.shape)
        for leak in self._leaks:
            if not leak.coefficient or t.max(initial=-math.inf) < leak.opening.onset():
                continue
            more = leak.coefficient * leak.opening.value_at(t)
            G, C = (G + more, C) if leak.law == "laminar" else (G, C + more)
        return G, C

    def _within_limit(self, u: Array, t: Array) -> Array:
        if np.abs(u).max(initial=0.0) <= self._limit:
            return u
        # between samples, or beyond the end, where the filter still looks
        check_command(self._command, t[t <= self._duration], self._limit)
        return np.clip(u, -self._limit, self._limit)


def oversampling(experiment: Experiment) -> int:
    """Compute the outputs per sample: enough for the anti-alias filter, no more than the solver has steps."""
    longest = experiment.step or DEFAULT_STEP[choose_method(experiment.rig, experiment.method)]
    least = oversampling_of(experiment.rate, longest)
    controller = experiment.controlled
    return least if controller is None else outputs_per_sample(experiment.rate, controller.rate, least)


def oversampling_of(rate: float, step: float) -> int:
    """Compute the outputs per sample at `rate` [Hz] for a solver with a step of about `step` [s]."""
    return min(_OVERSAMPLING, steps_per_output(rate, step))


def steps_per_output(rate: float, step: float) -> int:
    """Compute the steps between outputs at `rate` [Hz]: the fewest that keep the step within `step` [s]."""
    return max(1, math.ceil(1.0 / (rate * step) * (1.0 - 1e-9)))


def trajectory(
    experiment: Experiment,
    leaks: tuple[Leak, ...],
    *,
    step: float | None = None,
    error: float | None = None,
    duration: float | None = None,
    progress: Progress | None = None,
) -> Trajectory:
    """Integrate an experiment, with states and flows as often as its instruments need them.

    `leaks` take the place of the experiment's and have coefficients; `step` [s], if given, that of its own step, and is
    not checked: the caller compares runs. `error` [Pa] takes the place of its own, `duration` [s] of its length and of
    what the anti-alias filter needs beyond.
    """
    if duration is None:
        duration = (round(experiment.duration * experiment.rate) + FILTER_REACH) / experiment.rate
    rate, target, controller = experiment.rate * oversampling(experiment), experiment.target, experiment.controlled
    feedback = None
    if target is not None and controller is not None:
        feedback = Feedback(experiment.rig, target, controller, (duration, rate), experiment.seed)
    return integrate(
        experiment.rig,
        RunInputs(experiment, leaks),
        duration,
        rate,
        load=experiment.load,
        feedback=feedback,
        x_0=experiment.x_0,
        method=experiment.method,
        step=step or experiment.step,
        error=(experiment.error_allowed if error is None else error) if step is None else None,
        allow_unresolved=experiment.allow_unresolved,
        progress=progress,
        effects=experiment.effects(),
    )


def _unsized(leaks: Sequence[Leak]) -> tuple[Leak, ...]:
    """Set the coefficients of leaks of a stated mean to 0."""
    return tuple(leak if leak.mean is None else replace(leak, mean=None, coefficient=0.0) for leak in leaks)


def sized_leaks(experiment: Experiment) -> tuple[Leak, ...]:
    """Find the coefficients of the experiment's leaks that give their stated means."""
    if not any(leak.mean for leak in experiment.leaks):
        return _unsized(experiment.leaks)
    return sized_run(experiment)[0]


def sized_run(
    experiment: Experiment,
    progress: Callable[[str, float], None] | None = None,
    simulating: Callable[[float], None] | None = None,
) -> tuple[tuple[Leak, ...], Trajectory]:
    """Find the coefficients of the experiment's leaks, and integrate its run with them.

    `progress` is called while leaks are sized, `simulating` with the time reached where there is nothing to size.

    Raises InputError for a leak larger than the pump's mean |Q_1| or never open within the run; SimulationFailed
    where the search does not settle.
    """
    leaks, dp_0 = experiment.leaks, experiment.rig.line.dp_0
    current = _unsized(leaks)
    if not any(leak.mean for leak in leaks):
        return current, trajectory(experiment, current, progress=simulating)
    first = True

    def measure(sizes: Array) -> tuple[Array, tuple[tuple[Leak, ...], Trajectory]]:
        nonlocal first
        sized = tuple(replace(leak, coefficient=float(size)) for leak, size in zip(current, sizes, strict=True))
        run = trajectory(experiment, sized)
        pump_flow = float(np.mean(np.abs(run["Q_1"])))
        units = np.zeros(len(leaks))
        for k, leak in enumerate(leaks):
            if not leak.mean:
                continue
            if first and leak.mean >= pump_flow:
                raise InputError(
                    f"a leak must be smaller than the pump's mean flow, {pump_flow / LITRE_PER_MINUTE:.4g} L/min for "
                    f"this command, got {leak.mean / LITRE_PER_MINUTE:.4g} L/min ({leak})"
                )
            (flowing,) = experiment.flowing((replace(sized[k], coefficient=1.0),))
            units[k] = mean_while_open(leak, run.t, leak_flow(flowing, run.t, run["p_A"] - run["p_B"], dp_0))
            if not units[k] > 0:
                raise InputError(f"a leak with a mean flow must be open within the run, got {leak}")
        first = False
        return units, (sized, run)

    sizes = np.array([leak.coefficient or 0.0 for leak in current])
    return size_leaks(leaks, sizes, measure, progress)[1]


def integrate(
    rig: Rig,
    inputs: RunInputs,
    duration: float,
    rate: float,
    *,
    x_0: float = 0.0,
    method: Method = "auto",
    step: float | None = None,
    error: float | None = PRESSURE_TOLERANCE,
    allow_unresolved: bool = False,
    progress: Progress | None = None,
    effects: Sequence[Effect] = (),
    load: Force | None = None,
    feedback: Feedback | None = None,
) -> Trajectory:
    """Integrate from standstill over `duration` [s] and report the outputs at `rate` [Hz].

    A `step` [s] that is given is taken (the largest that divides the output interval and is not above it); else the
    largest is chosen, from `LONGEST_STEP` down to `FINEST` of it, that passes the check: in short windows spread over
    the run (`windows`) half the step moves no pressure by more than `error` [Pa rms] and no detail's RMS by more than
    0.1 % (`StepErrorCheck`). The finest step is taken whatever the check says; `Trajectory.error` is what it found.
    `error` None leaves the check of a given step out. Inputs may jump at a step's boundary: the step's first and last
    node are looked up just inside it. `effects` are numbers of the rig that change within the run, held
    over short blocks (`Schedule`). `load` acts beside the rig's own, `feedback` gives the command in place of `inputs`.
    `progress` is called with the time reached [s].

    Raises InputError for a step or an error that is not positive; SimulationFailed when the step cannot resolve the
    rig, the leak or a stop that was hit, when a given step does not pass the check, when a state is not finite, or when
    a pressure falls below vacuum; `allow_unresolved` lets all but a state that is not finite pass.
    """
    from sealscope.physics.solvers.limits import longest_step
    from sealscope.physics.state import OUTPUTS, P_2, P_A, STATES

    base = numbers_under(rig, load)
    start_state = state_under(rig, load, x_0)
    if step is not None and not (math.isfinite(step) and step > 0):
        raise InputError(f"step must be > 0 s, got {step}")
    if error is not None and not (math.isfinite(error) and error > 0):
        raise InputError(f"error must be > 0 Pa, got {error}")
    n_out = round(duration * rate)
    schedule = Schedule(effects, base, n_out, rate)
    euler = rig.motor.integrator == "euler"
    run = _Run(inputs, schedule, rate, choose_method(rig, method), euler, allow_unresolved, progress, load, feedback)
    checks = [] if error is None else windows(n_out, rate)
    bounds, finest = {0, n_out}, steps_per_output(rate, LONGEST_STEP / FINEST)
    if step is None:  # checked window by window, and given up at the first that fails
        bounds |= {bound for window in checks for bound in window}
        worst = inputs.largest(np.arange(n_out) / rate)
        step_0 = min(LONGEST_STEP, *(longest_step(p, *worst) for p in schedule.numbers))
        every = steps_per_output(rate, max(step_0, LONGEST_STEP / FINEST))
    else:
        every = steps_per_output(rate, step)
    pressures = slice(P_A, P_2 + 1)
    while True:
        run.refuse_unresolved(every)
        check = StepErrorCheck(rig, rate, error or PRESSURE_TOLERANCE)
        times = 0.0
        rows, y = np.empty((n_out, len(OUTPUTS))), start_state.copy()
        if feedback is not None:
            feedback.restart()
        for start, stop in itertools.pairwise(sorted(bounds)):
            run.advance(y, start, stop, every, rows)
            for first, end in checks:
                if start <= first and end <= stop:
                    before, fine = rows[first, : len(STATES)].copy(), np.empty((end - first, len(OUTPUTS)))
                    run.advance(before, first, end, 2 * every, fine, first)
                    times = max(times, check.excess(rows[first:end, pressures], fine[:, pressures]))
            if times > 1.0 and every < finest and step is None:
                break
        h = 1.0 / (rate * every)
        if times <= 1.0 or every >= finest or (step is not None and allow_unresolved):
            volts = None if feedback is None else feedback.volts(n_out)
            flow = None if feedback is None else feedback.compensated(n_out)
            moved = check.moved if checks else math.nan
            return Trajectory(np.arange(n_out) / rate, rows, run.method, h, moved, volts, flow)
        if step is not None:
            raise SimulationFailed(
                f"the run is under-resolved: halving the step of {h:.3g} s ({run.method}) moves {check.worst()}; take "
                "a smaller step, or state an error instead of a step"
            )
        # of order four, or near it; a step far too long tells little
        longer = min(2.0, (1.1 * times) ** 0.25) if math.isfinite(times) else 2.0
        every = min(max(every + 1, math.ceil(every * longer)), finest)


@dataclass
class _Run:
    """One run of a rig, which can be integrated at one step or another."""

    inputs: RunInputs
    schedule: Schedule
    rate: float
    method: Literal["rk4", "imex"]
    euler: bool
    allow_unresolved: bool
    progress: Progress | None
    load: Force | None = None
    feedback: Feedback | None = None
    reached: float = 0.0

    def refuse_unresolved(self, every: int) -> None:
        """Raise SimulationFailed where `every` steps an output cannot resolve the rig."""
        if not self.allow_unresolved:
            for p in self.schedule.numbers:
                refuse_unresolved(p, 1.0 / (self.rate * every), self.method)

    def advance(self, y: Array, start: int, stop: int, every: int, rows: Array, origin: int = 0) -> None:
        """Advance the state `y` in place from output `start` to `stop`, `every` steps each; write rows k - origin."""
        from sealscope.physics.rig import packed
        from sealscope.physics.solvers.advance import EXPLICIT, IMPLICIT, advance, advance_closed, nodes_of
        from sealscope.physics.solvers.limits import longest_step

        unloaded = np.zeros((0, 0))
        h = 1.0 / (self.rate * every)
        implicit = IMPLICIT if self.method == "imex" else EXPLICIT
        nodes = nodes_of(implicit, h)
        block = max(1, _BLOCK_STEPS // every)
        last = start
        while last < stop:
            first, last = last, min(last + block, stop)
            steps = np.arange(first * every, last * every, dtype=np.float64)
            u, G, C = map(np.ascontiguousarray, self.inputs.at_nodes(steps * h, nodes))
            F = unloaded if self.load is None else np.ascontiguousarray(self.load.value_at(steps[:, None] * h + nodes))
            worst = float(G.max()), float(C.max())
            for k, end, p in self.schedule.blocks_between(first, last):
                if not self.allow_unresolved and max(worst) > 0.0:
                    refuse_long(h, longest_step(p, *worst), "the leak")
                part = slice((k - first) * every, (end - first) * every)
                out, outputs = rows[k - origin : end - origin], end - k
                inputs, how = (G[part], C[part], F[part]), (packed(p), self.euler, every)
                if self.feedback is None:
                    advance(implicit, y, h, u[part], *inputs, *how, out)
                else:
                    outputs = advance_closed(implicit, y, h, *inputs, *how, k, out, self.feedback.loop)
                self._refuse(p, h, out[:outputs], k)
                if self.feedback is not None and outputs < end - k:
                    self.feedback.refuse()
            if self.progress is not None and last / self.rate > self.reached:
                self.reached = last / self.rate
                self.progress(self.reached)

    def _refuse(self, p: RigNumbers, h: float, rows: Array, first: int) -> None:
        """Raise SimulationFailed where rows from the output `first` on are beyond what the rig allows."""
        from sealscope.physics.solvers.limits import longest_step_on_stop
        from sealscope.physics.state import OUTPUTS, P_2, P_A, POSITION

        if not self.allow_unresolved and (np.abs(rows[:, POSITION]) > 0.5 * p.L).any():
            refuse_long(h, longest_step_on_stop(p), "the hard stop (cylinder.k_stop, d_stop)")
        bad = ~np.isfinite(rows)
        if bad.any():
            k, column = np.unravel_index(int(np.argmax(bad)), bad.shape)
            raise SimulationFailed(
                f"the run diverged: {OUTPUTS[column]} is not finite at t = {(first + k) / self.rate:.4g} s; take a "
                "smaller step or smaller gains"
            )
        low = rows[:, P_A : P_2 + 1] < VACUUM
        if low.any() and not self.allow_unresolved:
            k, column = np.unravel_index(int(np.argmax(low)), low.shape)
            raise SimulationFailed(
                f"{OUTPUTS[P_A + column]} must stay above vacuum ({VACUUM:g} Pa gauge: the rig's oil does not boil), "
                f"got {rows[k, P_A + column]:.4g} Pa at t = {(first + k) / self.rate:.4g} s "
                f"(x = {rows[k, POSITION]:.3f} m); raise fluid.p_charge, take a smaller command, start further from "
                "the cap, let the oil boil (fluid.p_vap), or replace what leaks out (makeup.check_valves = present)"
            )


def refuse_long(h: float, limit: float, what: str) -> None:
    """Raise SimulationFailed where a step h [s] is above the limit that resolves something."""
    if h > limit * (1.0 + 1e-9):
        raise SimulationFailed(f"step must be <= {limit:.2g} s to resolve {what}, got {h:.3g} s; take a smaller step")


def refuse_unresolved(p: RigNumbers, h: float, method: str) -> None:
    """Raise SimulationFailed where a step h [s] cannot resolve the rig."""
    from sealscope.physics.solvers.limits import DECAY_LIMIT, longest_step, stiffest_rate

    refuse_long(
        h, longest_step(p), "speed loop, oil columns and friction of this rig" + " under its load" * (len(p.pushed) > 1)
    )
    rate = stiffest_rate(p)
    if method == "rk4" and p.throttled and h * rate > DECAY_LIMIT:
        raise SimulationFailed(
            f"step must be <= {DECAY_LIMIT / rate:.2g} s for rk4 with throttles (line volumes answer within "
            f"{1 / rate:.2g} s), got {h:.3g} s; use method imex"
        )


def windows(n_out: int, rate: float) -> list[tuple[int, int]]:
    """Choose the outputs (start, stop) of the windows in which a run of `n_out` outputs at `rate` [Hz] is checked."""
    first = min(n_out, round(FIRST_WINDOW * rate))
    checked = [(0, first)]
    length = round(LATER_WINDOW * rate)
    for share in LATER:
        start = round(share * n_out)
        if length and start >= checked[-1][1] and start + length <= n_out:
            checked.append((start, start + length))
    return checked


class StepErrorCheck:
    """Compares windows of a run at one step with those at half of it.

    `moved` [Pa rms]: how far a pressure moved at most; `changed`: how far a detail's RMS did, as a share of it.
    """

    def __init__(self, rig: Rig, rate: float, tolerance: float) -> None:
        """`rate` [Hz] of the outputs; `tolerance` [Pa] of a pressure."""
        self._tolerance = tolerance
        self._every = max(1, round(rate / rig.daq.sample_rate))
        sensors = [getattr(rig.sensors, name) for name in CHAMBERS]
        self._noise = np.repeat([sensor.noise**2 + rig.sensors.common_noise**2 for sensor in sensors], 2)
        self._squares, self._samples = np.zeros((LEVELS, 4)), 0
        self.moved = self.changed = 0.0

    def excess(self, coarse: Array, fine: Array) -> float:
        """Compare one more window; return the largest difference so far over its tolerance.

        `coarse`, `fine`: (n, 4) p_A, p_B, p_1, p_2 [Pa]. Each window's pressures are judged by themselves, the RMS of
        db8's d_1 .. d_4 in both chambers over all windows so far, at the recording's rate and with its noise.
        """
        pressure = SAFETY * float(np.sqrt(np.mean(np.square(coarse - fine), axis=0)).max(initial=0.0))
        self.moved = max(self.moved, pressure)
        if not pressure <= self._tolerance:
            return pressure / self._tolerance
        self._add(coarse, fine)
        if self._samples == 0:
            return pressure / self._tolerance
        recorded = np.sqrt(self._squares / self._samples + self._noise)
        a, b = recorded[:, ::2], recorded[:, 1::2]
        change = float(np.max(np.abs(a - b) / np.where(b > 0, b, 1.0)))
        self.changed = max(self.changed, change)
        return max(pressure / self._tolerance, change / DETAIL_TOLERANCE)

    def worst(self) -> str:
        """Return name, size and tolerance of the quantity furthest beyond its tolerance."""
        if self.moved / self._tolerance >= self.changed / DETAIL_TOLERANCE:
            return f"a pressure by {self.moved:.4g} Pa rms, which must be <= {self._tolerance:.4g} Pa"
        return f"the RMS of a detail by {100 * self.changed:.3g} %, which must be <= {100 * DETAIL_TOLERANCE:.3g} %"

    def _add(self, coarse: Array, fine: Array) -> None:
        """Add the squares of a window's details that do not reach beyond the window."""
        import pywt

        from sealscope.signals.filters import reach

        before, after = reach("db8", LEVELS)[-1]
        runs = np.array([run[:: self._every, column] for column in range(2) for run in (coarse, fine)])
        n = runs.shape[1] // 2**LEVELS * 2**LEVELS
        if n <= before + after:
            return
        _, *details = pywt.swt(runs[:, :n], "db8", level=LEVELS, trim_approx=True, norm=False, axis=-1)
        inside = np.array(details)[..., before : n - after]
        self._squares += np.sum(np.square(inside), axis=-1)
        self._samples += inside.shape[-1]
