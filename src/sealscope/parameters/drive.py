"""Parameters of the electric and hydraulic drive: servo motor, pump, lines with throttles, fluid."""

from __future__ import annotations

from typing import Literal

from sealscope.parameters.fields import Part, choice, conductance, quantity


class Motor(Part):
    """Parameters of the servo motor and its PI speed control, eqs. (4.2)-(4.6) of the thesis."""

    R_c: float = quantity("winding resistance", "ohm", gt=0, le=1e4)
    L_c: float = quantity("winding inductance", "H", gt=0, le=10)
    C_e: float = quantity("back electromotive force constant", "V s/rad", gt=0, le=1e3)
    C_m: float = quantity("torque constant", "N m/A", gt=0, le=1e3)
    J_M: float = quantity("moment of inertia of motor and pump", "kg m^2", gt=0, le=1e3)
    B_M: float = quantity("viscous damping of motor and pump", "N m s/rad", ge=0, le=1e3)
    k_p: float = quantity("proportional gain of the speed loop", "V s/rad", ge=0, le=1e6)
    K_i: float = quantity("integral gain of the speed loop", "V/rad", ge=0, le=1e6)
    omega_per_volt: float = quantity("commanded speed per volt", "rad/(s V)", gt=0, le=1e4)
    V_max: float = quantity("largest motor voltage", "V", gt=0, le=1e5)
    i_max: float = quantity("largest motor current", "A", gt=0, le=1e5)
    T_f: float = quantity("friction torque of motor and pump", "N m", absent=0, ge=0, le=1e4)
    omega_f: float = quantity("speed below which that friction is linear", "rad/s", absent=1, gt=0, le=1e3)
    integrator: Literal["state", "euler"] = choice("integral of the speed error, eq. (4.2)")


class Pump(Part):
    """Bidirectional pump of fixed displacement, eq. (4.1) of the thesis, and its losses.

    In a closed circuit the pump moves oil between the chambers. In an open one it draws oil from a tank and feeds one
    chamber at a time through valves, while the other drains. An asymmetric one moves more oil at side A, where `q_b` is
    stated, than at side B, in the ratio of the piston areas. `G_pump` is the laminar slip. Viscous drag is part of
    `motor.B_M`, and constant friction of `motor.T_f`.
    """

    q_b: float = quantity("displacement", "m^3/rev", gt=0, le=0.1)
    G_pump: float = conductance("internal leakage conductance of the pump")
    G_healthy: float = conductance(
        "most that pump and piston of a healthy machine pass together, as a conductance (0: not known)", absent=0
    )
    C_st: float = quantity("turbulent slip coefficient", "1", absent=0, ge=0, le=1)
    C_f: float = quantity("friction torque over that of the pressure", "1", absent=0, ge=0, le=1)
    C_h: float = quantity("hydrodynamic torque coefficient", "1", absent=0, ge=0, le=1e6)
    omega_max: float = quantity("speed limit (informative)", "rad/s", gt=0, le=1e4)
    circuit: Literal["closed", "open", "asymmetric"] = choice("circuit of pump and chambers", absent="closed")


