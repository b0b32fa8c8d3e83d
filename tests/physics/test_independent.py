"""Every variant of the rig against other programs' integration of equations written anew.

The right-hand sides are plain Python, with the rigs' numbers typed in; SciPy's LSODA integrates them.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sealscope.parameters import load_rig
from sealscope.physics.standstill import initial_state
from sealscope.physics.state import STATES
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run
from sealscope.simulation.targets_and_loads import parse_force

from ..representatives import SLOW, other


@pytest.mark.parametrize(
    ("throttled", "x", "p_A"), [(False, 0.0234061, 192_441.0), (True, 0.0234119, 193_238.0)], ids=["free", "throttled"]
)
def test_the_independent_results_come_out_with_default_steps(check_rig, drive, throttled, x, p_A):
    run = drive(check_rig(throttled), 20.0 + 1 / 500)
    assert run.t[-1] == 20.0
    assert abs(run["x"][-1] - x) <= 0.5e-7 + 1e-9  # five digits
    assert abs(run["p_A"][-1] - p_A) <= 20.0


def thesis(t, y, throttled, G, C, metering, load=lambda x, v: 0.0):
    """3 sin 4t; eqs. (4.1)-(4.22), Tables 2.1 and 4.1."""
    integral, i, w, _theta, x, v, pa, pb, p1, p2 = y
    if not throttled:
        p1, p2 = pa, pb
    R, L, Ce, Cm, J, B = 0.73, 3.55e-3, 0.6963, 0.6963, 8.74e-4, 4.855e-4
    K, V, V12, A, M, qb = 689e6, 234e-6, 50e-6, 633e-6, 12.3, 4.9e-6
    wd = 26.7 * 3.0 * math.sin(4.0 * t)  # commanded speed
    volts = 1.2 * (wd - w) + 0.1 * integral  # (4.2), (4.3)
    torque = qb * (p1 - p2) / (2 * math.pi)  # (4.6)
    q1 = qb * w / (2 * math.pi)  # (4.1)

    def orifice(dp, closed):  # (4.7)-(4.12), regularised
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
        (A * (pa - pb) - f - load(x, v)) / M,  # (4.15)
        K / V * (qa - A * v - ql),  # (4.18)
        K / V * (A * v + ql - qb_flow),  # (4.19)
        K / V12 * (q1 - qa) if throttled else 0.0,  # (4.16)
        K / V12 * (qb_flow - q1) if throttled else 0.0,  # (4.17)
    ]


def closed_loop(t, y, volts, load, charge, G_check, least):
    """`volts` sin 3t, volumes that move, make-up valves, a leak of 5e-12, oil lost at a rod seal by 2e-13.

    Below the pressure `least` the oil boils: the density, which is the mass in a chamber, goes on, the pressure stays.
    """
    integral, i, w, x, v, qa, qb, fed = y
    pa, pb = max(qa, least), max(qb, least)
    A, K, M, q = 633e-6, 689e6, 12.3, 4.9e-6 / (2 * math.pi)
    VA, VB = 234e-6 + A * x, 234e-6 - A * x
    ps = (charge + 101325) * 0.32e-3 / (0.32e-3 + fed) - 101325
    wd = 100 * math.pi / 30 * volts * math.sin(3.0 * t)
    drive = 1.2 * (wd - w) + 0.1 * integral

    def mass(Q, source, sink):
        return Q * math.exp((source if Q > 0 else sink) / K)

    from_B_to_A, leak = mass(q * w, qb, qa), mass(5e-12 * (pa - pb), qa, qb)
    up_A = mass(G_check * max(ps - pa - 5e3, 0.0), ps, qa)
    up_B = mass(G_check * max(ps - pb - 5e3, 0.0), ps, qb)
    lost = 2e-13 * max(pa, 0.0) * math.exp(qa / K)
    fc = 25 + 1e-6 * (pa + pb)
    if abs(v) > 0.01:
        f = fc * (1 + 2 * math.exp(-10 * abs(v))) * math.copysign(1, v) + 300 * v
    else:
        f = v / 0.01 * (fc * (1 + 2 * math.exp(-10 * 0.01)) + 300 * 0.01)
    return [
        wd - w,
        (drive - 0.73 * i - 0.6963 * w) / 3.55e-3,
        (0.6963 * i - 4.855e-4 * w - q * (pa - pb)) / 8.74e-4,
        v,
        ((pa - pb) * A - f - load) / M,
        K / VA * ((from_B_to_A - leak + up_A - lost) * math.exp(-qa / K) - A * v),
        K / VB * ((leak - from_B_to_A + up_B) * math.exp(-qb / K) + A * v),
        (up_A + up_B) * math.exp(-ps / K),
    ]


def single_rod(t, y, force):
    """5 sin 2t under a load, a leak of 1e-11."""
    integral, i, w, x, v, pa, pb, fed = y
    A, B, K, M, q = 3117.25e-6, 2155.13e-6, 1e9, 100.0, 16e-6 / (2 * math.pi)
    VA, VB = 773.5e-6 + A * x, 773.5e-6 - 192.4e-6 - B * x
    ps = (0.5e6 + 101325) * (2e-3 / (2e-3 + fed)) ** 1.2 - 101325
    wd = 100 * math.pi / 30 * 5.0 * math.sin(2.0 * t)
    volts = 1.2 * (wd - w) + 10 * integral
    dp = pa - pb

    def valve(p, other):
        s = (ps - p + 3 * max(other - ps, 0.0) - 2e4) / 5e4
        return 1e-9 * (ps - p) * min(max(s, 0.0), 1.0)

    def mass(Q, source, sink):
        return Q * math.exp((source if Q > 0 else sink) / K)

    from_B_to_A = mass(q * w - 1e-12 * dp, pb, pa)
    leak = mass(1e-11 * dp, pa, pb)
    up_A, up_B = mass(valve(pa, pb), ps, pa), mass(valve(pb, pa), ps, pb)
    fc = 100 + 5e-5 * (pa + pb)
    if abs(v) > 0.005:
        f = fc * (1 + 0.5 * math.exp(-10 * abs(v))) * math.copysign(1, v) + 2000 * v
    else:
        f = v / 0.005 * (fc * (1 + 0.5 * math.exp(-10 * 0.005)) + 2000 * 0.005)
    return [
        wd - w,
        (volts - 0.73 * i - 0.6963 * w) / 3.55e-3,
        (0.6963 * i - 4.855e-4 * w - q * dp) / 8.74e-4,
        v,
        (pa * A - pb * B - f - force) / M,
        K / VA * ((from_B_to_A - leak + up_A) * math.exp(-pa / K) - A * v),
        K / VB * ((leak - from_B_to_A + up_B) * math.exp(-pb / K) + B * v),
        (up_A + up_B) * math.exp(-ps / K),
    ]


def servo_valve(t, y):
    """2 sin 2t under 1 kN, a leak of 1e-12."""
    integral, i, w, x, v, pa, pb, ps, xs, vs = y
    A, K, V, M, q, pt = 633e-6, 689e6, 234e-6, 12.3, 4.9e-6 / (2 * math.pi), 0.3e6
    wp = 1500 * math.pi / 30
    volts = 1.2 * (wp - w) + 0.1 * integral
    u = 2.0 * math.sin(2.0 * t)
    top = 0.16
    dxs = min(max(vs, -top), top)
    dvs = 942.0**2 * (5e-4 * u / 10.0 - xs) - 2 * 0.8 * 942.0 * vs

    def edge(dp, way):
        return 10e-3 / 60 / math.sqrt(3.5e6) * max(way, 0.0) / 5e-4 * dp / (dp * dp + 5e4**2) ** 0.25

    def mass(Q, source, sink):
        return Q * math.exp((source if Q > 0 else sink) / K)

    pa_in, a_out = mass(edge(ps - pa, xs), ps, pa), mass(edge(pa - pt, -xs), pa, pt)
    pb_in, b_out = mass(edge(ps - pb, -xs), ps, pb), mass(edge(pb - pt, xs), pb, pt)
    leak = mass(1e-12 * (pa - pb), pa, pb)
    pumped = mass(q * w, pt, ps)
    relief = mass(5e-10 * max(ps - pt - 7e6, 0.0), ps, pt)
    gas = 0.32e-3 * ((5e6 + 101325) / (ps + 101325)) ** (1 / 1.2)
    room = (200e-6 + 0.32e-3 - gas) / K + gas / (1.2 * (ps + 101325))
    fc = 25 + 1e-6 * (pa + pb)
    if abs(v) > 0.01:
        f = fc * (1 + 2 * math.exp(-10 * abs(v))) * math.copysign(1, v) + 300 * v
    else:
        f = v / 0.01 * (fc * (1 + 2 * math.exp(-10 * 0.01)) + 300 * 0.01)
    return [
        wp - w,
        (volts - 0.73 * i - 0.6963 * w) / 3.55e-3,
        (0.6963 * i - 4.855e-4 * w - q * (ps - pt)) / 8.74e-4,
        v,
        ((pa - pb) * A - f - 1000.0) / M,
        K / (V + A * x) * ((pa_in - a_out - leak) * math.exp(-pa / K) - A * v),
        K / (V - A * x) * ((pb_in - b_out + leak) * math.exp(-pb / K) + A * v),
        (pumped - relief - pa_in - pb_in) * math.exp(-ps / K) / room,
        dxs,
        dvs,
    ]


def lines_and_losses(t, y):
    """4 sin 3t, a leak of 1e-12, oil that becomes 3 K warmer within 2 s, a line that shuts and opens again.

    Filters that clog (standard blocking) have bypass valves.
    """
    integral, i, w, _, v, pa, pb, p1, p2, *passed = y
    fouled = [(1 - 0.5 * k * V) ** -2 for k, V in zip((4e3, 1e4), passed, strict=True)]
    G_b, p_b = 1e-9, 1.5e5
    T = 313.15 + 3.0 * min(max(t / 2.0, 0.0), 1.0)
    logs = [math.log(math.log(nu + 0.7)) for nu in (32.0, 5.4)]
    nu = math.exp(math.exp(logs[0] - (logs[0] - logs[1]) / math.log(373.15 / 313.15) * math.log(T / 313.15))) - 0.7
    light = 1 - 7e-4 * (T - 313.15)
    mu = nu / 32.0 * light
    K = 689e6 * 10 ** (-0.0024 * (T - 313.15))
    rho, A, V, M, V1, D = 847.0 * light, 633e-6, 234e-6, 12.3, 44e-6, 4.9e-6 / (2 * math.pi)
    shut = 1.0 - min(max(min((t - 1.0) / 0.2, (1.8 - t) / 0.2), 0.0), 1.0)
    circulating = (1.0 - shut) * 1e-9
    wd = 100 * math.pi / 30 * 4.0 * math.sin(3.0 * t)
    dp = p1 - p2
    slip = 2e-5 * D ** (2 / 3) * math.sqrt(2 / rho) * dp / (dp * dp + 2000.0**2) ** 0.25
    Q1 = D * w - slip - (2e-13 + circulating) / mu * dp
    torque = D * dp + min(max(w, -1.0), 1.0) * (0.09 + 0.03 * abs(D * dp)) + 30.0 * rho * D ** (5 / 3) * w * abs(w)

    def line(over, free_in, s, R):
        """Flow of valve, throttle and filter in series under `over` [Pa]."""
        c_line = 0.92 * math.pi / 4 * 7e-3**2 * math.sqrt(2 / rho)
        c = c_line if (over > 0) == free_in else 0.5 * c_line
        c = 0.0 if s <= 0 else 1 / math.sqrt(1 / c**2 + (1 / s**2 - 1) / c_line**2)
        if c == 0.0 or over == 0.0:
            return 0.0, 0.0
        d, step = 0.0, math.inf  # what is left for the orifice, by Newton's method from below: the sum is concave
        while step > 1e-12 * abs(over):
            root = (d * d + 2000.0**2) ** 0.25
            through, steep = R * c * d / root, R
            if through > p_b:
                through, steep = (c * d / root + G_b * p_b) / (1 / R + G_b), 1 / (1 / R + G_b)
            step = (abs(over) - d - through) / (1 + steep * c * (0.5 * d * d + 2000.0**2) / root**5)
            d += step
        Q = c * d / (d * d + 2000.0**2) ** 0.25
        return math.copysign(Q, over), min(Q, (Q + G_b * p_b) / (1 + G_b * R))

    (QA, cleaned_A), (QB, cleaned_B) = (
        line(p1 - pa, True, shut, 2e9 * mu * fouled[0]),
        line(pb - p2, False, 0.3, 5e9 * mu * fouled[1]),
    )
    leak = 1e-12 / mu * (pa - pb)
    fc = 25 + 1e-6 * (pa + pb)
    if abs(v) > 0.01:
        f = fc * (1 + 2 * math.exp(-10 * abs(v))) * math.copysign(1, v) + 300 * mu * v
    else:
        f = v / 0.01 * (fc * (1 + 2 * math.exp(-10 * 0.01)) + 300 * mu * 0.01)
    force = 1e-4 * (1e6 + v * abs(v) * (1e-4 / 1e-7) ** 2)
    return [
        wd - w,
        (1.2 * (wd - w) + 0.1 * integral - 0.73 * i - 0.6963 * w) / 3.55e-3,
        (0.6963 * i - 1e-3 * mu * w - torque) / 8.74e-4,
        v,
        ((pa - pb) * A - f - force) / M,
        K / V * (QA - A * v - leak),
        K / V * (A * v + leak - QB),
        K / V1 * (Q1 - QA),
        K / V1 * (QB - Q1),
        cleaned_A,
        cleaned_B,
    ]


PARTS = {
    **{"orifices": "present", "closed_A": "50 %", "closed_B": "50 %", "p_charge": "2 MPa"},
    **{"T_f": 0.09, "C_f": 0.03, "C_h": 60.0, "C_st": 2e-5, "G_pump": 2e-13, "B_M": 1e-3},
    **{"R_A": 2e9, "R_B": 5e9, "open_B": 0.3, "G_circ": 1e-9},
    **{"A_opp": "100[mm^2]", "p_opp": "1 MPa", "C_opp": 1e-7},
}
CLOGS = {"k_clog_A": 4e3, "k_clog_B": 1e4, "n_clog": 1.5, "p_bypass": 1.5e5, "G_bypass": 1e-9}
OPERATED = (
    "shut-off A to 0 % from 1 s to 1.6 s within 0.2 s",
    "circulation from 1 s to 1.6 s within 0.2 s",
    "oil +3 K growing from 0 s to 2 s",
)
BOILS = {"p_vap": "2 kPa", "p_charge": "0.1 MPa", "F_l": 120.0, "G_check": 1e-13, "G_ext_A": 2e-13}
PUMPED = ("I", "i", "omega", "x", "v", "p_A", "p_B")
LINED = ("I", "i", "omega", "theta", "x", "v", "p_A", "p_B", "p_1", "p_2")

PRESS = (
    "20 N/mm over x - 30 N/mm over x from 4 mm + 0.2 kN/mm over x from 6 mm + 500 N s/m over v + "
    "2 kN s/m over v from 0 m/s"
)


def press(x, v):
    force = 20e3 * x if x < 4e-3 else 80.0 - 10e3 * (x - 4e-3)
    return force + (2e5 * (x - 6e-3) if x > 6e-3 else 0.0) + (2500.0 * v if v > 0 else 500.0 * v)


FREE, THROTTLED = (False, 6e-13, 2e-10, "meter-out"), (True, 6e-13, 2e-10, "meter-out")
#: Rig, its values, right-hand side and its arguments, states of it, volts and rad/s of the command, leak, options.
VARIANTS = {
    "free": ("check", {}, thesis, FREE, LINED, (3.0, 4.0), {"G": 6e-13, "C": 2e-10}),
    "throttled": ("check", {"throttled": True}, thesis, THROTTLED, LINED, (3.0, 4.0), {"G": 6e-13, "C": 2e-10}),
    "free, a load over position and velocity": (
        *("check", {"p_charge": "6 MPa"}, thesis, (*FREE, press), LINED, (3.0, 4.0)),
        {"G": 6e-13, "C": 2e-10, "load": parse_force(PRESS)},
    ),
    "thesis-closed-loop": (
        *("thesis-closed-loop", {"G_ext_A": 2e-13}, closed_loop, (3.0, 0.0, 1e6, 1e-10, -math.inf), (*PUMPED, "V_up")),
        *((3.0, 3.0), {"G": 5e-12}),
    ),
    "thesis-closed-loop, the oil boils": (
        *("thesis-closed-loop", BOILS, closed_loop, (9.0, 120.0, 1e5, 1e-13, 2e3 - 101325), (*PUMPED, "V_up")),
        *((9.0, 3.0), {"G": 5e-12}),
    ),
    "single-rod-eha, one side carries": (
        *("single-rod-eha", {"F_l": 2000.0}, single_rod, (2000.0,), (*PUMPED, "V_up"), (5.0, 2.0)),
        {"G": 1e-11},
    ),
    "single-rod-eha, the carrying side changes": (  # both valves switch within each stroke: at 50 us 270 Pa off
        *("single-rod-eha", {"F_l": 800.0}, single_rod, (800.0,), (*PUMPED, "V_up"), (5.0, 2.0)),
        {"G": 1e-11, "step": 2e-5},
    ),
    "servo-valve": (
        *("servo-valve", {"F_l": 1000.0}, servo_valve, (), (*PUMPED, "p_1", "x_s", "v_s"), (2.0, 2.0)),
        {"G": 1e-12},
    ),
    "lines and losses": (
        *("thesis", {**PARTS, **CLOGS}, lines_and_losses, ()),
        *((*LINED[:3], *LINED[4:], "x_s", "v_s"), (4.0, 3.0), {"G": 1e-12}),
    ),
}
#: Size of a state, by which the other program's tolerance is set.
SIZES = {"omega": 10.0, "x": 1e-3, "v": 1e-2, "V_up": 1e-6, "x_s": 1e-5, "v_s": 1e-2}
SIZES |= dict.fromkeys(("p_A", "p_B", "p_1", "p_2"), 1e4)


#: Variants whose laws another one has, too.
CONTAINED = ("free", "throttled", "single-rod-eha, one side carries")


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", [pytest.param(name, marks=pytest.mark.long) if name in CONTAINED else name for name in VARIANTS]
)
def test_an_independent_program_finds_the_same_over_20_s(check_rig, drive, variant):
    """Within 1e-6 m and 100 Pa rms, with the step that is chosen where none is stated."""
    name, values, theirs, arguments, states, (volts, omega), options = VARIANTS[variant]
    rig = check_rig(**values) if name == "check" else load_rig(name).with_overrides(values)
    if theirs is lines_and_losses:  # valves that move are held for an output; a leak's flow goes with the viscosity
        words = {"command": f"{volts} sin({omega}t)", "leak": "G = 1e-12", "fault": OPERATED, "duration": 20.0}
        experiment = Experiment.of(rig=rig, **words, rate=4000.0, error=5.0)
        run = integrate_run(experiment, experiment.leaks)
    else:
        run = drive(rig, 20.01, u=lambda t: volts * np.sin(omega * t), **options)
    start = initial_state(rig, 0.0)[[STATES.index(state) for state in states]]
    ours = slice(0, None, round(1 / (run.t[1] - run.t[0]) / 100))
    t = run.t[ours]
    atol = 1e-9 * np.array([SIZES.get(state, 1.0) for state in states])
    other = solve_ivp(theirs, (0.0, t[-1]), start, "LSODA", t, args=arguments, rtol=1e-9, atol=atol, max_step=0.02)
    assert other.success
    assert t[-1] >= 20.0
    worst = np.abs(run["x"][ours] - other.y[states.index("x")]).max()
    moved = {state: row for state, row in zip(states, other.y, strict=True) if state[:2] == "p_" and np.ptp(row) > 0}
    least = rig.fluid.p_vap - 101325 if rig.fluid.p_vap > 0 else -np.inf
    off = {state: np.sqrt(np.mean((run[state][ours] - np.maximum(row, least)) ** 2)) for state, row in moved.items()}
    print(f"{variant}: x {worst:.1e} m, " + ", ".join(f"{state} {value:.2g} Pa" for state, value in off.items()))
    assert (min(run["p_A"].min(), run["p_B"].min()) == least) == (values is BOILS)
    assert worst < 1e-6
    assert "p_A" in off
    assert max(off.values()) < 100.0
    assert np.ptp(run["x"]) > 0.002


@pytest.mark.parametrize(
    ("throttled", "G", "C", "metering"),
    [
        other((False, 0.0, 0.0, "meter-out")),
        (False, 6e-13, 2e-10, "meter-out"),
        (True, 6e-13, 2e-10, "meter-out"),
        other((True, 0.0, 0.0, "literal"), SLOW),
    ],
    ids=["free", "free, leaking", "throttled, leaking", "literal metering"],
)
def test_an_independent_right_hand_side_gives_the_same_run(check_rig, drive, throttled, G, C, metering):
    ours = drive(check_rig(throttled, metering=metering), 2.0, G=G, C=C, step=1e-4)
    start = [0.0] * 6 + [0.25e6] * 4
    theirs = solve_ivp(
        thesis,
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
