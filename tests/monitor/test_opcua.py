"""OPC UA: values gathered into blocks, and a server in this process whose samples become the rows of the same lines."""

from __future__ import annotations

import asyncio
import io
import math
import pickle
import threading
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from sealscope.monitor.service import Service
from sealscope.monitor.settings import read_settings
from sealscope.monitor.sources.gathering import LATE, ValueGatherer

from .plant import CHANNELS, WORN, rows_of, until
from .servers import free_port


def test_values_that_change_are_gathered_and_others_stay():
    dropped: Counter[str] = Counter()
    clock = [0.0]
    gatherer = ValueGatherer(("x", "theta"), 10.0, 1.0, lambda reason: dropped.update([reason]), lambda: clock[0])
    assert gatherer.push("x", 100.2, [5.0]) == []  # theta is not known yet
    for k in range(10):
        assert gatherer.push("theta", 100.4 + 0.1 * k, [1.0 + k]) == []  # x may yet have changed
    clock[0] = 10.0
    (block,) = gatherer.push("theta", 101.4, [11.0])  # it has not
    assert block.t.tolist() == pytest.approx([100.4 + 0.1 * k for k in range(10)])
    assert block["x"].tolist() == [5.0] * 10
    assert block["theta"].tolist() == [1.0 + k for k in range(10)]
    assert gatherer.push("x", 100.5, [7.0]) == []
    assert dropped == {LATE: 1}
    assert gatherer.push("x", 102.0, [8.0] * 10) == []  # an array
    (block,) = gatherer.push("theta", 102.3, [21.0])
    assert block["x"].tolist() == [5.0] * 6 + [8.0] * 4
    assert block["theta"].tolist() == [11.0] * 9 + [21.0]
    gatherer.push("x", 1e9, [1.0])  # after a pause
    clock[0] = 20.0
    (block,) = gatherer.push("x", 1e9 + 1.0, [math.nan])
    assert block.t[0] == pytest.approx(1e9)
    assert (block["x"].tolist(), block["theta"].tolist()) == ([1.0] * 10, [21.0] * 10)
    gatherer.push("x", 50.0, [3.0])  # the clock was set back
    gatherer.push("theta", 50.0, [4.0])
    gatherer.push("theta", 51.6, [5.0])
    (block,) = gatherer.push("x", 51.0, [math.nan])
    assert (block.t[0], block["x"].tolist(), block["theta"].tolist()) == (50.0, [3.0] * 10, [4.0] * 10)
    assert gatherer.push("x", math.inf, [1.0]) == []
    gatherer.discard_values()
    assert gatherer.push("x", 1e9 + 9.0, [2.0]) == []


def test_a_channel_that_never_came_fills_no_memory_and_may_come_late():
    gatherer, sizes = ValueGatherer(("x", "theta"), 50.0, 1.0, lambda reason: None), []
    for second in range(200):
        assert gatherer.push("x", float(second), [float(second)] * 50) == []
        sizes.append(len(pickle.dumps(vars(gatherer)["_channels"])))
    assert max(sizes[100:]) < 1.1 * sizes[70]
    (block,) = gatherer.push("theta", 199.0, [1.0] * 50)
    assert (block.t[0], block["x"][0]) == (199.0, 199.0)


def test_values_in_portions_make_the_same_blocks():
    random = np.random.default_rng(3)
    signal = {name: random.standard_normal(600) for name in ("x", "theta")}
    made = []
    for size in (1, 7, 50):
        gatherer, blocks = ValueGatherer(("x", "theta"), 50.0, 1.0, lambda reason: None), []
        for start in range(0, 600, size):
            for name, values in signal.items():
                blocks += gatherer.push(name, 10.0 + start / 50.0, values[start : start + size].tolist())
        made.append({name: np.concatenate([block[name] for block in blocks])[:500] for name in signal})
    for other in made:
        for name, values in signal.items():
            np.testing.assert_array_equal(other[name], values[:500])