class HydraulicLine(Part):
    """Lines between pump and cylinder: throttles (eqs. (4.7)-(4.12) of the thesis), shut-off valves, filters.

    With `orifices = "absent"` the pump is piped directly to the cylinder: p_1 = p_A, p_2 = p_B, V_1 and V_2 are
    unused, and there are neither valves nor filters. A filter may clog with the volume that has passed it
    (`physics.restrictors`), and has a bypass valve. The circulation valve between the pump's ports is shut by default.
    """

    orifices: Literal["absent", "present"] = choice("throttles and line volumes in the model")
    C_d: float = quantity("discharge coefficient of the throttle", "1", gt=0, le=1)
    d_line: float = quantity("bore of the line", "m", gt=0, le=0.5)
    closed_A: float = quantity("closed fraction of the throttle at A", "1", ge=0, le=0.99)
    closed_B: float = quantity("closed fraction of the throttle at B", "1", ge=0, le=0.99)
    closed_means: Literal["area", "diameter"] = choice("what the closed fraction is a fraction of")
    metering: Literal["meter-out", "literal"] = choice("which flow is throttled, eqs. (4.9)-(4.12)")
    dp_0: float = quantity("pressure difference below which the throttle is laminar", "Pa", gt=0, le=1e6)
    V_1: float = quantity("volume of the line at pump port 1", "m^3", gt=0, le=1)
    V_2: float = quantity("volume of the line at pump port 2", "m^3", gt=0, le=1)
    open_A: float = quantity("opening of the shut-off valve in line A", "1", absent=1, ge=0, le=1)
    open_B: float = quantity("opening of the shut-off valve in line B", "1", absent=1, ge=0, le=1)
    G_circ: float = conductance("conductance of the circulation valve where it is open", absent=0)
    R_A: float = quantity("resistance of the filter in line A", "Pa s/m^3", absent=0, ge=0, le=1e13)
    R_B: float = quantity("resistance of the filter in line B", "Pa s/m^3", absent=0, ge=0, le=1e13)
    k_clog_A: float = quantity(
        "rise of R_A per volume that passed, over R_A, at first", "1/m^3", absent=0, ge=0, le=1e9
    )
    k_clog_B: float = quantity(
        "rise of R_B per volume that passed, over R_B, at first", "1/m^3", absent=0, ge=0, le=1e9
    )
    n_clog: float = quantity(
        "law of clogging: 0 cake, 1 intermediate, 1.5 standard, 2 complete", "1", absent=0, ge=0, le=2
    )
    p_bypass: float = quantity("pressure that opens a filter's bypass valve", "Pa", absent=3.5e5, gt=0, le=1e8)
    G_bypass: float = conductance("conductance of a filter's bypass above that pressure", absent=0)


class Fluid(Part):
    """Parameters of the oil and the air in it, and the pressure to which the closed circuit is charged."""

    K_oil: float = quantity("effective bulk modulus", "Pa", gt=0, le=1e11)
    rho: float = quantity("density", "kg/m^3", gt=0, le=1e4)
    p_charge: float = quantity("charge pressure: all pressures at the start", "Pa", ge=0, le=1e8)
    air: float = quantity("free air in the oil, by volume of oil at atmospheric pressure", "1", ge=0, le=0.5)
    n_air: float = quantity("polytropic exponent of the air in the oil", "1", ge=1, le=1.4)
    p_vap: float = quantity("vapour pressure of the oil, absolute; 0: it does not boil", "Pa", absent=0.0, ge=0, le=1e5)
    T_oil: float = quantity("temperature of the oil at which the rig's values hold", "K", absent=313.15, gt=200, lt=500)
    nu_40: float = quantity("kinematic viscosity at 40 deg C", "m^2/s", absent=32e-6, gt=2e-6, le=1e-2)
    nu_100: float = quantity("kinematic viscosity at 100 deg C", "m^2/s", absent=5.4e-6, gt=1.5e-6, le=1e-2)
    alpha: float = quantity("thermal expansion of the oil", "1/K", absent=7e-4, ge=0, le=1e-2)


class MakeUp(Part):
    """Accumulator of the closed circuit, with check and relief valves between it and both sides of the circuit.

    With `check_valves = "absent"` the rig has neither accumulator nor valves. The accumulator is at the charge pressure
    at the start. Check valves feed oil into the circuit. Pilot-operated ones, which the pressure of the other side
    opens, also return the oil that the rod of a single-rod cylinder displaces.
    """

    check_valves: Literal["absent", "present", "pilot-operated"] = choice("make-up from an accumulator in the model")
    p_crack: float = quantity("pressure that opens a check valve", "Pa", ge=0, le=1e7)
    G_check: float = quantity("conductance of an open check valve", "m^3/(s Pa)", gt=0, le=1e-6)
    V_gas: float = quantity("gas in the accumulator at the charge pressure", "m^3", gt=0, le=10)
    n_gas: float = quantity("polytropic exponent of the gas in the accumulator", "1", absent=1, ge=1, le=2)
    k_pilot: float = quantity("pilot ratio of a pilot-operated check valve", "1", absent=3, gt=0, le=100)
    p_open: float = quantity(
        "pressure from cracking to full opening of a pilot-operated check valve", "Pa", absent=5e4, gt=0, le=1e7
    )
    p_relief: float = quantity(
        "pressure above the accumulator's that opens a relief valve", "Pa", absent=2e7, gt=0, le=1e9
    )
    G_relief: float = conductance("conductance of a relief valve above its pressure", absent=0)
