"""An hour of attacks on a monitor: its blocks, marks and alarms beside those of a monitor that nobody disturbed.

    python benchmarks/monitor_hostility.py [--minutes 60] [--actuators 50] [--seed 0] [-o result.json]

Two monitors with the same settings get the same blocks in real time, by MQTT and as files in folders, and persons mark
the same alarms of both. One of them is attacked all the time (`ATTACKS`): hostile messages, files, links, connections
and requests, a webhook and a standard output that misbehave, a broker that restarts, and kills. After each minute both
must have stored all blocks; then the alarms are marked. At the end the rows of blocks, estimates, alarms and events
must be the same, numbers to nine digits, and each event must have arrived at the webhook and in the lines. It needs
mosquitto.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import random
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from sqlalchemy import create_engine, text

from sealscope.monitor.sparkplug import BIRTH_SEQUENCE, DOUBLE, INT64, SparkplugMetric, SparkplugPayload, encode_payload
from sealscope.recordings import write
from sealscope.recordings.recording import Recording

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.diagnosis.balance_machine import machine, step
from tests.monitor.plant import CHANNELS, message
from tests.monitor.servers import Broker, free_port
from tests.monitor.test_dropouts import dropped
from tests.monitor.test_message_limits import HOSTILE as CBOR
from tests.monitor.test_message_limits import colliding
from tests.recordings.test_packed_files import rows, workbook

RATE, BLOCK_S, ROUND_S, TOKEN = 50.0, 10.0, 60.0, "the page's token"
#: How long an answer of the page is waited for, and for the blocks of a round to be stored [s], on a busy machine.
PATIENCE_S = 600.0
#: One of so many actuators has its samples in files, and one of so many leaks.
FILES, LEAKS = 10, 3
SETTINGS = """
database = "monitor.db"
settle_s = 0.5
[defaults]
learn_hours = 0.03
warning_lpm = 0.0005
error_lpm = 0.05
[page]
port = {page}
token_file = "token.txt"
[mqtt]
host = "127.0.0.1"
port = {broker}
[webhook]
url = "http://127.0.0.1:{hook}/events"
timeout_s = 2.0
[[actuator]]
name = "bait"
folder = "bait"
[[actuator]]
name = "edge bait"
sparkplug = "plant/bait"
rate = 50.0
"""


class Hook:
    """A webhook that keeps the numbers of events, and answers as `manner` says."""

    def __init__(self) -> None:
        self.manner, self.numbers = "well", Counter[int]()
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            line, _ = self._socket.accept()
            threading.Thread(target=self._answer, args=(line,), daemon=True).start()

    def _answer(self, line: socket.socket) -> None:
        with suppress(OSError), line:
            line.settimeout(10.0)
            got = b""
            while b"\r\n\r\n" not in got:
                got += line.recv(65536)
            head, _, body = got.partition(b"\r\n\r\n")
            size = int(re.search(rb"content-length: (\d+)", head.lower())[1])  # type: ignore[index]
            while len(body) < size:
                body += line.recv(65536)
            if self.manner == "well":
                self.numbers[int(json.loads(body)["number"])] += 1
                line.sendall(b"HTTP/1.1 204 No Content\r\n\r\n")
            elif self.manner == "no HTTP":
                line.sendall(b"\x00\xff hello\r\n\r\n")
            elif self.manner == "an error":
                line.sendall(b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n")
            elif self.manner == "silence":
                time.sleep(8.0)
            else:
                for letter in b"HTTP/1.1 200 OK\r\n" + b"X-Wait: yes\r\n" * 9:
                    line.sendall(bytes([letter]))
                    time.sleep(0.5)


class Monitor:
    """A monitor in a process of its own, with the broker and the webhook that it needs."""

    def __init__(self, folder: Path, names: list[str]) -> None:
        self.folder, self.names = folder, names
        folder.mkdir()
        self.broker, self.hook, self.page = Broker(folder), Hook(), free_port()
        (folder / "token.txt").write_text(TOKEN)
        lines = [SETTINGS.format(page=self.page, broker=self.broker.port, hook=self.hook.port)]
        for k, name in enumerate(names):
            where = f'folder = "files {k}"' if k % FILES == 0 else f'topic = "plant/{k}"'
            lines.append(f"[[actuator]]\nname = {json.dumps(name)}\n{where}\n")
            (folder / f"files {k}").mkdir()
        (folder / "bait").mkdir()
        (folder / "monitor.toml").write_text("\n".join(lines))
        self.broker.open_session("sealscope-monitor", [f"plant/{k}" for k in range(len(names)) if k % FILES])
        self.client = Client(CallbackAPIVersion.VERSION2, "plant", protocol=MQTTProtocolVersion.MQTTv5)
        self.client.reconnect_delay_set(1, 1)
        self.client.connect("127.0.0.1", self.broker.port)
        self.client.loop_start()
        self.lines, self.log = folder / "lines.jsonl", folder / "monitor.log"
        self.busy_s, self.largest, self.starts = 0.0, 0, 0
        self.start()

    def start(self, stdout: str = "file") -> None:
        """Start it; `stdout`: "file", "full" (a disk without room) or "closed" (a pipe that nobody reads)."""
        self.starts += 1
        out: Any
        if stdout == "closed":
            read, out = os.pipe()
            os.close(read)
        else:
            out = os.open("/dev/full" if stdout == "full" else self.lines, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        with self.log.open("ab") as log:
            call = [sys.executable, "-m", "sealscope", "monitor", "monitor.toml"]
            self.process = subprocess.Popen(call, cwd=self.folder, stdin=subprocess.DEVNULL, stdout=out, stderr=log)
        os.close(out)

    def end(self, number: signal.Signals = signal.SIGTERM) -> float:
        """End it; return how long that took [s]."""
        began = time.monotonic()
        self.process.send_signal(number)
        _, _, usage = os.wait4(self.process.pid, 0)
        self.process.returncode = 0
        self.busy_s += usage.ru_utime + usage.ru_stime
        self.largest = max(self.largest, usage.ru_maxrss)
        return time.monotonic() - began

    def ask(self, path: str, body: dict[str, str] | None = None, timeout: float = 30.0) -> Any:
        """Return what the page answers; asked again while the monitor begins, or too many guess its token."""
        request = urllib.request.Request(f"http://127.0.0.1:{self.page}{path}")
        request.add_header("Authorization", f"Bearer {TOKEN}")
        if body is not None:
            request.data = json.dumps(body).encode()
            request.add_header("X-Sealscope", "mark")
        deadline = time.monotonic() + PATIENCE_S
        while True:
            if (status := self.process.poll()) is not None:
                raise RuntimeError(f"the monitor has ended by itself with {status}: {self.log.read_text()[-2000:]}")
            try:
                with urllib.request.urlopen(request, timeout=timeout) as answer:
                    return json.load(answer)
            except (OSError, ValueError) as error:
                if isinstance(error, urllib.error.HTTPError) and error.code not in (429, 503):
                    return {"status": error.code, "body": error.read(1000).decode("utf-8", "replace")}
                if time.monotonic() > deadline:
                    raise RuntimeError(f"{path}: {error!r}: {self.log.read_text()[-2000:]}") from None
            time.sleep(0.5)

    def rows(self, query: str) -> list[tuple[Any, ...]]:
        """Return rows of its database."""
        if not (self.folder / "monitor.db").exists():
            return []
        engine = create_engine(f"sqlite:///{self.folder / 'monitor.db'}")
        try:
            with engine.connect() as connection:
                return [tuple(row) for row in connection.execute(text(query))]
        finally:
            engine.dispose()

    def stored(self) -> int:
        """Return how many blocks of the plant are stored."""
        return len(self.blocks())

    def blocks(self) -> list[tuple[Any, ...]]:
        """Return actuator and identity of the plant's blocks."""
        rows = self.rows("select actuator, identity from blocks where actuator not like '%bait'")
        return sorted(row for row in rows if not row[1].startswith("hostile"))

    def lines_out(self) -> Counter[int]:
        """Return how often each event has gone out by a line."""
        numbers = Counter[int]()
        for line in self.lines.read_text().splitlines():
            with suppress(ValueError):  # the line at which it was killed
                numbers[json.loads(line)["number"]] += 1
        return numbers


