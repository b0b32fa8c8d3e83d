"""Export alarms and estimates as labelled data; the labels follow from the marks that persons gave the alarms."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sealscope.diagnosis.verdict.evidence import LEAK
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.database.tables import FIGURES
from sealscope.storage.csv_file import write_csv

ALARM_COLUMNS = (
    *("id", "actuator", "level", "state", "mark", "reason", "marked_by", "marked_s", "comments", "raised_s", "onset_s"),
    *("onset_low_s", "onset_high_s", "leak_lpm", "leak_low_lpm", "leak_high_lpm", "cause", "evidence", "baseline"),
    "by_chance_per_1000_h",
)
ESTIMATE_COLUMNS = ("actuator", "t", "status", *FIGURES, "label", "alarm")
#: Label of the estimates during an alarm, by the mark of the alarm.
_LABELS = {"valid": LEAK, "repaired": LEAK, "invalid": "healthy"}


def export_labels(store: MonitorStore, folder: Path) -> tuple[int, int]:
    """Write all alarms and estimates of a monitor to `alarms.csv` and `estimates.csv`; return both counts.

    The estimates from the start of an alarm's onset interval until the alarm's last mark are labelled: `leak` if the
    mark is `repaired` or `valid`, `healthy` if it is `invalid`. Other estimates have no label.
    """
    events = _events_by_alarm(store)
    alarms = []
    # by actuator: start and stop [s] of an interval, and the columns `label` and `alarm` of the estimates in it
    intervals = defaultdict[str, list[tuple[float, float, dict[str, str]]]](list)
    # `alarms` lists the latest first: reversed and sorted by time, the labels of the latest alarm come last
    for alarm in sorted(reversed(store.alarms()), key=lambda alarm: float(alarm["raised_s"])):
        history = events[alarm["id"]]
        last_mark: dict[str, Any] = next((event for event in reversed(history) if event["event"] in _LABELS), {})
        onset_low, onset_high = alarm["onset_interval_s"] or (None, None)
        leak_low, leak_high = alarm["leak_interval_lpm"] or (None, None)
        comments = (f"{event['by']}: {event['text']}" for event in history if event["by"] and event["text"])
        alarm |= {
            "marked_by": last_mark.get("by"),
            "marked_s": last_mark.get("t"),
            "comments": "; ".join(comments),
            "onset_low_s": onset_low,
            "onset_high_s": onset_high,
            "leak_low_lpm": leak_low,
            "leak_high_lpm": leak_high,
        }
        alarms.append(_select_columns(alarm, ALARM_COLUMNS))
        if last_mark:
            start = alarm["onset_s"] if onset_low is None else onset_low
            labels = {"label": _LABELS[last_mark["event"]], "alarm": alarm["id"]}
            intervals[alarm["actuator"]].append((start, last_mark["t"], labels))

    def label_estimates() -> Iterator[dict[str, Any]]:
        for row in store.estimates():
            for start, stop, labels in intervals[row["actuator"]]:
                if start <= row["t"] <= stop:
                    row.update(labels)
            yield _select_columns(row, ESTIMATE_COLUMNS)

    n_alarms = write_csv(folder / "alarms.csv", ALARM_COLUMNS, alarms)
    return n_alarms, write_csv(folder / "estimates.csv", ESTIMATE_COLUMNS, label_estimates())


def _events_by_alarm(store: MonitorStore) -> defaultdict[str, list[dict[str, Any]]]:
    """Read all events of alarms, and group them by the id of the alarm, in their order."""
    events = defaultdict[str, list[dict[str, Any]]](list)
    last_number = 0
    while batch := store.events_since(last_number):
        for number, event in batch:
            events[event["alarm"]["id"]].append(event)
            last_number = number
    return events


def _select_columns(row: dict[str, Any], columns: Sequence[str]) -> dict[str, Any]:
    return {name: row.get(name) for name in columns}
