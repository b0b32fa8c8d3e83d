"""Read blocks of samples from an MQTT 5 broker, and publish alarms and states to it as retained messages.

A message is acknowledged when its block is stored. The session outlives the connection (QoS 1, no clean start):
messages that were under way at a crash are sent again, and their blocks are recognised by identity. The thread of the
connection only queues messages; another thread decodes them and waits for the service.

The start of decoding a large or repeated message is stored until decoding ends. A message whose decoding has crashed
the process twice is refused unread. Messages of QoS 0 that find the queue full are dropped and counted. If a broker
sends more messages of QoS 1 than agreed (mosquitto 2.0.11 does), the surplus is not acknowledged, and sent again later.
"""

from __future__ import annotations

import json
import logging
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from sealscope.monitor.bounded_queue import BoundedQueue
from sealscope.monitor.mqtt_client import MqttLink, check_mqtt
from sealscope.monitor.settings import BrokerSettings, read_secret, topic_level
from sealscope.monitor.sources.source_block import (
    UNENDED,
    BlockReceiver,
    RefusedMessage,
    compute_digest,
    decode_message,
)
from sealscope.monitor.sources.sparkplug_host import SparkplugHost
from sealscope.monitor.sparkplug import NAMESPACE
from sealscope.monitor.supervisor import BROKER

_log = logging.getLogger(__name__)
#: Lifetime of the session without a connection [s]; most messages in flight; largest message [bytes].
_SESSION_S, _IN_FLIGHT, _MAX_PACKET_BYTES = 30 * 86_400, 256, 16_000_000
#: Queued messages, and their bytes, up to which another message of QoS 0 is accepted.
_MAX_QUEUE, _MAX_QUEUE_BYTES = 256, 64_000_000
#: Queued messages, and their bytes, up to which another message of QoS 1 is accepted.
_MAX_QOS1_QUEUE, _MAX_QOS1_BYTES = 2048, 192_000_000
#: Size above which the start of decoding a message is stored [bytes], and most attempts to decode a message.
_NOTED_BYTES, _MAX_ATTEMPTS = 256_000, 2
_NAME = "mqtt"
#: How long `run` waits for the decoder at its end [s].
_END_S = 2.0
#: How often new events are published [s].
_POLL_S = 0.05
#: How often changed states of the actuators are published [s].
_STATES_S = 2.0
#: Counters of messages that find the queue full.
_NO_ROOM = "messages of QoS 0 that found no room"
_ASKED_AGAIN = "messages of QoS 1 that found no room and were asked for again"


def broker_source(settings: BrokerSettings) -> Callable[[BlockReceiver], None]:
    """Build a source that submits the messages of a broker as blocks, and publishes alarms to it.

    Raises InputError if a secret cannot be read, and MissingExtra if the MQTT library is not installed.
    """
    password = read_secret(settings.password_file, "mqtt.password_file")
    check_mqtt()  # before the service starts
    return lambda service: _Connection(settings, password, service).run()