def plant(count: int, seconds: float, seed: int) -> tuple[list[str], list[Recording]]:
    """Return names and recordings of actuators: one of three begins to leak, another gives zeros for 15 s."""
    names = [f"line {k // 10}/press {k}" for k in range(count)]
    chance, made = random.Random(seed), []
    for k in range(min(count, 4 * LEAKS)):
        leak = step(0.0, 3.0e-13, at=chance.uniform(0.2, 0.7) * seconds) if k % LEAKS == 1 else 0.0
        whole = machine(seed + k, G=leak, duration=seconds, rate=RATE).only(CHANNELS)
        made.append(dropped(whole, 0.6 * seconds, 15.0) if k % LEAKS == 2 else whole)
    return names, [made[k % len(made)] for k in range(count)]


class Attacks:
    """What is played against a monitor; `counts`: how often each was."""

    def __init__(self, monitor: Monitor, seed: int) -> None:
        self.monitor, self.chance = monitor, random.Random(seed)
        self.counts: Counter[str] = Counter()
        self.slowest_end = 0.0
        self.deaf: list[str] = []
        self._held: list[tuple[float, list[socket.socket]]] = []
        self._number = 0

    def play(self) -> None:
        """Play one at random."""
        self._held = [(ends, lines) for ends, lines in self._held if ends > time.monotonic() or _closed(lines)]
        name, attack = self.chance.choice(ATTACKS)
        self.counts[name] += 1
        attack(self)

    def calm_down(self) -> None:
        """End what would last, so that all blocks can be stored."""
        self.monitor.hook.manner = "well"
        for _, lines in self._held:
            _closed(lines)
        self._held = []

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish a hostile message."""
        self.monitor.client.publish(topic, payload, qos=1)

    def a_topic(self) -> str:
        """Return the topic of some actuator."""
        return f"plant/{self.chance.choice([k for k in range(len(self.monitor.names)) if k % FILES])}"

    def deep_json(self) -> None:
        depth = self.chance.choice([500, 1000, 1020, 5000, 100_000])
        key = self.chance.choice([b"actuator", b"t", b"x", b"units", b"id", b"p_A"])
        self.publish(self.a_topic(), b'{"' + key + b'": ' + b"[" * depth + b"1" + b"]" * depth + b"}")

    def odd_message(self) -> None:
        kind = self.chance.randrange(4)
        self.publish(
            self.a_topic(),
            [b"", b"\x81" * 50_000, self.chance.randbytes(500), b'{"t": 0, "rate": 50, "x": [1e999]}'][kind],
        )

    def hostile_cbor(self) -> None:
        """Big numbers of one hash as keys, patterns, mail, depth, and lengths that are not there."""
        self.publish(self.a_topic(), self.chance.choice([*CBOR.values(), colliding(100_000)]))

    def twice_the_key(self) -> None:
        keys = b", ".join(
            self.chance.choice([b'"t": 1', b'"x": [1, 2]', b'"units": {"x": "m", "x": "mm"}']) for _ in "abc"
        )
        self.publish(self.a_topic(), b'{"t": 0, "rate": 50, "x": [' + b"9" * 5000 + b"], " + keys + b"}")

    def forwarded_guesses(self) -> None:
        """Guess the token, each time for another address; five are looked at."""
        viewing = 0
        for k in range(20):
            request = urllib.request.Request(f"http://127.0.0.1:{self.monitor.page}/metrics")
            request.add_header("Authorization", f"Bearer guess {k}")
            request.add_header("X-Forwarded-For", f"10.0.{self.chance.randrange(256)}.{k}")
            try:
                urllib.request.urlopen(request, timeout=10.0).close()
            except urllib.error.HTTPError as error:
                viewing += error.code == 401
            except OSError:
                pass  # it is being killed, or its connections are held
        if viewing > 6:  # a pause may end meanwhile
            self.deaf.append(f"{viewing} guesses were looked at")

    def death_with_an_array(self) -> None:
        birth = (SparkplugMetric(BIRTH_SEQUENCE, 3, INT64), SparkplugMetric("p_A", 1.0, DOUBLE))
        array = (SparkplugMetric(BIRTH_SEQUENCE, np.arange(3.0), 31),)
        self.publish("spBv1.0/plant/NBIRTH/bait", encode_payload(SparkplugPayload(1, birth, 0)))
        self.publish("spBv1.0/plant/NDEATH/bait", encode_payload(SparkplugPayload(1, array, None)))
        self.publish("spBv1.0/plant/NDATA/bait", self.chance.randbytes(60))

    def hostile_file(self, suffix: bytes, contents: bytes, folder: str | None = None) -> Path:
        """Write a hostile file into the folder of an actuator, or into the bait's."""
        self._number += 1
        if folder is None:
            wet = [f"files {k}" for k in range(0, len(self.monitor.names), FILES)]
            folder = self.chance.choice([*wet, "bait", "bait"])
        name = b"hostile %d" % self._number + suffix
        path = Path(os.fsdecode(os.fsencode(self.monitor.folder / folder) + b"/" + name))
        with suppress(OSError):  # the folder may be away
            path.write_bytes(contents)
        return path

    def latin_name(self) -> None:
        self.hostile_file(b" pr\xe9sse.csv", b"t [s],x [m]\n0,1\nnot a number")
        good = "t [s],p_A [Pa]\n" + "".join(f"{k / 50},{k}\n" for k in range(4000))
        self.hostile_file(b" sch\xf6n.csv", good.encode(), "bait")

    def damaged_file(self) -> None:
        suffix = self.chance.choice([b".csv", b".parquet", b".mat", b".h5", b".mf4", b".tdms", b".zip", b".xlsx"])
        self.hostile_file(suffix, self.chance.randbytes(3000))

    def corner_workbook(self) -> None:
        path = self.hostile_file(b".xlsx", b"", "bait")
        workbook(path, [rows([("A1", 1), ("XFD1048576", 1)])])

    def bomb(self) -> None:
        self.hostile_file(b".csv.gz", BOMB, "bait")

    def foreign_link(self) -> None:
        path = self.hostile_file(b" link.csv", b"")
        with suppress(OSError):
            path.unlink()
            path.symlink_to("/etc/passwd")

    def future_file(self) -> None:
        path = self.hostile_file(b" of the future.csv", b"t [s],x [m]\n0,1\n")
        with suppress(OSError):
            os.utime(path, (4e9, 4e9))

    def removed_folder(self) -> None:
        k = self.chance.randrange(0, len(self.monitor.names), FILES)
        folder = self.monitor.folder / f"files {k}"
        away = folder.with_suffix(".away")
        folder.rename(away)
        time.sleep(2.0)
        away.rename(folder)

    def hook_misbehaves(self) -> None:
        self.monitor.hook.manner = self.chance.choice(["no HTTP", "a drip", "silence", "an error", "well"])

    def silent_connections(self) -> None:
        """Hold 600 connections for a while; the metrics must be there all the same."""
        lines = []
        with suppress(OSError):
            for _ in range(600):
                line = socket.create_connection(("127.0.0.1", self.monitor.page), timeout=2.0)
                line.sendall(self.chance.choice([b"", b"GET /metrics HTTP/1.1\r\nHost: ", b"POST /login HTTP/1.1\r\n"]))
                lines.append(line)
        self._held.append((time.monotonic() + 15.0, lines))
        if lines and self.monitor.process.poll() is None:
            try:
                self.monitor.ask("/api/fleet", timeout=15.0)
            except RuntimeError as error:
                self.deaf.append(f"{len(lines)} silent connections: {error!r}")

    def many_listeners(self) -> None:
        lines = []
        head = f"GET /api/changes HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\n\r\n".encode()
        with suppress(OSError):
            for _ in range(230):
                line = socket.create_connection(("127.0.0.1", self.monitor.page), timeout=2.0)
                line.sendall(head)
                lines.append(line)
        self._held.append((time.monotonic() + 3.0, lines))

    def odd_requests(self) -> None:
        name = quote(self.chance.choice(self.monitor.names), safe="")
        for path, header in (
            (f"/api/actuator?name={name}&hours=%C2%B2", TOKEN),
            (f"/api/actuator?name={name}%00..%2F&hours=9e999", TOKEN),
            ("/api/fleet", f"guess {self.chance.random()}"),
        ):
            request = urllib.request.Request(f"http://127.0.0.1:{self.monitor.page}{path}")
            request.add_header("Authorization", f"Bearer {header}")
            try:
                with urllib.request.urlopen(request, timeout=10.0) as answer:
                    answer.read()
            except urllib.error.HTTPError as error:
                if error.code == 500:
                    self.deaf.append(f"{path}: 500")
            except OSError:
                pass  # it is being killed, or its connections are held

    def killed(self) -> None:
        self.monitor.end(signal.SIGKILL)
        self.monitor.start(self.chance.choice(["file", "file", "full", "closed"]))

    def ended(self) -> None:
        self.slowest_end = max(self.slowest_end, self.monitor.end())
        self.monitor.start(self.chance.choice(["file", "file", "full", "closed"]))

    def broker_restarts(self) -> None:
        self.monitor.broker.stop()
        time.sleep(self.chance.uniform(0.0, 3.0))
        self.monitor.broker.start()


