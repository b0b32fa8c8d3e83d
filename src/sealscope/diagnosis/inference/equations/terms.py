"""The terms of a machine's volume balance, computed from recorded channels.

A balance states where the volume of oil goes that the pump delivers. It is linear in the unknown coefficients of the
machine. For a pump-controlled cylinder

    D dtheta = sum_j c_j f_j dg_j + G (p_A - p_B) dt,

with the pump's displacement D [m^3/rad] and angle theta, the leakage conductance G [m^3/(s Pa)] and a coefficient c_j
for each term; f_j and g_j are functions of the recorded channels. A term computes its increment f_j dg_j over each
sampling interval dt, so no signal is differentiated (`weak_form`). With a servo valve, each chamber has a balance. Its
left side is the volume displaced by the piston, and its terms include the orifice flows of the valve's metering edges.
G is the same in both chambers.

Source: Merritt, Hydraulic Control Systems, 1967, sections 5.2 and 6.3 (continuity of the chambers, flow of edges).
"""

from __future__ import annotations

from collections.abc import Callable, Container
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.equations.expressions import DIRECTIONS, increments_of
from sealscope.diagnosis.inference.equations.signals import Signals, interval_means, signed_root
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Kinds of coefficients: each has a prior on its differences between recordings and, but for "speed", on its drift.
Coefficient = Literal["motion", "speed", "compliance", "air", "bias", "piston", "pump", "outside", "edge"]


class Term(NamedTuple):
    """A term of a volume balance: an unknown coefficient times a function of recorded channels.

    Parameters
    ----------
    name : str
        Name of the term, for example "compliance A".
    unit : str
        Unit of the coefficient, m^3 over that of the increments.
    increments : callable
        Computes the increments f dg from `Signals` over each sampling interval, shape (n - 1,).
    cause : str
        Cause of a sudden change of the coefficient, for example "external leak".
    drift : str
        Kind of the coefficient, with its priors in `priors.toml`; "" if it is zero unless `cause` is present.
    needs : tuple of str
        Channels from which the increments are computed.
    driver : {"", "pressure", "root"}
        Pressure or square root of a pressure that drives the flow, so that an offset of a pressure sensor changes the
        increments; "" if such an offset is neglected.
    expression : str
        The increments as an expression (`expressions`), which streams compute, too; "" if only files compute them.
    """

    name: str
    unit: str
    increments: Callable[[Signals], Array]
    cause: Cause
    drift: Coefficient | Literal[""] = ""
    needs: tuple[str, ...] = ()
    driver: Literal["", "pressure", "root"] = ""
    expression: str = ""

    def with_increments(self, increments: Callable[[Signals], Array]) -> Term:
        """Return the term with other increments, which only files compute."""
        return self._replace(increments=increments, expression="")

    def scaled_by(self, expression: str) -> Term:
        """Return the term with increments times an `expression`, which streams compute, too, if they do the term's."""
        factor = increments_of(expression)
        scaled = self.with_increments(lambda s: np.asarray(factor(s) * self.increments(s)))
        return scaled._replace(expression=f"({expression}) * ({self.expression})" if self.expression else "")

    @property
    def is_fitted(self) -> bool:
        """True if the coefficient is fitted in every recording, since it is unknown even in a healthy machine."""
        return bool(self.drift) and not self.is_compared

    @property
    def is_compared(self) -> bool:
        """True if the coefficient is fitted only to compare recordings: within one, the motion varies too little."""
        return self.drift == "speed"


class Flow(Enum):
    """Source of the flow in a volume balance.

    `PUMP`: the pump's angle or speed; `METER`: a flow meter between pump and cylinder; `SUPPLY`: one in the supply line
    of a valve; `COMMAND`: the command u, from which a speed is computed (`balances.derive_drive_signals`);
    `VALVE`: the opening of a servo valve, with one balance for each chamber; `CREEP`: nothing but the creep of a load
    that valves hold.
    """

    PUMP = "pump"
    METER = "meter"
    SUPPLY = "supply"
    COMMAND = "command"
    VALVE = "valve"
    CREEP = "creep"

    @property
    def is_measured(self) -> bool:
        """True if a flow meter measures it, which sees no leakage inside the pump."""
        return self in (Flow.METER, Flow.SUPPLY)


