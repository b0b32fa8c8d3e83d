"""A pump that keeps up a press's pressure until valves shut shows its own leakage in that time."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.circuit.holds.leaks import HeldLeaks
from sealscope.diagnosis.inference.circuit.holds.recorded_hold import find_locked_holds
from sealscope.diagnosis.inference.comparison import RecordingSums, Resistance, held_pump_rise
from sealscope.diagnosis.inference.volumes.recorded import estimate_pump_leakage
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Recording
from sealscope.units import P_ATM

from ..representatives import few

RATE, CYCLE, CYCLES = 100.0, 15.0, 5
AREA, COMPLIANCE, LOADED, CHARGE = 8e-3, 2e-12, 1.2e7, 8e5
PUMP = 2e-12
TIGHT = HeldLeaks(0.0, 1e-16, 0.0, 1e-16, 0.0, 1e-16)


def press(pump: float = PUMP, leak: float = 0.0, seed: int = 0, on_B: bool = False) -> Estimate | None:
    """Record cycles of a press: 3 s of motion, 0.8 s of pressing and holding by the pump, 8 s behind shut valves, back.

    The pump delivers q = (pump + leak) dp + A v + C d(dp)/dt, but for 50 ms in which it stops as the valves shut.
    """
    random = np.random.default_rng(seed)
    t = np.arange(round(CYCLES * CYCLE * RATE)) / RATE
    phase = t % CYCLE
    speed = np.where(phase < 3.0, 0.05, np.where((phase > 12.0) & (phase < 14.5), -0.06, 0.0))
    speed += np.where((phase > 3.0) & (phase < 3.3), 0.004, 0.0) - np.where((phase > 11.7) & (phase < 12.0), 0.004, 0.0)
    x = np.cumsum(speed) / RATE
    pressed = np.clip((phase - 3.0) / 0.3, 0.0, 1.0) * np.clip((12.0 - phase) / 0.3, 0.0, 1.0)
    p_A, p_B = CHARGE + (LOADED - CHARGE) * pressed, np.full_like(t, CHARGE)
    if on_B:
        x, p_A, p_B = -x, p_B, p_A
    difference = p_A - p_B
    flow = (pump + leak) * difference + AREA * np.gradient(x, t) + COMPLIANCE * np.gradient(difference, t)
    shut = (phase > 3.8) & (phase < 11.7)
    flow *= np.clip((3.85 - phase) / 0.05, 0.0, 1.0) * shut + ~shut
    noise = random.standard_normal((4, len(t)))
    channels = {
        "p_A": p_A + 1e4 * noise[0],
        "p_B": p_B + 1e4 * noise[1],
        "x": x + 1e-6 * noise[2],
        "q_pump": flow + 2e-6 * noise[3],
    }
    units = {"p_A": "Pa", "p_B": "Pa", "x": "m", "q_pump": "m^3/s"}
    recording = Recording(t, channels, units, RATE)
    sides = (channels["p_A"] + P_ATM, channels["p_B"] + P_ATM)
    holds = find_locked_holds((t, *sides, channels["x"]), shut[1:] & (phase[1:] > 3.85), RATE)
    assert len(holds) == CYCLES
    side = "outside_B" if on_B else "outside_A"
    pumped = 0.5 * (channels["q_pump"][1:] + channels["q_pump"][:-1]) / RATE
    return estimate_pump_leakage(recording, pumped, holds, TIGHT._replace(**{side: leak}))


@pytest.mark.parametrize(("factor", "leak", "on_B"), few([(1.0, 0.0, False), (3.0, 0.0, True), (1.0, PUMP, True)], 2))
def test_the_pumps_leakage_is_what_holding_takes_but_for_the_leaks_of_the_holds(factor, leak, on_B) -> None:
    found = press(factor * PUMP, leak, on_B=on_B)
    assert found is not None
    assert found.value == pytest.approx(factor * PUMP, rel=0.05)
    assert 0.0 < found.deviation < 0.1 * found.value


@pytest.mark.slow
def test_its_standard_error_is_the_scatter_of_recordings() -> None:
    found = [estimate for seed in range(20) if (estimate := press(seed=seed)) is not None]
    values, deviations = np.array(found).T
    assert 0.4 < values.std() / np.median(deviations) < 2.0


def test_one_hold_tells_nothing() -> None:
    t = np.arange(2000) / RATE
    flat = {name: np.full_like(t, 1e6) for name in ("p_A", "p_B", "x")}
    recording = Recording(t, flat, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, RATE)
    holds = find_locked_holds((t, *(flat[name] for name in ("p_A", "p_B", "x"))), (t > 5.0)[1:], RATE)
    assert len(holds) == 1
    assert estimate_pump_leakage(recording, np.zeros(len(t) - 1), holds, TIGHT) is None


def rise_chance(factor: float, oil: float, *, shows: bool, seed: int = 0) -> float:
    """P-value of a pump `factor` times as leaky, beside six days whose oil changes its leakage by 0.4 (logarithm).

    `oil`: effect of the judged day's oil, as a logarithm; `shows`: whether a viscous drop tells the oil of each day.
    """
    random = np.random.default_rng(seed)
    thinning = np.append(random.normal(0.0, 0.4, 6), oil)
    factors = np.append(np.ones(6), factor)

    def day(number: int) -> RecordingSums:
        level = PUMP * factors[number] * np.exp(thinning[number] + 0.03 * random.standard_normal())
        drop = 1e6 * np.exp(-thinning[number] / INFERENCE.oil.per_drop)
        fit = Resistance(friction=1e5, friction_error=1e3, drop=drop, drop_error=0.02 * drop, top_speed=0.1)
        start_s = 1.7e9 + 86400.0 * number
        return RecordingSums(
            np.zeros((1, 2, 2)), 3e-4, 5e6, start_s, held_pump=np.array([level, 0.02 * level]),
            resistance=np.array(fit) if shows else None,
        )  # fmt: skip

    *healthy, judged = (day(number) for number in range(7))
    rise = held_pump_rise(judged, healthy)
    assert rise is not None
    return rise.chance


def test_a_worn_pump_is_told_from_warm_oil() -> None:
    """Without anything that shows the oil, oil of a sixth of the viscosity may pass for wear, and wear for warm oil."""
    worn, warm = rise_chance(3.0, 0.0, shows=True), rise_chance(1.0, 1.1, shows=True)
    assert worn < 1e-3
    assert warm > 0.05
    assert worn < rise_chance(3.0, 0.0, shows=False) < 0.1
