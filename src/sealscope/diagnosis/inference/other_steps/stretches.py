"""Stretches of a recording, whole cycles of the duty each, and what a number read of each of them says of a step.

A machine that starts fills its lines and warms: what its readings do as exp(-t/tau) is no step, and is projected out.
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.terms import priors
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Array, Recording


def stretch_samples(recording: Recording, count: int) -> int:
    """Return the samples of one of about `count` stretches, whole cycles of the duty where it has any."""
    length, cycle = len(recording) // count, find_cycle(recording)
    if cycle is None:
        return length
    samples = cycle * recording.rate
    return round(max(1, round(length / samples)) * samples)


def readings(time: Array, values: Array, wander: float = np.inf) -> Information:
    """Return what readings (K,) at times (K,) say, however the machine settled at first.

    `wander`: scale of the walk and deviation of the slope that are believed.
    """
    constants = [priors()["features"][name].value for name in ("settles", "starts")]
    settling = np.linalg.qr(np.exp(-(time - time[0])[:, None] / constants))[0]
    free = np.eye(len(time)) - settling @ settling.T
    return Information(time, free, free @ values, slope=wander, walk=wander)
