"""Pressures and command alone: a model of the machine, fitted to the pressure difference, shows when G rises.

A leak past the piston damps the ringing after each reversal; friction does so too, but moves the mean pressure
difference of the strokes as well, and a softer oil changes the ringing's frequency. The reduced rig (`model`) knows
these ties. It is fitted to the record (`fit`), its parameters are followed block by block (`track`), and a leak is a
rise of the conductance G that the wandering of all other parameters does not explain. Pump and piston leak in parallel
here, so that the level of G says nothing of the piston: only its rise does, or its level against a baseline.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sealscope.diagnosis.baseline.level import DayToDay, against_baseline, incomparable, share_of_each
from sealscope.diagnosis.changepoint.tails import largest_normal, near_best, seed_of
from sealscope.diagnosis.verdict.evidence import (
    LEAK_WORTH_FINDING,
    NO_RIG,
    Cause,
    Evidence,
    LeakCourse,
    Passage,
    without_flow,
)
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Recording, remembered
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.diagnosis.pressure_model.follow import Followed
    from sealscope.parameters import Rig

#: Shortest record [s], lowest rate [Hz] the model was judged at (100 Hz, by a clock that is off), and fewest blocks on
#: either side of a step. The model rings between the samples, so that a ringing of 60 to 80 Hz is followed below its
#: own rate of samples, too (docs/decisions/0060-hundred-hertz.md).
SHORTEST, SLOWEST_RATE, LEAST = 40.0, 95.0, 3
#: Scatter of the blocks beyond the wandering, as chi square over its degrees of freedom: three deviations above 1, to
#: which the level of a record can be compared, and the most for which a wider error makes up.
STEADY, UNRULY = 1.2, 1.5
#: Probability with which a leak worth finding must show for `no leak`, where the model is led by its readings.
_FOUND = 0.9
#: A change of a parameter from the first to the last third that no healthy machine shows within a record, as a share.
_OTHER_CAUSE = {"friction": 0.18, "stiffness": 0.15}
#: What a machine that is fitted anew after the onset may have had, beside which a large leak is weighed. The command is
#: the model's own, and how far a chamber's mean moves says nothing of what rings. Air makes the ringing slower and
#: louder, which no leak does: it is asked for all the same.
_WEIGHED: frozenset[Cause] = frozenset({"friction change", "changed duty"})
#: A command that grows by no more than the leak takes is a controller's, which makes it good: no other duty.
_MADE_GOOD: frozenset[Cause] = frozenset({"changed duty"})
#: From day to day the level of G moves by this much [m^3/(s Pa)], known as from five recordings: fits differ with the
#: machine's friction.
DAY_TO_DAY = DayToDay(2e-13, 4.0)
#: Two deviations of the prior on the lead [s]: a fit beyond has a ring too many or too few, and another level of G.
_LARGEST_LEAD = 1e-3
#: How far the scale of all flows is known, as a share: the ringing shows flows only beside the moving mass over the
#: area squared, and machines differ from the rig by some 15 % in their mass and 4 % in their area.
FLOW_SCALE = float(np.hypot(0.15, 2.0 * 0.04))
#: Behind a servo valve a step of G takes some of what edges and spool give way [m^3/(s Pa)]: on six machines developed
#: on, a leak of 0.0042 L/min was stated 1.0 to 2.5 times too large.
_GIVES_WAY = 4e-13
#: ... and G wanders by so many times what it does behind a pump: of 400 sound machines of the profile `valve` 16 were
#: called a leak at 1 % without it, 7 with 1.2, 2 with 1.3 or 1.4 (seed 2037).
_WANDERS = 1.4
#: In oil that warms the pump's own G grows by this much as well [m^3/(s Pa)]: of six leaks on warming machines of the
#: bench two were stated 1.8 times too large.
_GROWS = 2e-13
#: Of two laws the dearer is excluded by this difference of cost (twice the log likelihood), which must also be this
#: share of what the leak itself explains: a model that is off by some per cent misses more of a larger leak.
_DECISIVE, _DECISIVE_SHARE = 6.0, 0.4
#: Why a large leak is not sized.
_UNSIZED = "this machine moves unlike the rig, so that the flow cannot be told from pressures and command"
#: ... and a leak under a force that moves the strokes of an open loop.
_MOVED = (
    "a force swings and no controller works against it: what leaks moves the strokes with the force, so that the flow "
    "cannot be told from pressures and command"
)
#: ... of which the model takes all but one part in so many for friction: leaks of 0.05 L/min had a z 2.5 to 4.7 times
#: under what their size stands for (development records).
_TAKEN = 4.0
#: Commands are alike within this ratio of their rms.
_ALIKE = 1.1


class _Machine(NamedTuple):
    """What the blocks of a machine do not show: `unsure` as `_flow` takes it, `wanders` and `taken` as above."""

    unsure: float = 0.0
    wanders: float = 1.0
    taken: float = 1.0


class PressureModel:
    """Rise of the leakage conductance from p_A, p_B and the command u."""

    name = "pressure model"
    reads = ("u", "p_A", "p_B")

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        # the ringing shows flows beside the moving mass over the area squared
        self.states_flow = rig.states("cylinder.A_A", "cylinder.A_B", "cylinder.M_eq")

    def usable(self, recording: Recording) -> str | None:
        """Return None where the record has what the model needs, else the reason why not."""
        missing = [name for name in (*CHAMBERS, "u") if name not in recording]
        if missing:
            return f"needs p_A, p_B and the command u, got no {' and no '.join(missing)}"
        strange = [name for name in CHAMBERS if recording.units[name] != "Pa"]
        if strange:
            return f"needs pressures in a unit of pressure, got {recording.units[strange[0]]} for {strange[0]}"
        if recording.units["u"] != "V":
            return f"needs the command in V, got {recording.units['u']}"
        if recording.rate < SLOWEST_RATE:
            return f"needs a rate of {SLOWEST_RATE:g} Hz or more, got {recording.rate:g} Hz"
        if recording.duration < SHORTEST:
            return f"needs {SHORTEST:g} s or more, got {recording.duration:.4g} s"
        for name in ("u", *CHAMBERS):
            if constant(recording[name]):
                return f"{name} is constant"
        return None

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Return the evidence of a rise of G within the recording, and of its level against the baseline's."""
        followed = self.follow(recording)
        if isinstance(followed, str):
            return _under_force(Evidence("cannot tell", followed), recording)
        probability = share_of_each(false_alarm_probability, baseline)
        moved = _strokes_move(recording)
        unstated = NO_RIG if not self.states_flow else _MOVED if moved else None
        within = _within(followed, recording, probability, self._machine(taken=_TAKEN if moved else 1.0))
        within = _under_force(replace(within, share=followed.share), recording)
        if unstated is not None and within.verdict == "leak":
            within = without_flow(within, unstated)
        if unstated is not None and within.passage is not None:
            within = replace(within, passage=replace(within.passage, findable_lpm=None))
        if not baseline or within.score is None:
            return within
        if not is_followed(followed):
            led = "the model is led by the readings, which its level of G depends on"
            ring = "the fit has a ring too many or too few in each reversal"
            return incomparable(within, ring if followed.predicted is None else led)
        known = [remembered(other, (self.name, self.rig), self.follow) for other in baseline]
        level = against_baseline(
            within,
            followed.level,
            [other.level for other in known if not isinstance(other, str) and _comparable(followed, other)],
            DAY_TO_DAY,
            probability,
            part="level of G",
            flows=(_mean_drop(recording) / LITRE_PER_MINUTE,) if unstated is None else (),
            cause="piston or pump leak",
        )
        if unstated is not None and level.verdict == "leak" and level.onset_s is None:
            level = without_flow(level, unstated)
        return replace(level, share=followed.share)

    def findable(self, recording: Recording, false_alarm_probability: float, detection: float) -> float | str:
        """Return the step of a leak in the middle of a leak-free record that would be found [L/min], or why none is.

        With the deviation s of a step there, in the record's own scatter, it is ``(threshold + z_detection) s``.
        """
        followed = self.follow(recording)
        if isinstance(followed, str):
            return followed
        if followed.excess > UNRULY:
            return f"the model does not follow this record: its parameters wander {followed.excess:.2f} times"
        z = followed.steps.z[_inner(followed)]
        correlation = followed.steps.correlation[_inner(followed), _inner(followed)]
        threshold, _ = largest_normal(correlation, false_alarm_probability, seed_of(z), float(np.max(z)))
        step = self._machine().wanders * _findable(followed, threshold, detection)
        return step * _mean_drop(recording) / LITRE_PER_MINUTE

    def _machine(self, taken: float = 1.0) -> _Machine:
        behind_valve = self.rig.valve.spool == "present"
        return _Machine(_GIVES_WAY, _WANDERS, taken) if behind_valve else _Machine(taken=taken)

    def follow(self, recording: Recording) -> Followed | str:
        """Return the record as the model follows it, or the reason why it does not."""
        from sealscope.diagnosis.pressure_model.follow import follow

        if self.rig.cylinder.single_rod:
            return (
                "the model is of a piston whose two areas are alike, so that p_A and p_B move against each other; "
                f"those of the rig {self.rig.name} differ by {self.rig.cylinder.unevenness:.0%}"
            )
        cycle = find_cycle(recording)
        # parameters that are tried and make the model diverge are left again
        with np.errstate(over="ignore", invalid="ignore"):
            return follow(self.rig, recording, cycle, UNRULY)


