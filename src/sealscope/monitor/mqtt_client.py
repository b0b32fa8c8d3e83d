"""A connection to an MQTT broker, its will, and its end."""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from sealscope.errors import MissingExtra
from sealscope.monitor.settings import BrokerSettings

_log = logging.getLogger(__name__)
_log.setLevel(logging.WARNING)  # paho tells each packet
#: Silence after which the broker is asked for a sign of life [s]; half of it later the connection counts as lost.
KEEP_ALIVE_S = 20
#: Topic and payload.
_Message = tuple[str, bytes | str]
#: How long a message that is published is waited for [s].
_SENT_S = 3.0


def check_mqtt() -> None:
    """Raise MissingExtra where the library for MQTT is not installed: before the service starts."""
    if find_spec("paho") is None:
        raise MissingExtra("MQTT needs paho-mqtt: pip install 'sealscope[mqtt]'")


class MqttLink:
    """A connection to a broker by MQTT 5, with paho's `client`, which acknowledges by hand.

    `will`: topic and payload that the broker publishes where the connection is lost, asked for before each connection;
    `close` publishes the same; `retain`: whether the broker keeps it.
    """

    def __init__(
        self,
        broker: BrokerSettings,
        client_id: str,
        password: str | None,
        will: Callable[[], _Message] | None = None,
        retain: bool = False,
    ) -> None:
        check_mqtt()
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

        self._broker, self._will, self._retain, self.is_open = broker, will, retain, False
        self._last_will: _Message | None = None
        client = Client(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTProtocolVersion.MQTTv5, manual_ack=True)
        if broker.user is not None:
            client.username_pw_set(broker.user, password)
        if broker.tls:
            client.tls_set(ca_certs=None if broker.ca_file is None else str(broker.ca_file))
        client.reconnect_delay_set(1, 30)
        client.suppress_exceptions = True  # an error of a callback ends no connection; paho logs it
        client.enable_logger(_log)
        self.client: Any = client
        client.on_pre_connect = self._before_connection

    def _before_connection(self, client: Any, userdata: Any) -> None:
        if self._will is not None:
            self._last_will = self._will()
            client.will_set(*self._last_will, qos=1, retain=self._retain)

    def open(self, **options: Any) -> None:
        """Connect in a thread, again whenever the connection is lost."""
        self.client.connect_async(self._broker.host, self._broker.port, KEEP_ALIVE_S, **options)
        self.client.loop_start()
        self.is_open = True

    def check(self) -> None:
        """Close and raise RuntimeError if the thread has ended, for example after a malformed packet."""
        if getattr(self.client, "_thread", self) is None:  # there is no public way to ask
            self.close()
            raise RuntimeError("the thread of the connection to the broker has ended")

    def published(self, topic: str, payload: bytes | str, **options: Any) -> bool:
        """Publish a message; return whether it went out in time, to the broker's knowledge with a `qos` of 1."""
        message = self.client.publish(topic, payload, **options)
        try:
            message.wait_for_publish(_SENT_S)
        except (RuntimeError, ValueError):  # the connection is lost, or its queue is full
            return False
        return bool(message.is_published())

    def close(self) -> None:
        """Publish the last will, and disconnect."""
        if self.is_open:
            self.is_open = False
            if self._last_will is not None and self.client.is_connected():
                self.published(*self._last_will, qos=1, retain=self._retain)
            self.client.disconnect()
            self.client.loop_stop()
