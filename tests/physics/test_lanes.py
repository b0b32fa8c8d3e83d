"""Lanes: each operation against the same on plain numbers, the own exponential, and eight runs against one."""

from __future__ import annotations

import math
import re

import llvmlite.binding
import numba
import numpy as np
import pytest

from sealscope.compiled import contracted, kernel
from sealscope.physics.friction import stribeck_friction
from sealscope.physics.lanes import (
    SINGLE_WIDTH,
    WIDTH,
    any_lane,
    broadcast,
    exponential,
    load,
    power_of_two,
    select,
    store,
)
from sealscope.physics.motor import winding_current_rate
from sealscope.physics.restrictors import implicit_orifice_flow, orifice_flow
from sealscope.physics.rig import CHOICES, NUMBERS, rig_numbers


@contracted
def every_operation(x, y):
    z = (x + y) * (x - y) / (2.0 + abs(y)) + 1.5 * x - y / 3.0 + -x
    z = select((x > 0.3) & (y <= 1.0) | (x < -1.0), z, math.copysign(z, y))
    z = min(max(z, -4.0), x + 4.0) + math.sqrt(abs(x)) + math.pow(abs(x), 0.7)
    if any_lane(y >= 2.5):
        z = z + 1.0
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


def test_every_operation_does_on_lanes_what_it_does_on_numbers():
    x, y = np.random.default_rng(1).normal(0.0, 1.5, (2, 400, WIDTH))
    y = np.where(np.any(y >= 2.5, axis=1, keepdims=True), np.maximum(y, 2.5), y)  # `any_lane` asks all lanes
    lanes, numbers = np.empty_like(x), np.empty_like(x)
    in_lanes(x, y, lanes)
    in_numbers(x, y, numbers)
    np.testing.assert_allclose(lanes, numbers, rtol=1e-13, atol=1e-13)
    assert np.ptp(lanes) > 10.0


def test_lanes_of_single_precision_do_the_same_to_six_digits():
    x, y = np.random.default_rng(2).normal(0.0, 1.5, (2, 200, SINGLE_WIDTH)).astype(np.float32)
    y = np.where(np.any(y >= 2.5, axis=1, keepdims=True), np.maximum(y, np.float32(2.5)), y)
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
def spread_out(value, out):
    store(out, 0, broadcast(value))
    store(out, 1, load(out, 0) + 1)


def test_a_number_spreads_to_every_lane_and_whole_numbers_may_stand_beside_lanes():
    out = np.zeros((2, WIDTH))
    spread_out(2.5, out)
    np.testing.assert_array_equal(out, [[2.5] * WIDTH, [3.5] * WIDTH])


@kernel
def exponentials(x, out):
    for row in range(x.shape[0]):
        store(out, row, exponential(load(x, row)))


def test_the_exponential_is_within_1e_13_of_the_library_s():
    rng = np.random.default_rng(2)
    x = np.r_[rng.uniform(-708.0, 709.0, 40_000), rng.uniform(-5.0, 0.0, 40_000), np.linspace(-1e-3, 1e-3, 2000)]
    x = np.r_[x, 0.0, -0.0, 0.5 * math.log(2), -0.5 * math.log(2), -708.0, 709.0].tolist()
    x = np.array(x + [0.0] * (-len(x) % WIDTH)).reshape(-1, WIDTH)
    out = np.empty_like(x)
    exponentials(x, out)
    truth = np.array([math.exp(value) for value in x.ravel()]).reshape(x.shape)
    assert np.abs(out / truth - 1.0).max() < 1e-13
    assert np.abs([exponential(v) / math.exp(v) - 1.0 for v in x.ravel()[:200]]).max() < 1e-13
    exponentials(np.full((1, WIDTH), -1e9), out[:1])
    assert np.all(out[0] < 1e-300)  # held, not infinite, not negative
    assert exponential.py_func(-1.25) == pytest.approx(math.exp(-1.25), rel=1e-13)


@contracted
def laws(x, y):
    friction = stribeck_friction(0.03 * x, 25.0 + y * y, 3.0, 10.0, 300.0, 0.01, False)
    literal = stribeck_friction(0.03 * x, 25.0 + y * y, 3.0, 10.0, 300.0, 0.01, True)
    flow = orifice_flow(1e4 * x, 1.7e-6, 2000.0) + implicit_orifice_flow(1e5 * y, 4e9, 1.7e-6, 8e-7, 2000.0)
    return friction + literal + 1e6 * flow + winding_current_rate(100.0 * x, 23.0 * y, 5.0, 0.7, 4e-3, 0.7, 23.0)


@kernel
def laws_in_lanes(x, y, out):
    for row in range(x.shape[0]):
        store(out, row, laws(load(x, row), load(y, row)))


def test_the_laws_are_the_same_on_lanes_and_on_numbers():
    x, y = np.random.default_rng(3).normal(0.0, 1.0, (2, 300, WIDTH))
    out = np.empty_like(x)
    laws_in_lanes(x, y, out)
    one_by_one = np.array([[laws(a, b) for a, b in zip(*rows, strict=True)] for rows in zip(x, y, strict=True)])
    np.testing.assert_allclose(out, one_by_one, rtol=1e-10)


def test_the_machine_code_works_on_whole_registers():
    """The sums and products of the laws are packed ones, on the longest registers that the processor has."""
    code = numba.njit(error_model="numpy")(laws_in_lanes.py_func)  # compiled here: a cached one has no text
    code(*np.ones((3, 4, WIDTH)))
    text = next(iter(code.inspect_asm().values()))
    if "pd\t" not in text and "pd " not in text:
        pytest.skip("no packed arithmetic of x86 on this processor")
    operations = r"\bv?(?:add|mul|sub|div|sqrt|fn?m(?:add|sub)\d+)"
    packed, single = len(re.findall(operations + "pd", text)), len(re.findall(operations + "sd", text))
    assert packed > 100
    assert single < 0.1 * packed
    features = llvmlite.binding.get_host_cpu_features()
    if features.get("avx512f"):
        assert len(re.findall(operations + r"pd.*%zmm", text)) > 0.9 * packed


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
