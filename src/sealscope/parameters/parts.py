"""Parameters of a rig's parts: motor, pump, lines, fluid, cylinder, valve with its supply, sensors; and its circuit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, Self

from pydantic import model_validator

from sealscope.errors import InputError
from sealscope.parameters.fields import Part, choice, conductance, quantity, with_unit


class HydraulicCircuit(NamedTuple):
    """Connection of pump and cylinder chambers: one of `CIRCUITS`, chosen by a parameter of the rig (`Rig.circuit`).

    Other modules read the properties below instead of comparing circuits. `CONTRIBUTING.md` says what a further circuit
    needs.

    Attributes
    ----------
    name : str
        Name in messages.
    parameter, value : str
        Parameter that chooses the circuit, and its value.
    required : mapping of str to str
        Further parameters that must have a value in a rig with this circuit.
    simulated : bool
        A rig with this circuit can be simulated, by laws in `physics`; otherwise it can only be diagnosed.
    valve_controlled : bool
        A servo valve on a supply of constant pressure meters the flow into each chamber; else the pump's speed does.
    pump_feeds_chambers : bool
        The pump delivers into chamber A and draws from B, or the reverse. One balance of volumes then holds for both
        chambers, but it cannot tell leakage of the pump from leakage past the piston. If the piston areas are equal,
        the balance does not need the piston's position.
    feeds_one_chamber : bool
        The pump delivers into one chamber at a time, through directional valves, and the other drains to the tank.
    has_asymmetric_pump : bool
        The flows of the pump in the two lines have the ratio of the piston areas. The displacement is that of side A.
    pump_is_measured : bool
        An encoder on the pump's motor records its angle and speed.
    holds_load : bool
        Both chambers are shut while the command rests at zero, so that a load creeps by leakage alone.
    flow_size : {"area", "displacement"}
        The machine's size, piston area or pump displacement, to which flows in L/min from the balance of volumes are
        proportional. Its uncertainty is in ``diagnosis/inference/priors.toml``, table ``[size]``, under the same name.
    watched_by : tuple of tuple of str
        Sets of channels from which the balance of volumes watches a running machine, the best set first.
    needed_channels : str
        Channels that the balance of volumes of a recording needs, in words for a message.
    """

    name: str
    parameter: str
    value: str
    required: Mapping[str, str]
    simulated: bool
    valve_controlled: bool
    pump_feeds_chambers: bool
    feeds_one_chamber: bool
    has_asymmetric_pump: bool
    pump_is_measured: bool
    holds_load: bool
    flow_size: Literal["area", "displacement"]
    watched_by: tuple[tuple[str, ...], ...]
    needed_channels: str

    def __str__(self) -> str:
        return f"{self.name} ({self.parameter} = {self.value})"

    @property
    def pump_moves_piston(self) -> bool:
        """True if the piston moves by the flow of the pump, which no valve meters: into both chambers, or into one."""
        return self.pump_feeds_chambers or self.feeds_one_chamber

    @property
    def size_parameters(self) -> tuple[str, ...]:
        """Dotted names of the parameters that scale flows of the volume balance: piston areas or displacement."""
        return ("cylinder.A_A", "cylinder.A_B") if self.flow_size == "area" else ("pump.q_b",)


#: A pump whose speed is commanded, in a closed circuit with the cylinder.
PUMP_CIRCUIT = HydraulicCircuit(
    name="pump-controlled",
    parameter="valve.spool",
    value="absent",
    required={"supply.drive": "absent"},
    simulated=True,
    valve_controlled=False,
    pump_feeds_chambers=True,
    feeds_one_chamber=False,
    has_asymmetric_pump=False,
    pump_is_measured=True,
    holds_load=False,
    flow_size="displacement",
    watched_by=(("p_A", "p_B", "x", "theta"), ("p_A", "p_B", "x", "omega")),
    needed_channels="p_A, p_B and the pump's theta or omega, a flow meter q_pump or the command u",
)
#: A pump that draws from a tank. Directional valves lead its flow to one chamber at a time; the other drains.
OPEN_CIRCUIT = PUMP_CIRCUIT._replace(
    name="pump-controlled in an open circuit",
    parameter="pump.circuit",
    value="open",
    required={"valve.spool": "absent", "supply.drive": "absent"},
    simulated=False,
    pump_feeds_chambers=False,
    feeds_one_chamber=True,
    needed_channels="x, p_A, p_B and the pump's theta or omega, or a flow meter q_pump",
)
#: A pump with a displacement for each piston area, or two pumps on one shaft, in a closed circuit with the cylinder.
ASYMMETRIC_CIRCUIT = PUMP_CIRCUIT._replace(
    name="pump-controlled by an asymmetric pump",
    parameter="pump.circuit",
    value="asymmetric",
    required={"valve.spool": "absent", "supply.drive": "absent"},
    simulated=False,
    has_asymmetric_pump=True,
)
#: A servo valve between a supply and the cylinder.
VALVE_CIRCUIT = HydraulicCircuit(
    name="valve-controlled",
    parameter="valve.spool",
    value="present",
    required={"supply.drive": "constant-speed", "line.orifices": "absent", "makeup.check_valves": "absent"},
    simulated=True,
    valve_controlled=True,
    pump_feeds_chambers=False,
    feeds_one_chamber=False,
    has_asymmetric_pump=False,
    pump_is_measured=False,
    holds_load=True,
    flow_size="area",
    watched_by=(("p_A", "p_B", "p_1", "p_2", "u", "x"),),
    needed_channels="x, u, p_A, p_B (for leaks in holds), and p_1 of the supply for motion",
)
#: All circuits. A rig has the first circuit whose `parameter` has its `value` in the rig. As the last two circuits
#: cover all values of their parameter, a circuit that another parameter chooses must stand before them.
CIRCUITS = (OPEN_CIRCUIT, ASYMMETRIC_CIRCUIT, PUMP_CIRCUIT, VALVE_CIRCUIT)


def check_circuit_property(subject: str, rig: str, circuit: HydraulicCircuit, flag: str) -> None:
    """Raise InputError unless a rig's `circuit` has the property `flag`, a bool attribute such as "pump_is_measured".

    `subject`: what needs the property, such as "a simulation"; `rig`: the rig's name, for the message.
    """
    if not getattr(circuit, flag):
        suitable = " or ".join(str(candidate) for candidate in CIRCUITS if getattr(candidate, flag))
        raise InputError(f"{subject} must have a rig that is {suitable}, got {rig}, which is {circuit}")


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


#: Largest difference of a double-rod cylinder's areas, divided by their mean: makers' tolerances.
_MAX_DOUBLE_ROD_UNEVENNESS = 0.1


class Cylinder(Part):
    """Parameters of the cylinder, its end stops and its load, eqs. (4.13)-(4.15), (4.18), (4.19) of the thesis.

    The position x is 0 at mid-stroke. The areas A_A and A_B of a double-rod cylinder are equal to within makers'
    tolerances; those of a single-rod cylinder differ by more (`single_rod`).
    """

    A_A: float = quantity("piston area on side A", "m^2", gt=0, le=10)
    A_B: float = quantity("piston area on side B", "m^2", gt=0, le=10)
    L: float = quantity("stroke", "m", gt=0, le=100)
    M_eq: float = quantity("moving mass", "kg", gt=0, le=1e6)
    V: float = quantity("volume of each side at mid-stroke", "m^3", gt=0, le=100)
    V_rod: float = quantity("rod in side B at mid-stroke: V less this is left", "m^3", absent=0, ge=0, le=100)
    volumes: Literal["fixed", "position"] = choice("chamber volumes: constant V, or V + A_A x and V - A_B x")
    balance: Literal["mass", "volume"] = choice(
        "what chambers balance where volumes move with the piston", absent="mass"
    )
    k_stop: float = quantity("stiffness of the end stop", "N/m", gt=0, le=1e12)
    d_stop: float = quantity("damping of the end stop", "N s/m", ge=0, le=1e9)
    V_hose_A: float = quantity("hose on side A: volume beside the chamber's", "m^3", absent=0, ge=0, le=1)
    V_hose_B: float = quantity("hose on side B: volume beside the chamber's", "m^3", absent=0, ge=0, le=1)
    k_load: float = quantity("spring of the load about mid-stroke", "N/m", absent=0, ge=0, le=1e9)
    d_load: float = quantity("damper of the load", "N s/m", absent=0, ge=0, le=1e9)
    A_opp: float = quantity("piston area of an opposing cylinder (0: none)", "m^2", absent=0, ge=0, le=10)
    p_opp: float = quantity("pressure that feeds the opposing cylinder", "Pa", absent=0, ge=0, le=1e9)
    C_opp: float = quantity("coefficient of the orifice in that feed", "m^3/(s Pa^0.5)", absent=1, gt=0, le=1)
    F_l: float = quantity("constant external load", "N", ge=-1e8, le=1e8)
    G_ext_A: float = conductance("leakage conductance of the rod seal of A")
    G_ext_B: float = conductance("leakage conductance of the rod seal of B")

    @property
    def single_rod(self) -> bool:
        """True if the piston areas differ by more than makers' tolerances, 10 % of their mean."""
        return abs(self.A_A - self.A_B) / (0.5 * (self.A_A + self.A_B)) > _MAX_DOUBLE_ROD_UNEVENNESS


