"""What persons said of alarms, as labelled data: tables of alarms and of estimates."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sealscope.monitor.memory.store import MonitorStore
from sealscope.storage.atomic import atomic_write

Label = Literal["healthy", "leak", ""]
ALARM_COLUMNS = (
    *("id", "actuator", "level", "state", "mark", "reason", "marked_by", "marked_s", "comments", "raised_s", "onset_s"),
    *("onset_low_s", "onset_high_s", "leak_lpm", "leak_low_lpm", "leak_high_lpm", "cause", "evidence", "baseline"),
    "by_chance_per_1000_h",
)
ESTIMATE_COLUMNS = (
    *("actuator", "t", "status", "total_lpm", "total_low_lpm", "total_high_lpm"),
    *("leak_lpm", "leak_low_lpm", "leak_high_lpm", "oil_celsius", "label", "alarm"),
)


@dataclass(frozen=True)
class _Marked:
    """A stretch of time [s] of which a person said what it was."""

    start: float
    stop: float
    label: Label
    alarm: str


def export_labels(store: MonitorStore, folder: Path) -> tuple[int, int]:
    """Write `alarms.csv` and `estimates.csv` into a folder, and return how many rows each has.

    An estimate is labelled `leak` from the start of an alarm's onset interval on until it was marked `repaired` or
    `valid`, and `healthy` until it was marked `invalid`; what nobody said anything of has no label.
    """
    marks: dict[str, list[_Marked]] = {}
    rows = []
    for alarm, events in _alarms(store):
        rows.append(_alarm_row(alarm, events))
        said = _judged(events)
        if said is not None:
            label: Label = "healthy" if said["event"] == "invalid" else "leak"
            start = float((alarm["onset_interval_s"] or (alarm["onset_s"],))[0])
            marks.setdefault(alarm["actuator"], []).append(_Marked(start, float(said["t"]), label, alarm["id"]))
    _write(folder / "alarms.csv", ALARM_COLUMNS, rows)
    count = _write(folder / "estimates.csv", ESTIMATE_COLUMNS, _estimates(store, marks))
    return len(rows), count


def _alarms(store: MonitorStore) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """Yield each alarm, the first raised first, with the events that happened to it."""
    events: dict[str, list[dict[str, Any]]] = {}
    number = 0
    while batch := store.events_since(number):
        for _, event in batch:
            events.setdefault(event["alarm"]["id"], []).append(event)
        number = batch[-1][0]
    for alarm in reversed(store.alarms()):
        yield alarm, events.get(alarm["id"], [])


def _judged(events: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the last event by which a person judged an alarm."""
    return next((event for event in reversed(events) if event["event"] in ("valid", "invalid", "repaired")), None)


def _alarm_row(alarm: Mapping[str, Any], events: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    said = [event for event in events if event["by"]]
    marked = _judged(said)
    onset, leak = alarm["onset_interval_s"] or (None, None), alarm["leak_interval_lpm"] or (None, None)
    return {
        **{name: alarm.get(name) for name in ALARM_COLUMNS},
        "marked_by": marked and marked["by"],
        "marked_s": marked and marked["t"],
        "comments": "; ".join(f"{event['by']}: {event['text']}" for event in said if event["text"]),
        "onset_low_s": onset[0],
        "onset_high_s": onset[1],
        "leak_low_lpm": leak[0],
        "leak_high_lpm": leak[1],
    }


def _estimates(store: MonitorStore, marks: Mapping[str, Sequence[_Marked]]) -> Iterator[dict[str, Any]]:
    for row in store.estimates():
        known = marks.get(row["actuator"], ())
        mark = next((mark for mark in reversed(known) if mark.start <= row["t"] <= mark.stop), None)
        yield {**row, "label": mark.label if mark else "", "alarm": mark.alarm if mark else ""}


def _write(path: Path, columns: Sequence[str], rows: Any) -> int:
    count = 0
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n", extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: _cell(row.get(name)) for name in columns})
            count += 1
    return count


def _cell(value: Any) -> Any:
    """Return a cell that a spreadsheet takes for no formula: names and comments come from outside."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value
