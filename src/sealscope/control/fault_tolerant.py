"""Fault-tolerant control: the leakage across the piston is estimated, and the pump delivers this flow in addition."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import address_of, call_at, entry, make_record, record_dtype, record_view
from sealscope.control.controller import CompiledLaw, Controller, Measured, Started, measured_at, start_law
from sealscope.control.drive import DRIVE, Drive, check_numbers, drive_voltage
from sealscope.control.leak_observer import OBSERVER, SHUT, Balance, make_observer, update_observer
from sealscope.control.position import PositionPI
from sealscope.parameters.parts import check_circuit_property

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRESSURE_LAG = 0.005  # time constant [s] of the average of the pressures that drive the leak
#: Time constant [s] by which a changed estimate enters the control law, so that the inner integral can follow.
_BLEND = 0.5
#: A leak is compensated once its estimate exceeds this many standard errors, until the estimate is below half of them.
_SIGNIFICANT_SDS = 4.0
#: The leak must also move the piston by this many encoder counts a second: a slower motion cannot be measured.
_RESOLVED_COUNTS = 0.5
_MIN_BLOCKS = 4  # number of blocks that the observer must have used before a leak is compensated
#: Conductance [m^3/(s Pa)] below which a former leak counts as 0: the voltages are the inner controller's again.
_NEGLIGIBLE_G = 1e-18
#: State and parameters of the control law. `inner`, `inner_memory`: addresses of the inner controller's law and memory;
#: `mean_A`, `mean_B`: averaged pressures [Pa]; `G`: compensated conductance [m^3/(s Pa)].
_MEMORY = record_dtype(
    *("compensated", "inner", "inner_memory", "u_max", "G_assumed", "is_known", "pressure_gain", "blend_gain"),
    *("mean_A", "mean_B", "G", "is_significant"),
    drive=DRIVE,
    observer=OBSERVER,
)
_memory_at = record_view(_MEMORY)


@entry
def _tolerant_law(memory: Any, sample: Any) -> Any:
    """Compute the voltage [V] of a sample: the inner controller's, plus the one for the leakage flow.

    The leakage flow is G times the averaged p_A - p_B; it is stored as `compensated`. If the leak is not known
    (`is_known` = 0), G slowly follows a target: the conductance that the observer estimates minus the assumed one, or 0
    while this difference is not significant or based on too few blocks. While G is not 0, the voltage is limited to
    +-u_max. `memory`, `sample`: addresses of a record `_MEMORY`, which is updated, and of the numbers of a `Measured`.
    """
    m, measured = _memory_at(memory), measured_at(sample)
    u = call_at(int(m.inner), int(m.inner_memory), address_of(sample))
    if math.isnan(m.mean_A):  # the first sample
        m.mean_A, m.mean_B = measured.p_A, measured.p_B
    m.mean_A += m.pressure_gain * (measured.p_A - m.mean_A)
    m.mean_B += m.pressure_gain * (measured.p_B - m.mean_B)
    mean_dp = m.mean_A - m.mean_B
    if m.is_known == 0.0:  # the leak's conductance is estimated
        observer = m.observer
        update_observer(observer, measured.theta, measured.x, measured.p_A, measured.p_B)
        excess_G, sd = observer.state[0] - m.G_assumed, math.sqrt(observer.P[0, 0])
        target_G = 0.0
        if observer.n_blocks >= _MIN_BLOCKS:
            # the largest leak whose motion of the piston the encoder does not resolve; 1 Pa: no division by 0
            unresolved_flow = _RESOLVED_COUNTS * observer.x_step * min(observer.area_A, observer.area_B)
            unresolved_G = unresolved_flow / max(abs(mean_dp), 1.0)
            # a leak that is compensated already has half the threshold
            threshold_G = (0.5 if m.is_significant > 0.0 else 1.0) * max(_SIGNIFICANT_SDS * sd, unresolved_G)
            m.is_significant = 1.0 if excess_G > threshold_G else 0.0
            target_G = excess_G if excess_G > threshold_G else 0.0
        m.G += m.blend_gain * (target_G - m.G)
        if m.is_significant == 0.0 and m.G < _NEGLIGIBLE_G:
            m.G = 0.0
    if m.G == 0.0:
        m.compensated = 0.0
        return u
    m.compensated = m.G * mean_dp
    added_u = drive_voltage(m.drive, m.compensated, 0.0)  # dp = 0: the inner controller's voltage meets the load
    return min(max(u + added_u, -m.u_max), m.u_max)


@dataclass(frozen=True)
class FaultTolerant:
    """A controller that compensates the leakage across the piston, in addition to another controller.

    The voltage is that of the controller `inner`, plus the one at which the `drive` delivers the leakage flow G dp.
    Here dp is p_A - p_B, averaged over some milliseconds. A Kalman filter (`update_observer`, with the model `balance`)
    estimates the conductance between the chambers. G [m^3/(s Pa)] is `known` or, if this is None, the estimate minus
    `G_assumed`. It then stays 0 until this difference exceeds 4 standard errors and the leak would move the piston by
    half an encoder count a second. While G is 0, the voltages are exactly those of `inner`. The compensated flow
    [m^3/s] is reported as `compensated`.
    """

    inner: Controller
    drive: Drive
    balance: Balance
    u_max: float  # [V] limit of the voltage while a leak is compensated
    G_assumed: float = 0.0  # [m^3/(s Pa)] assumed leakage conductance of the pump
    known: float | None = (
        None  # [m^3/(s Pa)] taken as G, by an ideal controller that knows the leak; None to estimate G
    )

    def __post_init__(self) -> None:
        not_negative = ("G_assumed",) if self.known is None else ("G_assumed", "known")
        check_numbers("the controller", self, positive=("u_max",), not_negative=not_negative)

    @classmethod
    def from_rig(cls, rig: Rig, inner: Controller | None = None, *, known: float | None = None) -> Self:
        """Build the controller from a rig's parameters; raise InputError for a rig whose pump angle is not measured.

        `inner`: by default the rig's `PositionPI`; `known` [m^3/(s Pa)]: the leak's conductance, None to estimate it.
        """
        from sealscope.physics.cylinder import mid_stroke_volumes

        cylinder, sensors, makeup = rig.cylinder, rig.sensors, rig.makeup
        subject = "a fault-tolerant controller, which reads the pump's angle,"
        check_circuit_property(subject, rig.name, rig.circuit, "pump_is_measured")
        V_A, V_B = mid_stroke_volumes(cylinder)
        balance = Balance(
            D=rig.pump.q_b / (2.0 * math.pi),
            area_A=cylinder.A_A,
            area_B=cylinder.A_B,
            V_A=V_A,
            V_B=V_B,
            K=rig.fluid.K_oil,
            x_step=sensors.x.resolution,
            noise=math.hypot(max(sensors.p_A.noise, sensors.p_B.noise), sensors.common_noise),
            # a plain check valve feeds the lower pressure only
            shut=SHUT * (makeup.p_crack + makeup.p_open) if makeup.check_valves == "pilot-operated" else 0.0,
        )
        inner = inner or PositionPI.from_rig(rig)
        return cls(inner, Drive.from_rig(rig), balance, rig.daq.u_max, G_assumed=rig.pump.G_pump, known=known)

    @property
    def rate(self) -> float:
        """Sampling rate of the controller [Hz]."""
        return self.inner.rate

    @property
    def delay(self) -> int:
        """Number of samples from a measurement to the voltage computed from it."""
        return self.inner.delay

    def start(self) -> Callable[[Measured], float]:
        """Start a run; return the function that computes the voltage [V] from each `Measured`."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Make the control law of a new run as machine code; it calls the law of the inner controller."""
        inner, rate = start_law(self.inner), self.rate
        memory = make_record(
            _MEMORY,
            self,
            inner=inner.address,  # below 2^53: exact as a double
            inner_memory=inner.memory.ctypes.data,
            is_known=self.known is not None,  # else the conductance is estimated
            pressure_gain=1.0 - math.exp(-1.0 / (rate * _PRESSURE_LAG)),
            blend_gain=1.0 - math.exp(-1.0 / (rate * _BLEND)),
            mean_A=math.nan,
            G=self.known or 0.0,  # an estimate starts at 0
            drive=self.drive.coefficients(rate),
            observer=make_observer(self.balance, rate),
        )
        return CompiledLaw(_tolerant_law.address, memory.view(np.float64), kept=inner)
