"""The code of a unit: the laws of `simulate`, compiled for a rig's choice of them, as functions for C.

Pointers of all functions: `values` in the order of `variables.VALUES`, `inputs` of `variables.INPUTS`, the state `y` of
`physics.state.STATES`, `results` of `variables.RESULTS`. What they return: 0, or one of `FAILURES`.
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
from sealscope.physics.standstill import BELOW_VACUUM, NOT_HELD, carried_at_standstill, stand_still
from sealscope.physics.state import (
    CURRENT,
    OUTPUTS,
    P_1,
    P_2,
    P_A,
    P_B,
    STATES,
    VELOCITY,
    state_of,
)
from sealscope.simulation.experiment import choose_method
from sealscope.units import P_ATM

#: What a function of a unit returns where it fails.
FAILURES = MappingProxyType(
    {
        1: "the state is not finite: take a smaller step, or smaller gains",
        BELOW_VACUUM: "a pressure is below vacuum, where the model does not hold",
        NOT_HELD: "the drive cannot hold the load at standstill",
    }
)
_SIZES = {"values": len(VALUES), "inputs": len(INPUTS), "y": len(STATES), "results": len(RESULTS)}
_N_VALUES, _N_INPUTS, _N_STATES, _N_RESULTS = _SIZES.values()
_N_PARAMETERS, _N_OUTPUTS = len(PARAMETERS), len(OUTPUTS)
_OUTWARD_A, _OUTWARD_B = VALUES.index("cylinder.G_ext_A"), VALUES.index("cylinder.G_ext_B")
_U, _G, _C, _F, _MORE_A, _MORE_B = range(len(INPUTS))
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
def _nodes_along(a: float, b: float, t: float, h: float) -> tuple[float, float, float]:
    """Compute a + b t at the nodes of an explicit step of h [s]."""
    n = RK4_NODES
    return a + b * (t + n[0] * h), a + b * (t + n[1] * h), a + b * (t + n[2] * h)


@law
def _along_implicit(a: float, b: float, t: float, h: float) -> tuple[float, float, float, float, float, float]:
    """Compute a + b t at the nodes of an implicit-explicit step of h [s]."""
    n = IMEX_NODES
    first = a + b * (t + n[0] * h), a + b * (t + n[1] * h), a + b * (t + n[2] * h)
    return first[0], first[1], first[2], a + b * (t + n[3] * h), a + b * (t + n[4] * h), a + b * (t + n[5] * h)


class Choice(NamedTuple):
    """The laws and readings by which a rig's code differs from that of others; numbers stay variables of the unit."""

    laws: tuple[bool | tuple[bool, ...], ...]
    exponent: float
    literal: bool
    implicit: bool
    euler: bool

    @classmethod
    def from_rig(cls, rig: Rig) -> Choice:
        """Return a rig's choice, with the laws of a load and of outward leakage, which are inputs of every unit."""
        laws = tuple(rig_numbers(rig)._replace(open_circuit=(True,), pushed=(True,)))[len(NUMBERS) :]
        return cls(laws, *throttle_readings(rig), choose_method(rig, "auto") == "imex", rig.motor.integrator == "euler")


def numbers_of(choices: tuple[bool | tuple[bool, ...], ...], exponent: float, literal: bool) -> Callable[..., Any]:
    """Build the law that makes `RigNumbers` of a unit's values and its outward leakage."""

    @law
    def numbers(v: Any, outward_A: float, outward_B: float) -> Any:
        derived = derived_numbers(RigValues(*to_fixed_tuple(v, _N_VALUES)), exponent, literal)
        parameters = to_fixed_tuple(v, _N_PARAMETERS)
        parameters = tuple_setitem(parameters, _OUTWARD_A, parameters[_OUTWARD_A] + outward_A)
        parameters = tuple_setitem(parameters, _OUTWARD_B, parameters[_OUTWARD_B] + outward_B)
        return RigNumbers(*(parameters + derived + choices))

    return numbers  # type: ignore[no-any-return]


