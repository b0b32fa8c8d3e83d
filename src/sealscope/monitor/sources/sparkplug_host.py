"""Blocks from edge nodes of Sparkplug B: births name the metrics, data bring the samples, deaths end it.

A node or device of a node is an actuator, its metrics are the channels. A metric is an array of samples that begin at
its time, or a single sample; metrics of one time belong together, and a single one that is left out is as it was, which
is how nodes report by exception. Times are whole milliseconds; a block that follows the one before within that follows
it exactly.

The host asks a node to be born again when it does not know its birth, or when a sequence number is missing: then an
alias may mean another metric, so metrics without a name are refused until the birth comes.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sealscope.errors import InputError
from sealscope.monitor import sparkplug as spb
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources import source_block as blocks
from sealscope.monitor.sources.source_block import RefusedMessage, SourceBlock, digest_of, nothing, refusing
from sealscope.monitor.stream.joining import CHANNELS
from sealscope.recordings.channels import SLOW
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.units import to_si

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
    """What a birth says of the metrics that are channels, or the rate.

    `names`: channel -> name of its metric; `aliases`: alias -> name; `metrics`: name -> metric as it was last.
    """

    names: dict[str, str] = field(default_factory=dict)
    aliases: dict[int, str] = field(default_factory=dict)
    metrics: dict[str, spb.SparkplugMetric] = field(default_factory=dict)

    @classmethod
    def of(cls, metrics: Iterable[spb.SparkplugMetric], actuator: ActuatorSettings) -> _Birth:
        """Return the birth of an actuator: a name counts with a unit in brackets behind it, too."""
        birth, wanted = cls(), {actuator.map.get(channel, channel): channel for channel in (*CHANNELS, _RATE)}
        for metric in metrics:
            name = metric.name or ""
            bracketed = _BRACKETED.fullmatch(name)
            channel = wanted.get(name) or (wanted.get(bracketed["name"]) if bracketed else None)
            if channel is None:
                continue
            unit = metric.unit or (bracketed["unit"] if bracketed else None)
            birth.names[channel], birth.metrics[name] = name, replace(metric, unit=unit)
            if metric.alias is not None:
                birth.aliases[metric.alias] = name
        return birth


@dataclass
class _EdgeState:
    """An edge node: `births` of actuators by device, "" for the node; `whole`: no number is missing since its birth."""

    births: dict[str, _Birth] = field(default_factory=dict)
    birth_sequence: int | None = None
    seq: int | None = None
    whole: bool = False
    asked: float = float("-inf")


class SparkplugHost:
    """The actuators that are nodes, or devices of nodes, of Sparkplug B; those without `sparkplug` are left out.

    `publish`: sends a topic and a payload; `count`: counts what happened, by a reason.
    """

    def __init__(
        self,
        actuators: Iterable[ActuatorSettings],
        publish: Callable[[str, bytes], None],
        count: Callable[[str], None],
    ) -> None:
        spb.check_sparkplug()
        self._publish, self._count = publish, count
        self._actuators = {actuator.sparkplug: actuator for actuator in actuators if actuator.sparkplug is not None}
        self._nodes: dict[tuple[str, str], _EdgeState] = {}
        for path in self._actuators:
            group, node = path.split("/")[:2]
            self._nodes[group, node] = _EdgeState()
        self._follows: dict[str, float] = {}

    @property
    def topics(self) -> list[str]:
        """The filters of what the nodes send."""
        return [f"{spb.topic_of(group, '+', node)}/#" for group, node in self._nodes]  # the parent level is included

    def ask_all(self) -> None:
        """Ask every node for its birth, as after a connection is made: something may have been missed."""
        for group, node in self._nodes:
            self._nodes[group, node].whole = False
            self._ask(group, node)

    def owns(self, topic: str) -> bool:
        """Return whether a topic is one of Sparkplug's."""
        return topic.startswith(f"{spb.NAMESPACE}/")

    @refusing()
    def taken(self, topic: str, data: bytes, done: Callable[[], None] = nothing) -> SourceBlock | None:
        """Take a message; return the block that it brings, None where it brings none.

        Raises RefusedMessage where it is not what its topic says, or nothing of it can be used.
        """
        parts = topic.split("/")
        kind = parts[2] if 4 <= len(parts) <= 5 else ""
        state = self._nodes.get((parts[1], parts[3])) if kind else None
        device = parts[4] if len(parts) == 5 else ""
        if kind in ("NCMD", "DCMD"):
            return None  # for the node, not from it
        if state is None or kind not in ("NBIRTH", "DBIRTH", "NDATA", "DDATA", "NDEATH", "DDEATH"):
            raise RefusedMessage(blocks.WRONG_ACTUATOR, "its topic must be that of a node of the settings")
        if (kind[0] == "D") != bool(device):
            raise RefusedMessage(blocks.WRONG_ACTUATOR, f"{kind} must name {'a' if kind[0] == 'D' else 'no'} device")
        try:
            payload = spb.decoded_payload(data)
        except ValueError as error:
            raise RefusedMessage(blocks.UNREADABLE, error) from None
        group, node = parts[1], parts[3]
        if kind == "NDEATH":
            self._died(state, payload)
            return None
        if kind == "NBIRTH":
            self._born(state, payload)
        else:
            self._in_order(group, node, state, payload)
        path = "/".join([group, node, *([device] if device else [])])
        actuator = self._actuators.get(path)
        if actuator is None:  # a device that is not watched
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
        known = [self._known(metric, state, birth) for metric in payload.metrics]
        metrics = [metric for metric in known if metric is not None]
        samples = self._samples(actuator, birth, metrics, payload.timestamp)
        if samples is None:
            return None
        return SourceBlock(actuator.name, digest_of(topic.encode() + b"\0" + data), samples, done=done)

    @staticmethod
    def _died(state: _EdgeState, payload: spb.SparkplugPayload) -> None:
        if state.birth_sequence is not None and _birth_sequence(payload) != state.birth_sequence:
            raise RefusedMessage(blocks.STALE_DEATH, "a death must bear the bdSeq of the last birth")
        state.births, state.birth_sequence, state.seq, state.whole = {}, None, None, False

    @staticmethod
    def _born(state: _EdgeState, payload: spb.SparkplugPayload) -> None:
        state.births, state.birth_sequence, state.seq, state.whole = {}, _birth_sequence(payload), payload.seq, True

    def _in_order(self, group: str, node: str, state: _EdgeState, payload: spb.SparkplugPayload) -> None:
        """Look at the sequence number; where some are missing the node is asked for its birth."""
        if state.seq is None:
            self._ask(group, node)
            raise RefusedMessage(blocks.UNBORN, f"a message of {group}/{node} must follow its birth")
        if payload.seq is None:
            raise RefusedMessage(blocks.OUT_OF_SEQUENCE, f"a message of {group}/{node} must have a sequence number")
        if payload.seq != spb.after(state.seq):
            state.whole = False
            self._count(GAPS)
            self._ask(group, node)
        state.seq = payload.seq

    @staticmethod
    def _known(metric: spb.SparkplugMetric, state: _EdgeState, birth: _Birth) -> spb.SparkplugMetric | None:
        """Return a metric with name, type and unit of its birth, None where it is no channel."""
        name = metric.name
        if name is None:
            if not state.whole:
                raise RefusedMessage(blocks.OUT_OF_SEQUENCE, "after a missing message an alias must wait for a birth")
            name = birth.aliases.get(-1 if metric.alias is None else metric.alias)
        known = birth.metrics.get(name or "")
        if known is None:
            return None
        try:
            metric = metric if metric.datatype else spb.typed(metric, known.datatype)
        except ValueError as error:
            raise RefusedMessage(blocks.NO_SAMPLES, error) from None
        return replace(metric, name=name, unit=metric.unit or known.unit)

    def _ask(self, group: str, node: str) -> None:
        """Ask a node for its birth, unless it was asked a moment ago."""
        state, now = self._nodes[group, node], time.monotonic()
        if now - state.asked < _ASK_AGAIN_S:
            return
        state.asked = now
        _log.info("%s/%s is asked for its birth", group, node)
        request = spb.SparkplugPayload(
            round(1000.0 * time.time()), (spb.SparkplugMetric(spb.REBIRTH, True, spb.BOOLEAN),), None
        )
        self._publish(spb.topic_of(group, "NCMD", node), spb.encoded(request))

    def _samples(
        self, actuator: ActuatorSettings, birth: _Birth, metrics: list[spb.SparkplugMetric], sent: int | None
    ) -> Recording | None:
        """Return the samples that metrics bring, None where none of them is a channel."""
        by_name = {name: channel for channel, name in birth.names.items() if channel != _RATE}
        rate = self._rate(actuator, birth, metrics)
        groups: dict[int, dict[str, spb.SparkplugMetric]] = {}
        for metric in metrics:
            if metric.name is not None and metric.name in by_name:
                if by_name[metric.name] in SLOW and not isinstance(metric.value, np.ndarray):
                    birth.metrics[metric.name] = metric
                    continue
                at = metric.timestamp if metric.timestamp is not None else sent
                if at is None:
                    raise RefusedMessage(blocks.NO_CLOCK, f"the metric {metric.name[:40]!r} must have a time, got none")
                groups.setdefault(at, {})[by_name[metric.name]] = metric
        if not groups:
            return None
        if rate is None:
            raise RefusedMessage(
                blocks.NO_CLOCK, f"{actuator.name} must have a rate, in its settings or as the metric {_RATE!r}"
            )
        times, pieces = [], []
        for at in sorted(groups):
            piece = _piece(groups[at], birth, by_name)
            size = next(iter(piece.values())).size
            times.append(self._clock(actuator.name, at / 1000.0, size, rate))
            pieces.append(piece)
        names = [channel for channel in CHANNELS if any(channel in piece for piece in pieces)]
        t = np.concatenate(times)
        if t.size > blocks.MOST_SAMPLES:
            raise RefusedMessage(
                blocks.OVERSIZED, f"a channel must have at most {blocks.MOST_SAMPLES} samples, got {t.size}"
            )
        values = {
            name: np.concatenate(
                [piece.get(name, np.full(clock.size, np.nan)) for piece, clock in zip(pieces, times, strict=True)]
            )
            for name in names
        }
        for name, channel in by_name.items():
            if channel in SLOW and isinstance(known := birth.metrics[name].value, (int, float)):
                values[channel] = np.full(t.size, float(known))
        return _in_si(t, values, rate, {channel: birth.metrics[name].unit for name, channel in by_name.items()})

    def _clock(self, actuator: str, at: float, size: int, rate: float) -> Array:
        """Return the times of samples that begin at `at` [s], a whole millisecond."""
        first, expected = at, self._follows.get(actuator, float("nan"))
        if abs(expected - at) < 3.0 * _LATE:
            beyond = min(max(expected, at - _EARLY), at + _LATE) - expected
            first = expected + min(max(beyond, -_YIELDS / rate), _YIELDS / rate)
        self._follows[actuator] = first + size / rate
        return np.asarray(first + np.arange(size) / rate)

    @staticmethod
    def _rate(actuator: ActuatorSettings, birth: _Birth, metrics: list[spb.SparkplugMetric]) -> float | None:
        """Return the sampling rate [Hz]: that of the settings, else that of the metric."""
        name = birth.names.get(_RATE, _RATE)
        stated = spb.named(metrics, name)
        if stated is not None:
            birth.metrics[name] = stated
        if actuator.rate is not None:
            return actuator.rate
        metric = birth.metrics.get(name)
        if metric is None:
            return None
        try:
            rate = spb.number_of(metric.value)
        except ValueError as error:
            raise RefusedMessage(blocks.NO_CLOCK, f"{name}: {error}") from None
        if not 0.0 < rate < float("inf"):
            raise RefusedMessage(blocks.NO_CLOCK, f"{name} must be > 0 Hz, got {rate:g}")
        return rate


