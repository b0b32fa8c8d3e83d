"""The right-hand side dy/dt of the whole rig from its physical laws, eqs. (4.1)-(4.22) of the thesis.

The state y contains, in the order of `STATES`: controller integral I [rad], winding current i [A], motor speed omega
[rad/s] and angle theta [rad], piston position x [m] and velocity v [m/s], pressures p_A, p_B, p_1, p_2 [Pa], oil V_up
[m^3] that the make-up has delivered, deflection z [m] of LuGre's bristles, and position x_s [m] and speed v_s [m/s]
of a servo valve's spool. In a rig with clogging filters the last two are the oil [m^3] that has passed each filter.

Without throttles there are no line volumes: the pump is connected to the chambers, p_1 = p_A and p_2 = p_B. With a
servo valve the pump runs at a constant speed from the return (p_2) to the supply (p_1), and the valve's edges connect
both to the chambers. With throttles, only their two flows are stiff (microseconds, against milliseconds for the
rest), so the right-hand side is in two parts: `rates_without_throttles` and `throttle_rates`.

The argument `p` is always the rig's numbers, `RigNumbers`. An optional part of the rig (`LAWS`) is an empty tuple in
`p` if the rig does not have it, so `len(p.valved) > 0` asks for a servo valve. Laws of the pressure
response also compile for vectors over parameter sets (`lanes`) in place of numbers.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable, Mapping
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from sealscope.compiled import contracted, law
from sealscope.parameters import Rig
from sealscope.parameters.fields import iter_fields, unit_of
from sealscope.parameters.parts import check_circuit_property
from sealscope.physics import cylinder, external, friction, motor, pump, restrictors, valve
from sealscope.physics.fluid import effective_bulk_modulus, mixture_density_ratio, oil_density_ratio
from sealscope.physics.lanes import select
from sealscope.physics.leakage import piston_leakage
from sealscope.physics.state import (
    BRISTLE,
    CURRENT,
    INTEGRAL,
    MADE_UP,
    OMEGA,
    P_1,
    P_2,
    P_A,
    P_B,
    PASSED_A,
    PASSED_B,
    POSITION,
    SPOOL,
    SPOOL_SPEED,
    VELOCITY,
    Pressures,
    State,
    add_to_pressures,
)
from sealscope.physics.state import OUTPUTS as OUTPUTS  # noqa: PLC0414
from sealscope.units import P_ATM

#: Parameters that the laws take only through derived numbers (`DERIVED`).
_DERIVED_ONLY = (
    *("line.C_d", "line.d_line", "line.closed_A", "line.closed_B", "line.open_A", "line.open_B", "fluid.rho"),
    *("cylinder.V_rod", "cylinder.V_hose_A", "cylinder.V_hose_B", "pump.C_st", "pump.C_h"),
)
#: Parameters that the laws do not take: informative ones, and those of changes within a run.
_NOT_TAKEN = {"pump.omega_max", "line.G_circ", "fluid.T_oil", "fluid.nu_40", "fluid.nu_100", "fluid.alpha"}
#: Dotted names of the parameters that the laws take, by symbol, in the order of declaration.
PARAMETERS = {
    name.rpartition(".")[2]: name
    for name, field in iter_fields(Rig)
    if unit_of(field) and not name.startswith(("sensors.", "daq.")) and name not in _NOT_TAKEN | {*_DERIVED_ONLY}
}
#: The same, followed by the parameters from which numbers are derived.
VALUES = {**PARAMETERS, **{name.rpartition(".")[2]: name for name in _DERIVED_ONLY}}
#: Choices that the laws take as truth values, each with the function that decides it for a rig.
_CHOICES: Mapping[str, Callable[[Rig], bool]] = {
    "position_dependent": lambda rig: rig.cylinder.volumes == "position",
    "coulomb_of_difference": lambda rig: rig.friction.coulomb_pressure == "difference",
    "literal_bracket": lambda rig: rig.friction.bracket == "literal",
    "made_up": lambda rig: rig.makeup.check_valves != "absent",  # plain or pilot-operated
}
#: Derived numbers: flow coefficients of throttles A and B towards the cylinder and back, with their shut-off valves;
#: volumes of both sides at mid-stroke; coefficients of the pump's losses (`derived_numbers`).
DERIVED = ("c_A_in", "c_A_out", "c_B_in", "c_B_out", "V_A", "V_B", "c_slip", "k_h")
#: The numbers of `RigNumbers`.
NUMBERS = (*PARAMETERS, *DERIVED)
#: Laws that only some rigs have, each with the function that tells whether a rig has it. Each is a tuple in
#: `RigNumbers`, empty if the rig does not have the law: numba specialises on its length, so that the law is then not
#: compiled in. `pushed` is an additional load, which callers add: (True,) over time, or tables over position and
#: velocity (`piecewise_linear_force`).
LAWS: Mapping[str, Callable[[Rig], bool]] = {
    "throttled": lambda rig: rig.line.orifices == "present",
    "aerated": lambda rig: rig.fluid.air > 0,
    "open_circuit": lambda rig: (
        rig.makeup.check_valves != "absent" or rig.cylinder.G_ext_A > 0 or rig.cylinder.G_ext_B > 0
    ),
    "conserving": lambda rig: rig.cylinder.volumes == "position" and rig.cylinder.balance == "mass",
    "sticking": lambda rig: rig.friction.law == "karnopp",
    "bristled": lambda rig: rig.friction.law == "lugre",
    "one_sided": lambda rig: rig.friction.backward != 1.0,
    "piloted": lambda rig: rig.makeup.check_valves == "pilot-operated",
    "relieved": lambda rig: rig.makeup.G_relief > 0,
    "polytropic": lambda rig: rig.makeup.check_valves != "absent" and rig.makeup.n_gas != 1.0,
    "damped": lambda rig: rig.cylinder.d_load > 0,
    "pushed": lambda rig: False,
    "valved": lambda rig: rig.circuit.valve_controlled,
    "filtered": lambda rig: rig.line.R_A > 0 or rig.line.R_B > 0,
    "lossy": lambda rig: rig.motor.T_f > 0 or rig.pump.C_st > 0 or rig.pump.C_f > 0 or rig.pump.C_h > 0,
    "opposed": lambda rig: rig.cylinder.A_opp > 0,
    "boiling": lambda rig: rig.fluid.p_vap > 0,
    "clogging": lambda rig: rig.line.k_clog_A > 0 or rig.line.k_clog_B > 0,
    "bypassed": lambda rig: rig.line.G_bypass > 0,
}
#: The choices: truth values, and the laws.
CHOICES = (*_CHOICES, *LAWS)

#: `RigNumbers`: a rig's parameters, and the numbers derived from them, as the compiled laws take them: SI floats, truth
#: values, and for each optional law a tuple, empty if the rig lacks it. `RigValues`: the parameters of `VALUES` only.
#: They are plain named tuples, which numba takes apart into their fields.
if TYPE_CHECKING:
    RigNumbers: TypeAlias = Any  # type checkers cannot know the fields
    RigValues: TypeAlias = Any
else:
    RigNumbers = namedtuple("RigNumbers", (*NUMBERS, *CHOICES))
    RigValues = namedtuple("RigValues", VALUES)


@law
def throttle_flow_coefficients(v: RigValues, exponent: float, literal: bool) -> tuple[float, float, float, float]:
    """Compute the throttles' flow coefficients (c_A_in, c_A_out, c_B_in, c_B_out) [m^3/(s Pa^0.5)], eqs. (4.7)-(4.12).

    "in" is the flow towards the cylinder, "out" the return. Each throttle is in series with a shut-off valve.
    `exponent`: 1 if a throttle's closed fraction is that of its area (eq. 4.8), 2 if that of its diameter (the thesis's
    text). `literal`: if False, the flow towards the cylinder is free and the return is throttled on both sides (the
    text and Appendix A); if True, side B is the other way round, as eqs. (4.9)-(4.12) are printed.
    """
    free = restrictors.orifice_coefficient(v.C_d, math.pi / 4.0 * v.d_line**2, v.rho)  # eq. (4.7)
    throttled_A = free * (1.0 - v.closed_A) ** exponent  # eq. (4.8)
    throttled_B = free * (1.0 - v.closed_B) ** exponent
    free_A, free_B = free, free
    if v.open_A < 1.0:  # a fully open valve changes nothing; the formula would add a rounding error
        free_A = restrictors.series_coefficient(free, free, v.open_A)
        throttled_A = restrictors.series_coefficient(throttled_A, free, v.open_A)
    if v.open_B < 1.0:
        free_B = restrictors.series_coefficient(free, free, v.open_B)
        throttled_B = restrictors.series_coefficient(throttled_B, free, v.open_B)
    if literal:
        return free_A, throttled_A, throttled_B, free_B
    return free_A, throttled_A, free_B, throttled_B


@law
def derived_numbers(v: RigValues, exponent: float, literal: bool) -> tuple[float, ...]:
    """Compute the numbers `DERIVED` of a rig; `exponent`, `literal`: as in `throttle_flow_coefficients`."""
    c_A_in, c_A_out, c_B_in, c_B_out = throttle_flow_coefficients(v, exponent, literal)
    V_A, V_B = cylinder.mid_stroke_volumes(v)
    c_slip, k_h = pump.loss_coefficients(v.q_b, v.C_st, v.C_h, v.rho)
    return c_A_in, c_A_out, c_B_in, c_B_out, V_A, V_B, c_slip, k_h


def parameter_values(rig: Rig) -> RigValues:
    """Collect the rig's parameters that the compiled model needs, in SI units, by symbol."""
    return RigValues(*(float(attrgetter(name)(rig)) for name in VALUES.values()))


