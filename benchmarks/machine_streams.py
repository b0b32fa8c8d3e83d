"""Machines in folders as streams: commissioned, watched through healthy sessions, and then with each leak or fault.

    python benchmarks/machine_streams.py FOLDER... [--sessions 4] [--rate 1]

The folders are those of `machine_folders.py`, whose commissioned machines a monitor watches here, in messages of some
seconds. The stream of a machine is all its healthy recordings, in the order of their names, a day apart. For each other
recording a copy of the monitor goes on with it up to `--sessions` times, a day apart, until an alarm. Nobody says when
a leak begins; a false alarm is marked as a person would. It needs the extra `serve`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from machine_folders import call, holds, row_of_leak
from rich.progress import track
from threadpoolctl import threadpool_limits

import sealscope as ss
from sealscope.diagnosis.commissioned.watched import load_watched
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.alarms import Alarm
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.source_block import SourceBlock

#: Rows that are no counts.
HOURS, SESSIONS = "hours", "sessions"
NAME, DAY_S, MESSAGE_S = "machine", 86_400.0, 5.0


class Monitor:
    """A monitor of one machine, with its database in a folder."""

    def __init__(self, folder: Path, machine: Path, rate: float) -> None:
        self.folder, self._machine, self._rate = folder, machine, rate
        settings = ActuatorSettings.model_validate(
            {"name": NAME, "machine": str(machine), "topic": NAME, "false_alarms_per_1000_h": rate}
        )
        self.actuators = WatchedActuators([settings], MonitorStore(f"sqlite:///{folder / 'monitor.db'}"))

    def copy(self, folder: Path) -> Monitor:
        """Return a monitor that goes on from a copy of the database."""
        shutil.copytree(self.folder, folder)
        return Monitor(folder, self._machine, self._rate)

    def watch(self, recording: ss.Recording, day: int) -> Alarm | None:
        """Watch a recording as the session of a day, and return an alarm that it raises."""
        clock = 1.7e9 + DAY_S * day
        recording = replace(recording, t=clock + recording.t - recording.t[0])
        size, raised = max(1, round(MESSAGE_S * recording.rate)), None
        for first in range(0, len(recording), size):
            block = SourceBlock(NAME, f"{day}-{first}", recording.samples(slice(first, first + size)))
            self.actuators.process_blocks([block])
            alarm = self.actuators._actuator(NAME).judge.alarm
            raised = raised or (alarm if alarm is not None and alarm.active else None)
        return raised


def outcomes(machine: Path, folder: Path, rate: float, sessions: int) -> Iterator[tuple[str, float]]:
    """Yield rows of the table with numbers that are averaged, or added up for hours and alarms."""
    truth = json.loads((machine / "truth.json").read_text())
    file = folder / "machine.toml"
    call("commission", machine / "healthy", "-o", file, *truth["options"])
    watched = load_watched(str(file))

    def read(name: str) -> ss.Recording:
        return ss.read(machine / name, map=watched.channel_map, rate=watched.rate)

    (folder / "healthy").mkdir()
    monitor, day = Monitor(folder / "healthy", file, rate), 0
    for name in sorted(name for name, own in truth["files"].items() if own["fault"] == "none"):
        recording = read(name)
        alarm = monitor.watch(recording, day)
        yield HOURS, recording.duration / 3600.0
        yield "healthy sessions: alarms", float(alarm is not None)
        if alarm is not None:
            with suppress(ss.InputError):  # it may be over
                monitor.actuators.apply_mark(NAME, "invalid", text="nothing was found")
        day += 1
    for number, (name, own) in enumerate(truth["files"].items()):
        if own["fault"] == "none":
            continue
        recording, going_on = read(name), monitor.copy(folder / str(number))
        alarms = (going_on.watch(recording, day + session) for session in range(sessions))
        session, alarm = next(((k, alarm) for k, alarm in enumerate(alarms, 1) if alarm is not None), (0, None))
        if own["fault"] != "leak":
            yield "other faults: alarms", float(alarm is not None)
            continue
        yield row_of_leak(own["share"]), float(alarm is not None)
        if alarm is not None:
            yield SESSIONS, float(session)
            if alarm.leak_interval_lpm is not None:
                yield "sizes stated: intervals that hold", float(holds(alarm.leak_interval_lpm, own["leak_lpm"]))


def main() -> None:
    """Watch the machines, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--sessions", type=int, default=4, help="of each leak or fault, at most")
    parser.add_argument("--rate", type=float, default=1.0, help="stated false alarms per 1000 h")
    chosen = parser.parse_args()
    machines = sorted(path.parent for folder in chosen.folder for path in folder.glob("*/truth.json"))
    rows = defaultdict[str, list[float]](list)
    with threadpool_limits(limits=1):
        for machine in track(machines, "machines"):
            with tempfile.TemporaryDirectory() as folder:
                for name, value in outcomes(machine, Path(folder), chosen.rate, chosen.sessions):
                    rows[name].append(value)
    print(f"{sum(rows.pop(HOURS)):.1f} healthy hours")
    print(f"sessions until an alarm, mean: {np.mean(rows.pop(SESSIONS, [np.nan])):.1f}")
    for name, values in rows.items():
        print(f"{name}: {sum(values):g} of {len(values)}")


if __name__ == "__main__":
    main()
