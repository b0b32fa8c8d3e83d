"""The watch of a machine as a plan's detector: the alarm that it would have at the record's end."""

import pytest

import sealscope as ss
from sealscope.campaigns.cases.scoring import run_watch
from sealscope.campaigns.plans.detectors import check_detector, parse_detector_name


@pytest.fixture(scope="module")
def recording():
    return ss.simulate(command="3 sin(4t)", duration="90 s", leak="0.0042 L/min from 62 s", seed=1)


def test_a_machine_that_is_watched_raises_the_alarm_of_the_record(recording):
    evidence = run_watch(recording, "thesis", 0.01)
    assert evidence.verdict == "leak"
    assert evidence.onset_s == pytest.approx(62.0, abs=1.0)
    low, high = evidence.leak_interval_lpm
    assert low < 0.0042 < high
    watch = ss.watch("thesis", false_alarms_per_1000_h=0.01 * 3.6e6 / 90, learn_hours=1000.0)
    watch.update(recording)
    assert watch.evidence.score == evidence.score  # however the samples are cut


def test_before_the_leak_nothing_is_raised(recording):
    assert run_watch(recording.between(0.0, 62.0), "thesis", 0.01).verdict == "no leak"


def test_a_machine_without_its_channels_cannot_be_watched(recording):
    evidence = run_watch(recording.only(["x", "p_A"]), "thesis", 0.01)
    assert evidence.verdict == "cannot tell"
    assert "p_B" in evidence.reason


def test_a_plan_names_it_with_a_view():
    parsed = parse_detector_name("watch @ some")
    assert (parsed.base, parsed.scorer, parsed.view) == ("watch", None, "some")
    check_detector("watch", {})
