"""Lanes: each operation against the same on plain numbers, the exponential, and sixteen runs against one."""

from __future__ import annotations

import math
import re

import llvmlite.binding
import numba
import numpy as np
import pytest

from sealscope.compiled import contracted, kernel
from sealscope.physics.friction import stribeck_force
from sealscope.physics.lanes import WIDTH, exponential, load, power_of_two, select, store
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.rig import CHOICES, NUMBERS, rig_numbers


@contracted
def every_operation(x, y):
    z = (x + y) * (x - y) / (2.0 + abs(y)) + 1.5 * x - y / 3.0 + -x
    z = select((x > 0.3) & (y <= 1.0) | (x < -1.0), z, select(y >= 2.5, y, -z))
    z = min(max(z, -4.0), x + 4.0)
    return z * power_of_two(3.0 + 0.0 * x) + exponential(x)


@kernel
def in_lanes(x, y, out):
    for row in range(x.shape[0]):
        store(out, row, every_operation(load(x, row), load(y, row)))


@kernel
def in_numbers(x, y, out):
    for row in range(x.shape[0]):
        for lane in range(x.shape[1]):
            out[row, lane] = every_operation(x[row, lane], y[row, lane])


def test_every_operation_does_on_lanes_what_it_does_on_numbers_to_six_digits():
    x, y = np.random.default_rng(2).normal(0.0, 1.5, (2, 200, WIDTH)).astype(np.float32)
    x[0, :4] = -60.0, -200.0, 60.0, 200.0  # far ends of the exponential: 0 and the largest power of two
    singles, numbers = np.empty_like(x), np.empty(x.shape)
    in_lanes(x, y, singles)
    in_numbers(x.astype(np.float64), y.astype(np.float64), numbers)
    assert 1e38 < singles[0, 3] < np.inf
    numbers[0, 3] = singles[0, 3]
    # a difference of terms is as exact as its largest term
    np.testing.assert_allclose(singles, numbers, rtol=4e-6, atol=4e-5)
    assert np.ptp(singles[1:]) > 10.0


@kernel
def add_a_whole_number(out):
    store(out, 1, load(out, 0) + 1)


def test_whole_numbers_may_stand_beside_lanes():
    out = np.arange(2 * WIDTH, dtype=np.float32).reshape(2, WIDTH)
    add_a_whole_number(out)
    np.testing.assert_array_equal(out[1], out[0] + 1)


@kernel
def exponentials(x, out):
    for k in range(x.size):
        out[k] = exponential(x[k])


def test_the_exponential_is_within_1e_13_of_the_library_s():
    rng = np.random.default_rng(2)
    x = np.r_[rng.uniform(-708.0, 709.0, 40_000), rng.uniform(-5.0, 0.0, 40_000), np.linspace(-1e-3, 1e-3, 2000)]
    x = np.r_[x, 0.0, -0.0, 0.5 * math.log(2), -0.5 * math.log(2), -708.0, 709.0, -1e9]
    out = np.empty_like(x)
    exponentials(x, out)
    truth = np.array([math.exp(value) for value in x[:-1]])
    assert np.abs(out[:-1] / truth - 1.0).max() < 1e-13
    assert 0.0 < out[-1] < 1e-300  # held, not infinite, not negative
    assert exponential.py_func(-1.25) == pytest.approx(math.exp(-1.25), rel=1e-13)


@contracted
def laws(x, y):
    friction = stribeck_force(0.03 * abs(x), 25.0 + y * y, 3.0, 10.0)
    shaft = shaft_acceleration(x, 10.0 * y, 0.1 * x, 0.7, 1e-3, 2e-3)
    voltage = controller_voltage(x, y, 60.0, 30.0, 100.0)
    return friction + 0.1 * shaft + winding_current_rate(voltage, 23.0 * y, 5.0, 0.7, 0.4, 0.7, 23.0)


@kernel
def laws_in_lanes(x, y, out):
    for row in range(x.shape[0]):
        store(out, row, laws(load(x, row), load(y, row)))


def test_the_laws_are_the_same_on_lanes_and_on_numbers():
    x, y = np.random.default_rng(3).normal(0.0, 1.0, (2, 300, WIDTH)).astype(np.float32)
    out = np.empty_like(x)
    laws_in_lanes(x, y, out)
    expected = [laws(float(a), float(b)) for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    np.testing.assert_allclose(out.ravel(), expected, rtol=1e-4, atol=1e-3)


def test_the_machine_code_works_on_whole_registers():
    """The sums and products of the laws are packed ones, on the longest registers that the processor has."""
    code = numba.njit(error_model="numpy")(laws_in_lanes.py_func)  # compiled here: a cached one has no text
    code(*np.ones((3, 4, WIDTH), dtype=np.float32))
    text = next(iter(code.inspect_asm().values()))
    if "ps\t" not in text and "ps " not in text:
        pytest.skip("no packed arithmetic of x86 on this processor")
    operations = r"\bv?(?:add|mul|sub|div|sqrt|fn?m(?:add|sub)\d+)"
    packed, single = len(re.findall(operations + "ps", text)), len(re.findall(operations + "ss", text))
    assert packed > 30
    assert single < 0.1 * packed
    features = llvmlite.binding.get_host_cpu_features()
    if features.get("avx512f"):
        assert len(re.findall(operations + r"ps.*%zmm", text)) > 0.9 * packed


def test_a_parameter_is_listed_once_and_every_list_of_numbers_follows(check_rig):
    """The models declare the parameters; the laws' numbers are theirs, but for those that are within others."""
    rig = check_rig(True)
    numbers = rig_numbers(rig)
    symbols = {row.symbol: row.value for row in rig.table() if not row.name.startswith(("sensors.", "daq."))}
    within = {"omega_max", "C_d", "d_line", "closed_A", "closed_B", "rho", "V_hose_A", "V_hose_B", "V_rod"}
    within |= {"nu_40", "nu_100", "T_oil", "alpha", "C_st", "C_h", "G_circ", "open_A", "open_B"}
    taken = {symbol for symbol, value in symbols.items() if isinstance(value, float)} - within
    assert set(NUMBERS) - taken == {"c_A_in", "c_A_out", "c_B_in", "c_B_out", "V_A", "V_B", "c_slip", "k_h"}
    assert all(getattr(numbers, symbol) == symbols[symbol] for symbol in taken)
    assert len(numbers) == len(NUMBERS) + len(CHOICES)
