"""One test for each way in which a part of the monitor was ended or held up from outside."""

from __future__ import annotations

import gzip
import io
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import cbor2
import numpy as np
import pytest

from sealscope.cli.app import normalise_arguments
from sealscope.monitor.outputs.events import Webhook
from sealscope.monitor.service import Service
from sealscope.monitor.settings import ActuatorSettings, MonitorSettings
from sealscope.monitor.sources.source_block import (
    REASONS,
    STALE_DEATH,
    UNREADABLE_FILE,
    RefusedMessage,
    SourceBlock,
    decode_message,
)
from sealscope.monitor.sources.sparkplug_host import SparkplugHost
from sealscope.monitor.sparkplug import BIRTH_SEQUENCE, INT64, SparkplugMetric, SparkplugPayload, encode_payload
from sealscope.monitor.supervisor import PartAway
from sealscope.recordings import write

from ..recordings.test_packed_files import rows, workbook
from ..refusals import refusal
from .plant import CHANNELS, Running, by_broker, served, settings_in, until
from .servers import MOSQUITTO, Broker
from .test_broker import send
from .test_outputs import LINES, WORN

HEALTHY = WORN.between(0.0, 62.0)


def nested(key: str, depth: int) -> bytes:
    """A message of JSON one of whose values is so deep."""
    return f'{{"{key}": '.encode() + b"[" * depth + b"1" + b"]" * depth + b"}"


@pytest.mark.parametrize("key", ["actuator", "t", "rate", "x", "units", "id", "T_oil", "no such"])
def test_a_deep_message_is_refused_whatever_its_depth(key):
    for depth in (100, 500, 990, 1000, 1020, 2000):
        with pytest.raises(RefusedMessage) as raised:
            decode_message(nested(key, depth))
        assert raised.value.reason in REASONS
        deep: object = 1
        for _ in range(min(depth, 300)):
            deep = [deep]
        with pytest.raises(RefusedMessage):
            decode_message(cbor2.dumps({key: deep, "rate": 50, "t": 0.0}))


def test_a_death_whose_number_is_an_array_is_stale():
    host = SparkplugHost([ActuatorSettings(name="a", sparkplug="g/n", rate=50.0)], lambda *_: None, lambda _: None)
    birth = SparkplugPayload(1, (SparkplugMetric(BIRTH_SEQUENCE, 3, INT64),), 0)
    assert host.receive("spBv1.0/g/NBIRTH/n", encode_payload(birth)) is None
    for value in (np.arange(3.0), np.empty(0), np.array([3.0])):
        death = SparkplugPayload(1, (SparkplugMetric(BIRTH_SEQUENCE, value, 31),), None)
        with pytest.raises(RefusedMessage) as raised:
            host.receive("spBv1.0/g/NDEATH/n", encode_payload(death))
        assert raised.value.reason == STALE_DEATH
    assert host.receive("spBv1.0/g/NDEATH/n", encode_payload(birth)) is None


@pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")
def test_a_message_that_cannot_be_decoded_is_acknowledged_and_kept(tmp_path: Path):
    """By a real broker: what comes after it is stored, and after a restart it does not come again."""
    broker = Broker(tmp_path)
    settings = by_broker(tmp_path, broker.port)
    broker.open_session("sealscope-monitor", ("plant/press 1", "plant/press 2"))
    try:
        valid = LINES.splitlines()[:6]
        from paho.mqtt import publish
        from paho.mqtt.enums import MQTTProtocolVersion

        for message in (nested("actuator", 1000), nested("units", 1000), b"\xc1" * 20):
            publish.single(
                "plant/press 1",
                message,
                qos=1,
                hostname="127.0.0.1",
                port=broker.port,
                protocol=MQTTProtocolVersion.MQTTv5,
            )
        send(broker.port, valid)
        first = Running(settings)
        try:
            first.until(len(valid))
            until(lambda: len(first.service.store.refused()) == 3)  # they are stored after the blocks
            assert first.service.store.refused()[-1]["beginning"] == nested("actuator", 1000)[:4000]
        finally:
            first.end()
        again = Running(settings)
        until(lambda: again.service.supervisor.outage_totals().get("broker", (False,))[0])
        time.sleep(0.5)
        again.end()
        assert again.service.actuators.counters == {}
        assert len(again.service.store.refused()) == 3
    finally:
        broker.stop()