#: Those that cost the monitor a start are played more seldom.
ATTACKS: tuple[tuple[str, Callable[[Attacks], None]], ...] = (
    *(3 * (("deep JSON", Attacks.deep_json), ("odd message", Attacks.odd_message))),
    *(3 * (("hostile CBOR", Attacks.hostile_cbor), ("a key twice", Attacks.twice_the_key))),
    *(3 * (("NDEATH with an array", Attacks.death_with_an_array), ("webhook misbehaves", Attacks.hook_misbehaves))),
    *(3 * (("Latin-1 name", Attacks.latin_name), ("damaged file", Attacks.damaged_file))),
    *(3 * (("foreign link", Attacks.foreign_link), ("file of the future", Attacks.future_file))),
    *(3 * (("odd requests", Attacks.odd_requests), ("removed folder", Attacks.removed_folder))),
    *(2 * (("230 listeners", Attacks.many_listeners), ("600 silent connections", Attacks.silent_connections))),
    ("forwarded guesses", Attacks.forwarded_guesses),
    ("corner workbook", Attacks.corner_workbook),
    ("bomb", Attacks.bomb),
    ("killed", Attacks.killed),
    ("ended, output full or closed", Attacks.ended),
    ("broker restarts", Attacks.broker_restarts),
)
#: 1 GB of zeros in 1 MB.
BOMB = gzip.compress(bytes(4_000_000), 9) * 250


