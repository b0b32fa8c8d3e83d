"""The orifice law and the scalar equation that an implicit stage solves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from sealscope.physics.restrictors import implicit_orifice_flow, one_way_flow, orifice_coefficient, orifice_flow

decades = st.floats(-12.0, 0.0).map(lambda e: 10.0**e)


def flow(dp: float, c: float, dp_0: float) -> float:
    return c * dp / (dp * dp + dp_0 * dp_0) ** 0.25


@settings(deadline=None)
@given(dp=st.floats(-1e8, 1e8), c=decades, dp_0=st.floats(1.0, 1e6))
def test_the_law_is_odd_and_never_above_its_two_limits(dp, c, dp_0):
    q = orifice_flow(dp, c, dp_0)
    assert q == -orifice_flow(-dp, c, dp_0)
    assert abs(q) <= c * math.sqrt(abs(dp)) * (1 + 1e-12) + 5e-324
    assert abs(q) <= c * abs(dp) / math.sqrt(dp_0) * (1 + 1e-12) + 5e-324
    assert q * dp >= 0


def test_the_law_is_turbulent_far_above_and_laminar_far_below_its_corner():
    c, dp_0 = 1.7e-6, 2000.0
    assert orifice_flow(2e7, c, dp_0) == pytest.approx(c * math.sqrt(2e7), rel=1e-7)
    assert orifice_flow(0.2, c, dp_0) == pytest.approx(c * 0.2 / math.sqrt(dp_0), rel=1e-7)
    assert orifice_flow(dp_0, c, dp_0) == pytest.approx(c * math.sqrt(dp_0) / 2**0.25, rel=1e-14)


def test_the_coefficient_is_that_of_a_sharp_edged_orifice():
    # 7 mm bore, C_d 0.92, 847 kg/m^3: 0.1 MPa drives 0.5441 L/s
    area = math.pi / 4 * 0.007**2
    assert orifice_coefficient(0.92, area, 847.0) * math.sqrt(1e5) == pytest.approx(5.4408e-4, rel=1e-4)


def test_a_one_way_throttle_has_a_coefficient_for_each_direction():
    assert one_way_flow(1e5, 2e-6, 1e-6, 2000.0) == orifice_flow(1e5, 2e-6, 2000.0)
    assert one_way_flow(-1e5, 2e-6, 1e-6, 2000.0) == orifice_flow(-1e5, 1e-6, 2000.0)


@settings(max_examples=100, deadline=None)
@given(
    total=st.floats(-1e8, 1e8).filter(lambda total: abs(total) > 1e-100),
    g=st.floats(-3.0, 14.0).map(lambda e: 10.0**e),
    c_forward=st.floats(-10.0, -3.0).map(lambda e: 10.0**e),
    c_reverse=st.floats(-10.0, -3.0).map(lambda e: 10.0**e),
    dp_0=st.floats(0.0, 6.0).map(lambda e: 10.0**e),
)
@example(total=0.0, g=4.6e9, c_forward=1.7e-6, c_reverse=8e-7, dp_0=2000.0)
@example(total=2000.0, g=4.6e9, c_forward=1.7e-6, c_reverse=8e-7, dp_0=2000.0)
@example(total=3436928.1, g=3.9226353e8, c_forward=1e-3, c_reverse=1e-3, dp_0=76.8)
@example(total=1e8, g=1e14, c_forward=1e-3, c_reverse=1e-3, dp_0=1.0)
@example(total=-1e-9, g=1e14, c_forward=1e-3, c_reverse=1e-3, dp_0=1.0)
def test_the_implicit_flow_is_that_of_the_root_that_brentq_finds(total, g, c_forward, c_reverse, dp_0):
    c = c_forward if total > 0 else c_reverse
    result = implicit_orifice_flow(total, g, c_forward, c_reverse, dp_0)
    # in d = dp_0 sinh(s) the root is well scaled whatever the decade
    size = abs(total)

    def residual(s: float) -> float:
        d = dp_0 * math.sinh(s)
        return d + g * flow(d, c, dp_0) - size

    s = 0.0
    if size > 0:
        s = brentq(residual, 0.0, 1.001 * math.asinh(size / dp_0), xtol=1e-300, rtol=8.9e-16, maxiter=1000)
    expected = flow(math.copysign(dp_0 * math.sinh(s), total), c, dp_0)
    assert result == pytest.approx(expected, rel=1e-10, abs=2e-12 * c / math.sqrt(dp_0))


def test_without_coupling_the_flow_is_that_of_the_whole_difference():
    for total in (-3e5, 0.0, 12.5):
        expected = orifice_flow(total, 1e-6, 2000.0)
        assert implicit_orifice_flow(total, 0.0, 1e-6, 1e-6, 2000.0) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("dp_0", [1.0, 2000.0])
def test_the_flow_grows_with_the_total(dp_0):
    totals = np.r_[-np.logspace(8, -6, 200), np.logspace(-6, 8, 200)]
    flows = np.array([implicit_orifice_flow(total, 4.6e9, 1.7e-6, 4e-7, dp_0) for total in totals])
    assert np.all(np.diff(flows) > 0)
