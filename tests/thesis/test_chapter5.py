"""Figs. 5.1 to 5.89: each number shows what the thesis's figure of that number shows, and its numbers hold."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.errors import SimulationFailed
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.chapters.appendix_c_runs import part_detail_rms
from sealscope.thesis.chapters.chapter5 import (
    TESTS,
    PrintedTest,
    fit_step_time,
    leak_test_figure,
    make_test_experiment,
    measure_test,
    windowed_detail_rms,
)
from sealscope.thesis.engine.context import SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Figure
from sealscope.thesis.sheet import APPENDIX_C
from sealscope.units import PSI

from ..refusals import refusal
from .conftest import ITEMS, Kept, numbers

THESIS = sorted((Path(__file__).resolve().parents[3] / "shared" / "thesis").glob("0*.txt"))


class Direct(Kept):
    """Simulates without the halving test, which counts as passed."""

    def run(self, spec: Experiment, *, prove: bool = True) -> SimulatedRun:
        return replace(super().run(spec, prove=False), resolved=True)


@pytest.fixture(scope="module")
def context() -> Direct:
    return Direct()


def item(number: int) -> Item:
    return ITEMS[f"fig-5.{number}"]


def drawn(context: Direct, number: int) -> Figure:
    (made,) = leak_test_figure(context, item(number))
    return made


def test_every_number_once_and_in_order() -> None:
    assert [name for name in ITEMS if name.startswith("fig-5.")] == [f"fig-5.{n}" for n in range(1, 96)]


@pytest.mark.skipif(not THESIS, reason="../shared/thesis is absent")
def test_each_number_shows_what_the_thesis_s_caption_says() -> None:
    captions = dict(re.findall(r"^Fig\. 5\.(\d+) (.+)$", THESIS[0].read_text(encoding="utf-8"), flags=re.M))
    views: dict[int, tuple[str, str, bool]] = {}
    of_chamber: dict[int, str] = {}
    for text, caption in sorted(captions.items(), key=lambda pair: int(pair[0])):
        number = int(text)
        if number > 89:
            continue
        source = int(result[1]) if (result := re.search(r"Fig\. ?5\.(\d+)\.?$", caption)) else 0
        if caption.startswith("Close-up"):
            start, stop = map(int, re.search(r"from (\d+)th to (\d+)th", caption).groups())  # type: ignore[union-attr]
            views[number] = (*views[source][:2], True)
            assert (item(number).inputs["from_s"], item(number).inputs["to_s"]) == (start, stop)
        elif caption.startswith("Experimental input"):
            views[number] = ("input", "", False)
        elif "level of internal leakage" in caption:
            views[number] = ("leak", "", False)
            assert caption.split()[0].lower() == TESTS[str(item(number).inputs["test"])].level
        elif caption.startswith("Four-level detail"):
            chamber = f"p_{re.search(r'of P_([AB])', caption)[1]}"  # type: ignore[index]
            views[number] = ("details", chamber, False)
            of_chamber[number] = chamber
        else:
            assert caption.startswith("RMS values")
            views[number] = ("rms", of_chamber[source], False)
    assert sorted(views) == list(range(1, 90))
    for number, (view, chamber, closeup) in views.items():
        one = item(number)
        assert (one.inputs["view"], one.inputs["chamber"]) == (view, chamber), one.id
        assert (one.inputs["from_s"] != 0.0) == closeup, one.id


def test_the_row_of_a_test_is_the_one_nearest_to_the_level_s_nominal_leak() -> None:
    assert {test.section: test.condition.number for test in TESTS.values()} == {
        "5.2a": 39, "5.2b": 31, "5.3a": 37, "5.3b": 21, "5.4a": 35,
        "5.4b": 13, "5.5a": 11, "5.5b": 5, "5.5c": 7, "5.5d": 1,
    }  # fmt: skip
    assert [row.number for row in TESTS["5.5d"].candidates] == [1, 2, 3, 4]


def test_one_run_serves_all_figures_of_a_test() -> None:
    assert len({make_test_experiment(test).key() for test in TESTS.values()}) == 10
    assert make_test_experiment(TESTS["5.2a"]).duration == 120.0
    assert {make_test_experiment(test).duration for test in list(TESTS.values())[1:]} == {180.0}


@pytest.mark.slow
def test_command_speed_and_displacement(context: Direct) -> None:
    made = drawn(context, 1)
    assert [panel.y_label for panel in made.panels] == ["u [V]", "motor speed [rpm]", "x [mm]"]
    assert made.panels[0].curves[0].y.max() == pytest.approx(3.0, abs=1e-3)
    assert made.panels[0].marks == ((60.0, "leak opens"),)
    assert made.resolved is True
    assert "row 39" in made.notes


def test_a_close_up_holds_its_twenty_seconds_alone(context: Direct) -> None:
    made = drawn(context, 4)
    for panel in made.panels:
        assert panel.x_range == (50.0, 70.0)
        for curve in panel.curves:
            assert 50.0 <= curve.x.min() < 50.1
            assert 69.9 < curve.x.max() <= 70.0


def test_the_leak_is_the_sheet_s_and_none_before_it_opens(context: Direct) -> None:
    made = drawn(context, 3)
    by_name = numbers(made)
    assert by_name["mean leak while open (true)"] == pytest.approx(APPENDIX_C[38].mean_leak_lpm, rel=2e-3)
    flow = made.panels[0].curves[0]
    before, after = flow.y[flow.x < 59.9], flow.y[flow.x > 60.1]
    assert np.abs(before).max() < 0.002  # ten deviations of the flow meter's noise
    assert np.abs(after).mean() > 0.01


def test_details_are_pywavelets_in_psi_and_split_at_the_onset(context: Direct) -> None:
    import pywt

    made = drawn(context, 6)
    assert [panel.y_label for panel in made.panels] == [
        "d1 [psi]", "d2 [psi]", "d3 [psi]", "d4 [psi]", "d3d4 [psi^2]",
    ]  # fmt: skip
    assert [curve.role for curve in made.panels[2].curves] == ["no leak", "leak"]
    recording = context.run(make_test_experiment(TESTS["5.2a"])).recording
    assert recording is not None
    pressure = recording["p_A"] / PSI
    n = pressure.size // 16 * 16
    deepest_first = pywt.swt(pressure[:n], "db8", level=4, trim_approx=True, norm=False)[1:]
    d3 = deepest_first[1]
    part = slice(round(20 * recording.rate), round(59 * recording.rate))
    near = part_detail_rms(recording, ((20.0, 59.0),))["p_A"]["d3"][0]
    assert near == pytest.approx(np.sqrt(np.mean(d3[part] ** 2)), rel=0.02)
    shown_d3 = made.panels[2].curves[0]
    at = np.round(shown_d3.x * recording.rate).astype(int)
    np.testing.assert_allclose(shown_d3.y, d3[at], atol=1e-9)


def test_the_numbers_of_details_and_of_their_rms_agree(context: Direct) -> None:
    details, rms = numbers(drawn(context, 5)), numbers(drawn(context, 7))
    assert {name: details[name] for name in rms} == rms
    before, after = rms["RMS of d3 without leak"], rms["RMS of d3 with leak"]
    assert rms["change of d3"] == pytest.approx(100 * (after / before - 1))
    assert numbers(drawn(context, 10))["RMS of d3 without leak"] != before


def test_windows_are_a_thousand_samples_five_hundred_apart(context: Direct) -> None:
    recording = context.run(make_test_experiment(TESTS["5.2a"])).recording
    assert recording is not None
    centres, curves = windowed_detail_rms(recording, "p_A")
    np.testing.assert_allclose(np.diff(centres), 500 / recording.rate)
    assert centres[0] == pytest.approx((105 + 500) / recording.rate)
    assert set(curves) == {"d1", "d2", "d3", "d4", "d3d4"}
    levels = [c for c in drawn(context, 7).panels[0].curves if c.role == "reference"]
    settled = curves["d3"][(centres > 7) & (centres < 58)]
    assert levels[0].y[0] == pytest.approx(float(np.sqrt(np.mean(settled**2))), rel=0.01)


@pytest.mark.slow
def test_the_drift_of_the_piston_has_a_control_without_the_leak(context: Direct) -> None:
    test = TESTS["5.2a"]
    leaking, control = measure_test(context, test), measure_test(context, test, leak=False)
    assert leaking.drift[0] == control.drift[0]
    assert leaking.drift[1] != control.drift[1]
    assert control.velocity[1] > leaking.velocity[1]  # what bypasses the piston does not move it


def test_a_run_that_failed_is_told_and_not_drawn() -> None:
    class Failing(Direct):
        def run(self, spec: Experiment, *, prove: bool = True) -> SimulatedRun:
            return SimulatedRun(None, np.empty(0), {}, math.nan, False, diverged="p_A is not finite at t = 3 s")

    with refusal("p_A", error=SimulationFailed):
        leak_test_figure(Failing(), item(1))


def test_an_unresolved_run_marks_its_figure(context: Direct) -> None:
    class Unresolved(Direct):
        def run(self, spec: Experiment, *, prove: bool = True) -> SimulatedRun:
            return replace(context.run(spec), resolved=False)

    assert leak_test_figure(Unresolved(), item(4))[0].resolved is False


def noise(values: np.ndarray, rate: float = 500.0) -> Recording:
    t = np.arange(values.size) / rate
    units = {name: CHANNEL_UNITS[name] for name in ("p_A", "p_B")}
    return Recording(t, {"p_A": values, "p_B": 2 * values}, units, rate)


def test_detail_rms_of_white_noise_is_its_deviation_in_psi() -> None:
    values = 1.5 * PSI * np.random.default_rng(1).standard_normal(60_000)
    result = part_detail_rms(noise(values), ((5.0, 60.0), (60.0, 120.0)))
    for level in range(1, 5):
        assert result["p_A"][f"d{level}"] == pytest.approx((1.5, 1.5), rel=0.04)
        assert result["p_B"][f"d{level}"] == pytest.approx((3.0, 3.0), rel=0.04)


def test_a_part_sees_nothing_outside_of_itself() -> None:
    values = PSI * np.random.default_rng(2).standard_normal(20_000)
    loud = values.copy()
    loud[:5000] += 1e6 * np.random.default_rng(3).standard_normal(5000)
    loud[15_000:] += 1e6 * np.random.default_rng(4).standard_normal(5000)
    part = ((10.0, 30.0),)
    quiet, beside = part_detail_rms(noise(values), part), part_detail_rms(noise(loud), part)
    assert {c: {q: pytest.approx(rms) for q, rms in of.items()} for c, of in quiet.items()} == beside
    wider = part_detail_rms(noise(loud), ((9.6, 30.0),))
    assert wider["p_A"]["d1"][0] > 2 * beside["p_A"]["d1"][0]


@pytest.mark.parametrize(("command", "omega"), [("3 sin(4t)", 4.0), ("8 sin(t)", 1.0)])
def test_omega_of_a_command(command: str, omega: float) -> None:
    assert PrintedTest("5.2a", command, "large", 1, 0, 90.0).omega == omega


def test_best_step_finds_a_step_and_no_end_effect() -> None:
    t = np.arange(100.0)
    y = np.where(t < 63, 1.0, 0.8) + 0.02 * np.random.default_rng(5).standard_normal(100)
    assert fit_step_time(t, y) == 62.5
    everywhere = [fit_step_time(t, np.random.default_rng(k).standard_normal(100)) for k in range(40)]
    assert min(everywhere) >= 4.5
    assert max(everywhere) <= 94.5
