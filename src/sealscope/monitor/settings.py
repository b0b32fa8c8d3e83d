"""The monitor's settings: a TOML file, checked whole before anything is opened."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sealscope.errors import InputError
from sealscope.monitor.alarms.judging import Thresholds
from sealscope.monitor.stream.joining import CHANNELS
from sealscope.storage.toml_file import read_toml

_Text = Annotated[str, Field(min_length=1, max_length=100)]
_Words = Annotated[str, Field(min_length=1, max_length=1000)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class WatchSettings(_Part):
    """How an actuator is watched."""

    rig: _Text = "thesis"
    false_alarms_per_1000_h: float = Field(default=1.0, gt=0)
    learn_hours: float = Field(default=8.0, gt=0, le=1000)
    warning_lpm: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    error_lpm: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    debounce_blocks: int = Field(default=2, ge=1, le=1000)
    return_share: float = Field(default=0.7, gt=0, lt=1)

    @property
    def thresholds(self) -> Thresholds:
        """What makes an alarm."""
        rate = self.false_alarms_per_1000_h
        return Thresholds(self.warning_lpm, self.error_lpm, self.debounce_blocks, self.return_share, rate)

    @property
    def learned_with(self) -> str:
        """The settings that a baseline depends on."""
        return f"{self.rig}, {self.learn_hours:g} h"


class SimulateSettings(_Part):
    """The simulated rig in the place of an actuator's samples, in the words of ``sealscope simulate``.

    `speed`: as a multiple of real time.
    """

    command: _Words = "3 sin(4t)"
    load: _Words | None = None
    leak: _Words | list[_Words] = Field(default_factory=list)
    fault: _Words | list[_Words] = Field(default_factory=list)
    duration: _Words = "20 min"
    rate: _Words | None = None
    seed: int = Field(default=0, ge=0)
    speed: float = Field(default=1.0, gt=0, allow_inf_nan=False)


class ActuatorSettings(WatchSettings):
    """An actuator: its name, where its samples come from, and what differs from the defaults."""

    name: _Text
    folder: Path | None = None
    pattern: str = "*"
    map: dict[str, str] = Field(default_factory=dict)
    topic: str | None = None
    sparkplug: Annotated[str, Field(pattern=r"^[^/+#\x00]+/[^/+#\x00]+(/[^/+#\x00]+)?$", max_length=300)] | None = None
    rate: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    nodes: dict[str, str] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)
    simulate: SimulateSettings | None = None


class PageSettings(_Part):
    """The page."""

    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=0, le=65535)
    token_file: Path | None = None


class BrokerSettings(_Part):
    """The MQTT broker."""

    host: _Text = "localhost"
    port: int = Field(default=1883, ge=1, le=65535)
    client_id: _Text = "sealscope-monitor"
    user: str | None = None
    password_file: Path | None = None
    tls: bool = False
    ca_file: Path | None = None
    alarms_topic: str | None = "sealscope"
    host_id: Annotated[str, Field(pattern=r"^[^/+#\x00]+$", max_length=100)] | None = None


class OpcUaSettings(_Part):
    """The OPC UA server."""

    url: Annotated[str, Field(pattern=r"^opc\.tcp://[^\s@]+$", max_length=2000)]
    user: str | None = None
    password_file: Path | None = None
    security: str | None = None
    block_s: float = Field(default=1.0, ge=0.1, le=60.0)
    timeout_s: float = Field(default=10.0, gt=0, le=300)


class SparkplugSettings(_Part):
    """The edge node of Sparkplug B as which the alarms go out."""

    group: Annotated[str, Field(pattern=r"^[^/+#\x00]+$", max_length=100)] = "Sealscope"
    node: Annotated[str, Field(pattern=r"^[^/+#\x00]+$", max_length=100)] = "monitor"
    every_s: float = Field(default=10.0, ge=0.1, le=86_400)


class WebhookSettings(_Part):
    """The address that events are posted to."""

    url: Annotated[str, Field(pattern=r"^https?://[^\s@]+$", max_length=2000)]
    token_file: Path | None = None
    timeout_s: float = Field(default=10.0, gt=0, le=300)


class ShareSettings(_Part):
    """A monitor's part where several share the actuators of a database."""

    name: _Text
    lease_s: float = Field(default=12.0, ge=1, le=3600)


