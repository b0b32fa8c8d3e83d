"""Values with the wrong time or quality: each is missing, put in order or refused, and counted with a log line."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import Counter
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sealscope.monitor import sparkplug
from sealscope.monitor.actuators import WRONG_PACE
from sealscope.monitor.settings import ActuatorSettings, OpcUaSettings
from sealscope.monitor.sources import opcua
from sealscope.monitor.sources.gathering import CLOCK_OFF, CLOCK_SET, LATE, NO_CLOCK, ValueGatherer
from sealscope.monitor.sources.source_block import NO_CLOCK as REFUSED_CLOCK
from sealscope.monitor.sources.source_block import RefusedMessage, decode_message
from sealscope.monitor.sources.sparkplug_host import NOT_GOOD, OUTDATED
from sealscope.monitor.sparkplug import SparkplugMetric

from .plant import WORN, lines_of, moved, rows_of, served, settings_in
from .test_sparkplug import Plant

RATE = 100.0


# Sparkplug B


def live(name: str, value: Any, at: int, **more: Any) -> SparkplugMetric:
    return SparkplugMetric(name, value, sparkplug.DOUBLE, timestamp=at, **more)


@pytest.mark.parametrize("seed", range(4))
def test_history_never_changes_the_present_value(seed: int, caplog):
    """A node flushes stored values among live ones: what is live is as if it had sent none of them."""
    random = np.random.default_rng(seed)
    plants, t, blocks = [Plant(rate=10.0) for _ in range(2)], 1_700_000_000_000, []
    for plant in plants:
        plant.born(*(SparkplugMetric(name, float(k), sparkplug.DOUBLE) for k, name in enumerate(("p_A", "p_B", "x"))))
    n_stored = 0
    for _ in range(30):
        t += 100
        changed = [live(name, random.normal(), t) for name in ("p_A", "p_B", "x") if random.random() < 0.5]
        changed = changed or [live("x", random.normal(), t)]
        stored = [
            live(random.choice(["p_A", "p_B", "x"]), 99.0, t - int(random.integers(100, 10**7)), is_historical=True)
            for _ in range(int(random.integers(0, 3)))
        ]
        n_stored += len(stored)
        (with_history, plain), mixed = plants, [*changed, *stored]
        random.shuffle(mixed)
        blocks.append((with_history.send("DDATA", *mixed, at=t), plain.send("DDATA", *changed, at=t)))
        late = [live("p_A", 77.0, t - int(random.integers(100, 10**6)), is_historical=True)]
        assert with_history.send("DDATA", *late, at=t) is None
        assert plain.send("DDATA", at=t) is None
    first, later = blocks[0], blocks[1:]
    assert first[0].samples["p_A"][-1] == first[1].samples["p_A"][-1]  # what is stored may come before the first sample
    for mine, other in later:
        np.testing.assert_array_equal(mine.samples.t, other.samples.t)
        for name in ("p_A", "p_B", "x"):
            np.testing.assert_array_equal(mine.samples[name], other.samples[name])
    n_dropped = plants[0].counted[OUTDATED]
    assert 30 <= n_dropped <= n_stored + 30
    assert n_dropped >= n_stored + 30 - (len(first[0].samples) - len(first[1].samples)) - 2
    assert OUTDATED in caplog.text


@pytest.mark.parametrize("seed", range(4))
def test_history_that_fills_an_outage_is_taken_in_order(seed: int):
    """What a node stored while it was away, and sends before its next live samples, is as if it had been live."""
    random = np.random.default_rng(seed)
    values, t0 = random.standard_normal((2, 60)), 1_700_000_000_000
    plant, plain = Plant(rate=50.0), Plant(rate=50.0)
    away, back = sorted(random.choice(np.arange(1, 6), 2, replace=False))

    def sent(node: Plant, k: int, *, is_historical: bool = False) -> Any:
        part = slice(10 * k, 10 * k + 10)
        metrics = [
            SparkplugMetric(name, values[n, part], 31, timestamp=t0 + 200 * k, is_historical=is_historical)
            for n, name in enumerate(("p_A", "p_B"))
        ]
        return node.send("DDATA", *metrics)

    for node in (plant, plain):
        node.born(*(SparkplugMetric(name, None, 31) for name in ("p_A", "p_B")))
    mine = [sent(plant, k, is_historical=bool(away <= k < back)) for k in range(6)]
    others = [sent(plain, k) for k in range(6)]
    for name in ("p_A", "p_B"):
        np.testing.assert_array_equal(
            np.concatenate([block.samples[name] for block in mine]),
            np.concatenate([block.samples[name] for block in others]),
        )
    assert not plant.counted


@pytest.mark.parametrize("seed", range(6))
def test_a_value_that_is_not_good_is_missing_until_a_good_one_comes(seed: int, caplog):
    random = np.random.default_rng(seed)
    plant, t = Plant(rate=10.0), 1_700_000_000_000
    plant.born(*(SparkplugMetric(name, 1.0, sparkplug.DOUBLE, quality=192) for name in ("p_A", "p_B")))
    expected, n_bad = 1.0, 0
    for _ in range(40):
        t += 100
        metrics = [live("p_B", 2.0, t)]
        if random.random() < 0.6:
            quality = [None, 192, 200, 0, 64, 500, 512, 191, 256, 2**32 - 1][random.integers(10)]
            value, is_good = float(random.normal()), quality in (None, 192, 200)
            metrics.append(live("p_A", value, t, quality=quality))
            expected, n_bad = (value if is_good else np.nan), n_bad + (not is_good)
        samples = plant.send("DDATA", *metrics, at=t).samples
        np.testing.assert_array_equal(samples["p_A"], [expected])
        np.testing.assert_array_equal(samples["p_B"], [2.0])
    assert plant.counted == {NOT_GOOD: n_bad}
    assert caplog.text.count(NOT_GOOD) <= 3


def test_an_array_that_is_not_good_is_missing_in_full_and_births_may_be_bad():
    plant = Plant(rate=10.0)
    plant.born(live("p_A", 5.0, 0, quality=0), live("p_B", 6.0, 0, is_historical=True), live("x", 7.0, 0))
    samples = plant.send("DDATA", live("x", 8.0, 1000)).samples
    assert (np.isnan(samples["p_A"]).all(), np.isnan(samples["p_B"]).all(), samples["x"].tolist()) == (
        True,
        True,
        [8.0],
    )
    arrays = [SparkplugMetric(name, np.arange(5.0), 31, timestamp=2000) for name in ("p_B", "x")]
    bad = SparkplugMetric("p_A", np.arange(5.0), 31, timestamp=2000, quality=500)
    samples = plant.send("DDATA", bad, *arrays).samples
    assert (len(samples), np.isnan(samples["p_A"]).sum(), samples["x"].tolist()) == (5, 5, [0.0, 1.0, 2.0, 3.0, 4.0])


# OPC UA


class Subscription:
    """A session of an actuator whose server sends what a test says, on a clock of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, rate: float = RATE) -> None:
        self.counted: Counter[str] = Counter()
        nodes = {"p_A": "ns=2;s=a", "p_B": "ns=2;s=b"}
        actuator = ActuatorSettings(name="press", nodes=nodes, rate=rate)
        self.outages: dict[str, str] = {}
        self.session = opcua._OpcUaSession(
            OpcUaSettings(url="opc.tcp://localhost:4840"), None, self._receiver(actuator)
        )
        self.session._channels = {"p_A": (actuator, "p_A"), "p_B": (actuator, "p_B")}
        clock = self.clock = [datetime(2026, 3, 1, 10, tzinfo=UTC)]

        class Clock(datetime):
            @classmethod
            def now(cls, tz: Any = None) -> datetime:  # type: ignore[override]
                return clock[0]

        monkeypatch.setattr(opcua, "datetime", Clock)

    def _receiver(self, actuator: ActuatorSettings) -> Any:
        def part(name: str) -> Any:
            return SimpleNamespace(
                begin_outage=lambda reason: self.outages.setdefault(name, reason),
                end_outage=lambda: self.outages.pop(name, None),
            )

        return SimpleNamespace(
            supervisor=SimpleNamespace(part=part),
            settings=SimpleNamespace(actuator=[actuator]),
            count=lambda reason, number=1: self.counted.update({reason: number}),
            stopping=threading.Event(),
        )

    def send(self, channel: str, value: Any, stamp: datetime | None, status: int = 0) -> None:
        code = SimpleNamespace(value=status, is_good=lambda: status < 2**30)
        data_value = SimpleNamespace(SourceTimestamp=stamp, ServerTimestamp=None, StatusCode=code)
        data = SimpleNamespace(monitored_item=SimpleNamespace(Value=data_value))
        self.session.datachange_notification(SimpleNamespace(nodeid=channel), value, data)

    def samples(self) -> dict[str, np.ndarray]:
        """All samples of the complete blocks, by channel, and their times as "t"."""
        blocks = [block.samples for block in self.session._waiting.pop(max_items=1000, timeout=0.0)]
        names = ("p_A", "p_B")
        joined = {name: np.concatenate([block[name] for block in blocks] or [np.empty(0)]) for name in names}
        return {"t": np.concatenate([block.t for block in blocks] or [np.empty(0)]), **joined}


