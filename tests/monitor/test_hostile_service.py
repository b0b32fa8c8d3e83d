"""A running service under malformed, oversized, late, replayed and forged messages: each is counted by its reason.

What the valid messages among them leave in the database is what they leave without the others.
"""

from __future__ import annotations

import ctypes
import gc
import io
import json
import os
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from sealscope.monitor.service import Service
from sealscope.monitor.sources.message_limits import MAX_SAMPLES
from sealscope.monitor.sources.source_block import (
    MAX_MESSAGE_BYTES,
    NO_CLOCK,
    NO_MAPPING,
    NO_SAMPLES,
    OVERSIZED,
    UNREADABLE,
    WRONG_ACTUATOR,
    WRONG_UNITS,
)

from .plant import HEALTHY, LINES, message, rows_of, served, settings_in

UNKNOWN = "blocks of an actuator that is not in the settings"
REPEATED = "blocks stored already"
BRIEF = message("press 1", HEALTHY.samples(slice(0, 5)))
#: Messages of one wrong value, by the reason they are counted under.
FORGED: list[tuple[str, dict[str, object]]] = [
    (NO_MAPPING, {"valve": 3}),
    (NO_MAPPING, {"__class__": "os.system"}),
    (NO_CLOCK, {"t": "now"}),
    (NO_CLOCK, {"t": None}),
    (NO_CLOCK, {"t": [0.0]}),
    (NO_CLOCK, {"rate": True}),
    (NO_CLOCK, {"rate": -500.0}),
    (NO_CLOCK, {"rate": 0}),
    (NO_CLOCK, {"id": "a\0b"}),
    (UNREADABLE, {"id": "\ud800"}),
    (NO_CLOCK, {"id": {"a": 1}}),
    (NO_CLOCK, {"id": "x" * 101}),
    (NO_SAMPLES, {"x": []}),
    (NO_SAMPLES, {"x": "1, 2, 3"}),
    (NO_SAMPLES, {"x": {"0": 1.0}}),
    (NO_SAMPLES, {"x": [[1.0]] * 5}),
    (NO_SAMPLES, {"x": [1.0] * 4}),
    (NO_SAMPLES, {"x": ["0x10"] * 5}),
    (WRONG_UNITS, {"units": ["bar"]}),
    (WRONG_UNITS, {"units": {"x": "bar"}}),
    (WRONG_UNITS, {"units": {"p_A": "Pa" * 4000}}),
    (WRONG_UNITS, {"units": {"p_A": "9**9**9**9"}}),
    (WRONG_ACTUATOR, {"actuator": None}),
    (WRONG_ACTUATOR, {"actuator": ["press 1"]}),
    (WRONG_ACTUATOR, {"actuator": 1}),
    (UNKNOWN, {"actuator": "press 9"}),
    (UNKNOWN, {"actuator": "<script>alert(1)</script>"}),
    (UNKNOWN, {"actuator": "press 1\0"}),
    (UNREADABLE, {"actuator": "\ud800"}),
    (UNKNOWN, {"actuator": "'; drop table blocks; --"}),
    (UNKNOWN, {"actuator": "x" * 50_000}),
]


