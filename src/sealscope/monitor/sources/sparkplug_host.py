"""Read blocks of samples from edge nodes of Sparkplug B.

Birth messages of a node name its metrics, data messages bring samples, and death messages end the session. A node or
one of its devices is an actuator, and its metrics are the channels. The value of a metric is an array of samples that
begins at its timestamp, or a single sample; a single value that is left out has not changed. Timestamps are whole
milliseconds; a block that follows the block before within that resolution is joined to it. After a missing sequence
number an alias may stand for another metric, so messages with aliases are refused until a new birth.

A value whose quality is not good is a missing sample. A historical value, which the node has stored for a while, never
changes the present one: it is a sample if it is newer than all samples before it, else it is dropped.
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
from sealscope.monitor.logged_counts import LoggedCounts
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources import source_block as blocks
from sealscope.monitor.sources.message_limits import MAX_SAMPLES
from sealscope.monitor.sources.source_block import (
    RefusedMessage,
    SourceBlock,
    compute_digest,
    convert_to_si,
    raising_refused_message,
)
from sealscope.recordings.channels import SLOW
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording

_log = logging.getLogger(__name__)
#: Counter of missing sequence numbers; a message after a gap is still used if its metrics have names.
GAPS = "gaps in the sequence of a Sparkplug node"
#: Counter of values that are missing, as their sender says that they are not good.
NOT_GOOD = "Sparkplug values whose quality is not good"
#: Counter of historical values that are dropped.
OUTDATED = "historical Sparkplug values that are no newer than the samples before them"
#: Shortest time between two requests for the birth of a node [s].
_REQUEST_PAUSE_S = 10.0
#: Timestamps are truncated or rounded to whole milliseconds: largest distance of the true time before and after [s].
_EARLY_S, _LATE_S = 0.0005, 0.001
#: Largest shift of a block against the end of the block before [samples], as clock and rate of a node may disagree.
_MAX_SHIFT = 0.3
#: Name of the metric that states the sampling rate [Hz], unless `map` names another.
_RATE = "rate"
_BRACKETED = re.compile(r"(?P<name>.*?)\s*\[(?P<unit>[^\]]*)\]")


@dataclass
class _Birth:
    """The channels of an actuator in the birth message of its Sparkplug node, which states all metrics."""

    names: dict[str, str] = field(default_factory=dict)  # of the metrics, by channel or `_RATE`
    aliases: dict[int | None, str] = field(default_factory=dict)  # name of the metric, by its alias, a number
    metrics: dict[str | None, spb.SparkplugMetric] = field(default_factory=dict)  # by name, with the present value
    history: dict[str | None, spb.SparkplugMetric] = field(default_factory=dict)  # by name, with the last stored value

    @classmethod
    def from_metrics(cls, metrics: Iterable[spb.SparkplugMetric], actuator: ActuatorSettings) -> _Birth:
        """Select the metrics of a birth that are channels of an actuator, or its sampling rate.

        A metric has the name that `map` of the actuator states, by default that of the channel; "[unit]" may follow it.
        """
        birth = cls()
        # channel by name of its metric
        channel_of = {actuator.map.get(channel, channel): channel for channel in (*CHANNELS, _RATE)}
        for metric in metrics:
            name, unit = metric.name or "", metric.unit
            channel = channel_of.get(name)
            if (name_with_unit := _BRACKETED.fullmatch(name)) is not None:
                channel = channel or channel_of.get(name_with_unit["name"])
                unit = unit or name_with_unit["unit"]
            if channel is None:
                continue
            birth.names[channel] = name
            is_present = metric.is_good and not metric.is_historical
            birth.metrics[name] = replace(metric if is_present else metric.as_missing(), unit=unit)
            if metric.alias is not None:
                birth.aliases[metric.alias] = name
        return birth

    def complete_metric(self, metric: spb.SparkplugMetric, *, is_complete: bool) -> spb.SparkplugMetric | None:
        """Add name, type and unit of the birth to a metric of a data message; return None if it is not in the birth.

        `is_complete`: True if no message since the birth is missing. Raises RefusedMessage if a message is missing and
        the metric has an alias instead of a name, or if the value does not fit its type.
        """
        if metric.name is None and not is_complete:
            raise RefusedMessage(blocks.OUT_OF_SEQUENCE, "after a missing message an alias must wait for a birth")
        name = self.aliases.get(metric.alias) if metric.name is None else metric.name
        birth_metric = self.metrics.get(name)
        if birth_metric is None:
            return None
        try:
            metric = metric if metric.datatype else metric.with_datatype(birth_metric.datatype)
        except ValueError as error:
            raise RefusedMessage(blocks.NO_SAMPLES, error) from None
        return replace(metric, name=name, unit=metric.unit or birth_metric.unit)

    def rate(self, actuator: ActuatorSettings) -> float:
        """Find the sampling rate [Hz] in the settings, else in the birth; raise RefusedMessage if it is not > 0."""
        metric = self.metrics.get(self.names.get(_RATE))  # None if the birth has no rate
        rate = actuator.rate or (math.nan if metric is None else metric.value)
        if not _is_number(rate) or not 0.0 < rate < math.inf:
            rule = f"{actuator.name} must have a rate > 0 Hz, in its settings or as the metric {_RATE!r}"
            raise RefusedMessage(blocks.NO_CLOCK, f"{rule}, got {str(rate)[:40]}")
        return float(rate)


@dataclass
class _EdgeState:
    """The state of the session of a Sparkplug edge node, which begins with a birth message."""

    births: dict[str, _Birth] = field(default_factory=dict)  # by device, "" for the node itself
    birth_sequence: int | None = None  # number bdSeq of the last birth
    seq: int | None = None  # last sequence number, None before a birth
    is_complete: bool = False  # True if no sequence number since the birth is missing


class SparkplugHost:
    """Receives the messages of Sparkplug B nodes and devices that are actuators, and converts them to blocks.

    `publish`: function that sends a payload to a topic; `count_event`: function that increments the counter with a
    given name, such as `GAPS`. Raises MissingExtra if protobuf is not installed.
    """

    def __init__(
        self,
        actuators: Iterable[ActuatorSettings],
        publish: Callable[[str, bytes], object],
        count_event: Callable[[str], None],
    ) -> None:
        spb.payload_class()  # fails here rather than at the first message
        self._publish, self._counts = publish, LoggedCounts(count_event)
        self._actuators = {actuator.sparkplug: actuator for actuator in actuators if actuator.sparkplug is not None}
        # by (group, node) of the actuators' paths "group/node" or "group/node/device"
        self._nodes = {tuple(path.split("/")[:2]): _EdgeState() for path in self._actuators}
        self._last_requests: dict[tuple[str, ...], float] = {}
        self._next_starts: dict[str, float] = {}

    @property
    def topics(self) -> list[str]:
        """MQTT topic filters that include all messages of the nodes."""
        # "/#" matches the topic before it, too
        return [f"{spb.topic_of(group, '+', node)}/#" for group, node in self._nodes]

    def request_all_births(self) -> None:
        """Request a birth, which states all metrics, from each node, as a new connection may have missed messages.

        Until its birth arrives, the session of a node counts as incomplete, and messages with aliases are refused.
        """
        for (group, node), state in self._nodes.items():
            state.is_complete = False
            self._request_birth(group, node)

    def _request_birth(self, group: str, node: str) -> None:
        """Request the birth message of a node, which states all metrics, at most once in `_REQUEST_PAUSE_S` seconds."""
        now = time.monotonic()
        if now - self._last_requests.get((group, node), -math.inf) >= _REQUEST_PAUSE_S:
            self._last_requests[group, node] = now
            _log.info("%s/%s is asked for its birth", group, node)
            rebirth = spb.SparkplugMetric(spb.REBIRTH, True, spb.BOOLEAN)
            request = spb.SparkplugPayload(round(1000.0 * time.time()), (rebirth,))
            self._publish(spb.topic_of(group, "NCMD", node), spb.encode_payload(request))

    @raising_refused_message()
    def receive(self, topic: str, data: bytes) -> SourceBlock | None:
        """Process a message of a node; return the block of its samples, or None if it has no samples.

        `data`: its payload. Raises RefusedMessage if it breaks the protocol or its samples cannot be used.
        """
        match topic.split("/"):
            case [_, _, "NCMD" | "DCMD", *_]:
                return None  # a command to the node, not from it
            case [_, group, "NBIRTH" | "NDATA" | "NDEATH" as kind, node]:
                device, path = "", f"{group}/{node}"
            case [_, group, "DBIRTH" | "DDATA" | "DDEATH" as kind, node, device] if device:
                path = f"{group}/{node}/{device}"
            case _:
                raise RefusedMessage(blocks.WRONG_ACTUATOR, "its topic must be that of a node or a device")
        if (group, node) not in self._nodes:
            raise RefusedMessage(blocks.WRONG_ACTUATOR, "its topic must be that of a node of the settings")
        try:
            payload = spb.decode_payload(data)
        except ValueError as error:
            raise RefusedMessage(blocks.UNREADABLE, error) from None
        self._follow_session(group, node, kind, payload)  # devices that are no actuators count in the sequence, too
        state, actuator = self._nodes[group, node], self._actuators.get(path)
        if actuator is None or kind == "NDEATH":
            return None
        if kind.endswith("BIRTH"):
            state.births[device] = _Birth.from_metrics(payload.metrics, actuator)
            return None
        if kind == "DDEATH":
            state.births.pop(device, None)
            return None
        birth = state.births.get(device)
        if birth is None:
            self._request_birth(group, node)
            raise RefusedMessage(blocks.UNBORN, f"data of {path} must follow its birth")
        metrics = [birth.complete_metric(metric, is_complete=state.is_complete) for metric in payload.metrics]
        known_metrics = [self._with_quality(metric, actuator) for metric in metrics if metric is not None]
        samples = self._build_recording(actuator, birth, known_metrics, sent_ms=payload.timestamp)
        if samples is None:
            return None
        return SourceBlock(actuator.name, compute_digest(topic.encode() + b"\0" + data), samples)

    def _follow_session(self, group: str, node: str, kind: str, payload: spb.SparkplugPayload) -> None:
        """Update the state of a node with the birth, death or sequence number of a message of `kind`.

        A birth of a node (NBIRTH) begins its session, and a death (NDEATH) ends it; both discard the births of its
        devices. After a gap in the sequence, which is counted, a birth is requested. Raises RefusedMessage for a
        message outside a session or without a number, and for the death of an earlier session.
        """
        state = self._nodes[group, node]
        if kind in ("NBIRTH", "NDEATH"):
            metric = payload.find_metric(spb.BIRTH_SEQUENCE)
            number = metric.value if metric is not None and isinstance(metric.value, int) else None
            if kind == "NDEATH" and state.birth_sequence not in (None, number):
                raise RefusedMessage(blocks.STALE_DEATH, "a death must bear the bdSeq of the last birth")
            is_birth = kind == "NBIRTH"
            state.births, state.is_complete = {}, is_birth
            state.birth_sequence, state.seq = (number, payload.seq) if is_birth else (None, None)
        elif state.seq is None:
            self._request_birth(group, node)
            raise RefusedMessage(blocks.UNBORN, f"a message of {group}/{node} must follow its birth")
        elif payload.seq is None:
            raise RefusedMessage(blocks.OUT_OF_SEQUENCE, f"a message of {group}/{node} must have a sequence number")
        else:
            if payload.seq != (state.seq + 1) % 256:
                state.is_complete = False
                self._counts.add(GAPS, f"{group}/{node}")
                self._request_birth(group, node)
            state.seq = payload.seq

    def _with_quality(self, metric: spb.SparkplugMetric, actuator: ActuatorSettings) -> spb.SparkplugMetric:
        """Replace the value of a metric by a missing one if its quality is not good, and count this."""
        if metric.is_good:
            return metric
        self._counts.add(NOT_GOOD, f"{actuator.name}, {str(metric.name)[:40]!r}", detail=f"got {metric.quality}")
        return metric.as_missing()

    def _build_recording(
        self, actuator: ActuatorSettings, birth: _Birth, metrics: list[spb.SparkplugMetric], sent_ms: int | None
    ) -> Recording | None:
        """Build a recording in SI units from the samples in a message's metrics; return None if there are none.

        `metrics`: metrics of channels or of the sampling rate, with names; `sent_ms` [ms since 1970]: time of sending,
        used for metrics without a time. The value of a slow channel, such as the oil temperature, is not a sample: the
        `birth` of the actuator stores it, and all recordings repeat it until the next value. Only an array with the
        time and length of the samples has one for each. Historical values that do not follow the samples so far are
        dropped and counted. Raises RefusedMessage if the samples cannot be used.
        """
        channel_of = {name: channel for channel, name in birth.names.items() if channel != _RATE}
        # by timestamp, and False for present values, True for historical ones
        groups: dict[tuple[int, bool], dict[str, spb.SparkplugMetric]] = defaultdict(dict)
        for metric in metrics:
            name, timestamp = str(metric.name), sent_ms if metric.timestamp is None else metric.timestamp
            if name not in channel_of or (channel_of[name] in SLOW and not isinstance(metric.value, np.ndarray)):
                if metric.is_historical:
                    self._counts.add(OUTDATED, f"{actuator.name}, {name[:40]!r}")
                elif name in channel_of or metric.is_good:  # the rate is known from before
                    birth.metrics[name] = metric
            elif timestamp is None:
                raise RefusedMessage(blocks.NO_CLOCK, f"the metric {name[:40]!r} must have a time, got none")
            else:
                groups[timestamp, metric.is_historical][channel_of[name]] = metric
                birth.metrics[name] = replace(birth.metrics[name], unit=metric.unit)  # the message may state another
        for (_, is_historical), group in groups.items():
            _store_slow_values(group, birth.history if is_historical else birth.metrics)
        groups = {key: group for key, group in groups.items() if group}
        if not groups:
            return None
        rate, pieces = birth.rate(actuator), []
        for timestamp, is_historical in sorted(groups):
            group, t_stated = groups[timestamp, is_historical], timestamp / 1000.0
            if is_historical and not self._follows(actuator.name, t_stated, rate):
                for metric in group.values():
                    self._counts.add(OUTDATED, f"{actuator.name}, {str(metric.name)[:40]!r}")
                continue
            last_metrics = birth.history if is_historical else birth.metrics
            piece = _simultaneous_samples(group, last_metrics, channel_of)
            size = next(iter(piece.values())).size
            pieces.append({"t": self._sample_times(actuator.name, t_stated, size, rate), **piece})
        if not pieces:
            return None
        if (n_samples := sum(piece["t"].size for piece in pieces)) > MAX_SAMPLES:
            raise RefusedMessage(blocks.OVERSIZED, f"there must be at most {MAX_SAMPLES} samples, got {n_samples}")
        t = np.concatenate([piece["t"] for piece in pieces])
        values = {}
        for channel in CHANNELS:  # NaN where a piece lacks the channel
            if any(channel in piece for piece in pieces):
                series = [piece.get(channel, np.full(piece["t"].size, np.nan)) for piece in pieces]
                values[channel] = np.concatenate(series)
        for name, channel in channel_of.items():
            if channel in SLOW - values.keys() and _is_number(last := birth.metrics[name].value):
                values[channel] = np.full(n_samples, float(last))
        for channel, array in values.items():
            unit = birth.metrics[birth.names[channel]].unit or actuator.units.get(channel)
            values[channel] = convert_to_si(array, unit, channel)
        return Recording(t, values, {channel: CHANNEL_UNITS[channel] for channel in values}, rate)

    def _follows(self, actuator: str, t: float, rate: float) -> bool:
        """Return True if a sample at the time `t` [s] is newer than the actuator's samples so far, at `rate` [Hz]."""
        expected_start = self._next_starts.get(actuator, -math.inf)
        # `t` may be truncated to whole milliseconds, and one sampling interval may be shorter
        return t > min(expected_start - 1.0 / rate, expected_start - 3.0 * _LATE_S)

    def _sample_times(self, actuator: str, t: float, size: int, rate: float) -> Array:
        """Compute the times [s] of `size` samples at `rate` [Hz], the first at or near its stated time `t` [s].

        `t` is truncated or rounded to whole milliseconds. The times begin at the expected start, one sampling interval
        after the actuator's previous sample, if rounding explains its distance to `t`. For a larger distance they begin
        nearer to `t`, by at most `_MAX_SHIFT` samples. They begin at `t` itself if the distance is three times
        `_LATE_S` or more, as after missing samples or a change of the clock, and for the first samples.
        """
        start, expected_start = t, self._next_starts.get(actuator, math.nan)
        if abs(expected_start - t) < 3.0 * _LATE_S:
            # the true start lies within [t - _EARLY_S, t + _LATE_S]: take the time nearest to the expected
            possible_start = min(max(expected_start, t - _EARLY_S), t + _LATE_S)
            shift, max_shift = possible_start - expected_start, _MAX_SHIFT / rate
            start = expected_start + min(max(shift, -max_shift), max_shift)
        self._next_starts[actuator] = start + size / rate
        return np.asarray(start + np.arange(size) / rate)


