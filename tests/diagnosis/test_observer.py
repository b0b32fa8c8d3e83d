"""The model-based observer: its Jacobians, its consistency on its own model, wrong knowledge, and verdicts."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.diagnosis.inspection import comparable, inspected
from sealscope.diagnosis.observer import pressure_filter
from sealscope.diagnosis.observer.detector import LEAST_SECONDS, Observer, block_length
from sealscope.diagnosis.observer.model import (
    G_UNIT,
    PARAMETERS,
    assume,
    compliance,
    displacement,
    mean_area,
    start_parameters,
)
from sealscope.diagnosis.observer.stream import ObserverStream, channels_of, formulation_of
from sealscope.diagnosis.observer.volume_filter import VolumeFilter
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_with_truth

P = 0.01
ALL = ("u", "theta", "x", "p_A", "p_B")
PRESSURES = ("u", "p_A", "p_B")
VIEWS = {"volume": ("theta", "x", "p_A", "p_B"), "speed": ("theta", "p_A", "p_B"), "command": PRESSURES}


@pytest.fixture(scope="module")
def thesis() -> Rig:
    return load_rig("thesis")


@pytest.fixture(scope="module")
def machine():  # type: ignore[no-untyped-def]
    """A machine without throttles, as the observer's own model has it: leak of 0.0042 L/min from 70 s, or none."""
    made = {}

    def of(leak: bool, seed: int = 1, duration: float = 140.0, command: str = "7 sin(4t)"):  # type: ignore[no-untyped-def]
        key = (leak, seed, duration, command)
        if key not in made:
            words = f"0.0042 L/min from {duration / 2:g} s" if leak else None
            values = {"pump.G_pump": 2e-13}
            made[key] = simulate_with_truth(
                Experiment.of(command=command, leak=words, duration=duration, seed=seed, set=values)
            )
        return made[key]

    return of


def _point() -> tuple[np.ndarray, np.ndarray]:
    z = np.array([0.1, 0.3, 31.0, 3.6e5, 2.4e5, 0.031, 0.08])
    q = np.array([1.3, 1.1, 0.9, 1.05, 0.98, 4.0, 0.7, 0.8])
    return z, q


@pytest.mark.parametrize("v", [0.031, -0.004])
@pytest.mark.parametrize("commanded", [True, False])
def test_jacobians_are_the_rates_own_slopes(thesis: Rig, v: float, commanded: bool) -> None:
    a = assume(thesis)
    z, q = _point()
    z[5] = v
    drive = 3.0 if commanded else 31.0
    J, B = np.zeros((4, 4)), np.zeros((4, 8))
    pressure_filter._slopes(z, q, z[2] if commanded else drive, a, J, B)

    def rates(z: np.ndarray, q: np.ndarray) -> np.ndarray:
        dz = np.zeros(7)
        pressure_filter._rates(z, q, drive, commanded, a, dz)
        return dz[3:]

    def slope(which: int, of: int, h: float) -> np.ndarray:
        up, down = [z.copy(), q.copy()], [z.copy(), q.copy()]
        up[which][of] += h
        down[which][of] -= h
        return (rates(*up) - rates(*down)) / (2 * h)

    found = np.stack([slope(0, 3 + j, h) for j, h in enumerate((10.0, 10.0, 1e-6, 1e-6))], axis=1)
    # friction's small dependence on the pressures themselves (F_cfr, 2e-3 of the area) is left out of the Jacobian
    scale = np.abs(found).max(axis=1, keepdims=True)
    assert np.all(np.abs(J - found) <= 1e-6 * np.abs(found) + 5e-3 * scale * (np.arange(4) == 2)[:, None] + 1e-9)
    for j in range(8):
        wanted = slope(1, j, 1e-4)
        assert B[:, j] == pytest.approx(wanted, rel=1e-5, abs=1e-9 * float(np.abs(wanted).max() + 1e-30)), PARAMETERS[j]


