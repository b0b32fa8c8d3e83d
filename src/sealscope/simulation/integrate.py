"""Integrate the rig over an experiment: compute its inputs, choose the solver's step, and check the result."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.changes import Schedule
from sealscope.simulation.closed_loop import Feedback, outputs_per_sample
from sealscope.simulation.commands import Sine, check_command
from sealscope.simulation.experiment import FILTER_REACH, LONGEST_STEP, Experiment, choose_method
from sealscope.simulation.leaks import Leak
from sealscope.simulation.sizing import leak_flow, mean_while_open, size_leaks
from sealscope.simulation.targets_and_loads import loaded_rig_numbers, loaded_standstill_state
from sealscope.units import LITRE_PER_MINUTE, P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.physics.rig import RigNumbers

#: Called with the name of the current task and its completed fraction, 0..1.
Progress = Callable[[str, float], None]
#: Step [s] that suits the thesis's rig: error in p_A under 10 Pa rms (docs/decisions/0004-solvers.md).
DEFAULT_STEP = {"rk4": 5e-4, "imex": 1e-3}
#: The shortest step that is chosen by error is `LONGEST_STEP` over this.
MAX_STEP_REFINEMENT = 20
#: Lowest gauge pressure [Pa] for which the model is valid if the oil does not boil (`fluid.p_vap`).
VACUUM = -P_ATM
#: Largest relative error of a detail's RMS in a recording, its noise included.
DETAIL_TOLERANCE = 1e-3
#: Factor from differences in the windows to the error of the whole run. The difference to half the step is 15/16 of the
#: error of a method of order four.
SAFETY = 1.2
#: Lengths [s] of the first window and of the later ones, and the starts of these as fractions of the run.
FIRST_WINDOW, LATER_WINDOW = 2.0, 1.0
LATER_STARTS = (0.5, 0.9)
#: Levels of the wavelet details that are compared.
LEVELS = 4
#: Most solver steps for which the inputs are computed at once, which bounds the memory.
_BLOCK_STEPS = 4096


@dataclass(frozen=True)
class Trajectory:
    """Result of an integration: times `t` (n,) [s] and outputs `rows` (n, 21) in the order of `physics.state.OUTPUTS`.

    `trajectory[name]` gives one output (n,). `method`: rk4 or imex; `step` [s]: the solver's step; `error` [Pa]:
    estimated rms error of the pressures, NaN if it was not checked. `volts` (n,) [V]: voltage of a controller, if any;
    `compensated` (n,) [m^3/s]: leakage flow that it reports to compensate, if any.
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
    """Inputs of a run over time: the voltage command, and the leakage coefficients G and C summed over all leaks.

    `leaks`, all with coefficients (`Leak`), replace those of the experiment.
    """

    def __init__(self, experiment: Experiment, leaks: tuple[Leak, ...]) -> None:
        self._leaks = experiment.scale_with_viscosity(leaks)
        # 0 under a target, for which the controller sets the voltage (`Feedback`)
        self._command = experiment.voltage_command if experiment.target is None else Sine(amplitude=0.0, omega=0.0)
        self._duration, self._limit = experiment.duration, experiment.rig.daq.u_max

    def at_nodes(self, start: Array, offsets: Array) -> tuple[Array, Array, Array]:
        """Compute the command [V], G [m^3/(s Pa)] and C [m^3/(s Pa^0.5)], each (steps, nodes), for some solver steps.

        `start` (steps,): beginnings of the steps [s]; `offsets` (nodes,): times [s] after each at which the solver
        needs its inputs. Raises InputError for a command beyond the converter's limit within the run.
        """
        t = np.empty((start.size, offsets.size))
        for node, offset in enumerate(offsets):  # by columns, as NumPy is slow along a row of three numbers
            t[:, node] = start + offset
        u = self._command.volts(t)
        if not (u.max(initial=0.0) <= self._limit and u.min(initial=0.0) >= -self._limit):  # also for NaN
            check_command(self._command, t[t <= self._duration], self._limit)
            # beyond the limit only after the recording's end, where the solver runs on for the anti-alias filter
            u = np.clip(u, -self._limit, self._limit)
        return u, *self._leakage(t)

    def max_leakage(self, t: Array) -> tuple[float, float]:
        """Compute the largest G [m^3/(s Pa)] and the largest C [m^3/(s Pa^0.5)] that occur at the times t [s]."""
        G, C = self._leakage(t)
        return float(G.max(initial=0.0)), float(C.max(initial=0.0))

    def _leakage(self, t: Array) -> tuple[Array, Array]:
        """Compute G [m^3/(s Pa)] and C [m^3/(s Pa^0.5)] at times t [s], each with the shape of t."""
        G, C = np.zeros(t.shape), np.zeros(t.shape)
        latest = t.max(initial=-math.inf)
        for leak in self._leaks:
            if leak.coefficient and latest >= leak.opening.onset():  # else the leak is shut at all these times
                coefficient = leak.coefficient * leak.opening.value_at(t)
                if leak.law == "laminar":
                    G = G + coefficient
                else:
                    C = C + coefficient
        return G, C


