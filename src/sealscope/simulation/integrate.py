"""Integrate the rig over an experiment: choose method and step, feed the inputs block by block, refuse a result that
cannot be trusted."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.recording import Array
from sealscope.simulation.changes.rig import Effect, Schedule
from sealscope.simulation.resolution import PRESSURE_TOLERANCE

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.physics.rig import RigNumbers

Method = Literal["auto", "rk4", "imex"]
Inputs = Callable[[Array], tuple[Array, Array, Array]]
Progress = Callable[[float], None]
#: Step [s] that suits the thesis's rig: error in p_A under 10 Pa rms (docs/decisions/0004-solvers.md).
DEFAULT_STEP = {"rk4": 5e-4, "imex": 1e-3}

#: Longest step [s] that is tried when the step is chosen by error (docs/decisions/0004-solvers.md), and how many times
#: finer it may become.
LONGEST_STEP = 1e-3
FINEST = 20
#: Lowest gauge pressure [Pa] the model is valid for: there is no cavitation in it, and oil holds no tension.
VACUUM = -101325.0
_BLOCK_STEPS = 4096


@dataclass(frozen=True)
class Trajectory:
    """What the integration gives: (n,) times [s] and (n, 17) outputs in the order of
    `sealscope.physics.rig.OUTPUTS`; `error`: the estimated rms error [Pa] of the pressures, NaN where the step was
    given."""

    t: Array
    rows: Array
    method: str
    step: float
    error: float = math.nan

    def __getitem__(self, name: str) -> Array:
        from sealscope.physics.state import OUTPUTS

        return self.rows[:, OUTPUTS.index(name)]


def choose_method(rig: Rig, method: Method) -> Literal["rk4", "imex"]:
    """The stated method, or the one that suits the rig: implicit-explicit with throttles, explicit without."""
    if method not in ("auto", "rk4", "imex"):
        raise InputError(f"method must be auto, rk4 or imex, got {method!r}")
    throttled = rig.line.orifices == "present"
    if method == "imex" and not throttled:
        raise InputError("method imex needs throttles (line.orifices = present), got line.orifices = absent; use rk4")
    euler = rig.motor.integrator == "euler"
    if euler and (method == "imex" or (throttled and method == "auto")):
        raise InputError("motor.integrator = euler (eq. 4.2 taken literally) needs method rk4, got imex")
    if method == "auto":
        return "imex" if throttled else "rk4"
    return method


def steps_per_output(rate: float, step: float) -> int:
    """Steps between outputs at `rate` [Hz]: as few as keep the step within `step` [s]."""
    return max(1, math.ceil(1.0 / (rate * step) * (1.0 - 1e-9)))


class _TooCoarseError(Exception):
    """Halving the step moved a window of the run `times` further than it may."""

    def __init__(self, times: float) -> None:
        super().__init__(times)
        self.times = times


def integrate(
    rig: Rig,
    inputs: Inputs,
    duration: float,
    rate: float,
    *,
    x_0: float = 0.0,
    method: Method = "auto",
    step: float | None = None,
    error: float = PRESSURE_TOLERANCE,
    allow_unresolved: bool = False,
    progress: Progress | None = None,
    effects: Sequence[Effect] = (),
) -> Trajectory:
    """Integrate from rest over `duration` [s] and report the outputs at `rate` [Hz].

    `inputs(t)` gives command [V] and the leakage coefficients G and C at times `t` of any shape; where it has them,
    `inputs.at_nodes(start, offsets)` gives the same at start[:, None] + offsets and `inputs.largest(t)` the largest G
    and C at times t. A step that is given is taken (the largest that divides the output interval and is not above it).
    Else it is chosen by error: the largest from `LONGEST_STEP` down, refined until in short windows spread over the run
    its half moves no pressure by more than `error` [Pa rms] and no detail's RMS by more than 0.1 % (`resolution`), down
    to `FINEST` of it; `Trajectory.error` tells what was found. Inputs may jump at a step's boundary: the step's first
    and last node are looked up just inside it. `effects` are numbers of the rig that change within the run, held over
    short blocks (`Schedule`). `progress` is called with the time reached [s].

    Raises InputError for a step or an error that is not positive; SimulationFailed when the step cannot resolve the
    rig, the leak or a stop that was hit, when a state is not finite, or when a pressure falls below vacuum;
    `allow_unresolved` lets all but a state that is not finite pass.
    """
    from sealscope.physics.rig import rig_numbers
    from sealscope.physics.solvers.limits import longest_step

    chosen = choose_method(rig, method)
    if step is not None and not (math.isfinite(step) and step > 0):
        raise InputError(f"step must be > 0 s, got {step}")
    if not (math.isfinite(error) and error > 0):
        raise InputError(f"error must be > 0 Pa, got {error}")
    n_out = round(duration * rate)
    schedule = Schedule(effects, rig_numbers(rig), n_out, rate)
    run = _Run(rig, inputs, schedule, n_out, rate, chosen, x_0, allow_unresolved, progress)
    if step is not None:
        return run.at(steps_per_output(rate, step), None)
    worst = run.largest_leak()
    longest = LONGEST_STEP
    step = max(min(longest, *(longest_step(p, *worst) for p in schedule.numbers)), longest / FINEST)
    every, finest = steps_per_output(rate, step), steps_per_output(rate, longest / FINEST)
    while True:
        try:
            return run.at(every, error, last=every >= finest)
        except _TooCoarseError as found:
            # of order four, or near it; a step far too long tells little
            longer = min(2.0, (1.1 * found.times) ** 0.25) if math.isfinite(found.times) else 2.0
            every = min(max(every + 1, math.ceil(every * longer)), finest)


@dataclass
class _Run:
    """One run of a rig, to be integrated at one step or another."""

    rig: Rig
    inputs: Inputs
    schedule: Schedule
    n_out: int
    rate: float
    method: Literal["rk4", "imex"]
    x_0: float
    allow_unresolved: bool
    progress: Progress | None
    reached: float = 0.0

    def largest_leak(self) -> tuple[float, float]:
        t = np.arange(self.n_out) / self.rate
        if hasattr(self.inputs, "largest"):
            G, C = self.inputs.largest(t)
            return float(G), float(C)
        _, G, C = self.inputs(t)
        return float(G.max(initial=0.0)), float(C.max(initial=0.0))

    def at(self, every: int, error: float | None, *, last: bool = False) -> Trajectory:
        """The run with `every` steps an output; with an error [Pa], checked in windows against half the step, and
        given up (`_TooCoarseError`) where it is beyond it, unless this is the last resort."""
        from sealscope.physics.rig import initial_state
        from sealscope.physics.state import OUTPUTS, P_2, P_A
        from sealscope.simulation.resolution import Judge, windows

        n_out = self.n_out
        h = 1.0 / (self.rate * every)
        if not self.allow_unresolved:
            for p in self.schedule.numbers:
                refuse_unresolved(p, h, self.method)
        rows = np.empty((n_out, len(OUTPUTS)))
        y = initial_state(self.rig, self.x_0)
        checks = windows(n_out, self.rate) if error is not None else []
        bounds = sorted({0, n_out, *(bound for check in checks for bound in check)})
        judge = None if error is None else Judge(self.rig, self.rate, error)
        pressures = slice(P_A, P_2 + 1)
        for start, stop in itertools.pairwise(bounds):
            before = y.copy()
            self._advance(y, start, stop, every, rows)
            if judge is not None and (start, stop) in checks:
                fine = np.empty((stop - start, len(OUTPUTS)))
                self._advance(before, start, stop, 2 * every, fine, start)
                times = judge.beyond(rows[start:stop, pressures], fine[:, pressures])
                if not (times <= 1.0 or last):
                    raise _TooCoarseError(times)
        found = math.nan if judge is None else judge.found
        return Trajectory(np.arange(n_out) / self.rate, rows, self.method, h, found)

    def _advance(self, y: Array, start: int, stop: int, every: int, rows: Array, origin: int = 0) -> None:
        """Outputs start <= k < stop into rows k - origin, with `every` steps an output, from `y` on, which moves."""
        from sealscope.physics.solvers.imex import IMEX_NODES, advance_imex
        from sealscope.physics.solvers.limits import longest_step, longest_step_on_stop
        from sealscope.physics.solvers.rk4 import RK4_NODES, advance_rk4
        from sealscope.physics.state import survey

        h = 1.0 / (self.rate * every)
        nodes = np.array(IMEX_NODES if self.method == "imex" else RK4_NODES)
        nodes[0], nodes[-1] = 1e-9, 1.0 - 1e-9  # the limits from inside the step
        euler = self.rig.motor.integrator == "euler"
        block = max(1, _BLOCK_STEPS // every)
        for first in range(start, stop, block):
            last = min(first + block, stop)
            steps = np.arange(first * every, last * every, dtype=np.float64)
            if hasattr(self.inputs, "at_nodes"):
                u, G, C = self.inputs.at_nodes(steps * h, nodes * h)
            else:
                u, G, C = self.inputs((steps[:, None] + nodes) * h)
            worst = float(G.max()), float(C.max())
            for k, end, p in self.schedule.within(first, last):
                if not self.allow_unresolved and max(worst) > 0.0:
                    refuse_long(h, longest_step(p, *worst), "the leak")
                part = slice((k - first) * every, (end - first) * every)
                out = rows[k - origin : end - origin]
                if self.method == "imex":
                    advance_imex(y, h, u[part], G[part], C[part], p, every, out)
                else:
                    advance_rk4(y, h, u[part], G[part], C[part], p, euler, every, out)
            done = rows[first - origin : last - origin]
            finite, reach, least = survey(done)
            if not (self.allow_unresolved or reach <= 0.5 * p.L):
                refuse_long(h, longest_step_on_stop(p), "the hard stop (cylinder.k_stop, d_stop)")
            if not finite or (not self.allow_unresolved and least < VACUUM):
                _check(done, first, self.rate, self.allow_unresolved)
            if self.progress is not None and last / self.rate > self.reached:
                self.reached = last / self.rate
                self.progress(self.reached)


def refuse_long(h: float, limit: float, what: str) -> None:
    """Raise SimulationFailed where a step h [s] is above the limit that resolves something."""
    if h > limit * (1.0 + 1e-9):
        raise SimulationFailed(f"step must be <= {limit:.2g} s to resolve {what}, got {h:.3g} s; take a smaller step")


def refuse_unresolved(p: RigNumbers, h: float, method: str) -> None:
    """Raise SimulationFailed where a step h [s] cannot resolve the rig."""
    from sealscope.physics.solvers.limits import DECAY_LIMIT, longest_step, stiffest_rate

    refuse_long(h, longest_step(p), "speed loop, oil columns and friction of this rig")
    limit = DECAY_LIMIT / stiffest_rate(p)
    if method == "rk4" and p.throttled and h > limit:
        raise SimulationFailed(
            f"step must be <= {limit:.2g} s for rk4 with throttles (line volumes answer within "
            f"{1 / stiffest_rate(p):.2g} s), got {h:.3g} s; use method imex"
        )


def _check(rows: Array, first: int, rate: float, allow_unresolved: bool) -> None:
    from sealscope.physics.state import OUTPUTS, P_2, P_A

    bad = ~np.isfinite(rows)
    if bad.any():
        k, column = np.unravel_index(int(np.argmax(bad)), bad.shape)
        raise SimulationFailed(
            f"the run diverged: {OUTPUTS[column]} is not finite at t = {(first + k) / rate:.4g} s; take a smaller "
            f"step or smaller gains"
        )
    pressures = rows[:, P_A : P_2 + 1]
    if not allow_unresolved and pressures.min() < VACUUM:
        k, column = np.unravel_index(int(np.argmax(pressures < VACUUM)), pressures.shape)
        raise SimulationFailed(
            f"{OUTPUTS[P_A + column]} must stay above vacuum ({VACUUM:g} Pa gauge: the model has no cavitation), got "
            f"{pressures[k, column]:.4g} Pa at t = {(first + k) / rate:.4g} s (x = {rows[k, 4]:.3f} m); "
            "raise fluid.p_charge, take a smaller command, start further from the cap, or replace what leaks out "
            "(makeup.check_valves = present)"
        )
