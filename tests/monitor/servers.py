"""Servers that the tests and `benchmarks/monitor_kills.py` start: a broker of MQTT, and PostgreSQL."""

from __future__ import annotations

import os
import random
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
ROOT = os.geteuid() == 0
#: Why PostgreSQL cannot be started, None where it can.
NO_POSTGRESQL = (
    "PostgreSQL is not installed"
    if not BINARIES
    else "PostgreSQL does not run as root"
    if ROOT and shutil.which("runuser") is None
    else None
)


def free_port() -> int:
    """A port of this machine that nobody listens at, and that no connection is given while its server restarts."""
    while True:
        port = random.randrange(20_000, 30_000)
        with socket.socket() as free, suppress(OSError):
            free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            free.bind(("127.0.0.1", port))
            return port


class Broker:
    """A broker whose sessions survive its restart; `guards`: lines of its settings that say whom it lets in."""

    def __init__(self, folder: Path, guards: str = "allow_anonymous true") -> None:
        self.port = free_port()
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\n{guards}\nmax_queued_messages 0\n"
            f"persistence true\npersistence_location {folder}/\nuser root\n"
        )
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen([str(MOSQUITTO), "-c", str(self._config)], stderr=subprocess.DEVNULL)
        for _ in range(600):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise RuntimeError("mosquitto does not answer")

    def open_session(self, client_id: str, topics: Iterable[str]) -> None:
        """Make a client's session, so that what is published from now on is kept for it."""
        client = Client(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTProtocolVersion.MQTTv5)
        properties = Properties(PacketTypes.CONNECT)
        properties.SessionExpiryInterval = 86_400
        heard = threading.Event()
        client.on_subscribe = lambda *_: heard.set()
        client.connect("127.0.0.1", self.port, clean_start=False, properties=properties)
        client.loop_start()
        client.subscribe([(topic, 1) for topic in topics])
        assert heard.wait(120.0), "mosquitto does not take the subscription"
        client.disconnect()
        client.loop_stop()

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait()


class PostgreSQL:
    """A server of PostgreSQL with a database of its own in a folder."""

    def __init__(self, folder: str) -> None:
        if ROOT:
            shutil.chown(folder, "postgres")
        port = free_port()
        self.url = f"postgresql+psycopg://monitor@127.0.0.1:{port}/postgres"
        self._data = f"{folder}/data"
        self._options = ("-l", f"{folder}/log", "-o", f"-p {port} -h 127.0.0.1 -k {folder}")
        self._call("initdb", "-D", self._data, "-A", "trust", "-U", "monitor", "-E", "UTF8", "--no-sync")
        self.start()

    def _call(self, name: str, *words: str) -> None:
        as_user = ["runuser", "-u", "postgres", "--"] if ROOT else []
        command = [*as_user, str(BINARIES[0] / name), *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/")

    def start(self) -> None:
        self._call("pg_ctl", "-D", self._data, "-w", *self._options, "start")

    def stop(self) -> None:
        self._call("pg_ctl", "-D", self._data, "-m", "immediate", "stop")

    def _signal(self, kind: signal.Signals) -> None:
        """Send a signal to the server and to each process that it has made."""
        first = Path(self._data, "postmaster.pid").read_text().split()[0]
        os.kill(int(first), kind)  # before the others are counted: it makes no more of them meanwhile
        made = subprocess.run(["pgrep", "-P", first], capture_output=True, text=True, check=False).stdout.split()
        for process in made:
            with suppress(ProcessLookupError):  # one that goes on may end before its turn
                os.kill(int(process), kind)

    def hang(self) -> None:
        """Stop every process of the server: connections are accepted by the system, and nothing is answered."""
        self._signal(signal.SIGSTOP)

    def go_on(self) -> None:
        self._signal(signal.SIGCONT)
