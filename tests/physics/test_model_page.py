"""The model, written again from the page that states it (docs/explanation/model.md), moves as the compiled one does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sealscope.parameters import Rig, load_rig
from sealscope.physics import rig as compiled

PAGE = Path(__file__).resolve().parents[2] / "docs" / "explanation" / "model.md"


def rates_of_the_page(y: np.ndarray, u: float, G: float, C: float, rig: Rig) -> np.ndarray:
    """dy/dt of a rig with throttles by the page's tables, in its order and notation."""
    I, i, omega, _, x, v, p_A, p_B, p_1, p_2 = y[:10]  # noqa: E741
    m, c, f, line, oil = rig.motor, rig.cylinder, rig.friction, rig.line, rig.fluid
    D = rig.pump.q_b / (2 * np.pi)
    dI = m.omega_per_volt * u - omega
    V = np.clip(m.k_p * dI + m.K_i * I, -m.V_max, m.V_max)
    di = (V - m.R_c * i - m.C_e * omega) / m.L_c
    domega = (m.C_m * i - m.B_M * omega - D * (p_1 - p_2)) / m.J_M
    Q_1 = D * omega - rig.pump.G_pump * (p_1 - p_2)

    def throttle(dp: float, closed: float) -> float:
        coefficient = line.C_d * (1 - closed) * np.pi / 4 * line.d_line**2 * np.sqrt(2 / oil.rho)
        return coefficient * dp / (dp**2 + line.dp_0**2) ** 0.25

    Q_A = throttle(p_1 - p_A, 0.0 if p_1 > p_A else line.closed_A)
    Q_B = throttle(p_B - p_2, 0.0 if p_B < p_2 else line.closed_B)
    dp = p_A - p_B
    Q_L = G * dp + C * dp / (dp**2 + line.dp_0**2) ** 0.25
    Q_eA, Q_eB = c.G_ext_A * max(p_A, 0.0), c.G_ext_B * max(p_B, 0.0)
    F_C = f.F_pr + f.F_cfr * (p_A + p_B)
    if abs(v) > f.v_th:
        F_f = F_C * (1 + (f.K_brk - 1) * np.exp(-f.C_c * abs(v))) * np.sign(v) + f.F_v * v
    else:
        F_f = v / f.v_th * (F_C * (1 + (f.K_brk - 1) * np.exp(-f.C_c * f.v_th)) + f.F_v * f.v_th)
    s = np.sign(x)
    F_stop = -s * max(c.k_stop * (abs(x) - c.L / 2) + c.d_stop * s * v, 0.0) if abs(x) > c.L / 2 else 0.0
    dv = (p_A * c.A_A - p_B * c.A_B - F_f - c.F_l - c.k_load * x - c.d_load * v + F_stop) / c.M_eq
    K = oil.K_oil
    dp_A = K / c.V * (Q_A - c.A_A * v - Q_L - Q_eA)
    dp_B = K / (c.V - c.V_rod) * (-Q_B + c.A_B * v + Q_L - Q_eB)
    dp_1, dp_2 = K / line.V_1 * (Q_1 - Q_A), K / line.V_2 * (Q_B - Q_1)
    return np.array([dI, di, domega, omega, v, dv, dp_A, dp_B, dp_1, dp_2])


@pytest.mark.parametrize("seed", range(20))
def test_the_page_s_equations_are_the_model(seed: int) -> None:
    rig = load_rig("thesis").with_overrides({"orifices": "present", "closed_A": 0.3, "G_ext_A": 1e-14}, source="test")
    numbers = compiled.rig_numbers(rig)
    random = np.random.default_rng(seed)
    scale = [0.1, 5, 20, 3, 0.32, 0.03, 2e5, 2e5, 2e5, 2e5]
    y = np.zeros(14)
    y[:10] = scale * random.uniform(-1, 1, 10)
    y[6:10] += 6e5
    u, G, C = random.uniform(-8, 8), 1e-12, 1e-9
    expected = rates_of_the_page(y, u, G, C, rig)
    assert np.array(compiled.rates(tuple(y), u, G, C, 0.0, numbers))[:10] == pytest.approx(expected, rel=1e-9)


def test_the_page_writes_every_equation_of_the_model() -> None:
    text = PAGE.read_text(encoding="utf-8")
    written = {int(number) for number in re.findall(r"\(4\.(\d+)\)", text)}
    for first, last in re.findall(r"\(4\.(\d+)\) to \(4\.(\d+)\)", text):
        written |= set(range(int(first), int(last) + 1))
    assert written >= set(range(1, 23)) - {13, 14}  # those only name the state and its motion