def truth_at(times: np.ndarray, t0: datetime, values: np.ndarray, rate: float = RATE) -> np.ndarray:
    return values[np.round((times - t0.timestamp()) * rate).astype(int)]


@pytest.mark.parametrize("seed", range(3))
def test_values_without_stamps_are_spread_over_their_publication(seed: int, monkeypatch, caplog):
    """Publications are late by a varying delay; no sample is lost, and the distances of the samples stay."""
    random = np.random.default_rng(seed)
    rate = float(random.choice([40.0, 100.0, 500.0]))
    server = Subscription(monkeypatch, rate)
    size, t0 = round(0.25 * rate), server.clock[0]
    values = random.standard_normal((2, 16 * size)) + 5.0
    for k in range(16):
        delay = timedelta(seconds=float(random.uniform(0.0, 0.08)))
        server.clock[0] = t0 + timedelta(seconds=((k + 1) * size - 1) / rate) + delay
        for i in range(k * size, (k + 1) * size):
            server.send("p_A", values[0, i], None)
            server.send("p_B", values[1, i], None)
            server.clock[0] += timedelta(microseconds=30)
    samples = server.samples()
    assert samples["t"].size >= 12 * size
    for n, name in enumerate(("p_A", "p_B")):
        # in the order sent, each once: the delay of the first publication alone shifts them
        first = int(np.flatnonzero(values[n] == samples[name][0])[0])
        np.testing.assert_array_equal(samples[name], values[n, first : first + samples["t"].size])
    assert server.counted == {opcua.UNSTAMPED: 32 * size}
    assert opcua.UNSTAMPED in caplog.text