def _closed(lines: list[socket.socket]) -> bool:
    for line in lines:
        line.close()
    return False


def _send_round(monitor: Monitor, recordings: list[Recording], number: int) -> None:
    """Send the blocks of a round: at once what comes as files, over the round what comes by MQTT."""
    began = time.monotonic()
    for k in range(0, len(recordings), FILES):
        part = recordings[k].between(number * ROUND_S, (number + 1) * ROUND_S)
        last = 1.7e9 + float(part.t[-1])
        name = f"{number:04d}.csv"
        staged = monitor.folder / f"{name}.{k}"
        write(part, staged.with_suffix(".csv"))
        os.utime(staged.with_suffix(".csv"), (last, last))
        while True:
            with suppress(OSError):  # the folder may be away
                staged.with_suffix(".csv").rename(monitor.folder / f"files {k}" / name)
                break
            time.sleep(0.2)
    for turn in range(round(ROUND_S / BLOCK_S)):
        for k, recording in enumerate(recordings):
            if k % FILES:
                start = round((number * ROUND_S + turn * BLOCK_S) * RATE)
                block = message(monitor.names[k], recording.samples(slice(start, start + round(BLOCK_S * RATE))))
                monitor.client.publish(f"plant/{k}", json.dumps(block), qos=1)
        time.sleep(max(0.0, began + (turn + 1) * BLOCK_S - time.monotonic()))