def throttle_readings(rig: Rig) -> tuple[float, bool]:
    """Return the arguments `exponent` and `literal` of `throttle_flow_coefficients` for a rig."""
    return (2.0 if rig.line.closed_means == "diameter" else 1.0), rig.line.metering == "literal"


def throttle_coefficients(rig: Rig) -> tuple[float, float, float, float]:
    """Compute the flow coefficients (c_A_in, c_A_out, c_B_in, c_B_out) [m^3/(s Pa^0.5)] of a rig's throttles."""
    return throttle_flow_coefficients(parameter_values(rig), *throttle_readings(rig))  # type: ignore[no-any-return]


def rig_numbers(rig: Rig) -> RigNumbers:
    """Convert a rig to the numbers and choices for its physical laws; raise InputError if it cannot be simulated."""
    check_circuit_property("a simulation", rig.name, rig.circuit, "simulated")
    values = parameter_values(rig)
    return RigNumbers(
        *values[: len(PARAMETERS)],  # `VALUES` begins with `PARAMETERS`
        *derived_numbers(values, *throttle_readings(rig)),
        **{name: is_chosen(rig) for name, is_chosen in _CHOICES.items()},
        **{name: (True,) if is_present(rig) else () for name, is_present in LAWS.items()},
    )


@cache
def _record_type(lengths: tuple[int, ...]) -> np.dtype[Any]:
    """Build the NumPy dtype of the record that `pack_numbers` makes; `lengths`: those of the laws' tuples."""
    numbers = [(name, "f8") for name in NUMBERS]
    truth_values = [(name, "?") for name in CHOICES if name not in LAWS]
    laws = [(name, "f8", (length,)) for name, length in zip(LAWS, lengths, strict=True)]
    return np.dtype([*numbers, *truth_values, *laws], align=True)  # type: ignore[list-item]


