"""What persons said of alarms, as labelled data: tables of alarms and of estimates."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.database.tables import FIGURES
from sealscope.storage.csv_file import write_csv

ALARM_COLUMNS = (
    *("id", "actuator", "level", "state", "mark", "reason", "marked_by", "marked_s", "comments", "raised_s", "onset_s"),
    *("onset_low_s", "onset_high_s", "leak_lpm", "leak_low_lpm", "leak_high_lpm", "cause", "evidence", "baseline"),
    "by_chance_per_1000_h",
)
ESTIMATE_COLUMNS = ("actuator", "t", "status", *FIGURES, "label", "alarm")
#: What a person may say of an alarm -> what its estimates are then.
_LABELS = {"valid": "leak", "repaired": "leak", "invalid": "healthy"}


def export_labels(store: MonitorStore, folder: Path) -> tuple[int, int]:
    """Write `alarms.csv` and `estimates.csv` into a folder, and return how many rows each has.

    An estimate is labelled `leak` from the start of an alarm's onset interval on until it was marked `repaired` or
    `valid`, and `healthy` until it was marked `invalid`; what nobody said anything of has no label.
    """
    events, number = defaultdict[str, list[dict[str, Any]]](list), 0
    while batch := store.events_since(number):
        number = batch[-1][0]
        for _, event in batch:
            events[event["alarm"]["id"]].append(event)
    rows, labelled = [], defaultdict[str, list[tuple[float, float, dict[str, str]]]](list)
    for alarm in sorted(reversed(store.alarms()), key=lambda alarm: float(alarm["raised_s"])):
        history = events[alarm["id"]]
        judged = next((event for event in reversed(history) if event["event"] in _LABELS), None)
        onset, leak = alarm["onset_interval_s"] or (None, None), alarm["leak_interval_lpm"] or (None, None)
        row = {
            "marked_by": None if judged is None else judged["by"],
            "marked_s": None if judged is None else judged["t"],
            "comments": "; ".join(
                f"{event['by']}: {event['text']}" for event in history if event["by"] and event["text"]
            ),
            **dict(zip(("onset_low_s", "onset_high_s"), onset, strict=True)),
            **dict(zip(("leak_low_lpm", "leak_high_lpm"), leak, strict=True)),
        }
        rows.append({**alarm, **row})
        if judged is not None:
            start, label = alarm["onset_s"] if onset[0] is None else onset[0], _LABELS[judged["event"]]
            labelled[alarm["actuator"]].append((start, judged["t"], {"label": label, "alarm": alarm["id"]}))

    count = 0

    def estimates() -> Iterator[dict[str, Any]]:
        nonlocal count
        for count, row in enumerate(store.estimates(), 1):  # noqa: B007 (returned)
            known = [label for start, stop, label in labelled[row["actuator"]] if start <= row["t"] <= stop]
            yield _cells({**row, **(known[-1] if known else {})}, ESTIMATE_COLUMNS)

    write_csv(folder / "alarms.csv", ALARM_COLUMNS, [_cells(row, ALARM_COLUMNS) for row in rows])
    write_csv(folder / "estimates.csv", ESTIMATE_COLUMNS, estimates())
    return len(rows), count


def _cells(row: dict[str, Any], columns: Sequence[str]) -> dict[str, Any]:
    return {name: row.get(name) for name in columns}
