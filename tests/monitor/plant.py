"""A plant of two actuators whose samples come as JSON lines or as files, and what a monitor stored of them."""

from __future__ import annotations

import io
import json
import os
import random
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import create_engine, inspect, text

from sealscope.monitor.database.tables import metadata
from sealscope.monitor.page.live import LiveSamples
from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings, read_settings
from sealscope.recordings import write
from sealscope.recordings.recording import Recording

from ..diagnosis.balance_machine import machine, step
from ..waiting import until

Rows = dict[str, list[tuple[Any, ...]]]
SETTINGS = """
database = "{database}"
lines = {lines}
settle_s = 0.1
[defaults]
learn_hours = 0.02
warning_lpm = 0.0005
error_lpm = 0.05
[[actuator]]
name = "press 1"
{first}
[[actuator]]
name = "press 2"
{second}
{more}
"""
CHANNELS = ("p_A", "p_B", "x", "theta")
HEADINGS = {"p_A": ("bottom [bar]", 1e-5), "p_B": ("rod [bar]", 1e-5), "x": ("stroke [mm]", 1e3)}
MAP = {"p_A": "bottom", "p_B": "rod", "x": "stroke", "theta": "angle [rad]"}


def log(path: Path, recording: Recording) -> Path:
    """Write a log without a time column, in the headings of a plant."""
    path.parent.mkdir(exist_ok=True)
    columns = {name: recording[channel] * factor for channel, (name, factor) in HEADINGS.items()}
    columns["angle [rad]"] = recording["theta"]
    rows = np.transpose([*columns.values()])
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return path


def settings_in(folder: Path, more: str = "", database: str = "monitor.db", own: str = "") -> MonitorSettings:
    """Settings of two actuators; `own`: of each, with its NAME, where their samples do not come as lines."""
    first, second = (own.replace("NAME", name) for name in ("press 1", "press 2"))
    values = {"database": database, "lines": "false" if own else "true", "more": more}
    file = folder / "monitor.toml"
    file.write_text(SETTINGS.format(first=first, second=second, **values), encoding="utf-8")
    return read_settings(file)


def by_broker(folder: Path, port: int, more: str = "") -> MonitorSettings:
    """Settings of two actuators whose samples come from a broker."""
    mqtt = f'[mqtt]\nhost = "127.0.0.1"\nport = {port}\n{more}'
    return settings_in(folder, mqtt, own='topic = "plant/NAME"')


class Running:
    """A service in a thread."""

    def __init__(self, settings: MonitorSettings) -> None:
        self.service = Service(settings, stdin=io.BytesIO(), stdout=io.StringIO())
        self.thread = threading.Thread(target=self.service.run, daemon=True)
        self.thread.start()

    def until(self, blocks: int) -> None:
        until(lambda: len(rows_of(self.service.settings.database)["blocks"]) >= blocks)

    def end(self) -> None:
        self.service.stop()
        self.thread.join()


def moved(recording: Recording, seconds: float) -> Recording:
    return Recording(recording.t + seconds, recording.channels, recording.units, recording.rate)


def message(actuator: str, samples: Recording) -> dict[str, Any]:
    names = [name for name in (*CHANNELS, "u") if name in samples]
    channels: dict[str, Any] = {name: [float(f"{value:.9g}") for value in samples[name]] for name in names}
    if actuator == "press 2" and float(samples.t[0]) % 30.0 < 1.5:  # now and then a sensor tells how warm the oil is
        channels |= {"T_oil": 40.0 + float(samples.t[0]) // 30.0, "units": {"T_oil": "degC"}}
    return {"actuator": actuator, "t": float(samples.t[0]), "rate": samples.rate, **channels}


def is_viewed(live: LiveSamples, actuator: str) -> bool:
    """Test whether samples of an actuator are kept, which they are only while somebody views it."""
    live.push(actuator, HEALTHY.between(0.0, 1.0))
    return live.version(actuator) > 0


def lines_of(recordings: dict[str, Recording], size: int) -> bytes:
    """JSON lines of recordings, the actuators in turn."""
    lines = []
    longest = max(len(recording) for recording in recordings.values())
    for start in range(0, longest, size):
        for actuator, recording in recordings.items():
            part = recording.samples(slice(start, start + size))
            if len(part):
                lines.append(json.dumps(message(actuator, part)))
    return "\n".join(lines).encode() + b"\n"


WORN = machine(1, G=step(0.0, 3.0e-13, at=100.0), duration=130.0, rate=50.0)
HEALTHY = machine(2, duration=130.0, rate=50.0)
LINES = lines_of({"press 1": WORN, "press 2": HEALTHY}, 150)


def served(settings: MonitorSettings, lines: bytes = b"") -> tuple[Service, str]:
    """A service that has taken all lines and files, and what it wrote."""
    out = io.StringIO()
    service = Service(settings, once=True, stdin=io.BytesIO(lines), stdout=out)
    service.run()
    return service, out.getvalue()


def rows_of(database: str) -> Rows:
    """All rows of a monitor's database but the positions of outputs and what was refused, without events' numbers."""
    url = database if "://" in database else f"sqlite:///{database}"
    engine = create_engine(url)
    rows = {}
    with engine.connect() as connection:
        for table in inspect(engine).get_table_names():
            if table in ("facts", "refused"):
                continue
            columns = [column["name"] for column in inspect(engine).get_columns(table)]
            chosen = ", ".join(name for name in columns if (table, name) != ("events", "number"))
            rows[table] = sorted(map(tuple, connection.execute(text(f"select {chosen} from {table}"))))
    engine.dispose()
    return rows


def write_files(folder: Path, recording: Recording, seconds: float, began: float = 1.7e9) -> None:
    """Write a recording as files of so many seconds, as a logger that began at the clock `began` would have."""
    folder.mkdir(exist_ok=True)
    for k, start in enumerate(np.arange(0.0, recording.duration, seconds)):
        part = recording.between(start, start + seconds)
        file = folder / f"{k:03d}.csv"
        write(part.only(CHANNELS), file)
        at = began + float(part.t[-1])
        os.utime(file, (at, at))


def kill_often(settings: MonitorSettings, lines: Path, kills: int, seed: int) -> int:
    """Run a monitor over a file of lines, kill it at random instants, and let the last run end; return the kills.

    Each run begins the file anew, as a source that repeats what was not acknowledged.
    """
    chance, killed = random.Random(seed), 0
    while True:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                with lines.open("rb") as stream, Path(os.devnull).open("w") as out:
                    Service(settings, once=True, stdin=stream, stdout=out).run()
                status = 0
            finally:
                os._exit(status)
        if killed < kills:
            time.sleep(chance.uniform(0.01, 0.6))
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if os.WIFSIGNALED(status):
            killed += 1
            continue
        assert os.waitstatus_to_exitcode(status) == 0
        if killed >= kills:
            return killed
        # it ended before the instant: a fresh start, or there is nothing left to disturb
        if "://" in settings.database:
            engine = create_engine(settings.database)
            metadata.drop_all(engine)
            engine.dispose()
        else:
            Path(settings.database).unlink()