def pack_numbers(p: RigNumbers) -> Any:
    """Pack a rig's numbers `p` into one NumPy record, which compiled code takes by its address.

    If `p` has the tables of a load (`pushed`), which a record of numbers cannot contain, `p` itself is returned.
    """
    if len(p.pushed) > 1:
        return p
    lengths = tuple(len(getattr(p, name)) for name in LAWS)
    return np.array([tuple(p)], _record_type(lengths)).view(np.recarray)[0]


@contracted
def limit_state(y: State, p: RigNumbers) -> State:
    """Limit the states of motor and spool in `y` after a step of the solver, and set those that no law changes.

    A step may overshoot the limits, although the rates become 0 there. Without lines p_1 = p_A and p_2 = p_B are set;
    with a servo valve p_2 is the return's pressure. Other states of parts that the rig does not have are set to 0, so
    that the compiler removes them.
    """
    V_up = y[MADE_UP] if len(p.open_circuit) > 0 else 0.0
    bristle = y[BRISTLE] if len(p.bristled) > 0 else 0.0
    current = min(max(y[CURRENT], -p.i_max), p.i_max)
    p_1, p_2 = (y[P_1], y[P_2]) if len(p.throttled) > 0 else (y[P_A], y[P_B])
    x_s, v_s = 0.0, 0.0
    if len(p.valved) > 0:
        p_1, p_2 = y[P_1], p.p_return
        x_s, v_s = valve.spool_within_stroke(y[SPOOL], y[SPOOL_SPEED], p.x_max, p.v_max)
    if len(p.clogging) > 0:  # in a rig without a spool, these two states are the oil that has passed each filter
        x_s, v_s = y[PASSED_A], y[PASSED_B]
    return y[0], current, y[2], y[3], y[4], y[5], y[6], y[7], p_1, p_2, V_up, bristle, x_s, v_s


@contracted
def vapour_floor(q: float, p: RigNumbers) -> float:
    """Compute an oil volume's pressure [Pa gauge]: its pressure state q [Pa gauge], but at least the vapour pressure.

    Below the vapour pressure `p_vap` [Pa absolute] the oil boils. The state q may fall further: rho(q) V remains the
    mass of oil in the volume V, of which the fraction 1 - rho(q)/rho(p_vap) is vapour.

    Source: E. B. Wylie, V. L. Streeter, Fluid Transients, 1978, chapter 8: vapour cavities at constant pressure.
    """
    if len(p.boiling) == 0:  # the rig's oil does not boil
        return q
    return max(q, p.p_vap - P_ATM)  # type: ignore[no-any-return]


@contracted
def pressures_of(y: State, p: RigNumbers) -> Pressures:
    """Compute the pressures p_A, p_B, p_1, p_2 [Pa] in the state `y`, at least that of vapour if the oil boils."""
    return vapour_floor(y[P_A], p), vapour_floor(y[P_B], p), vapour_floor(y[P_1], p), vapour_floor(y[P_2], p)


@contracted
def speed_error(y: State, u: float, p: RigNumbers) -> float:
    """Compute the speed error [rad/s] of the motor: set speed, by `u` [V] or of a valve's supply, minus that in `y`."""
    if len(p.valved) > 0:
        return p.omega_P - y[OMEGA]  # type: ignore[no-any-return]
    return p.omega_per_volt * u - y[OMEGA]  # type: ignore[no-any-return]


@contracted
def pump_difference(y: State, p: RigNumbers) -> float:
    """Compute the pressure difference across the pump [Pa] in the state `y`, port 1 minus port 2."""
    p_A, p_B, p_1, p_2 = pressures_of(y, p)
    if len(p.throttled) > 0 or len(p.valved) > 0:  # a rig with lines or a servo valve
        return p_1 - p_2
    return p_A - p_B