class MonitorSettings(_Part):
    """All settings of a monitor."""

    database: str = "monitor.db"
    lines: bool = False
    settle_s: float = Field(default=5.0, ge=0, le=3600)
    keep_days: float = Field(default=90.0, gt=0)
    fleet_false_alarms_per_1000_h: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    defaults: WatchSettings = Field(default_factory=WatchSettings)
    page: PageSettings | None = None
    mqtt: BrokerSettings | None = None
    opcua: OpcUaSettings | None = None
    sparkplug: SparkplugSettings | None = None
    webhook: WebhookSettings | None = None
    share: ShareSettings | None = None
    actuator: list[ActuatorSettings] = Field(min_length=1, max_length=10_000)

    @model_validator(mode="before")
    @classmethod
    def _defaults_reach_actuators(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        defaults, actuators = values.get("defaults", {}), values.get("actuator")
        if not (isinstance(defaults, dict) and isinstance(actuators, list)):
            return values
        budget, rate = values.get("fleet_false_alarms_per_1000_h"), "false_alarms_per_1000_h"
        if isinstance(budget, int | float) and actuators:
            if any(isinstance(part, dict) and rate in part for part in (defaults, *actuators)):
                raise ValueError(f"state {rate} of actuators, or fleet_{rate}, which they share in equal parts")
            defaults = {**defaults, rate: budget / len(actuators)}
        spread = [{**defaults, **actuator} if isinstance(actuator, dict) else actuator for actuator in actuators]
        return {**values, "actuator": spread}

    @model_validator(mode="after")
    def _fits_together(self) -> MonitorSettings:
        names = [actuator.name for actuator in self.actuator]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"actuators must have names of their own, got {name!r} twice")
        topics = [actuator.topic for actuator in self.actuator if actuator.topic is not None]
        for topic in topics:
            if topics.count(topic) > 1 or any(letter in topic for letter in "+#"):
                raise ValueError(f"each actuator must have a topic of its own without wildcards, got {topic!r}")
        paths = [actuator.sparkplug for actuator in self.actuator if actuator.sparkplug is not None]
        for path in paths:
            if paths.count(path) > 1:
                raise ValueError(f"each actuator must have a Sparkplug node or device of its own, got {path!r} twice")
        if (topics or paths or self.sparkplug is not None) and self.mqtt is None:
            raise ValueError("an actuator with a topic, or Sparkplug B, needs the table [mqtt]")
        for actuator in self.actuator:
            if not actuator.nodes:
                continue
            if self.opcua is None or actuator.rate is None:
                raise ValueError(f"an actuator with nodes needs the table [opcua] and its rate, got {actuator.name!r}")
            for channel in {**actuator.nodes, **actuator.units}:
                if channel not in CHANNELS:
                    raise ValueError(f"nodes must be of {', '.join(CHANNELS)}, got {channel[:40]!r}")
        if self.sparkplug is not None or (self.mqtt is not None and self.mqtt.alarms_topic is not None):
            devices = [topic_part(name) for name in names]
            if len({*devices}) < len(devices):
                raise ValueError("actuators must have names that differ in more than the letters + # / as topics")
        own = None if self.sparkplug is None else [self.sparkplug.group, self.sparkplug.node]
        if any(path.split("/")[:2] == own for path in paths):
            raise ValueError("the node of the alarms must be none of the actuators' nodes")
        if self.share is not None and "://" not in self.database:
            raise ValueError(f"monitors that share actuators need a database by URL, got the file {self.database!r}")
        if self.share is not None and self.mqtt is not None and self.mqtt.host_id is not None:
            raise ValueError("monitors that share actuators are no primary host of Sparkplug: leave mqtt.host_id out")
        local = self.page is None or self.page.host in ("127.0.0.1", "localhost", "::1")
        if self.page is not None and not local and self.page.token_file is None:
            raise ValueError(f"a page beyond this machine needs page.token_file, got host {self.page.host!r} without")
        return self


def topic_part(name: str) -> str:
    """Return a name as one level of a topic."""
    return "".join("_" if letter in "+#/\0" else letter for letter in name)


#: Files that the parts of the settings name.
_FILES = {
    "page": ("token_file",),
    "mqtt": ("password_file", "ca_file"),
    "opcua": ("password_file",),
    "webhook": ("token_file",),
}


def read_settings(path: Path) -> MonitorSettings:
    """Return the settings of a file, paths in it taken from its folder.

    Raises InputError of one line where it cannot be read or breaks a rule.
    """
    values = read_toml(path, "the monitor's settings", os.fspath(path))
    try:
        settings = MonitorSettings.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "settings"
        message = first["msg"].removeprefix("Value error, ")
        value = "" if first["type"] in ("value_error", "missing") else f", got {str(first['input'])[:60]!r}"
        raise InputError(f"{place}: {message}{value} ({path})") from None
    folder = path.resolve().parent
    database = settings.database if "://" in settings.database else str(folder / settings.database)
    actuators = [
        one if one.folder is None else one.model_copy(update={"folder": folder / one.folder})
        for one in settings.actuator
    ]
    changed: dict[str, Any] = {"database": database, "actuator": actuators}
    for name, fields in _FILES.items():
        part = getattr(settings, name)
        if part is not None:
            given = {field: getattr(part, field) for field in fields}
            changed[name] = part.model_copy(update={f: folder / path for f, path in given.items() if path is not None})
    return settings.model_copy(update=changed)