class Equation(NamedTuple):
    """A volume balance of a machine: its left side equals the sum of its terms.

    Parameters
    ----------
    name : str
        Name of the balance, for example "cylinder".
    left : callable
        Computes the increments of the left side [m^3] from `Signals`, shape (n - 1,).
    terms : tuple of Term
        The terms; those of the leak are the last two.
    healthy : float
        Standard deviation of a healthy machine's leakage conductance [m^3/(s Pa)]; infinite if unknown.
    flow : Flow
        Source of the flow on the left side.
    flow_sign : float
        1 if a flow into A is positive on the left side, -1 if it is negative.
    area_ratio : float
        Area of the piston on side B over that on side A; 1 in a balance of one chamber.
    fed_outward : {"", "A", "B"}
        Chamber that the pump feeds while x grows, if it feeds one at a time (`feed`); "" in a closed circuit.
    left_expression : str
        The left side as an expression, "" if only files compute it.
    """

    name: str
    left: Callable[[Signals], Array]
    terms: tuple[Term, ...]
    healthy: float = float("inf")
    flow: Flow = Flow.PUMP
    flow_sign: float = 1.0
    area_ratio: float = 1.0
    fed_outward: Literal["", "A", "B"] = ""
    left_expression: str = ""


#: Names of terms: first the leak past the piston or in the pump, laminar (the tested term) and through an orifice.
LEAK, ORIFICE = "leak through a gap", "leak through an orifice"
#: Free air in both chambers together, instead of one term for each chamber.
AIR = "free air"
#: The pump's leakage, driven by the pressures at its ports.
PUMP = "pump leak"
#: The same driven by the pressure drop of the lines between the pump's ports and the chambers.
LINES = "pump leak by the lines"
#: The pump's leakage driven by p_A - p_B, if a valve cuts the pump off at rest: while the pump moves the piston, and
#: while it turns only to hold the load.
TURNING, HOLDING = "pump leak while it turns", "pump leak while it holds"
#: Constant flow, for example by an offset of a flow sensor; an offset of the pressure sensors changes it, too.
BIAS = "bias"
#: Suffix for an external leak that a check valve compensates.
MADE_UP = ", made up"
#: A delay between position and flow.
LAG = "lag"
#: Loss of the pump that grows with speed: incomplete filling, and slip that depends on no recorded pressure.
SPEED_LOSS = "loss over speed"
#: The constant flow while pump and piston move.
MOVING_BIAS = "bias in motion"
#: The terms that `balances.with_rests` adds, each zero in some states of the machine.
STATES = TURNING, HOLDING, MOVING_BIAS
#: Flow from the supply past a valve while the piston rests: a constant part, and one in proportion to p_A - p_B.
NULL_FLOW, LOADED_NULL_FLOW = "flow past the valve at rest", "flow past the valve at rest, under load"
#: Name of the balance of a cylinder, by its position and the flow of a pump or meter.
CYLINDER = "cylinder"
#: Name of a derived signal: the decay, with the drive's time constant, of the speed loop's unknown initial state.
START = "start"

PRESSURES = ("p_A", "p_B")
#: Makes a term whose coefficient changes suddenly only by a sensor fault.
fitted_term = partial(Term, cause="sensor fault")
#: Makes a term of oil that the pressure compresses; air in the oil changes its coefficient suddenly.
compliance_term = partial(Term, cause="air in the oil", drift="compliance")


def expressed_term(name: str, unit: str, expression: str, cause: Cause, **properties: Any) -> Term:
    """Make a term from the expression of its increments; `properties`: those of `Term`."""
    return Term(name, unit, increments_of(expression), cause, expression=expression, **properties)


def conductance_term(
    name: str,
    increments: Callable[[Signals], Array],
    cause: Cause,
    needs: tuple[str, ...] = PRESSURES,
    drift: Coefficient | Literal[""] = "",
) -> Term:
    """Make the term of a conductance; `increments` computes the driving pressure times dt [Pa s]."""
    return Term(name, "m^3/(s Pa)", increments, cause, drift=drift, needs=needs, driver="pressure")


_LEAK_CAUSE: Cause = "piston or pump leak"
LEAKS = (
    expressed_term(
        LEAK,
        "m^3/(s Pa)",
        "pressure_difference * dt",
        _LEAK_CAUSE,
        drift="piston",
        needs=PRESSURES,
        driver="pressure",
    ),
    Term(ORIFICE, "m^3/(s Pa^0.5)", lambda s: s.pressure_root * s.dt, _LEAK_CAUSE, needs=PRESSURES, driver="root"),
)


