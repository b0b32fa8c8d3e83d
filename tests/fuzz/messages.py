"""Hostile messages of the monitor: JSON, CBOR, and Sparkplug B, each decoder as the monitor has it for days.

A message is refused for one of the reasons that are foreseen: the guard against all others must have nothing to do.
"""

from __future__ import annotations

import json
import random
from copy import deepcopy
from pathlib import Path
from typing import Any

import cbor2
import numpy as np

from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.source_block import UNFORESEEN, RefusedMessage, decoded
from sealscope.monitor.sources.sparkplug_host import SparkplugHost
from sealscope.monitor.sparkplug import (
    BIRTH_SEQUENCE,
    BOOLEAN,
    DOUBLE,
    INT64,
    STRING,
    UINT64,
    SparkplugMetric,
    SparkplugPayload,
    encoded,
)

from .mutations import change_tree, changed_bytes
from .targets import Use, taken

SAMPLES = [0.001 * k for k in range(20)]
VALID: dict[str, Any] = {
    "actuator": "press 1",
    "t": 1.0,
    "rate": 50.0,
    "id": "block 7",
    "units": {"p_A": "bar", "T_oil": "degC"},
    "T_oil": 41.5,
    **dict.fromkeys(("p_A", "p_B", "x", "theta"), SAMPLES),
}
KINDS = ("NBIRTH", "DBIRTH", "NDATA", "DDATA", "NDEATH", "DDEATH", "NCMD", "STATE")


def deep(draw: random.Random) -> Any:
    """A value that is deep, huge or of a kind that JSON has not."""
    kind, value = draw.randrange(6), 1
    if kind < 3:
        nested: Any = value
        for _ in range(draw.choice((2, 30, 100, 250))):
            nested = [nested] if kind == 0 else {"p_A": nested} if kind == 1 else [0, nested]
        return nested
    if kind == 3:
        return draw.choice((7**600, -(2**70), 1e308, float("nan"), float("-inf")))
    if kind == 4:
        return cbor2.CBORTag(draw.choice((2, 4, 30, 64, 81, 82, 85, 86, 258)), draw.choice((b"\x00" * 12, [1, 2], "a")))
    return draw.choice((b"bytes", None, True, "\ud800", "\0", cbor2.undefined, [[1.0], [2.0]], ["nan"] * 20))


def _refused(error: RefusedMessage) -> None:
    assert error.reason != UNFORESEEN, str(error)
    raise error


def messages(folder: Path) -> Use:
    """JSON and CBOR."""

    def use(draw: random.Random) -> bool:
        tree = deepcopy(VALID)
        change_tree(tree, draw)
        if draw.random() < 0.5:
            tree[draw.choice([*VALID, "no such"])] = deep(draw)
        try:
            whole = cbor2.dumps(tree) if draw.random() < 0.5 else json.dumps(tree, default=str).encode()
        except Exception:  # what cannot be written is no message
            whole = cbor2.dumps(VALID)
        message = changed_bytes(whole, draw) if whole and draw.random() < 0.3 else whole

        def work() -> None:
            try:
                decoded(message, draw.choice((None, "press 1")))
            except RefusedMessage as error:
                _refused(error)

        return taken(work)

    return use


def metric(draw: random.Random) -> SparkplugMetric:
    """A metric of a known name whose value is of any type."""
    name = draw.choice((BIRTH_SEQUENCE, "p_A", "p_B [bar]", "rate", "T_oil", "x", None, "", "no such"))
    kind, value = draw.choice(
        (
            (DOUBLE, draw.choice((1.0, float("nan"), float("inf"), -1e308))),
            (INT64, draw.choice((0, 1, 3, -(2**40)))),
            (UINT64, 2**64 - 1),
            (STRING, draw.choice(("", "3", "a" * 1000))),
            (BOOLEAN, True),
            (31, np.arange(float(draw.choice((0, 1, 20))))),
            (25, np.arange(20)),
            (DOUBLE, None),
        )
    )
    at = draw.choice((None, 0, 1_700_000_000_000, 2**63, 2**64 - 1))
    unit = draw.choice((None, "bar", "furlong", "degC", ""))
    return SparkplugMetric(name, value, kind, draw.choice((None, 0, 1, 2**64 - 1)), at, unit)


def sparkplug(folder: Path) -> Use:
    """Sparkplug B, by a host that keeps what it has heard: births, data and deaths in any order."""
    edges = [("g/n", "edge"), ("g/n/d", "device"), ("g/m", "other")]
    heard = [
        ActuatorSettings(name=name, sparkplug=path, rate=50.0 if name != "other" else None) for path, name in edges
    ]
    host = SparkplugHost(heard, lambda *_: None, lambda _: None)

    def use(draw: random.Random) -> bool:
        metrics = tuple(metric(draw) for _ in range(draw.choice((0, 1, 1, 2, 5))))
        payload = SparkplugPayload(draw.choice((None, 1, 2**63)), metrics, draw.choice((None, 0, 1, 255, 256, 2**40)))
        whole = encoded(payload)
        message = changed_bytes(whole, draw) if whole and draw.random() < 0.3 else whole
        kind = draw.choice(KINDS)
        place = draw.choice(
            (f"g/{kind}/n", f"g/{kind}/n/d", f"g/{kind}/m", f"{kind}", f"g/{kind}/n/d/e", f"g/{kind}/z")
        )

        def work() -> None:
            try:
                host.taken(f"spBv1.0/{place}", message)
            except RefusedMessage as error:
                _refused(error)

        return taken(work)

    return use


MESSAGES = {"monitor messages": messages, "Sparkplug messages": sparkplug}
