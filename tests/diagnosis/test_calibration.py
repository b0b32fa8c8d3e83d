"""Thresholds from leak-free recordings: their rate is what they say, they are kept whole in a file, and they hold for
the operating points they were made at only."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.baseline.operating_point import OperatingPoint
from sealscope.diagnosis.calibration.calibrated import (
    DEFAULT_DETECTORS,
    calibrate_on,
    default_detectors,
    diagnose_calibrated,
)
from sealscope.diagnosis.calibration.scorers import SCORERS, Look, scorer
from sealscope.diagnosis.calibration.thresholds import Place, as_dict, calibrate, grouped, load, save, with_judge
from sealscope.diagnosis.diagnose import diagnose
from sealscope.errors import InputError, UnreadableFile

RATE = 0.1
DETECTORS = ("d3 of p_A changed", "d4 of p_B changed", "d3 of p_A low")
POINT = OperatingPoint(0, 11.0, 500.0, ("Pa", "Pa"), ("p_A", "p_B"), 2.12, 1.57)


def place(duration=180.0, **point):
    return Place(replace(POINT, **point), duration)


@pytest.fixture(scope="module")
def sound_ones(records):
    """Leak-free recordings of 20 s, equal but for the noise."""
    return {f"sound-{seed}": records(seed, duration=20.0, throttled=True) for seed in range(12)}


@pytest.fixture(scope="module")
def calibration(sound_ones):
    return calibrate_on(sound_ones, DETECTORS, false_alarm_probability=RATE)


# scorers


@pytest.fixture(scope="module")
def look(records):
    return Look(records(50, duration=20.0, throttled=True))


@pytest.mark.parametrize("name", SCORERS)
def test_every_scorer_keeps_the_contract(name, look, noise_record):
    one = scorer(name)
    assert one.name == name
    assert one.about
    for recording in (look, Look(noise_record(1, 4000))):
        found = one.score(recording)
        assert found.value is None or math.isfinite(found.value)
        assert found.value is not None or found.reason
        assert one.score(recording) == found
    if one.name.endswith("changed"):
        assert one.score(look).value >= 0
    short = one.score(Look(noise_record(2, 100)))
    assert short.value is None
    assert short.reason


def test_changes_follow_the_closed_form(noise_record):
    """White noise whose standard deviation falls to 0.8 at the split: every log RMS falls by ln 0.8, d3d4 by twice."""
    plain = noise_record(3, 60000)
    scale = np.where(np.arange(60000) < 30000, 1.0, 0.8)
    changed = replace(plain, channels={name: plain[name] * scale for name in plain.channels})
    for quantity, power in (("d1", 1), ("d2", 1), ("d3", 1), ("d4", 1), ("d3d4", 2)):
        fell = [scorer(f"{quantity} of p_A fell").score(Look(one)).value for one in (changed, plain)]
        assert fell[0] - fell[1] == pytest.approx(-power * math.log(0.8), abs=1e-9)
        assert scorer(f"{quantity} of p_A rose").score(Look(changed)).value == -fell[0]
        assert scorer(f"{quantity} of p_A changed").score(Look(changed)).value == abs(fell[0])
    louder = replace(plain, channels={name: plain[name] * 3.0 for name in plain.channels})
    low = [scorer("d3 of p_B low").score(Look(one)).value for one in (louder, plain)]
    assert low[0] - low[1] == pytest.approx(-math.log(3.0), abs=1e-12)


def test_nothing_beyond_the_split_is_seen_before_it(noise_record):
    """A burst right after the split moves the second part only."""
    plain = noise_record(4, 8000)
    burst = plain["p_A"].copy()
    burst[4000:4100] += 50.0 * (-1.0) ** np.arange(100)
    bursty = replace(plain, channels={**plain.channels, "p_A": burst})
    before, after = Look(plain).sides.log_rms["p_A"], Look(bursty).sides.log_rms["p_A"]
    assert np.array_equal(before[0], after[0])
    late = plain["p_A"].copy()
    late[4400:4500] += 50.0 * (-1.0) ** np.arange(100)
    assert (
        Look(replace(plain, channels={**plain.channels, "p_A": late})).sides.log_rms["p_A"][1][0] > before[1][0] + 0.5
    )


def test_an_unknown_scorer_gets_a_hint():
    with pytest.raises(InputError, match="did you mean 'rms change'"):
        scorer("rms chang")


# thresholds


def test_the_rate_is_the_one_asked_for_on_fresh_scores():
    """Exact for any continuous score: over many calibrations the mean rate is rank/(n + 1)."""
    random = np.random.default_rng(1)
    rates = []
    for _ in range(400):
        known = random.standard_cauchy(59)
        found = calibrate([place()] * 59, {"d3 of p_A fell": list(known)}, false_alarm_probability=0.05)
        threshold = found.groups[0].thresholds["d3 of p_A fell"]
        assert (threshold.rank, threshold.expected) == (3, 0.05)
        rates.append(0.5 - math.atan(threshold.value) / math.pi)
    assert np.mean(rates) == pytest.approx(0.05, abs=4 * np.std(rates) / 20)
    inside = np.mean([threshold.low <= rate <= threshold.high for rate in rates])
    assert inside == pytest.approx(0.95, abs=0.04)


def test_a_bound_is_kept_by_nineteen_calibrations_in_twenty():
    random = np.random.default_rng(2)
    kept = 0
    for _ in range(300):
        found = calibrate(
            [place()] * 59, {"d3 of p_A fell": list(random.random(59))}, false_alarm_probability=0.05, promise="bound"
        )
        kept += 1 - found.groups[0].thresholds["d3 of p_A fell"].value <= 0.05
    assert kept / 300 == pytest.approx(0.95, abs=0.04)


def test_too_few_recordings_say_how_many_it_takes(sound_ones):
    few = dict(list(sound_ones.items())[:4])
    with pytest.raises(InputError, match=r"must be at least 5 at an operating point, .* got at most 4"):
        calibrate_on(few, DETECTORS, false_alarm_probability=0.01)


def test_few_recordings_extrapolate_the_tail(sound_ones, records):
    """Twelve for 1 %: every detector has a threshold, over all their scores, with the interval of the true rate."""
    found = calibrate_on(sound_ones, DETECTORS, false_alarm_probability=0.01)
    assert set(found.groups[0].thresholds) == set(DETECTORS)
    for name, threshold in found.groups[0].thresholds.items():
        scores = [scorer(name).score(Look(recording)).value for recording in sound_ones.values()]
        assert threshold.value > max(scores)
        assert threshold.low < 0.01 < threshold.high
        assert (threshold.rank, threshold.n) == (0, 12)
    leaky = records(98, duration=20.0, leak="0.1 L/min from 10 s", throttled=True)
    verdict = diagnose_calibrated(leaky, found)
    assert verdict.verdict == "leak"
    assert "by an extrapolated tail" in verdict.reason
    fresh = [diagnose_calibrated(records(seed, duration=20.0, throttled=True), found).verdict for seed in range(60, 66)]
    assert fresh.count("leak") <= 1


def test_a_point_with_too_few_has_no_threshold():
    places = [place()] * 12 + [place(command_rms=5.0)] * 3
    found = calibrate(places, {"d3 of p_A fell": [float(k) for k in range(15)]}, false_alarm_probability=0.1)
    assert [bool(group.thresholds) for group in found.groups] == [True, False]


def test_the_first_detector_that_judges_makes_the_verdict(sound_ones):
    """20 s are too short for a scan of their own, so that `rms change` has no score to calibrate with."""
    short = {name: recording.between(0.0, 8.0) for name, recording in sound_ones.items()}
    found = calibrate_on(short, ("rms change", *DETECTORS), false_alarm_probability=0.1)
    assert "rms change" not in found.groups[0].thresholds
    verdict = diagnose_calibrated(next(iter(short.values())), found)
    assert verdict.verdict in ("leak", "no leak")
    assert verdict.methods[0].detector == DETECTORS[0]
    last = next(method for method in verdict.methods if method.detector == "rms change")
    assert "too short to be its own baseline" in last.reason


def test_a_record_that_could_not_be_told_counts_as_no_alarm():
    scores = [None, *(float(k) for k in range(9))]
    found = calibrate([place()] * 10, {"rms change": scores}, false_alarm_probability=0.1)
    assert found.groups[0].thresholds["rms change"].n == 10


def test_what_has_its_own_threshold_is_not_calibrated():
    with pytest.raises(InputError, match="has a threshold of its own"):
        calibrate([place()] * 20, {"sign rule: d3 of p_A fell": [0.0] * 20}, false_alarm_probability=0.1)


# operating points


def test_recordings_are_grouped_by_where_they_were_made():
    places = [place(), place(direction=1), place(level=13.0), place(command_rms=2.14), place(cycle=3.1), place(60.0)]
    assert grouped(places) == [[0, 2, 3], [1], [4], [5]]


@pytest.mark.parametrize(
    ("there", "told"),
    [
        (place(rate=1000.0), "another sampling rate"),
        (place(command_rms=5.0), "another command"),
        (place(direction=-1), "another direction of the stroke"),
        (place(units=("count", "count")), "other channels or units"),
        (place(level=12.0), "another pressure level"),
        (place(level=10.0), "another pressure level"),
        (place(30.0), r"another length \(30 s, calibrated with 180 s\)"),
    ],
)
def test_outside_the_calibrated_points_says_why(there, told):
    found = calibrate([place()] * 20, {"d3 of p_A fell": [float(k) for k in range(20)]}, false_alarm_probability=0.1)
    assert not isinstance(found.find(place()), str)
    reason = found.find(there)
    assert isinstance(reason, str)
    assert re.search(told, reason)


# diagnoses


def test_a_sound_recording_and_a_leaky_one(records, calibration):
    fresh = [records(seed, duration=20.0, throttled=True) for seed in range(60, 80)]
    alarms = [diagnose_calibrated(one, calibration).verdict for one in fresh].count("leak")
    assert alarms <= 6  # 12 recordings leave the true rate within 0.2 % to 26 %
    leaky = diagnose_calibrated(records(98, duration=20.0, leak="0.1 L/min from 10 s", throttled=True), calibration)
    assert leaky.verdict == "leak"
    assert leaky.score > leaky.threshold
    assert leaky.false_alarm_probability == RATE
    assert [method.detector for method in leaky.methods] == list(DETECTORS)
    assert "set from 12 leak-free recordings" in leaky.reason


def test_the_first_detector_makes_the_verdict(records, calibration):
    recording = records(97, duration=20.0, leak="0.1 L/min from 10 s", throttled=True)
    for name in DETECTORS:
        found = diagnose_calibrated(recording, with_judge(calibration, name))
        assert found.methods[0].detector == name
        assert (found.verdict, found.score) == (found.methods[0].verdict, found.methods[0].score)
    with pytest.raises(InputError, match="the judging detector must be one of"):
        with_judge(calibration, "rms change")


def test_another_operating_point_cannot_be_told(records, calibration):
    found = diagnose_calibrated(records(96, duration=20.0, command="5 sin(2t)", throttled=True), calibration)
    assert found.verdict == "cannot tell"
    assert "outside the calibrated operating points: another command" in found.reason
    assert found.score is None


def test_data_that_cannot_be_trusted_cannot_be_told(records, calibration):
    recording = records(95, duration=20.0, throttled=True)
    stuck = replace(recording, channels={**recording.channels, "p_A": np.full(len(recording), 2e5)})
    found = diagnose_calibrated(stuck, calibration)
    assert found.verdict == "cannot tell"
    bare = recording.only(["u", "x"])
    assert "needs the pressure of a chamber" in diagnose_calibrated(bare, calibration).reason
    empty = recording.between(0.0, 0.1)
    assert diagnose_calibrated(empty, calibration).verdict == "cannot tell"


def test_a_spoilt_recording_has_no_place_in_a_calibration(sound_ones):
    bad = next(iter(sound_ones.values())).between(0.0, 0.1)
    with pytest.raises(InputError, match=r"must be in good order, got: needs 226 samples .* \(bad\)"):
        calibrate_on({**sound_ones, "bad": bad}, DETECTORS, false_alarm_probability=RATE)


def test_the_default_detectors_are_there():
    for name in DEFAULT_DETECTORS:
        assert scorer(name).threshold is None


def test_the_channels_decide_which_detectors_are_calibrated(records):
    whole = records(1, duration=20.0, throttled=True)
    assert default_detectors([whole])[:2] == ("volume balance, calibrated", "rms change")
    no_angle = whole.only([name for name in whole.channels if name not in ("theta", "omega", "u")])
    assert default_detectors([whole, no_angle])[0] == "rms change"  # the pressure response needs 40 s
    assert default_detectors([whole.only(["p_A"])]) == ("rms change", "d3 of p_A changed", "d4 of p_A changed")


def test_a_calibrated_balance_states_its_figures(records):
    sound = {f"sound-{seed}": records(seed, duration=20.0) for seed in range(5)}
    calibration = calibrate_on(sound, ("volume balance, calibrated",), false_alarm_probability=RATE)
    worn = records(60, duration=20.0, leak="0.02 L/min from 10 s")
    by_itself = diagnose(worn)
    found = diagnose_calibrated(worn, calibration)
    assert found.verdict == by_itself.verdict == "leak"
    assert (found.leak_lpm, found.onset_interval_s) == (by_itself.leak_lpm, by_itself.onset_interval_s)
    assert found.threshold == calibration.groups[0].thresholds["volume balance, calibrated"].value
    assert found.relative == by_itself.relative
    healthy = diagnose_calibrated(records(61, duration=20.0), calibration)
    assert healthy.passage is not None


def test_the_place_of_a_recording(records):
    found = Place.of(records(1, duration=20.0, throttled=True))
    assert found.duration_s == 20.0
    assert found.point.command_rms == pytest.approx(3 / math.sqrt(2), rel=0.02)


# files


def test_a_file_gives_back_the_same_calibration(calibration, tmp_path, records):
    path = tmp_path / "calibration.json"
    save(replace(calibration, made_from={"recordings": ["a", "b"]}), path)
    back = load(path)
    assert as_dict(back) == as_dict(replace(calibration, made_from={"recordings": ["a", "b"]}))
    recording = records(94, duration=20.0, throttled=True)
    assert diagnose_calibrated(recording, back) == diagnose_calibrated(recording, calibration)
    save(back, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def spoil(change):
    def made(tree):
        change(tree)
        return json.dumps(tree).encode()

    return made


@pytest.mark.parametrize(
    "content",
    [
        lambda _: b"",
        lambda _: b"\x00\x01\x02",
        lambda _: b"[1, 2]",
        spoil(lambda tree: tree.update(format="sealscope calibration 99")),
        spoil(lambda tree: tree.pop("groups")),
        spoil(lambda tree: tree["groups"][0].pop("levels")),
        spoil(lambda tree: tree.update(detectors=["nothing"])),
        spoil(lambda tree: tree.update(false_alarm_rate=2.0)),
        spoil(lambda tree: tree["groups"][0]["thresholds"]["d3 of p_A changed"].update(value=float("nan"))),
        spoil(lambda tree: tree["groups"][0]["point"].update(colour="red")),
    ],
)
def test_a_file_that_is_none_is_one_line(calibration, tmp_path, content):
    path = tmp_path / "bad.json"
    path.write_bytes(content(as_dict(calibration)))
    with pytest.raises(UnreadableFile) as error:
        load(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(UnreadableFile, match="must be readable"):
        load(tmp_path / "none.json")


def test_commands_are_not_needed_beside_the_pressures(noise_record):
    """Pressures of a swinging piston without a command or position: the point is what the pressures tell."""

    def swinging(seed):
        record = noise_record(seed, 4000)
        swing = 2e5 * np.sin(4.0 * record.t)
        pressures = {"p_A": 8e5 + swing + 3e3 * record["p_A"], "p_B": 8e5 - swing + 3e3 * record["p_B"]}
        return replace(record, channels=pressures)

    recordings = {str(seed): swinging(seed) for seed in range(10)}
    found = calibrate_on(recordings, ("d3 of p_A changed",), false_alarm_probability=RATE)
    assert diagnose_calibrated(swinging(99), found).verdict in ("leak", "no leak")
    quiet = swinging(98)
    louder = replace(quiet, channels={name: quiet[name] * 10.0 for name in quiet.channels})
    assert "another pressure level" in diagnose_calibrated(louder, found).reason
