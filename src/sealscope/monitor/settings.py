"""The settings of a monitor, read from a TOML file and checked completely before anything is opened.

The comments of `template.toml` explain each key.
"""

from __future__ import annotations

import os
from collections import Counter
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, IPvAnyAddress, ValidationInfo, model_validator

from sealscope.diagnosis.commissioned.watched import load_watched
from sealscope.diagnosis.live.joining import CHANNELS, format_ways
from sealscope.diagnosis.priors.live import LIVE
from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.formats.headings.labels import Label, split_unit
from sealscope.storage.toml_file import read_model, read_toml
from sealscope.units import same_dimension, to_si

_PathLike = TypeVar("_PathLike", Path, str)
_Text = Annotated[str, Field(min_length=1, max_length=100)]
_Level = Annotated[str, Field(pattern=r"^[^/+#\x00]+$", max_length=100)]  # of an MQTT topic
_LongText = Annotated[str, Field(min_length=1, max_length=1000)]


def _resolve_in_folder(place: _PathLike, info: ValidationInfo) -> _PathLike:
    """Resolve `place`, a path in the settings, relative to the folder of the settings file in the `context`, if any.

    URLs and names of packaged rigs are returned unchanged.
    """
    is_name = isinstance(place, str) and ("://" in place or (info.field_name == "rig" and not place.endswith(".toml")))
    return place if is_name or not info.context else type(place)(Path(info.context["folder"]) / place)


_File = Annotated[Path, AfterValidator(_resolve_in_folder)]


def _check_recording_length(seconds: float) -> float:
    """Return the length of a stream's recordings [s]; raise ValueError unless it is 0 or within the allowed range."""
    shortest, longest = LIVE.recording.lengths
    if seconds != 0.0 and not shortest <= seconds <= longest:
        raise ValueError(f"must be 0 or {shortest:g} to {longest:g} s, got {seconds:g}")
    return seconds