@pytest.mark.parametrize("seed", range(5))
def test_changes_without_stamps_at_unknown_times_are_missing(seed: int, monkeypatch):
    """Of a channel that changed now and then within a publication only the last value is known."""
    random, server = np.random.default_rng(seed), Subscription(monkeypatch)
    t0, truth = server.clock[0], np.empty(1000)
    level = 1.0
    for k in range(40):
        server.clock[0] = t0 + timedelta(seconds=(25 * k + 24) / RATE)
        changes = set(random.choice(25, int(random.integers(0, 8)), replace=False).tolist()) if k else {0}
        for i in range(25):
            if i in changes:
                level = float(random.normal())
                server.send("p_A", level, None)
            truth[25 * k + i] = level
            server.send("p_B", float(random.normal()), None)
    samples = server.samples()
    assert samples["t"].size >= 900
    expected = truth_at(samples["t"], t0, truth)
    is_known = np.isfinite(samples["p_A"])
    np.testing.assert_array_equal(samples["p_A"][is_known], expected[is_known])
    assert 0.1 < is_known.mean() < 1.0


@pytest.mark.parametrize("seed", range(4))
def test_samples_lost_in_the_server_s_queue_are_missing(seed: int, monkeypatch, caplog):
    random, server = np.random.default_rng(seed), Subscription(monkeypatch)
    t0, values = server.clock[0], random.standard_normal((2, 1000))
    lost = np.zeros(1000, dtype=bool)
    for start in random.choice(np.arange(1, 9), 3, replace=False) * 100 + random.integers(0, 40, 3):
        lost[start : start + int(random.integers(1, 60))] = True
    same_stamp = random.random() < 0.5  # the server stamps several values alike instead
    for i in range(1000):
        stamp = t0 + timedelta(seconds=i / RATE)
        server.send("p_B", values[1, i], stamp)
        if lost[i]:
            continue
        if i and lost[i - 1] and same_stamp:
            server.send("p_A", -9.0, stamp)
            server.send("p_A", values[0, i], stamp)
        else:
            server.send("p_A", values[0, i], stamp, status=0x480 if i and lost[i - 1] else 0)
    samples = server.samples()
    index = np.round((samples["t"] - t0.timestamp()) * RATE).astype(int)
    np.testing.assert_array_equal(np.isnan(samples["p_A"]), lost[index])
    np.testing.assert_array_equal(samples["p_A"][~lost[index]], values[0, index[~lost[index]]])
    np.testing.assert_array_equal(samples["p_B"], values[1, index])
    reason = opcua.SAME_STAMP if same_stamp else opcua.OVERFLOW
    assert server.counted[reason] == np.count_nonzero(np.diff(lost.astype(int)) == -1)
    assert reason in caplog.text


