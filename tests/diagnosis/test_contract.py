"""One contract for every detector: never raises, says `cannot tell` where it must, sees nothing it must not."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.diagnosis.detectors import registry
from sealscope.diagnosis.detectors.registry import detectors, validate_report
from sealscope.diagnosis.diagnose import Examination, diagnose
from sealscope.diagnosis.rms_change.rms_detector import RmsChange
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import COUNTS, Recording

from ..representatives import SLOW, few

P = 0.01
VERDICTS = {"leak", "no leak", "cannot tell"}
Change = Callable[[Recording], Recording]


def with_channels(recording: Recording, **channels: np.ndarray) -> Recording:
    return replace(recording, channels={**recording.channels, **channels})


def counts(recording: Recording) -> Recording:
    """The pressures as a mapped channel without a unit would bring them: whole numbers of a converter."""
    pressures = recording.only(["p_A", "p_B"])
    channels = {name: np.rint(pressures[name] / 2500.0) for name in ("p_A", "p_B")}
    return replace(pressures, channels=channels, units={"p_A": COUNTS, "p_B": COUNTS})


def holding(recording: Recording, start: int, stop: int, value: float) -> Recording:
    p_A = np.array(recording["p_A"])
    p_A[start:stop] = value
    return with_channels(recording, p_A=p_A)


def every_second_missing(recording: Recording) -> Recording:
    p_A = np.array(recording["p_A"])
    p_A[1::2] = np.nan
    return with_channels(recording, p_A=p_A)


#: Recordings that a detector must be able to judge ...
GOOD: dict[str, Change] = {
    "whole": lambda r: r,
    "one gap near the end": lambda r: with_channels(r, p_A=np.where(np.arange(len(r)) == 30000, np.nan, r["p_A"])),
    "every second value missing": every_second_missing,
    "command without a value": lambda r: with_channels(r, u=np.full(len(r), np.nan)),
}
#: ... and recordings on which it must say `cannot tell`, with what its reason has to name.
HOPELESS: dict[str, tuple[Change, str]] = {
    "no samples": (lambda r: r.samples(slice(0, 0)), "226 samples"),
    "30 samples": (lambda r: r.samples(slice(0, 30)), "226 samples"),
    "two seconds": (lambda r: r.between(0.0, 2.0), "too short"),
    "no pressure": (lambda r: r.only(["u", "x", "p_1", "p_2"]), "p_A or p_B"),
    "constant pressure": (lambda r: with_channels(r, p_A=np.full(len(r), 3e5)), "p_A is constant"),
    "no value at all": (lambda r: with_channels(r, p_A=np.full(len(r), np.nan)), "226 samples"),
    "time in ms labelled s": (lambda r: replace(r, t=np.arange(len(r)) * 2.0, rate=0.5), "the unit of the time"),
    "pressures at 0.5 Hz": (
        lambda r: replace(r, t=np.arange(len(r)) * 2.0, rate=0.5).only(["p_A", "p_B"]),
        "needs 8 Hz or more to see the ringing",
    ),
    "time runs backwards": (lambda r: replace(r, t=r.t[::-1]), "226 samples"),
    "10 s at the rail": (lambda r: holding(r, 5000, 10000, float(r["p_A"].min())), "p_A does not move"),
    "10 s at zero": (lambda r: holding(r, 5000, 10000, 0.0), "p_A"),
    "a straight line": (
        lambda r: with_channels(r, p_A=np.arange(len(r)) * 1.0, p_B=np.arange(len(r)) * 2.0),
        "p_A moves along a straight line",
    ),
    "beyond floating point": (lambda r: with_channels(r, p_A=r["p_A"] * 1e200), "p_A"),
}


#: A balance of volumes leaves the samples at a rail out, and needs no heed of constant pressures.
BY_PRESSURES = ("10 s at the rail", "10 s at zero", "a straight line")

#: The detector of the documentation's example, which keeps the contract as well.
EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "ringing-energy" / "ringing_energy.py"


def example(rig: Rig):  # type: ignore[no-untyped-def]
    return runpy.run_path(str(EXAMPLE))["RingingEnergy"](rig)


EVERY = {**detectors(), "ringing energy": example}


@pytest.fixture(scope="module")
def leaky(records) -> Recording:  # type: ignore[no-untyped-def]
    """80 s with a leak of 0.02 L/min from second 40, which each detector finds."""
    return records(1, leak="0.02 L/min from 40 s", duration=80.0, throttled=True)


@pytest.fixture(autouse=True)
def every_detector(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let examinations find the example by its name."""
    monkeypatch.setattr(registry, "detectors", lambda: EVERY)


#: Detectors that say when something changed; others need only say whether.
DATED = ("volume balance", "pressure response", "rms change")
#: What is examined by the slow tests only: a recording, and whether beside a baseline.
OTHER_CASES = (("healthy", False), ("healthy", True))
#: ... and by hand alone.
ALIKE_CASES = (("leaky", True),)
#: Detectors to which the size of a pressure means something.
PHYSICAL = ("volume balance", "pressure response")
COURSE = ("t", "lpm", "low", "high")