def secret_of(path: Path | None, what: str) -> str | None:
    """Return the first line of a file that holds a secret; raises InputError where it cannot be read or is empty."""
    if path is None:
        return None
    try:
        secret = path.read_text(encoding="utf-8").strip().splitlines()[:1]
    except (OSError, ValueError) as error:
        raise InputError(f"{what} must be a readable file: {getattr(error, 'strerror', None) or error}") from None
    if not secret:
        raise InputError(f"{what} must hold a secret in its first line, got an empty file ({path})")
    return secret[0]


#: A commented file of settings.
TEMPLATE = """\
# Settings of `sealscope monitor`; paths are taken from this file's folder.

database = "monitor.db"          # a file of SQLite, or a URL such as postgresql+psycopg://user@host/name
lines = false                    # take JSON lines from standard input
keep_days = 90.0                 # estimates of so many days of operation are kept; alarms and marks stay
# fleet_false_alarms_per_1000_h = 1.0 # of all healthy actuators together, in equal parts; in place of that below
settle_s = 5.0                   # a file is read when it has not changed for so long [s]

[defaults]                       # of every actuator
rig = "thesis"                   # by name, or the path of a rig's TOML file
false_alarms_per_1000_h = 1.0    # of a healthy actuator, at most
learn_hours = 8.0                # operating hours of healthy running that the baseline is learned from
warning_lpm = 0.0                # a leak of so much is a warning [L/min]; 0: every leak that the tests show
# error_lpm = 0.01               # ... and of so much an error
debounce_blocks = 2              # successive blocks (some 3 s each) that must say so
return_share = 0.7               # an alarm returns below this share of its threshold

[page]
host = "127.0.0.1"
port = 8765
# token_file = "token.txt"       # needed for any other host; put a proxy with TLS before it

# [mqtt]                         # MQTT 5
# host = "localhost"
# port = 1883
# user = "monitor"
# password_file = "password.txt"
# tls = false
# ca_file = "ca.pem"
# alarms_topic = "sealscope"     # alarms go to sealscope/ACTUATOR/alarm, retained
# host_id = "sealscope"          # nodes of Sparkplug B that have this primary host hear when the monitor is away

# [opcua]                        # OPC UA
# url = "opc.tcp://localhost:4840"
# user = "monitor"
# password_file = "password.txt"
# security = "Basic256Sha256,SignAndEncrypt,certificate.der,key.pem"
# block_s = 1.0                  # values are gathered into blocks of so long [s]

# [sparkplug]                    # alarms also go out as an edge node of Sparkplug B, a device for each actuator
# group = "Sealscope"
# node = "monitor"               # each monitor's own
# every_s = 10.0                 # what has changed is sent so often; alarms at once

# [share]                        # several monitors over one PostgreSQL, each with the same actuators
# name = "monitor 1"             # its own
# lease_s = 12.0                 # one that says nothing for so long [s] loses its actuators to the others

# [webhook]                      # each event is posted as the JSON object of its line
# url = "https://example.com/alarms"
# token_file = "hook-token.txt"  # sent as Authorization: Bearer
# timeout_s = 10.0

# An actuator is watched by p_A, p_B, x and theta or omega (balance of volumes: steps from 0.002 L/min on), or without
# a position by p_A, p_B and u at 200 Hz or more (their response: steps from 0.005 L/min on). The first minute settles
# which; other names stand in `map`.
[[actuator]]
name = "press 1"
folder = "press 1"               # recordings that appear here are read, in any format that `sealscope diagnose` reads
pattern = "*"
# map = { p_A = "PG_1[bar]" }    # channels from foreign columns
# topic = "plant/press1/samples" # JSON or CBOR: {"t": 0.0, "rate": 500, "p_A": [...], "p_B": [...], "x": [...], ...}
# sparkplug = "plant/node/press" # or an edge node of Sparkplug B, or its device: GROUP/NODE or GROUP/NODE/DEVICE
# nodes = { p_A = "ns=2;s=press1.p_A", p_B = "ns=2;s=press1.p_B" } # or nodes of the OPC UA server, by channel
# units = { p_A = "bar" }        # theirs, where they are not SI
# rate = 500.0                   # its sampling rate [Hz], where no metric `rate` states it
# simulate = { command = "3 sin(4t)", leak = "0.0042 L/min from 120 s", seed = 1, speed = 20.0 } # or the simulated rig,
#                                # in the words of `sealscope simulate`, at `speed` times real time
# error_lpm = 0.02               # what differs from the defaults
"""
