"""Pressures and command alone: the whole response of p_A - p_B, simulated and linearised block by block.

The rig reduced to what p_A - p_B depends on has five states: the difference p, the piston's speed v, the motor's speed,
its current and the integral of its speed loop, under the laws of `sealscope.physics`. With y(theta) the simulated
pressure difference and theta_k the parameters of block k, which wander from block to block as random walks,

    y_k(theta) = y_k(theta_k^0) + J_k (theta_k - theta_k^0),

where each block is linear about its own theta_k^0: the likeliest path, found by Gauss-Newton steps. All lanes of one
call of the kernel are one Jacobian: the path, and the path with each parameter a little more in all blocks. What is
left is Gaussian in all theta_k; all but the conductance G past the piston are eliminated by a Schur complement.

The ring of `ring_down` is in this response, and so is what it does not see: the ramp, the breakaway, and how far the
pressure falls while sliding. Both providers read the same pressures under the same factorisation, p(pressures |
command): they are two hypotheses of the machine, this one with the laws of the rig, and are never added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sealscope.compiled import contracted, kernel
from sealscope.diagnosis.inference.pressures.evidence import (
    WANDER_TIME,
    PressureEvidence,
    block_edges,
    eliminated,
    mains_lines,
    pressure_evidence,
    priors,
    usable,
)
from sealscope.diagnosis.inference.pressures.ring_down import ring_down
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_friction
from sealscope.physics.lanes import SINGLE_WIDTH, load, select, store
from sealscope.physics.leakage import laminar_leakage
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.rig import RigNumbers, rig_numbers
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What a block has of its own: speed per volt [rad/(s V)], lead of the command [s], speed beside it [rad/s], stiffness
#: of the oil [Pa], Coulomb friction [N], viscous friction [N s/m], breakaway over Coulomb friction [1], its decay
#: [s/m], share by which friction is larger on the way out [1], conductance past the piston [m^3/(s Pa)], lag of the
#: transducers [s].
PARAMETERS = ("gain", "lead", "bias", "K", "F_C", "F_v", "K_brk", "C_c", "side", "G", "lag")
GAIN, LEAD, BIAS, K_OIL, F_C, F_V, K_BRK, C_C, SIDE, G, LAG = range(len(PARAMETERS))
_SIZE = len(PARAMETERS)
State = tuple[float, float, float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float, float]
#: Longest step of the solver [s]: RK4 is within 100 Pa there, far under the noise of transducers.
_STEP = 1.01e-3
#: Steps of differences as a share of what is believed; gain of log likelihood that ends a descent, steps of one.
_NUDGE, _ENOUGH, _STEPS = 0.05, 0.1, 12
#: Least share of a step that is tried; damping [1] of steps that did not gain, at first, at least and at most.
_LEAST_SHARE, _DAMPED, _LEAST_DAMPED, _MOST_DAMPED = 0.02, 0.1, 1e-3, 100.0
#: The first fit: length of its window [s], width of the Gaussian that takes the ring out [periods], steps of the slow
#: fit, and stiffnesses from which the whole is fitted.
_WINDOW, _SLOW, _FIRST_STEPS, _STARTS = 40.0, 0.6, 6, 3
_POSITIVE = [GAIN, K_OIL, F_C, K_BRK, C_C]


@contracted
def _rates(y: State, spin: float, now: Parameters, m: RigNumbers) -> State:
    """Return dy/dt of y = (p, v, omega, i, I) under the speed `spin` [rad/s] that the command asks for."""
    p, v, omega, i, integral = y
    friction = stribeck_friction(v, now[F_C], now[K_BRK], now[C_C], now[F_V], m.v_th, False)
    friction = friction * select(v < 0.0, 1.0 - now[SIDE], 1.0 + now[SIDE])
    past = m.A_A * v + laminar_leakage(p, now[G])
    error = spin - omega
    voltage = controller_voltage(error, integral, m.k_p, m.K_i, m.V_max)
    return (
        2.0 * pressure_rate(pump_flow(omega, p, m.q_b, 0.0) - past, m.V, now[K_OIL]),
        piston_acceleration(0.5 * p, -0.5 * p, friction, 0.0, 0.0, m.A_A, m.A_A, m.M_eq),
        shaft_acceleration(i, omega, pump_torque(p, m.q_b), m.C_m, m.B_M, m.J_M),
        winding_current_rate(voltage, i, omega, m.R_c, m.L_c, m.C_e, m.i_max),
        error,
    )


@contracted
def _moved(y: State, h: float, k: State) -> State:
    return y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3], y[4] + h * k[4]


@kernel
def simulate_response(
    command: np.ndarray, h: float, every: int, theta: np.ndarray, block: np.ndarray, m: RigNumbers, out: np.ndarray
) -> None:
    """Write p_A - p_B [Pa] of all lanes at each sample into `out` (n, lanes), from rest, by RK4 in steps of h [s].

    `command` (2 every n + 1, 2) at every half step: [V] and [V/s], `every` steps to a sample; `theta` (K p, lanes), a
    row a parameter, block after block; `block` (n,) which of them holds at a sample.
    """
    zero = load(theta, LEAD) * 0.0
    y = (zero, zero, zero, zero, zero)
    read = zero
    for sample in range(block.size):
        store(out, sample, read)
        row = _SIZE * block[sample]
        now = (
            load(theta, row),
            load(theta, row + 1),
            load(theta, row + 2),
            load(theta, row + 3),
            load(theta, row + 4),
            load(theta, row + 5),
            load(theta, row + 6),
            load(theta, row + 7),
            load(theta, row + 8),
            load(theta, row + 9),
            load(theta, row + 10),
        )
        for step in range(every):
            at = 2 * (sample * every + step)
            w_0 = now[GAIN] * (command[at, 0] + now[LEAD] * command[at, 1]) + now[BIAS]
            w_1 = now[GAIN] * (command[at + 1, 0] + now[LEAD] * command[at + 1, 1]) + now[BIAS]
            w_2 = now[GAIN] * (command[at + 2, 0] + now[LEAD] * command[at + 2, 1]) + now[BIAS]
            k_1 = _rates(y, w_0, now, m)
            k_2 = _rates(_moved(y, 0.5 * h, k_1), w_1, now, m)
            k_3 = _rates(_moved(y, 0.5 * h, k_2), w_1, now, m)
            k_4 = _rates(_moved(y, h, k_3), w_2, now, m)
            total = _moved(_moved(_moved(k_1, 2.0, k_2), 2.0, k_3), 1.0, k_4)
            y = _moved(y, h / 6.0, total)
            read = read + (y[0] - read) * (h / (h + now[LAG]))


@dataclass(frozen=True, eq=False)
class Simulator:
    """The reduced rig under a recorded command; `command` (2 every n + 1, 2) as `simulate_response` takes it."""

    command: Array
    h: float
    every: int
    numbers: RigNumbers

    @staticmethod
    def of(u: Array, rate: float, rig: Rig) -> Simulator:
        """Return it for a command (n,) [V] that ramps from sample to sample."""
        every, numbers = math.ceil(1.0 / rate / _STEP), rig_numbers(rig)
        area, h = 0.5 * (numbers.A_A + numbers.A_B), 1.0 / rate / every
        fine = np.interp(np.arange(2 * every * u.size + 1) / (2 * every), np.arange(u.size), u)
        command = np.column_stack([fine, np.gradient(fine, 0.5 * h)])
        return Simulator(command, h, every, numbers._replace(A_A=area, A_B=area))

    def run(self, sets: Array, block: NDArray[np.int64]) -> Array:
        """Return p_A - p_B (n, lanes) [Pa] of up to 16 paths (lanes, K, p); `block` (n,): that of each sample."""
        lanes = np.minimum(np.arange(SINGLE_WIDTH), len(sets) - 1)
        theta = np.ascontiguousarray(sets[lanes].reshape(SINGLE_WIDTH, -1).T, dtype=np.float32)
        out = np.empty((block.size, SINGLE_WIDTH), dtype=np.float32)
        simulate_response(self.command, self.h, self.every, theta, block, self.numbers, out)
        return out[:, : len(sets)].astype(np.float64)


class Beliefs(NamedTuple):
    """What is believed of the parameters (p,): centre of their mean, its `width`, and how far they `wander` in 90 s."""

    centre: Array
    width: Array
    wander: Array


def beliefs_of(rig: Rig, pressures: float) -> Beliefs:
    """Return the beliefs on machines of a rig at a mean p_A + p_B [Pa]."""
    friction, gain = rig.friction, rig.motor.omega_per_volt
    of_difference = friction.coulomb_pressure == "difference"
    coulomb = coulomb_friction(0.5 * pressures, 0.5 * pressures, friction.F_pr, friction.F_cfr, of_difference)
    own = {"gain": gain, "bias": gain, "K": rig.fluid.K_oil, "F_C": coulomb}
    own |= {name: getattr(friction, name) for name in ("F_v", "K_brk", "C_c")}
    scale = np.array([own.get(name, 1.0) for name in PARAMETERS])
    mean, wander = priors("response"), priors("response_wander")
    return Beliefs(
        scale * [mean[name].value for name in PARAMETERS],
        scale * [mean[name].width for name in PARAMETERS],
        scale * [wander[name].width for name in PARAMETERS],
    )


class Path:
    """Likeliest parameters of K blocks, by Gauss-Newton steps over all blocks together.

    `dp` (n,) [Pa], `edges` (K + 1,) of the blocks [samples], each `seconds` long. With `smooth` [samples] > 0 only what
    a Gaussian of that width leaves of the pressure is fitted. `unit` (p,): a step of the parameters for a difference.
    """

    def __init__(
        self, simulator: Simulator, dp: Array, edges: NDArray[np.int64], seconds: float, beliefs: Beliefs
    ) -> None:
        self.simulator, self.dp, self.edges, self.beliefs = simulator, dp, edges, beliefs
        self.blocks, self.smooth, self.variance = edges.size - 1, 0.0, math.nan
        self.block = np.repeat(np.arange(self.blocks), np.diff(edges))
        self.unit = _NUDGE * np.minimum(beliefs.width, beliefs.wander)
        steps, level = np.diff(np.eye(self.blocks), axis=0), np.full((self.blocks, self.blocks), self.blocks**-2.0)
        walk = WANDER_TIME / seconds * steps.T @ steps
        self.strain = np.zeros((self.blocks, _SIZE, self.blocks, _SIZE))
        for j, unit in enumerate(self.unit):
            self.strain[:, j, :, j] = (unit / beliefs.wander[j]) ** 2 * walk + (unit / beliefs.width[j]) ** 2 * level

    def seen(self, rows: Array) -> Array:
        """Return rows (n, ...) without their means over the blocks, and without what is not fitted."""
        rows = gaussian_filter1d(rows, self.smooth, axis=0) if self.smooth > 0.0 else rows
        means = np.add.reduceat(rows, self.edges[:-1]) / np.diff(self.edges)[:, None]
        return np.asarray(rows - means[self.block])

    def squares(self, sets: Array) -> Array:
        """Return the squares [Pa^2] that up to 16 paths (m, K, p) leave."""
        left = self.seen(self.dp[:, None] - self.simulator.run(sets, self.block))
        return np.asarray(np.einsum("nm,nm->m", left, left))

    def look(self, theta: Array, others: Array) -> tuple[Array, Array, Array]:
        """Return residual (n,) and Jacobian (n, p) [Pa per unit] at a path, and the squares that `others` leave."""
        sets = np.concatenate([np.tile(theta, (_SIZE + 1, 1, 1)), others])
        sets[range(1, _SIZE + 1), :, range(_SIZE)] += self.unit[:, None]
        shown = self.simulator.run(sets, self.block)
        left = self.seen(self.dp[:, None] - shown[:, [0, *range(_SIZE + 1, len(sets))]])
        slopes = self.seen(shown[:, 1 : _SIZE + 1] - shown[:, :1])
        return left[:, 0], slopes, np.einsum("nm,nm->m", left[:, 1:], left[:, 1:])

    def spread(self, left: Array) -> float:
        """Return the variance [Pa^2] of a residual (n,), for as many samples as are independent of each other."""
        return float(left @ left) / (left.size - self.blocks) * max(1.0, 2.0 * math.sqrt(math.pi) * self.smooth)

    def normal(self, left: Array, slopes: Array) -> tuple[Array, Array]:
        """Return information (K p, K p) and vector (K p,) of the blocks, in units, at the present variance."""
        N, b = np.zeros_like(self.strain), np.empty((self.blocks, _SIZE))
        for k, (first, end) in enumerate(zip(self.edges[:-1], self.edges[1:], strict=True)):
            here = slopes[first:end]
            N[k, :, k], b[k] = here.T @ here, here.T @ left[first:end]
        return N.reshape(b.size, b.size) / self.variance, b.ravel() / self.variance

    def off(self, theta: Array) -> Array:
        """Return a path (K, p) as deviations (K p,) from what is believed, in units."""
        return np.asarray((theta - self.beliefs.centre) / self.unit).ravel()

    def descend(self, theta: Array, steps: int) -> tuple[Array, Array, Array]:
        """Return a likelier path (K, p) with residual (n,) and Jacobian (n, p) about it.

        A whole step is run with its Jacobian, beside shares of it; where none of them gains, it is damped.
        """
        strain = self.strain.reshape(theta.size, theta.size)
        shares = np.concatenate([[1.0], np.geomspace(0.5, _LEAST_SHARE, SINGLE_WIDTH - _SIZE - 1)])
        left, slopes, _ = self.look(theta, theta[None])
        damping = 0.0
        for _ in range(steps):
            self.variance = self.spread(left)
            N, b = self.normal(left, slopes)
            off = self.off(theta)
            H = N + strain
            move = np.linalg.solve(H + damping * np.diag(np.diag(H)), b - strain @ off)
            paths = theta + shares[:, None, None] * move.reshape(theta.shape) * self.unit
            paths = self._held(theta, paths)
            there, slopes_there, squares = self.look(paths[0], paths[1:])
            offs = np.array([self.off(path) for path in paths])
            costs = np.append(there @ there, squares) / self.variance + np.einsum("mi,mi->m", offs @ strain, offs)
            gains = np.nan_to_num(left @ left / self.variance + off @ strain @ off - costs, nan=-np.inf)
            best = int(np.argmax(gains))
            if not gains[best] > 0.0:
                damping = max(10.0 * damping, _DAMPED)
                if damping > _MOST_DAMPED:
                    break
                continue
            theta, damping = paths[best], 0.1 * damping if damping > _LEAST_DAMPED else 0.0
            left, slopes = (there, slopes_there) if best == 0 else self.look(theta, theta[None])[:2]
            if gains[best] < _ENOUGH:
                break
        self.variance = self.spread(left)
        return theta, left, slopes

    @staticmethod
    def _held(theta: Array, paths: Array) -> Array:
        """Return paths (m, K, p) whose positive parameters are between half and twice those of `theta` (K, p)."""
        paths[:, :, _POSITIVE] = np.clip(paths[:, :, _POSITIVE], 0.5 * theta[:, _POSITIVE], 2.0 * theta[:, _POSITIVE])
        paths[:, :, LAG] = np.maximum(paths[:, :, LAG], 0.0)
        return paths


def first_fit(path: Path, period: float) -> Array:
    """Return parameters (1, p) that hold over a window, a path of one block; the ring has a `period` [samples].

    The ringing makes many local minima. So the slow part of the pressure is fitted first, from the best of several
    gains; then the whole, from what was reached and from the best stiffnesses about the one believed.
    """
    spread, beliefs = np.linspace(-2.0, 2.0, SINGLE_WIDTH), path.beliefs

    def tried(theta: Array, parameter: int) -> tuple[Array, Array]:
        sets = np.tile(theta, (SINGLE_WIDTH, 1, 1))
        centre = beliefs.centre[parameter]
        sets[:, 0, parameter] = centre * np.exp(beliefs.width[parameter] / centre * spread)
        return sets, np.nan_to_num(path.squares(sets), nan=np.inf)

    path.smooth = _SLOW * period
    sets, squares = tried(beliefs.centre, GAIN)
    theta, _, _ = path.descend(sets[int(np.argmin(squares))], _FIRST_STEPS)
    path.smooth = 0.0
    sets, squares = tried(theta, K_OIL)
    beside = np.pad(squares, 1, constant_values=np.inf)
    minima = np.flatnonzero((squares <= beside[2:]) & (squares <= beside[:-2]))
    starts = [theta, *sets[minima[np.argsort(squares[minima])][:_STARTS]]]
    fits = [path.descend(start, _FIRST_STEPS) for start in starts]
    best = min(fits, key=lambda fit: float(np.nan_to_num(fit[1] @ fit[1], nan=np.inf)))[0]
    return path.descend(best, _STEPS)[0]


def evidence(recording: Recording, rig: Rig) -> PressureEvidence | None:
    """Return what the whole response says of the conductance past the piston, block by block.

    Parameters
    ----------
    recording : Recording
        p_A, p_B [Pa] and the command u [V] at a uniform rate.
    rig : Rig
        What is believed of the machine.

    Returns
    -------
    PressureEvidence or None
        None where the rig's piston has no two like areas or a valve drives it, or no parameters simulate the recording.
    """
    if not usable(recording, rig):
        return None
    ring, edges, rate = ring_down(recording, rig), block_edges(recording), recording.rate
    dp, total = recording["p_A"] - recording["p_B"], recording["p_A"] + recording["p_B"]
    dp = dp * np.sign(np.mean(recording["u"] * (dp - dp.mean())))
    beliefs, simulator = beliefs_of(rig, float(np.mean(total))), Simulator.of(recording["u"], rate, rig)
    blocks = edges.size - 1
    seconds, stiffness = recording.duration / blocks, np.ones(blocks)
    early = min(blocks, max(1, round(_WINDOW / seconds)))
    if ring is not None:
        stiffness = ring.stiffness / float(np.mean(ring.stiffness[:early]))
        beliefs.centre[K_OIL] *= float(np.mean(ring.stiffness[:early]))
        beliefs.width[K_OIL] = priors("response")["K_of_ring"].width * beliefs.centre[K_OIL]
    m, window = simulator.numbers, Path(simulator, dp[: edges[early]], edges[[0, early]], seconds, beliefs)
    period = 2.0 * math.pi * rate * math.sqrt(m.V * m.M_eq / (2.0 * beliefs.centre[K_OIL])) / m.A_A
    with np.errstate(over="ignore", invalid="ignore"):
        theta = np.tile(first_fit(window, period), (blocks, 1))
        theta[:, K_OIL] *= stiffness
        path = Path(simulator, dp, edges, seconds, beliefs)
        theta, left, slopes = path.descend(theta, _STEPS)
    if not (np.all(np.isfinite(slopes)) and np.all(np.isfinite(left))):
        return None
    waves = np.exp(2j * np.pi / rate * np.arange(dp.size)[:, None] * mains_lines(total, rate))
    rows = np.column_stack([waves.real, waves.imag])
    left = left - rows @ np.linalg.lstsq(rows.T @ rows, rows.T @ left, rcond=None)[0]
    precision, vector = _of_conductance(path, theta, left, slopes, round(rate))
    return pressure_evidence(recording, edges, precision, vector, (1.0, priors("response")["orifice"].value))


def _of_conductance(path: Path, theta: Array, left: Array, slopes: Array, second: int) -> tuple[Array, Array]:
    """Return precision (K, K) and vector (K,) of G, noise scaled by its long-run variance in G's score over a `second`.

    What is believed of G itself, which guided the descent, is taken out.
    """
    score = np.add.reduceat(slopes[:, G] * left, np.arange(0, left.size, second))
    path.variance = path.spread(left)
    expected = path.variance * float(slopes[:, G] @ slopes[:, G])
    path.variance *= max(1.0, float(score @ score) / max(expected, np.finfo(float).tiny))
    N, b = path.normal(left, slopes)
    strain = path.strain.copy()
    strain[:, G, :, G] = 0.0
    beliefs = strain.reshape(N.shape)
    precision, vector = eliminated(N + beliefs, b - beliefs @ path.off(theta), np.arange(G, len(N), _SIZE))
    unit = path.unit[G]
    return precision / unit**2, (vector + precision @ (theta[:, G] / unit)) / unit