@pytest.fixture(params=[*detectors(), pytest.param("ringing energy", marks=pytest.mark.slow)])
def detector(request: pytest.FixtureRequest):  # type: ignore[no-untyped-def]
    made = EVERY[request.param](load_rig("thesis"))
    assert made.name == request.param
    return made


def examined(  # type: ignore[no-untyped-def]
    detector, recording: Recording, probability: float = P, baseline: Sequence[Recording] = ()
) -> Evidence:
    assert detector.usable(recording) is None
    return Examination(recording, baseline, false_alarm_probability=probability).evidence(detector.name)


#: What detectors said of the recordings shared by all tests here, by detector, recording and probability.
SAID: dict[tuple[str, int, float], Evidence] = {}


def first_examined(detector, recording: Recording, probability: float = P) -> Evidence:  # type: ignore[no-untyped-def]
    """Examine a recording that lives as long as this module once for all tests."""
    key = (detector.name, id(recording), probability)
    if key not in SAID:
        SAID[key] = examined(detector, recording, probability)
    return SAID[key]


def alike(one: Evidence, other: Evidence) -> bool:
    """Whether two pieces of evidence say the same, the leak's course included."""
    courses = (one.course, other.course)
    if None in courses:
        return one == other
    followed = all(np.array_equal(getattr(courses[0], name), getattr(courses[1], name)) for name in COURSE)
    return followed and replace(one, course=None) == replace(other, course=None)


@pytest.mark.parametrize("change", few(GOOD, 2, SLOW))
def test_judges_what_it_can(change: str, leaky: Recording) -> None:
    result = diagnose(GOOD[change](leaky))
    assert result.verdict in ("leak", "no leak"), result.reason
    assert result.score is not None
    assert result.threshold is not None
    assert result.verdict == ("leak" if result.score > result.threshold else "no leak")


def test_ringing_that_falls_is_no_leak_by_itself(leaky: Recording) -> None:
    """Pressures in counts allow no balance: friction, duty and filters make the ringing fall as well."""
    result = diagnose(counts(leaky))
    assert result.verdict == "cannot tell"
    assert result.score is not None and result.threshold is not None and result.score > result.threshold


@pytest.mark.parametrize("change", HOPELESS)
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
def test_cannot_tell_where_it_must_and_says_why(change: str, leaky: Recording) -> None:
    make, named = HOPELESS[change]
    result = diagnose(make(leaky.only(["u", "p_A", "p_B"]) if change in BY_PRESSURES else leaky))
    assert result.verdict == "cannot tell"
    assert named in result.reason
    assert "\n" not in result.reason
    assert result.score is None
    assert result.onset_s is None


