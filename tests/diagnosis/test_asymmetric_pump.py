"""A clamp whose two pumps on one shaft feed the two areas of its piston: recognised, and its leaks have the right size.

The recordings follow from the volumes of the loaded chamber in closed form, so that the expected numbers do not come
from a simulator or from the detector.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope import diagnose
from sealscope.diagnosis.assumed_rig import infer_rig, recognise_circuit
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording

RATE = 100.0  # [Hz]
AREA_A, AREA_B = 120e-4, 60e-4  # [m^2]
DISPLACEMENT_A, DISPLACEMENT_B = 32e-6, 16e-6  # [m^3/rev]
COMPRESSIBILITY, STIFFNESS = 9e-10, 5e7  # [1/Pa] of oil and walls, [N/m] of the clamped part
PUMP_LEAKAGE = 1.5e-12  # [m^3/(s Pa)]
LPM = 1e-3 / 60.0
#: Phases of a cycle: duration [s], position [m] and p_A - p_B [bar] at its end; None: the part is clamped.
CYCLE = ((3.0, 0.17, -9.0), (0.5, 0.17, 0.0), (1.0, None, 150.0), (4.0, None, 150.0), (1.0, 0.17, 0.0),
         (0.5, 0.17, -9.0), (3.0, 0.0, -9.0), (2.0, 0.0, -9.0))  # fmt: skip


def clamp(seed: int, *, leak: float = 0.0, onset: float = np.inf, is_asymmetric: bool = True) -> Recording:
    """Record eight cycles with a leak past the piston of the conductance `leak` [m^3/(s Pa)] from `onset` [s].

    Unless `is_asymmetric`, one pump moves the area of the loaded side.
    """
    rng = np.random.default_rng(seed)
    times, positions, pressures = [0.0], [0.0], [-9.0]
    force = 1e5 * (1.0 + 0.2 * rng.standard_normal())  # Pa per bar of the cycle
    for _ in range(8):
        for duration, position, pressure in CYCLE:
            times.append(times[-1] + duration * (1.0 + 0.1 * rng.standard_normal()))
            pressures.append(pressure)
            positions.append(0.17 + AREA_A * force * pressure / STIFFNESS if position is None else position)
    t = np.arange(0.0, times[-1], 1.0 / RATE)
    smooth = np.hanning(21) / np.hanning(21).sum()

    def course(ends: list[float]) -> np.ndarray:
        padded = np.pad(np.interp(t, times, ends), 10, mode="edge")
        return np.convolve(padded, smooth, mode="valid")

    x, difference = course(positions), force * course(pressures)
    by_A = difference > 0.0
    p_A, p_B = 3e5 + np.maximum(difference, 0.0), 3e5 + np.maximum(-difference, 0.0)
    speed, rise = np.gradient(x, 1.0 / RATE), np.gradient(difference, 1.0 / RATE)
    volume = np.where(by_A, AREA_A * (0.1 + x), AREA_B * (0.3 - x))
    conductance = PUMP_LEAKAGE * (1.0 + 0.03 * rng.standard_normal()) + leak * (t >= onset)
    flow = np.where(by_A, AREA_A, AREA_B) * speed + COMPRESSIBILITY * volume * rise + conductance * difference
    displacement = np.where(by_A & is_asymmetric, DISPLACEMENT_A, DISPLACEMENT_B)
    channels = {
        "x": x + 3e-6 * rng.standard_normal(len(t)),
        "omega": 2.0 * np.pi * flow / displacement + 0.05 * rng.standard_normal(len(t)),
        "p_A": p_A + 1e4 * rng.standard_normal(len(t)),
        "p_B": p_B + 1e4 * rng.standard_normal(len(t)),
    }
    return Recording(t=t, rate=RATE, channels=channels, units={"x": "m", "omega": "rad/s", "p_A": "Pa", "p_B": "Pa"})


def stated(displacement: float | None = None) -> Rig:
    rig = unstated_rig().with_areas(AREA_A, AREA_B, source="nameplate")
    return rig if displacement is None else rig.with_overrides({"pump.q_b": displacement}, source="nameplate")


@pytest.mark.parametrize("is_asymmetric", [True, False])
def test_flows_per_speed_under_both_loads_tell_an_asymmetric_pump(is_asymmetric: bool) -> None:
    recordings = [clamp(seed, is_asymmetric=is_asymmetric) for seed in range(3)]
    assert recognise_circuit(stated(), recordings) == ("asymmetric" if is_asymmetric else "closed")


def test_a_speed_without_a_sign_shows_no_asymmetric_pump() -> None:
    """Neither where the motion restores its sign, nor where a pump at constant speed runs on behind a valve."""
    signed = [clamp(seed, is_asymmetric=False) for seed in range(3)]
    unsigned = [replace(part, channels={**part.channels, "omega": np.abs(part["omega"])}) for part in signed]
    assert recognise_circuit(stated(), unsigned) == "closed"
    random = np.random.default_rng(1)
    constant = [150.0 + random.standard_normal(len(part)) for part in signed]
    running = [
        replace(part, channels={**part.channels, "omega": omega}) for part, omega in zip(signed, constant, strict=True)
    ]
    assert recognise_circuit(stated(), running) != "asymmetric"


@pytest.mark.parametrize("displacement", [None, DISPLACEMENT_A, DISPLACEMENT_B])
def test_a_leak_has_its_size_whichever_displacement_is_stated(displacement: float | None) -> None:
    healthy = [clamp(seed) for seed in range(4)]
    rig = infer_rig(stated(displacement), healthy)
    leaking = clamp(9, leak=3e-13, onset=50.0)
    is_late = leaking.t >= 50.0
    flow = 3e-13 * float(np.mean(np.abs(leaking["p_A"] - leaking["p_B"])[is_late])) / LPM  # [L/min]
    diagnosis = diagnose(leaking, rig=rig, baseline=healthy)
    assert diagnosis.verdict == "leak"
    assert diagnosis.leak_lpm == pytest.approx(flow, rel=0.1)
    assert "displacement over area" not in diagnosis.reason
