"""Pressures and command alone: the whole response of p_A - p_B, simulated and linearised block by block.

The rig reduced to what p_A - p_B depends on has seven states: the difference p, the piston's speed v and position, the
friction, the motor's speed, its current and the integral of its speed loop, under the laws of `sealscope.physics`. Of
the friction there are two hypotheses, Stribeck's law and LuGre's; the likelier at the beginning is taken. All lanes of
a call of the kernel are one Jacobian: the path, and the path with each parameter a little more in all blocks; their
states are carried from block to block. An iterated Kalman filter leads from block to block (`Follower`), live and over
a recording alike; over a recording all blocks are then taken together (`fit.Joint`).

A leak damps the ring after each reversal by G/C, and takes from the ramp, the breakaway and the fall of the pressure
while sliding. Factorisation: this is p(pressures | command); a balance that reads position and angle takes p_A and p_B
as given, so that both might be added.

Source: B. M. Bell and F. W. Cathey, IEEE Trans. Autom. Control 38 (1993) 294 (iterated filter as Gauss-Newton steps).
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg.lapack import dtbtrs
from scipy.ndimage import gaussian_filter1d

from sealscope.compiled import contracted, kernel
from sealscope.diagnosis.inference.pressures.evidence import (
    PRIORS,
    PressureEvidence,
    block_edges,
    mains_waves,
    middles,
    unusable,
    wander_of_conductance,
)
from sealscope.diagnosis.inference.pressures.fit import STEPS, Block, Joint, Look, Normal, Priors, descend
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_level
from sealscope.physics.lanes import SINGLE_WIDTH, load, select, store
from sealscope.physics.leakage import laminar_leakage
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.rig import rig_numbers
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
_POSITIVE, _POSITION = [GAIN, K_OIL, F_C, K_BRK, C_C], 5
State = tuple[float, float, float, float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]
#: What the rig that is reduced to p_A - p_B has of the whole one's numbers, A_A the mean of both areas.
Reduced = namedtuple("Reduced", "A_A V M_eq v_th q_b k_p K_i V_max C_m B_M J_M R_c L_c C_e i_max")
#: Laws of the friction, two hypotheses: Stribeck's of the rig; and LuGre's, whose contact does not creep.
LAWS = STRIBECK, BRISTLES = "stribeck", "bristles"
_FOLLOW = PRIORS["follow"]
_UNCENTRED = 1.0 / _FOLLOW["centring"]
#: Longest step of the solver [s]: RK4 is within 100 Pa there, far under the noise of transducers; least give [m/N] and
#: lag [s]; length of spectra [samples].
_STEP, _LEAST, _SEGMENT = 1.01e-3, 1e-9, 256


@contracted
def _of_way(v: float, now: Parameters) -> float:
    return select(v < 0.0, 1.0 - now[SIDE], 1.0 + now[SIDE])  # type: ignore[no-any-return]


@contracted
def _steady(v: float, now: Parameters, m: Reduced) -> tuple[float, float, float]:
    """Return the friction of steady sliding [N], its level [N], and the speed at which the contact slips [m/s]."""
    speed = max(abs(v), m.v_th)
    level = stribeck_level(speed, now[F_C], now[K_BRK], now[C_C]) * _of_way(v, now)
    return level * min(max(v / m.v_th, -1.0), 1.0), level, speed


@contracted
def _held_by(friction: float, before: float, v: float, h: float, now: Parameters, m: Reduced) -> tuple[float, float]:
    """Compute the friction F [N] after h seconds, from F_0 `friction`.

    In them the friction of steady sliding went from `before` to `steady`, the one at v, which is returned as well. The
    law is give dF/dt = v - speed F/level: LuGre's law without its damping, which dies out as the contact slides. With
    a = h speed/(give level), F = (F_0 + (a/2) (before + (1 + a) steady)) / (1 + a + a^2/2), times (give level)^2 above
    and below.
    """
    steady, level, speed = _steady(v, now, m)
    w, g = h * speed, now[GIVE] * level
    part = 0.5 * w
    return (friction * g * g + part * (before * g + steady * (g + w))) / (g * g + w * (g + part)), steady


@contracted
def _rates(y: State, friction: float, spin: float, now: Parameters, m: Reduced) -> State:
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
        v - x * _UNCENTRED,
    )


@contracted
def _advance(y: State, h: float, k: State) -> State:
    return y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3], y[4] + h * k[4], y[5] + h * k[5]


@contracted
def _six(rows: Array, k: int) -> State:
    return load(rows, k), load(rows, k + 1), load(rows, k + 2), load(rows, k + 3), load(rows, k + 4), load(rows, k + 5)


@kernel
def simulate_response(
    command: np.ndarray, rate: float, every: int, theta: np.ndarray, states: np.ndarray, m: Reduced, out: np.ndarray
) -> None:
    """Write p_A - p_B [Pa] of all lanes at each sample into `out` (n, lanes), by RK4, `every` steps a sample.

    `command` (n + 1,) [V]: at the sample before, then at each, with ramps between; `theta` (p, lanes), a row a
    parameter; `states` (8, lanes): p, v, omega, i, I, x, friction and reading at the sample before, on return at the
    last.
    """
    y, friction, read = _six(states, 0), load(states, 6), load(states, 7)
    now = (*_six(theta, 0), *_six(theta, 6), load(theta, LAG))
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
            y_1 = _advance(y, 0.5 * h, k_1)
            k_2 = _rates(y_1, _held_by(friction, before, y_1[1], 0.5 * h, now, m)[0], w_1, now, m)
            y_2 = _advance(y, 0.5 * h, k_2)
            k_3 = _rates(y_2, _held_by(friction, before, y_2[1], 0.5 * h, now, m)[0], w_1, now, m)
            y_3 = _advance(y, h, k_3)
            k_4 = _rates(y_3, _held_by(friction, before, y_3[1], h, now, m)[0], w_2, now, m)
            y = _advance(y, h / 6.0, _advance(_advance(_advance(k_1, 2.0, k_2), 2.0, k_3), 1.0, k_4))
            friction, before = _held_by(friction, before, y[1], h, now, m)
            read = read + (y[0] - read) * (h / (h + now[LAG]))
        store(out, sample, read)
    for row in range(6):
        store(states, row, y[row])
    store(states, 6, friction)
    store(states, 7, read)


def priors_of(rig: Rig, law: str = STRIBECK) -> Priors:
    """Return the priors on machines of a rig at its charge pressure: zeros of the transducers change nothing."""
    friction, gain = rig.friction, rig.motor.omega_per_volt
    of_difference = friction.coulomb_pressure == "difference"
    coulomb = coulomb_friction(rig.fluid.p_charge, rig.fluid.p_charge, friction.F_pr, friction.F_cfr, of_difference)
    rig_values = {"gain": gain, "bias": gain, "K": rig.fluid.K_oil, "F_C": coulomb}
    rig_values |= {name: getattr(friction, name) for name in ("F_v", "K_brk", "C_c")}
    known = {**PRIORS["response"], "give": PRIORS[law]["give"]}
    return Priors(*np.array([rig_values.get(name, 1.0) * np.array(known[name]) for name in PARAMETERS]).T)


def _tried(table: str, parameter: int, count: int) -> Array:
    """Return values (count,) of a parameter at which a fit is begun."""
    middle, times = PRIORS[table][PARAMETERS[parameter]]
    return np.asarray(middle * np.geomspace(1.0 / times, times, count))


class Machine(NamedTuple):
    """The reduced rig of the simulation, at a rate [Hz] in `every` steps a sample."""

    numbers: Reduced
    rate: float
    every: int
    law: str

    @staticmethod
    def from_rig(rig: Rig, rate: float, law: str = STRIBECK) -> Machine:
        """Build the machine of a rig's kind."""
        whole = rig_numbers(rig)
        numbers = whole._replace(A_A=0.5 * (whole.A_A + whole.A_B), v_th=PRIORS[law].get("creep", whole.v_th))
        reduced = Reduced(*(getattr(numbers, name) for name in Reduced._fields))
        return Machine(reduced, rate, math.ceil(1.0 / rate / _STEP), law)

    def run(self, command: Array, paths: Array, states: Array) -> tuple[Array, Array]:
        """Return p_A - p_B (m, n) [Pa] of up to 16 sets (m, p) from their states (8, m), and the states at the end."""
        lanes = np.minimum(np.arange(SINGLE_WIDTH), len(paths) - 1)
        theta = np.ascontiguousarray(paths[lanes, : LAG + 1].T, dtype=np.float32)
        ends = np.ascontiguousarray(states[:, lanes], dtype=np.float32)
        out = np.empty((command.size - 1, SINGLE_WIDTH), dtype=np.float32)
        simulate_response(command, self.rate, self.every, theta, ends, self.numbers, out)
        return out[:, : len(paths)].T.astype(np.float64, order="C"), ends[:, : len(paths)].astype(np.float64)

    def from_mid_stroke(self, speed: Array) -> float:
        """Return where the piston begins [m] from the middle of its stroke under the motor's speed (n,) [rad/s]."""
        course = np.cumsum(speed) * self.numbers.q_b / (2.0 * math.pi * self.rate * self.numbers.A_A)
        return float(-0.5 * (course.max() + course.min()))

    def period(self, stiffness: float) -> float:
        """Return the ring's period [samples] at a stiffness of the oil [Pa]."""
        m = self.numbers
        return float(2.0 * math.pi * self.rate * math.sqrt(m.V * m.M_eq / (2.0 * stiffness)) / m.A_A)

    def ringing(self, dp: Array, total: Array, priors: Priors) -> Array:
        """Return the stiffnesses (2,) [Pa] at which p_A - p_B rings most, beyond noise and hum of p_A + p_B.

        They are the rig's where no frequency that the recording holds is believed of the machine.
        """
        share = priors.width[K_OIL] / priors.centre[K_OIL]
        middle = 4 * _SEGMENT / self.period(priors.centre[K_OIL])
        k = np.arange(math.ceil(middle * math.exp(-2.0 * share)), min(2 * _SEGMENT, int(middle * math.exp(share))))
        if not k.size:
            return np.full(2, priors.centre[K_OIL])
        segments = sliding_window_view([dp, total], min(_SEGMENT, dp.size), axis=1)[:, :: _SEGMENT // 2]
        spectra = np.fft.rfft(segments * np.hanning(segments.shape[2] + 1)[:-1], 4 * _SEGMENT)
        powers = np.mean(np.abs(spectra) ** 2, axis=1)  # Welch's
        excess = np.pad((powers[0] - powers[1])[k], 1, constant_values=-np.inf)
        peaks = np.flatnonzero((excess[1:-1] > excess[:-2]) & (excess[1:-1] >= excess[2:]))
        chosen = np.resize(peaks[np.argsort(-excess[1 + peaks])], 2)
        return np.asarray(priors.centre[K_OIL] * (k[chosen] / middle) ** 2)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Samples that one set of parameters holds for.

    `command` (n + 1,) [V] with that of the sample before; `dp` (n,) [Pa]; `states` (8, 12): of path and perturbed paths
    before; `apart` (m, n): rows that are taken out, the mains' waves; `known` (n,): whether a sample is. With `smooth`
    [samples] > 0 only what a Gaussian of that width leaves is fitted.
    """

    machine: Machine
    priors: Priors
    command: Array
    dp: Array
    states: Array
    apart: Array
    known: Array
    smooth: float = 0.0

    @cached_property
    def unit(self) -> Array:
        """Units of the parameters."""
        return self.priors.unit

    @cached_property
    def samples(self) -> float:
        """Number of known samples."""
        return float(np.count_nonzero(self.known))

    @cached_property
    def _among(self) -> Array:
        return np.asarray(np.linalg.pinv(self.apart @ self.apart.T, hermitian=True))

    def _fitted_part(self, rows: Array) -> tuple[Array, Array, Array]:
        """Return rows (m, n) but for what is not fitted, products (m, k) with what is taken out, and its amplitudes."""
        rows = gaussian_filter1d(rows, self.smooth) if self.smooth > 0.0 else rows
        if self.samples < rows.shape[1]:
            rows *= self.known
        products = rows @ self.apart.T
        return rows, products, products @ self._among

    def squares(self, paths: Array) -> Array:
        """Return the squares [Pa^2] that up to 16 sets of parameters (m, p) leave beside their means, (m,)."""
        shown, _ = self.machine.run(self.command, paths, self.states[:, np.zeros(len(paths), dtype=int)])
        left, _, waves = self._fitted_part(self.dp - paths[:, SCALE, None] * shown)
        squares = self.dp.size * np.var(left - waves @ self.apart, axis=1)
        return np.asarray(np.nan_to_num(squares, nan=np.inf))

    def look(self, paths: Array) -> tuple[Look, Array]:
        """Return the look about the first of up to 5 sets (m, p), and the squares that each leaves (m,)."""
        theta, count, simulated = paths[0], len(paths), SPRING + 1
        sets = np.concatenate([paths[:1], np.tile(theta, (simulated, 1)), paths[1:]])
        sets[range(1, simulated + 1), range(simulated)] += self.unit[:simulated]
        states = self.states[:, [*range(simulated + 1), *[0] * (count - 1)]]
        shown, ends = self.machine.run(self.command, sets, states)
        rows = np.empty((len(PARAMETERS) + count, self.dp.size))  # what is left, its slopes, what the others leave
        rows[0] = self.dp - theta[SCALE] * shown[0] - theta[OFFSET]
        rows[1 : simulated + 1] = theta[SCALE] * (shown[1 : simulated + 1] - shown[0])
        rows[1 + LEAD : 1 + OFFSET] = self._rest(theta, shown[0])
        rows[1 + OFFSET] = self.unit[OFFSET]
        rows[2 + OFFSET :] = self.dp - paths[1:, SCALE, None] * shown[simulated + 1 :] - paths[1:, OFFSET, None]
        rows, products, waves = self._fitted_part(rows)
        gram, free = rows @ rows.T - waves @ products.T, slice(2 + OFFSET)
        squares = np.diag(gram)[[0, *range(2 + OFFSET, len(rows))]]
        return Look(theta, gram[free, free], rows[free], ends[:, : simulated + 1]), squares

    def _rest(self, theta: Array, shown: Array) -> Array:
        """Return the slopes of lead, lag and scale (3, n) from the simulated p_A - p_B (n,)."""
        change = np.asarray(np.gradient(shown))
        change[1:-1] -= np.diff(change, 2) / 6.0  # to fourth order: that of a ring is one of its fastest
        earlier = theta[SCALE] * self.machine.rate * change
        kept = math.exp(-1.0 / (self.machine.rate * max(theta[LAG], _LEAST)))
        late = dtbtrs(np.tile([[1.0], [-kept]], earlier.size), (kept - 1.0) * earlier, uplo="L")[0]
        rest = np.array([earlier, late, shown])
        return rest * self.unit[LEAD:OFFSET, None]

    def bounds(self, theta: Array) -> tuple[Array, Array]:
        """Return between which parameters a step from `theta` may lead: positive ones halve or double at most."""
        low, high = np.full(theta.size, -np.inf), np.full(theta.size, np.inf)
        low[_POSITIVE], high[_POSITIVE] = 0.5 * theta[_POSITIVE], 2.0 * theta[_POSITIVE]
        low[LAG], low[GIVE] = 0.0, _LEAST
        return low, high

    def spread(self, squares: float) -> float:
        """Return the variance [Pa^2] of a residual, for as many samples as are independent of each other."""
        count = max(self.samples - len(PARAMETERS), 1.0)
        return max(squares, 1.0) / count * max(1.0, 2.0 * math.sqrt(math.pi) * self.smooth)

    def explained(self, cost: float) -> bool:
        """Test whether a chi square is not far above the number of samples."""
        return bool(cost <= self.samples + _FOLLOW["unexplained"] * math.sqrt(2.0 * self.samples))

    def block(self, look: Look) -> Block:
        """Return the sums of a look, its scores in each second."""
        rows = look.rows - (look.rows @ self.apart.T) @ self._among @ self.apart
        first = np.arange(0, self.dp.size, round(self.machine.rate))
        scores = np.add.reduceat(rows[1 + G] * rows, first, axis=1).T
        return Block(look.theta, look.gram, self.samples, scores)


def first_fit(stretch: Stretch, total: Array, noise: float) -> Look:
    """Return the likeliest parameters that hold over a stretch, beside a noise's variance [Pa^2].

    The ringing makes many local minima. So the slow part of the pressure is fitted first, from the best of several
    gains; then the whole, from stiffnesses by which it rings where the spectra of p_A - p_B and of the sum p_A + p_B,
    `total` (n,), in which nothing rings, say, and from several breakaway forces.
    """
    priors = stretch.priors

    def ranked(section: Stretch, theta: Array, groups: int, changes: dict[int, Array]) -> Array:
        """Return the groups that 16 sets with `changes` make, the best of each first: (16/groups, groups, p)."""
        sets = np.tile(theta, (SINGLE_WIDTH, 1))
        for parameter, values in changes.items():
            sets[:, parameter] = values
        order = section.squares(sets).reshape(groups, -1).argsort(axis=1).T
        return sets.reshape(groups, -1, len(PARAMETERS))[range(groups), order]

    slow = replace(stretch, smooth=_FOLLOW["slow"] * stretch.machine.period(priors.centre[K_OIL]))
    gains = priors.centre[GAIN] * _tried("start", GAIN, 8)
    springs = priors.centre[SPRING] + priors.width[SPRING] * np.array([0.0, 1.0])
    first = ranked(slow, priors.centre, 1, {GAIN: np.tile(gains, 2), SPRING: np.repeat(springs, 8)})
    theta = descend(slow, slow.look(first[0])[0], priors.normal, STEPS // 2).theta
    ringing = stretch.machine.ringing(stretch.dp, total, priors)
    stiffnesses = np.append(ringing, priors.centre[K_OIL] * _tried("start", K_OIL, 2))
    breakaways = theta[K_BRK] * _tried("start", K_BRK, 4)
    starts = ranked(stretch, theta, 4, {K_OIL: np.repeat(stiffnesses, 4), K_BRK: np.tile(breakaways, 4)})
    look = fitted(stretch, starts[0], noise, 2)
    if not stretch.explained(look.cost(noise, priors.normal, priors.unit)):
        look = fitted(stretch, [look.theta, *starts[1]], noise, 2)
    return look


def fitted(stretch: Stretch, starts: Sequence[Array] | Array, noise: float, kept: int) -> Look:
    """Return the likeliest look that steps from several starts lead to, few from all and more from the best `kept`."""
    looks, prior = [stretch.look(start[None])[0] for start in starts], stretch.priors.normal
    for steps, number in ((STEPS // 6, kept), (STEPS, 1)):
        looks = [descend(stretch, look, prior, steps, noise) for look in looks]
        costs = np.nan_to_num([look.cost(noise, prior, stretch.unit) for look in looks], nan=np.inf)
        looks = [looks[place] for place in np.argsort(costs)[:number]]
    return looks[0]


class Follower:
    """Leads the response along a machine, block by block: an iterated Kalman filter of its parameters.

    `machine`, `priors`; `sense`: sign of p_A - p_B that goes with the command; then what changes from block to block:
    parameters `theta` (p,) and their `covariance` (p, p) in units, `variance` of the noise [Pa^2], `states` (8, 12) and
    `last`, the command at the last sample [V]; `excess` of the last block's chi square, in deviations.
    """

    def __init__(self, machine: Machine, priors: Priors, sense: float) -> None:
        self.machine, self.priors, self.sense = machine, priors, sense
        self.theta, self.variance, self.last = priors.centre, math.nan, math.nan
        self.covariance = np.diag((priors.width / priors.unit) ** 2)
        self.states, self.excess = np.zeros((8, SPRING + 2)), 0.0

    @staticmethod
    def fit_start(recording: Recording, rig: Rig) -> Follower:
        """Fit a follower to the first seconds of a recording; these are the next that it takes."""
        u, dp = recording["u"], recording["p_A"] - recording["p_B"]
        sense = float(np.sign(np.mean(u * (dp - dp.mean())))) or 1.0
        beginning = recording.samples(slice(0, math.ceil(_FOLLOW["window"] * recording.rate)))
        total = beginning["p_A"] + beginning["p_B"]
        noise = max(float(np.var(np.diff(total, 3))) / 20.0, 1.0)
        follower = Follower(Machine.from_rig(rig, recording.rate), priors_of(rig), sense)
        window = follower.stretch(beginning)
        look = first_fit(window, total, noise)
        cost = look.cost(noise, follower.priors.normal, window.unit)
        if not window.explained(cost):
            other = Follower(Machine.from_rig(rig, recording.rate, BRISTLES), priors_of(rig, BRISTLES), sense)
            starts = np.array([look.theta, other.priors.centre])
            starts[:, GIVE] = other.priors.centre[GIVE]
            giving = fitted(other.stretch(beginning), starts, noise, 1)
            if giving.cost(noise, other.priors.normal, other.priors.unit) < cost:
                follower, look = other, giving
        follower.theta, follower.variance = look.theta, window.spread(float(look.gram[0, 0]))
        covariance, states = follower.covariance, follower.states
        length = round(_FOLLOW["block"] * recording.rate)
        stop = min(round(_FOLLOW["beginning"] * recording.rate), len(recording) - length + 1)
        for first in range(0, stop, length):  # run once before, to begin where that ends
            follower.take(recording.samples(slice(first, first + length)))
        follower.covariance, follower.states, follower.last = covariance, states, math.nan
        return follower

    def at_rate(self, rig: Rig, rate: float) -> Follower:
        """Return a follower for samples at another rate [Hz], with the same knowledge of the machine."""
        machine = Machine.from_rig(rig, rate, self.machine.law)
        follower = Follower(machine, self.priors, self.sense)
        follower.theta, follower.covariance = self.theta, self.covariance
        follower.variance, follower.states = self.variance, self.states
        return follower

    def interrupt(self, seconds: float) -> None:
        """Go on after so many seconds without samples, the parameters at most as little known as at first."""
        priors = self.priors
        spread = np.minimum(priors.spread(seconds), (priors.width / priors.unit) ** 2)
        self.covariance = self.covariance + np.diag(spread)
        self.last = math.nan

    def stretch(self, block: Recording) -> Stretch:
        """Return the samples of a block after the last one."""
        u, n = block["u"], len(block)
        known = np.ones(n) if block.bridged is None else (~block.bridged).astype(float)
        if math.isnan(self.last):
            self.last, self.states = float(u[0]), self.states.copy()
            self.states[_POSITION] = self.machine.from_mid_stroke(u * self.theta[GAIN])
            known[: round(_FOLLOW["settling"] * block.rate)] = 0.0
        waves = mains_waves(block["p_A"] + block["p_B"], block.rate) * known
        dp = self.sense * (block["p_A"] - block["p_B"])
        return Stretch(self.machine, self.priors, np.append(self.last, u), dp, self.states, waves, known)

    def _prior(self, seconds: float, jumped: int | None = None) -> Normal:
        """Compute the prior on a block of so many seconds; a `jumped` parameter is as uncertain as at first."""
        priors = self.priors
        wander = priors.spread(seconds)
        if jumped is not None:
            wander[jumped] += (priors.width[jumped] / priors.unit[jumped]) ** 2
        return Normal(self.theta, np.asarray(np.linalg.inv(self.covariance + np.diag(wander))))

    def _updated(self, stretch: Stretch, seconds: float) -> tuple[Look, Normal]:
        """Return the likeliest look and the prior beside it.

        Where wandering does not explain the block, a jump is looked for: of the conductance, or of the stiffness.
        """

        def candidate(start: Array, prior: Normal) -> tuple[float, Look, Normal]:
            look = descend(stretch, stretch.look(start[None])[0], prior, STEPS, self.variance)
            return look.cost(self.variance, prior, stretch.unit), look, prior

        candidates = [candidate(self.theta, self._prior(seconds))]
        if not stretch.explained(candidates[0][0]):
            for parameter, unit in ((G, 1.0), (K_OIL, self.theta[K_OIL])):
                sets = np.tile(self.theta, (SINGLE_WIDTH, 1))
                sets[:, parameter] = unit * _tried("jump", parameter, SINGLE_WIDTH)
                best = int(stretch.squares(sets).argmin())
                candidates.append(candidate(sets[best], self._prior(seconds, parameter)))
        return min(candidates, key=lambda entry: entry[0])[1:]

    def take(self, block: Recording) -> Block:
        """Return the sums of the next block."""
        stretch = self.stretch(block)
        look, prior = self._updated(stretch, block.duration)
        excess = look.cost(self.variance, prior, stretch.unit) - stretch.samples
        self.excess = excess / math.sqrt(2.0 * max(stretch.samples, 1.0))
        off = (look.theta - prior.mean) / stretch.unit
        self.covariance = np.asarray(np.linalg.inv(look.gram[1:, 1:] / self.variance + prior.precision))
        move = self.covariance @ (look.gram[0, 1:] / self.variance - prior.precision @ off)
        self.theta = np.clip(look.theta + move * stretch.unit, *stretch.bounds(look.theta))
        self.states, self.last = look.ends, float(block["u"][-1])
        return stretch.block(look)


def response(recording: Recording, rig: Rig) -> Joint | None:
    """Return the response of a recording that is `usable`, computed once; None where no parameters simulate it."""

    def compute(recording: Recording) -> Joint | None:
        edges = block_edges(recording)
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                follower = Follower.fit_start(recording, rig)
                parts = [follower.take(recording.samples(slice(*map(int, pair)))) for pair in pairwise(edges)]
                joint = Joint.fit(parts, follower.priors, recording.duration / len(parts), G)
            except np.linalg.LinAlgError:
                return None
        whole = np.all(np.isfinite(joint.mean)) and np.all(np.isfinite(joint.covariance))
        share = _FOLLOW["explained"] * np.var(recording["p_A"] - recording["p_B"])
        return joint if whole and joint.variance < share else None

    return remembered(recording, ("response", rig), compute, ("u", "p_A", "p_B"))


def evidence(recording: Recording, rig: Rig) -> PressureEvidence | None:
    """Estimate the parameters from the response; None where nothing simulates it, or the circuit is another."""
    joint = response(recording, rig) if unusable(recording, rig) is None else None
    if joint is None:
        return None
    time = middles(recording, block_edges(recording))
    reach = np.sqrt(recording.duration / PRIORS["blocks"]["wander"]) * joint.priors.wander
    reach[G] = wander_of_conductance(recording.duration)
    information = {name: joint.information(k, time, float(reach[k])) for k, name in enumerate(PARAMETERS)}
    return PressureEvidence.from_blocks(recording, rig, information)
