"""Publish alarms and values as an edge node of Sparkplug B with one device per actuator.

Birth messages state all metrics. Data messages state each event of an alarm at once and in order, and every few seconds
the other metrics that have changed. The death message is the last will of the connection. Its number bdSeq increases
with each connection, also after a restart. The other messages have QoS 0: a host that misses one requests a birth.
"""

from __future__ import annotations

import logging
import threading
import time
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from sealscope.monitor import sparkplug as spb
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.alarms import latest_alarms
from sealscope.monitor.mqtt_client import MqttLink
from sealscope.monitor.settings import BrokerSettings, SparkplugSettings, read_secret, topic_level
from sealscope.recordings.formats.times.timebase import counts_from_1970

_log = logging.getLogger(__name__)
#: Names under which the database stores the numbers of the last sent event, and of the last birth message.
_NAME, _BIRTHS = "sparkplug", "sparkplug bdSeq"


class SparkplugNode:
    """The Sparkplug B edge node by which a monitor publishes its alarms and values; `deliver` connects it."""

    part = "Sparkplug node"

    def __init__(self, actuators: WatchedActuators, broker: BrokerSettings, settings: SparkplugSettings) -> None:
        """Prepare the connection to the broker; raise InputError if its password cannot be read."""
        password = read_secret(broker.password_file, "mqtt.password_file")
        spb.payload_class()  # fails here rather than at the first message
        self._actuators, self._store = actuators, actuators.store
        self._settings, self._broker = settings, broker
        name = f"{broker.client_id}-{settings.group}-{settings.node}"
        self._link = MqttLink(broker, name, password, will=self._death_message)
        self._client = self._link.client
        self._client.on_connect = self._on_connect
        self._client.on_message = self._on_message
        self._sent_birth_number = self._connection_birth_number = 0  # bdSeq of the last birth, and of this connection
        self._seq = 255  # sequence number of the last message; the next is 0
        self._birth_due = threading.Event()
        self._sent_values: dict[str, dict[str, Any]] = {}  # by actuator and metric
        self._next_update = 0.0

    def deliver(self) -> None:
        """Send births that are due, new events of alarms and, every few seconds, changed values to the broker.

        A birth message states all metrics. The first call connects to the broker; without a connection nothing is sent.
        """
        if not self._link.is_open:
            self._sent_birth_number = self._store.position(_BIRTHS)
            self._link.open(clean_start=True)
        self._link.check_thread()
        if not self._client.is_connected():
            return
        if self._birth_due.is_set():
            self._birth_due.clear()
            try:
                self._send_births()
            except BaseException:
                self._birth_due.set()
                raise
        if self._sent_birth_number != self._connection_birth_number:  # hosts ignore data before this connection's birth
            return
        self._store.deliver(_NAME, self._send_event)
        if time.monotonic() >= self._next_update:
            self._next_update = time.monotonic() + self._settings.every_s
            for actuator, summary in self._actuators.summaries().items():
                if actuator not in self._sent_values:  # its birth was not sent yet
                    self._send_device_birth(actuator, summary, alarm={})
                    continue
                sent_values, present_values = self._sent_values[actuator], _metric_values("summary", summary)
                changed_values = {name: value for name, value in present_values.items() if value != sent_values[name]}
                metrics = _build_metrics("summary", changed_values, _milliseconds(summary["t"]))
                if changed_values and self._send("DDATA", metrics, actuator):
                    sent_values.update(changed_values)

    def end(self) -> None:
        """Send the remaining events of alarms, and disconnect from the broker."""
        try:
            self.deliver()
        finally:
            self._link.close()

    def _topic(self, kind: str, device: str | None = None) -> str:
        return spb.topic_of(self._settings.group, kind, self._settings.node, device)

    def _birth_number_metric(self) -> spb.SparkplugMetric:
        """Build the metric bdSeq, the number that assigns a death message to its birth message."""
        return spb.SparkplugMetric(spb.BIRTH_SEQUENCE, self._connection_birth_number, spb.INT64)

    def _death_message(self) -> tuple[str, bytes]:
        """Build topic and payload of the death message, which the broker publishes when the next connection is lost.

        Death and birth of a connection have the same bdSeq (0 to 255), one more than that of the last birth sent.
        """
        self._connection_birth_number = (self._sent_birth_number + 1) % 256
        payload = spb.SparkplugPayload(_milliseconds(None), (self._birth_number_metric(),))
        return self._topic("NDEATH"), spb.encode_payload(payload)

    def _on_connect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        """Subscribe to commands, and send birth messages soon, unless the broker refuses the node; called by paho."""
        if reason.is_failure:
            _log.error("the broker %s refuses the Sparkplug node: %s", self._broker.host, reason)
            return
        client.subscribe(f"{self._topic('NCMD')}/#", qos=1)
        self._birth_due.set()

    def _on_message(self, client: Any, userdata: Any, message: Any) -> None:
        """Acknowledge a command, and send birth messages soon if it requests them; called by the library paho.

        A message that is not a valid Sparkplug payload is counted and logged.
        """
        if message.qos:
            client.ack(message.mid, message.qos)
        try:
            request = spb.decode_payload(message.payload).find_metric(spb.REBIRTH)
        except ValueError as error:
            self._actuators.count("invalid Sparkplug commands")
            _log.info("an invalid Sparkplug command: %s", error)
            return
        if request is not None and request.value is True:
            self._birth_due.set()

    def _send_event(self, event: dict[str, Any]) -> bool:
        """Send an event and its alarm as a data message of the actuator's device; return False if that fails."""
        alarm, timestamp = event["alarm"], _milliseconds(event["t"])
        if alarm["actuator"] not in self._sent_values:  # without a birth, as it is not in the settings
            return True
        metrics = _build_metrics("alarm", _metric_values("alarm", alarm), timestamp)
        metrics += _build_metrics("event", _metric_values("event", event), timestamp)
        return self._send("DDATA", metrics, alarm["actuator"])

    def _send_births(self) -> None:
        """Send the birth messages of the node and of all devices, with the present values of all metrics.

        The number bdSeq of this birth is stored first, so that it increases after a restart, too.
        """
        self._store.write_position(_BIRTHS, self._connection_birth_number)
        self._sent_birth_number = self._connection_birth_number
        latest = latest_alarms(self._store.alarms())
        self._seq, self._sent_values = 255, {}  # the birth of the node gets the sequence number 0
        # a birth that is not sent in time stays in the client's queue, before the data; a new connection sends all anew
        self._send("NBIRTH", [self._birth_number_metric(), spb.SparkplugMetric(spb.REBIRTH, False, spb.BOOLEAN)])
        for actuator, summary in self._actuators.summaries().items():
            self._send_device_birth(actuator, summary, latest.get(actuator, {}))

    def _send_device_birth(self, actuator: str, summary: dict[str, Any], alarm: dict[str, Any]) -> None:
        """Send the birth message of an actuator's device, with all metrics of its `summary` and its latest `alarm`."""
        values = _metric_values("summary", summary)
        metrics = _build_metrics("summary", values, _milliseconds(summary["t"]))
        metrics += _build_metrics("alarm", _metric_values("alarm", alarm), _milliseconds(alarm.get("updated_s")))
        metrics += _build_metrics("event", _metric_values("event", {}), _milliseconds(None))
        self._send("DBIRTH", metrics, actuator)
        self._sent_values[actuator] = values

    def _send(self, kind: str, metrics: list[spb.SparkplugMetric], actuator: str | None = None) -> bool:
        """Send `metrics` in a message of a `kind` such as "DDATA", of the node or a device; return True on success."""
        self._seq = (self._seq + 1) % 256
        topic = self._topic(kind, None if actuator is None else topic_level(actuator))
        payload = spb.SparkplugPayload(_milliseconds(None), tuple(metrics), self._seq)
        return self._link.publish(topic, spb.encode_payload(payload))


