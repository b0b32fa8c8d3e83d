"""Two results of an independent program, and a right-hand side written anew from the equations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp


@pytest.mark.parametrize(
    ("throttled", "x", "p_A"), [(False, 0.0234061, 192_441.0), (True, 0.0234119, 193_238.0)], ids=["free", "throttled"]
)
def test_the_independent_results_come_out_with_default_steps(check_rig, drive, throttled, x, p_A):
    run = drive(check_rig(throttled), 20.0 + 1 / 500)
    assert run.t[-1] == 20.0
    assert abs(run["x"][-1] - x) <= 0.5e-7 + 1e-9  # five digits
    assert abs(run["p_A"][-1] - p_A) <= 20.0


def oracle(t: float, y: np.ndarray, throttled: bool, G: float, C: float, metering: str) -> list[float]:
    """dy/dt from eqs. (4.1)-(4.22) in plain Python, with the numbers of Tables 2.1 and 4.1 typed in here."""
    integral, i, w, _theta, _x, v, pa, pb, p1, p2 = y
    if not throttled:
        p1, p2 = pa, pb
    R, L, Ce, Cm, J, B = 0.73, 3.55e-3, 0.6963, 0.6963, 8.74e-4, 4.855e-4
    K, V, V12, A, M, qb = 689e6, 234e-6, 50e-6, 633e-6, 12.3, 4.9e-6
    wd = 26.7 * 3.0 * math.sin(4.0 * t)  # commanded speed
    volts = 1.2 * (wd - w) + 0.1 * integral  # (4.2), (4.3)
    torque = qb * (p1 - p2) / (2 * math.pi)  # (4.6)
    q1 = qb * w / (2 * math.pi)  # (4.1)

    def orifice(dp: float, closed: float) -> float:  # (4.7)-(4.12), regularised
        area = (1 - closed) * math.pi * 0.007**2 / 4
        return 0.92 * area * math.sqrt(2 / 847) * dp / (dp**2 + 2000.0**2) ** 0.25

    if throttled:
        qa = orifice(p1 - pa, 0.0 if p1 > pa else 0.5)
        back = pb > p2  # oil leaves chamber B
        if metering == "literal":
            back = not back
        qb_flow = orifice(pb - p2, 0.5 if back else 0.0)
    else:
        qa = qb_flow = q1
    dp = pa - pb
    ql = G * dp + C * dp / (dp**2 + 2000.0**2) ** 0.25
    fc = 25 + 1e-6 * (pa + pb)  # (4.20)
    if abs(v) > 0.01:  # (4.21)
        f = fc * (1 + 2 * math.exp(-10 * abs(v))) * math.copysign(1, v) + 300 * v
    else:  # (4.22)
        f = v / 0.01 * (fc * (1 + 2 * math.exp(-10 * 0.01)) + 300 * 0.01)
    return [
        wd - w,
        (volts - R * i - Ce * w) / L,  # (4.4)
        (Cm * i - B * w - torque) / J,  # (4.5)
        w,
        v,
        (A * (pa - pb) - f) / M,  # (4.15)
        K / V * (qa - A * v - ql),  # (4.18)
        K / V * (A * v + ql - qb_flow),  # (4.19)
        K / V12 * (q1 - qa) if throttled else 0.0,  # (4.16)
        K / V12 * (qb_flow - q1) if throttled else 0.0,  # (4.17)
    ]


@pytest.mark.parametrize(
    ("throttled", "G", "C", "metering"),
    [
        (False, 0.0, 0.0, "meter-out"),
        (False, 6e-13, 2e-10, "meter-out"),
        (True, 6e-13, 2e-10, "meter-out"),
        (True, 0.0, 0.0, "literal"),
    ],
    ids=["free", "free, leaking", "throttled, leaking", "literal metering"],
)
def test_an_independent_right_hand_side_gives_the_same_run(check_rig, drive, throttled, G, C, metering):
    ours = drive(check_rig(throttled, metering=metering), 2.0, G=G, C=C, step=1e-4)
    start = [0.0] * 6 + [0.25e6] * 4
    theirs = solve_ivp(
        oracle,
        (0.0, float(ours.t[-1])),
        start,
        method="LSODA",
        t_eval=ours.t[::5],
        rtol=1e-9,
        atol=[1e-9, 1e-9, 1e-8, 1e-8, 1e-12, 1e-11, 1e-3, 1e-3, 1e-3, 1e-3],
        args=(throttled, G, C, metering),
    )
    assert theirs.success
    for name, row, tolerance in [
        ("i", 1, 1e-5),
        ("omega", 2, 1e-4),
        ("theta", 3, 1e-5),
        ("x", 4, 1e-9),
        ("v", 5, 1e-6),
    ]:
        np.testing.assert_allclose(ours[name][::5], theirs.y[row], rtol=0, atol=tolerance, err_msg=name)
    for name, row in [("p_A", 6), ("p_B", 7), *([("p_1", 8), ("p_2", 9)] if throttled else [])]:
        np.testing.assert_allclose(ours[name][::5], theirs.y[row], rtol=0, atol=5.0, err_msg=name)
    if not throttled:
        np.testing.assert_allclose(ours["p_1"], ours["p_A"], rtol=1e-12)
        np.testing.assert_allclose(ours["p_2"], ours["p_B"], rtol=1e-12)
