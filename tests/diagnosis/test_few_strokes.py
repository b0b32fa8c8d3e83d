"""A valve's actuator that moves four times in minutes: displacement over area is measured by its strokes alone."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.recordings.recording import Recording

RATE, AREA, DISPLACEMENT = 20.0, 78.5e-4, 1.6e-6  # [Hz], [m^2], [m^3/rev]
#: Times [s] and speeds [rad/s] of the strokes; the load is a spring, the motor is off at other times.
STROKES = ((11.0, 8.0, 157.0), (64.0, 9.0, 157.0), (141.0, 16.0, -157.0), (210.0, 5.0, 157.0))


def record(seed: int) -> Recording:
    """Record the actuator with a late position and a pump that loses 2 % of its flow."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 245.0, 1e-3)
    omega = np.sum([speed * np.clip(np.minimum(t - start, start + length - t) / 0.1, 0.0, 1.0)
                    for start, length, speed in STROKES], axis=0)  # fmt: skip
    flow = DISPLACEMENT / (2.0 * np.pi) * omega * (1.0 - 0.02 * np.sign(omega))
    x = 0.03 + np.cumsum(flow) * 1e-3 / AREA
    late = np.searchsorted(t, np.maximum(t - 0.03, 0.0))
    times = np.sort(np.arange(0.0, 244.0, 1.0 / RATE) + rng.uniform(-0.002, 0.002, int(244.0 * RATE)))
    at = np.searchsorted(t, np.maximum(times, 0.0))
    force = np.interp(t, np.arange(0.0, 246.0, 0.5), 3e4 * rng.standard_normal(492))  # of the flow in the valve
    p_A = 15e5 + 24e6 * x + 3e5 * np.sign(omega) + force
    channels = {
        "x": x[late][at] + 1e-5 * rng.standard_normal(len(at)),
        "omega": omega[at],
        "p_A": p_A[at] + 4e3 * rng.standard_normal(len(at)),
        "p_B": 1.5e5 + 4e3 * rng.standard_normal(len(at)),
    }
    units = {"x": "m", "omega": "rad/s", "p_A": "Pa", "p_B": "Pa"}
    return Recording(t=np.arange(len(at)) / RATE, rate=RATE, channels=channels, units=units)


@pytest.mark.parametrize("seed", range(3))
def test_sizes_that_are_right_are_not_said_to_disagree(seed: int) -> None:
    rig = unstated_rig().with_areas(AREA, AREA, source="sheet")
    balance = VolumeBalance(rig.with_overrides({"pump.q_b": DISPLACEMENT}, source="sheet")).balance(record(seed))
    assert balance is not None and balance.size.ratio is not None
    assert balance.size.ratio.value == pytest.approx(1.0, abs=0.03)
    assert not balance.size.disagrees