class OpcUaServer:
    """A server of the channels of one actuator, in a thread of its own; pressures are in bar."""

    def __init__(self, port: int) -> None:
        self.url = f"opc.tcp://127.0.0.1:{port}/plant"
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._do(self._start())

    def _do(self, work):  # type: ignore[no-untyped-def]
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(30.0)

    async def _start(self) -> None:
        from asyncua import Server, ua

        self._server = Server()
        await self._server.init()
        self._server.set_endpoint(self.url)
        self._server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        space = await self._server.register_namespace("plant")
        folder = await self._server.nodes.objects.add_object(space, "press 1")
        self.nodes = {
            name: await folder.add_variable(ua.NodeId(f"press 1.{name}", space), name, [0.0]) for name in CHANNELS
        }
        self.space = space
        await self._server.start()

    def write(self, t: float, samples: dict[str, np.ndarray]) -> None:
        async def written() -> None:
            from asyncua import ua

            at = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=t)
            for name, values in samples.items():
                variant = ua.Variant(values.tolist(), ua.VariantType.Double)
                await self.nodes[name].write_value(ua.DataValue(variant, SourceTimestamp=at))

        self._do(written())

    def stop(self) -> None:
        self._do(self._server.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(60.0)


SETTINGS = """
database = "monitor.db"
[opcua]
url = "{url}"
[defaults]
learn_hours = 0.02
warning_lpm = 0.0005
error_lpm = 0.05
[[actuator]]
name = "press 1"
rate = 50.0
units = {{ p_A = "bar", p_B = "bar" }}
nodes = {{ {nodes} }}
"""


def pieces() -> Iterator[tuple[float, dict[str, np.ndarray]]]:
    for start in range(0, len(WORN) + 100, 50):  # a little more than there is, so that the last block is whole
        part = {name: np.float64([f"{value:.9g}" for value in WORN[name][start : start + 50]]) for name in CHANNELS}
        part = {name: values if values.size else np.zeros(50) for name, values in part.items()}
        yield 1000.0 + start / 50.0, {k: v / 1e5 if k.startswith("p") else v for k, v in part.items()}


@pytest.mark.slow
def test_a_server_that_restarts_is_said_and_its_samples_become_estimates(undisturbed, tmp_path: Path, caplog):
    pytest.importorskip("asyncua")
    port = free_port()
    server = OpcUaServer(port)
    nodes = ", ".join(f'{name} = "ns={server.space};s=press 1.{name}"' for name in CHANNELS)
    file = tmp_path / "monitor.toml"
    file.write_text(SETTINGS.format(url=server.url, nodes=nodes))
    service = Service(read_settings(file), stdin=io.BytesIO(), stdout=io.StringIO())
    thread = threading.Thread(target=service.run)
    thread.start()

    def blocks() -> int:
        return len(rows_of(service.settings.database)["blocks"])

    def sent(part: list[tuple[float, dict[str, np.ndarray]]], before: int) -> None:
        for k, (t, samples) in enumerate(part, 1):
            server.write(t, samples)
            if k % 30 == 0:
                until(lambda k=k: blocks() >= before + k - 2)  # no more than the server's queue holds

    try:
        server.stop()
        until(service.supervisor.outages)
        (outage,) = service.supervisor.outages()
        assert outage["part"] == "OPC UA server"
        server = OpcUaServer(port)
        until(lambda: not service.supervisor.outages())
        every = list(pieces())
        sent(every, blocks())
        until(lambda: blocks() >= len(every) - 2)
        server.stop()
        until(service.supervisor.outages)
    finally:
        service.stop()
        thread.join()
    assert "the OPC UA server is reached again after" in caplog.text
    ours, theirs = rows_of(service.settings.database), dict(undisturbed)
    theirs["estimates"] = [row for row in theirs["estimates"] if row[0] == "press 1"]
    # what is sent beyond the recording's end may complete one block more
    assert 0 <= len(ours["estimates"]) - len(theirs["estimates"]) <= 1
    for mine, plain_row in zip(ours["estimates"], theirs["estimates"], strict=False):
        assert mine[:2] == plain_row[:2]
        assert mine[2] == pytest.approx(plain_row[2] + 1000.0)
        assert mine[3] == plain_row[3]
        figures = [[math.nan if value is None else value for value in row[4:]] for row in (mine, plain_row)]
        assert figures[0][:3] == pytest.approx(figures[1][:3], rel=1e-6, abs=1e-9, nan_ok=True)
        # pressures in bar are rounded: of two onsets that are as likely the other one may be taken
        assert figures[0][3:] == pytest.approx(figures[1][3:], rel=0.1, abs=1e-9, nan_ok=True)
    assert len(ours["alarms"]) == 1
    assert set(service.actuators.counters) == set()
