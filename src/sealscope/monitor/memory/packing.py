"""Samples as bytes, for a restart to go through once more."""

from __future__ import annotations

import json
from functools import lru_cache

import numpy as np

from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording


def packed(samples: Recording, follows: bool) -> bytes:
    """Return samples as one line of JSON and their numbers, little endian; of an even clock the first time alone."""
    even = np.array_equal(samples.t, _even(samples.t[:1], len(samples), samples.rate))
    columns = (samples.t[:1] if even else samples.t, *samples.channels.values())
    parts = [np.ascontiguousarray(column, dtype="<f8").data for column in columns]
    return b"".join([_head(tuple(samples.units.items()), samples.rate, len(samples), follows), *parts])


@lru_cache(maxsize=64)
def _head(units: tuple[tuple[str, str], ...], rate: float, n: int, follows: bool) -> bytes:
    other = {name: unit for name, unit in units if unit != CHANNEL_UNITS.get(name)}
    head = {"names": [name for name, _ in units], "rate": rate, "n": n, "follows": follows, "units": other}
    return json.dumps(head).encode() + b"\n"


def unpacked_samples(data: bytes) -> tuple[Recording, bool]:
    """Return the samples that `packed` made bytes of, and whether they follow those before."""
    line, _, numbers = data.partition(b"\n")
    head = json.loads(line)
    values = np.frombuffer(numbers, dtype="<f8")
    size, count = head["n"], len(head["names"])
    channels = values[values.size - size * count :].reshape(count, size)
    t = values[: -channels.size or None]
    t = t if t.size == size else _even(t, size, head["rate"])
    units = {name: head["units"].get(name) or CHANNEL_UNITS[name] for name in head["names"]}
    return Recording(t, dict(zip(head["names"], channels, strict=True)), units, head["rate"]), head["follows"]


def _even(first: Array, n: int, rate: float) -> Array:
    """Return n times that begin with the only one of `first`, as those of a message do."""
    with np.errstate(over="ignore"):
        return np.asarray(first + _elapsed(n, rate))


@lru_cache(maxsize=4)
def _elapsed(n: int, rate: float) -> Array:
    return np.arange(n) / rate
