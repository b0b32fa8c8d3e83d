"""Control that tolerates a leak: the flow that crosses the piston is estimated, and the pump gives it beside."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import address_of, call_at, entry, pointer_at
from sealscope.control.controller import ANGLE, P_A, P_B, CompiledLaw, Controller, Measured, Started, X, law_of
from sealscope.control.drive import DRIVE_BLOCK, Drive, check_numbers, drive_voltage
from sealscope.control.leak_observer import SHUT, Balance, conductance, observed, observer_block
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
#: Places of the law's numbers in its block: law and memory of the inner one, as addresses; the last are those of the
#: drive's inverse and of the observer.
_COMPENSATED, _INNER, _ITS_MEMORY, _U_MAX, _ASSUMED, _KNOWN, _AVERAGED, _BLENDED = range(8)
_MEAN_A, _MEAN_B, _G, _STANDS_OUT, _X_STEP, _AREA, _DRIVE = range(8, 15)
_OBSERVER = _DRIVE + DRIVE_BLOCK


@entry
def _tolerant_law(m: Any, measured: Any) -> Any:
    u = call_at(int(m[_INNER]), int(m[_ITS_MEMORY]), address_of(measured))
    if math.isnan(m[_MEAN_A]):
        m[_MEAN_A], m[_MEAN_B] = measured[P_A], measured[P_B]
    m[_MEAN_A] += m[_AVERAGED] * (measured[P_A] - m[_MEAN_A])
    m[_MEAN_B] += m[_AVERAGED] * (measured[P_B] - m[_MEAN_B])
    over = m[_MEAN_A] - m[_MEAN_B]
    if m[_KNOWN] == 0.0:
        observer = pointer_at(m, _OBSERVER)
        observed(observer, measured[ANGLE], measured[X], measured[P_A], measured[P_B])
        G, sd, blocks = conductance(observer)
        above = G - m[_ASSUMED]
        wanted = 0.0
        if blocks >= _FEWEST:
            unseen = _COUNTS * m[_X_STEP] * m[_AREA] / max(abs(over), 1.0)
            needed = (0.5 if m[_STANDS_OUT] > 0.0 else 1.0) * max(_SIGNIFICANT * sd, unseen)
            m[_STANDS_OUT] = 1.0 if above > needed else 0.0
            wanted = above if above > needed else 0.0
        m[_G] += m[_BLENDED] * (wanted - m[_G])
        if m[_STANDS_OUT] == 0.0 and m[_G] < 1e-18:
            m[_G] = 0.0
    if m[_G] == 0.0:
        m[_COMPENSATED] = 0.0
        return u
    m[_COMPENSATED] = m[_G] * over
    return min(max(u + drive_voltage(pointer_at(m, _DRIVE), m[_COMPENSATED], 0.0), -m[_U_MAX]), m[_U_MAX])


@dataclass(frozen=True)
class FaultTolerant:
    """A controller beside which the leakage across the piston is made good: u = u_inner + inverse of (G dp).

    `inner` is any controller; G [m^3/(s Pa)] comes from a `LeakObserver` on the controller's own signals, less the
    pump's `G_assumed`, and is 0 until it stands out of its own deviation and of a count of the encoder: without a leak
    the voltages are those of `inner`, to the last bit. `known` [m^3/(s Pa)], not negative, is taken instead (the ideal
    that knows the leak). The flow that is made good is reported as `compensated` [m^3/s].
    """

    inner: Controller
    drive: Drive
    balance: Balance
    u_max: float
    G_assumed: float = 0.0
    known: float | None = None

    def __post_init__(self) -> None:
        check_numbers("the controller", {"u_max": self.u_max}, {"G_assumed": self.G_assumed, "known": self.known or 0})

    @classmethod
    def of(cls, rig: Rig, inner: Controller | None = None, *, known: float | None = None) -> Self:
        """Return the controller for what a rig is said to be, around `inner`, by default `PositionPI`."""
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
        return cls(inner or PositionPI.of(rig), Drive.of(rig), balance, rig.daq.u_max, rig.pump.G_pump, known)

    @property
    def rate(self) -> float:
        """Samples of the controller a second [Hz]."""
        return self.inner.rate

    @property
    def delay(self) -> int:
        """Whole samples from a measurement to its voltage."""
        return self.inner.delay

    def start(self) -> Callable[[Measured], float]:
        """Return a function from what is measured to the voltage [V], for one run from its beginning."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Return the law in machine code, for one run from its beginning; it calls the inner one."""
        inner, balance, rate = law_of(self.inner), self.balance, self.rate
        m = np.zeros(_OBSERVER)
        m[_INNER], m[_ITS_MEMORY] = inner.address, inner.memory.ctypes.data  # below 2^53: exact as doubles
        m[_U_MAX], m[_ASSUMED], m[_KNOWN] = self.u_max, self.G_assumed, self.known is not None
        m[_AVERAGED], m[_BLENDED] = (1.0 - math.exp(-1.0 / (rate * lag)) for lag in (_PRESSURE_LAG, _BLEND))
        m[_MEAN_A] = m[_MEAN_B] = math.nan
        m[_G], m[_X_STEP], m[_AREA] = self.known or 0.0, balance.x_step, min(balance.area_A, balance.area_B)
        m[_DRIVE:_OBSERVER] = self.drive.block(rate)
        return CompiledLaw(_tolerant_law.address, np.r_[m, observer_block(balance, rate)], inner)
