"""The code of a functional mock-up unit (FMU) of a rig: the equations of `simulate` as C99, and the unit's functions.

The equations are kernels on one record, which `emit` specialises to C: the state `y`, inputs and their slopes, outputs
and the rig's numbers `p`. The unit's functions copy the numbers of an instance to the record and back.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from sealscope.compiled import law, record_dtype
from sealscope.emit.c99 import CText
from sealscope.emit.program import Program
from sealscope.emit.specialise import specialise
from sealscope.fmu.description import templates
from sealscope.fmu.variables import INPUTS, RESULTS
from sealscope.parameters import Rig
from sealscope.physics.cylinder import mechanical_power
from sealscope.physics.motor import electric_power
from sealscope.physics.pump import hydraulic_power
from sealscope.physics.rig import (
    CHOICES,
    DERIVED,
    NUMBERS,
    derived_numbers,
    observe,
    pressures_of,
    rig_numbers,
    throttle_readings,
)
from sealscope.physics.rig import VALUES as SYMBOLS
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
_N_STATES, _N_OUTPUTS = len(STATES), len(OUTPUTS)
_U, _G, _C, _F, _ADDED_G_EXT_A, _ADDED_G_EXT_B = range(len(INPUTS))
_VOLTAGE, _Q_1 = OUTPUTS.index("V"), OUTPUTS.index("Q_1")
#: The record of an FMU's kernels; `p` has the rig's parameters by symbol, and derived numbers.
_LAYOUT = record_dtype(
    y=(_N_STATES,), inputs=(len(INPUTS),), slopes=(len(INPUTS),), results=(len(RESULTS),),
    p=record_dtype(*SYMBOLS, *DERIVED),
)  # fmt: skip


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


@lru_cache(maxsize=8)
def rig_program(choice: RigChoice) -> Program:
    """Specialise the functions of an FMU for a rig.

    - ``start(m, x_0)`` sets `y` to standstill at x_0 [m] under the load among the inputs.
    - ``advance(m, span, steps)`` integrates `y` over `span` [s] in `steps` equal steps, while the inputs change
      linearly by their `slopes` (per second); `y` is replaced also after a failure.
    - ``report(m)`` writes the outputs, then the electric, hydraulic and mechanical power [W].

    The first two return 0, or a code of `FAILURES`.
    """
    laws, exponent, literal_metering, implicit, euler = choice
    throttled = bool(laws[CHOICES.index("throttled")])

    @law
    def derive(m: Any) -> None:
        """Compute the derived numbers of the rig, and add the inputs of external leakage to its own."""
        p = m.p
        p.c_A_in, p.c_A_out, p.c_B_in, p.c_B_out, p.V_A, p.V_B, p.c_slip, p.k_h = derived_numbers(
            p, exponent, literal_metering
        )
        p.G_ext_A = p.G_ext_A + m.inputs[_ADDED_G_EXT_A]
        p.G_ext_B = p.G_ext_B + m.inputs[_ADDED_G_EXT_B]

    @law
    def start(m: Any, x_0: float) -> int:
        """Set the state to standstill."""
        derive(m)
        m.y[:] = 0.0
        force = standstill_force(x_0, m.p) + m.inputs[_F]
        return stand_still(m.y, x_0, force, m.p)  # type: ignore[no-any-return]

    @law
    def report(m: Any) -> None:
        """Compute the outputs."""
        derive(m)
        p, out, z = m.p, m.results, state_of(m.y)
        observe(z, m.inputs[_U], m.inputs[_G], m.inputs[_C], p, out)
        out[_N_OUTPUTS] = electric_power(out[_VOLTAGE], z[CURRENT])
        # without throttles the ports of the pump have the chambers' pressures
        out[_N_OUTPUTS + 1] = hydraulic_power(out[_Q_1], (out[P_1] - out[P_2]) if throttled else (out[P_A] - out[P_B]))
        out[_N_OUTPUTS + 2] = mechanical_power(out[P_A], out[P_B], z[VELOCITY], p.A_A, p.A_B)

    @law
    def explicit_step(z: Any, h: float, u: Any, G: Any, C: Any, F: Any, p: Any) -> Any:
        """Advance the state by the Runge-Kutta method."""
        return rk4_step(z, h, u, G, C, F, p, euler)

    at_nodes: Any = _at_imex_nodes if implicit else _at_rk4_nodes
    solver_step: Any = imex_step if implicit else explicit_step

    @law
    def step(z: Any, h: float, t: float, a: Any, b: Any, p: Any) -> Any:
        """Advance the state z from the time t to t + h [s], while each input is a + b tau at the time tau [s]."""
        u, G = at_nodes(a[_U], b[_U], t, h), at_nodes(a[_G], b[_G], t, h)
        C, F = at_nodes(a[_C], b[_C], t, h), at_nodes(a[_F], b[_F], t, h)
        return solver_step(z, h, u, G, C, F, p)

    @law
    def advance(m: Any, span: float, steps: int) -> int:
        """Integrate the state over a span."""
        derive(m)
        p, z, h = m.p, state_of(m.y), span / steps
        for k in range(steps):
            z = step(z, h, k * h, m.inputs, m.slopes, p)
        finite_check = 0.0
        for i in range(_N_STATES):
            m.y[i] = z[i]
            finite_check += 0.0 * z[i]  # NaN from any value that is not finite
        if finite_check != 0.0:
            return _NOT_FINITE
        p_A, p_B, p_1, p_2 = pressures_of(z, p)
        return BELOW_VACUUM if min(p_A, p_B, p_1, p_2) < -P_ATM else 0

    entries = {
        "start": (start, {"m": "state", "x_0": "real"}),
        "advance": (advance, {"m": "state", "span": "real", "steps": "whole"}),
        "report": (report, {"m": "state"}),
    }
    known = {f"p_{name}": value for name, value in zip(CHOICES, laws, strict=True)}
    return specialise(_LAYOUT, entries, known=known)


def rig_sources(choice: RigChoice, title: str) -> dict[str, str]:
    """Render the C sources of a rig's unit by file name."""
    text = CText(rig_program(choice), "rig")
    values = [f"p_{symbol}" for symbol in SYMBOLS]
    source = (
        templates()
        .get_template("rig.c.j2")
        .render(title=title, state=text.declare_state(), source=text.render_source(()), values=values)
    )
    return {"rig.c": source}