def folder_settings(folder: Path, *names: str) -> str:
    for name in names:
        (folder / name).mkdir()
    return "".join(f'[[actuator]]\nname = "{name}"\nfolder = "{name}"\n' for name in names)


def blocks_of(service: Service) -> list[tuple[str, str]]:
    from sqlalchemy import text

    with service.store.engine.connect() as connection:
        return [tuple(row) for row in connection.execute(text("select actuator, identity from blocks order by number"))]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux")
def test_names_are_bytes(tmp_path: Path):
    settings = settings_in(tmp_path, folder_settings(tmp_path, "press 3", "press 4"))
    for folder in ("press 3", "press 4"):
        write(HEALTHY.only(CHANNELS), tmp_path / folder / "a.csv")
    os.rename(tmp_path / "press 3" / "a.csv", os.fsencode(tmp_path / "press 3") + b"/pr\xe9sse.csv")  # noqa: PTH104
    for _ in range(2):  # the second time after a restart
        service, _ = served(settings)
        stored = blocks_of(service)
        assert [actuator for actuator, _ in stored] == ["press 3", "press 4"]
        assert stored[0][1].startswith("pr\\udce9sse.csv ")
        assert service.supervisor.outages() == []


def test_a_file_that_cannot_be_read_is_named_once_and_not_read_again(tmp_path: Path, monkeypatch, caplog):
    reads: list[str] = []

    def read(path: Path, *_: object) -> object:
        reads.append(path.name)
        if path.name.startswith("b"):
            raise {"b1.csv": MemoryError(), "b2.csv": RuntimeError("the reader crashed")}[path.name]
        return HEALTHY

    monkeypatch.setattr("sealscope.monitor.sources.folder.read_by_map", read)
    settings = settings_in(tmp_path, folder_settings(tmp_path, "press 3"))
    for name in ("b1.csv", "b2.csv", "c.csv"):
        (tmp_path / "press 3" / name).write_text(name)
        os.utime(tmp_path / "press 3" / name, (1.7e9, 1.7e9))
    service, _ = served(settings)
    assert reads == ["b1.csv", "b2.csv", "c.csv"]
    assert service.actuators.counters == {UNREADABLE_FILE: 2}
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 2
    assert [row["reason"] for row in service.store.refused()] == [UNREADABLE_FILE] * 2
    again, _ = served(settings)
    assert len(reads) == 3 and again.actuators.counters == {}
    assert len(blocks_of(again)) == 3


def watched_folder(folder: Path, settle_s: float = 0.0) -> Callable[[], list[SourceBlock | RefusedMessage]]:
    from sealscope.monitor.sources.folder import WatchedFolder

    watched = WatchedFolder(ActuatorSettings(name="press 3", folder=folder), settle_s, lambda *_: False)
    return lambda: list(watched.blocks())


def test_a_file_that_fails_is_read_twice_at_most(tmp_path: Path, monkeypatch):
    reads: list[Path] = []

    def read(path: Path, *_: object) -> object:
        reads.append(path)
        raise MemoryError

    monkeypatch.setattr("sealscope.monitor.sources.folder.read_by_map", read)
    (tmp_path / "a.csv").write_text("a")
    blocks = watched_folder(tmp_path, 0.05)
    handed: list[SourceBlock | RefusedMessage] = []
    until(lambda: handed.extend(blocks()) or handed)
    refused, empty = handed
    assert isinstance(refused, RefusedMessage)
    assert isinstance(empty, SourceBlock) and empty.samples is None
    assert len(reads) == 2


def test_a_file_of_the_future_is_read_and_named(tmp_path: Path, caplog):
    write(HEALTHY.only(CHANNELS), tmp_path / "a.csv")
    os.utime(tmp_path / "a.csv", (4e9, 4e9))
    blocks = watched_folder(tmp_path, 0.05)
    assert blocks() == []
    time.sleep(0.06)
    (block,) = blocks()
    assert isinstance(block, SourceBlock) and block.samples is not None
    assert float(block.samples.t[-1]) == pytest.approx(4e9)
    assert "a.csv is dated in the future" in caplog.text
    assert blocks() == []


