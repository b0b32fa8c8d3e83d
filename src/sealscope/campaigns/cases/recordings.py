"""Rows from recordings of real machines: the same scorers as over simulated records."""

from __future__ import annotations

import hashlib
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from sealscope.campaigns.cases.row import STROKE, CaseRow, error_text
from sealscope.campaigns.cases.scoring import INSPECTED, judge_record
from sealscope.campaigns.plans.model import RecordedPlan, RecordingSet
from sealscope.diagnosis.inspection import inspected
from sealscope.diagnosis.verdict.machine import assumed_rig
from sealscope.errors import InputError, SealscopeError
from sealscope.recordings import read
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording
from sealscope.storage.folders import by_numbers, inner_files

#: Share of the rms of p_A - p_B that its mean exceeds in a stroke of one direction.
_ONE_WAY = 0.5
_log = logging.getLogger(__name__)
#: Called with how many records have their row, how many there are, and how many of those failed.
ProgressCallback = Callable[[int, int, int], None]


def _files(plan: RecordedPlan, folder: Path) -> Iterator[tuple[RecordingSet, Path]]:
    for recordings in plan.sets:
        files = inner_files(folder, folder.glob(recordings.files))
        paths = sorted(files, key=lambda path: by_numbers(path.name))
        selected = paths[recordings.first - 1 : recordings.end - 1]
        if not selected:
            raise InputError(f"a set's files must be there, got none for {recordings.files!r} ({folder})")
        yield from ((recordings, path) for path in selected)


def recorded_rows(plan: RecordedPlan, folder: Path, progress: ProgressCallback | None = None) -> list[CaseRow]:
    """Judge each recording, in the order of their ids; one that cannot be judged has its error."""
    files = list(_files(plan, folder))
    for path, count in Counter(path for _, path in files).items():
        if count > 1:
            raise InputError(f"a recording must be in one set, got it in two ({path})")
    rows: dict[str, CaseRow] = {}
    for number, (recordings, path) in enumerate(files, 1):
        row = _row(plan, recordings, path, path.relative_to(folder).as_posix())
        rows[row.id] = row
        if progress is not None:
            progress(number, len(files), sum(row.error is not None for row in rows.values()))
    return [rows[name] for name in sorted(rows)]


def _direction(recording: Recording) -> str:
    """Determine the direction of a single stroke by the mean of p_A - p_B against its rms; `both` for neither."""
    if not all(name in recording for name in CHAMBERS):
        return "both"
    dp = recording["p_A"] - recording["p_B"]
    share = float(dp.mean() / max(np.sqrt(np.mean(dp**2)), np.finfo(float).tiny))
    return "both" if abs(share) <= _ONE_WAY else "out" if share > 0 else "in"


def _row(plan: RecordedPlan, recordings: RecordingSet, path: Path, name: str) -> CaseRow:
    levels = {"set": recordings.label or recordings.files, STROKE: "unknown"}
    row = partial(
        CaseRow,
        id=hashlib.sha256(os.fsencode(name)).hexdigest()[:16],
        use=recordings.use,
        leak_lpm=recordings.size,
        levels=levels,
    )
    try:
        recording = read(path, map=plan.channel_map or None, rate=plan.rate_hz)
        scores, statements = judge_record(recording, None, plan, assumed_rig(plan.assumed, recording)[0])
        levels[STROKE] = _direction(inspected(recording, INSPECTED).part)
        return row(scores=scores, statements=statements)
    except Exception as error:  # one recording must not end the others; the table says it
        if not isinstance(error, SealscopeError):
            _log.debug("cannot judge %s", path, exc_info=True)
        return row(error=error_text(error))