#: Word of the expression that is 1 in a direction of motion while a side carries the load, by the name of the term.
_MOTION_WORDS = {
    "motion out, A carries": "out_A",
    "motion out, B carries": "out_B",
    "motion in, A carries": "in_A",
    "motion in, B carries": "in_B",
}
#: Direction of the piston's motion (true: to B) and loaded side (true: A) of the terms of motion, by their names.
MOTIONS = {name: DIRECTIONS[word] for name, word in _MOTION_WORDS.items()}


def motion_term(name: str) -> Term:
    """Make the term of the piston's motion in one direction while one side carries the load (`MOTIONS`)."""
    expression = f"{_MOTION_WORDS[name]} * change(x)"
    return expressed_term(name, "m^2", expression, "sensor fault", drift="motion", needs=("x",))


def chamber_terms(side: str) -> tuple[Term, ...]:
    """Make the four terms of one chamber, `side` "A" or "B": two of its compliance, and two of the air in its oil.

    With the chamber's absolute pressure p, the position x, and changes d over a sampling interval, the increments are
    dp for a constant compliance, x dp for its change over the stroke, d(1/p) for free air, d ln p for dissolving air.
    """
    p, name = f"p_{side}", f"compliance {side}"
    term = partial(expressed_term, cause="air in the oil")
    return (
        term(name, "m^3/Pa", f"change({p})", drift="compliance", needs=(p,)),
        term(f"{name} over the stroke", "m^2/Pa", f"mean(x) * change({p})", drift="compliance", needs=(p, "x")),
        term(f"free air {side}", "m^3 Pa", f"change(1 / absolute({p}))", drift="air", needs=(p,)),
        term(f"dissolving air {side}", "m^3", f"change(log(absolute({p})))", drift="air", needs=(p,)),
    )


def free_air_term(rig: Rig, weight_A: Callable[[Signals], Array | float]) -> Term:
    """Make the term of free air in both chambers: w V_A d(1/p_A) - (1 - w) V_B d(1/p_B).

    p_A and p_B are absolute. V_A and V_B are the volumes of the chambers at the position x, which counts from
    mid-stroke, or at mid-stroke if the rig's file states fixed volumes. `weight_A` computes w, the weight (0 to 1) of
    chamber A in the balance. The coefficient [Pa] is minus the fraction of free air at atmospheric pressure, times that
    pressure.
    """
    from sealscope.physics.cylinder import mid_stroke_volumes

    cylinder = rig.cylinder
    mid_volumes = dict(zip("AB", mid_stroke_volumes(cylinder), strict=True))
    # change of each volume with the position
    areas = {"A": cylinder.A_A, "B": -cylinder.A_B} if cylinder.volumes == "position" else {"A": 0.0, "B": 0.0}

    def expansion(s: Signals, side: str) -> Array:
        """Compute V d(1/p) [m^3/Pa] of the chamber `side` in each interval, with the volume V at the mean position."""
        # at least a tenth of the volume at mid-stroke: x of an unknown origin may exceed the stroke
        volumes = np.maximum(mid_volumes[side] + areas[side] * s.mean("x"), 0.1 * mid_volumes[side])
        return np.asarray(volumes * np.diff(1.0 / s.absolute_pressure[f"p_{side}"]))

    def weighted_expansion(s: Signals) -> Array:
        """Compute the increments of the term [m^3/Pa], shape (n - 1,)."""
        weight = weight_A(s)
        return np.asarray(weight * expansion(s, "A") - (1.0 - weight) * expansion(s, "B"))

    return Term(AIR, "Pa", weighted_expansion, "air in the oil", needs=("x", *PRESSURES))


def external_leak_term(side: str, weight: float = 1.0) -> Term:
    """Make the term of an external leak from `side` "A" or "B" at its gauge pressure p: `weight` max(p, 0) dt [Pa s].

    No oil flows in at a negative pressure. `weight`: 1 for a leak from A, -1 for a leak from B, and 0 in a balance of
    the other chamber alone.
    """
    p = f"p_{side}"
    return conductance_term(
        f"external leak {side}", lambda s: weight * np.maximum(s.mean(p), 0.0) * s.dt, "external leak", needs=(p,)
    )


def compensated_leak_term(side: str) -> Term:
    """Make the term of an external leak from one side in a circuit whose check valve refills the low-pressure side.

    The leak counts only while its side has the higher pressure: max(p, 0) dt [Pa s] for A, -max(p, 0) dt for B.
    """

    def lost_volume(s: Signals) -> Array:
        """Compute the increments of the term [Pa s], shape (n - 1,)."""
        weight = interval_means(s.carried_by_A) - float(side == "B")  # 1 or 0 for side A, 0 or -1 for side B
        return np.asarray(weight * np.maximum(s.mean(f"p_{side}"), 0.0) * s.dt)

    return conductance_term(f"external leak {side}{MADE_UP}", lost_volume, cause="external leak")


