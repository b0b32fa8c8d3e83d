"""Roots and minima agree with scipy's, which takes longer to load than a diagnosis to compute."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import betainc, ndtr

from sealscope.diagnosis.estimate.special import find_minimum, find_root

FUNCTIONS = {
    "cubic": (lambda x: x**3 - 2.0, 0.0, 2.0),
    "normal": (lambda x: float(ndtr(x)) - 1e-6, -40.0, 40.0),
    "flat": (lambda x: (x - 0.3) ** 7, -1.0, 5.0),
    "beta": (lambda x: float(betainc(20.0, 0.5, np.exp(-x / 60.0))) - 0.01, 0.0, 1e4),
    "steep": (lambda x: np.expm1(50.0 * (x - 0.99)), -1.0, 1.0),
    "step": (lambda x: -1.0 if x < 0.1 else 1.0, -1.0, 1.0),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("reverse", [False, True])
def test_roots_are_those_of_scipy(name, reverse):
    function, low, high = FUNCTIONS[name]
    calls = []
    root = find_root(lambda x: calls.append(x) or function(x), *((high, low) if reverse else (low, high)))
    if name == "flat":
        assert abs(function(root)) < 1e-15
    else:
        assert root == pytest.approx(brentq(function, low, high, xtol=1e-14), rel=1e-12, abs=1e-13)
    assert len(calls) < 70


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_the_root_of_a_line_is_found_wherever_it_is(root, below, above):
    assert find_root(lambda x: x - root, root - below, root + above) == pytest.approx(root, rel=1e-14, abs=1e-14)


def test_a_root_may_be_an_end():
    assert find_root(lambda x: x, 0.0, 1.0) == 0.0
    assert find_root(lambda x: x - 1.0, 0.0, 1.0) == 1.0


@pytest.mark.parametrize("function", [lambda x: 1.0, lambda x: float("nan"), lambda x: 1e-200 * (1.0 + x)])
def test_without_a_change_of_sign_there_is_no_root(function):
    with pytest.raises(ValueError, match="change its sign"):
        find_root(function, 0.0, 1.0)


@given(st.floats(-0.9, 0.9))
def test_a_minimum_is_found_to_its_tolerance(position):
    found, value = find_minimum(lambda x: abs(x - position) ** 1.5, -1.0, 1.0, 1e-4)
    assert abs(found - position) <= 1e-4
    assert value == abs(found - position) ** 1.5
