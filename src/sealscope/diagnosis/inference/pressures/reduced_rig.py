"""Model of the rig reduced to the difference p_A - p_B of its chamber pressures, for many parameter sets at once.

Its seven states are the difference p, the piston's speed v and position, the friction, the motor's speed and current,
and the integral of the speed loop. The states follow the laws of `sealscope.physics`. A leak of conductance G damps the
ringing of a compliance C after each reversal by G/C. It also reduces the ramp, the breakaway and the fall of the
pressure while sliding. `response` fits the parameters to recorded pressures. Parameter sets are simulated in parallel
lanes of the processor (`physics.lanes`).
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.diagnosis.inference.pressures.fit import Priors
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_force
from sealscope.physics.lanes import WIDTH, load, select, store
from sealscope.physics.leakage import laminar_leakage
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.rig import rig_numbers
from sealscope.recordings.recording import Array
from sealscope.signals.spectrum import average_power

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Parameters that are fitted to a block. The derivatives by the last four need no simulation.
PARAMETERS = (
    "gain",  # motor speed per volt of the command [rad/(s V)]
    "bias",  # motor speed without command [rad/s]
    "K",  # stiffness (bulk modulus) of the oil [Pa]
    "F_C",  # Coulomb friction [N]
    "F_v",  # viscous friction [N s/m]
    "K_brk",  # breakaway over Coulomb friction [1]
    "C_c",  # decay of the breakaway friction with the speed [s/m]
    "side",  # relative increase of friction in motion out [1]
    "G",  # leakage conductance past the piston [m^3/(s Pa)]
    "give",  # compliance of the contact before it slides [m/N]
    "spring",  # stiffness of the load [N/m]
    "lead",  # lead of the command [s]
    "lag",  # lag of the transducers [s]
    "scale",  # scale of p_A - p_B [1]
    "offset",  # sensor offset of p_A - p_B [Pa]
)
#: Index of each parameter.
GAIN, BIAS, K_OIL, F_C, F_V, K_BRK, C_C, SIDE, G, COMPLIANCE, SPRING, LEAD, LAG, SCALE, OFFSET = range(len(PARAMETERS))
#: Index of the position in a state.
POSITION = 5
State = tuple[float, float, float, float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]
#: Numbers of the reduced rig, named as in `physics.rig.RigNumbers`; A_A is the mean of both areas.
Reduced = namedtuple("Reduced", "A_A V M_eq v_th q_b k_p K_i V_max C_m B_M J_M R_c L_c C_e i_max")
#: Laws of friction: Stribeck's, as in the rig, and LuGre's, whose contact does not creep.
LAWS = STRIBECK, BRISTLES = "stribeck", "bristles"
_FRICTION = {STRIBECK: PRESSURE.stribeck, BRISTLES: PRESSURE.bristles}
_CENTRING_RATE = 1.0 / PRESSURE.follow.centring
#: Maximum step of the solver [s], with which RK4 is within 100 Pa, far below the noise of transducers; length of the
#: segments of which spectra are computed [samples].
_MAX_STEP, _SEGMENT = 1.01e-3, 256


@contracted
def _direction_factor(v: float, theta: Parameters) -> float:
    """Compute the factor on the friction for the direction of the piston's speed v [m/s].

    It is 1 + s for motion out (v >= 0) and 1 - s for motion in, with the parameter s = `theta[SIDE]`.
    """
    return select(v < 0.0, 1.0 - theta[SIDE], 1.0 + theta[SIDE])  # type: ignore[no-any-return]


@contracted
def _steady_friction(v: float, theta: Parameters, m: Reduced) -> tuple[float, float, float]:
    """Compute the friction of steady sliding at a speed v [m/s] by Stribeck's law.

    Returns the friction force [N], which falls linearly to zero below the creep speed `m.v_th`; the magnitude of the
    force without this reduction [N]; and the magnitude of the speed, at least the creep speed [m/s]. `theta`:
    parameters; `m`: sizes.
    """
    speed = max(abs(v), m.v_th)
    magnitude = stribeck_force(speed, theta[F_C], theta[K_BRK], theta[C_C]) * _direction_factor(v, theta)
    return magnitude * min(max(v / m.v_th, -1.0), 1.0), magnitude, speed


@contracted
def _advance_friction(
    friction_0: float, steady_0: float, v: float, h: float, theta: Parameters, m: Reduced
) -> tuple[float, float]:
    """Advance the friction force by LuGre's law over a time step h [s].

    Returns the friction force after the step and the friction of steady sliding at the speed `v` [m/s] after it, both
    [N]. `friction_0`, `steady_0`: the same two forces before the step; `theta`: fitted parameters; `m`: sizes.

    The law, without the damping of the contact, is c dF/dt = v - |v| F/F_m, with the contact's compliance c and the
    magnitude F_m of the steady friction (`_steady_friction`). The step is L-stable and of order 2: with a = h |v|/(c
    F_m), |v| being at least the creep speed `m.v_th`, and the steady friction F_s after and F_s0 before the step,

            F = (F_0 + (a/2) (F_s0 + (1 + a) F_s)) / (1 + a + a^2/2).

    In the code numerator and denominator are multiplied by (c F_m)^2.
    """
    steady, magnitude, speed = _steady_friction(v, theta, m)
    slip, stretch = h * speed, theta[COMPLIANCE] * magnitude  # [m]: h |v|, and c F_m
    numerator = friction_0 * stretch * stretch + 0.5 * slip * (steady_0 * stretch + steady * (stretch + slip))
    return numerator / (stretch * stretch + slip * (stretch + 0.5 * slip)), steady


@contracted
def _rates(y: State, friction: float, omega_ref: float, theta: Parameters, m: Reduced) -> State:
    """Compute the time derivative of the state y = (p, v, omega, i, I, x) of the reduced rig.

    These are p_A - p_B [Pa], the piston's speed [m/s], the motor's speed [rad/s] and current [A], the integral of the
    speed error [rad], and the position [m]. `friction` [N]; `omega_ref`: commanded speed [rad/s]; `theta`: fitted
    parameters; `m`: sizes of the rig.
    """
    # p_A = p/2 and p_B = -p/2, so p changes twice as fast as p_A; 0.0: no leakage of the pump, no force of an end stop
    p, v, omega, i, integral, x = y
    outflow = m.A_A * v + laminar_leakage(p, theta[G])  # from chamber A, by motion and leakage
    viscous = theta[F_V] * v * _direction_factor(v, theta)
    error = omega_ref - omega
    voltage = controller_voltage(error, integral, m.k_p, m.K_i, m.V_max)
    return (
        2.0 * pressure_rate(pump_flow(omega, p, m.q_b, 0.0) - outflow, m.V, theta[K_OIL]),
        piston_acceleration(0.5 * p, -0.5 * p, friction + viscous, theta[SPRING] * x, 0.0, m.A_A, m.A_A, m.M_eq),
        shaft_acceleration(i, omega, pump_torque(p, m.q_b), m.C_m, m.B_M, m.J_M),
        winding_current_rate(voltage, i, omega, m.R_c, m.L_c, m.C_e, m.i_max),
        error,
        v - x * _CENTRING_RATE,  # x decays slowly to 0: it counts from the slowly varying mean position
    )


@contracted
def _advance(y: State, h: float, k: State) -> State:
    """Compute the state y + h k after a step h [s] with the derivative k."""
    return y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3], y[4] + h * k[4], y[5] + h * k[5]


@contracted
def _load_six(rows: Array, k: int) -> State:
    """Load the six consecutive rows k to k + 5 of an array, each as one vector of lanes."""
    return load(rows, k), load(rows, k + 1), load(rows, k + 2), load(rows, k + 3), load(rows, k + 4), load(rows, k + 5)


@kernel
def simulate_response(
    command: np.ndarray, rate: float, n_substeps: int, sets: np.ndarray, states: np.ndarray, m: Reduced, out: np.ndarray
) -> None:
    """Simulate p_A - p_B as read by the transducers, for several parameter sets at once, one in each lane.

    The states are integrated by RK4; friction advances by an implicit step from the speed at each stage.

    - `command` (n + 1,): command [V] at the sample before the first and at each of n samples, linear in between;
    - `rate`: sampling rate [Hz]; `n_substeps`: number of integration steps from sample to sample;
    - `sets` (13, lanes): parameters up to the lag of the transducers;
    - `states` (8, lanes): p, v, omega, i, I, x (`_rates`), friction and reading at the sample before the first; on
      return those at the last sample;
    - `m`: sizes of the reduced rig; `out` (n, lanes): receives the readings of p_A - p_B at each sample [Pa].
    """
    y, friction, reading = _load_six(states, 0), load(states, 6), load(states, 7)
    theta = (*_load_six(sets, 0), *_load_six(sets, 6), load(sets, LAG))
    h = 1.0 / (rate * n_substeps)
    steady = _steady_friction(y[1], theta, m)[0]  # friction of steady sliding at the piston's speed y[1]
    for sample in range(command.size - 1):
        rise = command[sample + 1] - command[sample]
        # speed in addition to gain times command: the bias, and the effect of a command that comes earlier by the lead
        lead_speed = theta[GAIN] * theta[LEAD] * (rise * rate) + theta[BIAS]
        for step in range(n_substeps):
            # commanded speeds at the start, in the middle and at the end of the step
            speed_0 = theta[GAIN] * (command[sample] + rise * (step / n_substeps)) + lead_speed
            speed_1 = theta[GAIN] * (command[sample] + rise * ((step + 0.5) / n_substeps)) + lead_speed
            speed_2 = theta[GAIN] * (command[sample] + rise * ((step + 1.0) / n_substeps)) + lead_speed
            # the four stages of RK4; the first result of `_advance_friction` is the friction at the stage
            k_1 = _rates(y, friction, speed_0, theta, m)
            y_1 = _advance(y, 0.5 * h, k_1)
            k_2 = _rates(y_1, _advance_friction(friction, steady, y_1[1], 0.5 * h, theta, m)[0], speed_1, theta, m)
            y_2 = _advance(y, 0.5 * h, k_2)
            k_3 = _rates(y_2, _advance_friction(friction, steady, y_2[1], 0.5 * h, theta, m)[0], speed_1, theta, m)
            y_3 = _advance(y, h, k_3)
            k_4 = _rates(y_3, _advance_friction(friction, steady, y_3[1], h, theta, m)[0], speed_2, theta, m)
            # y + h/6 (k_1 + 2 k_2 + 2 k_3 + k_4)
            y = _advance(y, h / 6.0, _advance(_advance(_advance(k_1, 2.0, k_2), 2.0, k_3), 1.0, k_4))
            friction, steady = _advance_friction(friction, steady, y[1], h, theta, m)
            reading = reading + (y[0] - reading) * (h / (h + theta[LAG]))  # implicit Euler step of the lag
        store(out, sample, reading)
    for row in range(6):
        store(states, row, y[row])
    store(states, 6, friction)
    store(states, 7, reading)


def response_priors(rig: Rig, law: str = STRIBECK, *, is_healthy: bool = False) -> Priors:
    """Compute the priors on the parameters `PARAMETERS` of the pressure response from the parameters of a rig.

    They are the table `[response]` of `priors.toml`, multiplied by the rig's value of the parameter, or absolute if the
    rig has none; the prior of the contact's compliance, "give", depends on the `law` of friction, one of `LAWS`. The
    Coulomb friction is that at the charge pressure. The table states the bias, a speed, in volts of the command. Within
    a recording the leakage of a healthy machine (`is_healthy`) changes only as `conductance.wander` states.
    """
    friction, gain = rig.friction, rig.motor.omega_per_volt
    p_charge, of_difference = rig.fluid.p_charge, friction.coulomb_pressure == "difference"
    coulomb = coulomb_friction(p_charge, p_charge, friction.F_pr, friction.F_cfr, of_difference)
    rig_values = {"gain": gain, "bias": gain, "K": rig.fluid.K_oil, "F_C": coulomb}
    rig_values |= {name: getattr(friction, name) for name in ("F_v", "K_brk", "C_c")}
    relative = {str(name): row for name, row in PRESSURE.response.items()} | {"give": _FRICTION[law].give}
    # one row of centre, width, wander and difference between recordings for each parameter
    rows = [rig_values.get(name, 1.0) * np.array(relative[name]) for name in PARAMETERS]
    priors = Priors.independent(*np.array(rows).T)
    if is_healthy:
        wander = np.where(np.arange(len(PARAMETERS)) == G, PRESSURE.conductance.wander, priors.wander)
        priors = replace(priors, wander=wander)
    return priors


class Machine(NamedTuple):
    """Simulator of the reduced rig.

    `numbers`: sizes of the rig; `rate`: sampling rate [Hz]; `n_substeps`: integration steps per sample; `law`: law of
    friction, one of `LAWS`.
    """

    numbers: Reduced
    rate: float
    n_substeps: int
    law: str

    @staticmethod
    def from_rig(rig: Rig, rate: float, law: str = STRIBECK) -> Machine:
        """Make the simulator of a rig for samples at a `rate` [Hz] and a `law` of friction.

        The piston has the mean area of both sides. The creep speed is that of the law if it has one, else the rig's.
        """
        numbers = rig_numbers(rig)
        numbers = numbers._replace(A_A=0.5 * (numbers.A_A + numbers.A_B), v_th=_FRICTION[law].creep or numbers.v_th)
        reduced = Reduced(*(getattr(numbers, name) for name in Reduced._fields))
        return Machine(reduced, rate, math.ceil(1.0 / rate / _MAX_STEP), law)

    def simulate(self, command: Array, sets: Array, states: Array) -> tuple[Array, Array]:
        """Simulate p_A - p_B [Pa] at n samples for each of up to 16 parameter sets (m, p).

        `command` (n + 1,), `states` (8, m): as in `simulate_response`. Returns p_A - p_B (m, n), and the states (8, m)
        at the last sample.
        """
        lanes = np.minimum(np.arange(WIDTH), len(sets) - 1)  # unused lanes repeat the last set
        theta = np.ascontiguousarray(sets[lanes, : LAG + 1].T, dtype=np.float32)  # without scale and offset
        ends = np.ascontiguousarray(states[:, lanes], dtype=np.float32)
        out = np.empty((command.size - 1, WIDTH), dtype=np.float32)
        simulate_response(command, self.rate, self.n_substeps, theta, ends, self.numbers, out)
        return out[:, : len(sets)].T.astype(np.float64, order="C"), ends[:, : len(sets)].astype(np.float64)

    def centred_start(self, speed: Array) -> float:
        """Compute the initial position [m] that centres the stroke about 0; `speed` (n,): motor speeds [rad/s]."""
        position = np.cumsum(speed) * self.numbers.q_b / (2.0 * math.pi * self.rate * self.numbers.A_A)
        return float(-0.5 * (position.max() + position.min()))

    def ringing_period(self, stiffness: float) -> float:
        """Compute the period of the pressures' ringing [samples] for a stiffness (bulk modulus) of the oil [Pa]."""
        m = self.numbers  # the oil of both chambers is a spring of the stiffness 2 K A^2 / V on the mass
        return float(2.0 * math.pi * self.rate * math.sqrt(m.V * m.M_eq / (2.0 * stiffness)) / m.A_A)

    def ringing_stiffnesses(self, dp: Array, total: Array, priors: Priors) -> Array:
        """Find the stiffnesses of the oil [Pa] for the two strongest ringing frequencies of p_A - p_B, shape (2,).

        The ringing shows in the spectrum of `dp` (n,), i.e. p_A - p_B [Pa], minus that of `total` (n,), i.e. p_A + p_B
        [Pa], which has the same noise and hum but does not ring. A single peak is repeated. If no frequency of the
        spectrum lies within the prior of the stiffness (`priors`), both results are the centre of this prior.
        """
        relative_width = priors.width[K_OIL] / priors.centre[K_OIL]
        n_padded = 4 * _SEGMENT  # samples of a segment with zeros, for a finer grid of frequencies
        middle = n_padded / self.ringing_period(priors.centre[K_OIL])  # bin of the ringing at the centre of the prior
        # bins from 4 prior deviations of log K below the centre to 2 above; the frequency grows with the root of K
        bins = np.arange(
            math.ceil(middle * math.exp(-2.0 * relative_width)),
            min(n_padded // 2, int(middle * math.exp(relative_width))),
        )
        if not bins.size:
            return np.full(2, priors.centre[K_OIL])
        segment = min(_SEGMENT, dp.size)
        difference_power, total_power = average_power(np.array([dp, total]), segment, n_padded)
        excess = np.pad((difference_power - total_power)[bins], 1, constant_values=-np.inf)  # so that ends may be peaks
        peaks = np.flatnonzero((excess[1:-1] > excess[:-2]) & (excess[1:-1] >= excess[2:]))
        strongest = np.resize(peaks[np.argsort(-excess[1 + peaks])], 2)  # a single peak is repeated
        # the frequency grows with the root of the stiffness
        return np.asarray(priors.centre[K_OIL] * (bins[strongest] / middle) ** 2)