def functions(choice: Choice) -> dict[str, Callable[..., Any]]:
    """Build the functions of a unit, to be compiled.

    ``start(values, inputs, x_0, y)`` puts the state at standstill under the load of the inputs; ``advance(values,
    inputs, slopes, y, span, steps)`` moves it over `span` [s], while the inputs move along their slopes;
    ``report(values, inputs, y, results)`` writes the outputs.
    """
    choices, exponent, literal, implicit, euler = choice
    throttled = bool(choices[CHOICES.index("throttled")])
    of_values = numbers_of(choices, exponent, literal)

    @law
    def numbers(v: Any, inputs: Any) -> Any:
        return of_values(v, inputs[_MORE_A], inputs[_MORE_B])

    def start(values: Any, inputs: Any, x_0: float, y: Any) -> int:
        v, input_values, state = carray(values, _N_VALUES), carray(inputs, _N_INPUTS), carray(y, _N_STATES)
        p = numbers(v, input_values)
        state[:] = 0.0
        return stand_still(state, x_0, carried_at_standstill(x_0, p) + input_values[_F], p)  # type: ignore[no-any-return]

    def report(values: Any, inputs: Any, y: Any, results: Any) -> int:
        v, input_values, state = carray(values, _N_VALUES), carray(inputs, _N_INPUTS), carray(y, _N_STATES)
        out = carray(results, _N_RESULTS)
        p, z = numbers(v, input_values), state_of(state)
        observe(z, input_values[_U], input_values[_G], input_values[_C], p, out)
        out[_N_OUTPUTS] = _electric(out[_VOLTAGE], z[CURRENT])
        out[_N_OUTPUTS + 1] = _hydraulic(out[_Q_1], (out[P_1] - out[P_2]) if throttled else (out[P_A] - out[P_B]))
        out[_N_OUTPUTS + 2] = _mechanical(out[P_A], out[P_B], z[VELOCITY], p.A_A, p.A_B)
        return 0

    if implicit:

        @law
        def step(z: Any, h: float, t: float, a: Any, b: Any, p: Any) -> Any:
            u, G = _along_implicit(a[_U], b[_U], t, h), _along_implicit(a[_G], b[_G], t, h)
            C, F = _along_implicit(a[_C], b[_C], t, h), _along_implicit(a[_F], b[_F], t, h)
            return imex_step(z, h, u, G, C, F, p)

    else:

        @law
        def step(z: Any, h: float, t: float, a: Any, b: Any, p: Any) -> Any:
            u, G = _nodes_along(a[_U], b[_U], t, h), _nodes_along(a[_G], b[_G], t, h)
            C, F = _nodes_along(a[_C], b[_C], t, h), _nodes_along(a[_F], b[_F], t, h)
            return rk4_step(z, h, u, G, C, F, p, euler)

    def advance(values: Any, inputs: Any, slopes: Any, y: Any, span: float, steps: int) -> int:
        v, state = carray(values, _N_VALUES), carray(y, _N_STATES)
        a, b = carray(inputs, _N_INPUTS), carray(slopes, _N_INPUTS)
        p, z, h = numbers(v, a), state_of(state), span / steps
        for k in range(steps):
            z = step(z, h, k * h, a, b, p)
        total = 0.0
        for m in range(_N_STATES):
            state[m] = z[m]
            total += 0.0 * z[m]  # NaN from any value that is not finite
        if total != 0.0:
            return 1
        p_A, p_B, p_1, p_2 = pressures_of(z, p)
        return BELOW_VACUUM if min(p_A, p_B, p_1, p_2) < -P_ATM else 0

    return {"start": start, "advance": advance, "report": report}


@lru_cache(maxsize=8)
def code(choice: Choice) -> Mapping[str, str]:
    """Compile the LLVM code of a rig's unit (`unit_code`)."""
    return unit_code(functions(choice))


def unit_code(functions: Mapping[str, Callable[..., Any]]) -> Mapping[str, str]:
    """Compile the LLVM code of each function of a unit, by its name, with the symbol ``sealscope_NAME``."""
    modules = {}
    for name, function in functions.items():
        text, symbol = plain_code(function, *ARGUMENTS[name])
        modules[name] = re.sub(r'"?' + re.escape(symbol) + r'"?(?=\()', f"sealscope_{name}", text)
    return MappingProxyType(modules)


def object_code(module: str, triple: str | None = None) -> bytes:
    """Compile LLVM code to machine code for a target ("x86_64-pc-windows-gnu"); None: this machine's system.

    For any processor of the target's family, with the addresses of a shared library.
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple or llvm.get_process_triple())
    machine = target.create_target_machine(opt=3, reloc="pic", codemodel="default")
    parsed = llvm.parse_assembly(module)
    parsed.triple, parsed.data_layout = machine.triple, str(machine.target_data)
    parsed.verify()
    return bytes(machine.emit_object(parsed))
