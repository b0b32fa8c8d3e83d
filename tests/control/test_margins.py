"""Margins of a loop, against the loop itself with its gain turned up."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sealscope.control import FaultTolerant, PositionPI, margins
from sealscope.control.loop_margins import _frequency_response, compute_margins, open_loop
from sealscope.parameters import load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run

from ..refusals import refusal

RIG = load_rig("thesis-closed-loop")
PI = PositionPI.from_rig(RIG)


@pytest.mark.parametrize(("share", "grows"), [(0.9, False), (1.1, True)])
def test_the_gain_margin_is_where_the_loop_begins_to_swing(share, grows):
    """At standstill, by an encoder of fine counts; the speed stays within the linear part of the friction."""
    factor = share * margins(RIG, PI).gain
    louder = replace(PI, k_v=factor * PI.k_v, k_i=factor * PI.k_i, dead_band=0.0)
    experiment = Experiment.of(
        rig=RIG, command="position step 0.002 mm at 0.1 s", duration=3.0, controller=louder,
        set={"sensors.x.resolution": "1e-9[m]"},
    )  # fmt: skip
    run = integrate_run(experiment, (), step=1e-4)
    late = np.ptp(run["x"][run.t > 2.0])
    assert late > 20e-6 if grows else late < 0.2e-6


def test_an_impulse_response_that_is_constant_but_for_rounding_is_an_integrator():
    response = np.full(50, 0.3)
    response[:2] += 1e-15
    z = np.exp(1j * np.array([0.1, 1.0]))
    np.testing.assert_allclose(_frequency_response(response, z), 0.3 / (1.0 - 1.0 / z), rtol=1e-12)


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


@pytest.mark.long
@pytest.mark.slow
def test_a_delay_within_the_margin_takes_its_share_of_the_phase():
    m = margins(RIG, PI)
    samples = 10
    later = margins(RIG, Late(PI, PI.delay + samples))
    assert m.phase - later.phase == pytest.approx(2.0 * math.pi * m.crossover * samples / PI.rate, rel=1e-3)
    assert m.delay - later.delay == pytest.approx(samples / PI.rate, rel=1e-3)


def test_phase_and_delay_margin_are_the_least_of_all_crossings():
    """L = k exp(-s tau)/(s (1 + 2 zeta s/w + s^2/w^2)): |L| = 1 at the roots r = omega^2/w^2 of a cubic, up in between.

    The delay turns the resonance off -1 to where the upward crossing has the least phase.
    """
    k, w, zeta = 20.0, 400.0, 0.02
    tau = 0.5 * math.pi / w
    f = np.geomspace(0.1, 200.0, 20_000)
    s = 2j * math.pi * f
    found = compute_margins(f, k * np.exp(-s * tau) / (s * (1.0 + 2.0 * zeta * s / w + (s / w) ** 2)))
    r = np.sort(np.roots([1.0, 4.0 * zeta**2 - 2.0, 1.0, -((k / w) ** 2)]).real)
    omega = w * np.sqrt(r)
    ahead = 0.5 * math.pi - omega * tau - np.arctan2(2.0 * zeta * np.sqrt(r), 1.0 - r)
    assert np.argmin(np.abs(ahead)) == 1
    assert found.phase == pytest.approx(abs(ahead[1]), rel=1e-4)
    assert found.delay == pytest.approx(np.min((ahead % (2.0 * math.pi)) / omega), rel=1e-4)
    assert found.crossover == pytest.approx(omega[2] / (2.0 * math.pi), rel=1e-5)


@pytest.mark.slow
def test_a_loop_turned_or_late_by_its_margin_passes_through_minus_one_and_by_less_it_does_not():
    """At 0.05 m/s the gain rises above 1 once more, at the resonance of piston and oil."""
    f = np.concatenate([np.geomspace(0.05, 60.0, 1500), np.linspace(60.1, 80.0, 2000), np.geomspace(81.0, 249.0, 200)])
    L, _ = open_loop(RIG, PI, f, 0.05)
    m = margins(RIG, PI, 0.05)
    late = np.exp(-2j * math.pi * f * m.delay)
    shares = np.linspace(0.0, 0.9, 40)

    def distance(turn):
        return np.abs(1.0 + L * turn).min()

    assert distance(1.0) == pytest.approx(1.0 / m.peak, rel=0.01)
    assert min(distance(np.exp(1j * m.phase)), distance(np.exp(-1j * m.phase))) < 0.005
    assert min(distance(np.exp(sign * 1j * m.phase * share)) for share in shares for sign in (1, -1)) > 0.02
    assert distance(late) < 0.02
    assert min(distance(late**share) for share in shares) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.01, 0.05])
def test_tolerance_costs_no_margin_without_a_leak_and_little_with_one_where_the_rig_is_damped(speed):
    without = margins(RIG, PI, speed)
    assert without.damped
    assert margins(RIG, FaultTolerant.from_rig(RIG), speed) == without
    with_one = margins(RIG, FaultTolerant.from_rig(RIG, known=2.6e-12), speed)
    assert with_one.phase > 0.95 * without.phase
    assert with_one.gain > 0.8 * without.gain


def test_a_speed_beyond_the_drive_is_refused():
    with refusal("speed", "5 m/s"):
        margins(RIG, PI, 5.0)


def test_margins_do_not_jump_where_the_voltage_of_the_stroke_reaches_its_limit():
    """The motor's controller is linear there: more speed damps the piston a little more."""
    below, at_limit = (margins(RIG, PI, speed) for speed in (0.09, 0.1))
    assert below.damped and at_limit.damped
    assert 1.0 < at_limit.gain / below.gain < 1.1
    assert at_limit.crossover == pytest.approx(below.crossover, rel=0.01)
