"""Blocks from edge nodes of Sparkplug B: births name the metrics, data bring the samples, deaths end it.

A node or its device is an actuator, its metrics are the channels: arrays of samples from their time on, or single ones,
of which those left out are as they were. Times are whole milliseconds; a block that follows the one before within that
follows it exactly. After a missing sequence number an alias may mean another metric: it waits for the birth asked for.
"""

from __future__ import annotations

import logging
import math
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sealscope.diagnosis.live.joining import CHANNELS
from sealscope.monitor import sparkplug as spb
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources import source_block as blocks
from sealscope.monitor.sources.message_limits import MOST_SAMPLES
from sealscope.monitor.sources.source_block import RefusedMessage, SourceBlock, digest_of, in_si, refusing
from sealscope.recordings.channels import SLOW
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording

_log = logging.getLogger(__name__)
#: What a missing sequence number is counted under: the message is taken all the same where its metrics have names.
GAPS = "gaps in the sequence of a Sparkplug node"
#: A node is asked for its birth once in so long [s].
_ASK_AGAIN_S = 10.0
#: Times are whole milliseconds, cut off or rounded: what was measured lies so far before and behind [s].
_EARLY, _LATE = 0.0005, 0.001
#: A block is moved against the end of the one before by at most so many samples, for the node's clock is not its rate.
_YIELDS = 0.3
#: Name of the metric that states the sampling rate [Hz], unless `map` names another.
_RATE = "rate"
_BRACKETED = re.compile(r"(?P<name>.*?)\s*\[(?P<unit>[^\]]*)\]")


@dataclass
class _Birth:
    """The metrics of a birth that are channels or the rate.

    `names`: channel -> name of its metric; `aliases`: alias -> name; `metrics`: name -> metric as it was last.
    """

    names: dict[str, str] = field(default_factory=dict)
    aliases: dict[int | None, str] = field(default_factory=dict)
    metrics: dict[str | None, spb.SparkplugMetric] = field(default_factory=dict)

    @classmethod
    def of(cls, metrics: Iterable[spb.SparkplugMetric], actuator: ActuatorSettings) -> _Birth:
        """Return the birth of an actuator: a name counts with a unit in brackets behind it, too."""
        birth, channel_of = cls(), {actuator.map.get(channel, channel): channel for channel in (*CHANNELS, _RATE)}
        for metric in metrics:
            name, unit = metric.name or "", metric.unit
            channel, bracketed = channel_of.get(name), _BRACKETED.fullmatch(name)
            if bracketed is not None:
                channel, unit = channel or channel_of.get(bracketed["name"]), unit or bracketed["unit"]
            if channel is None:
                continue
            birth.names[channel], birth.metrics[name] = name, replace(metric, unit=unit)
            if metric.alias is not None:
                birth.aliases[metric.alias] = name
        return birth

    def complete_metric(self, metric: spb.SparkplugMetric, *, whole: bool) -> spb.SparkplugMetric | None:
        """Complete a metric by the name, type and unit of its birth, None if it is no channel; `whole`: none missed."""
        if metric.name is None and not whole:
            raise RefusedMessage(blocks.OUT_OF_SEQUENCE, "after a missing message an alias must wait for a birth")
        name = self.aliases.get(metric.alias) if metric.name is None else metric.name
        born = self.metrics.get(name)
        if born is None:
            return None
        try:
            metric = metric if metric.datatype else metric.typed(born.datatype)
        except ValueError as error:
            raise RefusedMessage(blocks.NO_SAMPLES, error) from None
        return replace(metric, name=name, unit=metric.unit or born.unit)

    def rate(self, actuator: ActuatorSettings) -> float:
        """Return the sampling rate [Hz]: that of the settings, else that of the metric."""
        metric = self.metrics.get(self.names.get(_RATE))
        rate = actuator.rate or (math.nan if metric is None else metric.value)
        if not isinstance(rate, (int, float)) or not 0.0 < rate < math.inf:
            rule = f"{actuator.name} must have a rate > 0 Hz, in its settings or as the metric {_RATE!r}"
            raise RefusedMessage(blocks.NO_CLOCK, f"{rule}, got {str(rate)[:40]}")
        return float(rate)


@dataclass
class _EdgeState:
    """An edge node: `births` of actuators by device, "" for the node; `whole`: no number is missing since its birth."""

    births: dict[str, _Birth] = field(default_factory=dict)
    birth_sequence: int | None = None
    seq: int | None = None
    whole: bool = False


