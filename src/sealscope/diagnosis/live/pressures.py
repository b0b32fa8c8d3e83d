"""An actuator watched by both chamber pressures and the command, without a position.

The response of p_A - p_B to the command is estimated along with the machine (`diagnosis.inference.pressures.response`),
block by block, so that friction, stiffness and gain that change as the oil warms are not taken for a leak. Changes of
the conductance are stated, levels are not. After a pause, or where it has lost the machine, nothing before is compared
with what comes after.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.inference.pressures.evidence import PRIORS, flow_scale, states_flow, unusable
from sealscope.diagnosis.inference.pressures.response import LAWS, Follower, G, Machine, priors_of
from sealscope.diagnosis.live.balance import BlockConductance, NotJudged, Shown
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.priors import priors
from sealscope.errors import InputError
from sealscope.recordings.motion import does_not_move, find_holds, moves
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import part_of, recall, saved
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRIORS = priors("live")["response"]
_SETTLING, _RESUMING, _PAUSE = _PRIORS["settling"], _PRIORS["resuming"], priors("live")["watch"]["pause"]
_SLOWEST, _READ = PRIORS["blocks"]["slowest"], ("p_A", "p_B", "u")
#: Rows of what is kept that are pressures, after the times.
_PRESSURES = (1, 2)


class PressureEstimator:
    """Conductances by the response, block by block, as `LiveBalance` gives them by volumes.

    `rig`: what is believed of the machine; `litres`: whether it states what turns a conductance into L/min. The
    conductance itself is not stated (`levels`), only its changes, to `size_error`; an orifice that shows as the same
    conductance passes `orifice` times what a laminar leak does, by which the upper end of an interval is wider;
    `inside`: share of what shows that is surely inside.
    """

    method, levels, cause = "pressures", False, "leak inside or outside"
    size_error, orifice = flow_scale(), PRIORS["conductance"]["orifice"]
    inside: float = priors("live")["watch"]["inside"]
    block_seconds: float = _PRIORS["seconds"]
    states_flow = staticmethod(states_flow)

    def __init__(self, rig: Rig, litres: bool | None = None) -> None:
        self._rig = rig
        self.litres = states_flow(rig) if litres is None else litres
        self._kept = np.empty((1 + len(_READ), 0))  # times and channels since the last whole block
        self._follower: Follower | None = None
        self._held = np.full(len(_PRESSURES), math.nan)  # values that the pressures hold since the last block
        self._end = math.nan  # of the last block that was followed [s]
        self._settling, self._lost = _SETTLING, 0

    @property
    def begun(self) -> bool:
        """True once the machine moved long enough for its response to be fitted."""
        return self._follower is not None

    def take(self, run: SampleRun) -> list[Shown]:
        """Take the next samples; return the result of each block they complete."""
        before = self._kept if run.follows else self._kept[:, :0]
        if not run.follows:
            self._held[:] = math.nan
        kept = np.hstack([before, [run.t, *(run.channels[name] for name in _READ)]])
        first, length = (round(seconds * run.rate) for seconds in (_PRIORS["begins"], self.block_seconds))
        results: list[Shown] = []
        while self._follower is None and run.rate >= _SLOWEST and kept.shape[1] >= first:
            beginning = _recording(kept[:, :first], run.rate)
            if reason := unusable(beginning, self._rig) or does_not_move(beginning):
                kept = kept[:, first // 2 :]
                results.append(NotJudged(float(run.t[-1]), "", f"half minutes before the first block: {reason}"))
            else:
                self._follower = Follower.fit_start(beginning, self._rig)
        while (self._follower is not None or run.rate < _SLOWEST) and kept.shape[1] >= length:
            holds = [find_holds(kept[k], run.rate, self._held[k - 1]) for k in _PRESSURES]
            if min(hold.open for hold in holds) < length:  # a hold may go on
                break
            for k, hold in zip(_PRESSURES, holds, strict=True):
                self._held[k - 1] = kept[k, length - 1] if hold.flags[length - 1] else math.nan
                kept[k, :length][hold.flags[:length]] = math.nan
            block, kept = _recording(kept[:, :length], run.rate), kept[:, length:]
            results.append(self._estimate_block(block))
        self._kept = kept.copy()
        return results

    def _estimate_block(self, block: Recording) -> Shown:
        """Return the conductance of a block, or the reason why it is not judged."""
        begin, end = float(block.t[0]), float(block.t[-1]) + 1.0 / block.rate
        if self._follower is None or block.rate < _SLOWEST:
            return _passed_over(end, f"sampled at less than {_SLOWEST:g} Hz")
        if not all(np.isfinite(block[name]).all() for name in _READ):
            return _passed_over(end, "missing values")
        interrupted = self._resume(begin - self._end, block.rate)
        follower = self._follower
        self._end = end
        sums = follower.take(block)
        variance = float(sums.gram[0, 0]) / max(sums.samples, 1.0)
        settling, self._settling = self._settling > 0, max(self._settling - 1, 0)
        described = bool(np.isfinite(follower.theta).all()) and follower.excess < _PRIORS["described"]
        ratio = float(np.clip(max(variance, 1.0) / follower.variance, 0.1, 10.0)) if math.isfinite(variance) else 1.0
        follower.variance *= ratio ** (1.0 / (_PRIORS["usual"] if described and not settling else _RESUMING))
        if not described:  # after some of them the machine is lost
            self._lost += 1
            if self._lost < _PRIORS["lost"] and np.isfinite(follower.theta).all():
                self._settling = self._settling if settling else _RESUMING
                return _passed_over(end, "settling" if settling else "not described by the model", interrupted)
            follower.interrupt(math.inf)
            self._lost, self._settling = 0, _SETTLING
            return _passed_over(end, "not described by the model", True)
        self._lost = 0
        width = PRIORS["response"]["G"][1]
        g, sd = float(follower.theta[G]), math.sqrt(follower.covariance[G, G]) * float(follower.priors.unit[G])
        if settling:
            return _passed_over(end, "settling", interrupted)
        if sd > width:
            return _passed_over(end, "conductance not resolved" if moves(block["u"]) else "at standstill", interrupted)
        dp = float(np.mean(np.abs(block["p_A"] - block["p_B"])))
        sizes = np.log(np.maximum([dp, np.sqrt(np.mean(block["u"] ** 2))], np.finfo(float).tiny))
        duty = float(sizes[0]), float(sizes[1])
        return [BlockConductance(begin, end, g, sd, g, width, dp / LITRE_PER_MINUTE, duty)]

    def _resume(self, gap: float, rate: float) -> bool:
        """Prepare for a block after a gap [s]; return True if it must not be compared with any before.

        What is known of the machine stays at another rate, but may lie elsewhere among the likely parameters there.
        """
        assert self._follower is not None
        anew = self._follower.machine.rate != rate
        if anew:
            self._follower = self._follower.at_rate(self._rig, rate)
        elif abs(gap) < 0.5 / rate:
            return False
        short = -1.0 / rate <= gap <= _PAUSE  # nan before the first block
        self._follower.interrupt(max(gap, 0.0) if short else math.inf)
        self._settling = max(self._settling, _RESUMING if short else _SETTLING)
        return anew or not short

    def relearn(self) -> None:
        """Forget the machine's parameters: know as little as at first."""
        if self._follower is not None:
            self._follower.interrupt(math.inf)

    def state(self) -> dict[str, Any]:
        """Return the state without the rig as plain values."""
        state = saved(self, _SAVED)
        if (follower := self._follower) is None:
            return state | {"follower": None}
        machine = {"rate": follower.machine.rate, "law": follower.machine.law, "sense": follower.sense}
        return state | {"follower": saved(follower, _FOLLOWED) | machine}

    def recall(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` with the same bits; raises InputError where it does not fit."""
        recall(self, _SAVED, state)
        if (known := part_of(state, "follower", (Mapping, type(None)))) is None:
            return
        rate, sense = (float(part_of(known, name, (float, int))) for name in ("rate", "sense"))
        if not rate > 0.0:
            raise InputError(f"saved state's rate must be > 0 Hz, got {rate}")
        if (law := part_of(known, "law", str)) not in LAWS:
            raise InputError(f"saved state's law must be {' or '.join(LAWS)}, got {law!r}")
        self._follower = Follower(Machine.from_rig(self._rig, rate, law), priors_of(self._rig, law), sense)
        recall(self._follower, _FOLLOWED, known)


_SAVED = ("litres", "_kept", "_held", "_end", "_settling", "_lost")
_FOLLOWED = ("theta", "covariance", "states", "variance", "last")


def _recording(rows: Array, rate: float) -> Recording:
    t, *channels = rows
    return Recording(t, dict(zip(_READ, channels, strict=True)), {name: CHANNEL_UNITS[name] for name in _READ}, rate)


def _passed_over(end: float, status: str, interrupted: bool = False) -> NotJudged:
    return NotJudged(end, status, f"blocks: {status}", interrupted)
