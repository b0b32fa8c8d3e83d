"""The step that is chosen by error: what is asked for is what comes out, and no step is finer than it need be."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sealscope.parameters import load_rig
from sealscope.signals.details import details
from sealscope.signals.windows import rms
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import comparison_windows, integrate_run
from sealscope.units import P_ATM

from ..refusals import refusal
from ..representatives import few

PRESSURES = ("p_A", "p_B", "p_1", "p_2")


def off(run, truth) -> float:
    return max(float(np.sqrt(np.mean((run[name] - truth[name]) ** 2))) for name in PRESSURES)


PRBS = "prbs 1 every 0.5 s seed 1"


@pytest.mark.parametrize(
    ("throttled", "command"),
    few(
        [
            *[(True, "3 sin(4t)"), (False, "5 sin(t)"), (False, PRBS)],
            *[(False, "3 sin(4t)"), (True, "5 sin(t)"), (True, PRBS)],
        ],
        2,
    ),
)
def test_the_error_that_is_asked_for_comes_out(check_rig, throttled, command):
    experiment = Experiment.of(rig=check_rig(throttled), command=command, leak="G = 6e-13 from 10 s", duration=20.0)
    common = {"duration": 20.0, "rate": 500.0}
    truth = integrate_run(experiment, experiment.leaks, step=5e-5, **common)
    steps = []
    for error in (1000.0, 100.0, 10.0):
        run = integrate_run(experiment, experiment.leaks, error=error, **common)
        assert off(run, truth) <= 1.25 * error, (error, run.step)
        assert run.error <= error
        steps.append(run.step)
        for name in ("p_A", "p_B"):
            noise = experiment.rig.sensors.p_A.noise
            one, other = (details(result[name]) for result in (run, truth))
            for level in range(1, 5):
                a, b = (np.hypot(rms(x[level][x.inside(level)]), noise) for x in (one, other))
                assert abs(a / b - 1.0) < 1.5e-3, (error, name, level)
    assert steps == sorted(steps, reverse=True)
    assert steps[-1] < steps[0] or throttled  # the throttled rig is within 10 Pa at the longest step


def test_a_quick_command_gets_a_finer_step_than_a_slow_one(check_rig):
    def step(command: str) -> float:
        experiment = Experiment.of(rig=check_rig(), command=command, duration=4.0)
        return integrate_run(experiment, (), duration=4.0, rate=500.0).step

    assert step("prbs 1 every 0.5 s seed 1") < step("1 sin(2t)")


@pytest.mark.slow
def test_a_change_late_in_the_run_is_seen(check_rig, drive):
    """The first half is gentle, and the second half is not: the step is that of the second."""
    rig = check_rig()

    def volts(t):
        return np.where(t < 9.0, 0.1 * np.sin(t), np.where(np.floor(4.0 * t) % 2 > 0, 1.0, -1.0))

    run = drive(rig, 20.0, u=volts)
    gentle = drive(rig, 8.0, u=volts)
    assert gentle.step == 1e-3
    assert run.step < 0.5 * gentle.step
    assert off(run, drive(rig, 20.0, u=volts, step=2e-5)) < 150.0


def test_a_window_that_begins_in_a_cavity_is_no_error():
    """It began again with pressures raised to that of vapour: the shortest step was off by 0.04 MPa, as it said."""
    changed = {"p_vap": 2e3, "u_max": 12.0, "volumes": "position", "p_charge": "0 Pa", "F_v": 6000.0}
    experiment = Experiment.of(rig=load_rig("thesis").with_overrides(changed), command="11 sin(4t)", duration=4.6)
    common = {"duration": 4.6, "rate": 1000.0}
    run = integrate_run(experiment, (), **common)
    assert run["p_A"][round(0.9 * len(run.t))] == 2e3 - P_ATM
    assert run.step == 1e-3
    assert run.error <= experiment.error_allowed
    assert off(run, integrate_run(experiment, (), step=5e-5, **common)) <= 1.25 * experiment.error_allowed


def test_the_windows_lie_within_the_run_and_apart():
    for n, rate in ((1, 500.0), (40, 10.0), (1000, 500.0), (2600, 500.0), (90_000, 500.0), (360_000, 2000.0)):
        result = comparison_windows(n, rate)
        assert result[0][0] == 0
        assert all(0 <= start < stop <= n for start, stop in result)
        assert all(a[1] <= b[0] for a, b in itertools.pairwise(result))
    assert comparison_windows(90_000, 500.0)[-1][0] >= 0.85 * 90_000


def test_an_error_must_be_a_pressure(check_rig, drive):
    for error in (0.0, -1.0, float("nan"), float("inf")):
        with refusal("error", "0 Pa"):
            drive(check_rig(), 1.0, error=error)


def test_a_step_must_be_a_time(check_rig, drive):
    for step in (0.0, -1e-4, float("nan"), float("inf")):
        with refusal("step", "0 s"):
            drive(check_rig(), 1.0, step=step)
