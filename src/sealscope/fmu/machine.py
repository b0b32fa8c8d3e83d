"""The code of a rig's unit: the laws of `simulate` that the rig needs, compiled to functions for C.

Their arguments are pointers to numbers: `values` in the order of `variables.VALUES`, `inputs` of `variables.INPUTS`,
the state `y` of `physics.state.STATES`, `results` of `variables.RESULTS`. They return 0, or a code of `FAILURES`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from numba import carray
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.np.unsafe.ndarray import to_fixed_tuple

from sealscope.compiled import law, plain_code
from sealscope.fmu.variables import INPUTS, RESULTS, VALUES
from sealscope.parameters import Rig
from sealscope.physics.cylinder import mechanical_power
from sealscope.physics.motor import electric_power
from sealscope.physics.pump import hydraulic_power
from sealscope.physics.rig import (
    CHOICES,
    NUMBERS,
    PARAMETERS,
    RigNumbers,
    RigValues,
    derived_numbers,
    observe,
    pressures_of,
    rig_numbers,
    throttle_readings,
)
from sealscope.physics.solvers.imex import IMEX_NODES, imex_step
from sealscope.physics.solvers.rk4 import RK4_NODES, rk4_step
from sealscope.physics.standstill import BELOW_VACUUM, BEYOND_DRIVE, stand_still, standstill_force
from sealscope.physics.state import CURRENT, OUTPUTS, P_1, P_2, P_A, P_B, STATES, VELOCITY, state_of
from sealscope.simulation.experiment import choose_method
from sealscope.units import P_ATM

_NOT_FINITE = 1
#: Codes that a function of a unit returns if it fails, with their messages.
FAILURES = MappingProxyType(
    {
        _NOT_FINITE: "the state is not finite: take a smaller step, or smaller gains",
        BELOW_VACUUM: "a pressure is below vacuum, where the model does not hold",
        BEYOND_DRIVE: "the drive cannot hold the load at standstill",
    }
)
_SIZES = {"values": len(VALUES), "inputs": len(INPUTS), "y": len(STATES), "results": len(RESULTS)}
_N_VALUES, _N_INPUTS, _N_STATES, _N_RESULTS = _SIZES.values()
_N_PARAMETERS, _N_OUTPUTS = len(PARAMETERS), len(OUTPUTS)
_G_EXT_A, _G_EXT_B = VALUES.index("cylinder.G_ext_A"), VALUES.index("cylinder.G_ext_B")
_U, _G, _C, _F, _ADDED_G_EXT_A, _ADDED_G_EXT_B = range(len(INPUTS))
_VOLTAGE, _Q_1 = OUTPUTS.index("V"), OUTPUTS.index("Q_1")
_electric, _hydraulic, _mechanical = law(electric_power), law(hydraulic_power), law(mechanical_power)
#: The arguments of each function of a unit, as C passes them.
ARGUMENTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "start": ("double*", "double*", "double", "double*"),
        "advance": ("double*", "double*", "double*", "double*", "double", "int64"),
        "report": ("double*", "double*", "double*", "double*"),
    }
)


@law
def _at_rk4_nodes(a: float, b: float, t: float, h: float) -> tuple[float, float, float]:
    """Compute the input a + b t at the nodes of an explicit step of h [s] that begins at t [s]."""
    n = RK4_NODES
    return a + b * (t + n[0] * h), a + b * (t + n[1] * h), a + b * (t + n[2] * h)


@law
def _at_imex_nodes(a: float, b: float, t: float, h: float) -> tuple[float, float, float, float, float, float]:
    """Compute the input a + b t at the nodes of an implicit-explicit step of h [s] that begins at t [s]."""
    n = IMEX_NODES
    first = a + b * (t + n[0] * h), a + b * (t + n[1] * h), a + b * (t + n[2] * h)
    return first[0], first[1], first[2], a + b * (t + n[3] * h), a + b * (t + n[4] * h), a + b * (t + n[5] * h)


class RigChoice(NamedTuple):
    """The laws of a rig that are compiled into its unit; all parameters remain variables of the unit.

    `laws`: choices and optional laws of the rig, in the order of `physics.rig.CHOICES`; `exponent`, `literal_metering`:
    reading of the throttles' equations (`throttle_flow_coefficients`); `implicit`: implicit-explicit method, not
    Runge-Kutta; `euler`: integral of the speed loop by eq. (4.2).
    """

    laws: tuple[bool | tuple[bool, ...], ...]
    exponent: float
    literal_metering: bool
    implicit: bool
    euler: bool

    @classmethod
    def from_rig(cls, rig: Rig) -> RigChoice:
        """Choose the laws of a rig, always with load and external leakage, which are inputs of every unit."""
        laws = tuple(rig_numbers(rig)._replace(open_circuit=(True,), pushed=(True,)))[len(NUMBERS) :]
        implicit, euler = choose_method(rig, "auto") == "imex", rig.motor.integrator == "euler"
        return cls(laws, *throttle_readings(rig), implicit=implicit, euler=euler)


def _build_parameters_law(
    laws: tuple[bool | tuple[bool, ...], ...], exponent: float, literal_metering: bool
) -> Callable[..., Any]:
    """Build the law that computes the model's parameters, `RigNumbers`, from a unit's values and external leakage.

    Its arguments: values (n,), and the conductances [m^3/(s Pa)] of leakage out of A and B to add to those of the rig.
    """

    @law
    def model_parameters(v: Any, G_ext_A: float, G_ext_B: float) -> Any:
        """Compute the model's parameters from a unit's values v and additional external leakage [m^3/(s Pa)]."""
        derived = derived_numbers(RigValues(*to_fixed_tuple(v, _N_VALUES)), exponent, literal_metering)
        parameters = to_fixed_tuple(v, _N_PARAMETERS)
        parameters = tuple_setitem(parameters, _G_EXT_A, parameters[_G_EXT_A] + G_ext_A)
        parameters = tuple_setitem(parameters, _G_EXT_B, parameters[_G_EXT_B] + G_ext_B)
        return RigNumbers(*(parameters + derived + laws))

    return model_parameters  # type: ignore[no-any-return]


def build_functions(choice: RigChoice) -> dict[str, Callable[..., Any]]:
    """Build the functions of a unit, to be compiled.

    ``start(values, inputs, x_0, y)`` sets the state to standstill at x_0 [m] under the load of the inputs;
    ``advance(values, inputs, slopes, y, span, steps)`` integrates it over `span` [s] with inputs that change linearly
    by their `slopes` [1/s]; ``report(values, inputs, y, results)`` writes the outputs.
    """
    laws, exponent, literal_metering, implicit, euler = choice
    throttled = bool(laws[CHOICES.index("throttled")])
    parameters_from_values = _build_parameters_law(laws, exponent, literal_metering)

    @law
    def model_parameters(v: Any, inputs: Any) -> Any:
        """Compute the model's parameters from the unit's values and its inputs of external leakage."""
        return parameters_from_values(v, inputs[_ADDED_G_EXT_A], inputs[_ADDED_G_EXT_B])

    def start(values: Any, inputs: Any, x_0: float, y: Any) -> int:
        """Set the state `y` to standstill at x_0 [m] under the load of the inputs; return 0, or a code of failure."""
        v, input_values, state = carray(values, _N_VALUES), carray(inputs, _N_INPUTS), carray(y, _N_STATES)
        p = model_parameters(v, input_values)
        state[:] = 0.0
        return stand_still(state, x_0, standstill_force(x_0, p) + input_values[_F], p)  # type: ignore[no-any-return]

    def report(values: Any, inputs: Any, y: Any, results: Any) -> int:
        """Write the outputs, and after them the electric, hydraulic and mechanical power [W]."""
        v, input_values, state = carray(values, _N_VALUES), carray(inputs, _N_INPUTS), carray(y, _N_STATES)
        out = carray(results, _N_RESULTS)
        p, z = model_parameters(v, input_values), state_of(state)
        observe(z, input_values[_U], input_values[_G], input_values[_C], p, out)
        out[_N_OUTPUTS] = _electric(out[_VOLTAGE], z[CURRENT])
        out[_N_OUTPUTS + 1] = _hydraulic(out[_Q_1], (out[P_1] - out[P_2]) if throttled else (out[P_A] - out[P_B]))
        out[_N_OUTPUTS + 2] = _mechanical(out[P_A], out[P_B], z[VELOCITY], p.A_A, p.A_B)
        return 0

    if implicit:

        @law
        def step(z: Any, h: float, t: float, a: Any, b: Any, p: Any) -> Any:
            """Advance the state z by h [s] from t [s], with inputs a + b t and parameters p."""
            u, G = _at_imex_nodes(a[_U], b[_U], t, h), _at_imex_nodes(a[_G], b[_G], t, h)
            C, F = _at_imex_nodes(a[_C], b[_C], t, h), _at_imex_nodes(a[_F], b[_F], t, h)
            return imex_step(z, h, u, G, C, F, p)

    else:

        @law
        def step(z: Any, h: float, t: float, a: Any, b: Any, p: Any) -> Any:
            """Advance the state z by h [s] from t [s], with inputs a + b t and parameters p."""
            u, G = _at_rk4_nodes(a[_U], b[_U], t, h), _at_rk4_nodes(a[_G], b[_G], t, h)
            C, F = _at_rk4_nodes(a[_C], b[_C], t, h), _at_rk4_nodes(a[_F], b[_F], t, h)
            return rk4_step(z, h, u, G, C, F, p, euler)

    def advance(values: Any, inputs: Any, slopes: Any, y: Any, span: float, steps: int) -> int:
        """Integrate the state `y` over `span` [s] by equal steps; fail if it is not finite or below vacuum."""
        v, state = carray(values, _N_VALUES), carray(y, _N_STATES)
        a, b = carray(inputs, _N_INPUTS), carray(slopes, _N_INPUTS)
        p, z, h = model_parameters(v, a), state_of(state), span / steps
        for k in range(steps):
            z = step(z, h, k * h, a, b, p)
        finite_check = 0.0
        for m in range(_N_STATES):
            state[m] = z[m]
            finite_check += 0.0 * z[m]  # NaN from any value that is not finite
        if finite_check != 0.0:
            return _NOT_FINITE
        p_A, p_B, p_1, p_2 = pressures_of(z, p)
        return BELOW_VACUUM if min(p_A, p_B, p_1, p_2) < -P_ATM else 0

    return {"start": start, "advance": advance, "report": report}


@lru_cache(maxsize=8)
def rig_code(choice: RigChoice) -> Mapping[str, str]:
    """Compile the functions of a rig's unit to LLVM code (`unit_code`)."""
    return unit_code(build_functions(choice))


def unit_code(functions: Mapping[str, Callable[..., Any]]) -> Mapping[str, str]:
    """Compile each function of a unit to LLVM code, by its name; its symbol in the code is ``sealscope_NAME``."""
    modules = {}
    for name, function in functions.items():
        text, symbol = plain_code(function, *ARGUMENTS[name])
        modules[name] = re.sub(r'"?' + re.escape(symbol) + r'"?(?=\()', f"sealscope_{name}", text)
    return MappingProxyType(modules)


def object_code(module: str, triple: str | None = None) -> bytes:
    """Compile LLVM code to position-independent machine code for any processor of a target, by default this system's.

    `triple`: LLVM's name of the target, such as "x86_64-pc-windows-gnu".
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple or llvm.get_process_triple())
    machine = target.create_target_machine(opt=3, reloc="pic", codemodel="default")
    parsed = llvm.parse_assembly(module)
    parsed.triple, parsed.data_layout = machine.triple, str(machine.target_data)
    parsed.verify()
    return bytes(machine.emit_object(parsed))
