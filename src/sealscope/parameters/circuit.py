"""The hydraulic circuits: how a machine's pump or servo valve is connected with the chambers of its cylinder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

from sealscope.errors import InputError


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
