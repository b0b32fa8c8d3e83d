"""Control that tolerates a leak: the flow that crosses the piston is estimated, and the pump gives it beside."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from sealscope.control.controller import Controller, Measured
from sealscope.control.drive import Drive, check_numbers
from sealscope.control.leak_observer import SHUT, Balance, LeakObserver
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
            c.V + c.V_hose_A,
            c.V - c.V_rod + c.V_hose_B,
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
        return _Compensating(self)


class _Compensating:
    """One run of a fault-tolerant controller."""

    def __init__(self, law: FaultTolerant) -> None:
        self._law, self._inner = law, law.inner.start()
        self._inverse = law.drive.inverse(law.rate)
        self._observer = LeakObserver(law.balance, law.rate)
        self._averaged = 1.0 - math.exp(-1.0 / (law.rate * _PRESSURE_LAG))
        self._blended = 1.0 - math.exp(-1.0 / (law.rate * _BLEND))
        self._p_A = self._p_B = math.nan
        self._G = law.known or 0.0
        self._stands_out = False
        #: Leakage flow that is made good [m^3/s].
        self.compensated = 0.0

    def __call__(self, measured: Measured) -> float:
        law = self._law
        u = self._inner(measured)
        if math.isnan(self._p_A):
            self._p_A, self._p_B = measured.p_A, measured.p_B
        self._p_A += self._averaged * (measured.p_A - self._p_A)
        self._p_B += self._averaged * (measured.p_B - self._p_B)
        if law.known is None:
            self._observer.update(measured.theta, measured.x, measured.p_A, measured.p_B)
            self._G += self._blended * (self._estimate() - self._G)
            if not self._stands_out and self._G < 1e-18:
                self._G = 0.0
        if self._G == 0.0:
            self.compensated = 0.0
            return u
        self.compensated = self._G * (self._p_A - self._p_B)
        return min(max(u + self._inverse(self.compensated, 0.0), -law.u_max), law.u_max)

    def _estimate(self) -> float:
        observer, above = self._observer, self._observer.G - self._law.G_assumed
        if observer.blocks < _FEWEST:
            return 0.0
        balance, dp = self._law.balance, max(abs(self._p_A - self._p_B), 1.0)
        unseen = _COUNTS * balance.x_step * min(balance.area_A, balance.area_B) / dp
        needed = (0.5 if self._stands_out else 1.0) * max(_SIGNIFICANT * observer.sd, unseen)
        self._stands_out = above > needed
        return above if self._stands_out else 0.0
