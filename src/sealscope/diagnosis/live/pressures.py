"""An actuator watched by both chamber pressures and the command, without a position.

The response of p_A - p_B to the command is estimated along with the machine (`diagnosis.inference.pressures.response`),
block by block, so that friction, stiffness and gain that change as the oil warms are not taken for a leak. Changes of
the conductance are stated, levels are not. After a pause, or where it has lost the machine, nothing before is compared
with what comes after.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.pressures.evidence import BELIEVED, flow_scale, states_flow, unusable
from sealscope.diagnosis.inference.pressures.response import LAWS, Follower, G, Machine, beliefs_of
from sealscope.diagnosis.live.balance import FOLLOWS, BlockConductance, NotJudged, Shown
from sealscope.errors import InputError
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import array_of, part_of, plain_array, recall, saved
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_BELIEVED = beliefs("live")["response"]
_SETTLING, _RESUMING, _PAUSE = _BELIEVED["settling"], _BELIEVED["resuming"], beliefs("live")["watch"]["pause"]
_SLOWEST, _READ = BELIEVED["blocks"]["slowest"], ("u", "p_A", "p_B")


class PressureEstimator:
    """Conductances by the response, block by block, as `LiveBalance` gives them by volumes.

    `rig`: what is believed of the machine; `names`: channels of the samples; `litres`: whether the rig states what
    turns a conductance into L/min. The conductance itself is not stated (`levels`), only its changes, to `size_error`;
    an orifice that shows as the same conductance passes `orifice` times what a laminar leak does, by which the upper
    end of an interval is wider; `inside`: share of what shows that is surely inside.
    """

    method, levels, cause = "pressures", False, "leak inside or outside"
    size_error, orifice = flow_scale(), BELIEVED["conductance"]["orifice"]
    inside: float = beliefs("live")["watch"]["inside"]
    block_seconds: float = _BELIEVED["seconds"]
    states_flow = staticmethod(states_flow)

    def __init__(self, rig: Rig, names: Sequence[str], litres: bool | None = None) -> None:
        self._rig, self.names = rig, tuple(names)
        self.litres = states_flow(rig) if litres is None else litres
        self._kept = np.empty((1 + len(self.names), 0))  # times and channels since the last whole block
        self._rate, self._until = 0.0, -math.inf
        self.begun = False  # once the machine moved for so long that its response was fitted
        self._follower: Follower | None = None
        self._next = math.nan  # clock at which the next block begins if it follows
        self._settling, self._lost = _SETTLING, 0

    def take(self, t: Array, samples: Mapping[str, Array], rate: float) -> list[Shown]:
        """Take samples that follow each other at the times `t` [s]; return what each block shows that they complete."""
        if rate != self._rate or not FOLLOWS[0] < (float(t[0]) - self._until) * rate < FOLLOWS[1]:
            self.interrupt()
        self._rate, self._until = rate, float(t[-1])
        kept = np.hstack([self._kept, [t, *(samples[name] for name in self.names)]])
        first, length = round(_BELIEVED["begins"] * rate), round(self.block_seconds * rate)
        shown: list[Shown] = []
        while not self.begun and kept.shape[1] >= first:
            self.begun = self._begin(self._recording(kept[:, :first]))
            if not self.begun:
                kept = kept[:, first // 2 :]
                reason = "half minutes at standstill or with missing values before the first block"
                shown.append(NotJudged(self._until, "", reason))
        while self.begun and kept.shape[1] >= length:
            block, kept = self._recording(kept[:, :length]), kept[:, length:]
            shown.append(self._shown(block))
        self._kept = kept.copy()
        return shown

    def _recording(self, rows: Array) -> Recording:
        t, *channels = rows
        units = {name: CHANNEL_UNITS[name] for name in self.names}
        return Recording(t, dict(zip(self.names, channels, strict=True)), units, self._rate)

    def interrupt(self) -> None:
        """Take the next samples as those after a gap, whatever their time is."""
        self._kept, self._until = self._kept[:, :0], -math.inf

    def _begin(self, first: Recording) -> bool:
        """Fit the response to the first minute; return whether the machine moves in it, and nothing is missing."""
        whole = all(np.isfinite(first[name]).all() for name in first.channels)
        if not (whole and all(name in first and moves(first[name]) for name in _READ)):
            return False
        if unusable(first, self._rig) is None:
            self._follower = Follower.begun(first.only(_READ), self._rig)
        return True

    def _shown(self, block: Recording) -> Shown:
        """Return what a block shows."""
        begin, end = float(block.t[0]), float(block.t[-1]) + 1.0 / block.rate
        if self._follower is None:
            slow = f"sampled at less than {_SLOWEST:g} Hz"
            return _passed_over(end, slow if block.rate < _SLOWEST else "needs a pump and two like areas")
        if not all(np.isfinite(block[name]).all() for name in _READ):
            return _passed_over(end, "missing values")
        apart = self._resume(self._follower, begin - self._next, block.rate)
        self._next = end
        own = self._follower.take(block.only(_READ))
        variance, follower = float(own.gram[0, 0]) / max(own.samples, 1.0), self._follower
        settling, self._settling = self._settling > 0, max(self._settling - 1, 0)
        described = bool(np.isfinite(follower.theta).all()) and follower.excess < _BELIEVED["described"]
        ratio = float(np.clip(max(variance, 1.0) / follower.variance, 0.1, 10.0)) if math.isfinite(variance) else 1.0
        follower.variance *= ratio ** (1.0 / (_BELIEVED["usual"] if described and not settling else _RESUMING))
        if not described:  # after some of them the machine is lost
            self._lost += 1
            if self._lost < _BELIEVED["lost"] and np.isfinite(follower.theta).all():
                self._settling = self._settling if settling else _RESUMING
                return _passed_over(end, "settling" if settling else "not described by the model", apart)
            follower.interrupt(math.inf)
            self._lost, self._settling = 0, _SETTLING
            return _passed_over(end, "not described by the model", True)
        self._lost = 0
        width = BELIEVED["response"]["G"][1]
        g, sd = float(follower.theta[G]), math.sqrt(follower.covariance[G, G]) * float(follower.beliefs.unit[G])
        if settling or sd > width:
            return _passed_over(end, "settling" if settling else "at standstill", apart)
        dp = float(np.mean(np.abs(block["p_A"] - block["p_B"])))
        sizes = np.log(np.maximum([dp, np.sqrt(np.mean(block["u"] ** 2))], np.finfo(float).tiny))
        duty = float(sizes[0]), float(sizes[1])
        return [BlockConductance(begin, end, g, sd, g, width, dp / LITRE_PER_MINUTE, duty)]

    def _resume(self, follower: Follower, gap: float, rate: float) -> bool:
        """Prepare for a block after a gap [s]; return whether nothing before may be compared with what comes."""
        if abs(gap) < 0.5 / rate:
            return False
        short = 0.0 < gap <= _PAUSE  # nan before the first block
        follower.interrupt(gap if short else math.inf)
        self._settling = max(self._settling, _RESUMING if short else _SETTLING)
        return not short

    def relearn(self) -> None:
        """Know the machine's parameters as little as at first."""
        if self._follower is not None:
            self._follower.interrupt(math.inf)

    def state(self) -> dict[str, Any]:
        """Return all of it but the rig as plain values."""
        state = saved(self, ("names", *_SAVED)) | {"pieces": [plain_array(self._kept)]}
        if (own := self._follower) is None:
            return state | {"follower": None}
        machine = {"rate": own.machine.rate, "law": own.machine.law, "sense": own.sense}
        return state | {"follower": saved(own, _FOLLOWED) | machine}

    def recall(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` with the same bits; raises InputError where it does not fit."""
        recall(self, _SAVED, state)
        pieces = [array_of(piece, "pieces") for piece in part_of(state, "pieces", list)]
        if any(piece.ndim != 2 or len(piece) != len(self._kept) for piece in pieces):
            raise InputError("saved state's pieces must have a row of times and one for each channel")
        self._kept = np.hstack([self._kept, *pieces])
        if (known := part_of(state, "follower", (Mapping, type(None)))) is None:
            return
        rate, sense = (float(part_of(known, name, (float, int))) for name in ("rate", "sense"))
        if not rate > 0.0:
            raise InputError(f"saved state's rate must be > 0 Hz, got {rate}")
        if (law := part_of(known, "law", str)) not in LAWS:
            raise InputError(f"saved state's law must be {' or '.join(LAWS)}, got {law!r}")
        self._follower = Follower(Machine.of(self._rig, rate, law), beliefs_of(self._rig, law), sense)
        recall(self._follower, _FOLLOWED, known)


_SAVED = ("litres", "begun", "_rate", "_until", "_next", "_settling", "_lost")
_FOLLOWED = ("theta", "covariance", "states", "variance", "last")


def _passed_over(end: float, status: str, apart: bool = False) -> NotJudged:
    return NotJudged(end, status, f"blocks: {status}", apart)
