"""A client of an MQTT broker."""

from __future__ import annotations

import logging
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from sealscope.errors import MissingExtra
from sealscope.monitor.settings import BrokerSettings

if TYPE_CHECKING:
    from paho.mqtt.client import Client

_log = logging.getLogger(__name__)
_log.setLevel(logging.WARNING)  # paho tells each packet
#: Silence after which the broker is asked for a sign of life [s]; half of it later the connection counts as lost.
KEEP_ALIVE_S = 20


def check_mqtt() -> None:
    """Raise MissingExtra where the library for MQTT is not installed: before the service starts."""
    if find_spec("paho") is None:
        raise MissingExtra("MQTT needs paho-mqtt: pip install 'sealscope[mqtt]'")


def client_of(broker: BrokerSettings, client_id: str, password: str | None) -> Client:
    """Return a client of MQTT 5 that is not connected yet; messages are acknowledged by hand."""
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

    client = Client(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTProtocolVersion.MQTTv5, manual_ack=True)
    if broker.user is not None:
        client.username_pw_set(broker.user, password)
    if broker.tls:
        client.tls_set(ca_certs=None if broker.ca_file is None else str(broker.ca_file))
    client.reconnect_delay_set(1, 30)
    client.suppress_exceptions = True  # an error of a callback ends no connection; paho logs it
    client.enable_logger(_log)
    return client


def check_running(client: Client) -> None:
    """Raise RuntimeError where the thread of a client has ended, as after a packet that paho does not understand."""
    if getattr(client, "_thread", client) is None:  # there is no public way to ask
        raise RuntimeError("the thread of the connection to the broker has ended")


def published(client: Client, topic: str, payload: bytes | str, timeout_s: float, **options: Any) -> bool:
    """Publish a message; return whether it went out in time, to the broker's knowledge with a `qos` of 1."""
    message = client.publish(topic, payload, **options)
    try:
        message.wait_for_publish(timeout_s)
    except (RuntimeError, ValueError):  # the connection is lost, or its queue is full
        return False
    return bool(message.is_published())
