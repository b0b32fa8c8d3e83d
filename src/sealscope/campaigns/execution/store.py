"""A campaign's folder: the rows that belong to a plan, and the inputs they were made from."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from sealscope.campaigns.cases.case import CaseInputs, cases_of, code_key, digest, world
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.plans.detectors import DIAGNOSE, plan_detector
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.diagnosis.detectors.registry import PlugIn, detectors
from sealscope.errors import InputError, UnreadableFile
from sealscope.storage import rows
from sealscope.storage.atomic import atomic_write
from sealscope.storage.folders import make_folder
from sealscope.storage.opening import open_inner
from sealscope.storage.plain_values import parse_json

#: What rows of one folder must share, and how messages call it.
_SAME = {
    "format": "form of rows",
    "name": "campaign",
    "world": "rig, bench, length, onset or seed",
    "code": "program code",
    "mode": "mode of making rows (run by run, or in batches)",
    "false_alarm_within": "false-alarm probability, at which its detectors search within a record",
    "assumed": "rig that its detectors assume",
    "plug_ins": "detectors of other distributions",
    "views": "channels that its detectors see",
}
#: The form of a row: 3 since rows hold no operating point.
FORMAT = 3
HEAD, WHAT = "campaign.json", "a campaign"
#: Largest head [bytes].
_LARGEST_HEAD = 1_000_000
#: How rows are made unless in batches.
RUN_BY_RUN = "run by run"


@dataclass(frozen=True)
class CampaignProgress:
    """Progress of a campaign.

    `records` in the plan, how many are `done`, and `failed` of these; `seconds`: processor time of a record on
    average, None where none is done.
    """

    records: int
    done: int
    failed: int
    seconds: float | None

    @property
    def complete(self) -> bool:
        """True if every record has its row."""
        return self.done == self.records


def made_from(plan: SimulatedPlan, mode: str = RUN_BY_RUN) -> dict[str, Any]:
    """Collect the inputs of a campaign's rows as plain values; `mode`: `RUN_BY_RUN` or `batches.IN_BATCHES`."""
    detectors = [plan_detector(name) for name in plan.detectors]
    searching = any(detector.scorer is None for detector in detectors)  # its verdict follows from the probability
    assumed = plan.assumed
    return {
        "format": FORMAT,
        "name": plan.name,
        "title": plan.title,
        "world": world(plan),
        "mode": mode,
        "code": code_key(),
        "false_alarm_within": plan.false_alarm if searching else None,
        "assumed": digest({name: repr(value) for name, value in assumed.present().items()}) if searching else None,
        "plug_ins": _plug_ins(plan),
        "views": {view: list(plan.views.get(view, ())) for view in sorted({detector.view for detector in detectors})},
        "version": _version(),
    }


def _plug_ins(plan: SimulatedPlan) -> dict[str, str]:
    """Collect the detectors of other distributions that a plan runs, each with a hash of its source."""
    run = {detector.base for name in plan.detectors if (detector := plan_detector(name)).scorer is None}
    return {
        name: plug_in.fingerprint
        for name, plug_in in detectors().items()
        if isinstance(plug_in, PlugIn) and (name in run or DIAGNOSE in run)
    }


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("sealscope")
    except PackageNotFoundError:  # a source tree that is not installed
        return "unknown"


def read_rows(folder: Path) -> dict[str, CaseRow]:
    """Read rows by case id, the last of each (`storage.rows.read_rows`)."""
    return rows.read_rows(folder, CaseRow.from_dict, WHAT)


def rows_of(plan: SimulatedPlan, folder: Path) -> dict[str, CaseRow]:
    """Read the folder's rows that belong to the plan, by case id in rising order.

    Rows that lack one of the plan's detectors are left out. Raises InputError for rows of another plan, UnreadableFile
    for a row whose inputs differ from its case's.
    """
    rows_by_id = read_rows(folder)
    if rows_by_id:
        _check_same(folder, head(folder) or {}, made_from(plan), ("mode", "code"))
    detectors = set(plan.detectors)
    of_plan: dict[str, CaseRow] = {}
    for case in sorted(cases_of(plan), key=lambda case: case.id):
        row = rows_by_id.get(case.id)
        if row is None:
            continue
        if any(getattr(row, field.name) != getattr(case, field.name) for field in fields(CaseInputs)):
            place = folder / rows.ROWS
            raise UnreadableFile(f"a row must say the inputs of its case, got others of {case.id} ({place})")
        if row.error is not None or detectors <= set(row.scores):
            of_plan[row.id] = row
    return of_plan


def progress_of(plan: SimulatedPlan, folder: Path) -> CampaignProgress:
    """Compute the progress of the campaign in the folder."""
    done = rows_of(plan, folder).values()
    seconds = [row.seconds for row in done if row.error is None]
    mean = sum(seconds) / len(seconds) if seconds else None
    return CampaignProgress(plan.size, len(done), len(done) - len(seconds), mean)


def head(folder: Path) -> dict[str, Any] | None:
    """Read the inputs of the folder's campaign, None where there is none yet."""
    path = folder / HEAD
    try:
        with open_inner(path, "a campaign's head") as file:
            tree = parse_json(file.read(_LARGEST_HEAD))
    except FileNotFoundError:
        return None
    except InputError:
        raise
    except (OSError, ValueError, RecursionError):
        tree = None
    if not isinstance(tree, dict):
        raise UnreadableFile(f"a campaign's head must be a JSON object, got something else ({path})")
    return tree


def begin(folder: Path, source: Mapping[str, Any]) -> None:
    """Make the folder a campaign's, or continue in it; raise InputError where it holds rows of another campaign."""
    make_folder(folder)
    before = head(folder) or {}
    if (folder / rows.ROWS).is_file():
        open_inner(folder / rows.ROWS, f"{WHAT}'s file of rows", "ab+").close()
        _check_same(folder, before, source)
    with atomic_write(folder / HEAD) as temporary:
        temporary.write_text(json.dumps(source, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _check_same(folder: Path, before: Mapping[str, Any], source: Mapping[str, Any], but: Collection[str] = ()) -> None:
    """Raise InputError where the inputs `before` differ from `source`, except in the entries `but`."""
    for key, name in _SAME.items():
        if key not in but and before.get(key) != source[key]:
            raise InputError(
                f"a campaign continues only with the same {name}: its rows would not belong together; choose "
                f"another folder or remove this one ({folder})"
            )
