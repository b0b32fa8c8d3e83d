"""Kills of a monitor at random instants over a replay by MQTT: its rows beside those of an undisturbed run.

    python benchmarks/monitor_kills.py [--kills 500] [--database postgresql] [--each 10] [--minutes 9]

Simulated actuators (p_A, p_B, x, theta at 500 Hz, one of two with a leak) are replayed to mosquitto in messages of 1 s.
A monitor is ended by SIGKILL at an instant between 0 and 0.4 s after its start, `--each` times a replay, and begun
again; the broker holds the whole replay, so that a monitor is at work once it is connected. Then a last run takes what
is left. All rows of
the database (blocks, estimates, alarms, events, states, samples since the last checkpoint) are compared with those of a
run that nobody killed, the last retained alarm with the stored one, and each event must have gone out by the lines.

Each replay is a row of `results/monitor_kills.csv`: its seed, kills, how many of these met a monitor that had stored
blocks since its start and had more to store, rows compared, rows that differ, events, events that no line told, and
whether the retained alarm is the stored one. A second call goes on after the last seed. It needs mosquitto, and
PostgreSQL where that is the database.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from paho.mqtt import publish, subscribe
from paho.mqtt.enums import MQTTProtocolVersion
from sqlalchemy import create_engine, inspect, text

import sealscope as ss
from sealscope.monitor.database.tables import metadata
from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings
from sealscope.monitor.sources import broker as _loaded  # noqa: F401 (here, not by each monitor anew)

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.monitor.plant import message, rows_of
from tests.monitor.servers import Broker, PostgreSQL

RESULTS = Path(__file__).parent / "results" / "monitor_kills.csv"
COLUMNS = (
    *("database", "seed", "kills", "amid_blocks", "rows", "rows_that_differ"),
    *("events", "events_untold", "retained_alarm_is_the_stored", "seconds"),
)
LEAKS = {"press 1": "0.0042 L/min from 200 s", "press 2": None}
#: A run is killed after at most so long, and the last one must be done after so long [s].
LONGEST_S, DONE_S = 0.4, 120.0


def replay(seconds: float = 300.0) -> list[tuple[str, bytes]]:
    """Return actuators and messages in turn."""
    made = []
    for k, (actuator, leak) in enumerate(LEAKS.items()):
        recording = ss.simulate(command="3 sin(4t)", duration=seconds, seed=k, leak=leak)
        learned = ss.watch("thesis", learn_hours=0.02)
        learned.update(recording)  # what is compiled is loaded here, not by each monitor anew
        made.append(
            [
                (actuator, json.dumps(message(actuator, recording.samples(slice(at, at + 500)))).encode())
                for at in range(0, len(recording), 500)
            ]
        )
    return [pair for pairs in zip(*made, strict=True) for pair in pairs]


class Plant:
    """A broker, a database, and the monitor between them."""

    def __init__(self, folder: Path, broker: Broker, database: str, name: str) -> None:
        self.broker, self.database, self.name = broker, database, name
        self.lines = folder / f"{name}.jsonl"
        self.settings = MonitorSettings.model_validate(
            {
                "database": database,
                "defaults": {"learn_hours": 0.02, "warning_lpm": 0.0005, "error_lpm": 0.05},
                "mqtt": {
                    "host": "127.0.0.1",
                    "port": broker.port,
                    "client_id": name,
                    "alarms_topic": f"{name}-alarms",
                },
                "actuator": [{"name": actuator, "topic": f"{name}/{actuator}"} for actuator in LEAKS],
            }
        )

    def subscribed(self) -> None:
        """Make the session that the broker keeps messages for."""
        self.broker.open_session(self.name, [f"{self.name}/{actuator}" for actuator in LEAKS])

    def published(self, messages: list[tuple[str, bytes]]) -> None:
        """Publish messages, each once."""
        publish.multiple(
            [{"topic": f"{self.name}/{name}", "payload": payload, "qos": 1} for name, payload in messages],
            hostname="127.0.0.1",
            port=self.broker.port,
            protocol=MQTTProtocolVersion.MQTTv5,
        )

    def started(self) -> int:
        """Return the process of a monitor."""
        child = os.fork()
        if child:
            return child
        status = 1
        try:
            with self.lines.open("a") as out:
                service = Service(self.settings, stdout=out)
                signal.signal(signal.SIGTERM, lambda *_: service.stop())
                service.run()
            status = 0
        finally:
            os._exit(status)

    def ended(self, blocks: int) -> None:
        """Let a monitor take what is left, and end it in good order."""
        child, began = self.started(), time.monotonic()
        while self.stored() < blocks or self.untold():
            if time.monotonic() - began > DONE_S:
                os.kill(child, signal.SIGKILL)
                raise RuntimeError(f"{self.name}: {self.stored()} of {blocks} blocks stored after {DONE_S:.0f} s")
            time.sleep(0.1)
        os.kill(child, signal.SIGTERM)
        _, status = os.waitpid(child, 0)
        if os.waitstatus_to_exitcode(status) != 0:
            raise RuntimeError(f"{self.name}: the last monitor ended with {os.waitstatus_to_exitcode(status)}")

    def stored(self) -> int:
        """Return how many blocks are stored."""
        return int(self._number("select count(*) from blocks"))

    def untold(self) -> int:
        """Return how many events have not gone out by the lines."""
        numbers = set()
        for line in self.lines.read_text().splitlines():
            try:
                numbers.add(json.loads(line)["number"])
            except ValueError:
                continue  # the line at which a monitor was killed
        return int(self._number("select count(*) from events")) - len(numbers)

    def retained(self) -> bool:
        """Return whether the broker's retained alarm is the last event's."""
        alarm = self._number("select alarm from events order by number desc limit 1")
        kept = subscribe.simple(f"{self.name}-alarms/press 1/alarm", hostname="127.0.0.1", port=self.broker.port)
        return bool(json.loads(kept.payload) == json.loads(alarm))

    def _number(self, query: str) -> Any:
        engine = create_engine(url_of(self.database))
        try:
            if not inspect(engine).has_table("facts"):  # the first monitor was killed before it made the tables
                return 0
            with engine.connect() as connection:
                return connection.execute(text(query)).scalar()
        finally:
            engine.dispose()


def url_of(database: str) -> str:
    """Return a database as a URL."""
    return database if "://" in database else f"sqlite:///{database}"


def emptied(database: str) -> None:
    """Make the tables of a database anew."""
    engine = create_engine(url_of(database))
    metadata.drop_all(engine)
    engine.dispose()


def main() -> None:
    """Kill, compare, and write a row a replay."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=500, help="kills in all, those of earlier calls included")
    parser.add_argument("--each", type=int, default=10, help="kills of one replay")
    parser.add_argument("--database", choices=("postgresql", "sqlite"), default="postgresql")
    parser.add_argument("--minutes", type=float, default=9.0, help="no replay is begun after so long")
    chosen = parser.parse_args()
    done = list(csv.DictReader(RESULTS.open())) if RESULTS.exists() else []
    mine = [row for row in done if row["database"] == chosen.database]
    kills, seed = sum(int(row["kills"]) for row in mine), 1 + max((int(row["seed"]) for row in mine), default=-1)
    if not RESULTS.exists():
        RESULTS.write_text(",".join(COLUMNS) + "\n")
    messages, began = replay(), time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="sealscope-kills-"))
    server, broker = None, None
    try:
        broker = Broker(folder)
        if chosen.database == "postgresql":
            data = folder / "postgresql"
            data.mkdir()
            folder.chmod(0o755)
            server = PostgreSQL(str(data))
        database = server.url if server else str(folder / "monitor.db")
        plain = Plant(folder, broker, database, "undisturbed")
        emptied(database)
        plain.subscribed()
        plain.published(messages)
        plain.ended(len(messages))
        expected = rows_of(database)
        while kills < chosen.kills and time.monotonic() - began < 60.0 * chosen.minutes:
            start, chance = time.monotonic(), random.Random(seed)
            emptied(database)
            plant = Plant(folder, broker, database, f"killed-{seed}")
            plant.subscribed()
            plant.published(messages)
            amid = before = 0
            for _ in range(chosen.each):
                child = plant.started()
                time.sleep(chance.uniform(0.0, LONGEST_S))
                os.kill(child, signal.SIGKILL)
                _, status = os.waitpid(child, 0)
                if not os.WIFSIGNALED(status):
                    raise RuntimeError(f"a monitor ended by itself with {os.waitstatus_to_exitcode(status)}")
                stored = plant.stored()
                amid += before < stored < len(messages)
                before = stored
            plant.ended(len(messages))
            rows = rows_of(database)
            differ = sum(len(set(rows[table]) ^ set(expected[table])) for table in expected)
            differ += sum(abs(len(rows[table]) - len(expected[table])) for table in expected)
            row = (
                chosen.database,
                seed,
                chosen.each,
                amid,
                sum(map(len, expected.values())),
                differ,
                len(expected["events"]),
                plant.untold(),
                plant.retained(),
                f"{time.monotonic() - start:.1f}",
            )
            with RESULTS.open("a") as file:
                file.write(",".join(map(str, row)) + "\n")
            kills, seed = kills + chosen.each, seed + 1
            print(dict(zip(COLUMNS, row, strict=True)), flush=True)
    finally:
        if server:
            server.stop()
        if broker:
            broker.stop()
        shutil.rmtree(folder, ignore_errors=True)
    print(f"{chosen.database}: {kills} kills")


if __name__ == "__main__":
    main()
