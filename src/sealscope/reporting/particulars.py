"""What a reader looks for first beside the verdict: machine, date, operator and oil temperature of a recording."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from sealscope.parameters import Rig
from sealscope.recordings.formats.headings.preamble import remarks_of
from sealscope.recordings.recording import Recording


def particulars_of(recording: Recording, rig: Rig | None = None) -> dict[str, str]:
    """Return the known facts about a recording, by the names of `particulars.toml` and in their order.

    The machine and the date fall back on the title of `rig` and on the recording's own start.
    """
    remarks = remarks_of(recording.provenance)
    names = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    known: dict[str, str] = {}
    start = recording.provenance.get("start")
    if isinstance(start, str):
        known["Date"] = re.sub(r"\.\d+", "", start).replace("T", " ")
    if rig is not None:
        known["Machine"] = (rig.title or rig.name).partition(":")[0]
    for label, patterns in names.items():
        matches = (name for pattern in patterns for name in remarks if re.fullmatch(pattern, name, re.IGNORECASE))
        name = next(matches, None)
        if name is not None:
            known[label] = remarks.pop(name)
    return {label: known[label] for label in names if label in known}
