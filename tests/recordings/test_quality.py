"""Findings: each fault that is put in is named, with its place; healthy data of every kind raise nothing."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.recordings import CHANNEL_UNITS, Finding, Recording, inspect, uniform_segments

from ..refusals import refusal

RATE = 500.0
STEP_PSI = 10 / 2**13 * 300  # 14 bits over +-10 V, 0..10 V for 0..3000 psi
PSI = 6894.757293168361


def recording(channels: dict[str, np.ndarray], t: np.ndarray | None = None) -> Recording:
    count = len(next(iter(channels.values())))
    return Recording(np.arange(count) / RATE if t is None else t, channels, CHANNEL_UNITS, RATE)


def quantised(values: np.ndarray, step: float) -> np.ndarray:
    return np.round(values / step) * step


def healthy(count: int = 20_000, seed: int = 0, noise: float = 1.23) -> dict[str, np.ndarray]:
    """Channels as a rig gives them: noisy quantised pressures, a slow encoder, a stepwise command, a resting meter."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) / RATE
    swing = 0.06e6 * np.tanh(8 * np.cos(4 * t)) + 2e3 * np.exp(-((4 * t) % np.pi)) * np.sin(438 * t)
    pressures = {
        name: quantised(3e5 + sign * swing + noise * PSI * rng.normal(size=count), STEP_PSI * PSI)
        for name, sign in (("p_A", 1), ("p_B", -1), ("p_1", 1), ("p_2", -1))
    }
    return {
        "u": np.where((t > 5) & (t < 20), 3.0, 0.0),
        "theta": quantised(20 * np.sin(0.4 * t), 2 * np.pi / 20_000),
        "x": quantised(0.02 * np.sin(4 * t), 20e-6),
        "omega": 30 * np.cos(4 * t),
        "q_leak": quantised(np.where(t > 15, 7e-8, 0) + 2e-10 * rng.normal(size=count), 1e-9),
    } | pressures


SQUARE = np.sign(np.sin(np.arange(20_000) / 125 + 0.1))
RAMP = np.clip(np.arange(20_000) / 5000.0, 1, 2)


def codes(result: tuple[Finding, ...], channel: str | None = None) -> list[str]:
    return [finding.code for finding in result if finding.channel == channel]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3, 1.23, 5.0])
def test_healthy_data_raise_nothing(seed: int, noise: float) -> None:
    assert inspect(recording(healthy(20_000, seed, noise))) == ()


@pytest.mark.parametrize(
    "values",
    [
        np.sin(np.arange(20_000) / 125),
        quantised(np.sin(np.arange(20_000) / 2000), 1e-3),
        quantised(np.sin(np.arange(20_000) / 2000), 1e-1),
        SQUARE,
        SQUARE + quantised(np.random.default_rng(1).normal(size=20_000), 0.5) / 10,
        np.repeat(np.random.default_rng(2).normal(size=200), 100),
        quantised(RAMP + np.random.default_rng(3).normal(size=20_000) * 2e-3, 1e-3),
        np.cumsum(np.random.default_rng(4).normal(size=20_000)),
        quantised(1 - np.exp(-np.arange(20_000) / 1000), 1e-3),
        np.random.default_rng(5).integers(0, 2, 20_000).astype(float),
        np.random.default_rng(6).normal(size=20_000).astype(np.float32).astype(float),
    ],
    ids=["sine", "slow", "coarse", "square", "noisy square", "staircase", "ramp", "walk", "settling", "bits", "noise"],
)  # fmt: skip
@pytest.mark.parametrize("name", ["p_A", "x"])
def test_no_fault_is_seen_in_signals_without(values: np.ndarray, name: str) -> None:
    assert inspect(recording({name: values})) == ()


def test_missing_runs() -> None:
    p = healthy()["p_A"]
    p[100:150] = np.nan
    p[5000:5200] = np.nan
    (finding,) = inspect(recording({"p_A": p}))
    assert (finding.code, finding.severity, finding.channel, finding.count) == ("missing", "warning", "p_A", 250)
    assert finding.first_t == 0.2
    assert finding.text == "p_A: 250 samples missing in 2 stretches, the longest 0.4 s"