class Friction(Part):
    """Coulomb, Stribeck and viscous friction of the piston, eqs. (4.20)-(4.22) of the thesis.

    `law` may select another law near standstill, which uses the same forces while the piston slides.
    """

    F_pr: float = quantity("preload force of the seals", "N", ge=0, le=1e7)
    F_cfr: float = quantity("Coulomb friction per pressure", "N/Pa", ge=0, le=1)
    C_c: float = quantity("transition coefficient", "s/m", gt=0, le=1e6)
    K_brk: float = quantity("breakaway force over Coulomb force", "1", ge=1, le=100)
    F_v: float = quantity("viscous friction coefficient", "N s/m", ge=0, le=1e8)
    v_th: float = quantity("velocity below which friction is linear", "m/s", gt=0, le=10)
    coulomb_pressure: Literal["sum", "difference"] = choice("pressure in the Coulomb force, eq. (4.20)")
    law: Literal["stribeck", "karnopp", "lugre"] = choice("law of friction near standstill", absent="stribeck")
    sigma_0: float = quantity("stiffness of the contact, LuGre", "N/m", absent=1e6, gt=0, le=1e12)
    sigma_1: float = quantity("damping of the contact, LuGre", "N s/m", absent=1e3, ge=0, le=1e9)
    backward: float = quantity("friction of motion towards -x over that towards +x", "1", absent=1, gt=0, le=100)
    bracket: Literal["continuous", "literal"] = choice("bracketing of the linear part, eq. (4.22)")


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