@cache
def _load_table(name: str) -> Mapping[str, Mapping[str, str]]:
    """Load a table of `sparkplug_node.toml`: for each metric the data type, path of the value (`at`), and any unit."""
    file = files("sealscope.monitor.outputs") / "sparkplug_node.toml"
    table: dict[str, dict[str, str]] = tomllib.loads(file.read_text("utf-8"))[name]
    return table


def _milliseconds(t: float | None) -> int:
    """Convert a time [s] to milliseconds since 1970; use the present time if `t` is None or not counted from 1970."""
    return round(1000.0 * (t if t is not None and counts_from_1970(t) else time.time()))


def _metric_values(table: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Look up the value of each metric of a `table` (`sparkplug_node.toml`) in nested values; None if it is missing."""
    result: dict[str, Any] = {}
    for name, row in _load_table(table).items():
        value: Any = values
        for key in row["at"].split("."):  # such as "state.severity" or "leak_interval_lpm.0"
            if value is not None:
                value = value.get(key) if isinstance(value, Mapping) else value[int(key)]
        result[name] = value
    return result


def _build_metrics(table: str, values: Mapping[str, Any], timestamp: int) -> list[spb.SparkplugMetric]:
    """Build metrics from values by name at a `timestamp` [ms since 1970]; `table` has their types (`_load_table`)."""
    rows = {name: _load_table(table)[name] for name in values}
    return [
        spb.SparkplugMetric(name, values[name], getattr(spb, row["type"]), timestamp=timestamp, unit=row.get("unit"))
        for name, row in rows.items()
    ]
