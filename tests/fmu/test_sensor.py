"""A soft sensor against the live balance in Python, fed with the same readings, run by an importer (FMPy)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student

import sealscope as ss
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.kernel.stream import WINDOW, StreamSettings, stream_layout
from sealscope.diagnosis.live.live_balance import LiveBalance, NotJudged, size_error
from sealscope.fmu.variables import SENSOR_RESULTS as RESULTS

from ..refusals import refusal

LEAK, ONSET, SECONDS = 0.0042, 80.0, 162.0
INPUTS = ("p_A", "p_B", "theta", "x")
RIG = ss.load_rig("thesis")


@pytest.fixture(scope="module")
def recording():
    # 2 s more than the unit reads: the live balance ends a block when the next has begun
    return ss.simulate(command="3 sin(4t)", duration=f"{SECONDS + 2.0} s", leak=f"{LEAK} L/min from {ONSET} s", seed=3)


def in_python(recording, n_blocks):
    """The results by the first blocks of the live balance."""
    live = LiveBalance(RIG, INPUTS)
    shown = live.take(SampleRun(recording.t, {name: recording[name] for name in INPUTS}, recording.rate, False))
    blocks = [block for part in shown if not isinstance(part, NotJudged) for block in part][:n_blocks]
    total, g, variance, offset = np.array([[own.total, own.g, own.sd**2, own.offset**2] for own in blocks]).T
    # the live balance takes the sensors' noise off the mean pressure difference, for which a unit keeps no samples
    difference = recording["p_A"] - recording["p_B"]
    middles, length = np.abs(difference[1:] + difference[:-1]) / 2, round((blocks[0].end - blocks[0].begin) * 500)
    firsts = [round(own.begin * 500 / length) * length for own in blocks]
    flow = np.array([middles[first : first + length].mean() for first in firsts])
    assert flow[-WINDOW:] == pytest.approx([own.pressure for own in blocks[-WINDOW:]], rel=0.04)
    last = slice(-WINDOW, None)
    level, unit = total[last].mean(), flow[last].mean()
    of_mean = max(g[last].var(ddof=1), variance[last].mean()) / WINDOW
    systematic = (offset + (size_error(RIG) * total) ** 2)[last].mean()
    half = np.hypot(student.ppf(0.975, WINDOW - 1) * np.sqrt(of_mean), 1.96 * np.sqrt(systematic))
    figures = unit * level, unit * (level - half), unit * (level + half)
    return {**dict(zip(RESULTS, figures, strict=False)), "conductance": level, "blocks": len(blocks)}


def lost(values):
    """Return readings of which some are no values of a sensor, in the beginning and for a second."""
    values = values.copy()
    values[100] = values[30000:30500] = 1e120
    return values


@pytest.mark.slow
@pytest.mark.parametrize("version", [2, pytest.param(3, marks=pytest.mark.long)])
def test_a_soft_sensor_says_what_the_live_balance_says(version, recording, tmp_path):
    """With readings that are lost, an encoder the other way round, and communication steps of any length."""
    pytest.importorskip("fmpy", reason="FMPy runs the units: pip install 'sealscope[fmu]'")
    from fmpy.validation import validate_fmu

    from .test_unit import Unit

    path = tmp_path / "leak.fmu"
    ss.write_sensor_fmu(path, fmi=version)
    assert validate_fmu(str(path)) == []
    unit = Unit(path, version)
    unit.start()
    channels = {name: recording[name].copy() for name in INPUTS} | {"theta": -recording["theta"]}
    channels["p_A"] = lost(channels["p_A"])
    readings, h = np.stack([channels[name] for name in INPUTS], axis=1), 1.0 / recording.rate
    for k in range(0, len(recording), 2):
        if k % 3:  # two samples in a communication step, held; or half a sample and one and a half
            readings[k + 1] = readings[k]

    def run(first):
        for k in range(first, round(SECONDS * recording.rate), 2):
            if k == 60000 and not first:
                kept.append(unit.unit.serializeFMUState(unit.unit.getFMUState()))
            for part, span in ((0, 2 * h),) if k % 3 else ((0, h), (1, h)):
                unit.set(**dict(zip(INPUTS, readings[k + part], strict=True)))
                unit.step((k + part) * h, span)
        return dict(zip(RESULTS, unit.get(*RESULTS), strict=True))

    kept = []
    results = run(0)
    units = {name: recording.units[name] for name in INPUTS}
    theirs = in_python(
        ss.Recording(recording.t, dict(zip(INPUTS, readings.T, strict=True)), units, recording.rate),
        n_blocks=int(results["blocks"]),
    )
    for name, value in theirs.items():
        assert results[name] == pytest.approx(value, rel=1e-9), name
    assert results["q_low"] < results["q"] < results["q_high"]
    assert results["alarm"] == 1.0 and results["score"] > results["threshold"]
    assert results["q_leak_low"] < LEAK / 6e4 < results["q_leak_high"]
    assert results["since"] == pytest.approx(SECONDS - ONSET, abs=4.0)
    assert 0.3 < results["misfit"] < 3.0
    # the state of the middle goes on to the same bits
    unit.unit.setFMUState(unit.unit.deserializeFMUState(kept[0]))
    assert run(60000) == results
    unit.free()


@pytest.mark.slow
def test_the_sign_of_the_angle_is_found_in_motion(recording, tmp_path):
    """A machine may stand still for the first minutes, with an angle that is constant or jumps by a count.

    An encoder the other way round changes no bit of the results.
    """
    pytest.importorskip("fmpy", reason="FMPy runs the units: pip install 'sealscope[fmu]'")
    from .test_unit import Unit

    path, h, random = tmp_path / "leak.fmu", 1.0 / recording.rate, np.random.default_rng(1)
    ss.write_sensor_fmu(path)
    for seconds, jump in ((20.0, 0), (80.0, 1)):  # 80 s: long enough to learn from the standstill
        size, readings = round(seconds * recording.rate), {}
        for name in INPUTS:
            count = abs(np.diff(np.unique(recording[name]))).min() * {"theta": jump, "x": 0}.get(name, 1)
            rest = recording[name][0] + count * random.integers(0, 2, size)
            readings[name] = np.r_[rest, recording[name]]
        results = []
        for sign in (1.0, -1.0):
            unit = Unit(path, 2)
            unit.start()
            rows = np.stack([*(readings[name] for name in INPUTS)], axis=1)
            rows[:, INPUTS.index("theta")] *= sign
            for k, row in enumerate(rows.tolist()):
                unit.set(**dict(zip(INPUTS, row, strict=True)))
                unit.step(k * h, h)
            results.append(dict(zip(RESULTS, unit.get(*RESULTS), strict=True)))
            unit.free()
        assert results[0] == results[1]
        assert results[0]["q"] == pytest.approx(LEAK / 6e4, rel=0.1)


@pytest.mark.parametrize("rig", ["thesis", "single-rod-eha"])
@pytest.mark.parametrize("rate", [16.0, 500.0, 10e3])
def test_the_code_has_the_terms_of_the_balance_and_a_bounded_memory(rig, rate):
    """Memory grows with the samples of 50 ms around the present one, and not with those of a block."""
    settings = StreamSettings.from_rig(ss.load_rig(rig), rate)
    assert sorted(settings.column_order) == list(range(len(settings.expressions)))
    assert stream_layout(settings).itemsize // 8 < 23000 + 4 * 0.06 * rate


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"sensor": "wavelet"}, "sensor, 'wavelet'"),
        ({"rate": 10.0}, "rate, 16 Hz, 10"),
        ({"fmi": 1}, "fmi, 2, 3"),
        ({"rig": "servo-valve"}, "q_pump, valve-controlled"),
        ({"rig": RIG.as_assumed("no rig was stated")}, "displacement, theta, stated"),
        ({"flow": "u"}, "theta, omega, q_pump, 'u'"),
    ],
)
def test_wrong_arguments_are_refused_and_nothing_is_written(given, words, tmp_path):
    with refusal(*words.split(", ")):
        ss.write_sensor_fmu(tmp_path / "leak.fmu", **given)
    assert list(tmp_path.iterdir()) == []