class SparkplugHost:
    """The actuators that are nodes, or devices of nodes, of Sparkplug B; those without `sparkplug` are left out.

    `publish`: sends a topic and a payload; `count`: counts what happened, by a reason.
    """

    def __init__(
        self,
        actuators: Iterable[ActuatorSettings],
        publish: Callable[[str, bytes], object],
        count: Callable[[str], None],
    ) -> None:
        spb.payload_class()
        self._publish, self._count = publish, count
        self._actuators = {actuator.sparkplug: actuator for actuator in actuators if actuator.sparkplug is not None}
        self._nodes = {tuple(path.split("/")[:2]): _EdgeState() for path in self._actuators}
        self._asked: dict[tuple[str, ...], float] = {}
        self._follows: dict[str, float] = {}

    @property
    def topics(self) -> list[str]:
        """The filters of what the nodes send."""
        return [f"{spb.topic_of(group, '+', node)}/#" for group, node in self._nodes]  # the parent level is included

    def ask_all(self) -> None:
        """Ask every node for its birth, as after a connection is made: something may have been missed."""
        for (group, node), state in self._nodes.items():
            state.whole = False
            self._ask(group, node)

    def _ask(self, group: str, node: str) -> None:
        """Ask a node for its birth, unless it was asked a moment ago."""
        now = time.monotonic()
        if now - self._asked.get((group, node), -math.inf) >= _ASK_AGAIN_S:
            self._asked[group, node] = now
            _log.info("%s/%s is asked for its birth", group, node)
            rebirth = spb.SparkplugMetric(spb.REBIRTH, True, spb.BOOLEAN)
            request = spb.SparkplugPayload(round(1000.0 * time.time()), (rebirth,))
            self._publish(spb.topic_of(group, "NCMD", node), spb.encoded(request))

    @refusing()
    def receive(self, topic: str, data: bytes) -> SourceBlock | None:
        """Process a message; return its block, or None if it brings none.

        Raises RefusedMessage where it is not what its topic says, or nothing of it can be used.
        """
        match topic.split("/"):
            case [_, _, "NCMD" | "DCMD", *_]:
                return None  # for the node, not from it
            case [_, group, "NBIRTH" | "NDATA" | "NDEATH" as kind, node]:
                device, path = "", f"{group}/{node}"
            case [_, group, "DBIRTH" | "DDATA" | "DDEATH" as kind, node, device] if device:
                path = f"{group}/{node}/{device}"
            case _:
                raise RefusedMessage(blocks.WRONG_ACTUATOR, "its topic must be that of a node or a device")
        state = self._nodes.get((group, node))
        if state is None:
            raise RefusedMessage(blocks.WRONG_ACTUATOR, "its topic must be that of a node of the settings")
        try:
            payload = spb.decoded_payload(data)
        except ValueError as error:
            raise RefusedMessage(blocks.UNREADABLE, error) from None
        if kind in ("NBIRTH", "NDEATH"):
            number = getattr(payload.find_metric(spb.BIRTH_SEQUENCE), "value", None)
            number = number if isinstance(number, int) else None
            if kind == "NDEATH" and state.birth_sequence not in (None, number):
                raise RefusedMessage(blocks.STALE_DEATH, "a death must bear the bdSeq of the last birth")
            born = (number, payload.seq, True) if kind == "NBIRTH" else (None, None, False)
            state.births, (state.birth_sequence, state.seq, state.whole) = {}, born
        elif state.seq is None:
            self._ask(group, node)
            raise RefusedMessage(blocks.UNBORN, f"a message of {group}/{node} must follow its birth")
        elif payload.seq is None:
            raise RefusedMessage(blocks.OUT_OF_SEQUENCE, f"a message of {group}/{node} must have a sequence number")
        else:
            if payload.seq != (state.seq + 1) % 256:
                state.whole = False
                self._count(GAPS)
                self._ask(group, node)
            state.seq = payload.seq
        actuator = self._actuators.get(path)
        if actuator is None or kind == "NDEATH":
            return None
        if kind.endswith("BIRTH"):
            state.births[device] = _Birth.of(payload.metrics, actuator)
            return None
        if kind == "DDEATH":
            state.births.pop(device, None)
            return None
        birth = state.births.get(device)
        if birth is None:
            self._ask(group, node)
            raise RefusedMessage(blocks.UNBORN, f"data of {path} must follow its birth")
        known = [birth.complete_metric(metric, whole=state.whole) for metric in payload.metrics]
        samples = self._samples(actuator, birth, [metric for metric in known if metric is not None], payload.timestamp)
        if samples is None:
            return None
        return SourceBlock(actuator.name, digest_of(topic.encode() + b"\0" + data), samples)

    def _samples(
        self, actuator: ActuatorSettings, birth: _Birth, metrics: list[spb.SparkplugMetric], sent: int | None
    ) -> Recording | None:
        """Return the samples of metrics, None if none of them is a channel."""
        by_name = {name: channel for channel, name in birth.names.items() if channel != _RATE}
        groups: dict[int, dict[str, spb.SparkplugMetric]] = defaultdict(dict)
        for metric in metrics:
            name, timestamp = str(metric.name), sent if metric.timestamp is None else metric.timestamp
            if name not in by_name or (by_name[name] in SLOW and not isinstance(metric.value, np.ndarray)):
                birth.metrics[name] = metric
            elif timestamp is None:
                raise RefusedMessage(blocks.NO_CLOCK, f"the metric {name[:40]!r} must have a time, got none")
            else:
                groups[timestamp][by_name[name]] = metric
        if not groups:
            return None
        rate, pieces = birth.rate(actuator), []
        for timestamp in sorted(groups):
            piece = _piece(groups[timestamp], birth, by_name)
            size = next(iter(piece.values())).size
            pieces.append({"t": self._clock(actuator.name, timestamp / 1000.0, size, rate), **piece})
        if (count := sum(piece["t"].size for piece in pieces)) > MOST_SAMPLES:
            raise RefusedMessage(blocks.OVERSIZED, f"{MOST_SAMPLES} samples are the most, got {count}")
        values = {
            name: np.concatenate([piece.get(name, np.full(piece["t"].size, np.nan)) for piece in pieces])
            for name in ("t", *CHANNELS)
            if any(name in piece for piece in pieces)
        }
        t = values.pop("t")
        for name, channel in by_name.items():
            if channel in SLOW and isinstance(known := birth.metrics[name].value, (int, float)):
                values[channel] = np.full(count, float(known))
        units = {channel: birth.metrics[name].unit or actuator.units.get(channel) for name, channel in by_name.items()}
        converted = {channel: in_si(array, units.get(channel), channel) for channel, array in values.items()}
        return Recording(t, converted, {channel: CHANNEL_UNITS[channel] for channel in converted}, rate)

    def _clock(self, actuator: str, t: float, size: int, rate: float) -> Array:
        """Return the times of samples that begin at `t` [s], a whole millisecond."""
        first, expected = t, self._follows.get(actuator, math.nan)
        if abs(expected - t) < 3.0 * _LATE:
            excess = min(max(expected, t - _EARLY), t + _LATE) - expected
            first = expected + min(max(excess, -_YIELDS / rate), _YIELDS / rate)
        self._follows[actuator] = first + size / rate
        return np.asarray(first + np.arange(size) / rate)


def _piece(group: Mapping[str, spb.SparkplugMetric], birth: _Birth, by_name: Mapping[str, str]) -> dict[str, Array]:
    """Return the samples (n,) of the metrics of one time; a missing single value repeats its last one."""
    if any(isinstance(metric.value, np.ndarray) for metric in group.values()):
        piece = {name: np.atleast_1d(metric.value) for name, metric in group.items() if metric.value is not None}
        sizes = {values.size for values in piece.values()}
        if len(sizes) != 1 or 0 in sizes or any(values.dtype != np.float64 for values in piece.values()):
            raise RefusedMessage(blocks.NO_SAMPLES, "metrics of one time must be arrays of equally many numbers")
        return piece
    birth.metrics.update({metric.name: metric for metric in group.values()})
    known = {channel: birth.metrics[name].value for name, channel in by_name.items() if channel not in SLOW}
    single = {channel: value for channel, value in known.items() if not isinstance(value, np.ndarray)}
    if not all(isinstance(value, (int, float, type(None))) for value in single.values()):
        raise RefusedMessage(blocks.NO_SAMPLES, "a single sample must be a number")
    return {channel: np.array([math.nan if value is None else float(value)]) for channel, value in single.items()}