def test_sensitivities_are_carried_by_the_exponential(thesis: Rig) -> None:
    from scipy.linalg import expm

    a = assume(thesis)
    z, q = _point()
    J, B = np.zeros((4, 4)), np.zeros((4, 8))
    pressure_filter._slopes(z, q, z[2], a, J, B)
    h = 2e-4
    S = np.hstack([np.eye(4), np.zeros((4, 8))])
    buffers = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 12))
    pressure_filter._carry(J, B, h, *buffers, S)
    whole = expm(h * np.block([[J, B], [np.zeros((8, 12))]]))[:4]
    scale = np.abs(whole).max(axis=0)
    assert np.all(np.abs(S - whole) <= 1e-5 * scale + 1e-300)


def test_volume_filter_is_consistent_on_its_own_model(thesis: Rig) -> None:
    """Innovations of mean square 1 (NIS), errors of G of mean square 1 (NEES), and both fail with half the noise."""
    a = assume(thesis)
    rate, block, seconds = 100.0, 300, 60.0
    t = np.arange(0.0, seconds, 1.0 / rate)
    dp = 1.1e5 * np.tanh(8.0 * np.sin(2.1 * t))
    x = 0.02 * (1.0 - np.cos(2.1 * t))
    true, noise = 1.7, 4e-9
    flow = 0.5 * G_UNIT * true * (dp[1:] + dp[:-1]) / rate
    clean = np.concatenate([[0.0], np.cumsum(flow)]) + 0.03 * mean_area(a) * x + 1.2 * compliance(a) * dp
    nis, nees, overconfident = [], [], []
    for seed in range(40):
        volume = clean + noise * np.random.default_rng(seed).standard_normal(t.size)
        theta = (volume + mean_area(a) * x) / displacement(a)
        for stated, into in ((noise, nees), (0.5 * noise, overconfident)):
            one = VolumeFilter(a, rate, block, stated**2)
            one.update(theta, x, dp)
            found = one.blocks.estimates()
            into.append(((found.G[-1] - true) / found.sd[-1]) ** 2)
            if stated == noise:
                nis.append(found.square.mean())
    assert np.mean(nis) == pytest.approx(1.0, abs=0.03)
    assert 0.5 < np.mean(nees) < 1.7  # chi-square of 40: 0.6 to 1.5 in 95 %
    assert np.mean(overconfident) > 2.0


