"""The duty's cycle, and blocks whose RMS is that of the details themselves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from sealscope.diagnosis.rms_change.rms_detector import column_names, cut_blocks, measure_levels
from sealscope.recordings.motion import find_cycle
from sealscope.recordings.recording import Recording
from sealscope.signals.details import details
from sealscope.simulation.commands import parse_command

RATE = 500.0


def duty(command: str, duration: float = 120.0, start: float = 0.0, rate: float = RATE) -> Recording:
    """A command alone with two chambers of noise."""
    t = np.arange(round(duration * rate)) / rate
    random = np.random.default_rng(0)
    channels = {"u": parse_command(command).volts(t)} | {n: 3e5 + random.normal(size=t.size) for n in ("p_A", "p_B")}
    return Recording(start + t, channels, {"u": "V", "p_A": "Pa", "p_B": "Pa"}, rate)


@pytest.mark.parametrize("omega", [0.5, 1.0, 2.0, 3.3, 4.0, 8.0, 20.0])
@pytest.mark.parametrize("rate", [100.0, 500.0, 1000.0])
def test_cycle_of_a_sine(omega: float, rate: float) -> None:
    assert find_cycle(duty(f"3 sin({omega}t)", rate=rate)) == pytest.approx(2 * np.pi / omega, rel=3e-3)


def test_cycle_of_a_square_wave_with_an_offset() -> None:
    recording = duty("3 sin(2t)")
    square = 1.0 + np.sign(recording["u"])
    recording = Recording(recording.t, {**recording.channels, "u": square}, recording.units, RATE)
    assert find_cycle(recording) == pytest.approx(np.pi, rel=2e-3)


@pytest.mark.parametrize(
    "command",
    ["prbs 3 every 0.5 s seed 1", "prbs 3 every 0.1 s seed 2", "step 5 at 1 s", "ramp 5 from 1 s to 90 s",
     "chirp 3 from 0.1 Hz to 2 Hz over 120 s", "3 sin(0.1t)", "3 sin(100t)"],
)  # fmt: skip
def test_no_cycle(command: str) -> None:
    assert find_cycle(duty(command)) is None


def test_cycle_from_the_pressures_where_there_is_no_command() -> None:
    recording = duty("0 sin(t)")
    swing = 1e5 * np.sin(2.5 * recording.t)
    channels = {"p_A": recording["p_A"] + swing, "p_B": recording["p_B"] - swing}
    for names in (("p_A", "p_B"), ("p_A",), ("p_B",)):
        assert find_cycle(Recording(recording.t, channels, recording.units, RATE).only(names)) == pytest.approx(
            2 * np.pi / 2.5, rel=2e-3
        )
    assert find_cycle(recording) is None  # a resting command, and noise


@pytest.mark.parametrize(
    ("command", "length"),
    [
        ("3 sin(4t)", np.pi / 2),
        ("5 sin(2t)", np.pi / 2),
        ("8 sin(t)", np.pi / 2),
        ("3 sin(10t)", 2 * 2 * np.pi / 10),
        ("prbs 3 every 0.5 s", 1.5),
    ],
)
def test_blocks_are_shares_of_the_cycle(command: str, length: float) -> None:
    recording = duty(command, duration=90.0, start=1000.0)
    blocks = cut_blocks(recording)
    assert blocks.edges.size == len(blocks.log_rms) + 1
    assert blocks.log_rms.shape[1] == len(column_names(blocks.chambers)) == 10
    np.testing.assert_allclose(np.diff(blocks.edges), length, rtol=2e-3, atol=1.01 / RATE)
    inside = details(recording["p_A"]).inside()
    assert blocks.edges[0] == pytest.approx(recording.t[inside.start])
    assert recording.t[inside.stop - 1] - blocks.edges[-1] < length
    assert blocks.edges[-1] <= recording.t[inside.stop - 1] + 1.0 / RATE


def test_log_rms_is_that_of_the_details() -> None:
    recording = duty("prbs 3 every 0.5 s", start=20.0)
    blocks = cut_blocks(recording)
    bounds = np.rint((blocks.edges - recording.t[0]) * RATE).astype(int)
    for chamber in ("p_A", "p_B"):
        result = details(recording[chamber])
        series = {f"d{level}": result[level] for level in (1, 2, 3, 4)} | {"d3d4": result[3] * result[4]}
        for quantity, values in series.items():
            direct = [np.sqrt(np.mean(values[a:b] ** 2)) for a, b in pairwise(bounds)]
            column = column_names(blocks.chambers).index(f"{quantity} of {chamber}")
            np.testing.assert_allclose(np.exp(blocks.log_rms[:, column]), direct, rtol=1e-9)
            inside = values[result.inside()]
            assert measure_levels(recording)[0][column] == pytest.approx(np.log(np.sqrt(np.mean(inside**2))), rel=1e-9)


def test_each_phases_own_level_is_taken_out() -> None:
    recording = duty("8 sin(t)")
    random = np.random.default_rng(1)
    loud = 1.0 + 0.9 * np.sin(recording.t)  # the noise follows the stroke
    p_A = 3e5 + loud * random.normal(size=len(recording))
    recording = Recording(recording.t, {**recording.channels, "p_A": p_A}, recording.units, RATE)
    blocks = cut_blocks(recording)
    d1 = [column_names(blocks.chambers).index(f"d1 of {chamber}") for chamber in blocks.chambers]
    means = np.array([blocks.log_rms[phase::4].mean(axis=0) for phase in range(4)])
    np.testing.assert_allclose(means, np.tile(means[0], (4, 1)), atol=1e-9)
    assert blocks.log_rms[:, d1].std(axis=0).max() < 0.08  # with the stroke left in: 0.6


def test_blocks_hold_enough_samples_at_a_low_rate() -> None:
    blocks = cut_blocks(duty("prbs 3 every 0.5 s", duration=500.0, rate=10.0))
    np.testing.assert_allclose(np.diff(blocks.edges), 6.4)


@pytest.mark.parametrize("samples", [226, 500, 900])
def test_short_recordings_have_few_blocks_or_none(samples: int) -> None:
    recording = duty("prbs 3 every 0.5 s").samples(slice(0, samples))
    blocks = cut_blocks(recording)
    assert len(blocks.log_rms) == (samples - 225) // 750
    assert blocks.log_rms.shape[1] == 10


def test_a_reading_that_does_not_move_is_named() -> None:
    recording = duty("prbs 3 every 0.5 s", start=100.0)
    p_B = np.array(recording["p_B"])
    p_B[20000:23000] = p_B.min()
    held = Recording(recording.t, {**recording.channels, "p_B": p_B}, recording.units, RATE)
    still = cut_blocks(held).frozen
    assert still is not None
    assert still.startswith("p_B does not move from 14")
    assert cut_blocks(recording).frozen is None