class PressureTransducer(Part):
    """A pressure transducer with the errors of its reading: noise, offset, drift, mains hum, delay and failures.

    Its white noise `noise` is independent of that of other channels; `sensors.common_noise` is equal in all of them.
    """

    range_lo: float = quantity("lower end of the range", "Pa", ge=-1e9, le=1e9)
    range_hi: float = quantity("upper end of the range", "Pa", gt=0, le=1e9)
    noise: float = quantity("own white noise, standard deviation of a sample", "Pa", ge=0, le=1e8)
    offset: float = quantity("zero offset", "Pa", ge=-1e8, le=1e8)
    gain_error: float = quantity("relative gain error", "1", gt=-1, le=1)
    drift: float = quantity("random walk of the zero, deviation per root second", "Pa/s^0.5", ge=0, le=1e8)
    hum: float = quantity("amplitude of mains hum", "Pa", ge=0, le=1e8)
    hum_frequency: float = quantity("frequency of mains hum", "Hz", gt=0, le=1e3)
    stuck_rate: float = quantity("rate at which the reading gets stuck", "1/s", ge=0, le=1e3)
    drop_rate: float = quantity("rate of lost samples", "1/s", ge=0, le=1e6)
    delay: float = quantity("delay: the reading is the pressure of this time before", "s", ge=0, le=1)
    lag: float = quantity("time constant of the transducer, first order", "s", absent=0, ge=0, le=10)
    hum_harmonics: float = quantity(
        "amplitude of each harmonic of the hum over the one before it", "1", absent=0, ge=0, le=1
    )

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        """Raise ValueError, as pydantic requires, unless range_lo < range_hi."""
        if self.range_lo >= self.range_hi:
            raise ValueError(f"range_lo must be < range_hi = {with_unit(self.range_hi, 'Pa')}, got {self.range_lo}")
        return self


