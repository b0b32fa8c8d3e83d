"""All corrections of a recording's samples in their order, as the inspection and the folder monitor apply them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.paragraphs import format_count
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.corrections.angles import unwrap_angles
from sealscope.recordings.corrections.clock import order_recording, resample_evenly
from sealscope.recordings.corrections.gaps import (
    bridge,
    flag_holes,
    interpolate_short_gaps,
    remove_dropouts,
    remove_impossible,
    remove_unsupplied,
    set_missing,
)
from sealscope.recordings.corrections.spikes import remove_spikes
from sealscope.recordings.corrections.stale import (
    MAX_STUCK_FRACTION,
    flag_frozen_rows,
    flag_stuck_rows,
    interpolate_stale_samples,
)
from sealscope.recordings.corrections.unsigned import restore_signs
from sealscope.recordings.motion import find_runs
from sealscope.recordings.quality import Finding, weigh_defects
from sealscope.recordings.recording import Recording


class CorrectedSamples(NamedTuple):
    """A recording after the correction of its samples."""

    recording: Recording  # evenly spaced, from the first to the last row with all chamber pressures and the command
    findings: tuple[Finding, ...]  # the corrections that `correct_samples` reports
    stuck: tuple[str, ...]  # names of chamber pressures that repeat one value for too long to be used
    # fractions of the original samples: those within the time span of `recording`, those before it, those after it
    used_fraction: float
    before_fraction: float
    after_fraction: float


def correct_samples(recording: Recording) -> CorrectedSamples:
    """Correct the samples of a recording for the defects of loggers, in this order.

    0. rows out of the order of time, and an angle that begins anew after a turn;
    1. impossible values, dropouts, i.e. rows with zeros in both chamber pressures, and sensors without a supply;
    2. rows, and then single pressures, that repeat one value for a long time;
    3. spikes, and samples that repeat the previous one;
    4. uneven sampling times;
    5. speeds and flows without a sign;
    6. gaps, which are interpolated or bridged, and incomplete rows at the ends, which are cut off.

    Steps 0, 3 and 5, bridged gaps, and rows outside of the time span that is left are reported as findings. Channels
    without any value are left out, except chamber pressures. A chamber pressure that is stuck in more than
    `MAX_STUCK_FRACTION` of the rows keeps these rows, and is named as unusable.
    """
    ordered = order_recording(recording)
    part, unwrapped_angles = unwrap_angles(remove_dropouts(remove_impossible(ordered.recording)))
    part = remove_unsupplied(part)
    part = set_missing(part, dict.fromkeys(part.channels, flag_frozen_rows(part)))
    chambers = chambers_of(part)
    # empty channels are left out, except chamber pressures
    names = [name for name in part.channels if name in chambers or np.any(np.isfinite(part[name]))]
    part = part.only(names) if len(names) < len(part.channels) else part
    needed = (*chambers, "u") if "u" in part else chambers
    stuck = {name: rows for name in chambers if (rows := flag_stuck_rows(part, name)).any()}
    unusable = tuple(name for name, rows in stuck.items() if np.mean(rows) > MAX_STUCK_FRACTION)
    part = set_missing(part, {name: rows for name, rows in stuck.items() if name not in unusable})
    part, spikes = remove_spikes(part)
    part, stale_samples = interpolate_stale_samples(part)
    part, restored_signs = restore_signs(resample_evenly(part))
    findings = [*ordered.findings, *unwrapped_angles, *spikes, *stale_samples, *restored_signs]
    part = interpolate_short_gaps(bridge(part, needed), needed)
    if part.bridged is not None:
        bridged = np.flatnonzero(part.bridged)
        gaps = format_count(len(find_runs(part.bridged)), "gap")
        text = f"{format_count(bridged.size, 'missing sample')} in {gaps} bridged: blocks with a long gap count less"
        findings.append(Finding("gaps_bridged", "note", None, bridged.size, float(part.t[bridged[0]]), text))
    part = _cut_to_complete(part, needed)
    times, n_total = ordered.recording.t, len(ordered.recording) + ordered.n_before + ordered.n_after
    n_before, n_after = ordered.n_before, n_total - ordered.n_before
    if len(part):
        n_before += int(np.count_nonzero(times < part.t[0]))
        n_after = ordered.n_after + int(np.count_nonzero(times > part.t[-1]))
    n_outside = len(times) - int(np.count_nonzero((times >= part.t[0]) & (times <= part.t[-1]))) if len(part) else 0
    n_outside += ordered.n_before + ordered.n_after
    if len(part) and n_outside:
        n_within = n_total - n_outside
        text = f"analysed from {part.t[0]:.4g} s to {part.t[-1]:.4g} s: {n_within} of {n_total} samples"
        severity = weigh_defects(n_outside, n_total)
        findings.append(Finding("part_analysed", severity, None, n_outside, float(part.t[0]), text))
    count = max(n_total, 1)
    used = 1.0 - n_outside / count if len(part) else 0.0
    return CorrectedSamples(part, tuple(findings), unusable, used, n_before / count, n_after / count)


def _cut_to_complete(recording: Recording, needed: Sequence[str]) -> Recording:
    """Cut a recording to the rows from the first to the last one that has values in all `needed` channels.

    Without such a row the result is empty. Without `needed` channels, nothing is cut.
    """
    is_complete = np.all([np.isfinite(recording[name]) for name in needed], axis=0) if needed else np.array([True])
    if is_complete.all():
        return recording
    rows = np.flatnonzero(is_complete)
    return recording.samples(slice(int(rows[0]), int(rows[-1]) + 1) if rows.size else slice(0, 0))


def remove_holes(recording: Recording) -> Recording:
    """Replace the filled samples of long gaps by NaN, for detectors that cannot give filled samples a lower weight.

    Short gaps stay filled, but are no longer marked as `bridged`. A recording without long gaps keeps these marks.
    """
    is_hole = flag_holes(recording)
    if not is_hole.any():
        return recording
    return replace(set_missing(recording, dict.fromkeys(recording.channels, is_hole)), bridged=None)
