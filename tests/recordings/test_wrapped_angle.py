"""Angles that begin anew after a turn are unwrapped, as a finding, and others are left as they are."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.recordings import Recording
from sealscope.recordings.corrections.samples import correct_samples

from ..representatives import SLOW, few

Array = np.ndarray


@cache
def machine(command: str = "3 sin(4t)", leak: str | None = None, every: int = 10) -> Recording:
    """Simulate two minutes of a machine, of which each `every`-th sample of 500 Hz is taken."""
    whole = ss.simulate(command=command, duration="2 min", seed=11, **({"leak": leak} if leak else {}))
    names = ("p_A", "p_B", "x", "theta", "u", "omega")
    channels = {name: whole[name][::every] for name in names if name in whole}
    return Recording(whole.t[::every], channels, {name: whole.units[name] for name in channels}, whole.rate / every)


def with_angle(recording: Recording, values: Array, unit: str, drop: tuple[str, ...] = ("omega",)) -> Recording:
    """Replace theta by `values` in another unit, and leave out the channels in `drop`."""
    channels = {name: samples for name, samples in recording.channels.items() if name not in drop}
    return Recording(
        recording.t, channels | {"theta": values}, {name: recording.units[name] for name in channels} | {"theta": unit},
        recording.rate,
    )  # fmt: skip


def wrap(angle: Array, period: float, low: float, step: float) -> Array:
    """Wrap an angle to the period from `low` on, in whole steps of the sensor."""
    return low + np.round((angle - low) / step) * step % period


TURN = 2.0 * np.pi
#: Form -> angle [rad], as the sensor writes it; its unit; rad of one of these.
FORMS: dict[str, tuple[Callable[[Array], Array], str, float]] = {
    "0 to 360 degrees": (lambda angle: np.radians(wrap(np.degrees(angle), 360.0, 0.0, 0.01)), "rad", 1.0),
    "-180 to 180 degrees": (lambda angle: np.radians(wrap(np.degrees(angle), 360.0, -180.0, 0.1)), "rad", 1.0),
    "0 to 2 pi": (lambda angle: wrap(angle, TURN, 0.0, 1e-4), "rad", 1.0),
    "0 to 1 rev": (lambda angle: wrap(angle / TURN, 1.0, 0.0, 1e-3) * TURN, "rad", 1.0),
    "4 turns": (lambda angle: wrap(angle, 4 * TURN, 0.0, 1e-3), "rad", 1.0),
    "4096 counts": (lambda angle: wrap(angle / TURN * 4096, 4096, 0, 1), "count", TURN / 4096),
    "65536 counts": (lambda angle: wrap(angle / TURN * 65536, 65536, 0, 1), "count", TURN / 65536),
    "signed counts": (lambda angle: wrap(angle / TURN * 4096, 65536, -32768, 1), "count", TURN / 4096),
    "3600 counts": (lambda angle: wrap(angle / TURN * 3600, 3600, 0, 1), "count", TURN / 3600),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", few(range(5), 1, SLOW))
def test_a_wrapped_angle_is_unwrapped(form: str, seed: int) -> None:
    """The angle begins anywhere; some samples are missing, and some rows in a row."""
    generator = np.random.default_rng([seed, list(FORMS).index(form)])
    write, unit, scale = FORMS[form]
    truth = machine()["theta"] + generator.uniform(-10.0, 10.0)
    truth = truth + (
        np.arange(truth.size) * generator.uniform(0.02, 0.1) if form in ("4 turns", "signed counts") else 0
    )
    values = write(truth)
    assert np.abs(np.diff(values)).max() > 0.5 * np.ptp(values)
    values[generator.random(values.size) < 0.005] = np.nan
    values[2000:2004] = np.nan
    corrected = correct_samples(with_angle(machine(), values, unit))
    finding = next(finding for finding in corrected.findings if finding.code == "angle_unwrapped")
    assert (finding.channel, finding.severity) == ("theta", "note")
    error = corrected.recording["theta"] * scale - truth
    assert np.ptp(error[np.isfinite(values)]) < 0.02


@pytest.mark.parametrize("signal", ["omega", "x", "u"])
@pytest.mark.parametrize("seed", few(range(5), 1, SLOW))
def test_over_half_a_turn_a_sample_the_speed_tells_the_turns(signal: str, seed: int) -> None:
    """At 10 Hz the shaft turns by up to a turn and more between samples."""
    generator = np.random.default_rng(seed)
    recording = machine(f"{generator.uniform(6, 9):.2f} sin({generator.uniform(0.5, 1.2):.2f}t)", every=50)
    truth = recording["theta"] + generator.uniform(-10.0, 10.0)
    assert np.abs(np.diff(truth)).max() > np.pi
    names = tuple({"omega", "x", "u"} - {signal})
    corrected = correct_samples(with_angle(recording, np.mod(truth, TURN), "rad", drop=names))
    assert np.ptp(corrected.recording["theta"] - truth) < 1e-6
    alone = correct_samples(with_angle(recording, np.mod(truth, TURN), "rad", drop=("omega", "x", "u")))
    assert "theta" not in alone.recording
    assert {finding.code: finding.severity for finding in alone.findings if finding.channel == "theta"} == {
        "angle_ambiguous": "warning"
    }


def swing(t: Array, generator: np.random.Generator) -> Array:
    return np.pi * (1 - np.cos(generator.uniform(1, 5) * t))


SOUND: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "a swing of 0 to 360 degrees": swing,
    "the same in whole degrees": lambda t, generator: np.radians(np.round(np.degrees(swing(t, generator)))),
    "a few samples a swing": lambda t, generator: generator.uniform(5, 40) * np.sin(generator.uniform(50, 140) * t),
    "at rest, by one step": lambda t, generator: 1e-3 * generator.integers(0, 2, t.size),
    "spikes to zero": lambda t, generator: np.where(
        generator.random(t.size) < 5e-4, 0.0, 5 + 0.5 * np.sin(generator.uniform(1, 5) * t)
    ),
    "a random walk": lambda t, generator: np.cumsum(generator.normal(0, 0.3, t.size)),
    "constant": lambda t, generator: np.full(t.size, 3.0),
}


@pytest.mark.parametrize("name", SOUND)
@pytest.mark.parametrize("seed", few(range(10), 2, SLOW))
def test_an_angle_that_does_not_wrap_stays(name: str, seed: int) -> None:
    recording = machine()
    values = SOUND[name](recording.t, np.random.default_rng([seed, list(SOUND).index(name)]))
    corrected = correct_samples(with_angle(recording, values, "rad"))
    assert not {"angle_unwrapped", "angle_ambiguous", "angle_reset"} & {finding.code for finding in corrected.findings}
    assert "theta" in corrected.recording


@pytest.mark.parametrize("seed", few(range(6), 2, SLOW))
def test_an_encoder_that_begins_again_from_zero_goes_on(seed: int) -> None:
    """Its supply is lost some times; the angle is that of the shaft but for a step or two at each."""
    generator = np.random.default_rng(seed)
    truth = np.array(machine(f"{generator.uniform(2, 5):.2f} sin({generator.uniform(1, 4):.2f}t)")["theta"])
    resets = np.sort(generator.choice(np.arange(100, truth.size - 100), generator.integers(1, 4), replace=False))
    values = truth - truth[0]
    for row in resets:
        values[row:] -= values[row]
    steps = np.abs(np.diff(truth))
    if (np.abs(np.diff(values))[resets - 1] < 11 * np.quantile(steps, 0.9)).any():
        pytest.skip("a reset near zero is no leap")
    corrected = correct_samples(with_angle(machine(), values, "rad"))
    finding = next(finding for finding in corrected.findings if finding.code == "angle_reset")
    assert finding.count == resets.size
    assert np.ptp(corrected.recording["theta"] - truth) <= 2.0 * resets.size * steps.max()


@pytest.mark.parametrize(("every", "code"), [(1, "angle_unwrapped"), (20, "angle_unwrapped"), (100, "angle_ambiguous")])
def test_an_angle_of_another_rate_is_unwrapped_before_it_is_resampled(every: int, code: str, tmp_path: Path) -> None:
    """Averages and straight lines over a leap are no angles."""
    nptdms = pytest.importorskip("nptdms")
    recording, fast = machine(), machine(every=1)
    angle = np.degrees(np.mod(fast["theta"], TURN))[::every]
    series = {name: (recording[name], recording.rate, "") for name in ("p_A", "p_B", "x")}
    series["theta"] = angle, fast.rate / every, "deg"
    units = {"p_A": "Pa", "p_B": "Pa", "x": "m", "theta": "deg"}
    with nptdms.TdmsWriter(str(tmp_path / "log.tdms")) as writer:
        for name, (values, rate, _) in series.items():
            properties = {"wf_increment": 1.0 / rate, "unit_string": units[name]}
            writer.write_segment([nptdms.ChannelObject("rig", name, values, properties)])
    read = ss.read(tmp_path / "log.tdms")
    findings = [finding for finding in ss.inspect(read) if finding.channel == "theta"]
    assert code in {finding.code for finding in findings}
    if code == "angle_unwrapped":
        assert np.nanmax(np.abs(read["theta"] - recording["theta"])) < 0.25
    else:
        assert np.isnan(read["theta"]).all()


@pytest.mark.parametrize(("leak", "verdict"), [("0.02 L/min from 60 s", "leak"), (None, "no leak")])
@pytest.mark.parametrize("form", few([form for form in FORMS if form not in ("4 turns", "signed counts")], 1, SLOW))
def test_the_truth_is_found_with_a_wrapped_angle(form: str, leak: str | None, verdict: str, tmp_path: Path) -> None:
    recording = machine(leak=leak)
    write, unit, scale = FORMS[form]
    columns = [recording.t, recording["p_A"], recording["p_B"], recording["x"], write(recording["theta"])]
    formula = "theta=#5 rad" if unit == "rad" else f"theta=#5*{scale!r} rad"
    np.savetxt(tmp_path / "log.csv", np.column_stack(columns), delimiter=",", fmt="%.7g", comments="",
               header="t [s],p_A [Pa],p_B [Pa],x [m],angle")  # fmt: skip
    read = ss.read(tmp_path / "log.csv", map=dict([formula.split("=", 1)]))
    diagnosis = ss.diagnose(read, rig="thesis")
    assert diagnosis.verdict == verdict, diagnosis.reason
    assert "angle_unwrapped" in {finding.code for finding in diagnosis.quality}
    if leak:
        assert diagnosis.onset_s == pytest.approx(60.0, abs=4.0)
        assert diagnosis.leak_lpm == pytest.approx(0.02, rel=0.25)