def oversampling(experiment: Experiment) -> int:
    """Compute the number of solver outputs per recorded sample that the anti-alias filter and a controller need.

    Without a stated step, `DEFAULT_STEP` of the integration method is assumed.
    """
    max_step = experiment.step or DEFAULT_STEP[choose_method(experiment.rig, experiment.method)]
    min_outputs = oversampling_of(experiment.rate, max_step)
    controller = experiment.active_controller
    return min_outputs if controller is None else outputs_per_sample(experiment.rate, controller.rate, min_outputs)


def oversampling_of(rate: float, step: float) -> int:
    """Compute the number of solver outputs per sample, for samples at `rate` [Hz] and steps of at most `step` [s].

    It is 4 for the anti-alias filter, or fewer if a sample takes fewer than 4 steps.
    """
    return min(4, steps_per_output(rate, step))


def steps_per_output(rate: float, step: float) -> int:
    """Compute the fewest solver steps between two outputs at `rate` [Hz] so that a step takes at most `step` [s]."""
    return max(1, math.ceil(1.0 / (rate * step) * (1.0 - 1e-9)))  # 1e-9: a quotient just above a whole number is whole


def run_with_sized_leaks(
    experiment: Experiment, progress: Progress | None = None
) -> tuple[tuple[Leak, ...], Trajectory]:
    """Integrate an experiment with leaks of the stated mean flows; return the leaks with coefficients, and the run.

    Raises InputError for a leak not smaller than the pump's mean flow |Q_1| or never open, SimulationFailed if the
    search for the coefficients (`size_leaks`) does not converge.
    """
    leaks, dp_0 = experiment.leaks, experiment.rig.line.dp_0
    # the search begins at the coefficient 0
    initial_leaks = tuple(leak if leak.mean is None else replace(leak, mean=None, coefficient=0.0) for leak in leaks)
    if not any(leak.mean for leak in leaks):
        return initial_leaks, integrate_run(experiment, initial_leaks, progress=progress)
    is_first_run = True  # it has the sought coefficients 0, so that these leaks do not change the pump's flow

    def measure(coefficients: Array) -> tuple[Array, tuple[tuple[Leak, ...], Trajectory]]:
        """Simulate the leaks with `coefficients` (n,); return the flows per unit of coefficient, the leaks and the run.

        The flows (n,) [m^3/s] are mean flows under the pressures of this run, 0 for leaks without a stated mean flow.
        """
        nonlocal is_first_run
        pairs = zip(initial_leaks, coefficients, strict=True)
        sized_leaks = tuple(replace(leak, coefficient=float(coefficient)) for leak, coefficient in pairs)
        run = integrate_run(experiment, sized_leaks)
        pump_flow = float(np.mean(np.abs(run["Q_1"])))
        unit_flows = np.zeros(len(leaks))
        for k, leak in enumerate(leaks):
            if not leak.mean:
                continue
            if is_first_run and leak.mean >= pump_flow:
                raise InputError(
                    f"a leak must be smaller than the pump's mean flow, {pump_flow / LITRE_PER_MINUTE:.4g} L/min for "
                    f"this command, got {leak.mean / LITRE_PER_MINUTE:.4g} L/min ({leak})"
                )
            (unit_leak,) = experiment.scale_with_viscosity((replace(sized_leaks[k], coefficient=1.0),))
            unit_flow = leak_flow(unit_leak, run.t, run["p_A"] - run["p_B"], dp_0)
            # weighted by the opening 0..1 of `leak`; that of `unit_leak` is divided by the oil's viscosity
            unit_flows[k] = mean_while_open(leak, run.t, unit_flow)
            if not unit_flows[k] > 0:
                raise InputError(f"a leak with a mean flow must be open within the run, got {leak}")
        is_first_run = False
        return unit_flows, (sized_leaks, run)

    coefficients = np.array([leak.coefficient or 0.0 for leak in initial_leaks])
    _, leaks_and_run = size_leaks(leaks, coefficients, measure, progress)
    return leaks_and_run


