"""Collect machine, date, operator and oil temperature of a recording for the head of a page."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording


def collect_particulars(recording: Recording, rig: Rig | None = None) -> dict[str, str]:
    """Collect the facts about a recording for the head of its page, as texts by label, such as "Date" or "Operator".

    They come from remarks in the recording's file, else from `rig` (machine) and the recording's start (date), in the
    order of `particulars.toml`.
    """
    remarks = recording.remarks
    patterns_by_label = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    facts: dict[str, str] = {}
    start = recording.provenance.get("start")
    if isinstance(start, str):
        facts["Date"] = re.sub(r"\.\d+", "", start).replace("T", " ")  # without fractions of a second
    if rig is not None:
        facts["Machine"] = (rig.title or rig.name).partition(":")[0]  # a title may continue with details after a colon
    for label, patterns in patterns_by_label.items():
        matches = (name for pattern in patterns for name in remarks if re.fullmatch(pattern, name, re.IGNORECASE))
        name = next(matches, None)
        if name is not None:
            facts[label] = remarks.pop(name)  # from a copy of the remarks; none is used for two facts
    return {label: facts[label] for label in patterns_by_label if label in facts}
