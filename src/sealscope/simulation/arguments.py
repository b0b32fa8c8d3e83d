"""The arguments of an experiment, declared once for `Experiment.of`, `simulate` and the command line."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from sealscope.calls import argument

if TYPE_CHECKING:
    from sealscope.control import Controller
    from sealscope.parameters import Rig
    from sealscope.simulation.changes import ParameterDrift
    from sealscope.simulation.commands import Command
    from sealscope.simulation.faults import Fault
    from sealscope.simulation.leaks import Leak
    from sealscope.simulation.targets_and_loads import Force, Position

Method = Literal["auto", "rk4", "imex"]
_COMMAND = (
    "Voltage sent to the servo drive: '3 sin(4t)', 'step 5 at 1 s', 'ramp 5 from 1 s to 3 s', 'chirp 3 from 0.1 Hz to "
    "5 Hz over 60 s', 'prbs 2 every 0.5 s seed 1', or 'file LOG' (channel u of a recording). Or a target for the "
    "piston, from mid-stroke, that a controller follows: 'position 50 mm sin(2t)'"
)
_LEAK = (
    "Leakage across the piston: '0.0042 L/min from 90 s' (mean flow while open), '0.01[L/min] orifice growing from 1 "
    "min to 2 min', 'G = 6.1e-13 from 90 s', 'C = 2e-10', 'table LEAK.csv' or 'none'"
)
_FAULT = (
    "Other faults: 'pump leak x3 from 90 s', 'rod seal A 0.01 L/min', 'friction +20 %', 'air 1 %', 'sensor p_A offset "
    "2 psi', 'sensor p_A gain -1 %', 'sensor p_A stuck from 90 s to 100 s', 'duty amplitude x1.5'"
)
_ERROR = "Rms error that a pressure may have, such as '20[Pa]', by which the step is chosen; 100 Pa by default"
_LOAD = (
    "Force against +x in addition to the rig's own (cylinder.F_l), in a command's words: '2 kN', '500 N sin(2t)', "
    "'step 2 kN at 3 s'; terms over the piston's position and velocity may be added: '200 N/mm over x', '5 kN/mm over "
    "x from 50 mm', '2 kN s/m over v'; or 'file LOAD.csv': F [N] over t [s], x [m] or v [m/s]"
)
_CONTROLLER = (
    "Controller that follows a target, with the rig's parameters: 'pi', 'flatness', 'fault-tolerant', "
    "'fault-tolerant-flatness', or your own as 'FILE.py:NAME' or 'MODULE:NAME'; 'pi' by default"
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The arguments of an experiment, as texts with units or as numbers in SI units."""

    rig: Rig | str | os.PathLike[str] = argument(
        "thesis", "Rig, str or path-like", "A rig by name, or by the path of its TOML file"
    )
    command: Command | Position | str = argument("3 sin(4t)", "str or Command", _COMMAND)
    leak: Leak | str | Iterable[Leak | str] | None = argument(None, "str, Leak or sequence", _LEAK)
    fault: Fault | str | Iterable[Fault | str] | None = argument(None, "str, Fault or sequence", _FAULT)
    drifts: Iterable[ParameterDrift] = argument(
        (),
        "iterable of ParameterDrift",
        "Parameters of the rig and of its instruments that change slowly within the run",
    )
    set: Mapping[str, float | str] | None = argument(
        None,
        "mapping of str to float or str",
        "Value of a parameter in place of the rig's own, such as V_1 of '50[cm^3]'",
    )
    duration: float | str = argument(180.0, "float or str", "Length of the recording, such as '3 min'", unit="s")
    rate: float | str | None = argument(
        None, "float or str", "Sampling rate; by default the rig's own (daq.sample_rate)", unit="Hz"
    )
    x_0: float | str = argument(0.0, "float or str", "Position of the piston at the start, from mid-stroke", unit="m")
    seed: int = argument(0, "int", "Seed of the instruments' noise")
    method: Method = argument(
        "auto",
        '{"auto", "rk4", "imex"}',
        "Integration method, auto, rk4 or imex; auto takes the implicit-explicit one for a rig with throttles",
    )
    step: float | str | None = argument(
        None, "float or str", "Largest step of the solver, instead of one chosen by an error", unit="s"
    )
    error: float | str | None = argument(None, "float or str", _ERROR, unit="Pa")
    allow_unresolved: bool = argument(
        False, "bool", "Let an unstable or under-resolved run through, marked in the provenance"
    )
    load: Force | str | None = argument(None, "str or Force", _LOAD)
    controller: Controller | str | None = argument(None, "Controller or str", _CONTROLLER)
