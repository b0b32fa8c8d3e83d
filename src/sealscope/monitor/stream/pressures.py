"""An actuator watched by both chamber pressures and the command (or the pump's speed), without a position.

The observer runs along with the machine (`diagnosis.observer`): friction, stiffness and gain of the machine are among
its states, so that what changes in them as the oil warms is not taken for a leak. Each block gives a conductance of its
own. Its level is known to some 0.75 `G_UNIT` only, so that changes are stated and levels are not.

The observer's oil is neither lost nor gained, so that the mean of both pressures stays. A machine's does not: oil
warms, accumulators give way. What a block's mean has beyond that of the first one is taken from both pressures.

After a gap the observer goes on with what it knew of the machine; after a pause, or where it has lost the machine, it
searches the oil's stiffness anew, and nothing before is compared with what comes after.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.inference.live.balance import BlockConductance, NotJudged, Shown
from sealscope.diagnosis.observer.detector import SLOWEST, block_length
from sealscope.diagnosis.observer.estimates import Estimates
from sealscope.diagnosis.observer.evidence import SIZE_ERROR, described, states_flow
from sealscope.diagnosis.observer.model import G_UNIT, assume
from sealscope.diagnosis.observer.stream import Formulation, ObserverStream
from sealscope.physics.rig import CHOICES, LAWS, NUMBERS, RigNumbers
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Array, Recording
from sealscope.storage.plain_state import array_of, part_of, plain_array
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: The observer goes on after a gap up to this [s].
PAUSE_S = 300.0
#: What moves the machine, in the order of preference: an encoder's steps are noise in the speed.
DRIVES = ("u", "omega", "theta")
#: Deviation of the level of all conductances [m^3/(s Pa)].
_LEVEL_SD = 0.75 * G_UNIT
#: Deviation of a block's conductance beyond which the machine hardly moves, in `G_UNIT`.
_AT_REST = 3.0
#: Blocks that are left out until the slow parameters have settled: after the start, and after a gap.
_SETTLING, _RESUMING = 60, 3
#: Successive blocks that the model does not describe, after which the observer begins anew.
_LOST = 10
#: Deviations are within this factor of the usual one.
_EVEN = 3.0


class PressureEstimator:
    """Conductances by the observer, block by block.

    `a`: the assumed machine; `litres`: whether its rig states what turns a conductance into L/min. The conductance
    itself is not stated (`levels`), only its changes, to `size_error`; an orifice that shows as the same conductance
    passes `orifice` times what a laminar leak does, by which the upper end of an interval is wider.
    """

    levels, size_error, orifice = False, SIZE_ERROR["command"], 2.0

    def __init__(self, a: RigNumbers, litres: bool) -> None:
        self._a, self.litres = a, litres
        self._drive = ""
        self._seconds = 0.0
        self._stream: ObserverStream | None = None
        self._known: Array | None = None  # parameters of the last block that the model described
        self._mean = float("nan")  # mean of both pressures when the observer began
        self._next = float("nan")  # clock at which the next block begins if it follows
        self._settling, self._lost = 0, 0
        self._usual = 0.0  # deviation of a block's conductance

    @classmethod
    def of(cls, rig: Rig) -> PressureEstimator:
        """Return the estimator of a machine of the rig's kind."""
        return cls(assume(rig), states_flow("command", rig))

    def seconds_of(self, first: Recording) -> float | None:
        """Return the length of a block [s], None where nothing moves."""
        drives = [name for name in DRIVES if name in first and moves(first[name])]
        if not drives or not all(moves(first[name]) for name in CHAMBERS):
            return None
        self._drive = drives[0]
        self._seconds = block_length(find_cycle(first.only((*CHAMBERS, self._drive))))
        return self._seconds

    @property
    def _formulation(self) -> Formulation:
        return "command" if self._drive == "u" else "speed"

    def take(self, block: Recording) -> Shown:
        """Return what a block shows."""
        end = float(block.t[-1]) + 1.0 / block.rate
        if self._a.valved:
            return _passed_over(end, "behind a servo valve a position is needed")
        slowest = SLOWEST[self._formulation]
        if block.rate < slowest:
            return _passed_over(end, f"sampled at less than {slowest:g} Hz")
        samples = block.only((*CHAMBERS, self._drive))
        if not all(np.isfinite(samples[name]).all() for name in samples.channels):
            return _passed_over(end, "missing values")
        begun, apart = self._follow(float(block.t[0]), block.rate)
        self._next = end
        assert self._stream is not None
        samples = self._levelled(samples, apart)
        if begun:  # the first sample only sets the observer's states
            channels = {name: np.append(samples[name][:1], samples[name]) for name in samples.channels}
            before = samples.t[0] - 1.0 / block.rate
            samples = Recording(np.append(before, samples.t), channels, samples.units, block.rate)
        with np.errstate(all="ignore"):  # a filter that diverges is begun anew
            self._stream.update(samples)
        rows = self._stream.drained()
        if rows.G.size == 0:
            return _passed_over(end, "settling", apart)
        self._settling -= rows.G.size
        if not described(rows, self._formulation)[-1]:
            return self._not_described(end, rows)
        self._lost = 0
        if self._settling >= 0:
            return _passed_over(end, "settling", apart)
        self._known = rows.parameters[-1].copy()
        if rows.sd[-1] > _AT_REST:
            return _passed_over(end, "at rest")
        return [self._shown(rows, samples)]

    def _follow(self, begins: float, rate: float) -> tuple[bool, bool]:
        """Prepare the observer for a block that begins at this clock [s].

        Return whether it begins with this block, and whether nothing before may be compared with what comes.
        """
        gap = begins - self._next
        if self._stream is not None and abs(gap) < 0.5 / rate:
            return False, False
        if self._stream is not None and self._stream.begun and 0.0 < gap <= PAUSE_S:
            self._stream.resume(gap)
            self._settling = max(self._settling, _RESUMING)
            return True, False
        self._stream = ObserverStream(self._a, (*CHAMBERS, self._drive), rate, self._seconds, self._known)
        self._settling, self._lost = _SETTLING, 0
        return True, True

    def _levelled(self, samples: Recording, apart: bool) -> Recording:
        """Return samples whose pressures have the mean of the beginning, which is this block's where it is `apart`."""
        mean = float(np.mean([samples[name] for name in CHAMBERS]))
        if apart:
            self._mean = mean
        channels = {name: samples[name] - (mean - self._mean) * (name in CHAMBERS) for name in samples.channels}
        return Recording(samples.t, channels, samples.units, samples.rate)

    def _not_described(self, end: float, rows: Estimates) -> NotJudged:
        """Count a block that the model does not describe; after some of them, or where it diverged, begin anew."""
        self._lost += 1
        if self._lost < _LOST and np.isfinite(rows.parameters[-1]).all():
            return _passed_over(end, "settling" if self._settling >= 0 else "not described by the model")
        self._stream = None
        return _passed_over(end, "not described by the model", True)

    def _shown(self, rows: Estimates, samples: Recording) -> BlockConductance:
        driven = samples[self._drive]
        if self._drive == "theta":
            driven = np.diff(driven) * samples.rate
        dp = float(rows.dp[-1])
        pressure, drive = np.log(np.maximum([dp, np.sqrt(np.mean(driven**2))], np.finfo(float).tiny))
        g, sd = (G_UNIT * float(values[-1]) for values in (rows.G, rows.sd))
        self._usual = self._usual or sd
        sd = min(max(sd, self._usual / _EVEN), self._usual * _EVEN)  # a single block shall not count for many
        self._usual *= (sd / self._usual) ** (1.0 / _SETTLING)
        begin, end = float(samples.t[0]), float(samples.t[-1]) + 1.0 / samples.rate
        return BlockConductance(begin, end, g, sd, g, _LEVEL_SD, dp / LITRE_PER_MINUTE, (float(pressure), float(drive)))

    def relearn(self) -> None:
        """Search the machine's stiffness again."""
        self._stream, self._known = None, None

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        stream = self._stream
        numbers = {name: list(value) if name in LAWS else value for name, value in self._a._asdict().items()}
        return {
            "machine": numbers,
            "litres": self.litres,
            "drive": self._drive,
            "seconds": self._seconds,
            "known": None if self._known is None else plain_array(self._known),
            "mean": None if np.isnan(self._mean) else self._mean,
            "next": None if np.isnan(self._next) else self._next,
            "settling": self._settling,
            "lost": self._lost,
            "usual": self._usual,
            "rate": None if stream is None else stream.rate,
            "observer": None
            if stream is None
            else {
                part: {name: plain_array(values) for name, values in arrays.items()}
                for part, arrays in stream.memory().items()
            },
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> PressureEstimator:
        """Return the estimator that `state` was of; raises InputError where it does not fit."""
        estimator = cls(_numbers_of(part_of(state, "machine", Mapping)), bool(part_of(state, "litres", bool)))
        estimator._drive = part_of(state, "drive", str)
        estimator._seconds = float(part_of(state, "seconds", (float, int)))
        known, mean, after, rate, observer = (
            part_of(state, name, kind)
            for name, kind in (
                ("known", (Mapping, type(None))),
                ("mean", (float, int, type(None))),
                ("next", (float, int, type(None))),
                ("rate", (float, int, type(None))),
                ("observer", (Mapping, type(None))),
            )
        )
        estimator._known = None if known is None else array_of(known, "known")
        estimator._mean, estimator._next = (float("nan") if value is None else float(value) for value in (mean, after))
        estimator._settling, estimator._lost = (int(part_of(state, name, int)) for name in ("settling", "lost"))
        estimator._usual = float(part_of(state, "usual", (float, int)))
        if observer is not None:
            channels = (*CHAMBERS, estimator._drive)
            stream = ObserverStream(estimator._a, channels, float(rate or 0.0), estimator._seconds)
            stream.recall(
                {
                    part: {name: array_of(values, name) for name, values in part_of(observer, part, Mapping).items()}
                    for part in ("stored", "last", "start", "turn", "filter")
                }
            )
            estimator._stream = stream
        return estimator


def _passed_over(end: float, status: str, apart: bool = False) -> NotJudged:
    return NotJudged(end, status, f"blocks: {status}", apart)


def _numbers_of(state: Mapping[str, Any]) -> RigNumbers:
    values: dict[str, Any] = {}
    for name in RigNumbers._fields:
        if name not in state and (name in LAWS or name in NUMBERS):  # of a law that came later
            values[name] = () if name in LAWS else 0.0
        elif name in LAWS:
            values[name] = tuple(bool(value) for value in part_of(state, name, list))
        elif name in CHOICES:
            values[name] = bool(part_of(state, name, bool))
        else:
            values[name] = float(part_of(state, name, (float, int)))
    return RigNumbers(**values)