@contracted
def friction_force(y: State, applied: float, p: RigNumbers) -> tuple[float, float]:
    """Compute the friction force [N] on the piston against +x, and the rate [m/s] at which LuGre's bristles deflect.

    The force is that of eqs. (4.20)-(4.22), unless the rig has Karnopp's law (`sticking`) or LuGre's (`bristled`); the
    rate is 0 for the other laws. Friction of motion along -x is multiplied by the parameter `backward`. `applied` [N]:
    sum of all other forces on the piston along +x.
    """
    v = y[VELOCITY]
    F_C = friction.coulomb_friction(
        vapour_floor(y[P_A], p), vapour_floor(y[P_B], p), p.F_pr, p.F_cfr, p.coulomb_of_difference
    )
    F_v, breakaway, no_rate = p.F_v, p.K_brk * F_C, 0.0 * v  # 0.0 * v: a zero of v's type, a number or a vector
    if len(p.one_sided) > 0:
        breakaway = select(applied < 0.0, p.backward * breakaway, breakaway)  # at rest `applied` gives the direction
        side = select(v < 0.0, p.backward, 1.0)
        F_C, F_v = side * F_C, side * F_v
    if len(p.sticking) > 0:
        return friction.karnopp_friction(v, applied, breakaway, F_C, p.K_brk, p.C_c, F_v, p.v_th), no_rate
    if len(p.bristled) > 0:
        dz = friction.bristle_rate(v, y[BRISTLE], friction.stribeck_force(abs(v), F_C, p.K_brk, p.C_c), p.sigma_0)
        return friction.lugre_friction(v, y[BRISTLE], dz, p.sigma_0, p.sigma_1, F_v, p.v_th), dz
    return friction.stribeck_friction(v, F_C, p.K_brk, p.C_c, F_v, p.v_th, p.literal_bracket), no_rate


@contracted
def filter_resistances(y: State, p: RigNumbers) -> tuple[float, float]:
    """Compute the resistances [Pa s/m^3] of the filters in lines A and B, which may rise with the oil passed so far."""
    if len(p.clogging) == 0:  # the rig's filters do not clog
        return p.R_A, p.R_B
    R_A = restrictors.clogged_resistance(p.R_A, y[PASSED_A], p.k_clog_A, p.n_clog)
    return R_A, restrictors.clogged_resistance(p.R_B, y[PASSED_B], p.k_clog_B, p.n_clog)


@contracted
def implicit_flows(
    total_A: float, total_B: float, g_A: float, g_B: float, y: State, p: RigNumbers
) -> tuple[float, float]:
    """Compute the line flows Q_A, Q_B [m^3/s] at the end of an implicit stage of the solver.

    Q_A flows from line 1 to chamber A, Q_B from chamber B to line 2. On each side the throttle's pressure drop d [Pa]
    at the end of the stage solves d + g Q(d) = total (`implicit_orifice_flow`). `total_A`, `total_B` [Pa]: the drops if
    nothing flowed in the stage; `g_A`, `g_B` [Pa s/m^3]: their fall over the stage per unit flow, to which the
    resistance R of a filter in series is added.
    """
    if len(p.filtered) > 0:
        R_A, R_B = filter_resistances(y, p)
        if len(p.bypassed) > 0:
            Q_A = restrictors.filtered_flow(total_A, g_A, R_A, p.p_bypass, p.G_bypass, p.c_A_in, p.c_A_out, p.dp_0)
            return Q_A, restrictors.filtered_flow(
                total_B, g_B, R_B, p.p_bypass, p.G_bypass, p.c_B_out, p.c_B_in, p.dp_0
            )
        g_A, g_B = g_A + R_A, g_B + R_B
    # Q_A > 0 flows into the cylinder, Q_B > 0 out of it
    Q_A = restrictors.implicit_orifice_flow(total_A, g_A, p.c_A_in, p.c_A_out, p.dp_0)
    return Q_A, restrictors.implicit_orifice_flow(total_B, g_B, p.c_B_out, p.c_B_in, p.dp_0)


@contracted
def filter_flows(y: State, p: RigNumbers) -> tuple[float, float]:
    """Compute the flows [m^3/s] through the filters of lines A and B, >= 0 in either direction, without bypass flow."""
    Q_A, Q_B = throttle_flows(y, p)
    if len(p.bypassed) == 0:
        return abs(Q_A), abs(Q_B)
    R_A, R_B = filter_resistances(y, p)
    filter_flow_A = restrictors.flow_through_filter(Q_A, R_A, p.p_bypass, p.G_bypass)
    return filter_flow_A, restrictors.flow_through_filter(Q_B, R_B, p.p_bypass, p.G_bypass)


@contracted
def throttle_flows(y: State, p: RigNumbers) -> tuple[float, float]:
    """Compute the flows [m^3/s] through the throttles: Q_A from line 1 to chamber A, Q_B from chamber B to line 2.

    Eqs. (4.9)-(4.12). A filter in series has the pressure drop R Q (Darcy's law), until its bypass valve opens.
    """
    p_A, p_B, p_1, p_2 = pressures_of(y, p)
    dp_A, dp_B = p_1 - p_A, p_B - p_2
    if len(p.filtered) > 0:
        return implicit_flows(dp_A, dp_B, 0.0, 0.0, y, p)  # g = 0: the pressures are those of `y`
    # Q_A > 0 flows into the cylinder, Q_B > 0 out of it
    Q_A = restrictors.one_way_flow(dp_A, p.c_A_in, p.c_A_out, p.dp_0)
    return Q_A, restrictors.one_way_flow(dp_B, p.c_B_out, p.c_B_in, p.dp_0)


