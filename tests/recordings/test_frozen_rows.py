"""A logger that repeats its last row measures nothing; a machine at rest behind a coarse converter does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.recordings.corrections.samples import correct_samples, flag_frozen_rows, flag_stuck_rows
from sealscope.recordings.recording import Recording

from ..diagnosis.balance_machine import machine


def repeat_last_row(recording: Recording, first: int, count: int, names: tuple[str, ...] | None = None) -> Recording:
    """Repeat the row before `first` in `count` rows of the named channels, of all by default."""
    channels = {name: values.copy() for name, values in recording.channels.items()}
    for name in names or recording.channels:
        channels[name][first : first + count] = channels[name][first - 1]
    return replace(recording, channels=channels)


def test_repeated_rows_of_all_channels_are_missing():
    recording = machine(3, duration=60.0, rate=200.0)
    frozen = repeat_last_row(recording, 4000, 600)
    rows = np.flatnonzero(flag_frozen_rows(frozen))
    assert (rows[0], rows[-1], rows.size) == (4000, 4599, 600)
    corrected = correct_samples(frozen)
    assert corrected.stuck == ()
    bridged = corrected.recording.bridged
    assert bridged is not None
    np.testing.assert_array_equal(np.flatnonzero(bridged), rows)


@pytest.mark.parametrize("names", [("p_A",), ("p_A", "p_B")])
def test_pressures_that_stop_while_the_piston_moves_are_no_repeated_row(names: tuple[str, ...]):
    frozen = repeat_last_row(machine(3, duration=60.0, rate=200.0), 4000, 600, names)
    assert not flag_frozen_rows(frozen).any()


def test_a_rest_behind_a_coarse_converter_is_a_reading():
    """Both pressures settle, p_B after p_A, and stay within one step of the converter for three seconds."""
    t = np.arange(0.0, 20.0, 0.01)
    rest = np.clip(t - 8.0, 0.0, 3.0)
    moving = t - rest
    p_A = 5e6 + 1e6 * np.sin(moving) + 2e5 * np.exp(-rest / 0.2) * (rest > 0.0) * (rest < 3.0)
    p_B = 5e6 - 1e6 * np.sin(moving) + 2e5 * np.exp(-rest / 0.4) * (rest > 0.0) * (rest < 3.0)
    channels = {"p_A": np.round(p_A, -4), "p_B": np.round(p_B, -4), "x": 0.01 * np.sin(moving)}
    units = {"p_A": "Pa", "p_B": "Pa", "x": "m"}
    assert not flag_frozen_rows(Recording(t, channels, rate=100.0, units=units)).any()


def test_a_repeated_row_is_found_in_any_part_of_the_recording():
    recording = repeat_last_row(machine(3, duration=60.0, rate=200.0), 4000, 600)
    part = recording.samples(slice(1000, 9000))
    np.testing.assert_array_equal(flag_frozen_rows(part), flag_frozen_rows(recording)[1000:9000])


def test_a_pressure_that_a_stiff_load_keeps_behind_shut_valves_is_not_stuck() -> None:
    """A leak raises the other pressure meanwhile; while the piston moves, a pressure that does not is stuck."""
    recording = machine(3, duration=60.0, rate=200.0)
    held = slice(4000, 5000)
    channels = {name: values.copy() for name, values in recording.channels.items()}
    channels["p_A"][held] = np.median(channels["p_A"])
    channels["p_B"][held] = np.linspace(1e5, 2e6, 1000)
    moving = replace(recording, channels=channels)
    assert flag_stuck_rows(moving, "p_A")[held].all()
    at_rest = replace(moving, channels={**channels, "x": np.where(np.arange(len(moving)) < 4000, channels["x"], 0.0)})
    assert not flag_stuck_rows(at_rest, "p_A").any()
