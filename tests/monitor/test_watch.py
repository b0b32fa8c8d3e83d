"""A watched actuator: the same for blocks of any size and after a restart; disorder is counted, never raised."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import sealscope as ss
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.live.estimates import BlockEstimate, WatchBaseline, find_level_rise
from sealscope.diagnosis.live.watch import Watch
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording

from ..diagnosis.balance_machine import machine, step
from ..refusals import refusal
from ..representatives import few
from .plant import moved

#: Conductance of the leak [m^3/(s Pa)], and the seconds from which it is open.
LEAK, OPENS = 3.0e-13, 110.0
WORN = machine(1, G=step(0.0, LEAK, at=OPENS), duration=160.0, rate=50.0)
LEARN = 0.02


def run(recording: Recording, sizes: list[int], watch: Watch | None = None) -> tuple[Watch, list[BlockEstimate]]:
    """The watch and its estimates after samples in pieces of these sizes over and over."""
    watch = watch or ss.watch("thesis", learn_hours=LEARN)
    estimates, start, turn = [], 0, 0
    while start < len(recording):
        stop = start + sizes[turn % len(sizes)]
        estimates += watch.update(recording.samples(slice(start, stop)))
        start, turn = stop, turn + 1
    return watch, estimates


def truth_lpm(recording: Recording) -> float:
    """Mean flow of the leak [L/min]."""
    late = recording.between(OPENS, recording.t[-1])
    return LEAK * float(np.mean(np.abs(late["p_A"] - late["p_B"]))) * 60_000.0


@cache
def whole() -> tuple[Watch, list[BlockEstimate]]:
    return run(WORN, [len(WORN)])


def test_a_leak_is_stated_in_litres_per_minute_with_its_onset():
    watch, estimates = whole()
    assert watch.leak is not None and watch.baseline is not None
    low, high = watch.leak.onset_interval_s
    assert low <= OPENS <= high
    assert OPENS < watch.leak.raised_s < OPENS + 15.0
    low_lpm, high_lpm = estimates[-1].leak_interval_lpm
    assert low_lpm <= truth_lpm(WORN) <= high_lpm
    assert estimates[-1].leak_lpm == pytest.approx(truth_lpm(WORN), rel=0.05)
    assert [estimate.number for estimate in estimates] == list(range(1, len(estimates) + 1))
    assert {estimate.status for estimate in estimates} == {"learning", "watched", "alarm"}
    watched = [estimate for estimate in estimates if estimate.status == "watched" and estimate.t < OPENS]
    assert np.mean([estimate.leak_interval_lpm[0] == 0.0 for estimate in watched]) > 0.9  # a 95 % interval


@pytest.mark.parametrize("flicker", [False, True])
@pytest.mark.parametrize("wiring", [1.0, -1.0])
def test_a_machine_that_stands_at_first_shows_the_sign_of_its_encoder_in_motion(wiring: float, flicker: bool):
    """An angle that is constant, or jumps by a count, tells no sign: the leak was negative ever after."""
    n_rest, random = round(30.0 * WORN.rate), np.random.default_rng(4)
    count = 2.0 * np.pi / 4096.0 * flicker
    rest = {name: np.full(n_rest, values[0]) for name, values in WORN.channels.items()}
    rest["theta"] = rest["theta"] + count * random.integers(0, 2, n_rest)
    rest |= {name: rest[name] + 1e3 * random.standard_normal(n_rest) for name in ("p_A", "p_B")}
    channels = {name: np.r_[rest[name], values] for name, values in WORN.channels.items()}
    channels["theta"] = wiring * channels["theta"]
    t = np.arange(n_rest + len(WORN)) / WORN.rate
    watch, estimates = run(replace(WORN, t=t, channels=channels), [500])
    assert watch.leak is not None
    assert estimates[-1].leak_lpm == pytest.approx(truth_lpm(WORN), rel=0.1)


@settings(
    max_examples=2,
    deadline=None,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow],
)
@given(sizes=st.lists(st.integers(7, 4000), min_size=1, max_size=4))
def test_results_do_not_depend_on_the_cuts(sizes: list[int]):
    watch, estimates = run(WORN, sizes)
    assert estimates == whole()[1]
    assert json.dumps(watch.state()) == json.dumps(whole()[0].state())


@pytest.mark.parametrize("stop", few([5700, 1000], 1))
def test_a_restart_continues_with_the_same_bits(stop: int):
    first, before = run(WORN.samples(slice(0, stop)), [700])
    again = Watch.from_state(json.loads(json.dumps(first.state(), allow_nan=False)))
    _, after = run(WORN.samples(slice(stop, len(WORN))), [700], again)
    assert before + after == whole()[1]
    assert again.leak == whole()[0].leak
    assert json.dumps(again.state()) == json.dumps(whole()[0].state())


def changed(recording: Recording, **channels: Any) -> Recording:
    return Recording(recording.t, {**recording.channels, **channels}, recording.units, recording.rate)


def test_repeated_and_late_samples_are_dropped():
    watch = ss.watch("thesis", learn_hours=LEARN)
    estimates = []
    for start in range(0, len(WORN), 500):
        estimates += watch.update(WORN.samples(slice(start, start + 500)))
        estimates += watch.update(WORN.samples(slice(max(0, start - 700), start + 100)))
    assert estimates == whole()[1]
    assert watch.counters["late or repeated samples"] > 10_000


def disordered() -> list[Recording]:
    """The worn machine's samples with every kind of trouble between them, the leak's onset whole."""
    pieces = [WORN.samples(slice(k, k + 500)) for k in range(0, len(WORN), 500)]
    del pieces[8]
    broken = pieces[10]
    pieces[10] = changed(broken, p_A=np.where(np.arange(len(broken)) == 99, np.nan, broken["p_A"]))
    pieces[13:] = [moved(piece, -1000.0) for piece in pieces[13:]]
    pieces.insert(5, pieces[4].only(["p_A", "p_B"]))
    pieces.insert(5, Recording(pieces[4].t, pieces[4].channels, {**pieces[4].units, "x": "count"}, 50.0))
    pieces.insert(5, Recording(np.full(500, np.nan), pieces[4].channels, pieces[4].units, 50.0))
    pieces.insert(5, Recording(pieces[4].t, pieces[4].channels, pieces[4].units, 1e9))
    fast = pieces[-1]
    pieces.append(Recording(fast.t[-1] + 0.02 + np.arange(500) / 100.0, dict(fast.channels), fast.units, 100.0))
    return pieces


def test_disorder_is_counted_by_reason_and_never_raised():
    watch = ss.watch("thesis", learn_hours=LEARN)
    for piece in disordered():
        watch.update(piece)
    assert set(watch.counters) == {
        "gap",
        "blocks: another duty",  # the last piece, played at double speed
        "clock set back",
        "rate changed",
        "samples without x",
        "samples of x not in m",
        "samples without a time",
        "samples at a rate outside 10 to 100000 Hz",
    }
    assert watch.leak is not None
    assert watch.leak.leak_lpm == pytest.approx(truth_lpm(WORN), rel=0.1)


@pytest.mark.slow
def test_disorder_does_not_depend_on_the_cuts():
    whole, fine = ss.watch("thesis", learn_hours=LEARN), ss.watch("thesis", learn_hours=LEARN)
    estimates: tuple[list[BlockEstimate], list[BlockEstimate]] = ([], [])
    for piece in disordered():
        estimates[0].extend(whole.update(piece))
        for start in range(0, len(piece), 77):
            estimates[1].extend(fine.update(piece.samples(slice(start, start + 77))))
    assert estimates[0] == estimates[1]
    assert whole.counters == fine.counters


@pytest.mark.slow
def test_another_rate_may_begin_with_late_samples():
    first, rest = WORN.samples(slice(0, 4000)), WORN.samples(slice(3001, 6000, 2))
    slow = Recording(rest.t, dict(rest.channels), rest.units, 25.0)
    estimates = []
    for pieces in ([slow], [slow.samples(slice(0, 400)), slow.samples(slice(400, None))]):
        watch = ss.watch("thesis", learn_hours=LEARN)
        estimates.append([block for piece in (first, *pieces) for block in watch.update(piece)])
        assert watch.counters["late or repeated samples"] == 500
    assert estimates[0] == estimates[1]


def test_warm_oil_and_another_duty_are_no_leak():
    warm = machine(2, G_pump=lambda t: 2.4e-13 * (1.0 + 0.6 * (1.0 - np.exp(-t / 150.0))), duration=170.0, rate=50.0)
    watch, _ = run(warm, [997])
    assert watch.leak is None
    other = machine(
        3, speed=lambda t: 24.0 * np.sin(4.0 * t), load=lambda t: 4e5 * np.sin(4.0 * t), duration=60.0, rate=50.0
    )
    estimates = watch.update(moved(other, 200.0))
    assert {estimate.status for estimate in estimates} == {"another duty"}
    assert watch.leak is None


def test_a_level_is_stated_with_what_warm_oil_may_have_of_it():
    place = {"version": 1, "known_s": 0.0, "hours": 8.0, "lpm": None}
    duty = {"duty_low": (0.0, 0.0), "duty_high": (0.0, 0.0)}
    scatter = {"deviation": 5e-14, "count": 600, "short_term_deviation": 5e-14}
    baseline = WatchBaseline(level=2e-13, low=1e-13, high=3e-13, **place, **duty, **scatter)
    onset = Interval(1e5, 0.0, 1e5)
    rise = find_level_rise(baseline, onset, 6e-13, 1e-15, 1e-6)
    assert rise is not None
    assert rise.size == pytest.approx(4e-13)
    assert rise.size - 1.96 * rise.deviation <= 2e-13  # the oil may be as warm as it gets, or as cold as it was
    assert rise.size + 1.96 * rise.deviation >= 5e-13
    assert find_level_rise(baseline, onset, 3.9e-13, 1e-15, 1e-6) is None
    # oil that warmed scatters the groups of blocks, but not successive ones
    warmed = replace(baseline, deviation=1.5e-13, short_term_deviation=1e-15)
    assert find_level_rise(warmed, onset, 6.5e-13, 1e-15, 1e-6) is not None
    assert find_level_rise(replace(warmed, short_term_deviation=1e-13), onset, 6.5e-13, 1e-15, 1e-6) is None
    assert find_level_rise(replace(warmed, high=6e-13), onset, 6.5e-13, 1e-15, 1e-6) is None


def test_a_leak_to_the_outside_is_stated_as_what_leaves_its_chamber():
    """At first it may be one past the piston, of half the flow."""
    recording = ss.simulate(
        command="3 sin(4t)",
        duration=150.0,
        seed=11,
        set={"makeup.check_valves": "present", "p_charge": "0.33 MPa"},
        fault="rod seal A 0.0042 L/min from 90 s",
    )
    watch = ss.watch("thesis", learn_hours=80.0 / 3600.0)
    estimate = watch.update(recording)[-1]
    assert watch.leak.cause == "external leak"
    leaves = 0.0042 * float(recording.between(90.0, 150.0)["p_A"].mean()) / 0.33e6
    for lpm, (low, high) in (
        (estimate.leak_lpm, estimate.leak_interval_lpm),
        (watch.leak.leak_lpm, watch.leak.leak_interval_lpm),
    ):
        assert low <= leaves <= high
        assert lpm == pytest.approx(leaves, rel=0.2)


def test_a_machine_at_standstill_is_not_judged():
    still = machine(4, speed=lambda t: np.where(t < 130.0, 12.0 * np.sin(4.0 * t), 0.0), duration=170.0, rate=50.0)
    watch, estimates = run(still, [1000])
    assert estimates[-1].status == "at standstill"
    assert watch.leak is None
    assert watch.counters["blocks: at standstill"] > 5


def test_a_repair_begins_a_new_baseline():
    watch = Watch.from_state(whole()[0].state())
    watch.relearn()
    assert watch.leak is None and watch.baseline is None
    healthy = machine(5, duration=90.0, rate=50.0)
    _, estimates = run(moved(healthy, 400.0), [900], watch)
    assert watch.baseline is not None and watch.baseline.version == 2
    assert watch.leak is None
    assert estimates[-1].status == "watched"


def test_a_dismissed_leak_is_compared_with_nothing_before():
    watch = Watch.from_state(whole()[0].state())
    watch.dismiss()
    more = machine(1, G=LEAK, duration=100.0, rate=50.0)
    run(moved(more, 300.0), [900], watch)
    assert watch.leak is None
    assert watch.baseline == whole()[0].baseline


def test_a_level_on_another_clock_has_its_onset_within_the_interval():
    """The baseline was learned at later times of the clock than that of the leak."""
    watch = Watch.from_state(whole()[0].state())
    watch.dismiss()
    watch.baseline = replace(watch.baseline, count=10, deviation=1e-14)  # as of longer learning
    watch.update(moved(machine(1, G=10.0 * LEAK, duration=80.0, rate=50.0), -1000.0), follows=False)
    assert watch.leak is not None and watch.leak.test == "level"
    low, high = watch.leak.onset_interval_s
    assert low <= watch.leak.onset_s <= high < 0.0


@pytest.mark.parametrize(
    "damage",
    [
        {"version": 99},
        {"estimator": {"names": []}},
        {"estimator": 1},
        {"rig": "{}"},
        {"detector": {}},
        {"samples": None},
        {"leak": {"raised_s": "x"}},
        {"compared": {"shape": [1e12, 6], "f8": ""}},
        {"grouped": "x"},
        {"blocks": None},
    ],
)
def test_a_damaged_state_is_refused_in_one_line(damage: dict[str, Any]):
    with pytest.raises(InputError) as raised:
        Watch.from_state({**whole()[0].state(), **damage})
    assert "\n" not in str(raised.value)


def test_the_largest_rate_that_is_allowed_holds_through_the_run():
    with pytest.raises(InputError) as refused:
        ss.watch("thesis", false_alarms_per_1000_h=1e9)
    largest = float(str(refused.value).split(" to ")[1].split(",")[0])
    watch = ss.watch("thesis", false_alarms_per_1000_h=largest, learn_hours=0.01)
    watch.update(ss.simulate(command="3 sin(4t)", duration="2 min", seed=1))
    assert watch.baseline is not None and watch.blocks > 30


def test_wrong_settings_are_refused():
    with refusal("false_alarms_per_1000_h"):
        ss.watch("thesis", false_alarms_per_1000_h=1e-6)
    with refusal("false_alarms_per_1000_h", "60000"):  # more than the test of the level can have
        ss.watch("thesis", false_alarms_per_1000_h=6e4)
    with refusal("learn_hours"):
        ss.watch("thesis", learn_hours=0.0)