@contracted
def volumes_at(x: float, p: RigNumbers) -> tuple[float, float]:
    """Compute the oil volumes [m^3] of chamber and hose on sides A and B; `x` [m]: piston position from mid-stroke."""
    return cylinder.chamber_volumes(x, p.V_A, p.V_B, p.A_A, p.A_B, p.position_dependent)


@contracted
def bulk_modulus(pressure: float, p: RigNumbers) -> float:
    """Compute the bulk modulus [Pa] of the oil, with the air in it if the rig has any, at `pressure` [Pa gauge]."""
    if len(p.aerated) == 0:  # no air in the oil
        return p.K_oil  # type: ignore[no-any-return]
    return effective_bulk_modulus(vapour_floor(pressure, p), p.K_oil, p.air, p.n_air)


@contracted
def density_ratio(pressure: float, reference: float, p: RigNumbers) -> float:
    """Compute the density of the oil at the pressure state `pressure` over that at `reference`, both in Pa gauge.

    A pressure state may fall below the vapour pressure (`vapour_floor`). There, the density falls with the bulk modulus
    that holds at the vapour pressure.
    """
    if len(p.aerated) == 0:  # no air in the oil: one bulk modulus, whether the oil boils or not
        return oil_density_ratio(pressure - reference, p.K_oil)
    liquid_pressure, liquid_reference = vapour_floor(pressure, p), vapour_floor(reference, p)
    ratio = mixture_density_ratio(liquid_pressure, liquid_reference, p.K_oil, p.air, p.n_air)
    if len(p.boiling) == 0:
        return ratio
    boiling_modulus = effective_bulk_modulus(p.p_vap - P_ATM, p.K_oil, p.air, p.n_air)
    # the parts of both states below the vapour pressure
    return ratio * oil_density_ratio((pressure - liquid_pressure) - (reference - liquid_reference), boiling_modulus)


@contracted
def flows_at_both_ends(Q: float, source: float, sink: float, p: RigNumbers) -> tuple[float, float]:
    """Compute the volume flows [m^3/s] of a stream where it leaves a source and where it enters a sink.

    `Q` [m^3/s]: flow at the upstream end, which is the source, or the sink for Q < 0. The flow at the downstream end
    carries the same mass, rho_up Q_up = rho_down Q_down, with the oil's densities rho at the pressures `source` and
    `sink` [Pa]. In a rig that balances volumes instead of masses both flows are Q.
    """
    if len(p.conserving) == 0:
        return Q, Q
    forward = Q > 0.0
    ratio = density_ratio(select(forward, source, sink), select(forward, sink, source), p)
    return select(forward, Q, Q * ratio), select(forward, Q * ratio, Q)


@contracted
def throttle_rates(y: State, Q_A: float, Q_B: float, p: RigNumbers) -> Pressures:
    """Compute the rates of p_A, p_B, p_1, p_2 [Pa/s] by the throttles' flows `Q_A`, `Q_B`, eqs. (4.16)-(4.19)."""
    V_A, V_B = volumes_at(y[POSITION], p)
    from_1, to_A = flows_at_both_ends(Q_A, y[P_1], y[P_A], p)
    from_B, to_2 = flows_at_both_ends(Q_B, y[P_B], y[P_2], p)
    return (
        cylinder.pressure_rate(to_A, V_A, bulk_modulus(y[P_A], p)),  # eq. (4.18)
        cylinder.pressure_rate(-from_B, V_B, bulk_modulus(y[P_B], p)),  # eq. (4.19)
        cylinder.pressure_rate(-from_1, p.V_1, bulk_modulus(y[P_1], p)),  # eq. (4.16)
        cylinder.pressure_rate(to_2, p.V_2, bulk_modulus(y[P_2], p)),  # eq. (4.17)
    )


@contracted
def makeup_pressure(y: State, p: RigNumbers) -> float:
    """Compute the pressure [Pa gauge] of the make-up's accumulator in the state `y`."""
    if len(p.polytropic) > 0:
        return external.polytropic_pressure(y[MADE_UP], p.p_charge, p.V_gas, p.n_gas)
    return external.accumulator_pressure(y[MADE_UP], p.p_charge, p.V_gas)