def test_pressures_along_a_straight_line_are_compared_with_no_baseline(records, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    """It was a leak: the response of p_B alone differs from that of healthy recordings."""
    channels = ("u", "p_A", "p_B")
    baseline = [records(seed, duration=60.0, throttled=True).only(channels) for seed in (2, 3, 4)]
    line = with_channels(leaky.only(channels), p_A=3e5 + 100.0 * leaky.t)
    result = diagnose(line, baseline)
    assert (result.verdict, result.score) == ("cannot tell", None)
    assert "p_A moves along a straight line" in result.reason


def test_unusable_is_one_line(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    assert isinstance(detector.name, str)
    for change in ("no samples", "30 samples", "no pressure", "constant pressure"):
        reason = detector.usable(HOPELESS[change][0](leaky))
        assert isinstance(reason, str)
        assert reason
        assert "\n" not in reason


@pytest.mark.slow
def test_deterministic(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    assert alike(first_examined(detector, leaky), examined(detector, leaky))


@pytest.mark.parametrize("case", ["leaky", pytest.param("healthy", marks=[pytest.mark.slow, pytest.mark.long])])
@pytest.mark.parametrize("factor, offset", few([(1.0, 1.0e5), (1.0 / 6894.757, -50.0), (3.0, 0.0)]))
def test_neither_unit_nor_zero_matters(  # type: ignore[no-untyped-def]
    detector, factor: float, offset: float, case: str, request: pytest.FixtureRequest
) -> None:
    if detector.name in PHYSICAL and factor != 1.0:
        pytest.skip("another scale of the pressures is another machine to a model in SI units")
    recording = request.getfixturevalue(case)
    scaled = with_channels(recording, **{name: factor * recording[name] + offset for name in ("p_A", "p_B")})
    before, after = first_examined(detector, recording), examined(detector, scaled)
    assert after.verdict == before.verdict
    if before.score is None:
        assert after.score is None
    else:
        # by runs in single precision, after as many steps as pay: a score is about the square of a z, which is known
        # to a small part of its deviation, 0.1
        rounded = 0.2 * np.sqrt(max(before.score, 0.25)) if detector.name == "pressure response" else 1e-12
        assert after.score == pytest.approx(
            before.score, rel=1e-6 if detector.name not in PHYSICAL else 1e-2, abs=rounded
        )
        assert after.threshold == pytest.approx(before.threshold, rel=1e-6 if detector.name not in PHYSICAL else 1e-2)
    assert after.onset_s == before.onset_s


def test_never_sees_the_flow_meter_or_where_the_data_come_from(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    metered = with_channels(leaky, q_leak=np.linspace(0.0, 1.0, len(leaky)))
    disclosed = replace(metered, provenance={"experiment": {"leak": "none"}}, history=("no leak",))
    assert alike(examined(detector, disclosed), first_examined(detector, leaky))


@pytest.mark.slow
def test_needs_no_flow_meter(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    assert alike(examined(detector, leaky.only(set(leaky.channels) - {"q_leak"})), first_examined(detector, leaky))


def test_onset_is_on_the_recordings_own_clock(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    here, later = first_examined(detector, leaky), examined(detector, replace(leaky, t=leaky.t + 1000.0))
    assert here.verdict == later.verdict == "leak"
    assert here.score == pytest.approx(later.score, rel=1e-9)
    if here.onset_s is None and detector.name not in DATED:
        assert later.onset_s is None
        return
    assert here.onset_s is not None
    assert here.onset_interval_s is not None
    assert later.onset_s == pytest.approx(here.onset_s + 1000.0, abs=1e-6)
    assert later.onset_interval_s == pytest.approx([one + 1000.0 for one in here.onset_interval_s], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        pytest.param(["x"], marks=[pytest.mark.slow, pytest.mark.long]),
        ["x", "theta", "omega", "p_1", "p_2"],
    ],
)
def test_holes_in_other_channels_are_no_fault(detector, names: list[str], leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    """Only the pressures and the command are promised to be whole."""
    holes = np.arange(len(leaky)) % 7919 == 100
    recording = with_channels(leaky, **{name: np.where(holes, np.nan, leaky[name]) for name in names})
    if detector.usable(recording) is None:
        result = examined(detector, recording)
        assert result.verdict in VERDICTS
        assert result.score is None or np.isfinite(result.score)


def test_a_smaller_false_alarm_probability_asks_for_more(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    thresholds = [first_examined(detector, leaky, p).threshold for p in (0.2, 0.01)]
    assert thresholds[0] < thresholds[1]


def test_reports_hold_numbers_alone(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    report = validate_report(detector.observe(leaky, ()), detector.name)
    assert report.observables and not report.lack
    for observable in report.observables:
        assert observable.name and 0.0 <= observable.chance <= 1.0 and np.isfinite(observable.score)
        if observable.onset is not None:
            assert observable.onset.low <= observable.onset.value <= observable.onset.high


def test_questions_share_the_probability(detector, leaky: Recording) -> None:  # type: ignore[no-untyped-def]
    for question in first_examined(detector, leaky).parts:
        assert question.verdict in VERDICTS
        assert question.score is not None and question.threshold is not None


def test_noise_alone_never_is_a_leak(leaky: Recording) -> None:
    """d1 holds no ringing that a leak damps."""
    report = RmsChange().observe(leaky)
    assert {observable.data for observable in report.observables if " d1 " in observable.name} == {"noise of details"}


@pytest.mark.parametrize(
    ("case", "with_baseline"),
    [
        ("leaky", False),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in OTHER_CASES),
        *(pytest.param(*each, marks=[pytest.mark.slow, pytest.mark.long]) for each in ALIKE_CASES),
    ],
)
def test_the_chance_agrees_with_score_and_threshold(
    detector,  # type: ignore[no-untyped-def]
    case: str,
    with_baseline: bool,
    request: pytest.FixtureRequest,
) -> None:
    """At each probability asked for: the score is over the threshold where the chance is below it, and only there."""
    recording = request.getfixturevalue(case)
    baseline = [request.getfixturevalue("records")(9, duration=120.0, throttled=True)] if with_baseline else []
    for probability in (0.05, P):
        evidence = (
            examined(detector, recording, probability, baseline)
            if baseline
            else first_examined(detector, recording, probability)
        )
        if evidence.score is None:
            assert evidence.chance is None
            continue
        assert 0.0 < evidence.chance <= 1.0
        assert (evidence.chance <= probability * (1.0 + 1e-9)) == (evidence.score > evidence.threshold)


def test_odds_in_words() -> None:
    said = {chance: Evidence("leak", "", chance=chance).odds for chance in (None, 1e-4, 0.00312, 0.05, 0.5, 1.0)}
    assert said[None] is None
    assert said[1e-4] == "fewer than 1 in 10 000 healthy recordings looks like this"
    assert said[0.00312] == "1 in 320 healthy recordings looks like this"
    assert said[0.05] == "1 in 20 healthy recordings looks like this"
    assert said[0.5] == said[1.0] == "more than 1 in 5 healthy recordings look like this"
    unchanged = Evidence("no leak", "", chance=0.05)
    assert unchanged.odds == "1 in 20 healthy recordings shows as much change"


def test_odds_are_in_every_output(leaky: Recording) -> None:
    from sealscope.reporting.messages import diagnosis_text

    result = diagnose(leaky)
    assert result.verdict == "leak"
    assert result.odds in diagnosis_text(result)
    assert result.as_dict()["odds"] == result.odds
    assert result.as_dict()["chance"] <= 0.01
    stated = [method["odds"] for method in result.as_dict()["methods"]]
    assert any(stated)