START_TERM = fitted_term("start of the drive", "m^3/s", lambda s: s.mean(START) * s.dt, drift="bias", needs=(START,))
BIAS_TERM = expressed_term(BIAS, "m^3/s", "dt", "sensor fault", drift="bias")
SPEED_LOSS_TERM = fitted_term(
    SPEED_LOSS, "m s", lambda s: interval_means(np.abs(s.speed)) * s.step("x"), drift="speed", needs=("x",)
)
PUMP_TERM = conductance_term(PUMP, lambda s: s.port_difference * s.dt, "pump leak", needs=("p_1", "p_2"))
#: The pressure drop of the lines acts on the pump's leakage only. With this term the leak's coefficient remains the
#: conductance of pump and piston together.
LINES_TERM = conductance_term(
    LINES,
    lambda s: (s.port_difference - s.pressure_difference) * s.dt,
    "pump leak",
    needs=("p_1", "p_2", *PRESSURES),
    drift="pump",
)
#: The increments are changes of the piston's speed; the coefficient is the piston's area times the delay.
LAG_TERM = expressed_term(LAG, "m^2 s", "gradient(change(x) * rate)", "sensor fault", drift="motion", needs=("x",))


def delay_name(channel: str) -> str:
    """Return the name of the term of a channel's delay, but for `LAG`, the delay of a position after the flow."""
    return f"delay of {channel}"


def delay_term(channel: str, volume: Callable[[Signals], Array], unit: str, needs: tuple[str, ...]) -> Term:
    """Make the term of a channel's delay: the change of `volume`, its increments, between sampling intervals."""
    return fitted_term(delay_name(channel), unit, lambda s: np.gradient(volume(s) * s.rate), needs=needs)


def metering_edge_terms(
    edge: str, upstream: str, downstream: str, sign: float, channels: Container[str], return_pressure: float
) -> tuple[Term, ...]:
    """Make the three terms of the flow over one metering edge of a servo valve: gain, delay and overlap.

    `edge`: its name, for example "P to A"; `upstream`, `downstream`: channels of the pressures; `sign`: sign of the
    command u that opens the edge, 1 or -1; `channels`: names of the recorded channels; `return_pressure`: pressure [Pa]
    in place of p_2 if that is not recorded. With dp = upstream pressure - downstream pressure, the flow is

        flow = (gain abs(u) - overlap) sign(dp) sqrt(abs(dp)),    overlap = gain times dead band of u,

    delayed by the lag of the spool. Up to their signs, the unknown coefficients are gain, gain times lag, and overlap.
    """
    recorded = tuple(name for name in (upstream, downstream) if name in channels)

    def pressure(s: Signals, name: str) -> Array | float:
        """Return the pressure [Pa] on one side of the edge in each interval, or `return_pressure` if not recorded."""
        return s.mean(name) if name in recorded else return_pressure

    def pressure_root(s: Signals) -> Array:
        """Compute sign(dp) sqrt(abs(dp)) [Pa^0.5] of the pressure drop dp over the edge, shape (n - 1,)."""
        return signed_root(np.asarray(pressure(s, upstream) - pressure(s, downstream)))

    def proportional_increments(s: Signals) -> Array:
        """Compute the increments abs(u) sign(dp) sqrt(abs(dp)) dt [V Pa^0.5 s], 0 unless u opens the edge."""
        return np.asarray(np.maximum(sign * s.mean("u"), 0.0) * pressure_root(s) * s.dt)

    def late_increments(s: Signals) -> Array:
        """Compute the changes of abs(u) sign(dp) sqrt(abs(dp)) in each interval [V Pa^0.5], for gain times lag."""
        return np.asarray(np.gradient(proportional_increments(s)) * s.rate)

    edge_term = partial(fitted_term, drift="edge", needs=("u", *recorded))
    return (
        edge_term(f"edge {edge}", "m^3/(s V Pa^0.5)", proportional_increments),
        edge_term(f"late edge {edge}", "m^3/(V Pa^0.5)", late_increments),
        edge_term(f"overlap {edge}", "m^3/(s Pa^0.5)", lambda s: (sign * s.mean("u") > 0.0) * pressure_root(s) * s.dt),
    )