@contracted
def make_up_flows(y: State, p: RigNumbers) -> tuple[float, float]:
    """Compute the flows [m^3/s] from the make-up's accumulator to sides 1 (A) and 2 (B), 0 without a make-up.

    They pass check valves and, in the opposite direction, relief valves. Sides 1 and 2 are the pump's ports, or the
    chambers A and B in a rig without lines. The pilot pressure of a pilot-operated valve is that of the opposite side.
    """
    p_up = makeup_pressure(y, p)
    p_A, p_B, p_1, p_2 = pressures_of(y, p)
    if len(p.throttled) == 0:
        p_1, p_2 = p_A, p_B
    if len(p.piloted) > 0:
        makeup_1 = external.pilot_valve_flow(p_up - p_1, p_2 - p_up, p.p_crack, p.G_check, p.k_pilot, p.p_open)
        makeup_2 = external.pilot_valve_flow(p_up - p_2, p_1 - p_up, p.p_crack, p.G_check, p.k_pilot, p.p_open)
    else:
        # a rig without a make-up may state a G_check, too; 0.0 * G_check: a zero of its type, a number or a vector
        G_check = p.G_check if p.made_up else 0.0 * p.G_check
        makeup_1 = external.check_valve_flow(p_up - p_1, p.p_crack, G_check)
        makeup_2 = external.check_valve_flow(p_up - p_2, p.p_crack, G_check)
    if len(p.relieved) > 0:  # `Rig` allows relief valves only with a make-up
        makeup_1 = makeup_1 - external.check_valve_flow(p_1 - p_up, p.p_relief, p.G_relief)
        makeup_2 = makeup_2 - external.check_valve_flow(p_2 - p_up, p.p_relief, p.G_relief)
    return makeup_1, makeup_2


@contracted
def external_pressure_rates(y: State, p: RigNumbers) -> tuple[Pressures, float]:
    """Compute the rates of p_A, p_B, p_1, p_2 [Pa/s] by external leakage and make-up, and the rate of V_up [m^3/s].

    The latter is the make-up flow where it leaves the accumulator, < 0 if oil returns. The make-up feeds the pump's
    ports, or the chambers in a rig without lines. Without lines and servo valve p_1 = p_A and p_2 = p_B.
    """
    V_A, V_B = volumes_at(y[POSITION], p)
    K_A, K_B = bulk_modulus(y[P_A], p), bulk_modulus(y[P_B], p)
    makeup_1, makeup_2 = make_up_flows(y, p)
    out_A, out_B = external.external_leakage(y[P_A], p.G_ext_A), external.external_leakage(y[P_B], p.G_ext_B)
    p_up = makeup_pressure(y, p)
    # each flow as drawn at the accumulator's pressure, and as it enters the circuit at the pressure of side 1 or 2
    drawn_1, makeup_1 = flows_at_both_ends(makeup_1, p_up, y[P_1] if len(p.throttled) > 0 else y[P_A], p)
    drawn_2, makeup_2 = flows_at_both_ends(makeup_2, p_up, y[P_2] if len(p.throttled) > 0 else y[P_B], p)
    fed = drawn_1 + drawn_2  # oil that the accumulator feeds
    if len(p.throttled) > 0:
        rate_1 = cylinder.pressure_rate(makeup_1, p.V_1, bulk_modulus(y[P_1], p))
        rate_2 = cylinder.pressure_rate(makeup_2, p.V_2, bulk_modulus(y[P_2], p))
        return (-cylinder.pressure_rate(out_A, V_A, K_A), -cylinder.pressure_rate(out_B, V_B, K_B), rate_1, rate_2), fed
    rate_1 = cylinder.pressure_rate(makeup_1 - out_A, V_A, K_A)
    rate_2 = cylinder.pressure_rate(makeup_2 - out_B, V_B, K_B)
    if len(p.valved) > 0:  # 1 and 2 are here supply and return, whose lines have neither rod seals nor make-up
        return (rate_1, rate_2, 0.0 * rate_1, 0.0 * rate_2), fed
    return (rate_1, rate_2, rate_1, rate_2), fed


@contracted
def valve_flows(y: State, p: RigNumbers) -> tuple[float, float, float, float]:
    """Compute a servo valve's flows [m^3/s] through its edges: from P to A, from A to T, from P to B, and from B to T.

    P is the supply and T the return. A spool position x_s > 0 opens the edges P-A and B-T, x_s < 0 opens A-T and P-B.
    """
    x_s, Q_N, dp_N, x_max, dp_lam = y[SPOOL], p.Q_N, p.dp_N, p.x_max, p.dp_lam
    p_A, p_B, p_P, p_T = pressures_of(y, p)
    return (
        valve.edge_flow(p_P - p_A, x_s, p.o_PA, Q_N, dp_N, x_max, dp_lam),
        valve.edge_flow(p_A - p_T, -x_s, p.o_AT, Q_N, dp_N, x_max, dp_lam),
        valve.edge_flow(p_P - p_B, -x_s, p.o_PB, Q_N, dp_N, x_max, dp_lam),
        valve.edge_flow(p_B - p_T, x_s, p.o_BT, Q_N, dp_N, x_max, dp_lam),
    )


@contracted
def supply_compliance(p_1: float, p: RigNumbers) -> float:
    """Compute the compliance [m^3/Pa] of the supply line: the oil it takes in per unit rise of its pressure.

    It is (V_1 + V_oil)/K + V_gas/(n p_abs) at the supply pressure `p_1` [Pa gauge], with the oil's bulk modulus K, the
    gas volume V_gas, its polytropic exponent n, and the oil V_oil = V_acc - V_gas in the supply's accumulator.
    """
    V_gas = external.gas_volume(p_1, p.p_pre, p.V_acc, p.n_acc)
    oil_compliance = (p.V_1 + p.V_acc - V_gas) / bulk_modulus(p_1, p)
    return oil_compliance + external.accumulator_compliance(p_1, p.p_pre, V_gas, p.n_acc)  # type: ignore[no-any-return]


