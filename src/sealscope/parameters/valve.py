"""Parameters of a valve-controlled rig: the servo valve, and its supply at constant pressure."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import model_validator

from sealscope.parameters.fields import Part, choice, quantity, with_unit


def _overlap(edge: str) -> Any:
    """Declare the parameter for the overlap [m] of a metering edge of the valve; `edge`: name, such as "P to A"."""
    return quantity(f"overlap of the edge from {edge} (< 0: underlap)", "m", absent=0, ge=-0.1, le=0.1)


class ServoValve(Part):
    """Servo valve with four metering edges between supply (P), return (T) and the chambers A and B.

    With `spool = "absent"` the rig has no servo valve. The spool follows the command as a second-order system with
    limited speed. An edge is an orifice whose area grows linearly with the spool's travel beyond the overlap.
    """

    spool: Literal["absent", "present"] = choice("servo valve between supply and cylinder", absent="absent")
    Q_N: float = quantity("rated flow of an edge at full stroke", "m^3/s", absent=1.6e-4, gt=0, le=1)
    dp_N: float = quantity("pressure drop of an edge at its rated flow", "Pa", absent=3.5e6, gt=0, le=1e9)
    dp_lam: float = quantity(
        "pressure difference below which an edge of the valve is laminar", "Pa", absent=5e4, gt=0, le=1e7
    )
    u_N: float = quantity("command at full stroke of the spool", "V", absent=10, gt=0, le=1e3)
    x_max: float = quantity("stroke of the spool, either way", "m", absent=5e-4, gt=0, le=0.1)
    o_PA: float = _overlap("P to A")
    o_AT: float = _overlap("A to T")
    o_PB: float = _overlap("P to B")
    o_BT: float = _overlap("B to T")
    omega_s: float = quantity("natural frequency of the spool", "rad/s", absent=600, gt=0, le=1e5)
    zeta_s: float = quantity("damping ratio of the spool", "1", absent=0.7, gt=0, le=100)
    v_max: float = quantity("largest speed of the spool", "m/s", absent=0.1, gt=0, le=1e3)

    @model_validator(mode="after")
    def _check_overlaps(self) -> Self:
        """Raise ValueError, as pydantic requires, unless the overlap of each edge is within +- the spool's stroke."""
        for name in ("o_PA", "o_AT", "o_PB", "o_BT"):
            overlap = getattr(self, name)
            if not abs(overlap) < self.x_max:
                raise ValueError(
                    f"valve.{name} must be within the spool's stroke, +-{with_unit(self.x_max, 'm')} (valve.x_max), "
                    f"got {with_unit(overlap, 'm')}"
                )
        return self


class Supply(Part):
    """Supply of a servo valve: a pump driven at constant speed, with a relief valve that limits the pressure.

    With `drive = "absent"` the rig has no such supply. The rig's motor turns the pump, which draws from the return
    line and feeds the line of volume V_1, to which an accumulator is connected.
    """

    drive: Literal["absent", "constant-speed"] = choice(
        "drive of the pump that supplies a servo valve", absent="absent"
    )
    omega_P: float = quantity("speed of the supply's pump", "rad/s", absent=157, gt=0, le=1e4)
    p_set: float = quantity("pressure above the return that opens the relief valve", "Pa", absent=7e6, gt=0, le=1e9)
    G_set: float = quantity(
        "conductance of the supply's relief valve above its pressure", "m^3/(s Pa)", absent=5e-10, gt=0, le=1e-6
    )
    p_return: float = quantity("pressure of the return line", "Pa", absent=0, ge=0, le=1e8)
    V_acc: float = quantity("gas in the accumulator at p_pre (0: none)", "m^3", absent=0, ge=0, le=10)
    p_pre: float = quantity("pressure of the gas in the empty accumulator", "Pa", absent=5e6, ge=0, le=1e9)
    n_acc: float = quantity("polytropic exponent of the gas in the supply's accumulator", "1", absent=1, ge=1, le=2)
