"""The code of a functional mock-up unit (FMU) of a rig: the equations of `simulate`, compiled to functions for C.

The functions' arguments are pointers to arrays of doubles. The arrays, and the tables that give their order, are:
parameters `values`, `variables.VALUES`; `inputs`, `variables.INPUTS`; state `y`, `physics.state.STATES`; outputs
`results`, `variables.RESULTS`. The functions return 0, or a code of `FAILURES`.
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
#: Codes that a function of an FMU returns if it fails, with their messages.
FAILURES: Mapping[int, str] = {
    _NOT_FINITE: "the state is not finite: take a smaller step, or smaller gains",
    BELOW_VACUUM: "a pressure is below vacuum, where the model does not hold",
    BEYOND_DRIVE: "the drive cannot hold the load at standstill",
}
_N_VALUES, _N_INPUTS, _N_STATES, _N_RESULTS = len(VALUES), len(INPUTS), len(STATES), len(RESULTS)
_N_PARAMETERS, _N_OUTPUTS = len(PARAMETERS), len(OUTPUTS)
_G_EXT_A, _G_EXT_B = VALUES.index("cylinder.G_ext_A"), VALUES.index("cylinder.G_ext_B")
_U, _G, _C, _F, _ADDED_G_EXT_A, _ADDED_G_EXT_B = range(len(INPUTS))
_VOLTAGE, _Q_1 = OUTPUTS.index("V"), OUTPUTS.index("Q_1")
_electric, _hydraulic, _mechanical = law(electric_power), law(hydraulic_power), law(mechanical_power)
#: The C types of the arguments of each function of an FMU.
ARGUMENTS: Mapping[str, tuple[str, ...]] = {
    "start": ("double*", "double*", "double", "double*"),
    "advance": ("double*", "double*", "double*", "double*", "double", "int64"),
    "report": ("double*", "double*", "double*", "double*"),
}


@law
def _at_rk4_nodes(a: float, b: float, t: float, h: float) -> tuple[float, float, float]:
    """Compute an input a + b s at the three times s [s] that a Runge-Kutta step from t to t + h needs."""
    n = RK4_NODES  # fractions of h
    return a + b * (t + n[0] * h), a + b * (t + n[1] * h), a + b * (t + n[2] * h)


@law
def _at_imex_nodes(a: float, b: float, t: float, h: float) -> tuple[float, float, float, float, float, float]:
    """Compute an input a + b s at the six times s [s] that an implicit-explicit step from t to t + h needs."""
    n = IMEX_NODES  # fractions of h
    at_0, at_1, at_2 = a + b * (t + n[0] * h), a + b * (t + n[1] * h), a + b * (t + n[2] * h)
    at_3, at_4, at_5 = a + b * (t + n[3] * h), a + b * (t + n[4] * h), a + b * (t + n[5] * h)
    return at_0, at_1, at_2, at_3, at_4, at_5


class RigChoice(NamedTuple):
    """The equations and the solver that are compiled into the FMU of a rig; the rig's parameters remain variables."""

    # by `physics.rig.CHOICES`: truth values, then for each optional law (True,) if the rig has it, else ()
    laws: tuple[bool | tuple[bool, ...], ...]
    exponent: float  # 1 if the closed fraction of a throttle is a fraction of its area, 2 if of its diameter
    literal_metering: bool  # True if eqs. (4.9)-(4.12) of the thesis are taken as printed
    implicit: bool  # True for the implicit-explicit method, False for Runge-Kutta
    euler: bool  # True to compute the speed loop's integral by eq. (4.2)

    @classmethod
    def from_rig(cls, rig: Rig) -> RigChoice:
        """Choose the equations and solver of a rig's FMU, always with load and external leakage, which are inputs."""
        # switches of external leakage (open_circuit) and load (pushed): on
        numbers = rig_numbers(rig)._replace(open_circuit=(True,), pushed=(True,))
        laws = tuple(numbers)[len(NUMBERS) :]  # only the entries that choose equations, after the numbers
        exponent, literal_metering = throttle_readings(rig)
        implicit = choose_method(rig, "auto") == "imex"
        return cls(laws, exponent, literal_metering, implicit=implicit, euler=rig.motor.integrator == "euler")


