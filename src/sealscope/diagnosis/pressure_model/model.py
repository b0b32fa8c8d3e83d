"""Pressure difference of a machine under its command: the rig reduced to what p_A - p_B depends on.

Where both pistons' areas are alike, p_A and p_B move against each other, so the rig of eqs. (4.1)-(4.22) leaves five
states: the difference dp, the piston's velocity v, the motor's speed omega, its current i and the integral I of its
speed loop. Long strokes change the chambers' volumes, and with them the stiffness and the pressures' sum, on which
friction depends: the sum is taken from the record, the piston's place from the model itself. Throttles and lines are
left out: at the piston they act as more volume (a softer oil) and a little more damping, which the fit finds. Behind a
servo valve other laws of motion hold (`behind_valve`). The laws are those of `sealscope.physics`; the numbers are the
detector's own, from a rig it may assume, and none of them is the recorded machine's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import contracted, kernel
from sealscope.diagnosis.pressure_model.behind_valve import flow_per_volt, rates_behind_a_valve, supply_of
from sealscope.parameters import Rig
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_friction
from sealscope.physics.lanes import SINGLE_WIDTH, load, select, store
from sealscope.physics.leakage import piston_leakage
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.rig import RigNumbers, rig_numbers
from sealscope.recordings.recording import Array

#: What is estimated: speed per volt of the command [rad/(s V)], lead of the command [s], what the speed has beyond it
#: [rad/s] (behind a servo valve flows instead of speeds, [m^3/(s V)] and [m^3/s]), stiffness of the oil [Pa],
#: conductance past the piston and the pump [m^3/(s Pa)], Coulomb friction [N], viscous friction [N s/m], breakaway over
#: Coulomb friction [1], decay of the breakaway [s/m]; Coulomb friction per pressure [N/Pa]; share of the stiffness that
#: follows the stroke [1], mid-stroke's offset as a share of V [1]; share by which friction is larger on the way out,
#: and smaller on the way back [1]; coefficient of an orifice past the piston [m^3/(s Pa^0.5)], which a sound machine
#: does not have.
PARAMETERS = (
    *("gain", "lead", "bias", "K", "G", "F_C", "F_v", "K_brk", "C_c", "F_cfr", "stroke", "offset", "side"),
    "orifice",
)
GAIN, LEAD, BIAS, K, G, F_C, F_V, K_BRK, C_C, F_CFR, STROKE, OFFSET, SIDE, ORIFICE = range(len(PARAMETERS))
#: The parameters that a machine without an orifice past the piston has.
SOUND = ORIFICE
_WIDTH = len(PARAMETERS)
#: Runs that one call makes side by side: in single precision, which is within some Pa of doubles.
RUNS = SINGLE_WIDTH
STATES = 5
State = tuple[float, float, float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float, float]
#: Samples that are turned from lanes into runs at a time.
_TURNED = 1024
#: Largest share of V that a stroke takes away, squared.
_LARGEST_SHARE = 0.75
#: Largest share of V by which a chamber behind a valve is smaller or larger.
_FARTHEST = 0.9
#: Longest step of the solver [s]: a tenth of a radian at the ringing of the thesis's rig would be 2e-4 s; RK4 at 1e-3 s
#: is within 100 Pa, far under the transducers' noise.
LONGEST_STEP = 1.01e-3
#: Most that a decay and a ringing [rad] may do within a coarse step: RK4 is stable up to 2.7 and 2.8.
_FASTEST_DECAY, _FASTEST_RINGING = 2.0, 1.2
#: A model that is led by its readings forgets within so long [s], a period of the ringing: a deviation that rings
#: without damping decays so in the mean.
MEMORY = 0.014
#: The slow part of a pressure: a Gaussian of this width [s] takes the ringing (60 to 80 Hz) out.
SLOW_WIDTH = 0.008
#: ... and of this one the supply's part of p_A + p_B, without what unlike edges do where the valve passes its middle.
SUPPLY_WIDTH = 0.1


def assumed_numbers(rig: Rig) -> RigNumbers:
    """Return the numbers of the assumed machine.

    The area of both sides of the piston is their mean; air in the oil and make-up valves are left out.
    """
    numbers = rig_numbers(rig)
    area = 0.5 * (numbers.A_A + numbers.A_B)
    return numbers._replace(A_A=area, A_B=area, aerated=(), open_circuit=())


def nominal(rig: Rig) -> Array:
    """Return the parameters (14,) that a rig has about its charge pressure with no leak past the piston."""
    friction = rig.friction
    coulomb = coulomb_friction(
        rig.fluid.p_charge,
        rig.fluid.p_charge,
        friction.F_pr,
        friction.F_cfr,
        friction.coulomb_pressure == "difference",
    )
    return np.array(
        [
            rig.motor.omega_per_volt if rig.valve.spool == "absent" else flow_per_volt(rig),
            0.0,
            0.0,
            rig.fluid.K_oil,
            rig.pump.G_pump,
            coulomb,
            friction.F_v,
            friction.K_brk,
            friction.C_c,
            friction.F_cfr,
            0.5,
            0.0,
            0.0,
            0.0,
        ]
    )


@contracted
def stiffening(travel: float, theta: Parameters) -> float:
    """Return the stiffness of both chambers together at a place of the stroke over that at mid-stroke [1].

    1 + s (1 / (1 - q^2) - 1), q = `travel` + o: with V_A = V + A x, V_B = V - A x and A x = q V, 1/V_A + 1/V_B = 2 /
    (V (1 - q^2)); s is 0 for a machine whose volumes are fixed. The inverse is its series up to q^12.
    """
    q = travel + theta[OFFSET]
    square = min(q * q, _LARGEST_SHARE)
    more = square * (1.0 + square * (1.0 + square * (1.0 + square * (1.0 + square * (1.0 + square)))))
    return 1.0 + theta[STROKE] * more


@contracted
def reduced_rates(
    y: State, u: float, stiffness: float, aside: float, coulomb: float, supply: float, theta: Parameters, m: RigNumbers
) -> State:
    """Return dy/dt of y = (dp, v, omega, i, I) under the command u [V], `stiffness` [Pa] and `coulomb` friction [N].

    Behind a servo valve y is that of `rates_behind_a_valve`, whose arguments `aside` and `supply` are; else `supply` is
    the load on the piston [N].
    """
    dp, v, omega, i, integral = y
    friction = stribeck_friction(v, coulomb, theta[K_BRK], theta[C_C], theta[F_V], m.v_th, False)
    friction = friction * select(v < 0.0, 1.0 - theta[SIDE], 1.0 + theta[SIDE])
    past = m.A_A * v + piston_leakage(dp, theta[G], theta[ORIFICE], m.dp_0)
    spin = theta[GAIN] * u + theta[BIAS]
    if len(m.valved) > 0:
        return rates_behind_a_valve(y, spin, theta[GAIN], friction, past, stiffness, aside, supply, m)  # type: ignore[no-any-return]
    error = spin - omega
    voltage = controller_voltage(error, integral, m.k_p, m.K_i, m.V_max)
    return (
        2.0 * pressure_rate(pump_flow(omega, dp, m.q_b, 0.0) - past, m.V, stiffness),
        piston_acceleration(0.5 * dp, -0.5 * dp, friction, supply, 0.0, m.A_A, m.A_A, m.M_eq),
        shaft_acceleration(i, omega, pump_torque(dp, m.q_b), m.C_m, m.B_M, m.J_M),
        winding_current_rate(voltage, i, omega, m.R_c, m.L_c, m.C_e, m.i_max),
        error,
    )


@contracted
def _moved(y: State, h: float, k: State) -> State:
    return y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3], y[4] + h * k[4]


@contracted
def _weighed(a: State, b: State, c: State, d: State) -> State:
    """Return a + 2 b + 2 c + d: summed before they are added to a state, which in single precision rounds once."""
    return (
        (a[0] + d[0]) + 2.0 * (b[0] + c[0]),
        (a[1] + d[1]) + 2.0 * (b[1] + c[1]),
        (a[2] + d[2]) + 2.0 * (b[2] + c[2]),
        (a[3] + d[3]) + 2.0 * (b[3] + c[3]),
        (a[4] + d[4]) + 2.0 * (b[4] + c[4]),
    )


@kernel
def pressure_differences(
    inputs: np.ndarray,
    h: float,
    every: int,
    theta: np.ndarray,
    segment: np.ndarray,
    m: RigNumbers,
    state: np.ndarray,
    out: np.ndarray,
    speeds: bool,
    readings: np.ndarray,
    correction: float,
) -> None:
    """Write dp [Pa], or v [m/s] if `speeds`, of all lanes at each sample into `out` (n, lanes).

    `theta`, `state` and `out` are in single precision for RUNS lanes, or doubles for half as many. The method is RK4 in
    steps of h [s], `every` to a sample. `inputs`: (2 every n + 1, 5) at every half step: command [V], its derivative
    [V/s], the piston's place as A x / V, p_A + p_B from their mean [Pa], a servo valve's supply [Pa] or, without one,
    the load [N]; `theta`:
    (segments, 14, lanes) parameters, `segment` (n,) which of them holds at a sample; `state`: (5, lanes) at the first
    sample, in place. With a `correction` dp, once written, is led towards its `readings` (n,) [Pa] by that share of the
    difference.
    """
    y = (load(state, 0), load(state, 1), load(state, 2), load(state, 3), load(state, 4))
    for sample in range(segment.size):
        store(out, sample, y[1] if speeds else y[0])
        if correction > 0.0:
            y = (y[0] + correction * (readings[sample] - y[0]), y[1], y[2], y[3], y[4])
        row = _WIDTH * segment[sample]
        lead = load(theta, row + LEAD)
        now = (
            load(theta, row + GAIN),
            lead,
            load(theta, row + BIAS),
            load(theta, row + K),
            load(theta, row + G),
            load(theta, row + F_C),
            load(theta, row + F_V),
            load(theta, row + K_BRK),
            load(theta, row + C_C),
            load(theta, row + F_CFR),
            load(theta, row + STROKE),
            load(theta, row + OFFSET),
            load(theta, row + SIDE),
            load(theta, row + ORIFICE),
        )
        for step in range(every):
            at = 2 * (sample * every + step)
            u_0 = inputs[at, 0] + lead * inputs[at, 1]
            u_1 = inputs[at + 1, 0] + lead * inputs[at + 1, 1]
            u_2 = inputs[at + 2, 0] + lead * inputs[at + 2, 1]
            # place and pressures change little within a step: they hold as they are in its middle
            aside = min(max(now[STROKE] * (inputs[at + 1, 2] + now[OFFSET]), -_FARTHEST), _FARTHEST)
            stiff = now[K] if len(m.valved) > 0 else now[K] * stiffening(inputs[at + 1, 2], now)
            coulomb = now[F_C] + now[F_CFR] * inputs[at + 1, 3]
            supply = inputs[at + 1, 4]
            k_1 = reduced_rates(y, u_0, stiff, aside, coulomb, supply, now, m)
            k_2 = reduced_rates(_moved(y, 0.5 * h, k_1), u_1, stiff, aside, coulomb, supply, now, m)
            k_3 = reduced_rates(_moved(y, 0.5 * h, k_2), u_1, stiff, aside, coulomb, supply, now, m)
            k_4 = reduced_rates(_moved(y, h, k_3), u_2, stiff, aside, coulomb, supply, now, m)
            y = _moved(y, h / 6.0, _weighed(k_1, k_2, k_3, k_4))
    store(state, 0, y[0])
    store(state, 1, y[1])
    store(state, 2, y[2])
    store(state, 3, y[3])
    store(state, 4, y[4])


@dataclass(frozen=True, eq=False)
class DrivenModel:
    """The reduced rig under a recorded command, run for many sets of parameters.

    `inputs` (m, 5) at every half step, as `pressure_differences` takes them; `every` steps of `h` [s] to a sample;
    `numbers` of the assumed rig; `readings` (n,) [Pa] that lead dp by the share `correction` of what they add, none
    by default.
    """

    inputs: Array
    h: float
    every: int
    numbers: RigNumbers
    readings: Array = field(default_factory=lambda: np.empty(0))
    correction: float = 0.0

    @staticmethod
    def of(
        u: Array, rate: float, numbers: RigNumbers, pressures: Array | None = None, carried: Array | None = None
    ) -> DrivenModel:
        """Return the model under a command (n,) [V], with the piston in mid-stroke.

        The command ramps from one sample to the next. `pressures` (n,): p_A + p_B [Pa], constant by default; `carried`
        (n,): the part of p_A - p_B that carries a load [Pa], none by default.
        """
        every = int(np.ceil(1.0 / rate / LONGEST_STEP))
        n, h = u.size, 1.0 / rate / every
        fine = finer(u, 2 * every)
        lift = np.zeros(n) if pressures is None else smoothed(pressures, rate)
        lift = finer(lift, 2 * every)
        supply = np.zeros(n) if carried is None else numbers.A_A * carried
        if numbers.valved:
            supply = np.full(n, numbers.p_set)
            if pressures is not None:
                supply = supply_of(smoothed(pressures, rate, SUPPLY_WIDTH), numbers)
        inputs = np.column_stack(
            [fine, np.gradient(fine, 0.5 * h), np.zeros(fine.size), lift - lift.mean(), finer(supply, 2 * every)]
        )
        return DrivenModel(inputs, h, every, numbers)

    def with_travel(self, theta: Array) -> DrivenModel:
        """Return the model with the piston's place that it shows itself for parameters `theta` (14,).

        Mean and trend of the place are removed: mid-stroke is not known, and a piston that stays in its cylinder has no
        trend for long. Behind a valve the trend is kept: what the valve passes at no command moves the piston on.
        """
        n = self.samples
        place = np.cumsum(self.coarse(theta).run(theta[None], speeds=True)[0]) * self.h * self.every
        place = place * self.numbers.A_A / self.numbers.V
        middle = np.arange(n) - 0.5 * (n - 1)
        place -= place.mean()
        if not self.numbers.valved:
            place -= middle * (middle @ place) / (middle @ middle)
        inputs = self.inputs.copy()
        inputs[:, 2] = finer(place, 2 * self.every)
        return replace(self, inputs=inputs)

    @property
    def samples(self) -> int:
        """Number of samples n."""
        return (len(self.inputs) - 1) // (2 * self.every)

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / (self.h * self.every)

    @property
    def u(self) -> Array:
        """The command (m,) [V]."""
        return self.inputs[:, 0]

    @property
    def travel(self) -> Array:
        """The piston's place (m,), A x / V."""
        return self.inputs[:, 2]

    @property
    def supply(self) -> Array:
        """Pressure between a servo valve's supply and return (n,) [Pa], at the samples."""
        return self.inputs[: -1 : 2 * self.every, 4]

    @property
    def carried(self) -> Array:
        """The part of p_A - p_B that carries a load (n,) [Pa], at the samples."""
        return np.zeros(self.samples) if self.numbers.valved else self.supply / self.numbers.A_A

    @cached_property
    def _halved(self) -> DrivenModel:
        return replace(self, inputs=np.ascontiguousarray(self.inputs[::2]), h=2.0 * self.h, every=self.every // 2)

    def coarse(self, theta: Array) -> DrivenModel:
        """Return the model in steps twice as long, itself where that would be too long for parameters `theta` (14,).

        On the thesis's rig at 500 Hz its frequency of ringing is 0.5 % lower and its damping 1.6 1/s larger: good for
        slopes and first looks, at half the time.
        """
        m = self.numbers
        sticking = theta[F_C] * theta[K_BRK] / (m.v_th * m.M_eq)
        ringing = m.A_A * np.sqrt(2.0 * theta[K] / (m.V * m.M_eq))
        stable = 2.0 * self.h * max(sticking / _FASTEST_DECAY, ringing / _FASTEST_RINGING) < 1.0
        return self._halved if stable and self.every % 2 == 0 else self

    def speed_amplitude(self, theta: Array) -> float:
        """Return the amplitude of the motor's speed [rad/s], as of a sine of the command's rms."""
        return float(np.sqrt(2.0) * theta[GAIN] * np.std(self.u))

    def part(self, first: int, n: int) -> DrivenModel:
        """Return the model over n samples from `first` on."""
        return replace(
            self,
            inputs=self.inputs[2 * self.every * first : 2 * self.every * (first + n) + 1],
            readings=self.readings[first : first + n],
        )

    def led(self, readings: Array, theta: Array) -> DrivenModel:
        """Return the model led by readings of dp (n,) [Pa]: what it shows is predicted from the samples before.

        Their mean becomes that of what parameters `theta` (14,) show under the command alone.
        """
        readings = readings - float(np.mean(readings - self.run(theta[None])[0]))
        return replace(self, readings=readings, correction=-math.expm1(-2.0 / (MEMORY * self.rate)))

    def piston_speed(self, omega: float | Array) -> float | Array:
        """Return the piston's speed [m/s] at a speed of the motor [rad/s], without leakage and stored oil."""
        per_drive = 1.0 if self.numbers.valved else self.numbers.q_b / (2.0 * np.pi)
        return omega * per_drive / self.numbers.A_A

    def run(
        self,
        thetas: Array,
        segment: NDArray[np.int64] | None = None,
        start: Array | None = None,
        speeds: bool = False,
    ) -> Array:
        """Return dp [Pa], or v [m/s] if `speeds`, (runs, n) of parameter sets `thetas`.

        `thetas` (runs, 14), or (runs, segments, 14) with `segment` (n,), which of them holds at a sample; `start`
        (runs, 5): the state at the first sample, at rest under the load by default, which becomes the last.
        """
        sets = thetas[:, None, :] if thetas.ndim == 2 else thetas
        runs, n = len(sets), self.samples
        which = np.zeros(n, dtype=np.int64) if segment is None else segment
        shown = np.empty((runs, n))
        for first in range(0, runs, RUNS):
            lanes = np.minimum(np.arange(first, first + RUNS), runs - 1)
            table = np.ascontiguousarray(np.moveaxis(sets[lanes], 0, -1), dtype=np.float32)
            state = np.zeros((STATES, RUNS), dtype=np.float32)
            state[0] = self.carried[:1]
            if start is not None:
                state[:] = start[lanes].T
            out = np.empty((n, RUNS), dtype=np.float32)
            pressure_differences(
                self.inputs,
                self.h,
                self.every,
                table,
                which,
                self.numbers,
                state,
                out,
                speeds,
                self.readings,
                self.correction,
            )
            here = lanes[: min(RUNS, runs - first)]
            for part in range(0, n, _TURNED):  # parts that stay in the processor's cache
                shown[first : first + here.size, part : part + _TURNED] = out[part : part + _TURNED].T[: here.size]
            if start is not None:
                start[here] = state.T[: here.size]
        return shown


def finer(values: Array, times: int) -> Array:
    """Return a signal (n,) that ramps from sample to sample, `times` places a sample (times n + 1,), its end held."""
    steps = np.append(np.diff(values), 0.0)
    between = values[:, None] + steps[:, None] * (np.arange(times) / times)
    return np.append(between, values[-1])


def gaussian(width: float) -> Array:
    """Return a Gaussian of that width in samples, to three widths either side."""
    reach = int(3.0 * width)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    return np.asarray(taps / taps.sum())


def smoothed(values: Array, rate: float, width: float = SLOW_WIDTH) -> Array:
    """Return the slow part of a signal (n,), what is faster than `width` [s] taken out, its ends held."""
    taps = gaussian(width * rate)
    return np.convolve(np.pad(values, taps.size // 2, mode="edge"), taps, "valid")
