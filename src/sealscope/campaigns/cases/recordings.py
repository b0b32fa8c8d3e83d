"""Judge recordings of real machines with the same detectors as simulated records; each gives a row of results."""

from __future__ import annotations

import hashlib
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.campaigns.cases.row import STROKE, CaseRow, error_text
from sealscope.campaigns.cases.scoring import INSPECTED, judge_record
from sealscope.campaigns.plans.model import RecordedPlan, RecordingSet
from sealscope.diagnosis.assumed_rig import assumed_rig
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.errors import InputError, SealscopeError
from sealscope.recordings import read
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Recording
from sealscope.storage.folders import iter_inner_files, numeric_sort_key

#: In a stroke of one direction, |mean| of p_A - p_B exceeds this fraction of the RMS of p_A - p_B.
_MIN_ONE_SIDEDNESS = 0.5
_log = logging.getLogger(__name__)
#: Called with the numbers of records done, of all records, and of failed ones.
ProgressCallback = Callable[[int, int, int], None]


def _iter_files(plan: RecordedPlan, folder: Path) -> Iterator[tuple[RecordingSet, Path]]:
    """Yield pairs of a set of recordings and one of its files in `folder`; raise InputError if a set has no files."""
    for recording_set in plan.sets:
        files = iter_inner_files(folder, folder.glob(recording_set.files))
        paths = sorted(files, key=lambda path: numeric_sort_key(path.name))
        selected = paths[recording_set.first - 1 : recording_set.end - 1]  # `first` counts from 1, `end` is excluded
        if not selected:
            raise InputError(f"a set must have files, got none for {recording_set.files!r} ({folder})")
        yield from ((recording_set, path) for path in selected)


def judge_recordings(plan: RecordedPlan, folder: Path, progress: ProgressCallback | None = None) -> list[CaseRow]:
    """Judge each recording of a plan in a folder; return the rows with results or errors in the order of their ids.

    `progress`: called after each recording with the numbers of recordings done, of all recordings, and of failed ones.
    Raises InputError if a file is in several sets, or a set has no files.
    """
    files = list(_iter_files(plan, folder))
    for path, count in Counter(path for _, path in files).items():
        if count > 1:
            raise InputError(f"a recording must be in one set only, got {count} sets ({path})")
    rows: list[CaseRow] = []
    for recording_set, path in files:
        rows.append(_judge_file(plan, recording_set, path, path.relative_to(folder).as_posix()))
        if progress is not None:
            progress(len(rows), len(files), sum(row.error is not None for row in rows))
    return sorted(rows, key=lambda row: row.id)


def _stroke_direction(recording: Recording) -> str:
    """Classify a recording as strokes "out" (p_A well above p_B on average) or "in" (well below), else as "both".

    It is "both", too, if a chamber's pressure was not recorded.
    """
    if not all(name in recording for name in CHAMBERS):
        return "both"
    dp = recording["p_A"] - recording["p_B"]
    mean_over_rms = float(dp.mean() / max(np.sqrt(np.mean(dp**2)), np.finfo(float).tiny))  # tiny: no division by 0
    return "both" if abs(mean_over_rms) <= _MIN_ONE_SIDEDNESS else "out" if mean_over_rms > 0 else "in"


def _judge_file(plan: RecordedPlan, recording_set: RecordingSet, path: Path, name: str) -> CaseRow:
    """Read and judge one recording of a set; return the row with its results, or with the error that prevented them.

    `name`: path of the recording within the folder, from which the id of the row is computed.
    """
    levels: dict[str, str | float] = {"set": recording_set.label or recording_set.files, STROKE: "unknown"}
    results: dict[str, Any]
    try:
        recording = read(path, map=plan.channel_map or None, rate=plan.rate_hz)
        rig, _ = assumed_rig(plan.assumed, recording)
        scores, statements = judge_record(recording, None, plan, rig)  # None: scorers split it in the middle
        levels[STROKE] = _stroke_direction(inspect_recording(recording, INSPECTED).part)
        results = {"scores": scores, "statements": statements}
    except Exception as error:  # one bad recording must not end the campaign; its row carries the error
        if not isinstance(error, SealscopeError):
            _log.debug("cannot judge %s", path, exc_info=True)
        results = {"error": error_text(error)}
    row_id = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    return CaseRow(id=row_id, use=recording_set.use, leak_lpm=recording_set.size, levels=levels, **results)
