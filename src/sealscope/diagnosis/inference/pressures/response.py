"""Pressures and command alone: the whole response of p_A - p_B, simulated and linearised block by block.

The rig reduced to what p_A - p_B depends on has five states: the difference p, the piston's speed v, the motor's speed,
its current and the integral of its speed loop, under the laws of `sealscope.physics`. With y(theta) the simulated
pressure difference and theta_k the parameters of block k, which wander from block to block as random walks,

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

#: What a block has of its own: speed per volt [rad/(s V)], lead of the command [s], speed beside it [rad/s], stiffness
#: of the oil [Pa], Coulomb friction [N], viscous friction [N s/m], breakaway over Coulomb friction [1], its decay
#: [s/m], share by which friction is larger on the way out [1], conductance past the piston [m^3/(s Pa)], lag of the
#: transducers [s]; then what no simulation needs: scale of p_A - p_B [1] and its offset [Pa].
PARAMETERS = (
    *("gain", "bias", "K", "F_C", "F_v", "K_brk", "C_c", "side", "G", "give", "spring"),
    *("lead", "lag", "scale", "offset"),
)
GAIN, BIAS, K_OIL, F_C, F_V, K_BRK, C_C, SIDE, G, GIVE, SPRING, LEAD, LAG, SCALE, OFFSET = range(len(PARAMETERS))
_SIZE, _SIMULATED = len(PARAMETERS), SPRING + 1
State = tuple[float, float, float, float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]
_CENTRING = 10.0
#: Longest step of the solver [s]: RK4 is within 100 Pa there, far under the noise of transducers.
_STEP = 1.01e-3
#: Steps of differences as a share of what is believed; gain of twice the log likelihood that is worth a run, most steps
#: of a fit, turns to the noise's variance.
_NUDGE, _ENOUGH, _STEPS, _TURNS = 0.05, 5.0, 12, 2
#: Share of the variance of p_A - p_B that parameters which simulate it leave.
_EXPLAINED = 0.5
#: Where a block's chi square is so many deviations more than expected, jumps are tried: conductances [m^3/(s Pa)], and
#: stiffnesses over the one before.
_UNEXPLAINED = 3.0
_CONDUCTANCES, _STIFFNESSES = np.geomspace(1e-12, 2e-10, SINGLE_WIDTH), np.geomspace(0.15, 1.2, SINGLE_WIDTH)
#: Least share of a step that is tried; damping [1] of steps that did not gain, at first, at least and at most.
_LEAST_SHARE, _DAMPED, _LEAST_DAMPED, _MOST_DAMPED = 0.02, 0.1, 1e-3, 100.0
#: Beginning along which it is led once, and the blocks there [s].
_BEGINNING, _BLOCK = 24.0, 6.0
#: The first fit: length of its window [s], width of the Gaussian that takes the ring out [periods], steps of the slow
#: fit, and starts from which the whole is fitted.
_WINDOW, _SLOW, _FIRST_STEPS, _STARTS = 12.0, 0.6, 6, 8
#: Breakaway over that of the slow fit, length of the spectra [samples], and steps by which starts are compared.
_BREAKAWAYS, _SEGMENT, _FEW_STEPS = (0.65, 0.85, 1.0, 1.25), 256, 2
_POSITIVE = [GAIN, K_OIL, F_C, K_BRK, C_C]


@contracted
def _steady(v: float, now: Parameters, m: RigNumbers) -> tuple[float, float]:
    """Return the friction of steady sliding [N], and the velocity over it at which the contact slips [m/(s N)]."""
    speed = max(abs(v), m.v_th)
    level = stribeck_level(speed, now[F_C], now[K_BRK], now[C_C]) * select(v < 0.0, 1.0 - now[SIDE], 1.0 + now[SIDE])
    slip = speed / level
    return v / slip, slip


@contracted
def _held_by(friction: float, before: float, v: float, h: float, now: Parameters, m: RigNumbers) -> tuple[float, float]:
    steady, slip = _steady(v, now, m)
    a = h * slip / now[GIVE]
    return (friction + 0.5 * a * (before + steady * (1.0 + a))) / (1.0 + a * (1.0 + 0.5 * a)), steady


@contracted
def _rates(y: State, friction: float, spin: float, now: Parameters, m: RigNumbers) -> State:
    """Return dy/dt of y = (p, v, omega, i, I, x) under the speed `spin` [rad/s] that the command asks for."""
    p, v, omega, i, integral, x = y
    past = m.A_A * v + laminar_leakage(p, now[G])
    error = spin - omega
    voltage = controller_voltage(error, integral, m.k_p, m.K_i, m.V_max)
    return (
        2.0 * pressure_rate(pump_flow(omega, p, m.q_b, 0.0) - past, m.V, now[K_OIL]),
        piston_acceleration(0.5 * p, -0.5 * p, friction + now[F_V] * v, now[SPRING] * x, 0.0, m.A_A, m.A_A, m.M_eq),
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
    parameter; `states` (6, lanes): p, v, omega, i, I and the reading at the sample before, on return at the last.
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


class Beliefs(NamedTuple):
    """What is believed of the parameters (p,): centre and `width` of their mean, and how far they `wander` in 90 s."""

    centre: Array
    width: Array
    wander: Array

    @property
    def unit(self) -> Array:
        """Steps of the parameters for a difference, in which all matrices are."""
        return np.asarray(_NUDGE * np.minimum(self.width, self.wander))


def beliefs_of(rig: Rig, law: str = "static") -> Beliefs:
    """Return the beliefs on machines of a rig at its charge pressure: zeros of the transducers change nothing."""
    friction, gain = rig.friction, rig.motor.omega_per_volt
    of_difference = friction.coulomb_pressure == "difference"
    coulomb = coulomb_friction(rig.fluid.p_charge, rig.fluid.p_charge, friction.F_pr, friction.F_cfr, of_difference)
    own = {"gain": gain, "bias": gain, "K": rig.fluid.K_oil, "F_C": coulomb}
    own |= {name: getattr(friction, name) for name in ("F_v", "K_brk", "C_c")}
    scale = np.array([own.get(name, 1.0) for name in PARAMETERS])
    mean, wander = {**priors("response"), **priors(law)}, {**priors("response_wander"), **priors(law + "_wander")}
    return Beliefs(
        scale * [mean[name].value for name in PARAMETERS],
        scale * [mean[name].width for name in PARAMETERS],
        scale * [wander[name].width for name in PARAMETERS],
    )


class Machine(NamedTuple):
    """The reduced rig of the simulation, at a rate [Hz] in `every` steps a sample."""

    numbers: RigNumbers
    rate: float
    every: int

    @staticmethod
    def of(rig: Rig, rate: float, law: str = "static") -> Machine:
        """Return that of a rig's kind."""
        numbers = rig_numbers(rig)
        area = 0.5 * (numbers.A_A + numbers.A_B)
        if law == "bristles":
            numbers = numbers._replace(v_th=1e-4)
        return Machine(numbers._replace(A_A=area, A_B=area), rate, math.ceil(1.0 / rate / _STEP))

    def run(self, command: Array, paths: Array, states: Array) -> tuple[Array, Array]:
        """Return p_A - p_B (n, m) [Pa] of up to 16 sets (m, p) from their states (6, m), and the states at the end."""
        lanes = np.minimum(np.arange(SINGLE_WIDTH), len(paths) - 1)
        theta = np.ascontiguousarray(paths[lanes, : LAG + 1].T, dtype=np.float32)
        ends = np.ascontiguousarray(states[:, lanes], dtype=np.float32)
        out = np.empty((command.size - 1, SINGLE_WIDTH), dtype=np.float32)
        simulate_response(command, self.rate, self.every, theta, ends, self.numbers, out)
        return out[:, : len(paths)].astype(np.float64), ends[:, : len(paths)].astype(np.float64)

    def period(self, stiffness: float) -> float:
        """Return the ring's period [samples] at a stiffness of the oil [Pa]."""
        m = self.numbers
        return 2.0 * math.pi * self.rate * math.sqrt(m.V * m.M_eq / (2.0 * stiffness)) / m.A_A

    def ringing(self, dp: Array, total: Array, beliefs: Beliefs) -> Array:
        """Return the stiffnesses (2,) [Pa] at which p_A - p_B rings most, beyond noise and hum of p_A + p_B.

        They are the rig's where no frequency that the recording holds is believed of the machine.
        """
        window = np.hanning(_SEGMENT)

        def power(values: Array) -> Array:
            parts = np.lib.stride_tricks.sliding_window_view(values, _SEGMENT)[:: _SEGMENT // 2]
            return np.asarray(np.square(np.abs(np.fft.rfft(parts * window, 4 * _SEGMENT))).mean(axis=0))

        share = beliefs.width[K_OIL] / beliefs.centre[K_OIL]
        middle = 4 * _SEGMENT / self.period(beliefs.centre[K_OIL])
        k = np.arange(math.ceil(middle * math.exp(-2.0 * share)), min(2 * _SEGMENT, int(middle * math.exp(share))))
        if not k.size:
            return np.full(2, beliefs.centre[K_OIL])
        beyond = np.pad((power(dp) - power(total))[k], 1, constant_values=-np.inf)
        peaks = np.flatnonzero((beyond[1:-1] >= beyond[2:]) & (beyond[1:-1] >= beyond[:-2]))
        chosen = np.resize(peaks[np.argsort(-beyond[1:-1][peaks])], 2)
        return np.asarray(beliefs.centre[K_OIL] * (k[chosen] / middle) ** 2)


class Normal(NamedTuple):
    """Normal belief on the parameters: mean (p,) and precision (p, p) in units."""

    mean: Array
    precision: Array


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

    `command` (n + 1,) [V] with that of the sample before; `dp` (n,) [Pa]; `states` (6, 12): of path and perturbed paths
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

    def seen(self, rows: Array) -> Array:
        """Return rows (n, m) without what is not fitted."""
        rows = gaussian_filter1d(rows, self.smooth, axis=0) if self.smooth > 0.0 else rows
        rows = rows * self.known[:, None]
        return np.asarray(rows - self.apart @ (self.apart.T @ rows))

    def residuals(self, paths: Array) -> Array:
        """Return what up to 16 sets of parameters (m, p) leave (n, m), their means taken out."""
        shown, _ = self.machine.run(self.command, paths, self.states[:, np.zeros(len(paths), dtype=int)])
        left = self.seen(self.dp[:, None] - paths[:, SCALE] * shown)
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
        course = np.pad(shown[:, 0], 2, mode="reflect", reflect_type="odd")
        earlier = theta[SCALE] * self.machine.rate * np.convolve(course, np.array([-1.0, 8.0, 0.0, -8.0, 1.0]) / 12.0, "valid")
        kept = math.exp(-1.0 / (self.machine.rate * max(theta[LAG], 1e-9)))
        later = -lfilter([1.0 - kept], [1.0, -kept], earlier)
        rest = np.column_stack(
            [
                self.unit[LEAD] * earlier,
                self.unit[LAG] * later,
                self.unit[SCALE] * shown[:, 0],
                np.full(len(shown), self.unit[OFFSET]),
            ]
        )
        rows = self.seen(np.concatenate([left, slopes, rest], axis=1))
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


def held(theta: Array, paths: Array) -> Array:
    """Return sets (m, p) whose positive parameters are between half and twice those of `theta` (p,)."""
    paths[:, _POSITIVE] = np.clip(paths[:, _POSITIVE], 0.5 * theta[_POSITIVE], 2.0 * theta[_POSITIVE])
    paths[:, LAG] = np.maximum(paths[:, LAG], 0.0)
    paths[:, GIVE] = np.maximum(paths[:, GIVE], 1e-9)
    return np.asarray(paths)


def first_fit(stretch: Stretch, beliefs: Beliefs, total: Array, noise: float) -> Look:
    """Return parameters (p,) that hold over a stretch, and the variance that they leave [Pa^2].

    The ringing makes many local minima. So the slow part of the pressure is fitted first, from the best of several
    gains; then the whole, from stiffnesses by which it rings where the spectra say and from several breakaway forces,
    and judged beside the noise of the sum p_A + p_B, `total` (n,), in which nothing rings.
    """
    belief = Normal(beliefs.centre, np.diag((beliefs.unit / beliefs.width) ** 2))

    def tried(of: Stretch, theta: Array, changes: dict[int, Array]) -> Array:
        sets = np.tile(theta, (SINGLE_WIDTH, 1))
        for parameter, values in changes.items():
            sets[:, parameter] = values
        squares = np.square(of.residuals(sets)).sum(axis=0)
        return np.asarray(sets[np.argsort(np.nan_to_num(squares, nan=np.inf))])

    slow = replace(stretch, smooth=_SLOW * stretch.machine.period(beliefs.centre[K_OIL]))
    spread = np.exp(np.linspace(-2.0, 2.0, SINGLE_WIDTH) * beliefs.width[GAIN] / beliefs.centre[GAIN])
    gains = tried(slow, beliefs.centre, {GAIN: beliefs.centre[GAIN] * spread})
    theta = slow.descend(gains[0], belief, _FIRST_STEPS).theta
    stiffnesses = np.append(stretch.machine.ringing(stretch.dp, total, beliefs), [theta[K_OIL], beliefs.centre[K_OIL]])
    grid = {K_OIL: np.repeat(stiffnesses, 4), K_BRK: np.tile(theta[K_BRK] * np.array(_BREAKAWAYS), 4)}

    def fitted(starts: Sequence[Array], steps: int) -> list[Look]:
        looks = [stretch.descend(start, belief, steps, noise) for start in starts]
        return sorted(looks, key=lambda look: float(np.nan_to_num(look.cost(noise, belief, beliefs.unit), nan=np.inf)))

    near = fitted(list(tried(stretch, theta, grid)[:_STARTS]), _FEW_STEPS)
    return fitted([look.theta for look in near[:2]], _STEPS)[0]


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


class Follower:
    """Leads the response along a machine, block by block: an iterated Kalman filter of its parameters.

    `machine`, `beliefs`; `sense`: sign of p_A - p_B that goes with the command; then what changes from block to block:
    parameters `theta` (p,) and their `covariance` (p, p) in units, `variance` of the noise [Pa^2], `states` (6, 12) and
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
        follower = Follower(Machine.of(rig, recording.rate), beliefs_of(rig), sense)
        window, total = follower.stretch(beginning), beginning["p_A"] + beginning["p_B"]
        noise = max(float(np.var(np.diff(total, 3))) / 20.0, 1.0)
        look = first_fit(window, follower.beliefs, total, noise)
        cost = look.cost(noise, Normal(follower.beliefs.centre, np.diag((follower.beliefs.unit / follower.beliefs.width) ** 2)), follower.beliefs.unit)
        samples = float(np.count_nonzero(window.known))
        if cost > samples + _UNEXPLAINED * math.sqrt(2.0 * samples):
            other = Follower(Machine.of(rig, recording.rate, "bristles"), beliefs_of(rig, "bristles"), sense)
            start = look.theta.copy()
            start[GIVE] = other.beliefs.centre[GIVE]
            belief = Normal(other.beliefs.centre, np.diag((other.beliefs.unit / other.beliefs.width) ** 2))
            bristly = other.stretch(beginning).descend(start, belief, _STEPS, noise)
            if bristly.cost(noise, belief, other.beliefs.unit) < cost:
                follower, look = other, bristly
        follower.theta, follower.variance = look.theta, window.spread(look.left)
        covariance, states = follower.covariance, follower.states
        length = round(_BLOCK * recording.rate)
        taken = min(round(_BEGINNING * recording.rate), len(recording) - length + 1)
        for first in range(0, taken, length):  # led on once, to begin where that ends
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
        before = u[0] if math.isnan(self.last) else self.last
        known = np.ones(n) if block.bridged is None else (~block.bridged).astype(float)
        lines = mains_lines(block["p_A"] + block["p_B"], block.rate)
        waves = np.exp(2j * np.pi / block.rate * np.arange(n)[:, None] * lines)
        apart = np.linalg.qr(np.column_stack([waves.real, waves.imag]) * known[:, None])[0]
        dp = self.sense * (block["p_A"] - block["p_B"])
        return Stretch(self.machine, np.append(before, u), dp, self.states, self.beliefs.unit, apart, known)

    def _belief(self, seconds: float, jumped: int | None = None) -> Normal:
        """Return what is believed of a block so long beforehand; a parameter that `jumped` as widely as at first."""
        beliefs = self.beliefs
        wander = (beliefs.wander / beliefs.unit) ** 2 * (seconds / WANDER_TIME)
        if jumped is not None:
            wander[jumped] += (beliefs.width[jumped] / beliefs.unit[jumped]) ** 2
        return Normal(self.theta, np.asarray(np.linalg.inv(self.covariance + np.diag(wander))))

    def _led(self, stretch: Stretch, seconds: float) -> tuple[Look, Normal]:
        """Return the likeliest look and the belief beside it.

        Where wandering does not explain the block, a jump is looked for: of the conductance, or of the stiffness.
        """
        unit, belief = self.beliefs.unit, self._belief(seconds)
        led = [(stretch.descend(self.theta, belief, _STEPS, self.variance), belief)]
        samples = float(np.count_nonzero(stretch.known))
        if led[0][0].cost(self.variance, belief, unit) > samples + _UNEXPLAINED * math.sqrt(2.0 * samples):
            for parameter, values in ((G, _CONDUCTANCES), (K_OIL, self.theta[K_OIL] * _STIFFNESSES)):
                sets, belief = np.tile(self.theta, (SINGLE_WIDTH, 1)), self._belief(seconds, parameter)
                sets[:, parameter] = values
                squares = np.nan_to_num(np.square(stretch.residuals(sets)).sum(axis=0), nan=np.inf)
                led.append((stretch.descend(sets[int(squares.argmin())], belief, _STEPS, self.variance), belief))
        return min(led, key=lambda own: own[0].cost(self.variance, own[1], unit))

    def take(self, block: Recording) -> LinearBlock:
        """Return the sums of the next block."""
        stretch = self.stretch(block)
        look, belief = self._led(stretch, block.duration)
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