def _is_number(value: object) -> bool:
    """Test whether the value of a metric is a number, which True and False are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _store_slow_values(
    group: dict[str, spb.SparkplugMetric], last_metrics: dict[str | None, spb.SparkplugMetric]
) -> None:
    """Store the last value of each slow channel's array; remove arrays longer or shorter than the samples.

    `group`: metrics with the same timestamp, by channel; `last_metrics`: metrics with their last values, by name.
    Raises RefusedMessage if a slow channel's array is empty.
    """
    samples = [metric.value for channel, metric in group.items() if channel not in SLOW]
    sizes = {values.size for values in samples if isinstance(values, np.ndarray)}
    for channel in SLOW & group.keys():
        metric = group[channel]
        if not metric.value.size:
            raise RefusedMessage(blocks.NO_SAMPLES, f"an array of {channel} must have a number, got none")
        last_metrics[metric.name] = replace(metric, value=float(metric.value[-1]))
        if metric.value.size not in sizes:
            del group[channel]


def _simultaneous_samples(
    group: Mapping[str, spb.SparkplugMetric],
    last_metrics: dict[str | None, spb.SparkplugMetric],
    channel_of: Mapping[str, str],
) -> dict[str, Array]:
    """Collect the samples (n,) of the metrics that have the same timestamp, by channel.

    `group`: these metrics by channel; `channel_of`: channel by name of its metric. If a value is an array, all must be
    arrays of the same length n, and channels without a value are left out. Otherwise n is 1: `last_metrics`, by name,
    stores the values, and a channel that is not in the group repeats the last single value stored there. None, and a
    value that is not known, become NaN.
    """
    if any(isinstance(metric.value, np.ndarray) for metric in group.values()):
        piece = {channel: np.atleast_1d(metric.value) for channel, metric in group.items() if metric.value is not None}
        sizes = {values.size for values in piece.values()}
        if len(sizes) != 1 or 0 in sizes or any(values.dtype != np.float64 for values in piece.values()):
            raise RefusedMessage(blocks.NO_SAMPLES, "metrics of one time must be arrays of numbers of one length")
        return piece
    last_metrics.update({metric.name: metric for metric in group.values()})
    known_metrics = {channel: last_metrics.get(name) for name, channel in channel_of.items() if channel not in SLOW}
    last_values = {channel: None if metric is None else metric.value for channel, metric in known_metrics.items()}
    numbers = {channel: value for channel, value in last_values.items() if not isinstance(value, np.ndarray)}
    if not all(value is None or _is_number(value) for value in numbers.values()):
        raise RefusedMessage(blocks.NO_SAMPLES, "a single sample must be a number")
    return {channel: np.array([math.nan if value is None else float(value)]) for channel, value in numbers.items()}