class PositionEncoder(Part):
    """Encoder of the piston's position, with its resolution, noise and scale error."""

    resolution: float = quantity("length of one count (0: no quantisation)", "m", ge=0, le=0.1)
    noise: float = quantity("white noise before counting, standard deviation", "m", ge=0, le=0.1)
    scale_error: float = quantity("relative error of the scale", "1", gt=-1, le=1)


class AngleEncoder(Part):
    """Encoder of the motor's angle."""

    counts: int = quantity("counts per revolution", "count/rev", gt=0, le=100_000_000)


class FlowMeter(Part):
    """Flow meter in the bypass across the piston; it reads both directions."""

    range_hi: float = quantity("largest flow read, either way", "m^3/s", gt=0, le=1)
    resolution: float = quantity("smallest step of the reading (0: none)", "m^3/s", ge=0, le=1)
    noise: float = quantity("white noise, standard deviation of a sample", "m^3/s", ge=0, le=1)


class Sensors(Part):
    """All sensors, by the names of their channels, and the noise that is common to the pressure channels."""

    common_noise: float = quantity("white noise common to the pressure channels", "Pa", ge=0, le=1e8)
    p_1: PressureTransducer
    p_2: PressureTransducer
    p_A: PressureTransducer
    p_B: PressureTransducer
    x: PositionEncoder
    theta: AngleEncoder
    q_leak: FlowMeter


class Daq(Part):
    """Data acquisition board; its inputs read `sensor_volts_lo` to `sensor_volts_hi` over a transducer's range."""

    bits: int = quantity("resolution of the conversion", "bit", ge=2, le=32)
    range: float = quantity("input range: plus and minus this voltage", "V", gt=0, le=1e3)
    sample_rate: float = quantity("sampling rate", "Hz", gt=0, le=1e6)
    jitter: float = quantity("jitter of the clock, standard deviation", "s", absent=0, ge=0, le=1e-3)
    sensor_volts_lo: float = quantity("transducer output at range_lo", "V", ge=-1e3, le=1e3)
    sensor_volts_hi: float = quantity("transducer output at range_hi", "V", ge=-1e3, le=1e3)
    u_max: float = quantity("largest command: plus and minus this voltage", "V", gt=0, le=1e3)

    @model_validator(mode="after")
    def _check_output_volts(self) -> Self:
        """Raise ValueError, as pydantic requires, unless -range <= sensor_volts_lo < sensor_volts_hi <= range."""
        lo, hi = self.sensor_volts_lo, self.sensor_volts_hi
        if lo >= hi:
            raise ValueError(f"sensor_volts_lo must be < sensor_volts_hi = {with_unit(hi, 'V')}, got {lo}")
        if hi > self.range:
            raise ValueError(f"sensor_volts_hi must be <= range = {with_unit(self.range, 'V')}, got {hi}")
        if lo < -self.range:
            raise ValueError(f"sensor_volts_lo must be >= -range = {with_unit(-self.range, 'V')}, got {lo}")
        return self

    @property
    def step(self) -> float:
        """Voltage [V] of one step of the analog-digital conversion: 2 range / 2^bits."""
        return 2.0 * self.range / 2.0**self.bits