class _Connection:
    """The connection of a monitor to its MQTT broker, by which blocks arrive and alarms are published."""

    def __init__(self, settings: BrokerSettings, password: str | None, service: BlockReceiver) -> None:
        self._settings, self._service = settings, service
        self._broker = service.supervisor.part(BROKER)
        self._names = {actuator.topic: actuator.name for actuator in service.settings.actuator if actuator.topic}
        self._units_of = {actuator.name: actuator.units for actuator in service.settings.actuator}
        will = None if settings.host_id is None else self._offline_message
        self._link = MqttLink(settings, settings.client_id, password, will, retain=True)
        self._client = self._link.client
        self._host: SparkplugHost | None = None
        if any(actuator.sparkplug is not None for actuator in service.settings.actuator):
            self._host = SparkplugHost(service.settings.actuator, self._client.publish, service.count)
        self._connected_ms = self._connection = 0  # time of the connection [ms since 1970], and its number
        self._overfull_connection = -1  # number of the connection whose further messages stay unacknowledged
        self._overfull_socket: Any = None  # socket of this connection, which will be closed
        self._ended = threading.Event()
        self._published_states: dict[str, str] = {}
        self._states_due = 0.0
        # pairs (number of the connection, message), or (number, None) when a connection is made
        self._received: BoundedQueue[Any] = BoundedQueue(_MAX_QUEUE, _MAX_QUEUE_BYTES)
        self._client.on_connect_fail = self._on_connect_fail
        self._client.on_connect = self._on_connect
        self._client.on_message = self._on_message
        self._client.on_disconnect = self._on_disconnect

    def run(self) -> None:
        """Submit messages as blocks and publish alarms until the service stops."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = _SESSION_S
        properties.ReceiveMaximum = _IN_FLIGHT
        properties.MaximumPacketSize = _MAX_PACKET_BYTES
        decoding = self._service.supervisor.start("MQTT decoder", self._submit_received)
        alarms = self._service.supervisor.part("MQTT alarms")
        self._link.open(clean_start=False, properties=properties)
        try:
            while not self._service.stopping.wait(_POLL_S):
                self._link.check_thread()
                alarms.attempt(self._deliver)
            self._states_due = 0.0  # publish the last states at once
            alarms.attempt(self._deliver)
        finally:
            self._ended.set()
            decoding.join(_END_S)
            self._link.close()

    def _on_connect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        """Subscribe to all topics, or begin an outage if the broker refuses the connection; called by the library paho.

        A Sparkplug primary host first publishes that it is online; the decoder then requests births of Sparkplug nodes.
        """
        self._connection += 1
        if reason.is_failure:
            self._broker.begin_outage(f"{self._settings.host} refuses the connection: {reason}")
            return
        self._broker.end_outage()
        self._published_states.clear()
        if self._settings.host_id is not None:
            client.publish(*self._state_message(online=True), qos=1, retain=True)
        for topic in (*self._names, *(self._host.topics if self._host is not None else ())):
            client.subscribe(topic, qos=1)
        self._received.put((self._connection, None), size=0, always=True)  # None tells the decoder of a new connection

    def _offline_message(self) -> tuple[str, str]:
        """Store the present time, and build topic and text of the last will, which states that the host is offline."""
        self._connected_ms = round(1000.0 * time.time())
        return self._state_message(online=False)

    def _state_message(self, *, online: bool) -> tuple[str, str]:
        """Build topic and payload of the message by which a Sparkplug primary host states whether it is `online`."""
        state = json.dumps({"online": online, "timestamp": self._connected_ms})
        return f"{NAMESPACE}/STATE/{self._settings.host_id}", state

    def _on_disconnect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        """Begin an outage after the connection is lost, unless this side has closed it; called by the library paho."""
        if not self._service.stopping.is_set() and self._overfull_connection != self._connection:
            self._broker.begin_outage(f"the connection to {self._settings.host} is lost: {reason}")

    def _on_connect_fail(self, client: Any, userdata: Any) -> None:
        """Begin an outage, with its reason, after a failed attempt to connect; called by the library paho."""
        error = sys.exc_info()[1]  # the error that paho is handling during this call
        reason = " ".join(str(getattr(error, "strerror", None) or error or "").split())[:120]
        if isinstance(error, ssl.SSLCertVerificationError):
            reason = f"its certificate is not trusted ({error.verify_message})"
        place = f"{self._settings.host}:{self._settings.port}"
        self._broker.begin_outage(f"no connection to {place}: {reason}".removesuffix(": "))

    def _on_message(self, client: Any, userdata: Any, message: Any) -> None:
        """Queue a received message; called by the library paho, whose connection would time out if this call waited.

        If the queue is full, a message of QoS 0 is dropped. A message of QoS 1, and all later ones on this connection,
        are left unacknowledged; the broker sends them again on the next connection. All of these messages are counted.
        """
        queue_entry, size = (self._connection, message), len(message.payload)
        if message.qos == 0:
            if not self._received.put(queue_entry, size):
                self._service.count(_NO_ROOM)
            return
        n_messages, n_bytes = self._received.size()
        is_full = n_messages >= _MAX_QOS1_QUEUE or n_bytes + size > _MAX_QOS1_BYTES
        if is_full and self._overfull_connection != self._connection:
            self._overfull_connection, self._overfull_socket = self._connection, self._client.socket()
        if self._overfull_connection == self._connection:
            self._service.count(_ASKED_AGAIN)
        else:
            self._received.put(queue_entry, size, always=True)

    def _submit_received(self) -> None:
        """Decode and submit the queued messages in their order until the service stops."""
        while not (self._service.stopping.is_set() or self._ended.is_set()):
            queue_entries = self._received.pop(max_items=1, timeout=0.5)
            for connection, message in queue_entries:
                if message is not None:
                    self._submit(connection, message)
                elif self._host is not None:  # a connection was made
                    self._host.request_all_births()
            # the broker sends messages that were left unacknowledged (`_on_message`) only on a new connection
            if not queue_entries and (overfull_socket := self._overfull_socket) is not None:
                self._overfull_socket = None
                with suppress(OSError):  # paho reconnects
                    overfull_socket.shutdown(socket.SHUT_RDWR)

    def _submit(self, connection: int, message: Any) -> None:
        """Decode a message of a `connection` (its number), and submit its block or the reason to refuse the message.

        The message is acknowledged once the block or the refusal is stored, and at once if there is neither.
        """
        number, qos = message.mid, message.qos

        def acknowledge() -> None:
            # on a new connection the number may be that of another message, and the broker sends this one again
            if qos and connection == self._connection:
                self._client.ack(number, qos)

        topic, block = "", None
        try:
            with suppress(UnicodeDecodeError):  # the message is then decoded as one of topic ""
                topic = message.topic
            with self._note_decoding(message):
                if self._host is not None and topic.startswith(f"{NAMESPACE}/"):
                    block = self._host.receive(topic, message.payload)  # None for a message without samples
                else:
                    block = decode_message(message.payload, self._names.get(topic), self._units_of)
        except RefusedMessage as error:  # stored and acknowledged, as it would fail again
            self._service.submit(RefusedMessage(error.reason, f"{topic[:100]}: {error}", message.payload, acknowledge))
            return
        if block is None:
            acknowledge()
        else:
            self._service.submit(replace(block, done=acknowledge))

    @contextmanager
    def _note_decoding(self, message: Any) -> Iterator[None]:
        """Store in the database, until the context ends, that a large or repeated message of QoS 1 is being decoded.

        Raises RefusedMessage if its decoding has begun `_MAX_ATTEMPTS` times before and never ended, because the
        process died each time.
        """
        if not message.qos or not (message.dup or len(message.payload) > _NOTED_BYTES):
            yield
            return
        store, digest = self._service.store, compute_digest(message.payload)
        n_starts = 0
        with suppress(SQLAlchemyError):  # an outage of the database, which the storage of the block reports
            n_starts = store.begin_decoding(self._settings.client_id, digest)
        try:
            if n_starts >= _MAX_ATTEMPTS:
                rule = "the decoding of a message must end"
                raise RefusedMessage(UNENDED, f"{rule}, got no end in {_MAX_ATTEMPTS} attempts")
            yield
        finally:
            with suppress(SQLAlchemyError):
                store.end_decoding(self._settings.client_id, digest)

    def _deliver(self) -> None:
        """Publish the alarms of new events, and the states that have changed, as retained messages."""
        if self._settings.alarms_topic is None or not self._client.is_connected():
            return
        self._service.store.deliver(
            _NAME, lambda event: self._publish(event["alarm"]["actuator"], "alarm", json.dumps(event["alarm"]))
        )
        if time.monotonic() >= self._states_due:
            self._states_due = time.monotonic() + _STATES_S
            for name, summary in self._service.summaries().items():
                state = json.dumps(summary["state"])
                if self._published_states.get(name) != state and self._publish(name, "state", state):
                    self._published_states[name] = state

    def _publish(self, actuator: str, kind: str, message: str) -> bool:
        """Publish a retained message of a `kind`, "alarm" or "state"; return True if the broker acknowledges it."""
        topic = f"{self._settings.alarms_topic}/{topic_level(actuator)}/{kind}"
        return self._link.publish(topic, message, qos=1, retain=True)
