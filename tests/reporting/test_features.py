"""Details and RMS as shown: the right samples, the right windows, the right parts before and after."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.reporting.features import chamber_details, changes, parts_to_compare
from sealscope.signals.details import details
from sealscope.signals.windows import windowed_rms


def holed(recording, first, last, channel="p_A"):
    values = recording[channel].copy()
    values[first:last] = np.nan
    return replace(recording, channels={**recording.channels, channel: values})


def test_details_and_windows_of_a_whole_recording_are_those_of_the_signals_room(recording):
    result, note = chamber_details(recording, "p_A")
    assert note == ""
    whole = details(recording["p_A"])
    inside = whole.inside()
    assert np.array_equal(result.values["d3d4"][inside], whole.product()[inside])
    assert np.isnan(result.values["d4"][0]) and np.isnan(result.values["d4"][-1])
    windows = windowed_rms(whole)
    assert np.array_equal(result.window_rms["d3"], windows.rms[2])
    assert result.window_t == pytest.approx((windows.ends - 500) / 500)


def test_a_hole_parts_the_details_and_no_window_reaches_over_it(recording):
    faulty = holed(recording, 9000, 9100)
    result, note = chamber_details(faulty, "p_A")
    assert "100 of 20000 samples are left out" in note
    assert np.all(np.isnan(result.values["d1"][9000:9100]))
    assert np.isfinite(result.values["d1"][8900]) and np.isfinite(result.values["d1"][9200])
    (parted,) = np.flatnonzero(np.isnan(result.window_rms["d1"]))
    # a window is 2 s wide: the last one before the hole ends by 18 s, the first one after it begins from 18.2 s on
    assert result.window_t[parted - 1] <= 17.0 and result.window_t[parted + 1] >= 19.2


def test_details_stop_at_gaps_and_reversals_of_time(recording):
    t = recording.t.copy()
    t[5000:] += 3
    d1 = chamber_details(replace(recording, t=t), "p_A")[0].values["d1"]
    assert np.isnan(d1[4999]) and np.isnan(d1[5000]) and np.isfinite(d1[4900]) and np.isfinite(d1[5100])
    t = recording.t.copy()
    t[7000:] -= 1.0
    result, _ = chamber_details(replace(recording, t=t), "p_A")
    assert np.isnan(result.values["d1"][7000])
    assert np.all(np.diff(result.window_t) >= 0)  # on the axis of the samples' numbers, as everything drawn


def test_why_there_are_no_details_is_said(recording):
    assert chamber_details(recording.only(["p_B"]), "p_A") == (None, "p_A is not in this recording.")
    result, note = chamber_details(recording.between(0, 0.06), "p_A")
    assert result is None and "226" in note and "30" in note
    assert chamber_details(holed(recording, 0, 20000), "p_A")[0] is None


def test_too_short_for_a_window_still_shows_the_details(recording):
    result, note = chamber_details(recording.between(0, 1.5), "p_A")
    assert result.window_t.size == 0 and "1000" in note
    assert np.isfinite(result.values["d2"]).any()


def test_change_is_of_the_parts_outside_the_onsets_interval(recording, make_diagnosis):
    result, _ = chamber_details(recording, "p_A")
    parts = parts_to_compare(make_diagnosis(), recording)
    assert (parts.end, parts.start, parts.heads) == (18.5, 21.75, ("Before", "After")) and "18.5" in parts.text
    by_name = {name: (before, after) for _, name, before, after in changes(recording, [result], parts)}
    d3 = result.values["d3"]
    early, late = d3[(recording.t < 18.5) & np.isfinite(d3)], d3[(recording.t >= 21.75) & np.isfinite(d3)]
    assert by_name["d3"] == pytest.approx((np.sqrt(np.mean(early**2)), np.sqrt(np.mean(late**2))), rel=1e-12)
    # the ringing at 70 Hz falls by a third; at 500 Hz it lies in d2 and d3
    before, after = by_name["d2"]
    assert after < 0.85 * before


def test_without_an_onset_the_halves_are_compared(recording, make_diagnosis):
    parts = parts_to_compare(make_diagnosis(onset_s=None, onset_interval_s=None), recording)
    assert parts.end == parts.start == pytest.approx(20.0, abs=0.01) and parts.heads[0] == "First half"


def test_a_short_recording_without_an_onset_is_not_parted(recording, make_diagnosis):
    short = recording.between(0, 10)
    result, _ = chamber_details(short, "p_A")
    parts = parts_to_compare(make_diagnosis(onset_s=None, onset_interval_s=None), short)
    rows = changes(short, [result], parts)
    assert parts.heads[0] == "Whole" and all(after is None for *_, after in rows)
    d1 = result.values["d1"]
    assert rows[0][2] == pytest.approx(np.sqrt(np.nanmean(d1**2)), rel=1e-12)