@pytest.mark.parametrize("every", [2, 5, 50])
def test_mixed_rates(every: int) -> None:
    p = healthy()["p_A"]
    p[np.arange(p.size) % every != 0] = np.nan
    result = inspect(recording({"p_A": p, "p_B": healthy()["p_B"]}))
    assert codes(result, "p_A") == ["mixed_rate"]
    assert f"({RATE / every:g} Hz among 500 Hz)" in result[0].text
    assert codes(result, "p_B") == []


def changed(change) -> np.ndarray:
    t = np.arange(5000) / RATE
    change(t)
    return t


@pytest.mark.parametrize(
    ("t", "rate", "expected"),
    [
        (changed(lambda t: t[2000:].__iadd__(1.0)), RATE, ("gap", "warning", 1, 1999 / RATE)),
        (changed(lambda t: t[1000:1001].__isub__(1 / RATE)), RATE, ("duplicated_time", "warning", 1, 999 / RATE)),
        (changed(lambda t: t[3000:].__isub__(2.0)), RATE, ("reversed_time", "warning", 1, 3000 / RATE - 2.0)),
        (changed(lambda t: t[10:11].__imul__(np.nan)), RATE, ("missing_time", "note", 1, None)),
        (changed(lambda t: None), 1000.0, ("rate_mismatch", "fatal", 1, 0.0)),
        (changed(lambda t: None)[::-1], RATE, ("reversed_time", "warning", 4999, 4998 / RATE)),
    ],
)
def test_faults_of_the_time(t: np.ndarray, rate: float, expected: tuple) -> None:
    result = inspect(replace(recording({"p_A": healthy()["p_A"][:5000]}, t), rate=rate))
    named = {finding.code: (finding.code, finding.severity, finding.count, finding.first_t) for finding in result}
    assert named[expected[0]][:3] == expected[:3]
    assert named[expected[0]][3] == pytest.approx(expected[3], abs=1.1 / RATE)


@pytest.mark.parametrize(("lost", "gaps"), [(0, []), (10, [(1, 10)]), (500, [(1, 500)])])
def test_a_clock_that_two_samples_share_has_gaps_only_where_samples_are_lost(lost: int, gaps: list[tuple]) -> None:
    t = np.delete(np.repeat(np.arange(5000) * 2 / RATE, 2), slice(2000, 2000 + lost))
    result = inspect(recording({"p_A": healthy()["p_A"][: t.size]}, t))
    assert codes(result) == ["duplicated_time"] + ["gap"] * len(gaps)
    assert [(f.count, f.text) for f in result if f.code == "gap"] == [
        (count, f"1 gap, about {samples} samples lost, the longest {(samples + 2) / RATE:g} s")
        for count, samples in gaps
    ]


@pytest.mark.parametrize("rate", [250.0, 1000.0])
def test_one_repeated_stamp_hides_no_wrong_rate(rate: float) -> None:
    t = np.arange(5000) / rate
    t[1000] = t[999]
    result = inspect(recording({"p_A": healthy()["p_A"][:5000]}, t))
    assert [f.code for f in result if f.severity == "fatal"] == ["rate_mismatch"]


def test_all_missing_and_infinite() -> None:
    p, q = healthy()["p_A"], healthy()["p_B"]
    p[:], q[77] = np.nan, np.inf
    result = inspect(recording({"p_A": p, "p_B": q}))
    assert (codes(result, "p_A"), codes(result, "p_B")) == (["missing"], ["infinite"])


@pytest.mark.parametrize(("jitter", "expected"), [(0.001, []), (0.02, []), (0.1, ["warning"]), (0.5, ["warning"])])
def test_irregular_sampling(jitter: float, expected: list[str]) -> None:
    rng = np.random.default_rng(0)
    t = (np.arange(5000) + jitter * rng.uniform(-0.9, 0.9, 5000)) / RATE
    result = [f for f in inspect(recording({"p_A": healthy()["p_A"][:5000]}, t)) if f.code == "irregular_sampling"]
    assert [f.severity for f in result] == expected


