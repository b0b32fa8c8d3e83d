"""Faults other than a leak across the piston: their words, and what each does to the machine."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sealscope.parameters import load_rig
from sealscope.simulation.commands import Sine, polyline_from_table, step
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import Fault, parse_fault
from sealscope.simulation.leaks import growing_opening, opening_from
from sealscope.simulation.simulate import simulate_experiment, write_truth

from ..refusals import refusal

PSI = 6894.757293168361
LPM = 1e-3 / 60
PRESSURES = ("p_1", "p_2", "p_A", "p_B")
QUIET = {"sensors.common_noise": 0.0, "bits": 24} | {
    f"sensors.{name}.{what}": 0.0 for name in PRESSURES for what in ("noise", "drift")
}
LEAKING_PUMP = {"G_pump": 2.4e-13}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("pump leak x3 from 90 s", Fault("pump leak", 3.0, opening=opening_from(90.0))),
        ("pump leakage +50 % growing from 1 s to 3 s", Fault("pump leak", 1.5, opening=growing_opening(1.0, 3.0))),
        ("pump leak G = 5e-13", Fault("pump leak G", 5e-13)),
        ("rod seal A 0.012 L/min from 90 s", Fault("rod seal", 0.012 * LPM, "A", opening_from(90.0))),
        ("external leak B G = 2e-13 from 90", Fault("rod seal G", 2e-13, "B", opening_from(90.0))),
        ("friction x1.3 from 90 s", Fault("friction", 1.3, opening=opening_from(90.0))),
        ("friction -20 %", Fault("friction", 0.8)),
        ("air 1 % growing from 60 s to 120 s", Fault("air", 0.01, opening=growing_opening(60.0, 120.0))),
        ("sensor p_A offset -2 psi from 90 s", Fault("sensor offset", -13789.514586336723, "p_A", opening_from(90.0))),
        ("sensor x offset 1 mm", Fault("sensor offset", 1e-3, "x")),
        ("sensor p_B gain +1 % from 9 s", Fault("sensor gain", 0.01, "p_B", opening_from(9.0))),
        ("sensor p_1 stuck from 90 s to 100 s", Fault("sensor stuck", 0.0, "p_1", opening_from(90.0, 100.0))),
        ("sensor q_leak stuck", Fault("sensor stuck", 0.0, "q_leak", opening_from(0.0))),
        ("duty amplitude x1.5 from 90 s", Fault("duty", 1.5, opening=opening_from(90.0))),
        (
            "duty amplitude x0.5 frequency x2 growing from 1 s to 2 s",
            Fault("duty", 0.5, "", growing_opening(1.0, 2.0), 2.0),
        ),
        ("duty frequency x0.8", Fault("duty", 1.0, frequency_factor=0.8)),
    ],
)
def test_faults_are_read_from_words_and_their_own_words_read_back(text, fault):
    result = parse_fault(text)
    again = parse_fault(str(result))
    for one in (result, again):
        assert type(one) is type(fault)
        assert str(one) == str(fault)
        assert one.onset() == fault.onset()
    assert Experiment.of(set=LEAKING_PUMP, duration=1.0, fault=result).faults[0].kind == fault.kind


def test_capitals_do_not_matter():
    for text, plain in (
        ("Friction X1.2 From 9 S", "friction x1.2 from 9 s"),
        ("SENSOR p_A STUCK from 9 s", "sensor p_A stuck from 9 s"),
        ("Rod Seal a g = 2e-13", "rod seal A G = 2e-13 from 0 s"),
        ("Shut-off b To 0 % Within 0.5 s", "shut-off B to 0 % from 0 s within 0.5 s"),
    ):
        assert str(parse_fault(text)) == str(parse_fault(plain))


def test_no_fault_is_none():
    assert parse_fault("none") is None
    assert Experiment.of(fault=["none", "friction x2"], duration=1.0).faults == (Fault("friction", 2.0),)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "fault"),
        ("pump leak", "fault"),
        ("pump leak x-3", "-3, 0"),
        ("rod seal C 0.01 L/min", "fault"),
        ("rod seal A 0.01 psi", "psi"),
        ("friction x1e999", "inf, 0"),
        ("air 80 %", "0 %, 50 %"),
        ("sensor p_9 offset 2 psi", "'p_9', p_A, q_leak"),
        ("sensor p_A offset 2 mm", "mm"),
        ("sensor p_A gain -100 %", "-100 %"),
        ("sensor p_A stuck from 9 s to 3 s", "3 s"),
        ("duty", "fault"),
        ("duty amplitude x1.5 from 3 s; rm", "fault"),
        ("friction x1.3 growing from 9 s to 3 s", "growing"),
    ],
)
def test_other_words_are_refused_in_one_line(text, words):
    with refusal(*words.split(", ")):
        parse_fault(text)


def test_a_fault_that_cannot_be_on_this_rig_is_refused():
    with refusal("pump.G_pump", "0", "pump leak x3 from 90 s"):
        Experiment.of(fault="pump leak x3 from 90 s")
    with refusal("command", "+-10 V"):
        Experiment.of(fault="duty amplitude x2 from 90 s", command="7 sin(4t)")
    with refusal("table"):
        Fault("duty", 2.0, opening=polyline_from_table(np.array([0.0]), np.array([1.0])))


def pair(fault: str, *, values: dict | None = None, duration: float = 8.0, **others):
    """The same experiment without and with a fault from half time on."""
    common = {"duration": duration, "set": values or {}, **others}
    return simulate_experiment(Experiment.of(**common)), simulate_experiment(
        Experiment.of(**common, fault=f"{fault} from {duration / 2:g} s")
    )


def halves(result) -> tuple[np.ndarray, np.ndarray]:
    t = result.truth.t
    return t < 0.5 * t[-1] - 0.01, t > 0.5 * t[-1] + 0.5


@pytest.mark.parametrize(
    ("fault", "values"),
    [
        ("friction x1.3", {}),
        ("duty amplitude x1.2", {}),
        pytest.param("pump leak x3", LEAKING_PUMP, marks=pytest.mark.slow),
        pytest.param("rod seal A 0.001 L/min", {"check_valves": "present"}, marks=pytest.mark.slow),
    ],
)
def test_until_its_onset_a_fault_changes_nothing_and_then_it_does(fault, values):
    healthy, faulty = pair(fault, values=values)
    first, second = halves(healthy)
    np.testing.assert_array_equal(healthy.recording["p_A"][first][:-20], faulty.recording["p_A"][first][:-20])
    difference = np.abs(healthy.truth.outputs["p_A"] - faulty.truth.outputs["p_A"])
    assert difference[first].max() < 1e-6  # Pa; a faulty duty is another command, equal to rounding
    assert difference[second].max() > 500.0


@pytest.mark.slow
def test_air_that_comes_later_is_not_there_before():
    healthy, faulty = pair("air 1 %")
    first, second = halves(healthy)
    np.testing.assert_allclose(
        healthy.truth.outputs["p_A"][first], faulty.truth.outputs["p_A"][first], atol=1e-3, rtol=0
    )
    assert np.abs(healthy.truth.outputs["p_A"] - faulty.truth.outputs["p_A"])[second].max() > 2e3


def test_a_worn_pump_delivers_less_by_its_own_law():
    healthy, faulty = pair("pump leak x4", values=LEAKING_PUMP)
    first, second = halves(healthy)
    rig = load_rig()
    for part, factor in ((first, 1.0), (second, 4.0)):
        o = faulty.truth.outputs
        lost = rig.pump.q_b / (2 * np.pi) * o["omega"] - o["Q_1"]
        np.testing.assert_allclose(
            lost[part], factor * 2.4e-13 * (o["p_1"] - o["p_2"])[part], atol=1e-6 * np.ptp(o["Q_1"]), rtol=1e-6
        )


def test_friction_takes_more_pressure():
    healthy, faulty = pair("friction +30 %")
    _, second = halves(healthy)
    rms = [np.sqrt(np.mean((r.truth.outputs["p_A"] - r.truth.outputs["p_B"])[second] ** 2)) for r in (healthy, faulty)]
    assert rms[1] / rms[0] == pytest.approx(1.3, abs=0.03)


def test_a_rod_seal_loses_what_it_says():
    values = {"check_valves": "present"}
    _, faulty = pair("rod seal B 0.02 L/min", values=values, duration=20.0)
    o, t = faulty.truth.outputs, faulty.truth.t
    p_charge = load_rig().fluid.p_charge
    after = t >= 10.0
    assert np.all(o["q_ext"][~after] == 0.0)
    np.testing.assert_allclose(o["q_ext"][after], 0.02 * LPM * o["p_B"][after] / p_charge, rtol=1e-9)
    assert np.mean(o["q_up"][t > 15.0]) == pytest.approx(np.mean(o["q_ext"][t > 15.0]), rel=0.02)


def test_a_faulty_sensor_errs_as_it_says_and_the_machine_does_not_know():
    common = {"duration": 4.0, "set": QUIET}
    healthy = simulate_experiment(Experiment.of(**common))
    t = healthy.recording.t
    after = t >= 2.0
    for words, expected in (
        ("sensor p_A offset 2 psi from 2 s", lambda p: p + 2 * PSI * after),
        ("sensor p_A gain +2 % from 2 s", lambda p: p * (1 + 0.02 * after)),
        ("sensor p_A offset 2 psi growing from 1 s to 3 s", lambda p: p + 2 * PSI * np.clip((t - 1) / 2, 0, 1)),
        ("sensor p_A stuck from 2 s", lambda p: np.where(after, p[1000], p)),
        ("sensor p_A stuck from 2 s to 3 s", lambda p: np.where(after & (t < 3.0), p[1000], p)),
    ):
        faulty = simulate_experiment(Experiment.of(**common, fault=words))
        step = 3000 * PSI / 2**23
        np.testing.assert_allclose(
            faulty.recording["p_A"], expected(healthy.recording["p_A"]), atol=1.6 * step, err_msg=words
        )
        for name in ("p_1", "p_2", "p_B", "x", "q_leak"):
            np.testing.assert_array_equal(faulty.recording[name], healthy.recording[name])
        np.testing.assert_array_equal(faulty.truth.outputs["p_A"], healthy.truth.outputs["p_A"])
    shifted = simulate_experiment(
        Experiment.of(**common, fault=["sensor x offset 1 mm", "sensor q_leak offset 3 mL/min"])
    ).recording
    np.testing.assert_allclose(shifted["x"], healthy.recording["x"] + 1e-3, atol=21e-6)
    np.testing.assert_allclose(shifted["q_leak"], healthy.recording["q_leak"] + 5e-8, atol=2e-9)


def test_a_changed_duty_changes_size_and_pace_without_a_jump_in_phase():
    t = np.arange(0.0, 20.0, 1e-3)
    command = Fault("duty", 1.5, "", opening_from(10.0), 0.5).change_command(Sine(3.0, 4.0))
    u = command.volts(t)
    np.testing.assert_allclose(u[t < 10], 3 * np.sin(4 * t[t < 10]))
    np.testing.assert_allclose(u[t >= 10], 4.5 * np.sin(40 + 2 * (t[t >= 10] - 10)), atol=1e-9)
    gradual = Fault("duty", 1.0, "", growing_opening(5.0, 10.0), 2.0).change_command(Sine(1.0, 3.0))
    pace = np.gradient(gradual.original_time(t), t)
    np.testing.assert_allclose(pace, 1.0 + np.clip((t - 5) / 5, 0, 1), atol=2e-3)
    assert np.abs(np.diff(gradual.volts(t))).max() < 6.5e-3
    assert step(1.0).volts(t).shape == Fault("duty", 2.0).change_command(step(1.0)).volts(t).shape
    recorded = simulate_experiment(
        Experiment.of(duration=4.0, fault="duty amplitude x1.5 frequency x0.5 from 2 s")
    ).recording
    late = recorded.t >= 2.0
    np.testing.assert_allclose(recorded["u"][late], 4.5 * np.sin(8 + 2 * (recorded.t[late] - 2)), atol=1e-9)


def test_the_truth_lists_the_faults_and_the_recording_does_not(tmp_path):
    made = simulate_experiment(
        Experiment.of(
            duration=4.0,
            leak="G = 6e-13 from 3 s",
            fault=["friction x1.3 from 2 s", "sensor p_A stuck from 1 s"],
        )
    )
    write_truth(made.truth, tmp_path / "truth.json")
    tree = json.loads((tmp_path / "truth.json").read_text())
    assert tree["onset_s"] == 3.0
    assert tree["faults"] == [
        {"kind": "friction", "words": "friction x1.3 from 2 s", "onset_s": 2.0},
        {"kind": "sensor stuck", "words": "sensor p_A stuck from 1 s", "onset_s": 1.0},
    ]
    public = str(dict(made.recording.provenance)) + str(made.recording.history)
    for word in ("friction", "stuck", "1.3"):
        assert word not in public


def test_faults_tell_experiments_apart():
    common = {"duration": 2.0, "set": LEAKING_PUMP}
    faults = (None, "pump leak x3", "pump leak x3.0000001", "pump leak x3 from 1 s", ["pump leak x3", "friction x1.1"])
    keys = {Experiment.of(**common, fault=fault).key() for fault in faults}
    assert len(keys) == len(faults)