@contracted
def valve_rates(y: State, Q_1: float, p: RigNumbers) -> Pressures:
    """Compute the rates of p_A, p_B, p_1, p_2 [Pa/s] by a servo valve and the flows into and out of its supply.

    `Q_1` [m^3/s]: flow of the pump into the supply. The relief valve takes oil from the supply while p_1 - p_2 is above
    its set pressure. The pressure p_2 of the return is constant.
    """
    p_A, p_B, p_P, p_T = y[P_A], y[P_B], y[P_1], y[P_2]
    Q_PA, Q_AT, Q_PB, Q_BT = valve_flows(y, p)
    V_A, V_B = volumes_at(y[POSITION], p)
    # oil is compressible: each flow has a value where it leaves its source and another where it enters its sink
    drawn_A, to_A = flows_at_both_ends(Q_PA, p_P, p_A, p)
    drawn_B, to_B = flows_at_both_ends(Q_PB, p_P, p_B, p)
    from_A, _ = flows_at_both_ends(Q_AT, p_A, p_T, p)
    from_B, _ = flows_at_both_ends(Q_BT, p_B, p_T, p)
    _, to_supply = flows_at_both_ends(Q_1, p_T, p_P, p)
    relief = external.check_valve_flow(pump_difference(y, p), p.p_set, p.G_set)
    return (
        cylinder.pressure_rate(to_A - from_A, V_A, bulk_modulus(p_A, p)),  # eq. (4.18)
        cylinder.pressure_rate(to_B - from_B, V_B, bulk_modulus(p_B, p)),  # eq. (4.19)
        (to_supply - relief - drawn_A - drawn_B) / supply_compliance(p_P, p),
        0.0 * p_T,  # a zero of p_T's type: a number, or a vector over runs
    )


@contracted
def rates_without_throttles(y: State, u: float, G: float, C: float, F: float, p: RigNumbers) -> State:
    """Compute the state's rates dy/dt from all physical laws but the throttles' flows; arguments: as in `rates`."""
    p_A, p_B, x, v = vapour_floor(y[P_A], p), vapour_floor(y[P_B], p), y[POSITION], y[VELOCITY]
    if len(p.sticking) > 0:  # a stuck piston neither moves nor displaces oil, whatever small v the state has
        v = friction.stuck_velocity(v, p.v_th)
    dp_pump = pump_difference(y, p)
    error = speed_error(y, u, p)  # the rate of the state I, its integral; eq. (4.2) of the thesis
    voltage = motor.controller_voltage(error, y[INTEGRAL], p.k_p, p.K_i, p.V_max)
    d_i = motor.winding_current_rate(voltage, y[CURRENT], y[OMEGA], p.R_c, p.L_c, p.C_e, p.i_max)
    torque = pump.pump_torque(dp_pump, p.q_b)
    Q_1 = pump.pump_flow(y[OMEGA], dp_pump, p.q_b, p.G_pump)
    if len(p.lossy) > 0:
        torque = torque + pump.friction_torque(y[OMEGA], dp_pump, p.q_b, p.T_f, p.C_f, p.k_h, p.omega_f)
        Q_1 = Q_1 - restrictors.orifice_flow(dp_pump, p.c_slip, p.dp_0)  # turbulent slip
    d_omega = motor.shaft_acceleration(y[CURRENT], y[OMEGA], torque, p.C_m, p.B_M, p.J_M)
    stop = cylinder.hard_stop_force(x, v, p.L, p.k_stop, p.d_stop)
    load = cylinder.load_force(x, p.F_l, p.k_load)
    if len(p.damped) > 0:
        load = load + p.d_load * v
    if len(p.opposed) > 0:
        load = load + cylinder.opposing_force(v, p.A_opp, p.p_opp, p.C_opp)
    if len(p.pushed) > 0:
        load = load + F
    if len(p.pushed) > 1:  # the tables of a load over position and velocity
        load = load + cylinder.piecewise_linear_force(x, p.pushed[0]) + cylinder.piecewise_linear_force(v, p.pushed[1])
    F_f, dz = friction_force(y, p_A * p.A_A - p_B * p.A_B - load + stop, p)
    acceleration = cylinder.piston_acceleration(p_A, p_B, F_f, load, stop, p.A_A, p.A_B, p.M_eq)
    Q_L = piston_leakage(p_A - p_B, G, C, p.dp_0)
    V_A, V_B = volumes_at(x, p)
    K_A, K_B = bulk_modulus(p_A, p), bulk_modulus(p_B, p)
    from_A, to_B = flows_at_both_ends(Q_L, y[P_A], y[P_B], p)
    if len(p.throttled) > 0:  # the pump's ports have volumes of their own; `throttle_rates` adds the throttles' flows
        from_2, to_1 = flows_at_both_ends(Q_1, y[P_2], y[P_1], p)
        rate_A = cylinder.pressure_rate(-p.A_A * v - from_A, V_A, K_A)
        rate_B = cylinder.pressure_rate(p.A_B * v + to_B, V_B, K_B)
        rate_1 = cylinder.pressure_rate(to_1, p.V_1, bulk_modulus(y[P_1], p))
        rate_2 = cylinder.pressure_rate(-from_2, p.V_2, bulk_modulus(y[P_2], p))
    elif len(p.valved) > 0:
        valve_rate_A, valve_rate_B, rate_1, rate_2 = valve_rates(y, Q_1, p)
        rate_A = valve_rate_A + cylinder.pressure_rate(-p.A_A * v - from_A, V_A, K_A)
        rate_B = valve_rate_B + cylinder.pressure_rate(p.A_B * v + to_B, V_B, K_B)
    else:
        from_2, to_1 = flows_at_both_ends(Q_1, y[P_B], y[P_A], p)
        rate_A = cylinder.pressure_rate(to_1 - p.A_A * v - from_A, V_A, K_A)
        rate_B = cylinder.pressure_rate(-from_2 + p.A_B * v + to_B, V_B, K_B)
        rate_1, rate_2 = rate_A, rate_B
    d_V_up, d_x_s, d_v_s = 0.0 * v, 0.0 * v, 0.0 * v  # zeros of v's type: a number, or a vector over runs
    if len(p.open_circuit) > 0:
        external_part, d_V_up = external_pressure_rates(y, p)  # rates of p_A, p_B, p_1, p_2; flow of the accumulator
        rate_A, rate_B = rate_A + external_part[0], rate_B + external_part[1]
        rate_1, rate_2 = rate_1 + external_part[2], rate_2 + external_part[3]
    if len(p.valved) > 0:
        d_x_s = min(max(y[SPOOL_SPEED], -p.v_max), p.v_max)
        x_d = valve.spool_target(u, p.u_N, p.x_max)
        d_v_s = valve.spool_acceleration(y[SPOOL], y[SPOOL_SPEED], x_d, p.omega_s, p.zeta_s, p.v_max)
    if len(p.clogging) > 0:  # in a rig without a spool, these two states are the oil that has passed each filter
        d_x_s, d_v_s = filter_flows(y, p)
    # in the order of `STATES`; dx/dt = v is eq. (4.13) of the thesis
    return error, d_i, d_omega, y[OMEGA], v, acceleration, rate_A, rate_B, rate_1, rate_2, d_V_up, dz, d_x_s, d_v_s


