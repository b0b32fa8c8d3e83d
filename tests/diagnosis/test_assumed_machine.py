"""What L/min rests on: the machine that was stated, or none; how bad a leak is without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.assumed_rig import assumed_rig, infer_rig
from sealscope.diagnosis.detectors import registry
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inference.pressures.response_detector import PressureResponse
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LeakCourse
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.diagnosis.verdict.severity import RepairLimit, severity
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording
from sealscope.reporting.charts import course_charts
from sealscope.reporting.messages import how_bad, how_much, machine_text, next_steps, short_text
from sealscope.simulation.simulate import simulate

from ..refusals import refusal
from ..wording import says
from .balance_machine import AREA, machine, step
from .judging import judge

LPM = 6.0e4
LEAK = 3.0e-13


@pytest.fixture(scope="module")
def foreign() -> Recording:
    """A leak past the piston of a machine that nobody has stated."""
    return machine(1, G=step(0.0, LEAK))


def stated(**values: str) -> Rig:
    names = {"area": ("cylinder.A_A", "cylinder.A_B"), "displacement": ("pump.q_b",)}
    return unstated_rig().with_overrides({name: text for key, text in values.items() for name in names[key]})


def flow(recording: Recording, share: float = 1.0) -> float:
    return share * LEAK * float(np.mean(np.abs(recording["p_A"] - recording["p_B"])[recording.t > 60.0])) * LPM


@pytest.mark.slow
@pytest.mark.long
def test_a_machine_five_times_as_large_gives_the_same_recording_and_no_flow(foreign: Recording) -> None:
    """Displacement, area and leak five times as large: 0.021 L/min was stated as 0.0043."""
    result = diagnose(foreign)
    assert result.verdict == "leak"
    assert result.leak_lpm is result.leak_interval_lpm is None
    assert result.refuses == {"leak_lpm"}
    assert says(str(how_much(result)), "how_much.machine_or_area")
    assert result.measured_ratio == (pytest.approx(1.0, abs=0.01), pytest.approx((1.0, 1.0), abs=0.02))
    small = diagnose(foreign, rig=stated(area=f"{AREA} m^2"))
    large = diagnose(foreign, rig=stated(area=f"{5 * AREA} m^2"))
    assert small.leak_lpm == pytest.approx(flow(foreign), rel=0.05)
    assert large.leak_lpm == pytest.approx(5.0 * small.leak_lpm, rel=1e-6)
    for other in (small, large):
        assert other.refuses == frozenset()
        assert result.severity is not None and other.severity is not None
        assert other.severity.pump_share == pytest.approx(result.severity.pump_share)
        assert other.severity.creep_mm_per_min == pytest.approx(result.severity.creep_mm_per_min)
        assert says(str(machine_text(other.machine)), "machine.area") and says(short_text(other), "machine.area")


def test_pump_share_and_creep_are_those_of_the_machine(foreign: Recording) -> None:
    result = diagnose(foreign).severity
    assert result is not None and result.pump_share is not None and result.creep_mm_per_min is not None
    assert result.mL_per_min is None
    pump = 4.9e-6 / (2.0 * np.pi) * 12.0 * 2.0 / np.pi * LPM  # mean of the size of 12 sin(4 t) rad/s
    assert result.pump_share[0] == pytest.approx(flow(foreign) / pump, rel=0.05)
    assert result.creep_mm_per_min[0] == pytest.approx(flow(foreign) / LPM / AREA * 6.0e4, rel=0.05)


@pytest.mark.parametrize("ratio", [0.5, pytest.param(1.4, marks=pytest.mark.slow)])
def test_area_or_displacement_alone_gives_the_flow_whatever_the_other_is(ratio: float) -> None:
    recording = machine(1, G=step(0.0, LEAK), ratio=ratio)
    by_area = diagnose(recording, rig=stated(area=f"{AREA} m^2"))
    by_pump = diagnose(recording, rig=stated(displacement=f"{ratio * 4.9} cm^3/rev"))
    both = diagnose(recording, rig="thesis")
    assert by_area.leak_lpm == pytest.approx(flow(recording), rel=0.06)
    assert by_pump.leak_lpm == pytest.approx(by_area.leak_lpm, rel=0.01)
    assert says(both.reason, "remark.sizes disagree")
    for by in (by_area, by_pump):  # either may be wrong: the interval holds what both say
        assert both.leak_interval_lpm[0] <= by.leak_lpm <= both.leak_interval_lpm[1]
    assert diagnose(recording).leak_lpm is None


@pytest.mark.slow
def test_pressures_alone_state_no_flow_without_a_rig() -> None:
    own = simulate(command="3 sin(4t)", leak="0.02 L/min from 20 s", duration="40 s", seed=1)
    pressures = own.only(["u", "p_A", "p_B"])
    foreign = diagnose(replace(pressures, provenance={}))
    known = judge(PressureResponse(assumed_rig(None, pressures)[0]), pressures)
    assert known.leak_lpm == pytest.approx(0.02, rel=0.5)
    assert (known.verdict, known.score) == (foreign.verdict, foreign.score)
    assert foreign.leak_lpm is None and foreign.severity is None
    assert says(foreign.reason, "alarm.no_size") and "L/min," not in foreign.reason
    assert all(own.leak_lpm is None and own.course is None for own in foreign.parts)
    area_alone = judge(PressureResponse(stated(area=f"{AREA} m^2")), pressures)
    assert area_alone.leak_lpm is None  # the ringing needs the moving mass, too


def test_who_states_the_machine() -> None:
    own = simulate(command="3 sin(4t)", duration="5 s", seed=1)
    other = simulate(command="3 sin(4t)", duration="5 s", seed=1, set={"pump.q_b": "3.9[cm^3/rev]"})
    for recording, rig, who in (
        (own, None, "recording"),
        (other, None, "nobody"),
        (replace(own, provenance={}), None, "nobody"),
        (own, "thesis", "call"),
        (other, stated(area="9 cm^2"), "nobody"),
    ):
        known, assumed = assumed_rig(rig, recording)
        assert assumed.stated_by == who
        assert known.states("cylinder.M_eq") == (who != "nobody")
    assert (assumed.area_stated, assumed.displacement_stated, assumed.has_stated_sizes) == (True, False, False)
    assert assumed.area == pytest.approx(9e-4)


def logged(rig: str, command: str, load: str) -> Recording:
    """A recording of a machine that nobody stated: the command, the position and four pressures."""
    recording = simulate(rig=rig, command=command, load=load, duration="10 s", seed=1)
    names = ("u", "x", "p_A", "p_B", "p_1", "p_2")
    units = {name: recording.units[name] for name in names}
    return replace(recording, channels={name: recording[name] for name in names}, units=units, provenance={})


def changed(recording: Recording, **channels: np.ndarray) -> Recording:
    return replace(recording, channels={**recording.channels, **channels})


def test_a_supply_above_both_chambers_is_that_of_a_valve() -> None:
    """Dropouts and an area that is stated change nothing; the area stays."""
    recording = logged("servo-valve", "2 sin(4t)", "0 N")
    missing = np.where(np.arange(len(recording)) % 5 == 0, np.nan, recording["p_1"])
    for each, rig in ((recording, None), (changed(recording, p_1=missing), stated(area="1000 mm^2"))):
        used, assumed = assumed_rig(rig, each)
        assert used.circuit.valve_controlled
        assert assumed.stated_by == "nobody"
        assert assumed.area_stated == (rig is not None)
    assert abs(used.cylinder.A_A - 1e-3) < 1e-9
    assert not assumed_rig("thesis", recording)[0].circuit.valve_controlled
    assert not assumed_rig(stated(displacement="5 cm^3/rev"), recording)[0].circuit.valve_controlled


def test_the_first_recording_with_the_supplys_pressure_shows_a_valve() -> None:
    recording = logged("servo-valve", "2 sin(4t)", "0 N")
    inferred = infer_rig(None, [recording.only(["u", "x", "p_A", "p_B"]), recording])
    assert inferred is not None and inferred.circuit.valve_controlled
    assert infer_rig(None, []) is None


@pytest.mark.parametrize(
    ("rig", "command", "load"), [("single-rod-eha", "2 sin(4t)", "8 kN"), ("thesis", "1 sin(4t) + 2", "0 N")]
)
def test_the_port_of_a_pump_is_no_supply(rig: str, command: str, load: str) -> None:
    """Its pressure is that of the loaded chamber, but for a zero, and counts compare with nothing."""
    recording = logged(rig, command, load)
    counts = replace(recording, units={**recording.units, "p_A": "count", "p_B": "count"})
    scaled = changed(counts, p_A=1e-4 * recording["p_A"], p_B=1e-4 * recording["p_B"])
    for each in (recording, changed(recording, p_1=recording["p_1"] + 5e4), scaled, recording.samples(slice(0, 0))):
        assert not assumed_rig(None, each)[0].circuit.valve_controlled


def test_no_leak_passes_a_share_of_the_pumps_flow() -> None:
    result = diagnose(machine(1))
    assert result.verdict == "no leak"
    assert result.total_leakage is not None and result.total_leakage.lpm is None
    pump = 4.9e-6 / (2.0 * np.pi) * 12.0 * 2.0 / np.pi
    own = 2.4e-13 * result.total_leakage.pressure / pump
    assert result.total_leakage.pump_share == pytest.approx(own, rel=0.2)
    text = " ".join(short_text(result).split())
    assert says(text, "leakage.share", pressure="1.1 bar") and says(text, "leakage.findable")
    assert "L/min" not in text


def leak(lpm: float, low: float, high: float, **changed: object) -> Diagnosis:
    """A leak of a machine whose rig is stated."""
    recording = Recording(np.arange(10.0), {"omega": np.full(10, 2 * np.pi)}, {"omega": "rad/s"}, 1.0)
    base = Diagnosis("leak", "r", 9.0, 3.0, leak_lpm=lpm, leak_interval_lpm=(low, high), false_alarm_probability=0.01)
    values = {name: value for name, value in vars(base).items() if name in Diagnosis.__mro__[1].__dataclass_fields__}
    evidence = Diagnosis.__mro__[1](**values)
    return Diagnosis.from_evidence(
        evidence, recording, assumed_rig("thesis", recording)[1], file="f", false_alarm_probability=0.01, **changed
    )


@pytest.mark.parametrize(
    ("interval", "level", "step_"),
    [((0.0055, 0.007), "repair", "now"), ((0.002, 0.003), "plan", "plan the"), ((0.001, 0.002), "monitor", "urgent")],
)
def test_levels_by_the_interval(interval: tuple[float, float], level: str, step_: str) -> None:
    """8 mm/min of a piston of 633 mm^2 are 5.06 mL/min."""
    result = leak(sum(interval) / 2, *interval)
    assert result.severity is not None
    assert result.severity.level == level
    assert result.severity.pump_share is not None
    assert result.severity.pump_share[0] == pytest.approx(sum(interval) / 2 / 1000.0 / (60 * 4.9e-6))
    assert any(step_ in text for text in next_steps(result))
    assert "8 mm/min of creep, the default" in str(how_bad(result))


def test_the_repair_limit_is_drawn_in_the_unit_of_the_leak() -> None:
    """8 mm/min of a piston of 633 mm^2 are 5.06 mL/min; a limit as a flow needs no area."""
    course = LeakCourse(np.array([1.0, 2.0]), np.array([0.0, 0.006]), np.array([0.0, 0.0055]), np.array([0.0, 0.0065]))
    for limit, level in ((None, 8e-3 * 633e-6 * 1e3), ("20 mL/min", 0.02)):
        chart, *_ = course_charts(replace(leak(0.006, 0.0055, 0.0065, limit=RepairLimit.parse(limit)), course=course))
        assert chart.level == pytest.approx(level)


def test_a_limit_as_a_flow() -> None:
    result = leak(0.006, 0.0055, 0.007, limit=RepairLimit.parse("20 mL/min"))
    assert result.severity is not None and result.severity.of_limit is not None
    assert result.severity.of_limit[0] == pytest.approx(0.3)
    assert result.severity.level == "monitor"
    assert result.as_dict()["limit"] == {"mL_per_min": pytest.approx(20.0), "creep_mm_per_min": None, "stated": True}
    unknown = severity(replace(result, leak_lpm=None, leak_interval_lpm=None), result.limit)
    assert unknown is not None and unknown.level is None


@pytest.mark.parametrize("text", ["5", "5 bar", "-1 mL/min", "0 mm/min", "much", "5 mL", ""])
def test_a_limit_that_is_none(text: str, foreign: Recording) -> None:
    with refusal("limit", "5 mL/min"):
        diagnose(foreign, limit=text)


@pytest.mark.parametrize("origin", ["simulation", "measurement", None])
def test_a_provenance_that_names_a_rig_states_it_whatever_its_origin(foreign: Recording, origin: str | None) -> None:
    named = {"experiment": {"rig": "thesis", "overrides": {}}} | ({} if origin is None else {"origin": origin})
    assert assumed_rig(None, replace(foreign, provenance=named))[1].stated_by == "recording"
    changed = {"experiment": {"rig": "thesis", "overrides": {"pump.q_b": 1e-6}}, "origin": "simulation"}
    for provenance in (changed, {"origin": "simulation"}):
        assert assumed_rig(None, replace(foreign, provenance=provenance))[1].stated_by == "nobody"


def test_a_rig_is_loaded_once(foreign: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """Detectors get the rig that the call has loaded, not its name."""
    loaded = list[object]()

    def load(rig: object) -> Rig:
        loaded.append(rig)
        return load_rig(rig)  # type: ignore[arg-type]

    monkeypatch.setattr("sealscope.diagnosis.assumed_rig.load_rig", load)
    assert diagnose(foreign, rig="thesis").machine is not None
    assert loaded == ["thesis"]
    assert not hasattr(registry, "load_rig")


@pytest.mark.slow
def test_the_verdict_reads_remarks_of_the_recording(foreign: Recording) -> None:
    remarked = replace(foreign, provenance={"about": {"Operator": "N. N."}})
    assert remarked.remarks == {"Operator": "N. N."}
    assert diagnose(remarked).about == {"Operator": "N. N."}
