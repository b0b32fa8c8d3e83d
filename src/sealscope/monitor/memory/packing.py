"""Samples as bytes, for a restart to go through once more."""

from __future__ import annotations

import json

import numpy as np

from sealscope.recordings.recording import CHANNEL_UNITS, Recording


def packed(samples: Recording, follows: bool) -> bytes:
    """Return samples as one line of JSON and their numbers, little endian."""
    names = list(samples.channels)
    units = {name: unit for name, unit in samples.units.items() if unit != CHANNEL_UNITS.get(name)}
    head = {"names": names, "rate": samples.rate, "n": len(samples), "follows": follows, "units": units}
    numbers = np.concatenate([samples.t, *(samples[name] for name in names)]).astype("<f8")
    return json.dumps(head).encode() + b"\n" + numbers.tobytes()


def unpacked_samples(data: bytes) -> tuple[Recording, bool]:
    """Return the samples that `packed` made bytes of, and whether they follow those before."""
    line, _, numbers = data.partition(b"\n")
    head = json.loads(line)
    values = np.frombuffer(numbers, dtype="<f8").reshape(1 + len(head["names"]), head["n"])
    units = {name: head["units"].get(name) or CHANNEL_UNITS[name] for name in head["names"]}
    return Recording(values[0], dict(zip(head["names"], values[1:], strict=True)), units, head["rate"]), head["follows"]
