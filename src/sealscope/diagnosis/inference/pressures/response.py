"""Pressures and command alone: the whole response of p_A - p_B, simulated and linearised block by block.

The rig reduced to what p_A - p_B depends on has seven states: the difference p, the piston's speed v and position, the
friction, the motor's speed, its current and the integral of its speed loop, under the laws of `sealscope.physics`. Of
the friction there are two hypotheses, Stribeck's law and LuGre's; the likelier at the beginning is taken. With y(theta)
the simulated pressure difference and theta_k the parameters of block k, which wander from block to block,

    y_k(theta) = y_k(theta_k^0) + J_k (theta_k - theta_k^0),

where each block is linear about its own theta_k^0: an iterated Kalman filter leads it from block to block (`Follower`),
live and over a recording alike. All lanes of one call of the kernel are one Jacobian: the path, and the path with each
parameter a little more in all blocks; their states are carried from block to block. Over a recording what is left is
Gaussian in all theta_k together (`Response`), so that what the blocks say of one parameter, all others eliminated, is
a block of its inverse. The block keeps sums only.

The ring of `ring_down` is in this response, and so is what it does not see: the ramp, the breakaway, and how far the
pressure falls while sliding. Both providers read the same pressures under the same factorisation, p(pressures |
command): they are two hypotheses of the machine, this one with the laws of the rig, and are never added.

Source: B. M. Bell and F. W. Cathey, IEEE Trans. Autom. Control 38 (1993) 294 (iterated filter as Gauss-Newton steps).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from sealscope.compiled import contracted, kernel
from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.pressures.evidence import (
    WANDER_TIME,
    PressureEvidence,
    block_edges,
    mains_lines,
    middles,
    pressure_evidence,
    priors,
    unusable,
    wander_of_conductance,
)
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_level
from sealscope.physics.lanes import SINGLE_WIDTH, load, select, store
from sealscope.physics.leakage import laminar_leakage
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.rig import RigNumbers, rig_numbers
from sealscope.recordings.recording import Array, Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What a block has of its own: speed per volt [rad/(s V)], speed beside it [rad/s], stiffness of the oil [Pa], Coulomb
#: friction [N], viscous friction [N s/m], breakaway over Coulomb friction [1], its decay [s/m], share by which friction
#: is larger on the way out [1], conductance past the piston [m^3/(s Pa)], give of the contact before it slides [m/N],
#: stiffness of the load [N/m]; then, whose slopes need no simulation of their own: lead of the command [s], lag of the
#: transducers [s], scale of p_A - p_B [1] and its offset [Pa].
PARAMETERS = (
    *("gain", "bias", "K", "F_C", "F_v", "K_brk", "C_c", "side", "G", "give", "spring"),
    *("lead", "lag", "scale", "offset"),
)
GAIN, BIAS, K_OIL, F_C, F_V, K_BRK, C_C, SIDE, G, GIVE, SPRING, LEAD, LAG, SCALE, OFFSET = range(len(PARAMETERS))
_SIZE, _SIMULATED = len(PARAMETERS), SPRING + 1
State = tuple[float, float, float, float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]
#: Laws of the friction, two hypotheses: Stribeck's of the rig; and LuGre's, whose contact does not creep (speed [m/s]).
LAWS = STRIBECK, BRISTLES = "stribeck", "bristles"
_NO_CREEP, _STIFF = 1e-4, 1e-9
#: Longest step of the solver [s]: RK4 is within 100 Pa there, far under the noise of transducers; time constant of the
#: mean position, from which the load's spring counts [s]; row of the position in the states; and first seconds, in
#: which they settle.
_STEP, _CENTRING, _POSITION, _SETTLING = 1.01e-3, 10.0, 5, 1.0
#: Steps of differences as a share of what is believed; gain of twice the log likelihood that is worth a run, most steps
#: of a fit, turns to the noise's variance.
_NUDGE, _ENOUGH, _STEPS, _TURNS = 0.05, 5.0, 12, 2
#: Share of the variance of p_A - p_B that parameters which simulate it leave.
_EXPLAINED = 0.5
#: Where a block's chi square is so many deviations more than expected, jumps are tried.
_UNEXPLAINED = 3.0
#: Least share of a step that is tried; damping [1] of steps that did not gain, at first, at least and at most.
_LEAST_SHARE, _DAMPED, _LEAST_DAMPED, _MOST_DAMPED = 0.02, 0.1, 1e-3, 100.0
#: Beginning along which it is run once before, and the blocks there [s].
_BEGINNING, _BLOCK = 24.0, 6.0
#: The first fit: length of its window [s], width of the Gaussian that takes the ring out [periods], steps of the slow
#: fit, steps by which starts are compared, and length of the spectra [samples].
_WINDOW, _SLOW, _FIRST_STEPS, _FEW_STEPS, _SEGMENT = 12.0, 0.6, 6, 2, 256
_POSITIVE = [GAIN, K_OIL, F_C, K_BRK, C_C]


@contracted
def _of_way(v: float, now: Parameters) -> float:
    return select(v < 0.0, 1.0 - now[SIDE], 1.0 + now[SIDE])  # type: ignore[no-any-return]


@contracted
def _steady(v: float, now: Parameters, m: RigNumbers) -> tuple[float, float, float]:
    """Return the friction of steady sliding [N], its level [N], and the speed at which the contact slips [m/s]."""
    speed = max(abs(v), m.v_th)
    level = stribeck_level(speed, now[F_C], now[K_BRK], now[C_C]) * _of_way(v, now)
    return level * min(max(v / m.v_th, -1.0), 1.0), level, speed


@contracted
def _held_by(friction: float, before: float, v: float, h: float, now: Parameters, m: RigNumbers) -> tuple[float, float]:
    """Return the friction F [N] after h seconds in which that of steady sliding went from `before` to that at v.

    give dF/dt = v - speed F/level: LuGre's law without its damping, which dies out as the contact slides. With a = h
    speed/(give level), F = (F_0 + (a/2) (before + (1 + a) steady)) / (1 + a + a^2/2), times (give level)^2 above and
    below; and `steady`, that at v.
    """
    steady, level, speed = _steady(v, now, m)
    w, g = h * speed, now[GIVE] * level
    part = 0.5 * w
    return (friction * g * g + part * (before * g + steady * (g + w))) / (g * g + w * (g + part)), steady


@contracted
def _rates(y: State, friction: float, spin: float, now: Parameters, m: RigNumbers) -> State:
    """Return dy/dt of y = (p, v, omega, i, I, x) under the speed `spin` [rad/s] that the command asks for."""
    p, v, omega, i, integral, x = y
    past, viscous = m.A_A * v + laminar_leakage(p, now[G]), now[F_V] * v * _of_way(v, now)
    error = spin - omega
    voltage = controller_voltage(error, integral, m.k_p, m.K_i, m.V_max)
    return (
        2.0 * pressure_rate(pump_flow(omega, p, m.q_b, 0.0) - past, m.V, now[K_OIL]),
        piston_acceleration(0.5 * p, -0.5 * p, friction + viscous, now[SPRING] * x, 0.0, m.A_A, m.A_A, m.M_eq),
        shaft_acceleration(i, omega, pump_torque(p, m.q_b), m.C_m, m.B_M, m.J_M),
        winding_current_rate(voltage, i, omega, m.R_c, m.L_c, m.C_e, m.i_max),
        error,
        v - x * (1.0 / _CENTRING),
    )


@contracted
def _moved(y: State, h: float, k: State) -> State:
    return (
        y[0] + h * k[0],
        y[1] + h * k[1],
        y[2] + h * k[2],
        y[3] + h * k[3],
        y[4] + h * k[4],
        y[5] + h * k[5],
    )


@kernel
def simulate_response(
    command: np.ndarray, rate: float, every: int, theta: np.ndarray, states: np.ndarray, m: RigNumbers, out: np.ndarray
) -> None:
    """Write p_A - p_B [Pa] of all lanes at each sample into `out` (n, lanes), by RK4, `every` steps a sample.

    `command` (n + 1,) [V]: at the sample before, then at each, with ramps between; `theta` (p, lanes), a row a
    parameter; `states` (8, lanes): p, v, omega, i, I, x, friction and reading at the sample before, on return at the
    last.
    """
    y = (load(states, 0), load(states, 1), load(states, 2), load(states, 3), load(states, 4), load(states, 5))
    friction, read = load(states, 6), load(states, 7)
    now = (
        load(theta, 0),
        load(theta, 1),
        load(theta, 2),
        load(theta, 3),
        load(theta, 4),
        load(theta, 5),
        load(theta, 6),
        load(theta, 7),
        load(theta, 8),
        load(theta, 9),
        load(theta, 10),
        load(theta, 11),
        load(theta, 12),
    )
    h = 1.0 / (rate * every)
    before = _steady(y[1], now, m)[0]
    for sample in range(command.size - 1):
        rise = command[sample + 1] - command[sample]
        ahead = now[GAIN] * now[LEAD] * (rise * rate) + now[BIAS]
        for step in range(every):
            w_0 = now[GAIN] * (command[sample] + rise * (step / every)) + ahead
            w_1 = now[GAIN] * (command[sample] + rise * ((step + 0.5) / every)) + ahead
            w_2 = now[GAIN] * (command[sample] + rise * ((step + 1.0) / every)) + ahead
            k_1 = _rates(y, friction, w_0, now, m)
            y_1 = _moved(y, 0.5 * h, k_1)
            k_2 = _rates(y_1, _held_by(friction, before, y_1[1], 0.5 * h, now, m)[0], w_1, now, m)
            y_2 = _moved(y, 0.5 * h, k_2)
            k_3 = _rates(y_2, _held_by(friction, before, y_2[1], 0.5 * h, now, m)[0], w_1, now, m)
            y_3 = _moved(y, h, k_3)
            k_4 = _rates(y_3, _held_by(friction, before, y_3[1], h, now, m)[0], w_2, now, m)
            total = _moved(_moved(_moved(k_1, 2.0, k_2), 2.0, k_3), 1.0, k_4)
            y = _moved(y, h / 6.0, total)
            friction, before = _held_by(friction, before, y[1], h, now, m)
            read = read + (y[0] - read) * (h / (h + now[LAG]))
        store(out, sample, read)
    store(states, 0, y[0])
    store(states, 1, y[1])
    store(states, 2, y[2])
    store(states, 3, y[3])
    store(states, 4, y[4])
    store(states, 5, y[5])
    store(states, 6, friction)
    store(states, 7, read)


class Normal(NamedTuple):
    """Normal belief on the parameters: mean (p,) and precision (p, p) in units."""

    mean: Array
    precision: Array


class Beliefs(NamedTuple):
    """What is believed of the parameters (p,): centre and `width` of their mean, and how far they `wander` in 90 s."""

    centre: Array
    width: Array
    wander: Array

    @property
    def unit(self) -> Array:
        """Steps of the parameters for a difference, in which all matrices are."""
        return np.asarray(_NUDGE * np.minimum(self.width, self.wander))

    @property
    def normal(self) -> Normal:
        """What is believed of a machine at first."""
        return Normal(self.centre, np.diag((self.unit / self.width) ** 2))


def beliefs_of(rig: Rig, law: str = STRIBECK) -> Beliefs:
    """Return the beliefs on machines of a rig at its charge pressure: zeros of the transducers change nothing."""
    friction, gain = rig.friction, rig.motor.omega_per_volt
    of_difference = friction.coulomb_pressure == "difference"
    coulomb = coulomb_friction(rig.fluid.p_charge, rig.fluid.p_charge, friction.F_pr, friction.F_cfr, of_difference)
    own = {"gain": gain, "bias": gain, "K": rig.fluid.K_oil, "F_C": coulomb}
    own |= {name: getattr(friction, name) for name in ("F_v", "K_brk", "C_c")}
    scale = np.array([own.get(name, 1.0) for name in PARAMETERS])
    mean, wander = dict(priors("response")), dict(priors("response_wander"))
    mean["give"], wander["give"] = (priors(law)[name] for name in ("give", "give_wander"))
    return Beliefs(
        scale * [mean[name].value for name in PARAMETERS],
        scale * [mean[name].width for name in PARAMETERS],
        scale * [wander[name].width for name in PARAMETERS],
    )


def _tried(table: str, name: str, count: int) -> Array:
    """Return values (count,) of a parameter at which a fit is begun: `width` times either way about `value`."""
    known = priors(table)[name]
    return np.asarray(known.value * np.geomspace(1.0 / known.width, known.width, count))


class Machine(NamedTuple):
    """The reduced rig of the simulation, at a rate [Hz] in `every` steps a sample."""

    numbers: RigNumbers
    rate: float
    every: int
    law: str

    @staticmethod
    def of(rig: Rig, rate: float, law: str = STRIBECK) -> Machine:
        """Return that of a rig's kind."""
        numbers = rig_numbers(rig)
        area = 0.5 * (numbers.A_A + numbers.A_B)
        creep = _NO_CREEP if law == BRISTLES else numbers.v_th
        return Machine(numbers._replace(A_A=area, A_B=area, v_th=creep), rate, math.ceil(1.0 / rate / _STEP), law)

    def run(self, command: Array, paths: Array, states: Array) -> tuple[Array, Array]:
        """Return p_A - p_B (n, m) [Pa] of up to 16 sets (m, p) from their states (8, m), and the states at the end."""
        lanes = np.minimum(np.arange(SINGLE_WIDTH), len(paths) - 1)
        theta = np.ascontiguousarray(paths[lanes, : LAG + 1].T, dtype=np.float32)
        ends = np.ascontiguousarray(states[:, lanes], dtype=np.float32)
        out = np.empty((command.size - 1, SINGLE_WIDTH), dtype=np.float32)
        simulate_response(command, self.rate, self.every, theta, ends, self.numbers, out)
        return out[:, : len(paths)].astype(np.float64), ends[:, : len(paths)].astype(np.float64)

    def from_mid_stroke(self, speed: Array) -> float:
        """Return where the piston begins [m] from the middle of its stroke under the motor's speed (n,) [rad/s]."""
        course = np.cumsum(speed) * self.numbers.q_b / (2.0 * math.pi * self.rate * self.numbers.A_A)
        return float(-0.5 * (course.max() + course.min()))

    def period(self, stiffness: float) -> float:
        """Return the ring's period [samples] at a stiffness of the oil [Pa]."""
        m = self.numbers
        return float(2.0 * math.pi * self.rate * math.sqrt(m.V * m.M_eq / (2.0 * stiffness)) / m.A_A)

    def ringing(self, dp: Array, total: Array, beliefs: Beliefs) -> Array:
        """Return the stiffnesses (2,) [Pa] at which p_A - p_B rings most, beyond noise and hum of p_A + p_B.

        They are the rig's where no frequency that the recording holds is believed of the machine.
        """

        def power(values: Array) -> Array:
            parts = np.lib.stride_tricks.sliding_window_view(values, _SEGMENT)[:: _SEGMENT // 2]
            return np.asarray(np.square(np.abs(np.fft.rfft(parts * np.hanning(_SEGMENT), 4 * _SEGMENT))).mean(axis=0))

        share = beliefs.width[K_OIL] / beliefs.centre[K_OIL]
        middle = 4 * _SEGMENT / self.period(beliefs.centre[K_OIL])
        k = np.arange(math.ceil(middle * math.exp(-2.0 * share)), min(2 * _SEGMENT, int(middle * math.exp(share))))
        if not k.size:
            return np.full(2, beliefs.centre[K_OIL])
        beyond = np.pad((power(dp) - power(total))[k], 1, constant_values=-np.inf)
        peaks = np.flatnonzero((beyond[1:-1] >= beyond[2:]) & (beyond[1:-1] >= beyond[:-2]))
        chosen = np.resize(peaks[np.argsort(-beyond[1:-1][peaks])], 2)
        return np.asarray(beliefs.centre[K_OIL] * (k[chosen] / middle) ** 2)


class Look(NamedTuple):
    """A stretch about parameters `theta` (p,): residual (n,), Jacobian (n, p) [Pa per unit], states at the end."""

    theta: Array
    left: Array
    slopes: Array
    ends: Array

    def cost(self, variance: float, belief: Normal, unit: Array) -> float:
        """Return minus twice the logarithm of the posterior."""
        off = (self.theta - belief.mean) / unit
        return float(self.left @ self.left / variance + off @ belief.precision @ off)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Samples that one set of parameters holds for.

    `command` (n + 1,) [V] with that of the sample before; `dp` (n,) [Pa]; `states` (8, 12): of path and perturbed paths
    before; `unit` (p,); `apart` (n, m): orthonormal rows that are taken out, the mains' lines; `known` (n,): whether a
    sample is. With `smooth` [samples] > 0 only what a Gaussian of that width leaves is fitted.
    """

    machine: Machine
    command: Array
    dp: Array
    states: Array
    unit: Array
    apart: Array
    known: Array
    smooth: float = 0.0

    def fitted_part(self, rows: Array) -> Array:
        """Return rows (n, m) without what is not fitted."""
        rows = gaussian_filter1d(rows, self.smooth, axis=0) if self.smooth > 0.0 else rows
        rows = rows * self.known[:, None]
        return np.asarray(rows - self.apart @ (self.apart.T @ rows))

    def residuals(self, paths: Array) -> Array:
        """Return what up to 16 sets of parameters (m, p) leave (n, m), their means taken out."""
        shown, _ = self.machine.run(self.command, paths, self.states[:, np.zeros(len(paths), dtype=int)])
        left = self.fitted_part(self.dp[:, None] - paths[:, SCALE] * shown)
        return np.asarray(left - left.mean(axis=0))

    def look(self, theta: Array, others: Array) -> tuple[Look, Array]:
        """Return the look about parameters (p,), and what others (m, p) leave, (n, m)."""
        sets = np.concatenate([np.tile(theta, (_SIMULATED + 1, 1)), others])
        sets[range(1, _SIMULATED + 1), range(_SIMULATED)] += self.unit[:_SIMULATED]
        states = self.states[:, [*range(_SIMULATED + 1), *[0] * len(others)]]
        shown, ends = self.machine.run(self.command, sets, states)
        own = [0, *range(_SIMULATED + 1, len(sets))]
        left = self.dp[:, None] - sets[own, SCALE] * shown[:, own] - sets[own, OFFSET]
        slopes = theta[SCALE] * (shown[:, 1 : _SIMULATED + 1] - shown[:, :1])
        earlier = theta[SCALE] * _rate_of_change(shown[:, 0]) * self.machine.rate
        kept = math.exp(-1.0 / (self.machine.rate * max(theta[LAG], _STIFF)))
        rest = np.column_stack(
            [earlier, lfilter([kept - 1.0], [1.0, -kept], earlier), shown[:, 0], np.ones(len(shown))]
        )
        rest *= self.unit[_SIMULATED:]
        rows = self.fitted_part(np.concatenate([left, slopes, rest], axis=1))
        count = len(own)
        return Look(theta, rows[:, 0], rows[:, count:], ends[:, : _SIMULATED + 1]), rows[:, 1:count]

    def spread(self, left: Array) -> float:
        """Return the variance [Pa^2] of a residual (n,), for as many samples as are independent of each other."""
        count = max(float(np.count_nonzero(self.known)) - _SIZE, 1.0)
        return max(float(left @ left), 1.0) / count * max(1.0, 2.0 * math.sqrt(math.pi) * self.smooth)

    def descend(self, theta: Array, belief: Normal, steps: int, variance: float | None = None) -> Look:
        """Return the look about likelier parameters; their noise's variance [Pa^2] is fitted where it is not given.

        A whole step is run with its Jacobian, beside shares of it; where none of them gains, it is damped. A step is
        not made where it would gain less than is worth a run.
        """
        shares = np.concatenate([[1.0], np.geomspace(0.5, _LEAST_SHARE, SINGLE_WIDTH - _SIMULATED - 1)])
        look, damping = self.look(theta, np.empty((0, _SIZE)))[0], 0.0
        for _ in range(steps):
            noise = variance or self.spread(look.left)
            off = (look.theta - belief.mean) / self.unit
            H = look.slopes.T @ look.slopes / noise + belief.precision
            rise = look.slopes.T @ look.left / noise - belief.precision @ off
            move = np.linalg.solve(H + damping * np.diag(np.diag(H)), rise)
            if float(rise @ move) < _ENOUGH:
                break
            paths = held(look.theta, look.theta + shares[:, None] * move * self.unit)
            whole, lefts = self.look(paths[0], paths[1:])
            offs = (paths[1:] - belief.mean) / self.unit
            costs = np.einsum("nm,nm->m", lefts, lefts) / noise + np.einsum("mi,ij,mj->m", offs, belief.precision, offs)
            costs = np.append(whole.cost(noise, belief, self.unit), costs)
            gains = np.nan_to_num(look.cost(noise, belief, self.unit) - costs, nan=-np.inf)
            best = int(np.argmax(gains))
            if not gains[best] > 0.0:
                damping = max(10.0 * damping, _DAMPED)
                if damping > _MOST_DAMPED:
                    break
                continue
            damping = 0.1 * damping if damping > _LEAST_DAMPED else 0.0
            look = whole if best == 0 else self.look(paths[best], paths[:0])[0]
        return look


def _rate_of_change(values: Array) -> Array:
    """Return the change a sample of values (n,), to fourth order: that of a ring is one of its fastest."""
    slope = np.asarray(np.gradient(values))
    slope[1:-1] -= np.diff(slope, 2) / 6.0
    return slope


def held(theta: Array, paths: Array) -> Array:
    """Return sets (m, p) whose positive parameters are between half and twice those of `theta` (p,)."""
    paths[:, _POSITIVE] = np.clip(paths[:, _POSITIVE], 0.5 * theta[_POSITIVE], 2.0 * theta[_POSITIVE])
    paths[:, LAG] = np.maximum(paths[:, LAG], 0.0)
    paths[:, GIVE] = np.maximum(paths[:, GIVE], _STIFF)
    return np.asarray(paths)


def first_fit(stretch: Stretch, beliefs: Beliefs, total: Array, noise: float) -> Look:
    """Return the likeliest parameters that hold over a stretch, beside a noise's variance [Pa^2].

    The ringing makes many local minima. So the slow part of the pressure is fitted first, from the best of several
    gains; then the whole, from stiffnesses by which it rings where the spectra of p_A - p_B and of the sum p_A + p_B,
    `total` (n,), in which nothing rings, say, and from several breakaway forces.
    """

    def ranked(of: Stretch, theta: Array, groups: int, changes: dict[int, Array]) -> Array:
        """Return the groups that 16 sets with `changes` make, the best of each first: (16/groups, groups, p)."""
        sets = np.tile(theta, (SINGLE_WIDTH, 1))
        for parameter, values in changes.items():
            sets[:, parameter] = values
        squares = np.nan_to_num(np.square(of.residuals(sets)).sum(axis=0), nan=np.inf).reshape(groups, -1)
        return sets.reshape(groups, -1, _SIZE)[range(groups), squares.argsort(axis=1).T]

    slow = replace(stretch, smooth=_SLOW * stretch.machine.period(beliefs.centre[K_OIL]))
    gains = beliefs.centre[GAIN] * _tried("response_start", "gain", 8)
    springs = beliefs.centre[SPRING] + beliefs.width[SPRING] * np.array([0.0, 1.0])
    first = ranked(slow, beliefs.centre, 1, {GAIN: np.tile(gains, 2), SPRING: np.repeat(springs, 8)})
    theta = slow.descend(first[0, 0], beliefs.normal, _FIRST_STEPS).theta
    ringing = stretch.machine.ringing(stretch.dp, total, beliefs)
    stiffnesses = np.append(ringing, beliefs.centre[K_OIL] * _tried("response_start", "K", 2))
    breakaways = theta[K_BRK] * _tried("response_start", "K_brk", 4)
    starts = ranked(stretch, theta, 4, {K_OIL: np.repeat(stiffnesses, 4), K_BRK: np.tile(breakaways, 4)})
    look = fitted(stretch, list(starts[0]), beliefs, noise, 2)
    if not _explained(look.cost(noise, beliefs.normal, beliefs.unit), stretch.known):
        look = fitted(stretch, [look.theta, *starts[1]], beliefs, noise, 2)
    return look


def fitted(stretch: Stretch, starts: Sequence[Array], beliefs: Beliefs, noise: float, kept: int) -> Look:
    """Return the likeliest look that steps from several starts lead to, few from all and more from the best `kept`."""
    best: list[Look] = []
    for steps, number in ((_FEW_STEPS, kept), (_STEPS, 1)):
        looks = [stretch.descend(start, beliefs.normal, steps, noise) for start in starts]
        costs = np.nan_to_num([look.cost(noise, beliefs.normal, beliefs.unit) for look in looks], nan=np.inf)
        best = [looks[place] for place in np.argsort(costs)[:number]]
        starts = [look.theta for look in best]
    return best[0]


class LinearBlock(NamedTuple):
    """A block's sums about its own parameters `theta` (p,), in units of them.

    `N` (p, p) and `b` (p,): of the Jacobian's products with itself and the residual [Pa^2]; `squares` of the residual
    over `samples`; `score` (s,) and `cross` (s, p): products of the column of G with residual and Jacobian in
    each of about so many seconds, which show how far the residual is from white.
    """

    theta: Array
    N: Array
    b: Array
    squares: float
    samples: float
    score: Array
    cross: Array


def linear(look: Look, known: Array, second: int) -> LinearBlock:
    """Return the sums of a look."""
    first, along = np.arange(0, look.left.size, second), look.slopes[:, G : G + 1]
    return LinearBlock(
        look.theta,
        look.slopes.T @ look.slopes,
        look.slopes.T @ look.left,
        float(look.left @ look.left),
        float(np.count_nonzero(known)),
        np.add.reduceat(along[:, 0] * look.left, first),
        np.add.reduceat(along * look.slopes, first, axis=0),
    )


def _explained(cost: float, known: Array) -> bool:
    """Whether a chi square is not far above the number of samples."""
    samples = float(np.count_nonzero(known))
    return cost <= samples + _UNEXPLAINED * math.sqrt(2.0 * samples)


class Follower:
    """Leads the response along a machine, block by block: an iterated Kalman filter of its parameters.

    `machine`, `beliefs`; `sense`: sign of p_A - p_B that goes with the command; then what changes from block to block:
    parameters `theta` (p,) and their `covariance` (p, p) in units, `variance` of the noise [Pa^2], `states` (8, 12) and
    `last`, the command at the last sample [V]; `excess` of the last block's chi square, in deviations.
    """

    def __init__(self, machine: Machine, beliefs: Beliefs, sense: float) -> None:
        self.machine, self.beliefs, self.sense = machine, beliefs, sense
        self.theta, self.variance, self.last = beliefs.centre, math.nan, math.nan
        self.covariance = np.diag((beliefs.width / beliefs.unit) ** 2)
        self.states, self.excess = np.zeros((8, _SIMULATED + 1)), 0.0

    @staticmethod
    def begun(recording: Recording, rig: Rig) -> Follower:
        """Return it fitted to the first seconds of a recording, about to take these."""
        u, dp = recording["u"], recording["p_A"] - recording["p_B"]
        sense = float(np.sign(np.mean(u * (dp - dp.mean())))) or 1.0
        beginning = recording.samples(slice(0, math.ceil(_WINDOW * recording.rate)))
        total = beginning["p_A"] + beginning["p_B"]
        noise = max(float(np.var(np.diff(total, 3))) / 20.0, 1.0)
        follower = Follower(Machine.of(rig, recording.rate), beliefs_of(rig), sense)
        window = follower.stretch(beginning)
        look = first_fit(window, follower.beliefs, total, noise)
        cost = look.cost(noise, follower.beliefs.normal, follower.beliefs.unit)
        if not _explained(cost, window.known):
            other = Follower(Machine.of(rig, recording.rate, BRISTLES), beliefs_of(rig, BRISTLES), sense)
            starts = np.array([look.theta, other.beliefs.centre])
            starts[:, GIVE] = other.beliefs.centre[GIVE]
            giving = fitted(other.stretch(beginning), list(starts), other.beliefs, noise, 1)
            if giving.cost(noise, other.beliefs.normal, other.beliefs.unit) < cost:
                follower, look = other, giving
        follower.theta, follower.variance = look.theta, window.spread(look.left)
        covariance, states = follower.covariance, follower.states
        length = round(_BLOCK * recording.rate)
        taken = min(round(_BEGINNING * recording.rate), len(recording) - length + 1)
        for first in range(0, taken, length):  # run once before, to begin where that ends
            follower.take(recording.samples(slice(first, first + length)))
        follower.covariance, follower.states, follower.last = covariance, states, math.nan
        return follower

    def interrupt(self, seconds: float) -> None:
        """Go on after so many seconds without samples, the parameters at most as little known as at first."""
        beliefs = self.beliefs
        spread = np.minimum(beliefs.wander**2 * (seconds / WANDER_TIME), beliefs.width**2) / beliefs.unit**2
        self.covariance = self.covariance + np.diag(spread)
        self.last = math.nan

    def stretch(self, block: Recording) -> Stretch:
        """Return the samples of a block after the last one."""
        u, n = block["u"], len(block)
        known = np.ones(n) if block.bridged is None else (~block.bridged).astype(float)
        if math.isnan(self.last):
            self.last, self.states = float(u[0]), self.states.copy()
            self.states[_POSITION] = self.machine.from_mid_stroke(u * self.theta[GAIN])
            known[: round(_SETTLING * block.rate)] = 0.0
        lines = mains_lines(block["p_A"] + block["p_B"], block.rate)
        waves = np.exp(2j * np.pi / block.rate * np.arange(n)[:, None] * lines)
        apart = np.linalg.qr(np.column_stack([waves.real, waves.imag]) * known[:, None])[0]
        dp = self.sense * (block["p_A"] - block["p_B"])
        return Stretch(self.machine, np.append(self.last, u), dp, self.states, self.beliefs.unit, apart, known)

    def _belief(self, seconds: float, jumped: int | None = None) -> Normal:
        """Return what is believed of a block so long beforehand; a parameter that `jumped` as widely as at first."""
        beliefs = self.beliefs
        wander = (beliefs.wander / beliefs.unit) ** 2 * (seconds / WANDER_TIME)
        if jumped is not None:
            wander[jumped] += (beliefs.width[jumped] / beliefs.unit[jumped]) ** 2
        return Normal(self.theta, np.asarray(np.linalg.inv(self.covariance + np.diag(wander))))

    def _updated(self, stretch: Stretch, seconds: float) -> tuple[Look, Normal]:
        """Return the likeliest look and the belief beside it.

        Where wandering does not explain the block, a jump is looked for: of the conductance, or of the stiffness.
        """
        unit, belief = self.beliefs.unit, self._belief(seconds)
        candidates = [(stretch.descend(self.theta, belief, _STEPS, self.variance), belief)]
        if not _explained(candidates[0][0].cost(self.variance, belief, unit), stretch.known):
            for parameter, values in (
                (G, _tried("response_jump", "G", SINGLE_WIDTH)),
                (K_OIL, self.theta[K_OIL] * _tried("response_jump", "K", SINGLE_WIDTH)),
            ):
                sets, belief = np.tile(self.theta, (SINGLE_WIDTH, 1)), self._belief(seconds, parameter)
                sets[:, parameter] = values
                squares = np.nan_to_num(np.square(stretch.residuals(sets)).sum(axis=0), nan=np.inf)
                candidates.append((stretch.descend(sets[int(squares.argmin())], belief, _STEPS, self.variance), belief))
        return min(candidates, key=lambda own: own[0].cost(self.variance, own[1], unit))

    def take(self, block: Recording) -> LinearBlock:
        """Return the sums of the next block."""
        stretch = self.stretch(block)
        look, belief = self._updated(stretch, block.duration)
        own = linear(look, stretch.known, round(block.rate))
        excess = look.cost(self.variance, belief, self.beliefs.unit) - own.samples
        self.excess = excess / math.sqrt(2.0 * max(own.samples, 1.0))
        H = own.N / self.variance + belief.precision
        off = (look.theta - belief.mean) / self.beliefs.unit
        self.covariance = np.asarray(np.linalg.inv(H))
        move = self.covariance @ (own.b / self.variance - belief.precision @ off)
        self.theta = held(look.theta, (look.theta + move * self.beliefs.unit)[None])[0]
        self.states, self.last = look.ends, float(block["u"][-1])
        return own


@dataclass(frozen=True, eq=False)
class Response:
    """All blocks of a recording together: the parameters' `mean` (K p,) and `covariance` (K p, K p) about `theta`.

    In units of the parameters; `strain` (K, p, K, p): precision of what is believed of them; `time` (K,) of the middles
    of the blocks [s]; `variance` of the residual [Pa^2].
    """

    time: Array
    blocks: tuple[LinearBlock, ...]
    beliefs: Beliefs
    mean: Array
    covariance: Array
    strain: Array
    variance: float

    @staticmethod
    def of(time: Array, blocks: Sequence[LinearBlock], beliefs: Beliefs, seconds: float) -> Response:
        """Return it for blocks of so many seconds; the noise is scaled by its long-run variance in the score of G."""
        K, unit = len(blocks), beliefs.unit
        steps, level = np.diff(np.eye(K), axis=0), np.full((K, K), K**-2.0)
        walk = WANDER_TIME / seconds * steps.T @ steps
        strain = np.zeros((K, _SIZE, K, _SIZE))
        for j in range(_SIZE):
            strain[:, j, :, j] = (unit[j] / beliefs.wander[j]) ** 2 * walk + (unit[j] / beliefs.width[j]) ** 2 * level
        off = np.array([(block.theta - beliefs.centre) / unit for block in blocks])
        pull = np.einsum("kilj,lj->ki", strain, off)
        count = sum(block.samples for block in blocks)
        variance = sum(block.squares for block in blocks) / count
        for _ in range(_TURNS):
            matrix = strain.copy()
            for k, block in enumerate(blocks):
                matrix[k, :, k] += block.N / variance
            covariance = np.asarray(np.linalg.inv(matrix.reshape(K * _SIZE, K * _SIZE)))
            mean = covariance @ (np.array([block.b for block in blocks]) / variance - pull).ravel()
            white, inflation = _noise(blocks, mean.reshape(K, _SIZE), count)
            variance = white * inflation
        return Response(time, tuple(blocks), beliefs, mean, covariance, strain, white)

    def parameters(self) -> Array:
        """Return the likeliest parameters of all blocks (K, p)."""
        theta = np.array([block.theta for block in self.blocks])
        return np.asarray(theta + self.mean.reshape(theta.shape) * self.beliefs.unit)

    def information(self, parameter: int) -> Information:
        """Return what the blocks say of a parameter, all others eliminated.

        What is believed of the parameter itself, which guided the filter, is taken out; that it wanders evenly or as a
        random walk is stated beside.
        """
        own = np.arange(parameter, self.mean.size, _SIZE)
        inverse = np.linalg.inv(self.covariance[np.ix_(own, own)])
        believed, unit = self.strain[:, parameter, :, parameter], self.beliefs.unit[parameter]
        at = np.array([block.theta[parameter] for block in self.blocks]) / unit
        precision = inverse - believed
        off = at - self.beliefs.centre[parameter] / unit
        vector = inverse @ self.mean[own] + believed @ off + precision @ at
        seconds = float(self.time[-1] - self.time[0]) * len(self.time) / max(len(self.time) - 1, 1)
        wander = float(self.beliefs.wander[parameter]) * math.sqrt(seconds / WANDER_TIME)
        reach = wander_of_conductance(seconds) if parameter == G else wander
        precision = 0.5 * (precision + precision.T) / unit**2
        return Information(self.time, precision, vector / unit, slope=reach, walk=reach)


def _noise(blocks: Sequence[LinearBlock], off: Array, count: float) -> tuple[float, float]:
    """Return the variance [Pa^2] left at deviations (K, p), and the long-run variance of G's score over it."""
    squares = sum(
        block.squares - 2.0 * block.b @ own + own @ block.N @ own for block, own in zip(blocks, off, strict=True)
    )
    variance = max(float(squares), 1.0) / count
    scores = np.concatenate([block.score - block.cross @ own for block, own in zip(blocks, off, strict=True)])
    expected = variance * sum(block.N[G, G] for block in blocks)
    return variance, max(1.0, float(scores @ scores) / max(expected, np.finfo(float).tiny))


def response(recording: Recording, rig: Rig) -> Response | None:
    """Return the response of a recording that is `usable`, computed once; None where no parameters simulate it."""

    def compute(recording: Recording) -> Response | None:
        edges = block_edges(recording)
        seconds = recording.duration / (len(edges) - 1)
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                follower = Follower.begun(recording, rig)
                parts = (recording.samples(slice(int(first), int(end))) for first, end in pairwise(edges))
                own = Response.of(
                    middles(recording, edges), [follower.take(part) for part in parts], follower.beliefs, seconds
                )
            except np.linalg.LinAlgError:
                return None
        whole = np.all(np.isfinite(own.mean)) and np.all(np.isfinite(own.covariance))
        return own if whole and own.variance < _EXPLAINED * np.var(recording["p_A"] - recording["p_B"]) else None

    return remembered(recording, ("response", rig), compute, ("u", "p_A", "p_B"))


def evidence(recording: Recording, rig: Rig) -> PressureEvidence | None:
    """Return what the whole response says of the conductance past the piston, block by block.

    Parameters
    ----------
    recording : Recording
        p_A, p_B [Pa] and the command u [V] at a uniform rate; bridged samples weigh nothing.
    rig : Rig
        What is believed of the machine.

    Returns
    -------
    PressureEvidence or None
        None where the rig's piston has no two like areas or a valve drives it, or no parameters simulate the recording.
    """
    own = response(recording, rig) if unusable(recording, rig) is None else None
    if own is None:
        return None
    laws = (1.0, priors("response")["orifice"].value)
    return pressure_evidence(recording, block_edges(recording), own.information(G), laws)
