"""Alarms as an edge node of Sparkplug B: a device for each actuator, with births, data, a death as the will.

Births state everything as it is; data state each event of an alarm at once, in order, and of the rest what has changed
every few seconds. bdSeq is one more with each connection, also after a restart. Messages have QoS 0: what a host misses
it learns from the birth that it asks for when a number is missing.
"""

from __future__ import annotations

import logging
import threading
import time
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from sealscope.monitor import sparkplug as spb
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.mqtt_client import MqttLink
from sealscope.monitor.settings import BrokerSettings, SparkplugSettings, topic_part
from sealscope.recordings.formats.timebase import counts_from_1970

_log = logging.getLogger(__name__)
_NAME, _BIRTHS = "sparkplug", "sparkplug bdSeq"


class SparkplugNode:
    """The edge node of a monitor.

    `summaries`: returns what each actuator shows now; `count`: counts what was dropped, by a reason; `password`: of the
    broker.
    """

    def __init__(
        self,
        store: MonitorStore,
        summaries: Callable[[], dict[str, dict[str, Any]]],
        count: Callable[[str], None],
        broker: BrokerSettings,
        settings: SparkplugSettings,
        password: str | None = None,
    ) -> None:
        spb.payload_class()
        self._store, self._summaries, self._count = store, summaries, count
        self._settings, self._broker = settings, broker
        name = f"{broker.client_id}-{settings.group}-{settings.node}"
        self._link = MqttLink(broker, name, password, will=self._death)
        self._client = self._link.client
        self._client.on_connect = self._on_connect
        self._client.on_message = self._message
        self._born = self._birth_number = 0  # bdSeq of the last birth, and of this connection
        self._seq = 255
        self._due = threading.Event()
        self._shown: dict[str, dict[str, Any]] = {}
        self._next = 0.0

    def pass_on(self) -> None:
        """Send what has happened."""
        if not self._link.is_open:
            self._born = self._store.position(_BIRTHS)
            self._link.open(clean_start=True)
        self._link.check()
        if not self._client.is_connected():
            return
        if self._due.is_set():
            self._due.clear()
            try:
                self._bear()
            except BaseException:
                self._due.set()
                raise
        if self._born != self._birth_number:  # connected a moment ago
            return
        self._store.pass_on(_NAME, self._sent_event)
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + self._settings.every_s
            for actuator, summary in self._summaries().items():
                if actuator not in self._shown:
                    self._bear_device(actuator, summary, {})
                    continue
                shown, now = self._shown[actuator], _values("summary", summary)
                changed = {name: value for name, value in now.items() if value != shown[name]}
                if changed and self._send("DDATA", _metrics("summary", changed, _clock(summary["t"])), actuator):
                    shown.update(changed)

    def end(self) -> None:
        """Send what is left, and end."""
        try:
            self.pass_on()
        finally:
            self._link.close()

    def _topic(self, kind: str, device: str | None = None) -> str:
        return spb.topic_of(self._settings.group, kind, self._settings.node, device)

    def _number(self) -> spb.SparkplugMetric:
        return spb.SparkplugMetric(spb.BIRTH_SEQUENCE, self._birth_number, spb.INT64)

    def _death(self) -> tuple[str, bytes]:
        """Return the death of the connection to come; its number is the one after that of the last birth."""
        self._birth_number = (self._born + 1) % 256
        return self._topic("NDEATH"), spb.encoded(spb.SparkplugPayload(_clock(None), (self._number(),)))

    def _on_connect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            _log.error("the broker %s refuses the Sparkplug node: %s", self._broker.host, reason)
            return
        client.subscribe(f"{self._topic('NCMD')}/#", qos=1)
        self._due.set()

    def _message(self, client: Any, userdata: Any, message: Any) -> None:
        if message.qos:
            client.ack(message.mid, message.qos)
        try:
            request = spb.decoded_payload(message.payload).find_metric(spb.REBIRTH)
        except ValueError as error:
            self._count("Sparkplug commands that are none")
            _log.info("a command that is none: %s", error)
            return
        if request is not None and request.value is True:
            self._due.set()

    def _sent_event(self, event: dict[str, Any]) -> bool:
        alarm, timestamp = event["alarm"], _clock(event["t"])
        if alarm["actuator"] not in self._shown:  # it is no longer in the settings
            return True
        metrics = _metrics("alarm", _values("alarm", alarm), timestamp) + _metrics(
            "event", _values("event", event), timestamp
        )
        return self._send("DDATA", metrics, alarm["actuator"])

    def _bear(self) -> None:
        """Send the births of the node and of all devices, with everything as it is."""
        self._store.keep_position(_BIRTHS, self._birth_number)
        self._born = self._birth_number
        summaries = self._summaries()
        latest = {alarm["actuator"]: alarm for alarm in reversed(self._store.alarms())}
        self._seq, self._shown = 255, {}
        self._send("NBIRTH", [self._number(), spb.SparkplugMetric(spb.REBIRTH, False, spb.BOOLEAN)])
        for actuator, summary in summaries.items():
            self._bear_device(actuator, summary, latest.get(actuator, {}))

    def _bear_device(self, actuator: str, summary: dict[str, Any], alarm: dict[str, Any]) -> None:
        shown = _values("summary", summary)
        metrics = _metrics("summary", shown, _clock(summary["t"]))
        metrics += _metrics("alarm", _values("alarm", alarm), _clock(alarm.get("updated_s")))
        self._send("DBIRTH", metrics + _metrics("event", _values("event", {}), _clock(None)), actuator)
        self._shown[actuator] = shown

    def _send(self, kind: str, metrics: list[spb.SparkplugMetric], actuator: str | None = None) -> bool:
        """Send a message with the next sequence number; return whether it went out."""
        self._seq = (self._seq + 1) % 256
        topic = self._topic(kind, None if actuator is None else topic_part(actuator))
        payload = spb.SparkplugPayload(_clock(None), tuple(metrics), self._seq)
        return self._link.published(topic, spb.encoded(payload))


@cache
def _table(name: str) -> Mapping[str, Mapping[str, str]]:
    """Return a table of metrics by name: type, unit and place of each."""
    tables: dict[str, Any] = tomllib.loads(
        (files("sealscope.monitor.outputs") / "sparkplug_node.toml").read_text("utf-8")
    )
    table: dict[str, dict[str, str]] = tables[name]
    return table


def _clock(t: float | None) -> int:
    """Convert a clock of samples [s] to [ms]; the present if it does not count from 1970."""
    return round(1000.0 * (t if t is not None and counts_from_1970(t) else time.time()))


def _values(table: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a table's metrics, None where there is none."""
    known: dict[str, Any] = {}
    for name, row in _table(table).items():
        value: Any = values
        for part in row["at"].split("."):
            if value is not None:
                value = value.get(part) if isinstance(value, Mapping) else value[int(part)]
        known[name] = value
    return known


def _metrics(table: str, values: Mapping[str, Any], timestamp: int) -> list[spb.SparkplugMetric]:
    """Return metrics of a table with their values, of the time `timestamp` [ms]."""
    rows = {name: _table(table)[name] for name in values}
    return [
        spb.SparkplugMetric(name, values[name], getattr(spb, row["type"]), timestamp=timestamp, unit=row.get("unit"))
        for name, row in rows.items()
    ]
