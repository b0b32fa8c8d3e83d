"""The laws of a rig in C against the same laws, run by Python."""

from __future__ import annotations

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

from sealscope.emit.c99 import CText
from sealscope.fmu.machine import RigChoice, rig_program
from sealscope.fmu.variables import INPUTS
from sealscope.parameters import load_rig
from sealscope.physics.rig import VALUES, observe, parameter_values, rig_numbers
from sealscope.physics.solvers.imex import imex_step
from sealscope.physics.solvers.rk4 import rk4_step
from sealscope.physics.standstill import stand_still, standstill_force
from sealscope.physics.state import OUTPUTS, STATES, state_of

COMPILER = shutil.which("gcc") or shutil.which("cc")
LINES = {"orifices": "present", "closed_A": 0.4, "closed_B": 0.2, "p_charge": "2 MPa"}
#: Rig and values of each variant; together they have every law of a pump-controlled rig.
VARIANTS = {
    "thesis": ("thesis", {}),
    "lines": ("thesis", LINES),
    "air that boils": ("thesis", {**LINES, "air": 0.01, "p_vap": 3000.0, "volumes": "position", "balance": "mass"}),
    "filters": (
        "thesis",
        {**LINES, "R_A": 1e9, "R_B": 4e9, "k_clog_A": 1e3, "n_clog": 1.5, "p_bypass": 5e4, "G_bypass": 1e-10},
    ),
    "losses": (
        "thesis",
        {"T_f": 0.09, "C_f": 0.03, "C_h": 60.0, "C_st": 2e-5, "A_opp": "100[mm^2]", "p_opp": "1 MPa", "C_opp": 1e-7},
    ),
    "bristles": ("thesis", {"friction.law": "lugre", "v_th": 0.002, "sigma_0": 2e5, "sigma_1": 800.0}),
    "sticking": ("thesis", {"friction.law": "karnopp", "backward": 1.3}),
    "literal": ("thesis", {"bracket": "literal", "coulomb_pressure": "difference", "integrator": "euler"}),
    "single rod": ("single-rod-eha", {"n_gas": 1.3, "d_load": 400.0}),
}


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
@pytest.mark.parametrize(
    "variant", [name if name in ("thesis", "air that boils") else pytest.param(name, marks=pytest.mark.slow)
                for name in VARIANTS]
)  # fmt: skip
def test_the_laws_in_c_equal_those_in_python(variant, tmp_path):
    """Standstill, ten steps of the solver and the outputs, from states and inputs at random."""
    name, values = VARIANTS[variant]
    rig = load_rig(name).with_overrides(values)
    choice = RigChoice.from_rig(rig)
    text, program = CText(rig_program(choice), "rig"), rig_program(choice)
    source = tmp_path / "rig.c"
    head = "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n"
    entries = ("start", "advance", "report")
    declared = [text.declare_function(program.function(entry)) + ";" for entry in entries]
    source.write_text("\n".join([head, text.declare_state(), *declared, text.render_source(entries)]))
    warnings = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-Wshadow"]
    library_path = tmp_path / "rig.so"
    command = [COMPILER, "-std=c99", "-O1", "-ffp-contract=off", *warnings, "-shared", "-fPIC", source, "-o"]
    subprocess.run([*map(str, command), str(library_path), "-lm"], check=True)
    library = ctypes.CDLL(str(library_path))
    fields = [(f.name, ctypes.c_double * f.size if f.size else ctypes.c_double) for f in program.fields]
    state = type("State", (ctypes.Structure,), {"_fields_": fields})()
    random, numbers = np.random.default_rng(2), rig_numbers(rig)._replace(open_circuit=(True,), pushed=(True,))

    def fill(inputs):
        for symbol, value in zip(VALUES, parameter_values(rig), strict=True):
            setattr(state, f"p_{symbol}", value)
        state.inputs[:] = inputs

    for _ in range(10):
        inputs = random.uniform(-1.0, 1.0, len(INPUTS)) * (5.0, 1e-12, 1e-9, 50.0, 0.0, 0.0)
        slopes = inputs * random.uniform(-3.0, 3.0, len(INPUTS))
        inputs[1:3], slopes[4:] = abs(inputs[1:3]), 0.0
        position, span, steps = 0.02 * random.standard_normal(), 2e-3, 10
        fill(inputs)
        code = library.rig_start(ctypes.byref(state), ctypes.c_double(position))
        y = np.zeros(len(STATES))
        assert code == stand_still(y, position, standstill_force(position, numbers) + inputs[3], numbers)
        assert np.array_equal(state.y, y)
        y[:6] += random.standard_normal(6) * (1.0, 2.0, 20.0, 1.0, 0.01, 0.03)
        y[6:10] += 3e5 * random.standard_normal(4)
        state.y[:] = y
        z, h = state_of(y), span / steps

        def at(k, nodes, index, inputs=inputs, slopes=slopes, h=h):
            return tuple(inputs[index] + slopes[index] * (k * h + node * h) for node in nodes)

        for k in range(steps):
            nodes = (0.0, 1 / 2, 83 / 250, 31 / 50, 17 / 20, 1.0) if choice.implicit else (0.0, 0.5, 1.0)
            arguments = z, h, *(at(k, nodes, index) for index in range(4)), numbers
            z = imex_step(*arguments) if choice.implicit else rk4_step(*arguments, choice.euler)
        fill(inputs)
        state.slopes[:] = slopes
        code = library.rig_advance(ctypes.byref(state), ctypes.c_double(span), ctypes.c_int32(steps))
        assert code in (0, 2)
        assert np.array(state.y) == pytest.approx(np.array(z), rel=1e-10, abs=1e-15)
        expected = np.zeros(len(OUTPUTS))
        observe(z, *inputs[:3], numbers, expected)
        state.y[:] = z
        fill(inputs)
        library.rig_report(ctypes.byref(state))
        assert np.array(state.results[: len(OUTPUTS)]) == pytest.approx(expected, rel=1e-12, abs=1e-20)


def test_the_variants_have_every_law():
    """But that of a servo valve, which no unit has."""
    laws = np.array([[bool(law) for law in RigChoice.from_rig(load_rig(name).with_overrides(values)).laws]
                     for name, values in VARIANTS.values()])  # fmt: skip
    from sealscope.physics.rig import CHOICES

    assert {name for name, has in zip(CHOICES, laws.any(axis=0), strict=True) if not has} == {"valved"}
