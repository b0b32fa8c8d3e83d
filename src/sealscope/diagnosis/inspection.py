"""Inspect recordings before any detector runs: which samples can be analysed, and what can be trusted and compared.

The judged recording and its leak-free baselines pass the same checks. Baselines that fail them, or that are copies of
another recording, are left out for all detectors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.healthy import Healthy, SummarisedRecording, learn_once
from sealscope.paragraphs import join_names
from sealscope.recordings.channels import CHANNEL_UNITS, SLOW, chambers_of
from sealscope.recordings.corrections.samples import correct_samples
from sealscope.recordings.formats.headings.labels import Label, find_name_and_unit, suggest_map_entry
from sealscope.recordings.header import oil_temperature
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import (
    MISSING_CHANNEL,
    SHORTEST,
    Finding,
    Severity,
    describe_missing_chambers,
    find_implausibility,
    inspect,
)
from sealscope.recordings.recording import Recording, compute_once
from sealscope.units import same_dimension

#: Most corrected samples of a healthy recording that are kept on disk.
_MAX_CORRECTED = 10_000


@dataclass(frozen=True, eq=False)
class Inspection:
    """A recording that was corrected and checked before the detectors use it."""

    # samples at equal steps, from the first to the last with all chamber pressures and the command
    part: Recording
    findings: tuple[Finding, ...]  # defects found in the whole recording
    distrust: str | None  # reason why the chamber pressures cannot be trusted; None if they can
    share: float  # fraction of the recording's samples between the first and the last time of `part`
    judged_from: float = 0.0  # fraction of the recording's samples before the first time of `part`
    judged_until: float = 1.0  # fraction of the recording's samples up to the last time of `part`

    @property
    def defect(self) -> str | None:
        """Reason why the recording cannot serve as a baseline; None if it can."""
        if missing := describe_missing_chambers(self.part):
            return missing
        if len(self.part) < SHORTEST:
            return f"needs {SHORTEST} samples or more, got {len(self.part)}"
        return self.distrust

    @property
    def defect_shares(self) -> dict[str, float]:
        """Share of the samples in which each defect was found, by its code and channel (`_defect_name`)."""
        return {_defect_name(finding): finding.count / len(self.part) for finding in self.findings if len(self.part)}

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of each channel of the corrected recording."""
        return self.part.units

    @property
    def file(self) -> str | None:
        """Name of the file that the recording was read from; None if there is none."""
        file = self.part.provenance.get("file")
        return None if file is None else str(file)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the chamber pressures in hexadecimal digits, equal for copies of a recording."""
        return sha256(b"".join(self.part[name].tobytes() for name in chambers_of(self.part))).hexdigest()


def inspect_recording(recording: Recording, channels: Iterable[str] | None = None) -> Inspection:
    """Correct a recording and look for defects of its `channels`, by default of all; the result is cached with it."""
    names = tuple(name for name in recording.channels if channels is None or name in channels)
    return compute_once(recording, ("inspection", names), lambda samples: _inspect(samples, names))


def inspect_healthy(recording: Recording) -> Inspection:
    """Inspect all channels of a healthy recording; the result is kept on disk by its content (`learn_once`).

    An inspection that moves samples in time, or corrects more than `_MAX_CORRECTED` of them, is computed anew.
    """

    def restore_or_inspect(samples: Recording) -> Inspection:
        """Restore the inspection from its description on disk, or compute it and keep the description."""
        computed = list[Inspection]()

        def inspect_and_describe(samples: Recording) -> dict[str, Any] | None:
            """Inspect the recording and describe the result."""
            computed.append(_inspect(samples, tuple(samples.channels)))
            return _describe_inspection(computed[0], samples)

        kept = learn_once(samples, ("kept inspection",), inspect_and_describe)
        if computed:
            return computed[0]
        return _inspect(samples, tuple(samples.channels)) if kept is None else _restore_inspection(kept, samples)

    return compute_once(recording, ("inspection", tuple(recording.channels)), restore_or_inspect)


def _describe_inspection(inspection: Inspection, recording: Recording) -> dict[str, Any] | None:
    """Describe an inspection by plain values, with the samples that it corrected; None if these are too many."""
    part = inspection.part
    same = (part.rate, part.units, part.provenance) == (recording.rate, recording.units, recording.provenance)
    if not same or not np.array_equal(part.t, recording.t):
        return None
    bridged = None if part.bridged is None else np.flatnonzero(part.bridged)
    corrected, count = dict[str, Any](), 0 if bridged is None else bridged.size
    for name, values in part.channels.items():
        # bit by bit, as missing values are not equal to themselves
        rows = np.flatnonzero(values.view(np.int64) != recording[name].view(np.int64))
        corrected[name], count = (rows, values[rows]), count + rows.size
    if count > _MAX_CORRECTED:
        return None
    return {
        "corrected": corrected,
        "bridged": bridged,
        "history": part.history,
        "findings": [tuple(vars(finding).values()) for finding in inspection.findings],
        "numbers": (inspection.distrust, inspection.share, inspection.judged_from, inspection.judged_until),
    }


def _restore_inspection(kept: Mapping[str, Any], recording: Recording) -> Inspection:
    """Restore the inspection of a recording from its description (`_describe_inspection`)."""
    channels = dict[str, Any]()
    for name, (rows, values) in kept["corrected"].items():
        channels[name] = recording[name]
        if rows.size:
            channels[name] = recording[name].copy()
            channels[name][rows] = values
    bridged = None if kept["bridged"] is None else np.isin(np.arange(len(recording)), kept["bridged"])
    part = replace(recording, channels=channels, history=kept["history"], bridged=bridged)
    return Inspection(part, tuple(Finding(*values) for values in kept["findings"]), *kept["numbers"])


def _inspect(recording: Recording, names: Sequence[str]) -> Inspection:
    """Correct the samples of a recording, find the defects of the channels `names`, and test if it can be trusted."""
    chambers = chambers_of(recording)
    # `stuck`: names of chamber pressures that repeat one value for too long
    part, corrections, stuck, share, unjudged_before, unjudged_after = correct_samples(recording)
    findings = (*inspect(recording.only(names)), *corrections)
    chamber_findings = [finding for finding in findings if finding.channel in chambers]
    defects = [finding for finding in chamber_findings if finding.code == "constant"]
    defects += [finding for finding in findings if finding.channel in stuck and finding.code == "stuck"]
    for code in ("clipped", "impossible"):
        mostly = [finding for finding in chamber_findings if finding.code == code and finding.count > len(part) / 2]
        if len(mostly) == len(chambers):  # one such chamber is no obstacle: the other chamber is judged
            defects += mostly
    distrust = f"the pressures cannot be trusted: {defects[0].text}" if defects else None
    # a shorter part has a `defect` in any case
    if distrust is None and len(part) >= SHORTEST and (reason := find_implausibility(part)):
        distrust = f"this is no recording of a hydraulic machine: {reason}"
    return Inspection(part, findings, distrust, share, unjudged_before, 1.0 - unjudged_after)


def _defect_name(finding: Finding) -> str:
    """Name the kind of a defect by its code and, if it is one of a channel, the channel."""
    return f"{finding.code} {finding.channel or ''}".strip()


def _lower_usual(judged: Inspection, entries: Sequence[Inspection | SummarisedRecording]) -> tuple[Finding, ...]:
    """Make those findings on a recording notes that all of its comparable healthy recordings (`entries`) have, too.

    In one of them a usual defect has at least 1 / `gaps.usual` (`priors.toml`) of its share of the samples.
    """
    healthy = [
        entry.defect_shares if isinstance(entry, Inspection) else entry.about.get("defects", {}) for entry in entries
    ]
    shares, findings = judged.defect_shares, list[Finding]()
    for finding in judged.findings:
        name = _defect_name(finding)
        known = [share[name] for share in healthy if name in share]
        is_known = finding.severity == "warning" and known and len(known) == len(healthy)
        is_usual = is_known and shares[name] <= RECORDINGS.gaps.usual * max(known)
        findings.append(replace(finding, severity="note") if is_usual else finding)
    return tuple(findings)


class Baselines(NamedTuple):
    """Leak-free recordings that can be compared with the judged one, and reasons for those that cannot."""

    judged: Recording  # the judged recording, without channels that none of the comparable ones has
    parts: tuple[Healthy, ...]  # the comparable recordings: samples that can be analysed, or stored summaries
    findings: tuple[Finding, ...]  # defects of the judged one, baselines left out, with the reasons, channels left out
    refusal: str | None  # if all given baselines were left out, the most frequent reason


def select_comparable(judged: Inspection, baseline: Sequence[Healthy]) -> Baselines:
    """Inspect the baselines of a judged recording and choose those that can be compared with it.

    Of baselines with the same samples, the one with the most channels is kept. Differences of speed, load and
    temperature are accepted, as the detectors allow for them. From the judged recording, channels that no comparable
    baseline has are left out, unless they change slowly, such as the oil temperature: estimates from different channels
    would not be comparable.
    """
    healthy = [entry if isinstance(entry, SummarisedRecording) else inspect_healthy(entry) for entry in baseline]
    index_of_digest: dict[str, int] = {}  # index of each comparable recording, by its digest
    left_out: dict[tuple[Severity, str], list[int]] = {}  # indices of the other recordings, by severity and reason
    for k in sorted(range(len(healthy)), key=lambda k: -len(healthy[k].units)):  # most channels first
        entry = healthy[k]
        obstacle = _find_obstacle(entry, judged)
        if obstacle is None and entry.digest in index_of_digest:
            obstacle = "note", "the same samples as another baseline recording"
        if obstacle is None:
            index_of_digest[entry.digest] = k
        else:
            left_out.setdefault(obstacle, []).append(k)
    findings = []
    for (severity, text), indices in left_out.items():
        names = [healthy[k].file or f"number {k + 1}" for k in sorted(indices)]
        count = f"{len(names)} of {len(healthy)} baseline recordings {'is' if len(names) == 1 else 'are'}"
        note = f"{count} left out: {text} ({join_names(names, most=3)})"
        findings.append(
            Finding("baseline_left_out", severity, channel=None, count=len(indices), first_t=None, text=note)
        )
    refusal = None
    if healthy and not index_of_digest:
        _, most_frequent_reason = max(left_out, key=lambda obstacle: len(left_out[obstacle]))
        refusal = f"no baseline recording can be used: {most_frequent_reason}"
    entries = [healthy[k] for k in sorted(index_of_digest.values())]  # in the order of `baseline`
    parts = tuple(entry.part if isinstance(entry, Inspection) else entry for entry in entries)
    findings = [*_lower_usual(judged, entries), *_find_missing_channels(judged, entries), *findings]
    part = judged.part
    # without a comparable baseline no channel is left out
    known = SLOW.union(*(entry.units for entry in entries)) if entries else part.channels.keys()
    if unknown := [name for name in part.channels if name not in known]:
        note = f"left out, as no baseline recording has it: {', '.join(unknown)}"
        findings.append(Finding("channels_left_out", "note", channel=None, count=len(unknown), first_t=None, text=note))
        part = part.only(name for name in part.channels if name in known)
    return Baselines(part, parts, tuple(findings), refusal)


def _find_missing_channels(judged: Inspection, entries: Sequence[Inspection | SummarisedRecording]) -> list[Finding]:
    """Report each channel that most comparable healthy recordings have, but the judged one lacks, with the remedy.

    An oil temperature that the file's header states replaces the channel T_oil.
    """
    part, findings = judged.part, list[Finding]()
    for name in CHANNEL_UNITS:
        count = sum(name in entry.units for entry in entries)
        if name in part or 2 * count <= len(entries) or (name == "T_oil" and oil_temperature(part) is not None):
            continue
        text = f"{name}: {count} of {len(entries)} healthy recordings have it and this one does not, so that the bound "
        text += "allows for what it may have been"
        if (column := _find_column_for(name, part)) is None:
            text += "; record it, or map its column"
        else:
            text += f"; if {column} is its column: --map '{name}={column}', or in the [map] of the machine's file: "
            text += f'{name} = "{column}"'
        findings.append(Finding(MISSING_CHANNEL, "warning", name, len(part), None, text))
    return findings


def _find_column_for(channel: str, recording: Recording) -> str | None:
    """Find the unused column of a recording's file that could be the `channel`, by its name or else its unit."""
    if channel == "T_oil" and recording.unused_temperatures:
        return recording.unused_temperatures[0]
    columns = {column: Label.parse(column) for column in recording.unused}
    by_name = (column for column, label in columns.items() if suggest_map_entry(label).startswith(f"{channel}="))
    units = {column: find_name_and_unit(label)[1] for column, label in columns.items()}
    by_unit = (column for column, unit in units.items() if unit and same_dimension(unit, CHANNEL_UNITS[channel]))
    return next(by_name, next(by_unit, None))


def _find_obstacle(entry: Inspection | SummarisedRecording, judged: Inspection) -> tuple[Severity, str] | None:
    """Find severity and text of why the baseline `entry` cannot be compared with `judged`; None if it can."""
    if isinstance(entry, Inspection) and entry.defect is not None:  # no summary is stored with a defect
        return "warning", entry.defect
    if entry.digest == judged.digest:
        return "warning", "the same samples as the recording itself"
    if any(entry.units.get(name) != judged.units[name] for name in chambers_of(judged.part)):
        return "note", "other channels or units"
    return None