def test_constant() -> None:
    result = inspect(recording({"p_A": np.full(1000, 3e5), "u": np.zeros(1000), "q_leak": np.zeros(1000)}))
    assert [(f.code, f.severity, f.channel) for f in result] == [
        ("constant", "warning", "p_A"),
        ("constant", "note", "u"),
        ("constant", "note", "q_leak"),
    ]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("noise", "step"), [(0.0, 0.0), (0.01, 0.0), (0.01, 0.002), (0.05, 0.01), (0.0, 0.002)])
@pytest.mark.parametrize("side", ["high", "low"])
def test_clipped(seed: int, noise: float, step: float, side: str) -> None:
    rng = np.random.default_rng(seed)
    p = np.sin(2 * np.pi * np.arange(20_000) / 777) + noise * rng.normal(size=20_000)
    p = quantised(p, step) if step else p
    cut = np.minimum(p, 0.8) if side == "high" else np.maximum(p, -0.8)
    result = inspect(recording({"p_A": cut}))
    assert codes(result, "p_A") == ["clipped"]
    assert f"at the {side} end" in result[0].text
    assert result[0].count == np.sum(p >= 0.8) if side == "high" else np.sum(p <= -0.8)


@pytest.mark.parametrize(("charge", "found"), [(9.9e5, []), (0.6e5, ["clipped"])])
def test_a_chamber_at_the_charge_pressure_is_not_clipped(charge: float, found: list[str]) -> None:
    """Only a transducer's zero is a low end: steps of 0.25 bar hide the noise of a pressure that checks hold."""
    t = np.arange(4000) / 100.0
    swing = np.sin(2.0 * t)
    strokes = np.where((t % 12.0 > 4.0) & (swing > 0.0), 3e5 + 8e5 * swing, 0.0)
    noise = np.random.default_rng(1).normal(0.0, 1.5e3, t.size)
    recording = Recording(t, {"p_A": 25e3 * np.round((charge + strokes + noise) / 25e3)}, {"p_A": "Pa"}, rate=100.0)
    assert codes(inspect(recording), "p_A") == found


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", ["p_A", "x"])
def test_stuck(seed: int, name: str) -> None:
    values = healthy(20_000, seed)[name]
    start = 7000 + 371 * seed
    values[start : start + 400] = values[start]
    result = [f for f in inspect(recording({name: values})) if f.code == "stuck"]
    assert len(result) == 1
    assert abs(result[0].first_t * RATE - start) <= 6
    assert 395 <= result[0].count <= 420


@pytest.mark.parametrize("mains", [50.0, 60.0])
def test_mains_hum(mains: float) -> None:
    channels = healthy()
    t = np.arange(20_000) / RATE
    channels["p_A"] = channels["p_A"] + 2 * PSI * np.sin(2 * np.pi * (mains + 0.02) * t + 1)
    (finding,) = inspect(recording(channels))
    assert (finding.code, finding.channel) == ("mains_hum", "p_A")
    assert f"{mains:g} Hz" in finding.text
    amplitude = float(finding.text.split("amplitude ")[1].split()[0])
    assert amplitude == pytest.approx(2 * PSI, rel=0.15)


def test_an_unconnected_sensor() -> None:
    t = np.arange(5000) / RATE
    p = 1500 * np.sin(2 * np.pi * 60 * t) + 30 * np.random.default_rng(0).normal(size=t.size)
    (finding,) = inspect(recording({"p_A": p}))
    assert finding.severity == "warning"
    assert "is the sensor connected?" in finding.text