def test_a_link_to_a_foreign_file_is_not_followed(tmp_path: Path, caplog):
    secret = tmp_path / "secret"
    secret.write_text("root:x:0:0:the contents\n")
    folder = tmp_path / "watched"
    folder.mkdir()
    (folder / "link.csv").symlink_to(secret)
    (folder / "circle.csv").symlink_to(folder / "circle.csv")
    write(HEALTHY.only(CHANNELS), folder / "a.csv")
    (folder / "within.csv").symlink_to(folder / "a.csv")
    blocks = watched_folder(folder)
    assert len([block for block in blocks() if isinstance(block, SourceBlock) and block.samples is not None]) == 2
    assert blocks() == []
    assert caplog.text.count("link.csv is a link out of the folder") == 1
    assert "contents" not in caplog.text


@pytest.mark.slow
def test_a_removed_folder_is_one_outage_and_the_others_go_on(tmp_path: Path, monkeypatch, caplog):
    monkeypatch.setattr("sealscope.monitor.sources.folder._LOOK_S", 0.05)
    settings = settings_in(tmp_path, folder_settings(tmp_path, "press 3", "press 4"))
    settings = settings.model_copy(update={"lines": False})
    (tmp_path / "press 3").rmdir()
    write(HEALTHY.only(CHANNELS), tmp_path / "press 4" / "a.csv")
    running = Running(settings)
    try:
        until(lambda: len(blocks_of(running.service)) == 1)
        time.sleep(0.2)
        (outage,) = running.service.supervisor.outages()
        assert outage["part"] == "folder of press 3"
        assert len([record for record in caplog.records if "press 3" in record.getMessage()]) == 1
        (tmp_path / "press 3").mkdir()
        write(HEALTHY.only(CHANNELS), tmp_path / "press 3" / "a.csv")
        until(lambda: len(blocks_of(running.service)) == 2 and not running.service.supervisor.outages())
    finally:
        running.end()


class OddServer:
    """A web server that answers each exchange with given bytes, one after the other with pauses."""

    def __init__(self, *answers: tuple[bytes, float]) -> None:
        self.answers, self.got = list(answers), 0
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}/"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            line, _ = self._socket.accept()
            with suppress(OSError), line:
                got = b""
                while b"}}" not in got:
                    got += line.recv(65536)
                self.got += 1
                answer, pause = self.answers.pop(0) if self.answers else (b"HTTP/1.1 204 Done\r\n\r\n", 0.0)
                for letter in [answer] if not pause else [bytes([byte]) for byte in answer]:
                    line.sendall(letter)
                    time.sleep(pause)


DRIP = (b"HTTP/1.1 200 OK\r\n" + b"X-Wait: yes\r\n" * 50, 0.1)


@pytest.fixture
def watched(taken: MonitorSettings) -> Iterator[Service]:
    """A monitor that has raised an alarm."""
    service, _ = served(taken)
    yield service
    service.store.engine.dispose()


@pytest.mark.parametrize(
    "answer",
    [
        b"SSH-2.0-x\r\n",
        *(
            pytest.param(answer, marks=[pytest.mark.slow, pytest.mark.long])
            for answer in (b"", b"\xff\x00" * 9, b"HTTP/1.1 2x4 ?\r\n\r\n")
        ),
        pytest.param(b"HTTP/1.1 200\r\n" * 500, marks=pytest.mark.slow),
    ],
)
def test_a_webhook_that_speaks_no_http_is_an_outage_and_asked_again(watched: Service, answer):
    server = OddServer((answer, 0.0))
    part = watched.supervisor.part("webhook")
    hook = Webhook(watched.store, server.url, timeout=2.0)
    assert not part.attempt(hook.deliver)
    assert [outage["part"] for outage in watched.supervisor.outages()] == ["webhook"]
    assert part.attempt(hook.deliver, at_once=True)
    assert watched.supervisor.outages() == []
    assert watched.store.position("webhook") == watched.store.events_since(0)[-1][0]
    assert server.got == 2


