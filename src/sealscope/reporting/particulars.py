"""What a reader looks for first beside the verdict: machine, date, operator and oil temperature of a recording."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sealscope.parameters import Rig
from sealscope.recordings.formats.headings.preamble import remarks_of
from sealscope.recordings.recording import Recording

#: What a page names, in its order, and the names under which logs state it, the most telling first.
_NAMES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Machine", (
        "machine", "maschine", "actuator", "aktor", "cylinder", "zylinder", "(unit|device) under test", "uut", "dut",
        "prüfling", "asset", "test ?(bench|rig|stand)", "bench|rig|prüfstand|anlage", "serial.*|seriennummer",
    )),
    ("Date", ("(date|time)[ /_]?(time)?", "datum", "(test|recording|start)[ _]?(date|time)", "recorded|start")),
    ("Operator", (
        "operator|operador|opérateur|bediener|bearbeiter", "prüfer|tester|technician|engineer", "author|user",
    )),
    ("Oil temperature", (
        "(hydraulic )?(oil|öl|fluid)[ _.-]*(temp.*|t)", "t_?(oil|öl)", "temp[a-z]*[ _.-]*(oil|öl|fluid)", "oil|öl",
        "(tank[ _]*)?temp[a-z]*",
    )),
)  # fmt: skip


@dataclass(frozen=True)
class Particulars:
    """Entries of a recording's preamble: `leading` those a reader looks for, `others` the rest, each (name, text)."""

    leading: tuple[tuple[str, str], ...]
    others: tuple[tuple[str, str], ...]

    def get(self, name: str) -> str | None:
        """Return a leading entry's text, None where there is none."""
        return dict(self.leading).get(name)


def particulars_of(recording: Recording, rig: Rig | None = None) -> Particulars:
    """Return what is known of a recording beside its samples.

    The machine and the date fall back on the title of `rig` and on the recording's own start.
    """
    remarks = remarks_of(recording.provenance)
    known: dict[str, str] = {}
    taken = set()
    for label, patterns in _NAMES:
        matches = (name for pattern in patterns for name in remarks if re.fullmatch(pattern, name, re.IGNORECASE))
        name = next((name for name in matches if name not in taken), None)
        if name is not None:
            known[label] = remarks[name]
            taken.add(name)
    start = recording.provenance.get("start")
    if isinstance(start, str):
        known.setdefault("Date", re.sub(r"\.\d+", "", start).replace("T", " "))
    if rig is not None:
        known.setdefault("Machine", (rig.title or rig.name).partition(":")[0])
    leading = tuple((label, known[label]) for label, _ in _NAMES if label in known)
    return Particulars(leading, tuple((name, text) for name, text in remarks.items() if name not in taken))