@contracted
def rates(y: State, u: float, G: float, C: float, F: float, p: RigNumbers) -> State:
    """Compute the rates dy/dt of all states of the rig from its physical laws.

    `y`: state in the order of `STATES`; `u` [V]: command; `G` [m^3/(s Pa)], `C` [m^3/(s Pa^0.5)]: conductance and flow
    coefficient of the leakage past the piston (`piston_leakage`); `F` [N]: load over time in addition to the rig's own;
    it counts only if `p.pushed` is not empty.
    """
    dy = rates_without_throttles(y, u, G, C, F, p)
    if len(p.throttled) > 0:
        Q_A, Q_B = throttle_flows(y, p)
        dy = add_to_pressures(dy, 1.0, throttle_rates(y, Q_A, Q_B, p))
    return dy


@contracted
def observe(y: State, u: float, G: float, C: float, p: RigNumbers, row: np.ndarray) -> None:
    """Write all outputs of the rig to `row` (21,), in the order of `OUTPUTS`; other arguments: as in `rates`.

    The pressures are those of `pressures_of`, so that a `row` does not contain the full state of boiling oil.
    """
    n = len(y)
    for m in range(n):
        row[m] = y[m]
    row[P_A], row[P_B], row[P_1], row[P_2] = pressures_of(y, p)
    dp_pump = pump_difference(y, p)
    Q_1 = pump.pump_flow(y[OMEGA], dp_pump, p.q_b, p.G_pump)
    if len(p.lossy) > 0:
        Q_1 = Q_1 - restrictors.orifice_flow(dp_pump, p.c_slip, p.dp_0)  # turbulent slip
    Q_A, Q_B = throttle_flows(y, p) if len(p.throttled) > 0 else (Q_1, Q_1)  # else the pump is at the chambers
    if len(p.valved) > 0:
        Q_PA, Q_AT, Q_PB, Q_BT = valve_flows(y, p)
        Q_A, Q_B = Q_PA - Q_AT, Q_BT - Q_PB
    # the outputs after the states: Q_1, Q_A, Q_B, q_leak, V, q_ext, q_up
    row[n] = Q_1
    row[n + 1] = Q_A
    row[n + 2] = Q_B
    row[n + 3] = piston_leakage(row[P_A] - row[P_B], G, C, p.dp_0)
    row[n + 4] = motor.controller_voltage(speed_error(y, u, p), y[INTEGRAL], p.k_p, p.K_i, p.V_max)
    row[n + 5] = row[n + 6] = 0.0
    if len(p.open_circuit) > 0:
        row[n + 5] = external.external_leakage(y[P_A], p.G_ext_A) + external.external_leakage(y[P_B], p.G_ext_B)
        makeup_1, makeup_2 = make_up_flows(y, p)
        row[n + 6] = makeup_1 + makeup_2