@pytest.mark.parametrize("offset", [61.0, -61.0, 3600.0, -7200.0, 1e6])
def test_a_channel_whose_clock_disagrees_is_missing_and_said(offset: float, caplog):
    counted, now = Counter[str](), [0.0]
    count = lambda reason, number=1: counted.update({reason: number})  # noqa: E731
    gatherer = ValueGatherer(("p_A", "p_B", "x"), RATE, 1.0, count, lambda: now[0], "press")
    random, blocks = np.random.default_rng(round(abs(offset))), []
    for k in range(400):
        now[0] = k / RATE
        for name in random.permutation(["p_A", "p_B", "x"]):
            t = 1.7e9 + k / RATE + (offset if name == "x" and k >= 100 else 0.0)
            blocks += gatherer.push(name, t, [float(k)])
    n_off = counted[CLOCK_OFF]
    assert n_off >= 250
    assert f"press, {'x' if offset < 0.0 else 'p_'}" in caplog.text and CLOCK_OFF in caplog.text
    # nobody knows whose clock is right; what lags behind is missing, and nothing is taken for constant
    for block in blocks[3:]:
        for name in ("p_A", "p_B", "x"):
            is_missing = np.isnan(block[name])
            assert is_missing.all() or np.unique(block[name]).size == len(block)
    assert len(blocks) >= 2


