"""A soft sensor against the observer's filters in Python, fed with the same readings, run by an importer (FMPy)."""

from __future__ import annotations

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.observer.detector import BLOCK_SECONDS, WARM_UP
from sealscope.diagnosis.observer.model import G_UNIT, assume, compliance, displacement, mean_area, start_parameters
from sealscope.diagnosis.observer.pressure_filter import SEARCH_SECONDS, PressureFilter, find_stiffness
from sealscope.diagnosis.observer.volume_filter import VolumeFilter
from sealscope.errors import InputError
from sealscope.fmu.sensor import INPUTS, READ, RESULTS
from sealscope.signals.filters import decomposition_filters

LEAK, ONSET, SECONDS = 0.0042, 110.0, 176.0


@pytest.fixture(scope="module")
def recording():
    return ss.simulate(command="3 sin(4t)", duration=f"{SECONDS} s", leak=f"{LEAK} L/min from {ONSET} s", seed=3)


def fine_variance(values):
    return np.mean(np.convolve(values, decomposition_filters()[1], "valid") ** 2)


def in_python(formulation, recording):
    """Estimates of the blocks after the beginning, by the filters of the detector."""
    rig, rate = ss.load_rig("thesis"), recording.rate
    a, p_A, p_B = assume(rig), recording["p_A"], recording["p_B"]
    n, block = round(SEARCH_SECONDS * rate), round(BLOCK_SECONDS * rate)
    if formulation == "volume":
        theta, x, dp = recording["theta"], recording["x"], p_A - p_B
        z = displacement(a) * theta - mean_area(a) * x - compliance(a) * dp
        own = VolumeFilter(a, rate, block, max(fine_variance(z[:n]), 1e-20))
        own.update(theta[n:] - theta[n - 1], x[n:] - x[n - 1], dp[n:])
        return own.blocks.estimates()
    drive = recording["u"] if formulation == "command" else recording["omega"].copy()
    if formulation == "speed":
        drive[1:] = 0.5 * (drive[1:] + recording["omega"][:-1])
    noise = np.array([max(fine_variance(p[:n]), 1e4) for p in (p_A, p_B)])
    q, deviations = start_parameters(a)
    bank = slice(n, 2 * n)
    q[3] = find_stiffness(
        a, formulation == "command", rate, (q, deviations), noise, (drive[bank], p_A[bank], p_B[bank])
    )
    deviations[3] *= q[3]
    own = PressureFilter(a, formulation == "command", rate, block, (q, deviations), noise)
    own.update(drive[2 * n :], p_A[2 * n :], p_B[2 * n :])
    return own.blocks.estimates()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("formulation", "version"),
    [
        ("volume", 2),
        pytest.param("volume", 3, marks=pytest.mark.long),
        pytest.param("speed", 3, marks=pytest.mark.long),
        ("command", 2),
    ],
)
def test_a_soft_sensor_says_what_the_observer_says(formulation, version, recording, tmp_path):
    pytest.importorskip("fmpy", reason="FMPy runs the units: pip install 'sealscope[fmu]'")
    from fmpy.validation import validate_fmu

    from .test_unit import Unit

    path = tmp_path / "leak.fmu"
    ss.write_sensor_fmu(path, sensor=formulation, fmi=version)
    assert validate_fmu(str(path)) == []
    unit, names = Unit(path, version), INPUTS[formulation]
    unit.start()
    readings, h = np.stack([recording[name] for name in names], axis=1), 1.0 / recording.rate
    for k in range(0, len(recording), 2):
        if k % 3:  # two samples in a communication step, held; or half a sample and one and a half
            readings[k + 1] = readings[k]
    again, k = None, 0
    for k in range(0, len(recording), 2):
        if k == 60000:
            again = unit.unit.serializeFMUState(unit.unit.getFMUState())
        for part, span in ((0, 2 * h),) if k % 3 else ((0, h), (1, h)):
            unit.set(**dict(zip(names, readings[k + part], strict=True)))
            unit.step((k + part) * h, span)
    results = dict(zip(RESULTS, unit.get(*RESULTS), strict=True))
    held = ss.Recording(
        recording.t, dict(zip(names, readings.T, strict=True)), {n: recording.units[n] for n in names}, recording.rate
    )
    theirs = in_python(formulation, held)
    settled = theirs.G[int(np.ceil((WARM_UP - SEARCH_SECONDS) / BLOCK_SECONDS)) :]
    assert results["blocks"] == theirs.G.size
    assert results["conductance"] == pytest.approx(G_UNIT * settled[-20:].mean(), rel=1e-6)
    dp = theirs.dp[-20:].mean()
    late = settled[20:][-20:]
    assert results["q_rise"] == pytest.approx(G_UNIT * dp * (late.mean() - settled[:20].mean()), rel=1e-5)
    assert results["misfit"] == pytest.approx(theirs.square[-1], rel=1e-6)
    assert results["q_low"] < results["q"] < results["q_high"]
    assert results["q_rise_low"] < results["q_rise"] < results["q_rise_high"]
    assert results["settled"] == 1.0
    # the state of the middle goes on to the same bits
    unit.unit.setFMUState(unit.unit.deserializeFMUState(again))
    for k in range(60000, len(recording), 2):
        for part, span in ((0, 2 * h),) if k % 3 else ((0, h), (1, h)):
            unit.set(**dict(zip(names, readings[k + part], strict=True)))
            unit.step((k + part) * h, span)
    assert dict(zip(RESULTS, unit.get(*RESULTS), strict=True)) == results
    unit.free()


@pytest.mark.parametrize("formulation", list(INPUTS))
def test_the_parameters_listed_are_those_that_the_filters_read(formulation, recording):
    """A parameter that is listed changes the estimates, another does not."""
    from sealscope.physics.rig import PARAMETERS

    rig, early = ss.load_rig("thesis"), recording.between(0.0, 30.0)
    a = assume(rig)
    own = conductances(a, rig, formulation, early)
    for symbol, name in PARAMETERS.items():
        factor = 0.005 if name in ("motor.V_max", "motor.i_max") else 1.01  # limits, far away
        other = a._replace(**{symbol: (getattr(a, symbol) or 1.0) * factor})
        same = np.array_equal(conductances(other, rig, formulation, early), own, equal_nan=True)
        assert same == (name not in READ[formulation]), name


def conductances(a, rig, formulation, recording):
    """By the numbers `a`, from the first sample on."""
    dp = recording["p_A"] - recording["p_B"]
    if formulation == "volume":
        own = VolumeFilter(a, recording.rate, 1000, 1e-14)
        own.update(recording["theta"], recording["x"], dp)
        return own.blocks.estimates().G
    drive, noise = recording["u" if formulation == "command" else "omega"], np.array([1e6, 1e6])
    own = PressureFilter(a, formulation == "command", recording.rate, 1000, start_parameters(a), noise)
    own.update(drive, recording["p_A"], recording["p_B"])
    return own.blocks.estimates().G


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ({"sensor": "wavelet"}, "sensor must be"),
        ({"sensor": "command", "rate": 100.0}, "rate of the sensor command must be >= 250 Hz, got 100"),
        ({"fmi": 1}, "fmi must be 2 or 3"),
    ],
)
def test_wrong_arguments_are_refused_and_nothing_is_written(given, rule, tmp_path):
    with pytest.raises(InputError, match=rule):
        ss.write_sensor_fmu(tmp_path / "leak.fmu", **given)
    assert list(tmp_path.iterdir()) == []