def _shown(values: Any) -> str:
    """Return values as text, numbers to nine digits."""
    return re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]):.9g}", str(values))


def _all_stored(monitors: list[Monitor], wanted: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while any(monitor.stored() < wanted for monitor in monitors):
        if time.monotonic() > deadline:
            raise RuntimeError(f"{[monitor.stored() for monitor in monitors]} of {wanted} blocks are stored")
        time.sleep(0.5)


def _marked(monitors: list[Monitor], chance: random.Random) -> int:
    """Mark open alarms, of all monitors alike; return how many marks there were."""
    lasting = "state not in ('closed', 'invalid')"
    opened = monitors[0].rows(f"select actuator, state, alarm from alarms where {lasting} order by id")
    marks = 0
    for actuator, state, _ in chance.sample(opened, min(4, len(opened))):
        choices = ["comment", "comment", "shelved", "invalid", "repaired"]
        mark = chance.choice([*choices, *(3 * ["acknowledged"] if state == "new" else [])])
        said = {"mark": mark, "by": "Ada", "text": f"mark {marks}"}
        answers = [monitor.ask(f"/api/mark?name={quote(actuator, safe='')}", said) for monitor in monitors]
        if len({_shown(answer) for answer in answers}) > 1:
            raise RuntimeError(f"{mark} of {actuator}: {answers}")
        marks += "status" not in answers[0]
    return marks


def _passed_on(monitor: Monitor, seconds: float = 400.0) -> None:
    """Wait until every event has arrived at the webhook and in the lines."""
    deadline = time.monotonic() + seconds
    last = monitor.rows("select coalesce(max(number), 0) from events")[0][0]
    while time.monotonic() < deadline:
        passed = monitor.rows("select value from facts where name in ('lines', 'webhook', 'mqtt')")
        if not last or (len(passed) == 3 and all(int(row[0]) >= last for row in passed)):
            return
        time.sleep(0.5)


def played(minutes: float, actuators: int, seed: int) -> dict[str, Any]:
    """Attack a monitor for so many minutes, and return what differs from an undisturbed one."""
    rounds = max(1, round(minutes * 60.0 / ROUND_S))
    names, recordings = plant(actuators, rounds * ROUND_S + 1.0, seed)
    folder = Path(tempfile.mkdtemp(prefix="sealscope-hostility-"))
    calm, attacked = (Monitor(folder / name, names) for name in ("calm", "attacked"))
    attacks, chance, marks, began = Attacks(attacked, seed), random.Random(seed), 0, time.monotonic()
    by_files = len(range(0, actuators, FILES))
    each = by_files + (actuators - by_files) * round(ROUND_S / BLOCK_S)
    try:
        for monitor in (calm, attacked):
            monitor.ask("/api/fleet")
        for number in range(rounds):
            if time.monotonic() - began > 60.0 * minutes:  # a busy machine takes longer for a round
                break
            sending = [
                threading.Thread(target=_send_round, args=(monitor, recordings, number)) for monitor in (calm, attacked)
            ]
            for thread in sending:
                thread.start()
            while any(thread.is_alive() for thread in sending):
                attacks.play()
                time.sleep(attacks.chance.uniform(0.2, 2.5))
            attacks.calm_down()
            _all_stored([calm, attacked], (number + 1) * each)
            marks += _marked([calm, attacked], chance)
            counts, differ, digits = _differing(calm, attacked)
            say = f"round {number + 1}: {counts}, {marks} marks, {attacks.counts.total()} attacks"
            print(
                f"{say}, lost or doubled: {sum(differ.values())}, other last digits: {sum(digits.values())}", flush=True
            )
        attacked.end()
        attacked.start()
        attacks.calm_down()
        for monitor in (calm, attacked):
            _passed_on(monitor)
        result = _compared(calm, attacked, attacks)
        ends = [calm.end(), attacked.end()]
        elapsed = time.monotonic() - began
        own = resource.getrusage(resource.RUSAGE_SELF)
        result |= {
            "minutes": round(elapsed / 60.0, 1),
            "actuators": actuators,
            "marks": marks,
            "starts": attacked.starts,
            "slowest_end_s": round(max(*ends, attacks.slowest_end), 2),
            "cores": {
                "calm": round(calm.busy_s / elapsed, 3),
                "attacked": round(attacked.busy_s / elapsed, 3),
                "harness": round((own.ru_utime + own.ru_stime) / elapsed, 3),
            },
            "largest_mb": {"calm": calm.largest // 1024, "attacked": attacked.largest // 1024},
            "log_kb": {each.folder.name: round(each.log.stat().st_size / 1e3, 1) for each in (calm, attacked)},
            "attacks": dict(attacks.counts),
        }
        shutil.copy(attacked.log, Path(tempfile.gettempdir()) / "sealscope-hostility.log")
        return result
    finally:
        for monitor in (calm, attacked):
            if monitor.process.poll() is None:
                monitor.process.kill()
            monitor.client.loop_stop()
            monitor.broker.stop()
        shutil.rmtree(folder, ignore_errors=True)


def _differing(calm: Monitor, attacked: Monitor) -> tuple[dict[str, int], dict[str, int], dict[str, int]]:
    """Return the rows of each table, how many are lost or too many, and in how many the last digits differ."""
    columns = "actuator, t, kind, alarm_id, by_whom, text, alarm"
    queries = {
        "estimates": "select * from estimates where actuator not like '%bait'",
        "alarms": "select * from alarms where actuator not like '%bait'",
        "events": f"select {columns} from events where actuator not like '%bait'",
    }
    ours = {"blocks": attacked.blocks(), **{name: attacked.rows(query) for name, query in queries.items()}}
    theirs = {"blocks": calm.blocks(), **{name: calm.rows(query) for name, query in queries.items()}}
    differ: dict[str, int] = {}
    digits: dict[str, int] = {}
    for name, expected in theirs.items():
        lost, doubled = Counter(map(_shown, expected)), Counter(map(_shown, ours[name]))
        differ[f"{name} lost"] = sum((lost - doubled).values())
        differ[f"{name} too many"] = sum((doubled - lost).values())
        exact = Counter(map(str, expected)) - Counter(map(str, ours[name]))
        digits[name] = exact.total() - differ[f"{name} lost"]
    return {name: len(each) for name, each in theirs.items()}, differ, digits


def _compared(calm: Monitor, attacked: Monitor, attacks: Attacks) -> dict[str, Any]:
    """Return what was compared, and what is missing or too much."""
    counts, differ, digits = _differing(calm, attacked)
    numbers = {row[0] for row in attacked.rows("select number from events")}
    lines, posted = attacked.lines_out(), attacked.hook.numbers
    calm_lines, calm_posted = {*calm.lines_out()}, {*calm.hook.numbers}
    return {
        "rows": counts,
        "differ": differ,
        "last_digits_differ": digits,
        "events_not_out": {
            "lines": len(calm_lines) - len({*lines} & numbers),
            "webhook": len(calm_posted) - len({*posted} & numbers),
        },
        "events_out_again": {"lines": lines.total() - len(lines), "webhook": posted.total() - len(posted)},
        "refused": attacked.rows("select count(*) from refused")[0][0],
        "page_troubles": attacks.deaf,
    }


def main() -> None:
    """Play, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--actuators", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path)
    chosen = parser.parse_args()
    result = json.dumps(played(chosen.minutes, chosen.actuators, chosen.seed), indent=1)
    print(result)
    if chosen.output is not None:
        chosen.output.write_text(result + "\n")


if __name__ == "__main__":
    main()
