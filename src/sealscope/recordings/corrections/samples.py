"""All corrections of a recording's samples in their order, as the inspection and the folder monitor apply them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.corrections.clock import even_clock
from sealscope.recordings.corrections.gaps import bridge, filled, holes, remove_dropouts, remove_impossible
from sealscope.recordings.corrections.spikes import without_spikes
from sealscope.recordings.corrections.stale import MOST_STUCK, frozen_rows, stuck_rows, without_stale_samples
from sealscope.recordings.corrections.unsigned import with_signed_speed
from sealscope.recordings.formats.columns import counted
from sealscope.recordings.motion import runs_of
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording


class CorrectedSamples(NamedTuple):
    """A recording whose samples are corrected.

    `recording`: on an even clock, from the first to the last sample with all chamber pressures and the command;
    `findings`: what was corrected; `stuck`: chambers whose pressure is stuck for too long to be believed; `share` of
    the samples that lie within the recording.
    """

    recording: Recording
    findings: tuple[Finding, ...]
    stuck: tuple[str, ...]
    share: float


def correct_samples(recording: Recording) -> CorrectedSamples:
    """Correct what loggers do to samples: spikes, stale samples, uneven clocks, missing signs, gaps."""
    part, findings = remove_dropouts(remove_impossible(recording)), list[Finding]()
    if (frozen := frozen_rows(part)).any():
        channels = {name: np.where(frozen, np.nan, values) for name, values in part.channels.items()}
        part = replace(part, channels=channels)
    chambers = chambers_of(part)
    known = [name for name in part.channels if name in chambers or np.any(np.isfinite(part[name]))]
    part = part.only(known) if len(known) < len(part.channels) else part  # the pressures can do without
    needed = (*chambers, "u") if "u" in part else chambers
    stuck = {name: rows for name in chambers if (rows := stuck_rows(part, name)).any()}
    distrusted = tuple(name for name, rows in stuck.items() if np.mean(rows) > MOST_STUCK)
    missing = {name: np.where(rows, np.nan, part[name]) for name, rows in stuck.items() if name not in distrusted}
    part = replace(part, channels={**part.channels, **missing}) if missing else part
    for correct in (without_spikes, without_stale_samples, _evened, with_signed_speed):
        part, found = correct(part)
        findings += found
    part = filled(bridge(part, needed), needed)
    if part.bridged is not None:
        lost = np.flatnonzero(part.bridged)
        text = (
            f"{counted(lost.size, 'missing sample')} in {counted(len(runs_of(part.bridged)), 'gap')} bridged: what a "
            "long one touches counts less"
        )
        findings.append(Finding("gaps_bridged", "note", None, lost.size, float(part.t[lost[0]]), text))
    kept = np.flatnonzero(np.all([np.isfinite(part[name]) for name in needed], axis=0)) if needed else None
    if kept is not None and kept.size < len(part):
        part = part.samples(slice(int(kept[0]), int(kept[-1]) + 1) if kept.size else slice(0, 0))
    within = int(np.count_nonzero((recording.t >= part.t[0]) & (recording.t <= part.t[-1]))) if len(part) else 0
    share = within / max(len(recording), 1)
    if len(part) and within < len(recording):
        text = f"analysed from {part.t[0]:.4g} s to {part.t[-1]:.4g} s: {within} of {len(recording)} samples"
        first = float(part.t[0])
        findings.append(Finding("part_analysed", "warning", None, len(recording) - within, first, text))
    return CorrectedSamples(part, tuple(findings), distrusted, share)


def without_holes(recording: Recording) -> Recording:
    """Set what lies in long bridged gaps to NaN, for what has no weights."""
    rows = holes(recording)
    if not rows.any():
        return recording
    channels = {name: np.where(rows, np.nan, values) for name, values in recording.channels.items()}
    return replace(recording, channels=channels, bridged=None)


def _evened(recording: Recording) -> tuple[Recording, list[Finding]]:
    return even_clock(recording), []