class _Table(BaseModel):
    """A table of the settings, which cannot be changed and must not have unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class WatchSettings(_Table):
    """Settings by which an actuator is watched."""

    rig: Annotated[_Text, AfterValidator(_resolve_in_folder)] = "thesis"
    false_alarms_per_1000_h: float = Field(default=1.0, gt=0)
    learn_hours: float = Field(default=8.0, gt=0, le=1000)
    warning_lpm: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    error_lpm: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    debounce_blocks: int = Field(default=2, ge=1, le=1000)  # successive blocks after which the alarm changes
    return_share: float = Field(default=0.7, gt=0, lt=1)  # fraction of a threshold below which the leak has ended
    # length of the recordings into which a stream is cut, 0 for none
    recording_s: Annotated[float, AfterValidator(_check_recording_length)] = 180.0
    no_data_s: float = Field(default=3600.0, gt=0)
    not_comparable_s: float = Field(default=3600.0, gt=0)

    @property
    def watched_with(self) -> WatchSettings:
        """The settings by which the actuator is watched, without its name and the source of its samples."""
        return WatchSettings(**{name: getattr(self, name) for name in WatchSettings.model_fields})


class SimulateSettings(_Table):
    """A simulated rig as the source of samples, by options of ``sealscope simulate``, at `speed` times real time."""

    command: _LongText = "3 sin(4t)"
    load: _LongText | None = None
    leak: _LongText | list[_LongText] = Field(default_factory=list)
    fault: _LongText | list[_LongText] = Field(default_factory=list)
    duration: _LongText = "20 min"
    rate: _LongText | None = None
    seed: int = Field(default=0, ge=0)
    speed: float = Field(default=1.0, gt=0, allow_inf_nan=False)


class ActuatorSettings(WatchSettings):
    """The settings of one actuator: its name, the source of its samples, and how it is watched.

    The sources are files (`folder`, `pattern` of their names), MQTT (`topic`), Sparkplug (`sparkplug`: "group/node" or
    "group/node/device"), OPC UA (`nodes`: node of each channel) and a simulated rig (`simulate`). `map`: by channel,
    the column of the files or the Sparkplug metric; `units`: by channel, the unit of values that come without one.
    """

    name: _Text
    folder: _File | None = None
    pattern: str = "*"
    map: dict[str, str] = Field(default_factory=dict)
    topic: str | None = None
    sparkplug: Annotated[str, Field(pattern=r"^[^/+#\x00]+/[^/+#\x00]+(/[^/+#\x00]+)?$", max_length=300)] | None = None
    rate: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    nodes: dict[str, str] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)
    simulate: SimulateSettings | None = None

    @model_validator(mode="before")
    @classmethod
    def _fill_from_machine(cls, values: Any, info: ValidationInfo) -> Any:
        """Complete the table of an actuator with the rate, columns, units and repair limit in its machine's file.

        `values`: the table, whose entries take precedence. The key `machine` is another name of `rig`, but must name a
        file written by `sealscope commission`. The units in the column headings of the machine's logs are used only for
        Sparkplug and OPC UA, whose values need not state units.
        """
        if not isinstance(values, dict):  # refused later, by the check of the types
            return values
        machine_file = values.get("machine")
        if isinstance(machine_file, str):
            if not machine_file.endswith(".toml"):
                raise ValueError(f"machine must be a .toml file that commission wrote, got {machine_file[:100]!r}")
            values = {name: value for name, value in values.items() if name != "machine"} | {"rig": machine_file}
        rig = values.get("rig")
        if not isinstance(rig, str) or not rig.endswith(".toml"):
            return values
        watched = load_watched(_resolve_in_folder(rig, info))
        if isinstance(machine_file, str) and watched.machine is None:
            raise ValueError(f"machine must be a file that sealscope commission wrote, got a rig: {rig[:100]}")
        # a text is "auto": the columns are then found only when a file is read
        columns = {} if isinstance(watched.channel_map, str) else dict(watched.channel_map)
        machine_values = {"map": columns or None, "rate": watched.rate, "error_lpm": watched.limit_lpm}
        if values.get("nodes") or values.get("sparkplug"):
            units = {name: unit for name, column in columns.items() if (unit := _column_unit(name, column))}
            machine_values["units"] = units or None
        known_values = {name: value for name, value in machine_values.items() if value is not None}
        return {**known_values, **values}


class PageSettings(_Table):
    """The settings of the web page; `proxies`: addresses of proxies, which may state the address of a visitor."""

    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=0, le=65535)
    token_file: _File | None = None
    proxies: list[IPvAnyAddress] = Field(default_factory=list, max_length=100)


class BrokerSettings(_Table):
    """The settings of the connection to an MQTT broker.

    `alarms_topic`: topic under which alarms and states are published, None to publish none; `host_id`: identity of the
    monitor as a primary host of Sparkplug, None if it is not one.
    """

    host: _Text = "localhost"
    port: int = Field(default=1883, ge=1, le=65535)
    client_id: _Text = "sealscope-monitor"
    user: str | None = None
    password_file: _File | None = None
    tls: bool = False
    ca_file: _File | None = None
    alarms_topic: str | None = "sealscope"
    host_id: _Level | None = None


class OpcUaSettings(_Table):
    """The settings of the connection to an OPC UA server; `security`: security string of the library asyncua."""

    url: Annotated[str, Field(pattern=r"^opc\.tcp://[^\s@]+$", max_length=2000)]
    user: str | None = None
    password_file: _File | None = None
    security: str | None = None
    block_s: float = Field(default=1.0, ge=0.1, le=60.0)
    timeout_s: float = Field(default=10.0, gt=0, le=300)


class SparkplugSettings(_Table):
    """The settings of the Sparkplug B node that publishes alarms and, every `every_s` [s], changed values."""

    group: _Level = "Sealscope"
    node: _Level = "monitor"
    every_s: float = Field(default=10.0, ge=0.1, le=86_400)


class WebhookSettings(_Table):
    """The settings of a web address that gets the events of alarms by POST requests of at most `timeout_s` [s] each."""

    url: Annotated[str, Field(pattern=r"^https?://[^\s@]+$", max_length=2000)]
    token_file: _File | None = None
    timeout_s: float = Field(default=10.0, gt=0, le=300)


class MonitorSettings(_Table):
    """All settings of a monitor; where a table is None, the page, or this input or output, is switched off."""

    database: Annotated[str, AfterValidator(_resolve_in_folder)] = Field(default="monitor.db", validate_default=True)
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
    actuator: list[ActuatorSettings] = Field(min_length=1, max_length=10_000)

    @model_validator(mode="before")
    @classmethod
    def _apply_defaults(cls, values: Any) -> Any:
        """Fill the defaults into the table of each actuator, with an equal part of the fleet's false-alarm rate."""
        if not isinstance(values, dict):  # refused later, by the check of the types
            return values
        defaults, actuators = values.get("defaults", {}), values.get("actuator")
        if not (isinstance(defaults, dict) and isinstance(actuators, list)):
            return values
        key = "false_alarms_per_1000_h"
        fleet_rate = values.get(f"fleet_{key}")
        if isinstance(fleet_rate, int | float) and actuators:
            if any(isinstance(table, dict) and key in table for table in (defaults, *actuators)):
                raise ValueError(f"state {key} of actuators, or fleet_{key}, which they share in equal parts")
            defaults = {**defaults, key: fleet_rate / len(actuators)}
        merged_tables = [{**defaults, **actuator} if isinstance(actuator, dict) else actuator for actuator in actuators]
        return {**values, "actuator": merged_tables}

    @model_validator(mode="after")
    def _check_consistency(self) -> MonitorSettings:
        """Check the rules that concern several tables; raise ValueError or InputError if one is broken."""
        actuators, mqtt, page = self.actuator, self.mqtt, self.page
        topics = [actuator.topic for actuator in actuators if actuator.topic is not None]
        paths = [actuator.sparkplug for actuator in actuators if actuator.sparkplug is not None]
        for values, rule in (
            ([actuator.name for actuator in actuators], "actuators must have names of their own"),
            (topics, "each actuator must have a topic of its own without wildcards"),
            (paths, "each actuator must have a Sparkplug node or device of its own"),
        ):
            for value, count in Counter(values).items():
                if count > 1 or (values is topics and any(letter in value for letter in "+#")):
                    raise ValueError(f"{rule}, got {value!r}" + (" twice" if count > 1 else ""))
        if (topics or paths or self.sparkplug is not None) and mqtt is None:
            raise ValueError("an actuator with a topic, or Sparkplug B, needs the table [mqtt]")
        for actuator in actuators:
            _check_channels(actuator, has_opcua=self.opcua is not None)
        publishes = self.sparkplug is not None or (mqtt is not None and mqtt.alarms_topic is not None)
        if publishes and len({topic_level(actuator.name) for actuator in actuators}) < len(actuators):
            raise ValueError("actuators must have names that still differ with _ in place of + # / in topics")
        node_path = None if self.sparkplug is None else [self.sparkplug.group, self.sparkplug.node]
        if any(path.split("/")[:2] == node_path for path in paths):  # "group/node" or "group/node/device"
            raise ValueError("the node of the alarms must not be one of the actuators' nodes")
        if page is not None and page.host not in ("127.0.0.1", "localhost", "::1") and page.token_file is None:
            raise ValueError(f"a page for other computers needs page.token_file, got host {page.host!r} without it")
        return self