def build_functions(choice: RigChoice) -> dict[str, Callable[..., Any]]:
    """Build the functions of an FMU for a rig, which `rig_code` compiles; return them by name.

    - ``start(values, inputs, x_0, y)`` sets `y` to standstill at x_0 [m] under the load among the inputs.
    - ``advance(values, inputs, slopes, y, span, steps)`` integrates `y` over `span` [s] in `steps` equal steps, while
      the inputs change linearly by their `slopes` (per second); `y` is replaced also after a failure.
    - ``report(values, inputs, y, results)`` writes the outputs, then the electric, hydraulic and mechanical power [W].

    All arguments but x_0, span and steps are pointers to arrays of doubles, in the order of the module's docstring.
    """
    laws, exponent, literal_metering, implicit, euler = choice
    throttled = bool(laws[CHOICES.index("throttled")])

    @law
    def model_parameters(v: Any, inputs: Any) -> Any:
        """Compute `RigNumbers` from the values v, with the external leakage among `inputs` added to the rig's."""
        derived = derived_numbers(RigValues(*to_fixed_tuple(v, _N_VALUES)), exponent, literal_metering)
        parameters = to_fixed_tuple(v, _N_PARAMETERS)
        parameters = tuple_setitem(parameters, _G_EXT_A, parameters[_G_EXT_A] + inputs[_ADDED_G_EXT_A])
        parameters = tuple_setitem(parameters, _G_EXT_B, parameters[_G_EXT_B] + inputs[_ADDED_G_EXT_B])
        return RigNumbers(*(parameters + derived + laws))

    def start(values: Any, inputs: Any, x_0: float, y: Any) -> int:
        v, input_values, state = carray(values, _N_VALUES), carray(inputs, _N_INPUTS), carray(y, _N_STATES)
        p = model_parameters(v, input_values)
        state[:] = 0.0
        return stand_still(state, x_0, standstill_force(x_0, p) + input_values[_F], p)  # type: ignore[no-any-return]

    def report(values: Any, inputs: Any, y: Any, results: Any) -> int:
        v, input_values, state = carray(values, _N_VALUES), carray(inputs, _N_INPUTS), carray(y, _N_STATES)
        out = carray(results, _N_RESULTS)
        p, z = model_parameters(v, input_values), state_of(state)
        observe(z, input_values[_U], input_values[_G], input_values[_C], p, out)
        out[_N_OUTPUTS] = _electric(out[_VOLTAGE], z[CURRENT])
        # without throttles the ports of the pump have the chambers' pressures
        out[_N_OUTPUTS + 1] = _hydraulic(out[_Q_1], (out[P_1] - out[P_2]) if throttled else (out[P_A] - out[P_B]))
        out[_N_OUTPUTS + 2] = _mechanical(out[P_A], out[P_B], z[VELOCITY], p.A_A, p.A_B)
        return 0

    @law
    def explicit_step(z: Any, h: float, u: Any, G: Any, C: Any, F: Any, p: Any) -> Any:
        return rk4_step(z, h, u, G, C, F, p, euler)

    at_nodes: Any = _at_imex_nodes if implicit else _at_rk4_nodes
    solver_step: Any = imex_step if implicit else explicit_step

    @law
    def step(z: Any, h: float, t: float, a: Any, b: Any, p: Any) -> Any:
        """Advance the state z from the time t to t + h [s], while each input is a + b tau at the time tau [s]."""
        u, G = at_nodes(a[_U], b[_U], t, h), at_nodes(a[_G], b[_G], t, h)
        C, F = at_nodes(a[_C], b[_C], t, h), at_nodes(a[_F], b[_F], t, h)
        return solver_step(z, h, u, G, C, F, p)

    def advance(values: Any, inputs: Any, slopes: Any, y: Any, span: float, steps: int) -> int:
        v, state = carray(values, _N_VALUES), carray(y, _N_STATES)
        a, b = carray(inputs, _N_INPUTS), carray(slopes, _N_INPUTS)  # the inputs at the time t are a + b t
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
    """Compile the functions of an FMU for a rig to LLVM code; return the text of each function by its name."""
    return unit_code(build_functions(choice))


def unit_code(functions: Mapping[str, Callable[..., Any]]) -> Mapping[str, str]:
    """Compile an FMU's functions to LLVM code, with symbols ``sealscope_NAME`` and arguments of types `ARGUMENTS`."""
    modules = {}
    for name, function in functions.items():
        text, symbol = plain_code(function, *ARGUMENTS[name])
        # rename the symbol, quoted or not, wherever arguments in brackets follow
        modules[name] = re.sub(r'"?' + re.escape(symbol) + r'"?(?=\()', f"sealscope_{name}", text)
    return MappingProxyType(modules)


def object_code(module: str, triple: str) -> bytes:
    """Compile LLVM code to the bytes of an object file with position-independent machine code for a platform.

    `module`: text of the code; `triple`: LLVM's target, such as "x86_64-pc-windows-gnu".
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple)
    machine = target.create_target_machine(opt=3, reloc="pic", codemodel="default")
    parsed = llvm.parse_assembly(module)
    parsed.triple, parsed.data_layout = machine.triple, str(machine.target_data)
    parsed.verify()
    return bytes(machine.emit_object(parsed))
