"""An actuator watched by both chamber pressures and the command, without a position.

The response of p_A - p_B to the command is led along with the machine (`diagnosis.inference.pressures.response`), a
block after the other: friction, stiffness and gain of the machine are among its parameters, so that what changes in
them as the oil warms is not taken for a leak. Each block gives a conductance of its own. Its level is not known well,
so that changes are stated and levels are not.

After a gap it goes on with what it knew of the machine. After a pause, or where it has lost the machine, parameters are
as little known as at first, and nothing before is compared with what comes after.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.inference.live.balance import BlockConductance, NotJudged, Shown
from sealscope.diagnosis.inference.pressures.evidence import SLOWEST, flow_scale, priors, states_flow, unusable
from sealscope.diagnosis.inference.pressures.response import Beliefs, Follower, G, Machine
from sealscope.errors import InputError
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import array_of, part_of, plain_array
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Length of a block [s]; it goes on after a gap up to a pause [s].
BLOCK_SECONDS, PAUSE_S = 6.0, 300.0
#: What is read.
CHANNELS = ("u", "p_A", "p_B")
#: Blocks that are left out until the states have settled: after the start, and after a gap.
_SETTLING, _RESUMING = 10, 3
#: Excess of a block's chi square, in deviations, from which on it is not described, and how many lose the machine.
_DESCRIBED, _LOST = 6.0, 10
#: Blocks over which the usual variance is taken; over those of resuming while it is being found.
_USUAL = 60
#: Arrays of a follower that change, and those of its beliefs.
_ARRAYS = ("theta", "covariance", "states", "beliefs")


class PressureEstimator:
    """Conductances by the response, block by block.

    `rig`: what is believed of the machine; `litres`: whether it states what turns a conductance into L/min. The
    conductance itself is not stated (`levels`), only its changes, to `size_error`; an orifice that shows as the same
    conductance passes `orifice` times what a laminar leak does, by which the upper end of an interval is wider.
    """

    levels, size_error, orifice = False, flow_scale(), priors("ring_down")["orifice"].value

    def __init__(self, rig: Rig, litres: bool) -> None:
        self._rig, self.litres = rig, litres
        self._follower: Follower | None = None
        self._next = math.nan  # clock at which the next block begins if it follows
        self._settling, self._lost = _SETTLING, 0

    @classmethod
    def of(cls, rig: Rig) -> PressureEstimator:
        """Return the estimator of a machine of the rig's kind."""
        return cls(rig, states_flow(rig))

    def seconds_of(self, first: Recording) -> float | None:
        """Return the length of a block [s], having fitted the first minute; None where nothing moves."""
        if not all(name in first and moves(first[name]) for name in CHANNELS):
            return None
        if unusable(first, self._rig) is None:
            self._follower = Follower.begun(first.only(CHANNELS), self._rig)
        return BLOCK_SECONDS

    def take(self, block: Recording) -> Shown:
        """Return what a block shows."""
        begin, end = float(block.t[0]), float(block.t[-1]) + 1.0 / block.rate
        if self._follower is None:
            slow = block.rate < SLOWEST
            return _passed_over(
                end, f"sampled at less than {SLOWEST:g} Hz" if slow else "needs a pump and two like areas"
            )
        if not all(np.isfinite(block[name]).all() for name in CHANNELS):
            return _passed_over(end, "missing values")
        apart = self._resume(begin - self._next, block.rate)
        self._next = end
        own = self._follower.take(block.only(CHANNELS))
        variance, follower = own.squares / max(own.samples, 1.0), self._follower
        settling, self._settling = self._settling > 0, max(self._settling - 1, 0)
        described = bool(np.isfinite(follower.theta).all()) and follower.excess < _DESCRIBED
        ratio = float(np.clip(max(variance, 1.0) / follower.variance, 0.1, 10.0)) if math.isfinite(variance) else 1.0
        follower.variance *= ratio ** (1.0 / (_USUAL if described and not settling else _RESUMING))
        if not described:
            return self._not_described(end, apart, settling)
        self._lost = 0
        if settling:
            return _passed_over(end, "settling", apart)
        width = priors("response")["G"].width
        g, sd = float(follower.theta[G]), math.sqrt(follower.covariance[G, G]) * float(follower.beliefs.unit[G])
        if sd > width:
            return _passed_over(end, "at rest", apart)
        dp = float(np.mean(np.abs(block["p_A"] - block["p_B"])))
        sizes = np.log(np.maximum([dp, np.sqrt(np.mean(block["u"] ** 2))], np.finfo(float).tiny))
        duty = float(sizes[0]), float(sizes[1])
        return [BlockConductance(begin, end, g, sd, g, width, dp / LITRE_PER_MINUTE, duty)]

    def _resume(self, gap: float, rate: float) -> bool:
        """Prepare for a block after a gap [s]; return whether nothing before may be compared with what comes."""
        assert self._follower is not None
        if abs(gap) < 0.5 / rate:
            return False
        first = math.isnan(self._next)
        self._follower.interrupt(gap if 0.0 < gap <= PAUSE_S else math.inf)
        known = not first and 0.0 < gap <= PAUSE_S
        self._settling = max(self._settling, _RESUMING if known else _SETTLING)
        return not known

    def _not_described(self, end: float, apart: bool, settling: bool) -> NotJudged:
        """Count a block that the response does not describe; after some of them the machine is lost."""
        assert self._follower is not None
        self._lost += 1
        if self._lost < _LOST and np.isfinite(self._follower.theta).all():
            self._settling = self._settling if settling else _RESUMING
            return _passed_over(end, "settling" if settling else "not described by the model", apart)
        self._follower.interrupt(math.inf)
        self._lost, self._settling = 0, _SETTLING
        return _passed_over(end, "not described by the model", True)

    def relearn(self) -> None:
        """Know the machine's parameters as little as at first."""
        if self._follower is not None:
            self._follower.interrupt(math.inf)

    def state(self) -> dict[str, Any]:
        """Return all of it but the rig as plain values."""
        follower = self._follower
        return {
            "litres": self.litres,
            "next": None if math.isnan(self._next) else self._next,
            "settling": self._settling,
            "lost": self._lost,
            "follower": None
            if follower is None
            else {
                "rate": follower.machine.rate,
                "sense": follower.sense,
                "variance": follower.variance,
                "last": None if math.isnan(follower.last) else follower.last,
                "theta": plain_array(follower.theta),
                "covariance": plain_array(follower.covariance),
                "states": plain_array(follower.states),
                "beliefs": plain_array(np.array(follower.beliefs)),
            },
        }

    @classmethod
    def from_state(cls, rig: Rig, state: Mapping[str, Any]) -> PressureEstimator:
        """Return the estimator that `state` was of; raises InputError where it does not fit."""
        estimator = cls(rig, bool(part_of(state, "litres", bool)))
        after = part_of(state, "next", (float, int, type(None)))
        estimator._next = math.nan if after is None else float(after)
        estimator._settling, estimator._lost = (int(part_of(state, name, int)) for name in ("settling", "lost"))
        saved = part_of(state, "follower", (Mapping, type(None)))
        if saved is None:
            return estimator
        theta, covariance, states, beliefs = (array_of(part_of(saved, name, Mapping), name) for name in _ARRAYS)
        rate, sense, variance = (float(part_of(saved, name, (float, int))) for name in ("rate", "sense", "variance"))
        last = part_of(saved, "last", (float, int, type(None)))
        size = theta.size
        if beliefs.shape != (3, size) or covariance.shape != (size, size) or states.ndim != 2 or not rate > 0.0:
            raise InputError("saved state's arrays of the response do not fit each other")
        follower = Follower(Machine.of(rig, rate), Beliefs(*beliefs), sense)
        if follower.theta.size != size or follower.states.shape != states.shape:
            raise InputError(f"saved state's theta must have {follower.theta.size} numbers, got {size}")
        follower.theta, follower.covariance, follower.states, follower.variance = theta, covariance, states, variance
        follower.last = math.nan if last is None else float(last)
        estimator._follower = follower
        return estimator


def _passed_over(end: float, status: str, apart: bool = False) -> NotJudged:
    return NotJudged(end, status, f"blocks: {status}", apart)
