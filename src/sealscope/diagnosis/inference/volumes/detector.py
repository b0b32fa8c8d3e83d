"""The volume balance as a detector: observables of a recording, and its leak beside that of healthy recordings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.inference.balance import RecordedBlocks, RegimeBlocks, recorded_blocks, shortest
from sealscope.diagnosis.inference.blocks import Columns
from sealscope.diagnosis.inference.circuit.store import lost_beside
from sealscope.diagnosis.inference.circuit.without_position import circulations
from sealscope.diagnosis.inference.differences import difference
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.regimes import shut_without_rests
from sealscope.diagnosis.inference.rows.weak_form import STRIDE, stride_samples
from sealscope.diagnosis.inference.scatter import RecordingSums, Rise, leave_one_out, motion_change, rise
from sealscope.diagnosis.inference.terms import (
    CYLINDER,
    LOCKED,
    TURNING,
    circulation,
    equations,
    locked,
    shut_at_rest,
)
from sealscope.diagnosis.inference.volumes.balance_leak import BalanceLeak
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.diagnosis.inference.volumes.rivals import rival_rises
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.diagnosis.priors import priors
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Why a recording has no balance, with its position and without.
_NO_BALANCE = {
    True: "too short for a balance, or the piston is not held: {:.3g} s",
    False: "no loop brings the piston back or holds it under a pressure difference, for long enough in {:.3g} s, so "
    "that what leaks moves it: record its position x",
}
_AGES = 1e11  # seconds
#: Fewest healthy recordings whose scatter tells one hypothesis of rests from the other.
FEWEST_THAT_SCATTER = 3
#: Fewest samples between neighbouring test functions.
RESOLVED = 2


def made_good(balance: RecordedBalance) -> bool:
    """Test whether the pump surely delivers the loss of any pump: a loop brings the piston back, or holds it."""
    least: float = priors("inference")["held"]["share"]
    return balance.level.low * balance.mean_pressure() > least * balance.mean_flow


#: Channels that balances read.
_READ = ("u", "theta", "omega", "q_pump", "x", "p_1", "p_2", *CHAMBERS)


class VolumeBalance:
    """Leakage from the balance of volumes: what the pump delivers and the piston does not displace.

    It needs both chamber pressures, and the pump's angle, its speed, a flow meter or the command; the piston's
    position, or a loop that brings the piston back or holds it (`without_position`). Behind a servo valve it needs
    position, command, both chambers, supply and return. Without the latter it sees what holds lose.
    """

    name = "volume balance"

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the balance needs, else the reason why not."""
        channels = frozenset(recording.channels)
        if not (equations(self.rig, channels) or circulation(self.rig, channels) or locked(self.rig, channels)):
            if self.rig.valve.spool == "present":
                return "needs x, u, p_A, p_B; for more than holds the pressures of supply and return, p_1 and p_2"
            return "needs p_A, p_B and the pump's theta or omega, a flow meter q_pump or the command u"
        if stride_samples(recording.rate) < RESOLVED:
            return f"needs {RESOLVED / STRIDE:g} Hz or more, got {recording.rate:g} Hz: is the unit of the time right?"
        fewest = shortest(recording.rate)
        if len(recording) < fewest:
            return f"needs {fewest} samples or more at {recording.rate:g} Hz, got {len(recording)}"
        for name in ("x", *CHAMBERS):
            if name not in recording:
                continue
            values = recording[name][np.isfinite(recording[name])]
            if not values.size or values.min() == values.max():
                return f"{name} is constant or missing"
        return None

    def balance(self, recording: Recording, odds: float = 0.0, *, is_locked: bool = False) -> RecordedBalance | None:
        """Return the recording's balance; None if it has none.

        Of several it is the one with the smallest bound. Without a recorded position a balance says nothing, unless
        the pump surely makes good its loss. `odds`: log odds by healthy recordings that the pump is cut off at rest;
        `is_locked`: they surely say so, whatever a leak makes of this recording's rests.
        """
        balances = equations(self.rig, frozenset(recording.channels))
        if not balances:
            cycle_balances = remembered(
                recording, (self.name, self.rig), lambda samples: circulations(samples, self.rig), _READ
            )
            candidates = [
                RecordedBalance(
                    cycle_balance.blocks,
                    (cycle_balance.equation,),
                    (cycle_balance.columns,),
                    self.rig,
                    recording,
                    cycle_balance.lost,
                )
                for cycle_balance in cycle_balances
            ]
            answering = [
                candidate for candidate in candidates if candidate.equations[0].name == LOCKED or made_good(candidate)
            ]
            return min(answering, key=lambda candidate: BalanceLeak(self.name, candidate).bound_flow, default=None)
        recorded = self._recorded(recording)
        if recorded is None:
            return None
        most: float = priors("inference")["rest"]["alone"]
        odds = np.inf if is_locked else odds + float(np.clip(recorded.odds, -most, most))
        return self._balance(recording, recorded.regime(odds))

    def _recorded(self, recording: Recording) -> RecordedBlocks | None:
        return remembered(recording, (self.name, self.rig), lambda samples: recorded_blocks(samples, self.rig), _READ)

    def _balance(self, recording: Recording, regime: RegimeBlocks) -> RecordedBalance:
        zero = float(regime.blocks.zero[0])
        lost = remembered(
            recording, ("lost oil", self.rig), lambda samples: lost_beside(samples, self.rig, zero), _READ
        )
        blocks, plain, balances, columns, shut = regime
        return RecordedBalance(blocks, balances, columns, self.rig, recording, lost, plain, shut)

    def learn(self, recording: Recording) -> Lesson | None:
        """Return the lesson of a healthy recording (`scatter.RecordingSums`), by the terms of its balance.

        `scale` makes flows by the rig's displacement the machine's, 0 where its size is not stated. Where the machine
        rests, `shut_sums` are those of a pump that is cut off then, `held` what its holds leak, `shut_odds` the log
        odds that it is.
        """
        recorded = self._recorded(recording) if equations(self.rig, frozenset(recording.channels)) else None
        balance = self.balance(recording) if recorded is None else self._balance(recording, recorded.open)
        if balance is None:
            return None
        scale = balance.size.scale if balance.size.stated else 0.0
        known = {name: value for name, value in balance.recording_sums._asdict().items() if value is not None}
        if recorded is not None and recorded.shut is not None:
            sums = self._balance(recording, recorded.shut).recording_sums
            known |= {"shut_sums": sums.sums, "shut_odds": recorded.odds}
            known |= {} if sums.held is None else {"held": sums.held}
        return {"terms": list(balance.columns[0].names), "scale": scale, **known}

    def next_rise(self, lessons: Sequence[Lesson], channels: frozenset[str], repeated: int = 1) -> Rise:
        """Return the rise of a healthy recording like these on a later day, as after `repeated` times as many days."""
        shut = _is_locked(lessons) or self._odds_of(lessons, channels) > 0.0
        healthy = [_sums_of(lesson, shut) for lesson in lessons]
        later = [sums._replace(start_s=_later(sums, k)) for k in range(repeated) for sums in healthy]
        flow, pressure = (float(np.median([lesson[name] for lesson in lessons])) for name in ("flow", "pressure"))
        middle = RecordingSums(healthy[0].sums, flow, pressure, oil_degC=healthy[0].oil_degC)
        dated = next((sums for sums in healthy if sums.start_s is not None), middle)
        return rise(middle._replace(start_s=_later(dated, repeated)), later, self._columns(channels, shut))

    def _odds_of(self, lessons: Sequence[Lesson], channels: frozenset[str]) -> float:
        """Compute the log odds, by healthy recordings, that the pump is cut off at rest.

        Of enough recordings by how far their leakage scatters under either hypothesis, the ratio of the likelihoods of
        an unknown scale: that under which healthy recordings agree also shows the smaller leak. Of fewer by the sum of
        what each says of itself.
        """
        known = [lesson for lesson in lessons if "shut_sums" in lesson]
        if len(known) < FEWEST_THAT_SCATTER:
            most: float = priors("inference")["rest"]["alone"]
            return float(np.sum(np.clip([lesson.get("shut_odds", 0.0) for lesson in known], -most, most)))
        scatter = []
        for shut in (False, True):
            sums = [_sums_of(lesson, shut) for lesson in known]
            values = leave_one_out(sums, self._columns(channels, shut))
            scatter.append(max(float(values.std(ddof=1)), np.finfo(float).tiny))
        return (len(known) - 1) * float(np.log(scatter[0] / scatter[1]))

    def _columns(self, channels: frozenset[str], shut: bool) -> list[Columns]:
        balances = equations(self.rig, channels)
        return [Columns(shut_at_rest(equation) if shut else equation) for equation in balances]

    def observe(self, recording: Recording, baseline: Sequence[Healthy] = ()) -> Observed:
        """Return the steps of the balance's terms, and the leak against healthy recordings."""
        lessons = lessons_of(self, baseline)
        is_locked = _is_locked(lessons)
        odds = self._odds_of(lessons, frozenset(recording.channels))
        balance = self.balance(recording, odds, is_locked=is_locked)
        if balance is None:
            return Observed(self.name, lack=_NO_BALANCE["x" in recording].format(recording.duration))
        names = [name for name in balance.columns[0].names if name != TURNING]
        known = [_sums_of(lesson, balance.shut) for lesson in lessons if lesson["terms"] == names]
        return self._report(balance, known if is_locked else [sums._replace(held=None) for sums in known])

    def observe_regimes(self, recording: Recording) -> Mapping[bool, Observed]:
        """Observe a recording by itself, with the pump in the circuit at rest (False) or cut off (True)."""
        recorded = self._recorded(recording) if equations(self.rig, frozenset(recording.channels)) else None
        regimes = [] if recorded is None else [recorded.open, recorded.shut]
        balances = [self._balance(recording, regime) for regime in regimes if regime is not None]
        if recorded is None:
            balances = [balance for balance in (self.balance(recording),) if balance is not None]
        return {balance.shut: self._report(balance, ()) for balance in balances}

    def _report(self, balance: RecordedBalance, healthy: Sequence[RecordingSums]) -> Observed:
        leak, rows = BalanceLeak(self.name, balance, healthy), balance.blocks.rows
        if leak.step is None and leak.rise is None:
            why = "p_A and p_B hardly differ, or too few samples are whole: no leak would show"
            return Observed(self.name, lack=why)
        is_whole = balance.equations[0].name == CYLINDER or len(balance.columns) > 1
        share = float(rows.mean() / max(rows.max(), 1.0)) if is_whole else 1.0
        observables = balance.observables
        if healthy and len(balance.columns) == 1 and is_whole:
            observables += tuple(_motion_observable(balance, healthy))
            observables += rival_rises(balance.recording_sums, healthy, balance.columns)
        return Observed(self.name, observables, leak, share=share)


