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
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d
from numpy.typing import NDArray

from sealscope.compiled import contracted, kernel
from sealscope.diagnosis.information import Information
from sealscope.diagnosis.priors import priors
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_friction
from sealscope.physics.lanes import SINGLE_WIDTH, load, select, store
from sealscope.physics.leakage import laminar_leakage
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.rig import RigNumbers, rig_numbers
from sealscope.diagnosis.ring_down import WANDER_TIME
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What a block has of its own: speed per volt [rad/(s V)], lead of the command [s], speed beside it [rad/s], stiffness
#: of the oil [Pa], Coulomb friction [N], viscous friction [N s/m], breakaway over Coulomb friction [1], its decay [s/m],
#: share by which friction is larger on the way out [1], conductance past the piston [m^3/(s Pa)].
PARAMETERS = ("gain", "lead", "bias", "K", "F_C", "F_v", "K_brk", "C_c", "side", "G", "lag")
GAIN, LEAD, BIAS, K_OIL, F_C, F_V, K_BRK, C_C, SIDE, G, LAG = range(len(PARAMETERS))
_SIZE, _STATES = len(PARAMETERS), 5
State = tuple[float, float, float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float, float]
#: Longest step of the solver [s]: RK4 is within 100 Pa there, far under the noise of transducers.
_STEP = 1.01e-3
#: Steps of differences as a share of what is believed, gain of log likelihood that ends a descent.
_NUDGE, _ENOUGH = 0.05, 0.1


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


