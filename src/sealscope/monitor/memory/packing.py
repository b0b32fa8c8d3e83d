"""Samples as bytes, for a restart to go through once more."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording


def packed(samples: Recording, follows: bool) -> bytes:
    """Return samples as one line of JSON and their numbers, little endian; of an even clock the first time alone."""
    names = list(samples.channels)
    units = {name: unit for name, unit in samples.units.items() if unit != CHANNEL_UNITS.get(name)}
    head = {"names": names, "rate": samples.rate, "n": len(samples), "follows": follows, "units": units}
    columns = [samples[name] for name in names]
    first = samples.t[:1] if np.array_equal(samples.t, _even(samples.t[:1], head)) else samples.t
    parts = [np.ascontiguousarray(column, dtype="<f8").data for column in (first, *columns)]
    return b"".join([json.dumps(head).encode(), b"\n", *parts])


def unpacked_samples(data: bytes) -> tuple[Recording, bool]:
    """Return the samples that `packed` made bytes of, and whether they follow those before."""
    line, _, numbers = data.partition(b"\n")
    head = json.loads(line)
    values = np.frombuffer(numbers, dtype="<f8")
    size, count = head["n"], len(head["names"])
    channels = values[values.size - size * count :].reshape(count, size)
    t = values[: -channels.size or None]
    t = t if t.size == size else _even(t, head)
    units = {name: head["units"].get(name) or CHANNEL_UNITS[name] for name in head["names"]}
    return Recording(t, dict(zip(head["names"], channels, strict=True)), units, head["rate"]), head["follows"]


def _even(first: Array, head: dict[str, Any]) -> Array:
    """Return the times that begin with the only one of `first`, as those of a message do."""
    with np.errstate(over="ignore"):
        return np.asarray(first + np.arange(head["n"]) / head["rate"])
