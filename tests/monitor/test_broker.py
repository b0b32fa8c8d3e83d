"""Blocks by a real broker: what comes while the monitor is away is stored once, alarms are retained."""

from __future__ import annotations

import io
import json
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from paho.mqtt import publish, subscribe
from paho.mqtt.enums import MQTTProtocolVersion

from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings, read_settings

from .plant import rows_of, served, settings_in
from .test_service import LINES

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")]
SETTINGS = """
database = "monitor.db"
[mqtt]
host = "127.0.0.1"
port = {port}
[defaults]
learn_hours = 0.02
warning_lpm = 0.0005
error_lpm = 0.05
[[actuator]]
name = "press 1"
topic = "plant/press 1"
[[actuator]]
name = "press 2"
topic = "plant/press 2"
"""


class Broker:
    """A broker whose sessions survive its restart."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\nmax_queued_messages 0\n"
            f"persistence true\npersistence_location {folder}/\nuser root\n"
        )
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen([str(MOSQUITTO), "-c", str(self._config)], stderr=subprocess.DEVNULL)
        for _ in range(100):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.stop()


@pytest.fixture
def port(broker: Broker) -> int:
    return broker.port


class Running:
    """A service in a thread."""

    def __init__(self, settings: MonitorSettings) -> None:
        self.service = Service(settings, stdin=io.BytesIO(), stdout=io.StringIO())
        self.thread = threading.Thread(target=self.service.run)
        self.thread.start()

    def until(self, blocks: int) -> None:
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline and len(rows_of(self.service.settings.database)["blocks"]) < blocks:
            time.sleep(0.1)

    def end(self) -> None:
        self.service.stop()
        self.thread.join()


def send(port: int, lines: list[bytes]) -> None:
    messages = [
        {"topic": f"plant/{json.loads(line)['actuator']}", "payload": line, "qos": 1, "retain": False} for line in lines
    ]
    publish.multiple(messages, hostname="127.0.0.1", port=port, protocol=MQTTProtocolVersion.MQTTv5)


def test_what_comes_while_the_monitor_is_away_is_stored_once(port: int, tmp_path: Path):
    plain = tmp_path / "plain"
    plain.mkdir()
    served(settings_in(plain), LINES)
    file = tmp_path / "monitor.toml"
    file.write_text(SETTINGS.format(port=port))
    settings, lines = read_settings(file), LINES.splitlines()
    third = len(lines) // 3
    first = Running(settings)
    time.sleep(0.5)  # it subscribes
    send(port, [b"not a block for press 1".join([b'{"actuator": "press 1", "x": "', b'"}'])])
    send(port, lines[:third])
    first.until(third)
    first.end()
    send(port, lines[third - 5 : 2 * third])  # five once more
    second = Running(settings)
    second.until(2 * third)
    send(port, lines[2 * third :])
    second.until(len(lines))
    time.sleep(0.5)
    second.end()
    assert rows_of(settings.database) == rows_of(str(plain / "monitor.db"))
    retained = subscribe.simple("sealscope/press 1/alarm", hostname="127.0.0.1", port=port)
    alarm = json.loads(retained.payload)
    assert (alarm["id"], alarm["state"]) == ("press 1-1", "unacknowledged")


def test_a_broker_that_restarts_loses_nothing(broker: Broker, tmp_path: Path):
    plain = tmp_path / "plain"
    plain.mkdir()
    served(settings_in(plain), LINES)
    file = tmp_path / "monitor.toml"
    file.write_text(SETTINGS.format(port=broker.port))
    lines = LINES.splitlines()
    running = Running(read_settings(file))
    time.sleep(0.5)
    for start in range(0, len(lines), 30):
        send(broker.port, lines[start : start + 30])
        broker.stop()
        time.sleep(0.2)
        broker.start()
    running.until(len(lines))
    running.end()
    assert rows_of(running.service.settings.database) == rows_of(str(plain / "monitor.db"))
    assert running.service.actuators.counters.get("messages that hold no block") is None
