"""The two hydraulic circuits: how a machine's pump or servo valve is connected with the chambers of its cylinder."""

from __future__ import annotations

from typing import NamedTuple


class HydraulicCircuit(NamedTuple):
    """Connection of pump and cylinder chambers, either `PUMP_CIRCUIT` or `VALVE_CIRCUIT`; `Rig.circuit` chooses one.

    A third circuit is a third value of this type, with a flag for each property that its users ask for; no user
    compares the name.

    Attributes
    ----------
    name : str
        Name in messages.
    valve_controlled : bool
        A servo valve on a supply of constant pressure meters the flow into each chamber; else the pump's speed does.
    pump_feeds_chambers : bool
        The pump delivers into chamber A and draws from B, or the reverse: one balance of volumes holds for both.
    pump_is_measured : bool
        An encoder on the pump's motor records its angle and speed.
    holds_load : bool
        Both chambers are shut while the command rests at zero, so that a load creeps by leakage alone.
    """

    name: str
    valve_controlled: bool
    pump_feeds_chambers: bool
    pump_is_measured: bool
    holds_load: bool


#: A pump whose speed is commanded, in a closed circuit with the cylinder.
PUMP_CIRCUIT = HydraulicCircuit(
    "pump-controlled", valve_controlled=False, pump_feeds_chambers=True, pump_is_measured=True, holds_load=False
)
#: A servo valve between a supply and the cylinder.
VALVE_CIRCUIT = HydraulicCircuit(
    "valve-controlled", valve_controlled=True, pump_feeds_chambers=False, pump_is_measured=False, holds_load=True
)
