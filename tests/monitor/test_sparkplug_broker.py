"""Sparkplug B over a real broker: samples that a third party encodes, alarms that it decodes, deaths by the will."""

from __future__ import annotations

import io
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings

from .plant import CHANNELS, HEALTHY, WORN, Running, rows_of, settings_in, until
from .servers import MOSQUITTO, Broker

spb = pytest.importorskip("pysparkplug")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")]
MORE = """
[mqtt]
host = "127.0.0.1"
port = {port}
{host}
[sparkplug]
every_s = 0.2
"""
HOST = 'host_id = "sealscope"'
OWN = """
sparkplug = "plant/edge/NAME"
rate = 50.0
"""


class Wire:
    """What goes over a broker, as a third party decodes it."""

    def __init__(self, port: int) -> None:
        self.heard: list[tuple[str, Any]] = []
        self._client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        hears = threading.Event()
        self._client.on_connect = lambda client, *_: client.subscribe("spBv1.0/#", qos=1)
        self._client.on_subscribe = lambda *_: hears.set()
        self._client.on_message = lambda client, userdata, message: self._hear(message.topic, message.payload)
        self.on_message: Callable[[str, Any], None] = lambda topic, payload: None
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        assert hears.wait(120.0)

    def _hear(self, topic: str, payload: bytes) -> None:
        kind = topic.split("/")[2]
        if topic.startswith("spBv1.0/plant/DDATA/"):  # its own
            return
        if topic.startswith("spBv1.0/STATE/"):
            decoded = json.loads(payload)
        elif kind == "NDEATH":  # bdSeq and no seq
            decoded = spb.NDeath.decode(payload)
        else:
            decoded = {"NBIRTH": spb.NBirth, "DBIRTH": spb.DBirth, "NCMD": spb.NCmd}.get(kind, spb.DData).decode(
                payload
            )
        self.heard.append((topic, decoded))
        self.on_message(topic, decoded)

    def publish(self, topic: str, payload: Any) -> None:
        # not waited for: a callback that did would hold up the thread that sends
        self._client.publish(topic, payload.encode(include_dtypes=isinstance(payload, spb.NCmd)), qos=0)

    def of(self, start: str) -> list[Any]:
        return [payload for topic, payload in self.heard if topic.startswith(f"spBv1.0/{start}")]

    def until(self, start: str, count: int) -> list[Any]:
        until(lambda: len(self.of(start)) >= count)
        return self.of(start)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


def values(payload: Any) -> dict[str, Any]:
    return {metric.name: metric.value for metric in payload.metrics}


class EdgeNode:
    """A node of a third party's payloads; it is born when it is asked."""

    def __init__(self, wire: Wire) -> None:
        self._wire, self._seq, self.births = wire, 255, 0
        self._lock = threading.RLock()

    def _next(self) -> int:
        self._seq = (self._seq + 1) % 256
        return self._seq

    def bear(self) -> None:
        with self._lock:
            self._seq = 255
            self.births += 1
            number = spb.Metric(timestamp=1, name="bdSeq", datatype=spb.DataType.INT64, value=self.births)
            self._wire.publish(
                "spBv1.0/plant/NBIRTH/edge", spb.NBirth(timestamp=1, seq=self._next(), metrics=(number,))
            )
            for k, device in enumerate(("press 1", "press 2")):
                metrics = tuple(
                    spb.Metric(
                        timestamp=1, name=name, datatype=spb.DataType.DOUBLE_ARRAY, alias=10 * k + n, value=(0.0,)
                    )
                    for n, name in enumerate(CHANNELS)
                )
                payload = spb.DBirth(timestamp=1, seq=self._next(), metrics=metrics)
                self._wire.publish(f"spBv1.0/plant/DBIRTH/edge/{device}", payload)

    def tell(self, k: int, device: str, part: Any) -> None:
        at = round(1000.0 * float(part.t[0]))
        metrics = tuple(
            spb.Metric(
                timestamp=at,
                name=None,
                datatype=spb.DataType.DOUBLE_ARRAY,
                alias=10 * k + n,
                value=tuple(part[name].tolist()),
            )
            for n, name in enumerate(CHANNELS)
        )
        with self._lock:
            payload = spb.DData(timestamp=at, seq=self._next(), metrics=metrics)
            self._wire.publish(f"spBv1.0/plant/DDATA/edge/{device}", payload)


@pytest.fixture
def settings(broker: Broker, tmp_path: Path) -> MonitorSettings:
    return settings_in(tmp_path, MORE.format(port=broker.port, host=HOST), own=OWN)


