"""Kernels as programs: what is written equals the kernel, and what cannot be written is refused with file and line."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess

import numpy as np
import pytest

from sealscope.compiled import record_dtype
from sealscope.emit.c99 import CText
from sealscope.emit.specialise import specialise
from sealscope.errors import InputError
from sealscope.physics.lanes import select

COMPILER = shutil.which("gcc") or shutil.which("cc")
LAYOUT = np.dtype(
    [
        ("n", "i8"),
        *(
            (name, field[0])
            for name, field in record_dtype("a", rows=(3, 4), part=record_dtype("b", v=(4,))).fields.items()
        ),
    ]
)
WEIGHTS = (0.5, -1.25, 2.0, 1e-3)


def total(values, first):
    """Sum some values, weighted."""
    result = 0.0
    for k in range(first, len(values)):
        result += values[k] * WEIGHTS[k]
    return result


def sort_row(values):
    """Sort values in place, by insertion."""
    for k in range(1, len(values)):
        i = k
        while i > 0 and values[i - 1] > values[i]:
            values[i - 1], values[i] = values[i], values[i - 1]
            i -= 1


def halves(x, y):
    """Return two results."""
    if x > y:
        return 0.5 * x, 1.0
    return x - y, -0.5 * y


def turn(pair, angle):
    """Return a pair, and a pair within a tuple."""
    if angle > 0.0:
        return (pair[1], -pair[0]), angle
    return pair, 0.0


def tuples(m, x, y):
    """Use tuples that are assigned anew, nested and indexed by a loop."""
    pair = x, y
    if len(m.absent) > 0:
        return m.missing
    for k in range(3):
        before = pair
        pair, angle = turn(pair, y - k)
        pair = select((angle > 1.0) | (x > y) & (y > 0.0), pair[0], before[1]), math.copysign(pair[1], before[0])
    for k in range(2):
        m.part.v[k] += pair[k]
    return pair[0] + m.scale[1]


def work(m, x, y):
    """Use each construct of the subset."""
    m.a = tuples(m, x, y)
    rows, part = m.rows, m.part
    m.n += 1
    sort_row(rows[int(m.n) % 3])
    for row in range(rows.shape[0]):
        rows[row, 1:3] = x if row % 2 == 0 else y
        m.a += total(rows[row], 1)
    low, high = halves(x, y)
    part.b = max(low, high, m.a) - min(low, 0.0 * y) + (x**3 if x < 2.0 else abs(y) ** 2)
    part.v[:] = 0.0
    for name in (0, 2):
        part.v[name] = math.sqrt(abs(part.b * rows[name, -1])) + (-7 // 2) + (int(x) - 5) % 3
    while True:
        if part.b < 1.0 or not 0.0 <= x < 1e300:
            break
        part.b /= 3.0
    is_odd = m.n % 2 == 1
    m.a = math.log1p(abs(m.a)) if is_odd and m.a > -math.inf else float(is_odd)


class WithSettings:
    """A record beside settings that kernels read as fields."""

    def __init__(self, record, settings):
        self.__dict__.update(settings, record=record)

    def __getattr__(self, name):
        return getattr(self.record, name)

    def __setattr__(self, name, value):
        setattr(self.record, name, value)


def record_as_struct(program):
    """A C structure for the state of a program."""
    kinds = {"real": ctypes.c_double, "whole": ctypes.c_int32}
    fields = [(f.name, kinds[f.kind] * f.size if f.size else kinds[f.kind]) for f in program.fields]
    return type("State", (ctypes.Structure,), {"_fields_": fields})()


def compile_c(program, public, folder, *flags):
    """Compile a program as a shared library, with every warning an error."""
    text = CText(program, "t")
    source = folder / "program.c"
    head = "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n"
    source.write_text(
        "\n".join([head, text.declare_state(), *(text.declare_function(program.function(n)) + ";" for n in public),
                   text.render_source(public)])
    )  # fmt: skip
    warnings = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-Wshadow"]
    command = [COMPILER, *warnings, "-O2", "-ffp-contract=off", *flags, "-shared", "-fPIC", source, "-o"]
    subprocess.run([*map(str, command), str(folder / "program.so"), "-lm"], check=True)
    return ctypes.CDLL(str(folder / "program.so"))


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
def test_a_program_in_c_equals_the_kernel_to_the_bit(tmp_path):
    known = {"absent": (), "scale": (1.0, 0.25)}
    program = specialise(LAYOUT, {"work": (work, {"m": "state", "x": "real", "y": "real"})}, known=known)
    library = compile_c(program, ["work"], tmp_path)
    state, memory = record_as_struct(program), np.zeros(1, LAYOUT).view(np.recarray)
    random, kernel_state = np.random.default_rng(1), WithSettings(memory[0], known)
    for k in range(400):
        x, y = (float(v) for v in random.integers(-40, 41, 2) / 8.0)  # whose powers are exact in any order
        memory.rows[0, 0, 0] = state.rows[0] = random.standard_normal()
        work(kernel_state, x, y)
        library.t_work(ctypes.byref(state), ctypes.c_double(x), ctypes.c_double(y))
        expected = [memory.n[0], memory.a[0], memory.part.b[0], *memory.rows.ravel(), *memory.part.v.ravel()]
        values = [state.n, state.a, state.part_b, *state.rows, *state.part_v]
        assert np.array_equal(expected, values, equal_nan=True), k


def refused(function, **arguments):
    """The message with which a function is refused."""
    with pytest.raises(InputError) as error:
        specialise(LAYOUT, {"entry": (function, {"m": "state", **arguments})})
    return str(error.value)


def test_what_lies_outside_the_subset_is_refused_with_file_and_line():
    def allocates(m):
        m.a = len([1.0])

    def calls_python(m):
        m.a = sorted((2.0, 1.0))[0]

    def calls_in_a_condition(m):
        m.a = 1.0 if m.a > 0.0 and total(m.part.v, 0) > 0.0 else 0.0

    def steps(m):
        for k in range(0, 4, 2):
            m.part.v[k] = 1.0

    def unknown_field(m):
        m.z = 1.0

    def reads_and_changes(m):
        m.a = m.a + changes(m)

    def changes(m):
        m.a += 1.0
        return 2.0

    def uses_before(m):
        if m.a > 0.0:
            m.n = 0
        for k in range(2):
            m.a = early if k else 0.0  # noqa: F821
            early = m.a  # noqa: F841

    def mixed_results(m):
        m.a, m.n = uneven(m.a)

    def uneven(a):
        if a > 0.0:
            return 1.0
        return 1.0, 2

    def formats(m):
        m.a = f"{m.a}"

    def shifts(m):
        m.n = m.n << 1

    def continues(m):
        for _ in range(3):
            continue

    def catches(m):
        try:
            m.a = 1.0
        except ValueError:
            m.a = 2.0

    def slices_by_two(m):
        m.part.v[::2] = 0.0

    def two_targets_of_one(m):
        m.a, m.n = m.part.v

    def real_index(m):
        m.a = m.part.v[m.a]

    def loops_over_an_array(m):
        for value in m.part.v:
            m.a += value

    for function, word in (
        (allocates, "List"),
        (calls_python, "sorted"),
        (calls_in_a_condition, "condition"),
        (steps, "step 1"),
        (unknown_field, "no field z"),
        (reads_and_changes, "beside"),
        (uses_before, "early"),
        (mixed_results, "same number of results"),
        (formats, "JoinedStr"),
        (shifts, "LShift"),
        (continues, "Continue"),
        (catches, "Try"),
        (slices_by_two, "step 1"),
        (two_targets_of_one, "2 targets"),
        (real_index, "whole"),
        (loops_over_an_array, "range"),
    ):
        message = refused(function)
        assert word in message, message
        assert message.startswith("test_specialise.py:"), message
        assert int(message.split(":")[1]) >= function.__code__.co_firstlineno or function is mixed_results
