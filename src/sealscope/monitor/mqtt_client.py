"""A connection to an MQTT broker, with a last will that the broker publishes if the connection is lost."""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from sealscope.errors import MissingExtra
from sealscope.monitor.settings import BrokerSettings

_log = logging.getLogger(__name__)
_log.setLevel(logging.WARNING)  # paho logs each packet
#: Silence after which the client pings the broker [s]; the broker takes the client for lost after 1.5 times as long.
KEEP_ALIVE_S = 20
#: Topic and payload of a message.
_Message = tuple[str, bytes | str]
#: Timeout for a message to be published [s].
_PUBLISH_TIMEOUT_S = 3.0


def check_mqtt() -> None:
    """Check that the MQTT library is installed; raise MissingExtra otherwise."""
    if find_spec("paho") is None:
        raise MissingExtra("MQTT needs paho-mqtt: pip install 'sealscope[mqtt]'")


class MqttLink:
    """A connection to a broker by MQTT 5; the caller must acknowledge the received messages.

    `client_id`: name of the client at the broker; `password`: for the user in the settings `broker`, None for none.
    `will`: function, called before each connection, that returns topic and payload of the last will, None for no will.
    The broker publishes this message when the connection is lost, and `close` publishes it before it disconnects.
    `retain`: True if the broker keeps the will for later subscribers; `client`: object of the library paho; `is_open`:
    True from `open` to `close`, also while the connection is lost.
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
        client.reconnect_delay_set(1, 30)  # first and longest pause [s]
        client.suppress_exceptions = True  # an error of a callback does not end the connection; paho logs it
        client.enable_logger(_log)
        self.client: Any = client
        client.on_pre_connect = self._set_will

    def _set_will(self, client: Any, userdata: Any) -> None:
        """Set the last will of the connection that the client is about to make; called by the library paho."""
        if self._will is not None:
            self._last_will = self._will()
            client.will_set(*self._last_will, qos=1, retain=self._retain)

    def open(self, **options: Any) -> None:
        """Start a thread that connects, with `options` of paho's `connect_async`, and reconnects after a loss."""
        self.client.connect_async(self._broker.host, self._broker.port, KEEP_ALIVE_S, **options)
        self.client.loop_start()
        self.is_open = True

    def check_thread(self) -> None:
        """Close the connection and raise RuntimeError if its thread has ended, as after a malformed packet."""
        # a private attribute, as paho has no public one; if a later paho lacks it, nothing is checked
        if getattr(self.client, "_thread", self) is None:
            self.close()
            raise RuntimeError("the thread of the connection to the broker has ended")

    def publish(self, topic: str, payload: bytes | str, **options: Any) -> bool:
        """Publish a message; return True if it was sent, and with `qos` 1 acknowledged, within `_PUBLISH_TIMEOUT_S`."""
        message = self.client.publish(topic, payload, **options)
        try:
            message.wait_for_publish(_PUBLISH_TIMEOUT_S)
        except (RuntimeError, ValueError):  # the connection is lost, or its queue is full
            return False
        return bool(message.is_published())

    def close(self) -> None:
        """Publish the last will and disconnect; do nothing if the connection is not open."""
        if self.is_open:
            self.is_open = False
            # after a regular end of the connection the broker does not publish the will
            if self._last_will is not None and self.client.is_connected():
                self.publish(*self._last_will, qos=1, retain=self._retain)
            self.client.disconnect()
            self.client.loop_stop()