def test_samples_and_alarms_over_sparkplug(
    broker: Broker,
    settings: MonitorSettings,
    undisturbed,
):
    wire = Wire(broker.port)
    node = EdgeNode(wire)
    wire.on_message = lambda topic, payload: node.bear() if topic == "spBv1.0/plant/NCMD/edge" else None
    running = Running(settings)
    try:
        assert values(wire.until("plant/NCMD/edge", 1)[0]) == {"Node Control/Rebirth": True}
        wire.until("plant/DBIRTH/edge", 2)
        told_in_parts(node, 0, len(WORN))
        blocks = 2 * -(-len(WORN) // 150)
        running.until(blocks)
        assert len(rows_of(settings.database)["blocks"]) == blocks

        def said(event: str) -> bool:
            sent = [values(payload) for payload in wire.of("Sealscope/DDATA/monitor/press 1")]
            return any(each.get("Alarm/Event") == event for each in sent)

        until(lambda: said("raised"))
        running.service.actuators.apply_mark("press 1", "acknowledged", by_whom="Ada")
        until(lambda: said("acknowledged"))
        rebirth = spb.Metric(timestamp=1, name="Node Control/Rebirth", datatype=spb.DataType.BOOLEAN, value=True)
        wire.publish("spBv1.0/Sealscope/NCMD/monitor", spb.NCmd(timestamp=1, metrics=(rebirth,)))
        births = wire.until("Sealscope/NBIRTH/monitor", 2)
        wire.until("Sealscope/DBIRTH/monitor", 4)
    finally:
        running.end()
    assert running.service.actuators.counters == {}
    born = values(wire.of("Sealscope/DBIRTH/monitor/press 1")[-1])
    assert (born["State"], born["State/Health"], born["Alarm/State"]) == ("maintenance required", 4, "acknowledged")
    assert (born["Alarm/Diagnostic Number"], born["Status Word"]) == (4101, 1)
    assert born["Leak Low"] < born["Leak"] < born["Leak High"]
    other = values(wire.of("Sealscope/DBIRTH/monitor/press 2")[-1])
    assert (other["State"], other["Alarm/State"], other["Status Word"]) == ("good", None, 0)
    ours, theirs = rows_of(settings.database), undisturbed
    assert [row[:2] + row[3:4] for row in ours["estimates"]] == [row[:2] + row[3:4] for row in theirs["estimates"]]
    assert [values(birth) for birth in births] == 2 * [{"bdSeq": 1, "Node Control/Rebirth": False}]
    events = [values(payload) for payload in wire.of("Sealscope/DDATA/monitor/press 1")]
    events = [event for event in events if "Alarm/Event" in event]
    assert [(event["Alarm/Event"], event["Alarm/State"]) for event in events] == [
        ("raised", "new"),
        ("acknowledged", "acknowledged"),
    ]
    assert events[0]["Alarm/Leak Low"] < 0.00195 < events[0]["Alarm/Leak High"]
    numbers = [
        payload.seq
        for topic, payload in wire.heard
        if "/monitor" in topic and "/NCMD/" not in topic and "/NDEATH/" not in topic
    ]
    again = next(k for k, number in enumerate(numbers) if number == 0 and k)
    for part in (numbers[:again], numbers[again:]):
        assert part == [k % 256 for k in range(len(part))]
    assert wire.until("Sealscope/NDEATH/monitor", 1)[0].bd_seq_metric.value == 1
    states = wire.until("STATE/sealscope", 2)
    assert [state["online"] for state in states] == [True, False]
    wire.close()


def told_in_parts(node: EdgeNode, start: int, stop: int) -> None:
    """Let the node tell samples of both devices, 150 at a time."""
    for at in range(start, stop, 150):
        for k, (device, recording) in enumerate((("press 1", WORN), ("press 2", HEALTHY))):
            node.tell(k, device, recording.samples(slice(at, at + 150)))
        time.sleep(0.02)  # of QoS 0 a broker keeps none


def test_a_monitor_that_is_killed_dies_by_its_will_and_is_born_with_the_next_number(
    broker: Broker,
    settings: MonitorSettings,
):
    wire = Wire(broker.port)
    for number in (1, 2):
        child = os.fork()
        if child == 0:
            try:
                Service(settings, stdin=io.BytesIO(), stdout=io.StringIO()).run()
            finally:
                os._exit(1)
        births = wire.until("Sealscope/NBIRTH/monitor", number)
        assert values(births[-1])["bdSeq"] == number
        wire.until("Sealscope/DBIRTH/monitor", 2 * number)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        deaths = wire.until("Sealscope/NDEATH/monitor", number)
        assert deaths[-1].bd_seq_metric.value == number
    assert [state["online"] for state in wire.until("STATE/sealscope", 4)] == [True, False, True, False]
    wire.close()


def test_a_broker_that_restarts_sees_a_new_birth(broker: Broker, settings: MonitorSettings):
    running = Running(settings)
    try:
        first = Wire(broker.port)
        first.until("STATE/sealscope", 1)
        until(lambda: running.service.store.position("sparkplug bdSeq") > 0)  # it is born
        broker.stop()
        first.close()
        broker.start()
        wire = Wire(broker.port)
        births = wire.until("Sealscope/NBIRTH/monitor", 1)
        assert values(births[-1])["bdSeq"] == 2
        wire.until("Sealscope/DBIRTH/monitor", 2)
        wire.close()
    finally:
        running.end()