@pytest.mark.parametrize("formulation", ["speed", "command"])
def test_pressure_filter_is_consistent_on_its_own_model(formulation: str, thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    """Innovations white and of mean square 1 (NIS); errors of the conductance, its level apart, of mean square 1
    (NEES). The level itself is off by up to 1.5 units (0.006 L/min), which slow parameters share: changes count."""
    recording = machine(False).recording.only(VIEWS[formulation])
    series = Observer(thesis).follow(recording)
    late = series.estimates.square[8:]
    assert np.mean(late) == pytest.approx(1.0, abs=0.12)
    assert abs(np.mean(series.estimates.correlation[8:])) < 0.12
    error = series.G - 2e-13 / G_UNIT
    changes = error - np.average(error, weights=series.sd**-2)
    assert 0.3 < np.mean((changes / series.sd) ** 2) < 2.0
    assert abs(np.mean(error)) < 1.5


def test_own_parameters_not_the_plants(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    """Told another rig the observer says another thing: nothing of the machine reaches it past its channels."""
    recording = machine(True).recording
    told = Observer(thesis).follow(recording.only(PRESSURES))
    bare = replace(recording, provenance={}, history=())
    assert np.array_equal(told.G, Observer(thesis).follow(bare.only(PRESSURES)).G)
    other = Observer(thesis.with_overrides({"friction.F_v": 330.0}, source="wrong")).follow(recording.only(PRESSURES))
    assert not np.array_equal(told.G, other.G)


@pytest.mark.parametrize("view", [ALL, PRESSURES])
def test_a_leak_is_found_and_sized(view: tuple[str, ...], thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    made = machine(True)
    found = Observer(thesis).examine(made.recording.only(view), [], P)
    assert found.verdict == "leak", found.reason
    assert found.score > found.threshold
    assert found.onset_s == pytest.approx(70.0, abs=1.0 if view == ALL else 4.0)
    slack = 0.0 if view == ALL else 1.5  # half a block: by the pressures the interval covers in nine of ten
    assert found.onset_interval_s[0] - slack <= 70.0 <= found.onset_interval_s[1] + slack
    low, high = found.leak_interval_lpm
    assert low <= made.truth.mean_leak_lpm <= high
    if view == ALL:
        assert found.leak_lpm == pytest.approx(made.truth.mean_leak_lpm, rel=0.05)
    after = found.course.t > 75.0
    assert np.mean(found.course.lpm[after]) == pytest.approx(found.leak_lpm, rel=0.2)
    assert abs(np.mean(found.course.lpm[found.course.t < 65.0])) < 0.3 * found.leak_lpm


@pytest.mark.parametrize("view", [ALL, PRESSURES])
def test_a_sound_machine_is_left_alone(view: tuple[str, ...], thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    found = Observer(thesis).examine(machine(False).recording.only(view), [], P)
    assert found.verdict == "no leak", found.reason
    assert found.leak_lpm is None
    assert found.onset_s is None


@pytest.mark.parametrize(
    "values",
    [
        {"fluid.K_oil": 758e6},
        {"friction.F_pr": 27.5, "friction.F_cfr": 1.1e-6, "friction.F_v": 330.0},
        {"cylinder.A_A": 696e-6, "cylinder.A_B": 696e-6},
        {"pump.q_b": 5.39e-6},
    ],
)
def test_ten_per_cent_of_wrong_knowledge_is_told_by_a_bounded_error(values, thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    """All channels: score hardly changes, and L/min is wrong by the error of the displacement alone."""
    made = machine(True)
    right = Observer(thesis).examine(made.recording.only(ALL), [], P)
    wrong = Observer(thesis.with_overrides(values, source="wrong on purpose")).examine(made.recording.only(ALL), [], P)
    assert wrong.verdict == "leak"
    assert wrong.score == pytest.approx(right.score, rel=0.1)
    share = 1.1 if "pump.q_b" in values else 1.0
    assert wrong.leak_lpm / right.leak_lpm == pytest.approx(share, rel=0.02)


@pytest.mark.parametrize("values", [{"fluid.K_oil": 620e6}, {"friction.F_v": 330.0, "friction.F_pr": 27.5}])
def test_the_pressures_alone_bear_wrong_knowledge(values, thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    made = machine(True)
    found = Observer(thesis.with_overrides(values, source="wrong on purpose")).examine(
        made.recording.only(PRESSURES), [], P
    )
    assert found.verdict == "leak", found.reason
    assert 0.5 < found.leak_lpm / made.truth.mean_leak_lpm < 2.0


def test_a_leak_that_opens_is_no_defect_of_the_model(thesis: Rig) -> None:
    """0.05 L/min makes the innovations of its first block a hundred times too large; a slip, too, is no leak."""
    made = simulate_with_truth(
        Experiment.of(command="7 sin(4t)", leak="0.05 L/min from 60.4 s", duration=120.0, seed=5)
    )
    found = Observer(thesis).examine(made.recording.only(ALL), [], P)
    assert found.verdict == "leak", found.reason
    assert found.onset_s == pytest.approx(60.4, abs=0.5)
    low, high = found.leak_interval_lpm
    assert low <= 0.05 <= high


def test_by_the_speed_no_flow_is_stated(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    found = Observer(thesis).examine(machine(True).recording.only(VIEWS["speed"]), [], P)
    assert found.leak_lpm is None
    assert found.verdict != "leak" or "overstated" in found.reason


def test_a_machine_of_another_kind_is_not_judged(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    """Pressures that do not come from the rig: innovations say so."""
    recording = machine(False).recording.only(PRESSURES)
    shuffled = {**recording.channels, "u": 4.0 * np.sign(np.sin(9.1 * recording.t))}
    found = Observer(thesis).examine(replace(recording, channels=shuffled), [], P)
    assert found.verdict == "cannot tell"
    assert "\n" not in found.reason
    assert found.score is None


def test_a_record_that_the_filter_loses_is_not_judged(thesis: Rig, machine, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """Of an unloaded single rod the last block had a deviation without end, and the method ended in an error."""
    observer, recording = Observer(thesis), machine(False).recording.only(PRESSURES)
    series = observer.follow(recording)
    assert series.sd.size > 1
    sd, own = series.sd.copy(), series.estimates.sd.copy()
    sd[-1] = own[-1] = np.inf
    lost = replace(series, sd=sd, estimates=series.estimates._replace(sd=own))
    monkeypatch.setattr(observer, "follow", lambda _: lost)
    judged = observer.examine(recording, [], P)
    assert (judged.verdict, judged.reason) == (
        "cannot tell",
        "the observer lost the recording: its model does not describe it",
    )


def test_a_slipping_encoder_is_named(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    recording = machine(False).recording.only(ALL)
    x = np.array(recording["x"])
    x[x.size // 2 :] += 0.005
    found = Observer(thesis).examine(replace(recording, channels={**recording.channels, "x": x}), [], P)
    assert found.verdict == "cannot tell"
    assert "jumps" in found.reason or "innovations" in found.reason


def test_senses_of_the_channels_do_not_matter(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    recording = machine(True).recording.only(ALL)
    plain = Observer(thesis).examine(recording, [], P)
    turned = replace(recording, channels={**recording.channels, "theta": 40.0 - recording["theta"]})
    assert Observer(thesis).examine(turned, [], P).score == pytest.approx(plain.score, rel=1e-6)
    swapped = replace(recording, channels={**recording.channels, "p_A": recording["p_B"], "p_B": recording["p_A"]})
    assert Observer(thesis).examine(swapped, [], P).score == pytest.approx(plain.score, rel=1e-6)


def test_speed_serves_where_the_angle_is_missing(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    recording = machine(True).recording.only(ALL)
    rate = recording.rate
    omega = np.gradient(recording["theta"]) * rate
    channels = {name: recording[name] for name in ("x", "p_A", "p_B")} | {"omega": omega}
    seen = Recording(recording.t, channels, {"x": "m", "p_A": "Pa", "p_B": "Pa", "omega": "rad/s"}, rate)
    assert formulation_of(seen) == "volume"
    found = Observer(thesis).examine(seen, [], P)
    assert found.verdict == "leak"
    assert found.leak_lpm == pytest.approx(0.0042, rel=0.1)


def test_against_baselines(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    leaky = machine(True).recording.only(ALL)
    after = leaky.between(72.0, 140.0)
    sound = [machine(False, seed=seed).recording.only(ALL) for seed in (1, 2, 3)]
    if after.duration < LEAST_SECONDS:
        after = leaky
    found = Observer(thesis).examine(leaky, sound, P)
    assert found.verdict == "leak"
    assert found.leak_lpm == pytest.approx(0.0042, rel=0.2)
    assert "3 baseline" in found.reason
    assert Observer(thesis).examine(machine(False, seed=4).recording.only(ALL), sound, P).verdict == "no leak"
    other = machine(False, command="5 sin(2t)").recording.only(ALL)
    refusal = comparable(inspected(other), sound).refusal  # left out before any detector sees it
    assert refusal is not None and "another command" in refusal


def test_says_what_is_missing(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    observer = Observer(thesis)
    recording = machine(False).recording.only(ALL)
    assert observer.usable(recording) is None
    cases = {
        "p_B": recording.only(["u", "p_A"]),
        "command": recording.only(["x", "p_A", "p_B"]),
        "constant": replace(recording, channels={**recording.channels, "p_A": np.full(len(recording), 3e5)}),
        "count": replace(recording, units={**recording.units, "p_A": "count"}),
        "without a gap": recording.between(0.0, 20.0),
        "Hz": replace(recording.only(PRESSURES), t=recording.t * 5.0, rate=100.0),
    }
    for word, one in cases.items():
        reason = observer.usable(one)
        assert reason is not None, word
        assert word in reason
        assert "\n" not in reason


def test_a_gap_in_the_position_leaves_the_pressures(thesis: Rig, machine) -> None:  # type: ignore[no-untyped-def]
    recording = machine(False).recording.only(ALL)
    x = np.array(recording["x"])
    x[1000:1010] = np.nan
    holed = replace(recording, channels={**recording.channels, "x": x})
    assert formulation_of(recording) == "volume"
    assert formulation_of(holed) == "command"
    assert Observer(thesis).usable(holed) is None


@pytest.mark.parametrize("cycle, length", [(None, 4.0), (12.0, 4.0), (1.5, 3.0), (np.pi / 2, np.pi), (6.3, 6.3)])
def test_blocks_are_whole_cycles(cycle: float | None, length: float) -> None:
    assert block_length(cycle) == pytest.approx(length)


@pytest.mark.parametrize("formulation", VIEWS)
@settings(max_examples=5, deadline=None)
@given(cuts=st.lists(st.integers(1, 9999), max_size=8))
def test_a_stream_says_what_the_batch_says(formulation: str, cuts: list[int]) -> None:
    rig = load_rig("thesis")
    t = np.arange(10000) / 500.0
    random = np.random.default_rng(3)
    channels = {
        "u": 3.0 * np.sin(4.0 * t),
        "theta": 20.0 * (1.0 - np.cos(4.0 * t)),
        "x": 0.024 * (1.0 - np.cos(4.0 * t)),
        "p_A": 3e5 + 6e4 * np.tanh(5 * np.sin(4.0 * t)) + 8e3 * random.standard_normal(t.size),
        "p_B": 3e5 - 6e4 * np.tanh(5 * np.sin(4.0 * t)) + 8e3 * random.standard_normal(t.size),
    }
    units = {"u": "V", "theta": "rad", "x": "m", "p_A": "Pa", "p_B": "Pa"}
    recording = Recording(t, channels, units, 500.0).only(VIEWS[formulation])
    names = channels_of(formulation_of(recording), recording)  # type: ignore[arg-type]
    batch = ObserverStream(assume(rig), names, 500.0, 3.0).update(recording)
    stream = ObserverStream(assume(rig), names, 500.0, 3.0)
    edges = [0, *sorted(set(cuts)), len(recording)]
    for first, last in pairwise(edges):
        stream.update(recording.samples(slice(first, last)))
    assert batch.G.size == 6
    for one, other in zip(batch, stream.estimates, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_stream_refuses_gaps(thesis: Rig) -> None:
    t = np.arange(500) / 500.0
    bad = Recording(
        t, {n: np.where(t == 0.5, np.nan, t) for n in PRESSURES}, {"u": "V", "p_A": "Pa", "p_B": "Pa"}, 500.0
    )
    with pytest.raises(InputError, match="must be finite"):
        ObserverStream(assume(thesis), PRESSURES, 500.0, 3.0).update(bad)
    with pytest.raises(InputError, match="> 0"):
        ObserverStream(assume(thesis), PRESSURES, 500.0, 0.0)


def test_start_parameters_follow_the_rig(thesis: Rig) -> None:
    number = PARAMETERS.index("volume_slope")
    assert start_parameters(assume(thesis))[0][number] == 0.0
    assert start_parameters(assume(thesis.with_overrides({"cylinder.volumes": "position"})))[0][number] == 1.0


def test_the_block_in_which_a_large_leak_begins_teaches_the_slow_states_nothing():
    """It moved the ratio of displacement to area by 2.5 %, and 0.05 L/min was stated as 0.061 for minutes."""
    lpm, onset = 0.05, 51.0
    made = Experiment.of(command="2 sin(6t)", duration=100.0, leak=f"{lpm} L/min from {onset} s", seed=103)
    recording = simulate_with_truth(made).recording
    series = Observer(load_rig("thesis")).follow(recording.only(VIEWS["volume"]))
    late, early = series.t > onset + series.block_s, series.t < onset - series.block_s
    rise = (series.G[late].mean() - series.G[early].mean()) * G_UNIT * series.dp[late].mean()
    assert rise * 6e4 == pytest.approx(lpm, rel=0.03)
