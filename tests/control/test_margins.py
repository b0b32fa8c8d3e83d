"""Margins of a loop, against the loop itself with its gain turned up."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sealscope.control import FaultTolerant, PositionPI, margins
from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import trajectory

RIG = load_rig("thesis-closed-loop")
PI = PositionPI.of(RIG)


@pytest.mark.parametrize(("share", "grows"), [(0.9, False), (1.1, True)])
def test_the_gain_margin_is_where_the_loop_begins_to_swing(share, grows):
    """At standstill, by an encoder of fine counts; the speed stays within the linear part of the friction."""
    factor = share * margins(RIG, PI).gain
    louder = replace(PI, k_v=factor * PI.k_v, k_i=factor * PI.k_i, dead_band=0.0)
    experiment = Experiment.of(
        rig=RIG, command="position step 0.002 mm at 0.1 s", duration=3.0, controller=louder,
        set={"sensors.x.resolution": "1e-9[m]"},
    )  # fmt: skip
    run = trajectory(experiment, (), step=1e-4)
    late = np.ptp(run["x"][run.t > 2.0])
    assert late > 20e-6 if grows else late < 0.2e-6


@dataclass(frozen=True)
class Late:
    """A controller, some samples later."""

    inner: PositionPI
    delay: int

    @property
    def rate(self):
        return self.inner.rate

    def start(self):
        return self.inner.start()


def test_a_delay_within_the_margin_takes_its_share_of_the_phase():
    m = margins(RIG, PI)
    samples = 10
    later = margins(RIG, Late(PI, PI.delay + samples))
    assert m.phase - later.phase == pytest.approx(2.0 * math.pi * m.crossover * samples / PI.rate, rel=1e-3)
    assert m.delay - later.delay == pytest.approx(samples / PI.rate, rel=1e-3)


@pytest.mark.slow
def test_tolerance_costs_no_margin_without_a_leak_and_little_with_one():
    assert margins(RIG, FaultTolerant.of(RIG), 0.02) == margins(RIG, PI, 0.02)
    with_one = margins(RIG, FaultTolerant.of(RIG, known=2.6e-12), 0.02)
    assert with_one.phase > math.radians(45.0)
    assert with_one.gain > 2.0


def test_a_speed_beyond_the_drive_is_refused():
    with pytest.raises(InputError, match="speed must be one that the drive can give, got 5 m/s"):
        margins(RIG, PI, 5.0)