class HostileWire:
    """A stream of lines: those of `valid` in their order, and `count` hostile ones between them.

    `sent`: hostile ones by the reason they must be counted under; `odd`: those whose samples are for the stream of
    "press 3" to judge; `memory`: resident bytes after a fifth of the lines, and after all.
    """

    def __init__(self, valid: list[bytes], count: int, largest: int) -> None:
        self._random, self._valid, self._count, self._largest = np.random.default_rng(count), valid, count, largest
        self.sent: Counter[str] = Counter()
        self.odd = 0
        self.memory: list[int] = []
        self._passed: list[bytes] = []
        self._lines = self._mixed()
        self._line = io.BytesIO()

    def readline(self, size: int) -> bytes:
        """Return the next line, or its next `size` bytes; nothing at the end."""
        part = self._line.readline(size)
        if not part:
            self._line = io.BytesIO(next(self._lines, b""))
            part = self._line.readline(size)
        return part

    def _mixed(self) -> Iterator[bytes]:
        every = self._count // len(self._valid)
        before_reading = 9 * self._count // 10  # the last line is read when no large one is under way
        large = set(self._random.choice(before_reading, self._largest, replace=False).tolist())
        for number in range(self._count):
            if number % every == 0 and (at := number // every) < len(self._valid):
                yield self._valid[at] + b"\n"
                self._passed.append(self._valid[at])
            if number in (self._count // 5, self._count - 1):
                self.memory.append(_resident())
            reason, line = self._large(number) if number in large else self._hostile(number)
            if reason:
                self.sent[reason] += 1
            else:
                self.odd += 1
            yield line + b"\n"

    def _large(self, number: int) -> tuple[str, bytes]:
        if number % 2:
            return OVERSIZED, b" " * (MAX_MESSAGE_BYTES + 1)
        return OVERSIZED, json.dumps({**BRIEF, "x": [0] * (MAX_SAMPLES + 1)}).encode()

    def _hostile(self, number: int) -> tuple[str, bytes]:
        kind = self._random.integers(8)
        if kind == 0:
            text = json.dumps(BRIEF).encode()
            return UNREADABLE, text[: self._random.integers(1, len(text) - 1)]
        if kind == 1:
            noise = self._random.integers(0, 256, int(self._random.integers(1, 200)), dtype=np.uint8).tobytes()
            return UNREADABLE, b"{" + noise.replace(b"\n", b" ") + b"\xff"
        if kind == 2:
            return REPEATED, self._passed[self._random.integers(len(self._passed))]
        if kind == 3:
            return "", self._odd_samples(number)
        reason, wrong = FORGED[self._random.integers(len(FORGED))]
        return reason, json.dumps({**BRIEF, **wrong}).encode()

    def _odd_samples(self, number: int) -> bytes:
        """Samples of "press 3" that are early, late, repeated, out of order, huge, missing or at an odd rate."""
        start = 5 * int(self._random.integers(0, 1200))
        values = message("press 3", HEALTHY.samples(slice(start, start + 5)))
        kind = self._random.integers(6)
        if kind == 0:
            values["t"] += float(self._random.choice([-1e9, 1e9, 1e15, -1e300, 1e300]))
        elif kind == 1:
            values["rate"] = float(self._random.choice([1e-300, 1.0, 49.9, 500.0, 1e300]))
        elif kind == 2:
            values["p_A"] = [float(self._random.choice([1e308, -1e308, 0.0, 1e-308])) for _ in range(5)]
        elif kind == 3:
            values["x"] = [None] * 5
        elif kind == 4:
            del values["p_B"]
        values["id"] = number  # no two are the same
        return json.dumps(values).encode()


def _resident() -> int:
    """Return what the process holds [byte], without what it has freed and the allocator keeps."""
    gc.collect()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # of the GNU library
        trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _eventually(true: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if true():
            return True
        time.sleep(0.1)
    return true()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_hostile_messages_are_counted_and_change_no_row(tmp_path: Path):
    flooded(tmp_path, 450, 2)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_a_hundred_thousand_hostile_messages_leave_no_memory_behind(tmp_path: Path):
    """In a process of its own: what other tests leave to be freed is not the service's."""
    call = (
        f"from tests.monitor.test_hostile_service import flooded, Path; flooded(Path({str(tmp_path)!r}), 100_000, 12)"
    )
    large = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "1000000"}  # buffers of large lines are given back when freed
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", call], cwd=root, env=large, timeout=1500.0, check=False)
    assert done.returncode == 0


def flooded(tmp_path: Path, count: int, largest: int) -> None:
    """Serve `count` hostile messages, `largest` of them oversized, and judge what is counted, stored and kept."""
    plain = tmp_path / "plain"
    plain.mkdir()
    served(settings_in(plain), LINES)
    wire = HostileWire(LINES.splitlines(), count, largest)
    more = '[[actuator]]\nname = "press 3"\n[page]\nport = 0\n'
    service = Service(settings_in(tmp_path, more), stdin=wire, stdout=io.StringIO())  # type: ignore[arg-type]
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        whole = count - wire.odd

        def settled() -> bool:
            return thread.is_alive() and sum(service.actuators.counters.values()) >= count - wire.odd > 0

        assert _eventually(lambda: len(wire.memory) == 2 and settled(), 1200.0), whole
        assert service.page is not None
        with urllib.request.urlopen(service.page.address + "metrics", timeout=10.0) as answer:
            text = answer.read().decode()
        with urllib.request.urlopen(service.page.address + "api/fleet", timeout=10.0) as answer:
            shown = json.load(answer)["counters"]
    finally:
        service.stop()
        thread.join()
    families = {family.name: family.samples for family in text_string_to_metric_families(text)}
    counted = {sample.labels["reason"]: sample.value for sample in families["sealscope_dropped_blocks"]}
    assert counted == dict(wire.sent) == shown
    assert set(counted) == {reason for reason, _ in FORGED} | {UNREADABLE, REPEATED, OVERSIZED}
    passed_over = {
        sample.labels["reason"]: sample.value
        for sample in families["sealscope_passed_over"]
        if sample.labels["actuator"] == "press 3"
    }
    assert {"late or repeated samples", "clock set back", "samples without p_B"} <= set(passed_over)
    assert len(passed_over) < 20
    before, after = wire.memory
    print(f"{count} messages: {(after - before) / 1e6:.1f} MB more after four fifths of them")
    assert after - before < 20_000_000 or count < 10_000  # a brief run does not stop
    ours, theirs = rows_of(service.settings.database), rows_of(str(plain / "monitor.db"))
    for table, rows in theirs.items():
        assert [row for row in ours[table] if "press 3" not in row] == rows, table
    assert sum("press 3" in row for row in ours["blocks"]) == wire.odd