@pytest.mark.slow
def test_a_webhook_that_drips_has_one_deadline(watched: Service):
    server = OddServer(DRIP)
    with refusal("0.4 s", error=PartAway):
        Webhook(watched.store, server.url, timeout=0.4).deliver()
    assert watched.store.position("webhook") == 0


@pytest.mark.slow
def test_the_monitor_ends_in_its_time_whatever_the_webhook_does(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("sealscope.monitor.service._END_S", 0.3)
    server = OddServer(*[DRIP] * 20)
    settings = settings_in(tmp_path, f'[webhook]\nurl = "{server.url}"\ntimeout_s = 60\n')
    service = Service(settings, stdin=io.BytesIO(LINES), stdout=io.StringIO(), sources=[lambda of: of.stopping.wait()])
    thread = threading.Thread(target=service.run)
    thread.start()
    until(lambda: server.got)
    service.stop()
    thread.join(30.0)  # the webhook has 60 s
    assert not thread.is_alive()


def opened(kind: str) -> io.TextIOWrapper:
    """A standard output that takes nothing."""
    if kind == "full":
        return Path("/dev/full").open("w")
    read, written = os.pipe()
    os.close(read)
    return os.fdopen(written, "w")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("kind", ["full", pytest.param("closed", marks=[pytest.mark.slow, pytest.mark.long])])
def test_a_standard_output_that_takes_nothing_ends_nothing(tmp_path: Path, kind, caplog):
    settings = settings_in(tmp_path)
    with suppress(OSError), opened(kind) as out:
        service = Service(settings, once=True, stdin=io.BytesIO(LINES), stdout=out)
        service.run()
        assert [outage["part"] for outage in service.supervisor.outages()] == ["standard output"]
        assert "the standard output is not reached" in caplog.text
        assert service.store.position("lines") == 0
        kept = [number for number, _ in service.store.events_since(0)]
    _, text = served(settings)
    assert [json.loads(line)["number"] for line in text.splitlines()] == kept


def test_a_line_that_was_written_in_part_is_finished(watched: Service, tmp_path: Path, monkeypatch):
    """The disk has room for a part of the lines, for none, and then for all."""
    from sealscope.monitor.outputs.events import EventLines
    from sealscope.monitor.supervisor import PartAway

    watched.store.write_position("lines", 0)
    write_, room = os.write, [20, 0, 0, 10**6]

    def narrow(file: int, data: bytes) -> int:
        if not (most := room.pop(0)):
            raise OSError(28, "No space left on device")
        return write_(file, data[:most])

    monkeypatch.setattr("sealscope.monitor.outputs.events.os.write", narrow)
    with (tmp_path / "lines").open("w") as stream:
        lines = EventLines(watched.store, stream)
        for _ in range(2):
            with pytest.raises(PartAway, match="No space left"):
                lines.deliver()
        lines.deliver()
    written = (tmp_path / "lines").read_text().splitlines()
    assert [json.loads(line) for line in written] == [event for _, event in watched.store.events_since(0)]


@pytest.mark.parametrize("kind", ["memory", "file"])
def test_a_line_is_not_repeated_when_its_position_is_not_stored(kind, watched: Service, tmp_path: Path, monkeypatch):
    from sealscope.monitor.outputs.events import EventLines

    watched.store.write_position("lines", 0)
    write_position, outages = watched.store.write_position, [OSError("the database is away")]

    def fail_once(output: str, number: int) -> None:
        if outages:
            raise outages.pop()
        write_position(output, number)

    monkeypatch.setattr(watched.store, "write_position", fail_once)
    with io.StringIO() if kind == "memory" else (tmp_path / "lines").open("w+") as stream:
        lines = EventLines(watched.store, stream)
        with pytest.raises(OSError, match="the database is away"):
            lines.deliver()
        lines.deliver()
        stream.seek(0)
        assert [json.loads(line) for line in stream] == [event for _, event in watched.store.events_since(0)]


@pytest.mark.parametrize(
    "words",
    ["-v monitor m.toml", "monitor -v m.toml", "monitor m.toml -v", "monitor run m.toml -v", "-v monitor run m.toml"],
)
def test_the_flag_v_may_stand_anywhere_in_a_call_of_the_monitor(words):
    assert normalise_arguments(words.split()) == ["-v", "monitor", "run", "m.toml"]


@pytest.mark.slow
def test_v_before_the_monitor_is_understood(tmp_path: Path):
    (tmp_path / "m.toml").write_text('[[actuator]]\nname = "press 1"\n')
    call = [sys.executable, "-m", "sealscope", "-v", "monitor", "m.toml", "--once"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, timeout=120.0, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")
def test_everything_at_once_changes_no_block_mark_or_alarm(tmp_path: Path):
    """Five minutes of what `benchmarks/monitor_hostility.py` plays for an hour."""
    script = Path(__file__).parents[2] / "benchmarks" / "monitor_hostility.py"
    call = [sys.executable, str(script), "--minutes", "5", "--actuators", "20", "-o", str(tmp_path / "result.json")]
    subprocess.run(call, check=True, timeout=1500.0)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["rows"]["events"] > result["marks"] > 0
    assert not any(result["differ"].values()), result["differ"]
    assert result["events_not_out"] == {"lines": 0, "webhook": 0}
    assert result["page_troubles"] == []
    assert result["slowest_end_s"] < 5.0


@pytest.mark.parametrize(
    "packet",
    [
        b"\x32\x05\x00\xffab\x00",  # a message whose topic is longer than it
        pytest.param(b"\x30\x04\x00\x01\xff\x00", marks=pytest.mark.slow),  # a topic that is no UTF-8
        pytest.param(b"\x20\x02\x00", marks=pytest.mark.slow),  # the connection is confirmed again, in part
        pytest.param(b"\x90\x01\x00", marks=pytest.mark.slow),  # a subscription is confirmed without its number
        pytest.param(
            b"\x30\x09\x00\x01a\x05\x26\x00\x01\xff\x00\x00", marks=pytest.mark.slow
        ),  # properties that are no UTF-8
        pytest.param(b"\xf0\xff\xff\xff\xff\xff", marks=pytest.mark.slow),  # a length without end
    ],
)
def test_a_broker_that_speaks_no_mqtt_is_tried_again(tmp_path: Path, monkeypatch, packet):
    monkeypatch.setattr("sealscope.monitor.supervisor.FIRST_PAUSE_S", 0.05)
    connections: list[bytes] = []
    server = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        while True:
            line, _ = server.accept()
            with suppress(OSError), line:
                connections.append(line.recv(65536))
                line.sendall(b"\x20\x03\x00\x00\x00" + packet)
                line.settimeout(1.0)
                while line.recv(65536):
                    pass

    threading.Thread(target=answer, daemon=True).start()
    running = Running(by_broker(tmp_path, server.getsockname()[1]))
    try:
        until(lambda: len(connections) >= 2, 20.0)
        assert running.thread.is_alive()
        assert (
            running.service.supervisor.outage_totals()["broker"][1]
            + running.service.supervisor.outage_totals()["MQTT client"][1]
            > 0
        )
    finally:
        running.end()


@pytest.mark.slow
def test_a_workbook_and_a_bomb_that_end_their_reader_are_named_once(tmp_path: Path, monkeypatch, caplog):
    """With the readers that there are; after a restart nothing is read."""
    settings, folder = settings_in(tmp_path, folder_settings(tmp_path, "press 3", "press 4")), tmp_path / "press 3"
    workbook(folder / "corner.xlsx", [rows([("A1", 1), ("XFD1048576", 2)])])
    (folder / "bomb.csv.gz").write_bytes(gzip.compress(bytes(4_000_000), 9) * 250)
    for where in (folder, tmp_path / "press 4"):
        write(HEALTHY.only(CHANNELS), where / "healthy.csv")
    service, _ = served(settings)
    assert service.actuators.counters == {UNREADABLE_FILE: 2}
    assert len(blocks_of(service)) == 4
    for name in ("corner.xlsx", "bomb.csv.gz"):
        assert len([record for record in caplog.records if name in record.getMessage()]) == 1

    def read(*_: object, **__: object) -> None:
        raise AssertionError("it is read again")

    monkeypatch.setattr("sealscope.monitor.sources.folder.read_by_map", read)
    again, _ = served(settings)
    assert again.actuators.counters == {} and len(blocks_of(again)) == 4
