"""Control that tolerates a leak: the flow across the piston is estimated, and the pump delivers it in addition."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import address_of, call_at, entry, layout_of, record_at, record_of
from sealscope.control.controller import CompiledLaw, Controller, Measured, Started, law_of, measured_at
from sealscope.control.drive import DRIVE, Drive, check_numbers, drive_voltage
from sealscope.control.leak_observer import OBSERVER, SHUT, Balance, conductance, observer_of, update_observer
from sealscope.control.position import PositionPI
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Time [s] over which the pressures that the leak flows under are averaged.
_PRESSURE_LAG = 0.005
#: Time [s] over which a change of the estimate enters the control law, so that the integral can make room.
_BLEND = 0.5
#: A leak is compensated from so many deviations of its estimate on, and no longer below half of them.
_SIGNIFICANT = 4.0
#: ... and from a flow on that moves the piston by so many counts of its encoder a second: less is below what it sees.
_COUNTS = 0.5
#: Blocks that the observer must have used.
_FEWEST = 4
#: What the law remembers, and its numbers; law and memory of the inner one as addresses.
_MEMORY = layout_of(
    *("compensated", "inner", "its_memory", "u_max", "G_assumed", "known", "averaged", "blended"),
    *("mean_A", "mean_B", "G", "stands_out"),
    drive=DRIVE,
    observer=OBSERVER,
)
_memory_at = record_at(_MEMORY)


@entry
def _tolerant_law(memory: Any, sample: Any) -> Any:
    m, measured = _memory_at(memory), measured_at(sample)
    u = call_at(int(m.inner), int(m.its_memory), address_of(sample))
    if math.isnan(m.mean_A):
        m.mean_A, m.mean_B = measured.p_A, measured.p_B
    m.mean_A += m.averaged * (measured.p_A - m.mean_A)
    m.mean_B += m.averaged * (measured.p_B - m.mean_B)
    over = m.mean_A - m.mean_B
    if m.known == 0.0:
        o = m.observer
        update_observer(o, measured.theta, measured.x, measured.p_A, measured.p_B)
        G, sd, blocks = conductance(o)
        above = G - m.G_assumed
        target_G = 0.0
        if blocks >= _FEWEST:
            unseen = _COUNTS * o.x_step * min(o.area_A, o.area_B) / max(abs(over), 1.0)
            needed = (0.5 if m.stands_out > 0.0 else 1.0) * max(_SIGNIFICANT * sd, unseen)
            m.stands_out = 1.0 if above > needed else 0.0
            target_G = above if above > needed else 0.0
        m.G += m.blended * (target_G - m.G)
        if m.stands_out == 0.0 and m.G < 1e-18:
            m.G = 0.0
    if m.G == 0.0:
        m.compensated = 0.0
        return u
    m.compensated = m.G * over
    return min(max(u + drive_voltage(m.drive, m.compensated, 0.0), -m.u_max), m.u_max)


@dataclass(frozen=True)
class FaultTolerant:
    """A controller that makes good the leakage across the piston: u = u_inner + inverse of (G dp).

    `inner` is any controller; G [m^3/(s Pa)] comes from a Kalman filter (`update_observer`) on the controller's own
    signals, less the pump's `G_assumed`. It is 0 until it exceeds its own deviation and a count of the encoder: without
    a leak the voltages are those of `inner`, to the last bit. `known` [m^3/(s Pa)], not negative, takes its place (an
    ideal controller that knows the leak). The compensated flow is reported as `compensated` [m^3/s].
    """

    inner: Controller
    drive: Drive
    balance: Balance
    u_max: float
    G_assumed: float = 0.0
    known: float | None = None

    def __post_init__(self) -> None:
        not_negative = ("G_assumed",) if self.known is None else ("G_assumed", "known")
        check_numbers("the controller", self, ("u_max",), not_negative)

    @classmethod
    def from_rig(cls, rig: Rig, inner: Controller | None = None, *, known: float | None = None) -> Self:
        """Build the controller from a rig's parameters around `inner`, by default `PositionPI`."""
        from sealscope.physics.cylinder import volumes_at_middle

        c, sensors, makeup = rig.cylinder, rig.sensors, rig.makeup
        if rig.valve.spool == "present":
            raise InputError(
                "a fault-tolerant controller must have a pump whose angle it reads (valve.spool = absent), got rig "
                f"{rig.name}"
            )
        pilots = makeup.check_valves == "pilot-operated"
        balance = Balance(
            rig.pump.q_b / (2.0 * math.pi),
            c.A_A,
            c.A_B,
            *volumes_at_middle(c),
            rig.fluid.K_oil,
            sensors.x.resolution,
            math.hypot(max(sensors.p_A.noise, sensors.p_B.noise), sensors.common_noise),
            SHUT * (makeup.p_crack + makeup.p_open) if pilots else 0.0,
        )
        return cls(
            inner or PositionPI.from_rig(rig), Drive.from_rig(rig), balance, rig.daq.u_max, rig.pump.G_pump, known
        )

    @property
    def rate(self) -> float:
        """Samples of the controller a second [Hz]."""
        return self.inner.rate

    @property
    def delay(self) -> int:
        """Whole samples from a measurement to its voltage."""
        return self.inner.delay

    def start(self) -> Callable[[Measured], float]:
        """Start a run: return the function from a `Measured` to the voltage [V]."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Start a run: return the law in machine code, which calls the inner one."""
        inner, rate = law_of(self.inner), self.rate
        memory = record_of(
            _MEMORY,
            self,
            inner=inner.address,  # below 2^53: exact as a double
            its_memory=inner.memory.ctypes.data,
            known=self.known is not None,
            averaged=1.0 - math.exp(-1.0 / (rate * _PRESSURE_LAG)),
            blended=1.0 - math.exp(-1.0 / (rate * _BLEND)),
            mean_A=math.nan,
            G=self.known or 0.0,
            drive=self.drive.numbers(rate),
            observer=observer_of(self.balance, rate),
        )
        return CompiledLaw(_tolerant_law.address, memory.view(np.float64), inner)
