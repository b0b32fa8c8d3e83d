"""Blocks by a real broker: what comes while the monitor is away is stored once, alarms are retained."""

from __future__ import annotations

import json
import random
import sqlite3
import time
from collections import Counter
from pathlib import Path

import pytest
from paho.mqtt import publish, subscribe
from paho.mqtt.enums import MQTTProtocolVersion
from starlette.testclient import TestClient

from sealscope.monitor.page.site import site
from sealscope.monitor.settings import MonitorSettings, PageSettings
from sealscope.monitor.sources.source_block import WRONG_ACTUATOR

from .plant import LINES, Running, by_broker, rows_of, until
from .servers import MOSQUITTO, Broker
from .test_hostile_service import BRIEF, FORGED, UNKNOWN

pytestmark = [pytest.mark.slow, pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")]


@pytest.fixture
def settings(broker: Broker, tmp_path: Path) -> MonitorSettings:
    return by_broker(tmp_path, broker.port)


def kept(broker: Broker) -> None:
    """Let the broker keep what comes for the monitor from now on."""
    broker.open_session("sealscope-monitor", ("plant/press 1", "plant/press 2"))


def send(port: int, lines: list[bytes]) -> None:
    messages = [
        {"topic": f"plant/{json.loads(line)['actuator']}", "payload": line, "qos": 1, "retain": False} for line in lines
    ]
    publish.multiple(messages, hostname="127.0.0.1", port=port, protocol=MQTTProtocolVersion.MQTTv5)


def test_what_comes_while_the_monitor_is_away_is_stored_once(undisturbed, broker: Broker, settings: MonitorSettings):
    lines = LINES.splitlines()
    third = len(lines) // 3
    kept(broker)
    first = Running(settings)
    send(broker.port, [b"not a block for press 1".join([b'{"actuator": "press 1", "x": "', b'"}'])])
    send(broker.port, lines[:third])
    first.until(third)
    first.end()
    send(broker.port, lines[third - 5 : 2 * third])  # five once more
    second = Running(settings)
    second.until(2 * third)
    send(broker.port, lines[2 * third :])
    second.until(len(lines))
    until(lambda: second.service.store.position("mqtt") > 0)
    second.end()
    assert rows_of(settings.database) == undisturbed
    retained = subscribe.simple("sealscope/press 1/alarm", hostname="127.0.0.1", port=broker.port)
    alarm = json.loads(retained.payload)
    assert (alarm["id"], alarm["state"]) == ("press 1-1", "new")
    for name, summary in second.service.summaries().items():
        message = subscribe.simple(f"sealscope/{name}/state", hostname="127.0.0.1", port=broker.port)
        assert json.loads(message.payload) == summary["state"]
    assert alarm["machine_state"] == second.service.summaries()["press 1"]["state"]


def test_a_broker_that_restarts_loses_nothing(undisturbed, broker: Broker, settings: MonitorSettings):
    lines = LINES.splitlines()
    kept(broker)
    running = Running(settings)
    for start in range(0, len(lines), 30):
        send(broker.port, lines[start : start + 30])
        if start == 0:
            running.until(30)  # it is connected
        broker.stop()
        time.sleep(0.2)
        broker.start()
    running.until(len(lines))
    running.end()
    assert rows_of(running.service.settings.database) == undisturbed
    assert set(running.service.actuators.counters) <= {"blocks stored already"}
    reached, number, seconds = running.service.supervisor.outage_totals()["broker"]
    assert reached
    assert 1 <= number <= len(range(0, len(lines), 30))  # fewer, where it was back before it was tried again
    assert seconds > 0.2 * number


def test_a_broker_that_is_away_stands_on_page_and_metrics(broker: Broker, settings: MonitorSettings, caplog):
    kept(broker)
    running = Running(settings)
    page = TestClient(site(running.service.actuators, PageSettings(), None), base_url="http://localhost")
    try:
        send(broker.port, LINES.splitlines()[:1])
        running.until(1)  # it is connected
        assert page.get("/api/fleet").json()["outages"] == []
        assert 'sealscope_reached{part="broker"} 1.0' in page.get("/metrics").text
        broker.stop()
        until(running.service.supervisor.outages)
        (outage,) = page.get("/api/fleet").json()["outages"]
        assert (outage["part"], outage["reason"][:27]) == ("broker", "the connection to 127.0.0.1")
        assert 'sealscope_reached{part="broker"} 0.0' in page.get("/metrics").text
        broker.start()
        until(lambda: not page.get("/api/fleet").json()["outages"])
        assert 'sealscope_outages_total{part="broker"} 1.0' in page.get("/metrics").text
    finally:
        running.end()
    assert "the broker is reached again after" in caplog.text


def test_while_the_database_is_away_the_connection_stays_and_the_broker_keeps_the_rest(
    undisturbed, broker: Broker, settings: MonitorSettings, monkeypatch
):
    """A locked database stops the storing for longer than the broker would wait for a client that is silent."""
    monkeypatch.setattr("sealscope.monitor.mqtt_client.KEEP_ALIVE_S", 2)
    monkeypatch.setattr("sealscope.monitor.service._QUEUE_BLOCKS", 8)
    lines = LINES.splitlines()
    kept(broker)
    running = Running(settings)
    lock = sqlite3.connect(settings.database, isolation_level=None)
    lock.execute("begin immediate")
    counters = running.service.actuators
    dropped, refused = "messages of QoS 0 that found no room", "messages that are no JSON or CBOR"
    try:
        send(broker.port, lines)  # more than the queue and those in flight
        until(running.service.supervisor.outages)
        flood = [{"topic": "plant/press 1", "payload": b"{", "qos": 0, "retain": False}] * 2000
        publish.multiple(flood, hostname="127.0.0.1", port=broker.port, protocol=MQTTProtocolVersion.MQTTv5)
        until(lambda: counters.counters.get(dropped, 0) > 1000 and running.service.supervisor.outages())
        time.sleep(4.0)  # over what the broker would wait for
        assert running.service.queue_load().n_blocks >= 8  # and those at hand
        assert [outage["part"] for outage in running.service.supervisor.outages()] == ["database"]
        assert running.service.supervisor.outage_totals()["broker"][:2] == (True, 0)
    finally:
        lock.execute("rollback")
        lock.close()
    running.until(len(lines))
    until(lambda: counters.counters[dropped] + counters.counters.get(refused, 0) == 2000)
    running.end()
    assert rows_of(settings.database) == undisturbed


def test_a_broker_that_sends_more_than_agreed_is_asked_again(
    undisturbed, broker: Broker, settings: MonitorSettings, monkeypatch
):
    """The room is less than what the broker is asked for at a time."""
    monkeypatch.setattr("sealscope.monitor.sources.broker._MAX_QOS1_QUEUE", 20)
    monkeypatch.setattr("sealscope.monitor.service._QUEUE_BLOCKS", 1)
    lines = LINES.splitlines()
    running = Running(settings)
    time.sleep(0.5)
    lock = sqlite3.connect(settings.database, isolation_level=None)
    lock.execute("begin immediate")
    send(broker.port, lines)
    time.sleep(1.0)
    lock.execute("rollback")
    lock.close()
    running.until(len(lines))
    running.end()
    assert rows_of(settings.database) == undisturbed
    assert running.service.actuators.counters["messages of QoS 1 that found no room and were asked for again"] > 20
    assert running.service.supervisor.outage_totals()["broker"][:2] == (True, 0)


def test_forged_messages_over_the_broker_are_counted(undisturbed, broker: Broker, settings: MonitorSettings):
    """What names another actuator than its topic is refused; one that is too large does not come through."""
    lines = LINES.splitlines()
    chance, sent = random.Random(1), Counter()
    messages: list[bytes] = []
    for line in lines:
        messages.append(line)
        for _ in range(20):
            reason, wrong = chance.choice(FORGED)
            sent[WRONG_ACTUATOR if reason == UNKNOWN or wrong.get("actuator", 0) is None else reason] += 1
            messages.append(json.dumps({**BRIEF, **wrong}).encode())
    kept(broker)
    running = Running(settings)
    for start in range(0, len(messages), 200):
        batch = messages[start : start + 200]
        publish.multiple(
            [{"topic": topic_of(message), "payload": message, "qos": 1, "retain": False} for message in batch],
            hostname="127.0.0.1",
            port=broker.port,
            protocol=MQTTProtocolVersion.MQTTv5,
        )
    publish.single("plant/press 1", b" " * 16_000_001, qos=0, hostname="127.0.0.1", port=broker.port)
    running.until(len(lines))
    until(lambda: sum(running.service.actuators.counters.values()) >= sum(sent.values()))
    running.end()
    assert running.service.actuators.counters == dict(sent)
    assert running.service.supervisor.outage_totals()["broker"][:2] == (True, 0)
    assert rows_of(settings.database) == undisturbed


def topic_of(message: bytes) -> str:
    """The topic of the actuator that a message names; that of the first where it names none."""
    name = json.loads(message)["actuator"]
    return "plant/press 2" if name == "press 2" else "plant/press 1"