def _birth_sequence(payload: spb.SparkplugPayload) -> int | None:
    """Return the number that ties a death to its birth, None where there is none, or no whole number."""
    given = spb.named(payload.metrics, spb.BIRTH_SEQUENCE)
    return given.value if given is not None and isinstance(given.value, int) else None


def _piece(group: Mapping[str, spb.SparkplugMetric], birth: _Birth, by_name: Mapping[str, str]) -> dict[str, Array]:
    """Return the samples (n,) of the metrics of one time; a single one that is missing is as it was last."""
    if any(isinstance(metric.value, np.ndarray) for metric in group.values()):
        piece = {name: np.atleast_1d(metric.value) for name, metric in group.items() if metric.value is not None}
        sizes = {values.size for values in piece.values()}
        if len(sizes) != 1 or 0 in sizes or any(values.dtype != np.float64 for values in piece.values()):
            raise RefusedMessage(blocks.NO_SAMPLES, "metrics of one time must be arrays of equally many numbers")
        return piece
    for metric in group.values():
        birth.metrics[str(metric.name)] = metric
    try:
        return {
            channel: np.array([spb.number_of(birth.metrics[name].value)])
            for name, channel in by_name.items()
            if channel not in SLOW and not isinstance(birth.metrics[name].value, np.ndarray)
        }
    except ValueError as error:
        raise RefusedMessage(blocks.NO_SAMPLES, error) from None


def _in_si(t: Array, values: dict[str, Array], rate: float, units: Mapping[str, str | None]) -> Recording:
    """Return samples in SI; those without a unit are."""
    converted: dict[str, Any] = {}
    for channel, array in values.items():
        unit = units.get(channel)
        try:
            converted[channel] = (
                array if unit is None else to_si(array, unit[:40], CHANNEL_UNITS[channel], name=channel)
            )
        except InputError as error:
            raise RefusedMessage(blocks.WRONG_UNITS, error) from None
    return Recording(t, converted, {channel: CHANNEL_UNITS[channel] for channel in converted}, rate)
