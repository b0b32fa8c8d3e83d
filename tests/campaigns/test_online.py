"""A detector's stream as a plan's detector: the alarm that a machine watched from the record's start would have."""

import pytest

import sealscope as ss
from sealscope.campaigns.cases.scoring import online
from sealscope.campaigns.plans.detectors import check_detector, plan_detector
from sealscope.errors import InputError


@pytest.fixture(scope="module")
def recording():
    return ss.simulate(command="3 sin(4t)", duration="90 s", leak="0.0042 L/min from 60 s", seed=1)


def test_a_stream_that_is_watched_raises_the_alarm_of_the_record(recording):
    said = online(recording, "thesis", 0.01)
    assert said.verdict == "leak"
    assert said.onset_s == pytest.approx(60.0, abs=1.0)
    low, high = said.leak_interval_lpm
    assert low < 0.0042 < high
    watched = ss.SequentialBalance("thesis", alarms_per_hour=0.01 * 3600 / 90)
    assert watched.update(recording).alarm == said  # however the samples are cut


def test_before_the_leak_nothing_is_raised(recording):
    assert online(recording.between(0.0, 60.0), "thesis", 0.01).verdict == "no leak"


def test_a_stream_without_its_channels_cannot_tell(recording):
    said = online(recording.only(["u", "p_A", "p_B"]), "thesis", 0.01)
    assert said.verdict == "cannot tell"
    assert "position" in said.reason or "x" in said.reason


def test_only_detectors_with_a_stream_are_online():
    parsed = plan_detector("volume balance, online @ some")
    assert (parsed.of, parsed.online, parsed.view) == ("volume balance", True, "some")
    check_detector("volume balance, online", {})
    with pytest.raises(InputError, match="online must be one of volume balance, got 'observer, online'"):
        check_detector("observer, online", {})