def integrate_run(
    experiment: Experiment,
    leaks: tuple[Leak, ...],
    *,
    step: float | None = None,
    error: float | None = None,
    duration: float | None = None,
    rate: float | None = None,
    progress: Progress | None = None,
    task: str = "simulating",
) -> Trajectory:
    """Integrate an experiment from standstill over `duration` [s], with outputs at `rate` [Hz].

    `leaks`, all with coefficients, replace those of the experiment. `step` [s] and `error` [Pa] replace the
    experiment's unless None; with a `step` stated here the error is not checked. By default the duration is that of the
    recording plus the reach of the anti-alias filter, and the rate is the one that the instruments need. `progress` is
    called with the name of the `task`.

    A stated step is rounded down to a divisor of the output interval. If none is stated, ever shorter steps are tried
    until one passes a check: from the longest that resolves the rig, at most `LONGEST_STEP`, to `LONGEST_STEP` /
    `MAX_STEP_REFINEMENT`, which is taken even if it fails. The check integrates short windows of the run
    (`comparison_windows`) at half the step as well, and allows changes of the pressures up to `error` [Pa rms]
    (`StepErrorCheck`).

    Raises InputError for a step or an error that is not positive. Raises SimulationFailed if a state is not finite and,
    unless the experiment allows an unresolved run, if

    - a pressure falls below vacuum;
    - the step cannot resolve the rig, the leak or an end stop that was hit;
    - a stated step fails the check, unless it is as short as the last step that would be tried.
    """
    from sealscope.physics.solvers.limits import longest_step
    from sealscope.physics.state import OUTPUTS

    if duration is None:
        duration = (round(experiment.duration * experiment.rate) + FILTER_REACH) / experiment.rate
    rate = rate or experiment.rate * oversampling(experiment)
    allowed_error = experiment.error_allowed if error is None else error
    is_checked = step is None
    step = experiment.step if step is None else step
    for name, value, unit in (("step", step, "s"), ("error", allowed_error, "Pa")):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} must be > 0 {unit}, got {value}")
    n_out = round(duration * rate)
    run = _Integration(experiment, leaks, n_out, rate, progress and partial(progress, task))
    start_state = loaded_standstill_state(experiment.rig, experiment.load, experiment.x_0)
    windows = comparison_windows(n_out, rate) if is_checked else []
    # outputs at which the run stops: a step that fails in a window is abandoned at its end
    bounds = sorted({0, n_out, *itertools.chain.from_iterable(windows)})
    shortest_step = LONGEST_STEP / MAX_STEP_REFINEMENT
    max_steps = steps_per_output(rate, shortest_step)  # most steps per output that are tried
    first_step = step
    if first_step is None:
        max_G, max_C = run.inputs.max_leakage(np.arange(n_out) / rate)
        longest = min(LONGEST_STEP, *(longest_step(p, max_G, max_C) for p in run.schedule.numbers))
        first_step = max(longest, shortest_step)
    n_steps = steps_per_output(rate, first_step)
    while True:
        h = 1.0 / (rate * n_steps)
        if not experiment.allow_unresolved:  # leaks and end stops are checked during the run
            for p in run.schedule.numbers:
                refuse_unresolved(p, h, run.method)
        check = StepErrorCheck(experiment.rig, rate, allowed_error)
        excess = 0.0  # largest ratio of an error to its tolerance
        rows = np.empty((n_out, len(OUTPUTS)))
        y = start_state.copy()
        if run.feedback is not None:
            run.feedback.restart()
        for start, stop in itertools.pairwise(bounds):
            window_state = y.copy()
            run.advance(y, start, stop, n_steps, rows)
            if (start, stop) in windows:
                excess = max(excess, run.compare_with_half_step(window_state, rows, start, stop, n_steps, check))
            if excess > 1.0 and n_steps < max_steps and step is None:
                break  # a shorter step is tried at once
        # the check is passed, or no other step is to be tried
        if excess <= 1.0 or n_steps >= max_steps or (step is not None and experiment.allow_unresolved):
            volts = None if run.feedback is None else run.feedback.volts(n_out)
            compensated = None if run.feedback is None else run.feedback.compensated_flow(n_out)
            found_error = check.pressure_error if windows else math.nan
            return Trajectory(np.arange(n_out) / rate, rows, run.method, h, found_error, volts, compensated)
        if step is not None:
            raise SimulationFailed(
                f"the run is under-resolved: halving the step of {h:.3g} s ({run.method}) moves "
                f"{check.describe_worst()}; take a smaller step, or state an error instead of a step"
            )
        # the error goes with h^4, here with a margin of 10 %; at most twice the steps, because the error found at a
        # step far too long is unreliable
        refinement = min(2.0, (1.1 * excess) ** 0.25) if math.isfinite(excess) else 2.0
        n_steps = min(max(n_steps + 1, math.ceil(n_steps * refinement)), max_steps)