def _motion_observable(balance: RecordedBalance, healthy: Sequence[RecordingSums]) -> Iterator[Observable]:
    """Compare the flow that motion takes with the healthy recordings: another machine, or another scale."""
    columns, sums = balance.columns[0], [recording.sums[0] for recording in healthy]
    change = motion_change(balance.recording_sums.sums[0], sums, columns)
    known = [
        motion_change(recording_sums, sums[:k] + sums[k + 1 :], columns) * (len(sums) - 1) / len(sums)
        for k, recording_sums in enumerate(sums if len(sums) > 1 else ())
    ]
    observable = difference("motion", "motion", change, known, priors("inference")["size"]["motion"])
    yield from () if observable is None else (observable,)


def _is_locked(lessons: Sequence[Lesson]) -> bool:
    """Tell whether healthy recordings surely say that valves hold the pressures while the pump rests."""
    odds = [lesson["shut_odds"] for lesson in lessons if "shut_odds" in lesson]
    return bool(odds) and float(np.mean(odds)) > priors("inference")["rest"]["locked"]


def _later(recorded: RecordingSums, times: int) -> float | None:
    """Return the date of a recording as many times later as no recordings of one machine are apart."""
    return None if recorded.start_s is None else recorded.start_s + times * _AGES


def _sums_of(lesson: Lesson, shut: bool = False) -> RecordingSums:
    sums = np.asarray(lesson["sums"], dtype=float)
    if shut:
        sums = np.asarray(lesson["shut_sums"]) if "shut_sums" in lesson else shut_without_rests(sums, lesson["terms"])
    held = np.asarray(lesson["held"], dtype=float) if shut and "held" in lesson else None
    return RecordingSums(sums, lesson["flow"], lesson["pressure"], lesson.get("start_s"), lesson.get("oil_degC"), held)
