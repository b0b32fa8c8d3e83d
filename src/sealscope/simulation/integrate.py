"""Integrate the rig over an experiment: choose method and step, feed the inputs block by block, refuse a result that
cannot be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.recording import Array
from sealscope.simulation.changes import Effect, Schedule

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.physics.rig import RigNumbers

Method = Literal["auto", "rk4", "imex"]
Inputs = Callable[[Array], tuple[Array, Array, Array]]
Progress = Callable[[float], None]

#: Largest step [s] taken unless the caller asks for another: error in p_A under 10 Pa rms
#: (docs/decisions/0004-solvers.md).
DEFAULT_STEP = {"rk4": 5e-4, "imex": 1e-3}
#: Lowest gauge pressure [Pa] the model is valid for: there is no cavitation in it, and oil holds no tension.
VACUUM = -101325.0
_BLOCK_STEPS = 4096
#: How many times finer than its default the step is made for a quick rig without being asked.
_FINER = 10


@dataclass(frozen=True)
class Trajectory:
    """What the integration gives: (n,) times [s] and (n, 17) outputs in the order of
    `sealscope.physics.rig.OUTPUTS`."""

    t: Array
    rows: Array
    method: str
    step: float

    def __getitem__(self, name: str) -> Array:
        from sealscope.physics.rig import OUTPUTS

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


def _steps_per_output(rate: float, step: float) -> int:
    return max(1, math.ceil(1.0 / (rate * step) * (1.0 - 1e-9)))


def integrate(
    rig: Rig,
    inputs: Inputs,
    duration: float,
    rate: float,
    *,
    x_0: float = 0.0,
    method: Method = "auto",
    step: float | None = None,
    allow_unresolved: bool = False,
    progress: Progress | None = None,
    effects: Sequence[Effect] = (),
) -> Trajectory:
    """Integrate from rest over `duration` [s] and report the outputs at `rate` [Hz].

    `inputs(t)` gives command [V] and the leakage coefficients G and C at times `t` of any shape. The step is the
    largest that divides the output interval and is not above `step` (default `DEFAULT_STEP`, down to a tenth of it
    for a quick rig or a large leak). Inputs may jump at a step's boundary: the step's first and last node are looked
    up just inside it. `effects` are numbers of the rig that change within the run, held over short blocks (`Schedule`).
    `progress` is called with the time reached [s].

    Raises InputError for a step that is not positive; SimulationFailed when the step cannot resolve the rig, the leak
    or a stop that was hit, when a state is not finite, or when a pressure falls below vacuum; `allow_unresolved` lets
    all but a state that is not finite pass.
    """
    from sealscope.physics.imex import IMEX_NODES, advance_imex
    from sealscope.physics.limits import longest_step, longest_step_on_stop
    from sealscope.physics.rig import OUTPUTS, POSITION, initial_state, rig_numbers
    from sealscope.physics.rk4 import RK4_NODES, advance_rk4

    chosen = choose_method(rig, method)
    if step is not None and not (math.isfinite(step) and step > 0):
        raise InputError(f"step must be > 0 s, got {step}")
    n_out = round(duration * rate)
    schedule = Schedule(effects, rig_numbers(rig), n_out, rate)

    if step is None:
        default = DEFAULT_STEP[chosen]
        _, G, C = inputs(np.arange(n_out) / rate)
        worst = float(G.max(initial=0.0)), float(C.max(initial=0.0))
        step = max(min(default, *(longest_step(p, *worst) for p in schedule.numbers)), default / _FINER)
    every = _steps_per_output(rate, step)
    h = 1.0 / (rate * every)
    if not allow_unresolved:
        for p in schedule.numbers:
            _refuse_unresolved(p, h, chosen)
    nodes = np.array(IMEX_NODES if chosen == "imex" else RK4_NODES)
    nodes[0], nodes[-1] = 1e-9, 1.0 - 1e-9  # the limits from inside the step
    rows = np.empty((n_out, len(OUTPUTS)))
    y = initial_state(rig, x_0)
    block = max(1, _BLOCK_STEPS // every)
    for first in range(0, n_out, block):
        last = min(first + block, n_out)
        start = np.arange(first * every, last * every, dtype=np.float64)
        u, G, C = inputs((start[:, None] + nodes) * h)
        worst = float(G.max()), float(C.max())
        for k, stop, p in schedule.within(first, last):
            if not allow_unresolved and max(worst) > 0.0:
                _refuse_long(h, longest_step(p, *worst), "the leak")
            steps = slice((k - first) * every, (stop - first) * every)
            if chosen == "imex":
                advance_imex(y, h, u[steps], G[steps], C[steps], p, every, rows[k:stop])
            else:
                euler = rig.motor.integrator == "euler"
                advance_rk4(y, h, u[steps], G[steps], C[steps], p, euler, every, rows[k:stop])
        if not allow_unresolved and np.any(np.abs(rows[first:last, POSITION]) > 0.5 * p.L):
            _refuse_long(h, longest_step_on_stop(p), "the hard stop (cylinder.k_stop, d_stop)")
        _check(rows[first:last], first, rate, allow_unresolved)
        if progress is not None:
            progress(last / rate)
    return Trajectory(np.arange(n_out) / rate, rows, chosen, h)


def _refuse_long(h: float, limit: float, what: str) -> None:
    if h > limit * (1.0 + 1e-9):
        raise SimulationFailed(f"step must be <= {limit:.2g} s to resolve {what}, got {h:.3g} s; take a smaller step")


def _refuse_unresolved(p: RigNumbers, h: float, method: str) -> None:
    from sealscope.physics.limits import DECAY_LIMIT, longest_step, stiffest_rate

    _refuse_long(h, longest_step(p), "speed loop, oil columns and friction of this rig")
    limit = DECAY_LIMIT / stiffest_rate(p)
    if method == "rk4" and p.throttled and h > limit:
        raise SimulationFailed(
            f"step must be <= {limit:.2g} s for rk4 with throttles (line volumes answer within "
            f"{1 / stiffest_rate(p):.2g} s), got {h:.3g} s; use method imex"
        )


def _check(rows: Array, first: int, rate: float, allow_unresolved: bool) -> None:
    from sealscope.physics.rig import OUTPUTS, P_2, P_A

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