import os
NS=int(os.environ.get('NS','3'))
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
        every = math.ceil(1.0 / rate / _STEP)
        numbers = rig_numbers(rig)
        area = 0.5 * (numbers.A_A + numbers.A_B)
        fine = np.interp(np.arange(2 * every * u.size + 1) / (2 * every), np.arange(u.size), u)
        h = 1.0 / rate / every
        return Simulator(
            np.column_stack([fine, np.gradient(fine, 0.5 * h)]), h, every, numbers._replace(A_A=area, A_B=area)
        )

    def run(self, sets: Array, block: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return p_A - p_B (n, lanes) [Pa] of up to 16 parameter sets (lanes, K, p); `block` (n,) of each sample."""
        lanes = np.minimum(np.arange(SINGLE_WIDTH), len(sets) - 1)
        theta = np.ascontiguousarray(sets[lanes].reshape(SINGLE_WIDTH, -1).T, dtype=np.float32)
        out = np.empty((block.size, SINGLE_WIDTH), dtype=np.float32)
        command = self.command[: 2 * self.every * block.size + 1]
        simulate_response(command, self.h, self.every, theta, block, self.numbers, out)
        return out[:, : len(sets)]


class Path:
    """Likeliest parameters of K blocks, by Gauss-Newton steps over all blocks together.

    `dp` (n,) [Pa], `edges` (K + 1,) [samples] of blocks of `seconds`; `centre`, `widths`, `walks` (p,): what is
    believed of the parameters' mean, and how far they wander. `units` (p,): a step of a difference.
    """

    def __init__(
        self, simulator: Simulator, dp: Array, edges: NDArray[np.int64], seconds: float, beliefs: tuple[Array, ...], width: float = 0.0
    ) -> None:
        self.centre, widths, walks = beliefs
        self.simulator, self.dp, self.edges, self.K = simulator, dp, edges, edges.size - 1
        self.block = np.repeat(np.arange(self.K), np.diff(edges))
        self.units = _NUDGE * np.minimum(widths, walks)
        steps, mean = np.diff(np.eye(self.K), axis=0), np.full((self.K, self.K), 1.0 / self.K**2)
        self.strains = [
            mean * (unit / width) ** 2 + steps.T @ steps * ((unit / walk) ** 2 * WANDER_TIME / seconds)
            for width, walk, unit in zip(widths, walks, self.units, strict=True)
        ]
        self.variance, self.width = math.nan, width

    def strain(self, without: int = -1) -> Array:
        """Return the precision (K p, K p) of the path in units, `without` what is believed of one parameter."""
        p = self.units.size
        strain = np.zeros((self.K, p, self.K, p))
        for j, each in enumerate(self.strains):
            strain[:, j, :, j] = each * (j != without)
        return strain.reshape(self.K * p, self.K * p)

    def centred(self, rows: Array) -> Array:
        """Return rows (n, ...) without their means over the blocks, and without what is quicker than `width`."""
        if self.width > 0.0:
            rows = gaussian_filter1d(rows, self.width, axis=0)
        means = np.add.reduceat(rows, self.edges[:-1]) / np.diff(self.edges)[:, None]
        return np.asarray(rows - means[self.block])

    def look(self, theta: Array, move: Array, shares: Array) -> tuple[Array, Array, Array]:
        """Return residual (n,), Jacobian (n, p) [Pa per unit] at a path moved wholly, and squares left at `shares`."""
        p = self.units.size
        sets = np.concatenate([np.tile(theta + move, (p + 1, 1, 1)), theta + shares[:, None, None] * move])
        sets[range(1, p + 1), :, range(p)] += self.units[:, None]
        shown = self.simulator.run(sets, self.block).astype(np.float64)
        left = self.centred(np.column_stack([self.dp - shown[:, 0], self.dp[:, None] - shown[:, p + 1 :]]))
        return left[:, 0], self.centred(shown[:, 1 : p + 1] - shown[:, :1]), np.einsum("nm,nm->m", left, left)

    def normal(self, left: Array, slopes: Array) -> tuple[Array, Array]:
        """Return the information (K p, K p) and vector (K, p) of linear blocks, in units, at the present variance."""
        p = self.units.size
        N, b = np.zeros((self.K, p, self.K, p)), np.empty((self.K, p))
        for k, (first, end) in enumerate(zip(self.edges[:-1], self.edges[1:], strict=True)):
            here = slopes[first:end]
            N[k, :, k], b[k] = here.T @ here, here.T @ left[first:end]
        return N.reshape(self.K * p, self.K * p) / self.variance, b / self.variance

    def descend(self, theta: Array, steps: int, verbose=False) -> tuple[Array, Array, Array]:
        """Return a likelier path (K, p) and residual and Jacobian about it."""
        p, strain = self.units.size, self.strain()
        shares = np.geomspace(0.5, 0.02, SINGLE_WIDTH - p - 1)
        off = lambda path: ((path - self.centre) / self.units).ravel()  # noqa: E731
        left, slopes, squares = self.look(theta, np.zeros_like(theta), shares)
        damping = 0.0
        for _ in range(steps):
            self.variance = self.spread(left)
            N, b = self.normal(left, slopes)
            H, slope = N + strain, b.ravel() - strain @ off(theta)
            cost = float(left @ left) / self.variance + off(theta) @ strain @ off(theta)
            move = np.linalg.solve(H + damping * np.diag(np.diag(H)), slope).reshape(self.K, p) * self.units
            move = self.held(theta, move)
            fresh, slopes_there, squares = self.look(theta, move, shares)
            costs = squares / self.variance
            costs = np.array([c + off(theta + s * move) @ strain @ off(theta + s * move) for c, s in zip(costs, [1.0, *shares])])
            best = int(np.nanargmin(costs)) if np.any(np.isfinite(costs)) else 0
            gained = cost - costs[best]
            if verbose: print("   gained", gained, "best", best, "rms", np.sqrt(self.variance), "damp", damping, theta.mean(0))
            if not gained > 0.0:
                if damping > 10.0: break
                damping = max(10.0 * damping, 0.1)
                continue
            if best == 0:
                theta, left, slopes = theta + move, fresh, slopes_there
                damping = damping / 10 if damping > 1e-3 else 0.0
            else:
                theta = theta + shares[best - 1] * move
                left, slopes, _ = self.look(theta, np.zeros_like(theta), shares)
            if gained < _ENOUGH:
                break
        self.variance = self.spread(left)
        return theta, left, slopes

    def spread(self, left: Array) -> float:
        """Return the variance [Pa^2] of a residual (n,), for as many samples as are independent."""
        return float(left @ left) / (left.size - self.K) * max(1.0, 2.0 * math.sqrt(math.pi) * self.width)

    def held(self, theta: Array, move: Array) -> Array:
        """Return a move that keeps what must be positive above half of itself."""
        positive = [GAIN, K_OIL, F_C, K_BRK, C_C]
        move = move.copy()
        move[:, LAG] = np.maximum(move[:, LAG], -theta[:, LAG])
        move[:, positive] = np.clip(move[:, positive], -0.5 * theta[:, positive], theta[:, positive])
        return move


def beliefs_of(rig: Rig, pressures: float) -> tuple[Array, Array, Array]:
    """Return centre, width and wander (p,) of the parameters of a rig's machines at a mean p_A + p_B [Pa]."""
    friction = rig.friction
    coulomb = friction.F_pr + friction.F_cfr * pressures
    own = {"gain": rig.motor.omega_per_volt, "bias": rig.motor.omega_per_volt, "K": rig.fluid.K_oil, "F_C": coulomb, "F_v": friction.F_v, "K_brk": friction.K_brk, "C_c": friction.C_c}
    mean, wander = priors("pressures.toml", "response"), priors("pressures.toml", "response_wander")
    scale = np.array([own.get(name, 1.0) for name in PARAMETERS])
    return (
        scale * [mean[name].value for name in PARAMETERS],
        scale * [mean[name].width for name in PARAMETERS],
        scale * [wander[name].width for name in PARAMETERS],
    )


def evidence(recording: Recording, rig: Rig, verbose=False) -> Information | None:
    from sealscope.diagnosis import ring_down
    import time
    t0=time.time()
    n, rate = len(recording), recording.rate
    u, dp = recording["u"], recording["p_A"] - recording["p_B"]
    pressures = float(np.mean(recording["p_A"] + recording["p_B"]))
    dp = dp * np.sign(np.mean(u * (dp - dp.mean())))
    simulator = Simulator.of(u, rate, rig)
    centre, widths, walks = beliefs_of(rig, pressures)
    # where the ring is
    machine = ring_down.Machine.of(rig, pressures)
    K = max(1, min(ring_down.BLOCKS, int(n / rate / ring_down.SHORTEST_BLOCK)))
    edges = np.round(np.linspace(0, n, K + 1)).astype(np.int64)
    classes = ring_down.windows_of(recording, machine, edges)
    theta = centre.copy()
    stiff=np.ones(K); 
    first = int(min(n, 40 * rate)); kw=max(1,int(round(K*first/n)))
    if classes:
        ring = ring_down._Ring(classes, machine, K, n / rate / K, rate)
        x,_,_ = ring.fit()
        om=x[K:2*K]; o0=om[:kw].mean()
        theta[K_OIL] *= (o0 / machine.omega) ** 2
        stiff=(om/o0)**2
    t1=time.time()
    sets = np.tile(theta, (SINGLE_WIDTH, 1, 1))
    sets[:, 0, GAIN] *= np.geomspace(0.4, 2.5, SINGLE_WIDTH)
    wn=widths.copy(); wn[K_OIL]=0.05*theta[K_OIL]
    bel=(theta, wn, walks)
    w=Path(simulator, dp[:first], np.array([0, first]), n/rate/K, bel, 0.6*machine.period*rate)
    shown=simulator.run(sets, w.block[:first])
    k=int(np.argmin(np.einsum("nm,nm->m",*(2*[w.centred(dp[:first,None]-shown)]))))
    theta=sets[k]
    theta,_,_=w.descend(theta, 6, verbose)
    w.width=0.0
    sets=np.tile(theta,(SINGLE_WIDTH,1,1)); sets[:,0,K_OIL]=bel[0][K_OIL]*np.linspace(0.93,1.07,SINGLE_WIDTH)
    cost=np.einsum("nm,nm->m",*(2*[w.centred(dp[:first,None]-simulator.run(sets, w.block[:first]))]))
    low=np.flatnonzero((cost<=np.append(cost[1:],np.inf))&(cost<=np.append(np.inf,cost[:-1])))
    low=low[np.argsort(cost[low])][:NS]
    if theta[0,K_OIL]<0.93*bel[0][K_OIL] or theta[0,K_OIL]>1.07*bel[0][K_OIL] or True: starts=[theta,*sets[low]]
    tried=[w.descend(x0, 12, verbose) for x0 in starts]
    sq=[float(l@l) for _,l,_ in tried]
    if verbose: print("tried",np.sqrt(np.array(sq)/first).round(0))
    theta=tried[int(np.argmin(sq))][0]
    t2=time.time()
    path=Path(simulator, dp, edges, n/rate/K, bel)
    theta=np.tile(theta,(K,1)); theta[:,K_OIL]*=stiff
    theta, left, slopes = path.descend(theta, 15, verbose)
    t3=time.time()
    if verbose: print("times",t1-t0,t2-t1,t3-t2)
    lines=2*np.pi*ring_down._mains(recording["p_A"]+recording["p_B"],rate)/rate
    waves=np.exp(1j*np.arange(n)[:,None]*lines); W=np.column_stack([waves.real,waves.imag])
    left=left-W@np.linalg.lstsq(W.T@W,W.T@left,rcond=None)[0]
    path.variance=float(left@left)/n
    N,b=path.normal(left,slopes)
    # long run variance
    sc=slopes[:,G]*left; L=int(rate); m=n//L
    infl=np.mean(sc[:m*L].reshape(m,L).sum(1)**2)/(np.mean(np.sum(slopes[:m*L,G].reshape(m,L)**2,1))*path.variance)
    N/=max(1,infl); b=b/max(1,infl)
    strain=path.strain(G); off=((theta-path.centre)/path.units).ravel()
    H=N+strain; slope=b.ravel()-strain@off
    g=np.arange(G,H.shape[0],len(PARAMETERS)); rest=np.setdiff1d(np.arange(H.shape[0]),g)
    sol=np.linalg.solve(H[np.ix_(rest,rest)],np.column_stack([H[np.ix_(rest,g)],slope[rest]]))
    precision=H[np.ix_(g,g)]-H[np.ix_(g,rest)]@sol[:,:-1]
    vector=slope[g]-H[np.ix_(g,rest)]@sol[:,-1]+precision@(theta[:,G]/path.units[G])
    pressure=np.add.reduceat(np.abs(dp),edges[:-1])/np.diff(edges)
    out=Information(recording.t[0]+0.5*(edges[1:]+edges[:-1])/rate, precision/path.units[G]**2, vector/path.units[G], pressure, 0.17,(1.0,2.0))
    if verbose: print("rms",np.sqrt(path.variance),"infl",infl, theta.mean(0), theta[:,G])
    return out