def _inner(followed: Followed) -> slice:
    """Return the steps that are looked at: with `LEAST` blocks or more on either side."""
    return slice(LEAST - 1, followed.blocks - LEAST)


def _findable(followed: Followed, threshold: float, detection: float) -> float:
    """Return the step of G in the middle of a record that is over a threshold with that probability [m^3/(s Pa)]."""
    from scipy.special import ndtri

    middle = slice(followed.blocks // 3, max(followed.blocks // 3 + 1, 2 * followed.blocks // 3))
    deviation = float(np.max(followed.steps.deviation[middle])) * float(np.sqrt(max(1.0, followed.excess)))
    return (threshold + float(ndtri(detection))) * deviation


def _strokes_move(recording: Recording) -> bool:
    """Return whether the strokes of an open loop give way to a force that swings."""
    from sealscope.diagnosis.pressure_model.load import moves_strokes

    dp = recording["p_A"] - recording["p_B"]
    return moves_strokes(recording["u"], dp, recording.rate, find_cycle(recording))


def _under_force(evidence: Evidence, recording: Recording) -> Evidence:
    """Return the evidence, a force that swings named where the record cannot be followed under it."""
    from sealscope.diagnosis.pressure_model.load import SWINGS, swing

    share = swing(recording["p_A"] - recording["p_B"], recording.rate, find_cycle(recording))
    if evidence.verdict != "cannot tell" or share < SWINGS:
        return evidence
    part = Evidence("cannot tell", "", share, SWINGS, detector="force that swings")
    return replace(
        evidence,
        reason=f"{evidence.reason}; a force swings: the mean of p_A - p_B over a cycle deviates by {share:.0%} of it",
        parts=(*evidence.parts, part),
    )


def _comparable(followed: Followed, other: Followed) -> bool:
    """Return whether another record has the same command, and the model follows it."""
    return 1.0 / _ALIKE < other.command_rms / followed.command_rms < _ALIKE and is_followed(other)


def is_followed(followed: Followed) -> bool:
    """Return whether the level of a record can be compared: its parameters are those of a machine, and wander so."""
    from sealscope.diagnosis.pressure_model.model import LEAD

    lead = float(np.mean(followed.path[:, LEAD]))
    return followed.predicted is None and followed.excess <= STEADY and abs(lead) <= _LARGEST_LEAD


def _mean_drop(recording: Recording) -> float:
    """Return the mean of |p_A - p_B| [Pa]."""
    return float(np.mean(np.abs(recording["p_A"] - recording["p_B"])))


def _flow(
    followed: Followed, recording: Recording, after: int, onset: float, scatter: float, unsure: float
) -> tuple[float, tuple[float, float], str, bool]:
    """Return the mean flow [L/min] of a rise after a block, its 95 % interval, and the law in words where it is known.

    Last, whether a leak by each of these laws is above zero by itself: blocks that the model follows badly may rise
    together, and the record followed with a leak from then on shows none.

    Where several laws explain the record, the flow is the mean of theirs and the interval holds what any says.
    `scatter` of the blocks over their stated deviation; `unsure` [m^3/(s Pa)]: deviation of G that no scatter shows.
    """
    from sealscope.diagnosis.pressure_model.tracking.laws import LAWS, WORN_SEAL
    from sealscope.diagnosis.pressure_model.tracking.steps import PossibleLeak

    steps = followed.steps
    leaks = followed.leaks or (
        PossibleLeak(WORN_SEAL, after, float(steps.size[after]), float(steps.deviation[after]), 0.0),
    )
    explained = float(np.max(steps.z)) ** 2 if followed.large is None else followed.large.explained
    decisive = max(_DECISIVE, _DECISIVE_SHARE * explained)
    likely = [leak for leak in leaks if leak.cost <= leaks[0].cost + decisive]
    stated = []
    late = recording.t >= onset
    drop = recording["p_A"][late] - recording["p_B"][late]
    if followed.predicted is not None:  # which law it is such a model does not tell, and readings at rest are noise
        likely, drop = list(leaks), followed.predicted[late]
    for leak in likely:
        unit = leak.law.flow(drop) / LITRE_PER_MINUTE
        blind = unsure * float(np.mean(np.abs(drop))) / leak.law.flow(drop)
        reach = 1.96 * math.hypot(scatter * leak.deviation, FLOW_SCALE * leak.size, blind)
        stated.append((leak.size * unit, max(0.0, (leak.size - reach) * unit), (leak.size + reach) * unit))
    pure = [law for law in LAWS if any(leak.law is law for leak in likely)]
    law = "" if len(pure) > 1 or len(leaks) == 1 else f", as of {(pure or [likely[0].law])[0].name}"
    return (
        float(np.mean([lpm for lpm, *_ in stated])),
        (min(low for _, low, _ in stated), max(high for *_, high in stated)),
        law,
        all(leak.size > 1.96 * scatter * leak.deviation for leak in likely),
    )


def _makes_good(recording: Recording, onset: float, share: float) -> bool:
    """Return whether the command grows from the onset on by no more than a leak of up to that share of the pump's flow.

    A controller that holds the strokes adds what leaks to what the pump moves.
    """
    late = recording.t >= onset
    before, after = (float(np.std(recording["u"][part])) for part in (~late, late))
    return before < after <= before * (1.0 + share)


def _within(followed: Followed, recording: Recording, probability: float, machine: _Machine) -> Evidence:
    """Return the evidence on a rise of G within the record."""
    steps, begin = followed.steps, float(recording.t[0])
    inner = _inner(followed)
    z = steps.z[inner]
    best = int(np.argmax(z))
    excess = followed.excess
    scatter = machine.wanders * float(np.sqrt(max(1.0, excess)))
    large = followed.large
    highest = float(z[best]) if large is None else large.z
    score = highest / scatter
    threshold, chance = largest_normal(steps.correlation[inner, inner], probability, seed_of(z), score)
    cause = _other_cause(followed)
    if excess > UNRULY and large is None:
        seen = {
            None: "",
            "friction change": f"; the friction changed by {100.0 * followed.friction_change:.0f} %",
            "air in the oil": f"; the oil's stiffness changed by {100.0 * followed.stiffness_change:.0f} %",
        }[cause]
        change = followed.change
        parts: tuple[Evidence, ...] = ()
        if change is not None:
            at = begin + change.onset / recording.rate
            seen += f"; at {at:.0f} s the machine changed: a large leak, or its drive"
            clear = change.z / math.sqrt(max(1.0, change.excess))
            parts = (Evidence("cannot tell", "", clear, threshold, detector="large change"),)
        return Evidence(
            "cannot tell",
            f"the model of the rig does not follow this record: its parameters wander {excess:.2f} times as much as "
            f"those of a healthy machine may, {UNRULY:g} are allowed{seen}",
            parts=parts,
            cause=cause,
            unruly=True,
        )
    edges = begin + followed.edges / recording.rate
    onset = float(edges[inner.start + 1 + best]) if large is None else begin + large.onset / recording.rate
    figures = f"z {score:.2f}, threshold {threshold:.2f}"
    if followed.predicted is not None:
        figures += ", predicted from sample to sample"
    alarm = score > threshold
    part = Evidence("leak" if alarm else "no leak", "", score, threshold, detector="rise of G")
    if not alarm:
        hidden = machine.taken * machine.wanders * _findable(followed, threshold, _FOUND) * _mean_drop(recording)
        share = hidden / followed.pumped
        passage = Passage(None, None, _mean_drop(recording), hidden / LITRE_PER_MINUTE, findable_share=share)
        if share > LEAK_WORTH_FINDING:
            return Evidence(
                "cannot tell",
                f"a leak of {share:.0%} of the pump's flow would not show ({figures})",
                parts=(part,),
                cause=cause,
                unruly=followed.predicted is not None or machine.taken > 1.0,
                passage=passage,
            )
        reason = {
            None: f"no rise of the leakage conductance beyond its scatter ({figures}); a leak that was there from the "
            f"start would need a --baseline to be seen",
            "friction change": f"the friction changed, the leakage conductance did not ({figures})",
            "air in the oil": f"the oil became softer, the leakage conductance did not change ({figures})",
        }[cause]
        reason += f"; the smallest rise that would show nine times in ten is {100.0 * share:.2g} % of the pump's flow"
        return Evidence("no leak", reason, score, threshold, parts=(part,), cause=cause, chance=chance, passage=passage)
    if large is None:
        near = near_best(z * np.abs(z), scatter**2)
        interval = float(edges[inner.start + near[0]]), float(edges[min(inner.start + near[-1] + 2, edges.size - 1)])
    else:
        interval = begin + large.limits[0] / recording.rate, begin + large.limits[1] / recording.rate
    unsure = _GROWS if followed.warming else machine.unsure
    lpm, limits, law, leaks = _flow(followed, recording, inner.start + best, onset, scatter, unsure)
    estimate, low, high = (np.where(edges[:-1] < onset, 0.0, value) for value in (lpm, *limits))
    course = LeakCourse(0.5 * (edges[:-1] + edges[1:]), estimate, low, high)
    reason = f"the leakage conductance past piston or pump rose at {onset:.1f} s{law} ({figures})"
    sized = large is None or large.sized
    if cause is not None or followed.another or (sized and not leaks):
        why = {
            "friction change": "the friction changed more than it does in a healthy machine",
            "air in the oil": "the oil's stiffness changed more than it does in a healthy machine",
            None: "another drive, friction and oil from then on explain the record better than a leak"
            if followed.another
            else "followed with a leak from then on, the record shows none",
        }[cause]
        return Evidence(
            "cannot tell",
            f"{reason}, but {why}",
            score,
            threshold,
            parts=(part,),
            cause=cause,
            chance=chance,
        )
    makes_good = _makes_good(recording, onset, limits[1] * LITRE_PER_MINUTE / followed.pumped)
    found = Evidence(
        "leak",
        reason,
        score,
        threshold,
        onset,
        interval,
        lpm,
        limits,
        parts=(part,),
        cause="piston or pump leak",
        course=course,
        chance=chance,
        weighed=_WEIGHED if large is not None else _MADE_GOOD if makes_good else frozenset(),
    )
    return found if sized else without_flow(found, _UNSIZED)


def _other_cause(followed: Followed) -> Cause | None:
    """Return what else changed more than a healthy machine's drift, or None.

    Beside a large leak, which is weighed against such a change by itself, the parameters are known too badly to ask. In
    oil that warms friction falls.
    """
    if followed.large is not None:
        return None
    if abs(followed.friction_change) > _OTHER_CAUSE["friction"] and not followed.warming:
        return "friction change"
    if followed.stiffness_change < -_OTHER_CAUSE["stiffness"]:
        return "air in the oil"
    return None