@settings(deadline=None, max_examples=30)
@given(st.data())
def test_uniform_segments_are_maximal_sound_and_disjoint(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 60))
    steps = data.draw(
        st.lists(st.sampled_from([1.0, 1.0, 1.0, 1.1, 0.0, -3.0, 4.0, np.nan]), min_size=count, max_size=count)
    )
    holes = data.draw(st.lists(st.integers(0, count - 1), max_size=4))
    t = np.cumsum(np.nan_to_num(steps)) / RATE
    t[np.isnan(steps)] = np.nan
    p = np.ones(count)
    p[holes] = np.nan
    segments = uniform_segments(recording({"p_A": p, "x": np.ones(count)}, t), ["p_A"])
    inside = np.zeros(count, dtype=bool)
    for segment in segments:
        assert not inside[segment].any()
        inside[segment] = True
        assert np.isfinite(p[segment]).all()
        assert (np.abs(np.diff(t[segment]) * RATE - 1) < 0.5).all()
    assert np.array_equal(inside, np.isfinite(p) & np.isfinite(t))
    for one, other in pairwise(segments):
        if one.stop == other.start:
            assert not abs((t[other.start] - t[one.stop - 1]) * RATE - 1) < 0.5


def test_uniform_segments_of_a_sound_recording_and_of_parts() -> None:
    whole = recording(healthy())
    assert uniform_segments(whole) == [slice(0, 20_000)]
    p = healthy()["p_A"]
    p[10:20] = np.nan
    holed = recording({"p_A": p, "x": healthy()["x"]})
    assert uniform_segments(holed) == [slice(0, 10), slice(20, 20_000)]
    assert uniform_segments(holed, ["x"]) == [slice(0, 20_000)]
    with refusal("p_B"):
        uniform_segments(holed, ["p_B"])


@pytest.mark.parametrize("scale", [1e-320, 1e-300, 1e150, 1e300])
@pytest.mark.filterwarnings("error")
def test_no_number_is_too_large_or_too_small_to_inspect(scale: float) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=3000) * scale
    values[5] = np.finfo(float).max
    t = np.sort(rng.normal(size=3000)) * scale
    t[-1] = np.finfo(float).max
    assert inspect(replace(recording({"p_A": values, "x": -values}, t), rate=1e300))


def test_pressures_that_creep_as_in_no_sealed_circuit_are_remarked():
    """Volumes balanced in place of mass pump a circuit up; mass balanced, a warm-up or a jump are no such thing."""
    t = np.arange(9000) / 100.0
    stroke = 1e5 * np.sin(4 * t)

    def codes(mean):
        channels = {"p_A": 3e5 + mean + stroke, "p_B": 3e5 + mean - stroke}
        result = inspect(Recording(t, channels, dict.fromkeys(channels, "Pa"), rate=100.0))
        return [(f.code, f.severity) for f in result if f.code == "creeping_pressures"]

    assert codes(6e3 * t) == codes(-6e3 * t) == [("creeping_pressures", "note")]
    assert codes(0.0 * t) == codes(500.0 * t) == codes(np.where(t > 45, 6e5, 0.0)) == []
    assert codes(3e5 * (1 - np.exp(-t / 10))) == []


@pytest.mark.parametrize(("intervals", "lost"), [((0.02, 0.03), 0), ((0.05, 0.06, 0.1), 0), ((0.02, 0.03), 200)])
def test_polls_at_uneven_times_are_no_gaps(intervals: tuple[float, ...], lost: int) -> None:
    steps = np.random.default_rng(0).choice(intervals, 5000)
    if lost:
        steps[2000] = lost * steps.mean()
    t = np.cumsum(steps)
    polled = replace(recording({"p_A": healthy()["p_A"][:5000]}, t), rate=1.0 / float(np.median(steps)))
    gaps = [finding for finding in inspect(polled) if finding.code == "gap"]
    assert [gap.count for gap in gaps] == ([1] if lost else [])
    assert all(f"about {lost - 1} samples lost" in gap.text for gap in gaps)
    assert polled.duration == pytest.approx(t[-1] - t[0], abs=0.1)


@pytest.mark.parametrize(("lost", "severity"), [(1, "note"), (150, "note"), (300, "warning")])
def test_a_defect_of_few_samples_is_a_note(lost: int, severity: str) -> None:
    t = np.arange(20_000) / RATE
    t[10_000:] += lost / RATE
    p = healthy()["p_A"]
    p[5000 : 5000 + lost] = np.nan
    findings = inspect(recording({"p_A": p}, t))
    assert {finding.code: finding.severity for finding in findings} == {"gap": severity, "missing": severity}