def _check_channels(actuator: ActuatorSettings, *, has_opcua: bool) -> None:
    """Check the OPC UA nodes and units of an actuator's channels; raise ValueError or InputError for a wrong entry."""
    if actuator.nodes and (not has_opcua or actuator.rate is None):
        raise ValueError(f"an actuator with nodes needs the table [opcua] and a rate, got {actuator.name!r}")
    for table, channels in (("nodes", actuator.nodes), ("units", actuator.units)):
        for channel in channels:
            if channel not in CHANNELS:
                raise ValueError(f"{table} must be stated for {', '.join(CHANNELS)} only, got {channel[:40]!r}")
    for channel, unit in actuator.units.items():  # raises if the unit has another dimension
        to_si(0.0, unit, CHANNEL_UNITS[channel], name=f"units.{channel}", place=actuator.name)
    if actuator.units and actuator.folder is not None:
        raise ValueError(f"the headings of files state their units, got units for the folder of {actuator.name!r}")
    if not actuator.nodes:
        return
    watched, nodes = load_watched(actuator.rig), actuator.nodes.keys()
    # recordings of the stream, which are judged as a whole, may do with other channels than its blocks
    ways = watched.rig.circuit.watched_by  # the sets of channels that suffice to watch the actuator by blocks
    if actuator.recording_s > 0.0:
        ways = (("p_A", "p_B"), *ways)
    if not any(nodes >= {*way} for way in ways):
        raise ValueError(f"nodes of {actuator.name!r} must give {format_ways(ways)}, got {', '.join(nodes)}")


def _column_unit(channel: str, column: str) -> str | None:
    """Find the unit in the heading of a watched channel's column; return None if none has the right dimension."""
    label = Label.parse(column)
    _, unit_in_name = split_unit(label.name)
    unit = label.unit or unit_in_name
    return unit if unit and channel in CHANNELS and same_dimension(unit, CHANNEL_UNITS[channel]) else None


def topic_level(name: str) -> str:
    """Convert a name to one level of an MQTT topic by replacing +, #, / and NUL with underscores."""
    return "".join("_" if letter in "+#/\0" else letter for letter in name)


def read_settings(path: Path) -> MonitorSettings:
    """Read the settings of a monitor from a TOML file; raise InputError if it cannot be read or breaks a rule."""
    values = read_toml(path, "the monitor's settings", os.fspath(path))
    context = {"folder": path.resolve().parent}
    # an error that concerns all settings has no entry: its message names the "settings"
    return read_model(values, MonitorSettings, os.fspath(path), lambda entry: entry or "settings", context)


def template() -> str:
    """Read the text of a settings file with comments, from which a user can begin."""
    return (files("sealscope.monitor") / "template.toml").read_text("utf-8")


def read_secret(path: Path | None, name: str) -> str | None:
    """Read a secret, such as a password, from the first line of a file; return None if `path` is None.

    `name`: name of the setting, for the InputError that is raised if the file cannot be read or is empty.
    """
    if path is None:
        return None
    try:
        secret = path.read_text(encoding="utf-8").strip().splitlines()[:1]
    except (OSError, ValueError) as error:
        raise InputError(f"{name} must be a readable file: {getattr(error, 'strerror', None) or error}") from None
    if not secret:
        raise InputError(f"{name} must hold a secret in its first line, got an empty file ({path})")
    return secret[0]