class _Integration:
    """The integration of an experiment with `leaks` over `n_out` outputs at `rate` [Hz], at any step.

    `schedule`: the model's parameters over time; `feedback`: the controller of a position target, None without one;
    `reported`: outputs last reported to `progress`, so that no fraction of the run is reported again.
    """

    def __init__(
        self,
        experiment: Experiment,
        leaks: tuple[Leak, ...],
        n_out: int,
        rate: float,
        progress: Callable[[float], None] | None,
    ) -> None:
        rig, target, controller = experiment.rig, experiment.target, experiment.active_controller
        self.experiment, self.n_out, self.rate = experiment, n_out, rate
        self.progress, self.reported = progress, 0
        self.inputs = RunInputs(experiment, leaks)
        self.method = choose_method(rig, experiment.method)
        self.schedule = Schedule(experiment.effects(), loaded_rig_numbers(rig, experiment.load), n_out, rate)
        self._records: dict[int, Any] = {}  # parameters of `schedule` by their id, packed
        self.feedback: Feedback | None = None
        if target is not None and controller is not None:
            self.feedback = Feedback(rig, target, controller, duration=n_out / rate, rate=rate, seed=experiment.seed)

    def advance(self, y: Array, start: int, stop: int, n_steps: int, rows: Array, origin: int = 0) -> None:
        """Integrate the state `y` (14,) in place from output `start` to `stop`, with `n_steps` steps per output.

        Output k is written to rows[k - origin]. Raises SimulationFailed if a state is not finite, and without
        `allow_unresolved` also if the step is too long for a leak or an end stop, or if a pressure is below vacuum.
        """
        from sealscope.physics.rig import pack_numbers
        from sealscope.physics.solvers.advance import EXPLICIT, IMPLICIT, advance, advance_closed, step_nodes
        from sealscope.physics.solvers.limits import longest_step
        from sealscope.physics.solvers.loop import SPACING

        h, load = 1.0 / (self.rate * n_steps), self.experiment.load
        euler = self.experiment.rig.motor.integrator == "euler"  # `euler_integral` of `rk4_step`
        implicit = IMPLICIT if self.method == "imex" else EXPLICIT
        nodes = step_nodes(implicit, h)
        max_outputs = max(1, _BLOCK_STEPS // n_steps)
        for first in range(start, stop, max_outputs):
            last = min(first + max_outputs, stop)
            step_numbers = np.arange(first * n_steps, last * n_steps, dtype=np.float64)
            u, G, C = map(np.ascontiguousarray, self.inputs.at_nodes(step_numbers * h, nodes))
            F = np.zeros((0, 0))  # stands for no load
            if load is not None:
                F = np.ascontiguousarray(load.value_at(step_numbers[:, None] * h + nodes))
            max_G, max_C = float(G.max()), float(C.max())
            for k, end, p in self.schedule.blocks_between(first, last):
                if not self.experiment.allow_unresolved and max(max_G, max_C) > 0.0:
                    refuse_long(h, longest_step(p, max_G, max_C), "the leak")
                steps = slice((k - first) * n_steps, (end - first) * n_steps)
                out = rows[k - origin : end - origin]
                if id(p) not in self._records:
                    self._records[id(p)] = pack_numbers(p)
                # the arguments that `advance` and `advance_closed` share, in their order
                arguments = G[steps], C[steps], F[steps], self._records[id(p)], euler, n_steps
                if self.feedback is None:
                    advance(implicit, y, h, u[steps], *arguments, out)
                    self._check_rows(p, h, out, k)
                    continue
                loop = self.feedback.loop
                volts = np.empty((loop.counters[SPACING] * n_steps, len(nodes)))
                n_completed = advance_closed(implicit, y, h, *arguments, k, out, loop, volts)
                self._check_rows(p, h, out[:n_completed], k)
                if n_completed < end - k:  # the controller failed
                    self.feedback.raise_failure()
            if self.progress is not None and last > self.reported:
                self.reported = last
                self.progress(last / self.n_out)

    def compare_with_half_step(
        self, y: Array, rows: Array, first: int, end: int, n_steps: int, check: StepErrorCheck
    ) -> float:
        """Integrate a window of the run again at half the step; return the largest ratio of an error to its tolerance.

        `y` (14,): state at the window's start, which is changed (not an output, whose pressures are at least that of
        vapour); `rows`: outputs of the run, with `n_steps` steps between them; the window has first <= k < end.
        """
        from sealscope.physics.state import OUTPUTS, P_2, P_A

        fine = np.empty((end - first, len(OUTPUTS)))
        self.advance(y, first, end, 2 * n_steps, fine, origin=first)
        pressures = slice(P_A, P_2 + 1)
        return check.add_window(rows[first:end, pressures], fine[:, pressures])

    def _check_rows(self, p: RigNumbers, h: float, rows: Array, first: int) -> None:
        """Raise SimulationFailed if the solver's outputs `rows` (n, 21) have diverged.

        Unless unresolved runs are allowed, a pressure below vacuum or a step h [s] too long for an end stop that was
        hit raises it, too. `first`: number of rows[0] in the run; `p`: parameters.
        """
        from sealscope.physics.solvers.limits import longest_step_on_stop
        from sealscope.physics.state import OUTPUTS, P_2, P_A, POSITION

        if not self.experiment.allow_unresolved and (np.abs(rows[:, POSITION]) > 0.5 * p.L).any():
            refuse_long(h, longest_step_on_stop(p), "the hard stop (cylinder.k_stop, d_stop)")
        diverged = ~np.isfinite(rows)
        if diverged.any():
            k, column = np.unravel_index(int(np.argmax(diverged)), diverged.shape)
            raise SimulationFailed(
                f"the run diverged: {OUTPUTS[column]} is not finite at t = {(first + k) / self.rate:.4g} s; take a "
                "smaller step or smaller gains"
            )
        below_vacuum = rows[:, P_A : P_2 + 1] < VACUUM
        if below_vacuum.any() and not self.experiment.allow_unresolved:
            k, column = np.unravel_index(int(np.argmax(below_vacuum)), below_vacuum.shape)
            raise SimulationFailed(
                f"{OUTPUTS[P_A + column]} must stay above vacuum ({VACUUM:g} Pa gauge: the rig's oil does not boil), "
                f"got {rows[k, P_A + column]:.4g} Pa at t = {(first + k) / self.rate:.4g} s "
                f"(x = {rows[k, POSITION]:.3f} m); raise fluid.p_charge, take a smaller command, start further from "
                "the cap, let the oil boil (fluid.p_vap), or replace what leaks out (makeup.check_valves = present)"
            )


def refuse_long(h: float, limit: float, what: str) -> None:
    """Raise SimulationFailed if the step h [s] exceeds the `limit` [s] that resolves `what`, a part of the rig."""
    if h > limit * (1.0 + 1e-9):
        raise SimulationFailed(f"step must be <= {limit:.2g} s to resolve {what}, got {h:.3g} s; take a smaller step")


def refuse_unresolved(p: RigNumbers, h: float, method: str) -> None:
    """Raise SimulationFailed if steps of h [s] by `method` are too long for a rig `p` without its leaks.

    The limits are `longest_step` and, for throttles with rk4, 2.785/lambda with lambda of `stiffest_rate`.
    """
    from sealscope.physics.solvers.limits import DECAY_LIMIT, longest_step, stiffest_rate

    has_load_tables = len(p.pushed) > 1  # a load over position or velocity acts as a spring or damper
    parts = "speed loop, oil columns and friction of this rig"
    refuse_long(h, longest_step(p), f"{parts} under its load" if has_load_tables else parts)
    rate = stiffest_rate(p)
    if method == "rk4" and p.throttled and h * rate > DECAY_LIMIT:
        raise SimulationFailed(
            f"step must be <= {DECAY_LIMIT / rate:.2g} s for rk4 with throttles (line volumes answer within "
            f"{1 / rate:.2g} s), got {h:.3g} s; use method imex"
        )


def comparison_windows(n_out: int, rate: float) -> list[tuple[int, int]]:
    """Choose the time windows in which the solver's step is checked, as pairs (start, stop) of output indices.

    They are the first 2 s, and 1 s from 50 % and from 90 % of the run on, unless such a window would overlap the one
    before, exceed the run or contain no output. The run has `n_out` outputs at `rate` [Hz].
    """
    windows = [(0, min(n_out, round(FIRST_WINDOW * rate)))]
    length = round(LATER_WINDOW * rate)
    for fraction in LATER_STARTS:
        start = round(fraction * n_out)
        if length and start >= windows[-1][1] and start + length <= n_out:
            windows.append((start, start + length))
    return windows


class StepErrorCheck:
    """Comparison of a run at one solver step with the same run at half that step, window by window.

    `rate` [Hz]: rate of the solver's outputs; `tolerance` [Pa rms]: allowed difference of a pressure. `pressure_error`
    [Pa]: largest rms difference of a pressure in a window so far, times `SAFETY`; `detail_error`: largest relative
    difference of the RMS of a wavelet detail so far.
    """

    def __init__(self, rig: Rig, rate: float, tolerance: float) -> None:
        self._tolerance = tolerance
        self._outputs_per_sample = max(1, round(rate / rig.daq.sample_rate))
        sensors = [getattr(rig.sensors, name) for name in CHAMBERS]
        # four columns: p_A at the step and at half the step, then p_B
        self._noise_variances = np.repeat([sensor.noise**2 + rig.sensors.common_noise**2 for sensor in sensors], 2)
        self._squares = np.zeros((LEVELS, 4))  # sums of the squared details over all windows so far
        self._samples = 0  # of `_squares`
        self.pressure_error = self.detail_error = 0.0

    def add_window(self, coarse: Array, fine: Array) -> float:
        """Compare both runs in one more window; return the largest ratio of an error to its tolerance.

        `coarse`, `fine` (n, 4): p_A, p_B, p_1, p_2 [Pa] at the step and at half the step. The error of a pressure is
        the rms difference within the window, times `SAFETY`. If all pressures are within their tolerance, the RMS of
        the db8 wavelet details d_1 .. d_4 of p_A and p_B are compared, too, over all windows so far that are long
        enough for the wavelet. They are those at the recording's sampling rate, without its anti-alias filter, and with
        the variance of the sensors' noise, which white noise has in each detail.
        """
        pressure_error = SAFETY * float(np.sqrt(np.mean(np.square(coarse - fine), axis=0)).max(initial=0.0))
        self.pressure_error = max(self.pressure_error, pressure_error)
        if not pressure_error <= self._tolerance:  # also for NaN
            return pressure_error / self._tolerance
        self._add_detail_squares(coarse, fine)
        if self._samples == 0:
            return pressure_error / self._tolerance
        recorded_rms = np.sqrt(self._squares / self._samples + self._noise_variances)
        coarse_rms, fine_rms = recorded_rms[:, ::2], recorded_rms[:, 1::2]  # both alternate in the columns
        # 1.0: where the finer run has neither a detail nor noise, the other's RMS itself is the error
        detail_error = float(np.max(np.abs(coarse_rms - fine_rms) / np.where(fine_rms > 0, fine_rms, 1.0)))
        self.detail_error = max(self.detail_error, detail_error)
        return max(pressure_error / self._tolerance, detail_error / DETAIL_TOLERANCE)

    def describe_worst(self) -> str:
        """Describe the largest difference, relative to its tolerance, of a pressure or of a wavelet detail's RMS."""
        if self.pressure_error / self._tolerance >= self.detail_error / DETAIL_TOLERANCE:
            return f"a pressure by {self.pressure_error:.4g} Pa rms, which must be <= {self._tolerance:.4g} Pa"
        error, tolerance = 100 * self.detail_error, 100 * DETAIL_TOLERANCE
        return f"the RMS of a detail by {error:.3g} %, which must be <= {tolerance:.3g} %"

    def _add_detail_squares(self, coarse: Array, fine: Array) -> None:
        """Add the squared details of p_A and p_B of both runs (`coarse`, `fine`, each (n, 4)) in a window to the sums.

        Samples near the window's ends, where the wavelet's filters reach beyond it, are left out.
        """
        import pywt

        from sealscope.signals.details import reach

        before, after = reach("db8", LEVELS)[-1]  # [-1]: the highest level reaches furthest
        # both runs' p_A, then both runs' p_B
        runs = np.array([run[:: self._outputs_per_sample, column] for column in range(2) for run in (coarse, fine)])
        n = runs.shape[1] // 2**LEVELS * 2**LEVELS  # the stationary transform needs a multiple
        if n <= before + after:
            return
        _, *details = pywt.swt(runs[:, :n], "db8", level=LEVELS, trim_approx=True, norm=False, axis=-1)
        inside = np.array(details)[..., before : n - after]
        self._squares += np.sum(np.square(inside), axis=-1)
        self._samples += inside.shape[-1]
