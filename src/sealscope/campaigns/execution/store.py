"""A campaign's folder: the rows with the results of its records, and the head, which lists the inputs of all rows."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from statistics import fmean
from typing import Any

from sealscope.campaigns.cases.case import CaseInputs, code_key, digest, list_cases, shared_inputs
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.plans.detectors import DIAGNOSE, parse_detector_name
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.diagnosis.detectors.registry import PlugIn, detectors
from sealscope.errors import InputError, UnreadableFile
from sealscope.storage import rows
from sealscope.storage.atomic import atomic_write
from sealscope.storage.folders import make_folder
from sealscope.storage.opening import open_inner
from sealscope.storage.plain_values import parse_json

#: Entries of the head that must be the same for all rows of a folder, with their names in messages.
_SHARED_ENTRIES = {
    "format": "form of rows",
    "name": "campaign",
    "world": "rig, bench, length, onset or seed",
    "code": "program code",
    "false_alarm_within": "false-alarm probability, at which its detectors search within a record",
    "assumed": "rig that its detectors assume",
    "plug_ins": "detectors of other distributions",
    "views": "channels that its detectors see",
}
#: Version of the format of rows; 3 since rows contain no operating point.
FORMAT = 3
#: Name of the head's file, and of the folder's content in messages.
HEAD, WHAT = "campaign.json", "a campaign"
_MAX_HEAD_BYTES = 1_000_000


@dataclass(frozen=True)
class CampaignProgress:
    """The progress of a campaign.

    `done`: number of the plan's `records` that have been run; `failed`: number of these that ended with an error;
    `seconds`: mean processor time of a record [s], None if no record has a result.
    """

    records: int
    done: int
    failed: int
    seconds: float | None


def collect_row_inputs(plan: SimulatedPlan) -> dict[str, Any]:
    """Collect the inputs on which all rows (results) of a campaign depend, as plain JSON values.

    Title and version of Sealscope are added for readers only.
    """
    detectors = [parse_detector_name(name) for name in plan.detectors]
    # scores of scorers depend neither on the false-alarm probability nor on the assumed rig
    has_verdicts = any(detector.scorer is None for detector in detectors)
    assumed_values = {name: repr(value) for name, value in plan.assumed.present_values().items()}
    return {
        "format": FORMAT,
        "name": plan.name,
        "title": plan.title,
        "world": shared_inputs(plan),
        "code": code_key(),
        "false_alarm_within": plan.false_alarm if has_verdicts else None,
        "assumed": digest(assumed_values) if has_verdicts else None,
        "plug_ins": _plug_ins(plan),
        "views": {view: list(plan.views.get(view, ())) for view in sorted({detector.view for detector in detectors})},
        "version": _installed_version(),
    }


def _plug_ins(plan: SimulatedPlan) -> dict[str, str]:
    """Collect the detectors of other distributions that a plan runs: a hash of the source file, by detector.

    A plan with `diagnose` runs all of them.
    """
    # all but the scorers, which are built in
    bases = {detector.base for name in plan.detectors if (detector := parse_detector_name(name)).scorer is None}
    return {
        name: plug_in.fingerprint
        for name, plug_in in detectors().items()
        if isinstance(plug_in, PlugIn) and (name in bases or DIAGNOSE in bases)
    }


def _installed_version() -> str:
    """Return the version of the installed package, or "unknown" for a source tree that is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("sealscope")
    except PackageNotFoundError:
        return "unknown"


def read_rows(folder: Path) -> dict[str, CaseRow]:
    """Read the newest row (stored result) of each case from a campaign's folder, by the id of the case."""
    return rows.read_rows(folder, CaseRow.from_dict, WHAT)


def read_plan_rows(plan: SimulatedPlan, folder: Path) -> dict[str, CaseRow]:
    """Read the rows (stored results) of a plan's cases from a campaign's folder, by id of the case, ascending.

    A row that lacks the score of one of the plan's detectors is left out, unless its case failed. Raises InputError if
    the rows belong to another plan, and UnreadableFile if the inputs in a row differ from those of its case.
    """
    rows_by_id = read_rows(folder)
    if rows_by_id:  # rows from other program code can still be read
        _check_same_inputs(folder, read_head(folder), collect_row_inputs(plan), ignored=("code",))
    detectors = set(plan.detectors)
    plan_rows: dict[str, CaseRow] = {}
    for case in sorted(list_cases(plan), key=lambda case: case.id):
        row = rows_by_id.get(case.id)
        if row is None:
            continue
        if any(getattr(row, field.name) != getattr(case, field.name) for field in fields(CaseInputs)):
            place = folder / rows.ROWS
            raise UnreadableFile(f"a row must state the inputs of its case, got others for {case.id} ({place})")
        if row.error is not None or detectors <= set(row.scores):
            plan_rows[row.id] = row
    return plan_rows


def read_progress(plan: SimulatedPlan, folder: Path) -> CampaignProgress:
    """Read the rows in a campaign's folder, and count the records that are done and those that failed."""
    done = read_plan_rows(plan, folder).values()
    seconds = [row.seconds for row in done if row.error is None]
    return CampaignProgress(plan.size, len(done), len(done) - len(seconds), fmean(seconds) if seconds else None)


def read_head(folder: Path) -> dict[str, Any]:
    """Read a campaign's head, the file with the inputs on which all its rows (stored results) depend.

    Returns {} if there is no such file yet. Raises UnreadableFile if it is damaged.
    """
    path = folder / HEAD
    try:
        with open_inner(path, "a campaign's head") as file:
            tree = parse_json(file.read(_MAX_HEAD_BYTES))
    except FileNotFoundError:
        return {}
    except InputError:  # also a ValueError, but its message already names the cause
        raise
    except (OSError, ValueError, RecursionError):
        tree = None
    if not isinstance(tree, dict):
        raise UnreadableFile(f"a campaign's head must be a JSON object, got something else ({path})")
    return tree


def begin_campaign(folder: Path, row_inputs: Mapping[str, Any]) -> None:
    """Write the head of a new or continued campaign, the file with the inputs on which all its rows depend.

    Raises InputError if the folder has rows that were made from other inputs.
    """
    make_folder(folder)
    existing = read_head(folder)
    if (folder / rows.ROWS).is_file():
        open_inner(folder / rows.ROWS, f"{WHAT}'s file of rows", "ab+").close()  # raises if no row can be appended
        _check_same_inputs(folder, existing, row_inputs)
    with atomic_write(folder / HEAD) as temporary:
        temporary.write_text(json.dumps(row_inputs, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _check_same_inputs(
    folder: Path, existing: Mapping[str, Any], row_inputs: Mapping[str, Any], ignored: Collection[str] = ()
) -> None:
    """Check that new rows have the inputs of the stored rows, in the head `existing`; raise InputError otherwise.

    `ignored`: names of the inputs that may differ.
    """
    for key, name in _SHARED_ENTRIES.items():
        if key not in ignored and existing.get(key) != row_inputs[key]:
            raise InputError(
                f"a campaign continues only with the same {name}: its rows would not belong together; choose "
                f"another folder or remove this one ({folder})"
            )