def test_a_clock_that_is_set_for_all_goes_on_and_is_counted():
    counted, now, blocks = Counter[str](), [0.0], []
    gatherer = ValueGatherer(
        ("p_A", "x"), 10.0, 1.0, lambda reason, number=1: counted.update({reason: number}), lambda: now[0]
    )
    for k in range(300):
        now[0] = k / 10.0
        shift = (0.0, 3600.0, -3600.0)[k // 100]
        for name in ("p_A", "x"):
            blocks += gatherer.push(name, 1e6 + shift + k / 10.0, [float(k)])
    assert counted[CLOCK_SET] == 2 and set(counted) <= {CLOCK_SET, CLOCK_OFF, LATE}
    for block in blocks:
        np.testing.assert_array_equal(block["p_A"], block["x"])
    assert sum(map(len, blocks)) >= 260


def test_a_value_is_taken_in_time_proportional_to_its_samples():
    """Twice an array takes about twice as long, up to the most samples; more are refused."""
    seconds = {}
    for size in (100_000, 800_000):
        values, best = np.random.default_rng(size).standard_normal(size), np.inf
        for _ in range(3):
            gatherer = ValueGatherer(("p_A", "p_B"), RATE, 1.0, lambda *_: None)
            start = time.process_time()
            blocks = []
            for k in range(2):
                for name in ("p_A", "p_B"):
                    blocks += gatherer.push(name, 1000.0 + k * size / RATE, values)
            best = min(best, time.process_time() - start)
        assert sum(map(len, blocks)) >= size
        np.testing.assert_array_equal(blocks[-1]["p_A"][-100:], values[-100:])
        seconds[size] = best
    assert seconds[800_000] < 5.0 * 8.0 * max(seconds[100_000], 1e-3)
    counted = Counter[str]()
    gatherer = ValueGatherer(("p_A",), RATE, 1.0, lambda reason, number=1: counted.update({reason: number}))
    assert gatherer.push("p_A", 0.0, np.zeros(1_000_001)) == []
    assert counted == {NO_CLOCK: 1_000_001}


def test_a_value_with_too_many_samples_is_an_outage_until_it_has_fewer(monkeypatch, caplog):
    server = Subscription(monkeypatch)
    stamp = server.clock[0]
    server.send("p_A", np.zeros(1_000_001), stamp)
    assert server.counted == {opcua.TOO_MANY: 1}
    assert "at most 1000000 samples, got 1000001 (press, p_A)" in server.outages["OPC UA values"]
    for channel in ("p_A", "p_B"):
        server.send(channel, np.arange(400_000.0), stamp)
    assert server.outages == {}
    assert server.samples()["t"].size == 400_000


# JSON


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_a_time_that_cannot_be_seconds_is_refused_with_its_unit(factor: float, unit: str):
    random = np.random.default_rng(int(factor))
    for t in random.uniform(1.2e9, 2.2e9, 20):
        with pytest.raises(RefusedMessage, match=rf"t must be a time in seconds, got \S+: is t in {unit}\?") as refused:
            decode_message(f'{{"actuator": "a", "t": {t * factor:.0f}, "rate": 500, "x": [1, 2]}}'.encode())
        assert refused.value.reason == REFUSED_CLOCK
        decode_message(f'{{"actuator": "a", "t": {t:.3f}, "rate": 500, "x": [1, 2]}}'.encode())


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us")])
def test_a_clock_of_the_machine_in_milliseconds_is_asked_about(factor: float, unit: str, tmp_path, caplog):
    """Times since a start are no larger than seconds may be: that they step too far is counted and said."""
    shifted = moved(WORN.between(0.0, 30.0), 500.0)
    messages = [json.loads(line) for line in lines_of({"press 1": shifted}, 50).splitlines()]
    wire = [json.dumps({**values, "t": factor * values["t"]}) for values in messages]
    service, _ = served(settings_in(tmp_path), "\n".join(wire).encode())
    assert service.actuators.counters == {WRONG_PACE: len(wire) - 1}
    assert f"is t in {unit}?" in caplog.text
    assert "press 1: gap" in caplog.text
    assert len(rows_of(service.settings.database)["blocks"]) == len(wire)


def test_what_a_stream_passes_over_has_a_line_at_each_power_of_ten(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    every_other = lines_of({"press 1": WORN.between(0.0, 40.0)}, 50).splitlines()[::2]
    served(settings_in(tmp_path), b"\n".join(every_other))
    assert [record.getMessage() for record in caplog.records if "gap" in record.getMessage()] == [
        "press 1: gap (1 so far)",
        "press 1: gap (10 so far)",
    ]
