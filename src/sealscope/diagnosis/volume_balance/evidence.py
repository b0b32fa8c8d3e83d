"""Evidence of a volume balance: whether a fit means anything, and what a rise of its conductance shows, in L/min."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.baseline.level import DayToDay, Level, against_baseline
from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, DriftStep
from sealscope.diagnosis.verdict.evidence import (
    LEAK_WORTH_FINDING,
    LEAKS,
    Cause,
    Evidence,
    Figure,
    LeakCourse,
    Passage,
    RelativeLeak,
    Verdict,
)
from sealscope.diagnosis.volume_balance.blocks import I_AB, Y
from sealscope.diagnosis.volume_balance.fit import (
    GEOMETRY,
    BalanceFit,
    Law,
    discriminate,
    loaded,
    swings,
)
from sealscope.diagnosis.volume_balance.growth import Oil, grown, oil_of
from sealscope.diagnosis.volume_balance.law import (
    ONE_SIDED,
    OrificeShare,
    evened,
    one_sided_share,
    orifice_share,
    reach,
    shape_of,
    zero_error,
)
from sealscope.diagnosis.volume_balance.search import findable, search
from sealscope.recordings.recording import Array
from sealscope.units import LITRE_PER_MINUTE

#: Displacement over area may differ by this share, beside the error of the fit, from that of the default rig, before it
#: is said to be another machine (`GEOMETRY` where a machine is stated). Assumed: makers state displacements to some per
#: cent.
UNSTATED_GEOMETRY = 0.05
#: Relative deviation of what every L/min is multiplied by: scale of the position, mean pressure difference. The mean
#: root of the difference is uncertain by the share that noise lifts it, too.
_RELATIVE = 0.003
#: ... and of what a single rod passes that neither side carries, where the load changes sides: 1 % on a press under 250
#: N, whose neutral load is 305 N.
_CHANGING_OVER = 0.01
#: The motion must be this many times what the balance leaves unexplained.
_CLEAR = 20.0
#: ... and follow the angle's within this time [s]: more is no skew of channels and no filter.
_LONGEST_LAG = 0.1
_MOST_LEFT_OUT = 0.3
_RESTS = 1e-3
#: Relative deviation of a whole conductance from what is not modelled (noise in the stored oil, the reversals).
_LEVEL = 0.02
#: Relative deviation of a level whose law is not known: a leak of the other law shifts the geometry fitted beside it.
_UNKNOWN_LAW = 0.03
#: From day to day the conductance of a machine differs by 10 % (two kelvin of oil, and its drift within a recording),
#: known as from five recordings.
_DAY_TO_DAY, _DAY_TO_DAY_FREEDOM = 0.1, 4.0
#: Recordings whose displacement over area differs by more are of another machine.
_SAME_MACHINE = 0.02
#: One place or law of a leak is told from another where it explains the blocks better by this (twice the log
#: likelihood).
_DECISIVE = 10.0
_SLIPPED = 20.0
#: Flow that leaves for good, over what the rise of the conductance alone leaks, from which oil is lost to the outside.
_LOST = 0.6
#: A transducer's zero drifts by less within a recording [Pa]: 1 psi.
_SENSOR_DRIFT = 7e3
#: What makes the conductance over strokes jump from rest to rest.
SETTLING = "how the circuit of a single rod settles where it rests without a load"
#: Share of a recording at its start in which the circuit may be filled; share of the pressure difference by which its
#: size changes under a force that does.
_FILLING, _UNSTEADY = 0.1, 0.1
#: A step is the whole of what grew where it is over this share of it.
_WHOLE = 0.6
#: A drift over this share of the conductance at the start is more than warm oil does within a recording.
_LARGE_DRIFT = 0.5
#: ... where it is also over so many deviations of a block.
_SMOOTH = 6.0
#: Under a force that swings, what blocks miss recurs with the beat of force and strokes: heights scatter by so many
#: times what their blocks state (development records).
_BEATS = 1.5
#: Conductances are the same within this share of their deviations: what was found in them holds.
_SAME = 0.05
#: A share through an orifice from which a leak shows unevenly.
_UNEVEN = 0.02
#: A leak follows both laws where either takes more than this share of it.
_SOME = 0.15
_LAWS: tuple[Law, Law] = ("laminar", "orifice")


def trouble(fit: BalanceFit) -> str | None:
    """Return why a balance means nothing, in one line, or None."""
    n = len(fit.blocks)
    if not np.isfinite(fit.residual) or not np.all(np.isfinite(fit.g)):
        return "the balance cannot be computed: values are beyond floating point"
    if fit.share_left_out > _MOST_LEFT_OUT or fit.count < FEWEST:
        return (
            f"position and angle do not belong together, or the machine stands, in {len(fit.left_out)} of "
            f"{n + len(fit.left_out)} blocks of {fit.blocks.seconds:.3g} s"
        )
    motion = np.sqrt(np.concatenate([fit.blocks.gram, fit.left_out.gram])[:, Y, Y] / fit.blocks.samples)
    if not np.median(motion) > _RESTS * np.max(motion):
        return "the machine stands still, or its position sticks, most of the time"
    if not (fit.signal > _CLEAR * fit.residual and abs(fit.lag) <= _LONGEST_LAG):
        return (
            f"the position does not follow the angle: with a lag of {fit.lag:.2g} s the balance leaves "
            f"{fit.residual:.2g} m^3 of a motion of {fit.signal:.2g} m^3 (rms) unexplained"
        )
    return None


class Samples(Protocol):
    """The samples behind a fit, for what its blocks do not show."""

    def dated(self, fit: BalanceFit, step: DriftStep) -> DriftStep:
        """Return the step with its onset from the samples about it."""
        ...

    def pressed(self, onset: float) -> tuple[float, float] | None:
        """Return the means of abs(p_A - p_B) [Pa] and of its root from `onset` on; None where they are not known."""
        ...

    def levelled(self, zero: float) -> tuple[BalanceFit, Samples] | None:
        """Return the fit, and its samples, with `zero` [Pa] added to p_A - p_B; None where there is none."""
        ...

    def thinned(self) -> tuple[float, float] | None:
        """Return the share of its viscous friction that the machine lost, and its deviation; None: not known."""
        ...


def judge(
    fit: BalanceFit,
    probability: float,
    *,
    window: bool = False,
    samples: Samples | None = None,
    healthy: float | None = None,
) -> Evidence:
    """Return the evidence of a rise of the conductance within a recording.

    `window`: of a stream, where neither a fall is named nor the smallest step that would have shown; `samples` behind
    the fit, where they are at hand; `healthy`: the most that pump and piston of a healthy machine pass together
    [m^3/(s Pa)], None where not known.
    """
    step = search(fit, probability)
    oil: Oil = "unknown" if samples is None or not _drifts(fit, step) else oil_of(fit, samples.thinned())
    risen = _risen(fit, step, probability, oil)
    if risen is not None:
        if samples is not None:
            fit, risen, samples = _levelled(fit, risen, samples, probability, oil)
            risen = samples.dated(fit, risen)
        pressed = samples.pressed(risen.onset) if samples is not None and risen.rise == 0.0 else None
        leak = describe_leak(fit, risen, probability, pressed)
        leak = _beyond_settling(leak, fit, risen) if window else _above_zero(leak)
        return _measured(replace(leak, passage=passage(fit, None, healthy)), fit)
    if window:
        return no_step(fit, step, None, 0.0)
    smallest = findable(fit, probability, step.noise)
    evidence = no_step(fit, step, search(fit, probability, sign=-1), smallest, oil)
    course = _whole_course(fit) if states_flow(fit) else None
    evidence = replace(evidence, passage=passage(fit, smallest, healthy), refuses=_refused(fit), course=course)
    return _measured(_from_the_start(evidence, fit, probability), fit)


def _above_zero(leak: Evidence) -> Evidence:
    """Return the evidence of a leak, `cannot tell` where by its own interval there may be none.

    A step that rises over several blocks, where the laws of a leak differ much, is often a circuit that settles.
    """
    if leak.verdict != "leak" or leak.leak_interval_lpm is None or leak.leak_interval_lpm[0] > 0.0:
        return leak
    reason = f"{leak.reason}; by the other law of a leak there may be none"
    return replace(
        _unsized(leak), verdict="cannot tell", reason=reason, cause=None, onset_s=None, onset_interval_s=None
    )


def _beyond_settling(leak: Evidence, fit: BalanceFit, risen: DriftStep) -> Evidence:
    """Return the evidence of a leak, `cannot tell` where no more rises than passed before and the circuit settles."""
    before = float(np.interp(risen.onset, fit.blocks.t, risen.level))
    if leak.verdict != "leak" or not fit.settles or risen.size >= before:
        return leak
    reason = f"{leak.reason}; less than the {_flow_text(before, fit)} that passed before may come of {SETTLING}"
    return replace(
        _unsized(leak), verdict="cannot tell", reason=reason, cause=None, onset_s=None, onset_interval_s=None
    )


def _unsized(evidence: Evidence) -> Evidence:
    return replace(evidence, leak_lpm=None, leak_interval_lpm=None, course=None, relative=None)


def _drifts(fit: BalanceFit, step: DriftStep) -> bool:
    """Return whether the conductance rises smoothly by more than oil does that keeps its temperature."""
    own, rise = level(fit), float(step.level[-1] - step.level[0])
    start = own.value + 1.96 * own.error - 0.5 * rise
    return rise > _LARGE_DRIFT * max(start, 0.0) and rise > _SMOOTH * float(np.median(fit.sd))


def _risen(fit: BalanceFit, step: DriftStep, probability: float, oil: Oil) -> DriftStep | None:
    """Return the growth of the conductance, else its step, None where neither is an alarm."""
    growth = None if oil == "thinner" else grown(fit, probability)
    if growth is not None and not (step.alarm and step.size > _WHOLE * growth.size):
        return growth
    return step if step.alarm else None


def _levelled(
    fit: BalanceFit, risen: DriftStep, samples: Samples, probability: float, oil: Oil
) -> tuple[BalanceFit, DriftStep, Samples]:
    """Return fit, rise and samples with the zero of p_A - p_B that the leak itself shows, where it still rises then."""
    zero = zero_error(fit, risen)
    again = samples.levelled(zero) if zero else None
    if again is None:
        return fit, risen, samples
    if np.array_equal(again[0].blocks.t, fit.blocks.t) and np.all(np.abs(again[0].g - fit.g) < _SAME * fit.sd):
        return again[0], risen, again[1]
    rise = _risen(again[0], search(again[0], probability), probability, oil)
    return (fit, risen, samples) if rise is None else (again[0], rise, again[1])


def judge_level(fit: BalanceFit, baseline: Sequence[BalanceFit], within: Evidence, probability: float) -> Evidence:
    """Return the evidence of the conductance of the whole recording against that of leak-free recordings."""
    same = [other for other in baseline if abs(other.scale / fit.scale - 1.0) <= _SAME_MACHINE]
    same = [other for other in same if other.sense == fit.sense]
    beside = float(np.mean([np.mean(other.leaning) for other in (fit, *same)]))
    levels = [level(other, beside) for other in same]
    every = np.ones(len(fit.blocks), dtype=bool)
    unit = float(fit.unit_flow("laminar").mean())
    evidence = against_baseline(
        within,
        level(fit, beside),
        levels,
        day_to_day(levels),
        probability,
        part="conductance against the baseline",
        flows=[_mean_flow(fit, law) for law in ("laminar", "orifice")] if states_flow(fit) else (),
        cause="piston or pump leak",
        refuses=_refused(fit),
        relative=lambda size, limits: _relative(fit, size * unit, (limits[0] * unit, limits[1] * unit), every),
    )
    return _measured(evidence, fit)


def day_to_day(baseline: Sequence[Level]) -> DayToDay:
    """Return the prior on the scatter of the conductance from day to day."""
    usual = float(np.mean([abs(known.value) for known in baseline])) if baseline else 0.0
    return DayToDay(max(_DAY_TO_DAY * usual, np.finfo(float).tiny), _DAY_TO_DAY_FREEDOM)


def _normal_quantile(probability: float) -> float:
    """Return what a standard normal number exceeds with this probability."""
    from scipy.special import ndtri

    return -float(ndtri(probability))


def _normal_tail(score: float) -> float:
    """Return the probability that a standard normal number exceeds a score."""
    from scipy.special import ndtr

    return float(ndtr(-score))


def level(fit: BalanceFit, beside: float | None = None) -> Level:
    """Return the mean conductance of the whole recording [m^3/(s Pa)], with the shared errors in its error.

    `beside`: the mean `leaning` of the recordings with which it is compared, whose scales err alike; None: of none.
    """
    weight = 1.0 / fit.sd**2
    weight = weight / weight.sum()
    mean = float(weight @ fit.g)
    common = weight @ fit.shared
    doubt = fit.doubt * (float(weight @ fit.leaning) - (beside or 0.0))
    own = np.sum((weight * fit.sd) ** 2)
    return Level(mean, float(np.sqrt(own + common @ common + doubt**2 + (_LEVEL * mean) ** 2)))


def _geometry_agrees(fit: BalanceFit) -> bool:
    """Return whether displacement over area is near the assumed one, whichever way the encoders count."""
    known = fit.geometry
    far = GEOMETRY if known.area_stated or known.displacement_stated else UNSTATED_GEOMETRY + 2.0 * fit.scale_sd
    return abs(fit.misfit - 1.0) <= far


def _geometry_fits(fit: BalanceFit) -> bool:
    """Return whether volumes are known, by what is stated of area and displacement.

    One of the two gives volumes, the piston's or the pump's (`BalanceFit.by_pump`); where the other one is stated, too,
    their ratio as measured must agree. Where that one is not stated, no ratio tells the size of the machine.
    """
    known = fit.geometry
    if known.area_stated and known.displacement_stated:
        return _geometry_agrees(fit)
    if fit.unequal:  # volumes are the pump's, the piston's area joins both sides
        return known.displacement_stated or (known.area_stated and _geometry_agrees(fit))
    return known.area_stated or known.displacement_stated


def _swings(fit: BalanceFit) -> bool:
    """Return whether the areas differ and the higher pressure changes sides faster than the samples tell."""
    return fit.unequal and swings(fit.blocks)


def states_flow(fit: BalanceFit) -> bool:
    """Return whether the balance gives L/min: a position with a unit, a known geometry, one side at a time."""
    return fit.metres and _geometry_fits(fit) and not _swings(fit)


def _no_flow_text(fit: BalanceFit, lpm: float | None = None) -> str:
    """Return why L/min is not stated; `lpm`: what it would be for a machine of the assumed size."""
    if not fit.metres:
        return "L/min is not stated: the position is in counts"
    if _swings(fit):
        share = 100.0 * float(np.median(fit.blocks.swinging))
        return (
            f"L/min is not stated: on {share:.0f} % of the way the higher pressure changes sides faster than the "
            "samples tell, so that the area that moves the oil is not known (another load keeps it on one side)"
        )
    ratio = f"displacement over area is {fit.misfit:.3g} times"
    if fit.geometry.area_stated or fit.geometry.displacement_stated:
        return f"L/min is not stated: {ratio} the assumed one, so the geometry is another"
    ask = "state --rig, --area or --displacement"
    if not _geometry_agrees(fit):
        return f"L/min is not stated: no rig was stated, and {ratio} that of the default rig: another geometry; {ask}"
    would = "" if lpm is None else f" ({lpm:.2g} L/min if the piston has {1e6 * fit.geometry.area:.4g} mm^2)"
    return f"L/min is not stated: no rig was stated, and the size of a machine cannot be measured{would}; {ask}"


def _refused(fit: BalanceFit) -> frozenset[Figure]:
    """Refuse L/min where the geometry is another, or the side: no other detector knows these better."""
    return frozenset({"leak_lpm"}) if fit.metres and not states_flow(fit) else frozenset()


def _measured(evidence: Evidence, fit: BalanceFit) -> Evidence:
    """Return the evidence with displacement over area as measured, over the assumed one, where it can be measured."""
    if _swings(fit):
        return evidence
    half = 1.96 * fit.carrying * math.hypot(fit.scale_sd, fit.doubt, _RELATIVE * fit.scale)
    ratio = fit.misfit
    return replace(evidence, ratio=ratio, ratio_interval=(ratio - half, ratio + half)) if fit.metres else evidence


def _relative(fit: BalanceFit, leak: float, limits: tuple[float, float], open_: NDArray[np.bool_]) -> RelativeLeak:
    """Return a leak, its flow counted as `unit_flow` does [m^3/s], beside the pump's flow and as a speed."""
    piston = abs(fit.scale) if fit.by_pump else 1.0  # volumes of the piston over the assumed area
    pump = abs(fit.scale) * float(np.mean(fit.blocks.abs_flow[open_]))
    shares = [piston * flow / max(pump, np.finfo(float).tiny) for flow in (leak, *limits)]
    speeds = [piston * flow / fit.geometry.area for flow in (leak, *limits)]
    if not fit.metres:
        return RelativeLeak(shares[0], (shares[1], shares[2]))
    return RelativeLeak(shares[0], (shares[1], shares[2]), speeds[0], (speeds[1], speeds[2]))


def _mean_flow(fit: BalanceFit, law: Law = "laminar") -> float:
    """Return the mean flow [L/min] of one unit of conductance over the recording."""
    return float(fit.unit_flow(law).mean()) / LITRE_PER_MINUTE


def total_lpm(fit: BalanceFit) -> float | None:
    """Return the mean leakage of pump and piston together [L/min], None where L/min cannot be stated."""
    return level(fit).value * _mean_flow(fit) if states_flow(fit) else None


def _left_out_text(fit: BalanceFit) -> str:
    if not len(fit.left_out):
        return ""
    return (
        f"; {len(fit.left_out)} of {len(fit.left_out) + len(fit.blocks)} blocks do not balance, stand or are filled "
        f"and were left out, the first at {fit.left_out.t[0]:.4g} s"
    )


def _figures(step: DriftStep) -> str:
    return f"score {step.score:.1f}, threshold {step.threshold:.1f}"


def _part(step: DriftStep) -> Evidence:
    verdict: Verdict = "leak" if step.alarm else "no leak"
    return Evidence(verdict, "", step.score, step.threshold, detector="step of the conductance")


def _flow_text(conductance: float, fit: BalanceFit) -> str:
    """Return a conductance as a flow under the recording's own pressure difference, or as a share of the pump's."""
    if states_flow(fit):
        return f"{conductance * _mean_flow(fit):.2g} L/min"
    return f"{100.0 * _pump_share(conductance, fit):.2g} % of the pump's flow"


def _pump_share(conductance: float, fit: BalanceFit) -> float:
    """Return the mean flow of a conductance over the pump's mean flow."""
    flow = conductance * float(fit.unit_flow("laminar").mean())
    every = np.ones(len(fit.blocks), dtype=bool)
    return _relative(fit, flow, (flow, flow), every).pump_share or 0.0


def passage(fit: BalanceFit, smallest: float | None, healthy: float | None) -> Passage:
    """Return what pump and piston together pass over the recording, in L/min where that can be stated.

    `smallest`: step of the conductance that would have been found; `healthy`: conductance of a healthy machine.
    """
    own, flow = level(fit), _mean_flow(fit)
    flows = (flow, _mean_flow(fit, "orifice"))
    mean, half = own.value + (fit.pump or 0.0), 1.96 * math.hypot(own.error, fit.pump_sd, _UNKNOWN_LAW * own.value)
    smallest = None if smallest is None or not math.isfinite(smallest) else smallest
    relative = Passage(
        lpm=None,
        interval_lpm=None,
        pressure=float(fit.blocks.abs_dp.mean()),
        pump_share=_pump_share(max(mean, 0.0), fit),
        findable_share=None if smallest is None else _pump_share(smallest, fit),
    )
    if not states_flow(fit):
        return relative
    return replace(
        relative,
        lpm=max(mean, 0.0) * flow,
        interval_lpm=(max(mean - half, 0.0) * min(flows), max(mean + half, 0.0) * max(flows)),
        findable_lpm=None if smallest is None else smallest * flow,
        healthy_lpm=None if healthy is None else healthy * flow,
    )


def _from_the_start(evidence: Evidence, fit: BalanceFit, probability: float) -> Evidence:
    """Return the evidence, a leak where pump and piston surely pass more than those of a healthy machine do."""
    passes = evidence.passage
    if evidence.verdict != "no leak" or passes is None or passes.healthy_lpm is None:
        return evidence
    if passes.lpm is None or passes.interval_lpm is None:
        return evidence
    own = level(fit)
    score = (own.value + (fit.pump or 0.0) - passes.healthy_lpm / _mean_flow(fit)) / math.hypot(own.error, fit.pump_sd)
    threshold = _normal_quantile(probability)
    if score <= threshold:
        return evidence
    low, high = passes.interval_lpm
    lpm, interval = passes.lpm - passes.healthy_lpm, (max(low - passes.healthy_lpm, 0.0), high)
    flow, *limits = (LITRE_PER_MINUTE * value for value in (lpm, *interval))
    return replace(
        evidence,
        verdict="leak",
        reason=(
            f"{_passes_text(passes)}, more than the {passes.healthy_lpm:.2g} L/min of a healthy machine, from the "
            f"start (score {score:.1f}, threshold {threshold:.1f}); {evidence.reason}"
        ),
        score=score,
        threshold=threshold,
        chance=_normal_tail(score),
        leak_lpm=lpm,
        leak_interval_lpm=interval,
        relative=_relative(fit, flow, (limits[0], limits[1]), np.ones(len(fit.blocks), dtype=bool)),
        cause="piston or pump leak",
    )


def _passes_text(passes: Passage) -> str:
    if passes.lpm is None or passes.interval_lpm is None:
        flow = f"{100.0 * (passes.pump_share or 0.0):.2g} % of the pump's flow"
    else:
        flow = f"{passes.lpm:.2g} L/min ({passes.interval_lpm[0]:.2g} to {passes.interval_lpm[1]:.2g})"
    return f"pump and piston together pass {flow} at {passes.pressure / 1e6:.2g} MPa"


def no_step(
    fit: BalanceFit, step: DriftStep, fall: DriftStep | None, smallest: float, oil: Oil = "unknown"
) -> Evidence:
    """Return the evidence where no rise of the conductance stands out from its drift.

    `smallest`: the smallest step of the conductance that would have stood out, 0 where it is not asked for.
    """
    own = level(fit)
    high = own.value + 1.96 * own.error
    rise, scatter = float(step.level[-1] - step.level[0]), float(np.median(fit.sd))
    verdict: Verdict = "no leak"
    parts = [_part(step)]
    reason = (
        "no change within this recording: the leakage conductance does not rise beyond its smooth drift "
        f"({_figures(step)})"
    )
    if _pump_share(high, fit) < -LEAK_WORTH_FINDING:
        verdict = "cannot tell"
        reason = "the balance gives a leak against the pressure: areas, displacement or the pressures' signs do not fit"
        if _swings(fit):
            reason = f"the balance gives a leak against the pressure; {_no_flow_text(fit)}"
    elif oil != "thinner" and _drifts(fit, step):
        verdict = "cannot tell"
        reason = (
            f"the conductance rises smoothly by {_flow_text(rise, fit)} over the recording, more than oil that "
            f"warms up explains: a growing leak would look alike ({_figures(step)})"
        )
        if oil == "as thick":
            reason += "; friction shows that the oil keeps its viscosity: a leak grows, or the pump warms alone"
            parts.append(Evidence("cannot tell", "", rise / scatter, _SMOOTH, detector="growth of the conductance"))
    elif _pump_share(smallest, fit) > LEAK_WORTH_FINDING:
        verdict = "cannot tell"
        reason += (
            f"; but a leak of {LEAK_WORTH_FINDING:.0%} of the pump's flow, the smallest worth finding, would not have "
            "shown"
        )
    elif fall is not None and fall.alarm:
        reason = (
            f"the conductance falls at {fall.onset:.1f} s by {_flow_text(-fall.size, fit)}, which no "
            f"leak does, and never rises beyond its drift ({_figures(step)})"
        )
        if fit.changes_over or _swings(fit):
            verdict = "cannot tell"
            reason += "; or it rises: where either side carries in turn, the sense of the pressures is not surely told"
    if verdict == "no leak":
        if oil == "thinner":
            reason += f"; it drifts by {_flow_text(rise, fit)} as the oil becomes thinner, which friction shows, too"
        reason += f"; {_passes_text(passage(fit, smallest, None))}"
        if fit.pump is not None:
            reason += f", the pump {_flow_text(fit.pump, fit)} of it"
        reason += ", in which a leak from the start would be hidden"
        if _refused(fit):
            reason += f"; {_no_flow_text(fit)}"
            if not _geometry_agrees(fit):
                reason += ", or a leak from the start takes most of the flow"
        if smallest > 0.0:
            reason += f"; the smallest step that would have shown is {_flow_text(smallest, fit)}"
    return Evidence(
        verdict, reason + _left_out_text(fit), step.score, step.threshold, parts=tuple(parts), chance=step.chance
    )


def describe_leak(
    fit: BalanceFit, step: DriftStep, probability: float, pressed: tuple[float, float] | None = None
) -> Evidence:
    """Return the evidence where the conductance rises: where the oil goes, since when, how much.

    `pressed`: means of abs(p_A - p_B) and of its root while the leak is open; None: those of the blocks, which begin
    after the onset and end with the last whole cycle.
    """
    shape = shape_of(fit, step)
    near = discriminate(fit.without_slopes, step.onset, step.rise, within=reach(fit))
    cause, place = _place(fit, step, near)
    open_ = shape >= 1.0 if step.rise == 0.0 else shape > 0.0
    law = orifice_share(fit, step)
    even, unit_flow = evened(fit, law, open_) if open_.any() else (fit, fit.unit_flow("laminar"))
    again = search(even, probability) if step.rise == 0.0 and open_.any() and law.mean > _UNEVEN else step
    by_law = again if again.alarm and again.rise == step.rise else step
    size, size_sd = by_law.size, by_law.size_sd * (_BEATS if _reverses(fit) else 1.0)
    lpm, interval, course, relative = None, None, None, None
    if open_.any():
        laminar, orifice = (float(np.mean((fit.unit_flow(name) * shape)[open_])) / LITRE_PER_MINUTE for name in _LAWS)
        flow = float(np.mean((unit_flow * shape)[open_])) / LITRE_PER_MINUTE
        while_open = _while_open(fit, open_, pressed)
        laminar, orifice = laminar * while_open[0], orifice * while_open[1]
        flow *= (1.0 - law.mean) * while_open[0] + law.mean * while_open[1]
        more = abs(orifice - laminar) * size
        over = _CHANGING_OVER if fit.changes_over else 0.0
        lift = law.mean * float(np.mean(np.abs(fit.blocks.lift[open_])))
        counted = fit.doubt / abs(fit.scale)  # a loop makes good what leaks: the angle shows it, by the scale
        half = step.quantile * math.hypot(size_sd, size * math.hypot(_RELATIVE, over, lift, counted)) * flow
        less, most = (law.mean - law.low, law.high - law.mean)[:: 1 if orifice > laminar else -1]
        lpm = size * flow
        interval = max(0.0, lpm - half - less * more), lpm + half + most * more
        low, high = (LITRE_PER_MINUTE * limit for limit in interval)
        if not _swings(fit):
            relative = _relative(fit, LITRE_PER_MINUTE * lpm, (low, high), open_)
    if lpm is not None and interval is not None and states_flow(fit):
        course = _course(even, by_law, shape, unit_flow)
        by = f" by {lpm:.2g} L/min ({interval[0]:.2g} to {interval[1]:.2g})"
    else:
        by = f" by {_flow_text(size, fit)}; {_no_flow_text(fit, lpm)}"
        lpm, interval = None, None
    grows = f", over {step.rise:.0f} s" if step.rise > 0 else ""
    reason = (
        f"the leakage conductance rises at {step.onset:.1f} s{grows}{by}; {place}{_law_text(law, near)} "
        f"({_figures(step)}){_left_out_text(fit)}"
    )
    evidence = Evidence(
        "leak" if cause in LEAKS else "cannot tell" if cause == "sensor fault" else "no leak",
        reason,
        step.score,
        step.threshold,
        step.onset,
        step.onset_interval,
        lpm,
        interval,
        (_part(step),),
        cause,
        course,
        _refused(fit),
        chance=step.chance,
        relative=relative,
    )
    return evidence if evidence.verdict == "leak" else _unsized(evidence)


def _reverses(fit: BalanceFit) -> bool:
    """Return whether slopes are kept on a double rod under a force that swings."""
    cut = fit.without_slopes.blocks
    return fit.swinging is not None and abs(float(cut.slope[:, I_AB].mean())) < ONE_SIDED * float(cut.abs_dp.mean())


def _while_open(fit: BalanceFit, open_: NDArray[np.bool_], pressed: tuple[float, float] | None) -> tuple[float, float]:
    """Return means of the size of the pressure difference and of its root over those of the open blocks."""
    usual = float(np.mean(fit.blocks.abs_dp[open_])), float(np.mean(fit.blocks.root_dp[open_]))
    if pressed is None or not (min(usual) > 0.0 and np.isfinite(pressed).all()):
        return 1.0, 1.0
    return pressed[0] / usual[0], pressed[1] / usual[1]


def _law_text(law: OrificeShare, near: dict[str, float]) -> str:
    """Return the law of a leak in words where the blocks decide."""
    if law.low > _SOME and law.high < 1.0 - _SOME:
        return f"; about {law.mean:.0%} of it goes with the root of the pressure, as of an orifice, the rest is laminar"
    if near.get("orifice", 0.0) < -_DECISIVE and law.mean < 0.5:
        return "; it is laminar, as of a worn seal"
    if near.get("orifice", 0.0) > _DECISIVE and law.mean > 0.5:
        return "; it goes with the root of the pressure, as of an orifice"
    return ""


def _place(fit: BalanceFit, step: DriftStep, near: dict[str, float]) -> tuple[Cause, str]:
    """Return where the oil goes, as a cause and in words."""
    drop = _drained(fit, step)
    if drop > 0.0:
        return "external leak", (
            f"from then on the lower pressure falls, by {drop / 1e3:.2g} kPa so far: oil leaves to the outside"
        )
    # under a load the steady flow of what swings alone is that of a leak inside; oil that leaves lowers the pressure
    lost = 0.0 if fit.swinging is not None else _lost(fit, step)
    steady = one_sided_share(fit, step) if lost > 0.0 else None
    if steady is not None and abs(steady[0] - 0.5) < 0.5 + 2.0 * steady[1]:
        cause, place = _between(near)
        return cause, f"{place}; under a load that never reverses, a leak to the outside would look alike"
    if lost > 0.0:
        return "external leak", (
            f"from then on the sides lose oil unevenly, {lost / LITRE_PER_MINUTE:.2g} L/min whichever way the pressure "
            "acts: it leaves to the outside"
        )
    if near.get("scale", 0.0) > max(_SLIPPED, 2.0 * near.get("pump", 0.0), 2.0 * near.get("orifice", 0.0)):
        return "sensor fault", (
            "it is no leak but a change of the scale of position, angle or displacement: an encoder slips"
        )
    return _between(near)


def _between(near: dict[str, float]) -> tuple[Cause, str]:
    """Return whether oil that stays inside passes the piston or the pump, as a cause and in words."""
    if "pump" not in near:
        return "piston or pump leak", "pump and piston cannot be told apart without the pressures at the pump's ports"
    if near["pump"] > _DECISIVE:
        return "pump leak", "it follows the pressure at the pump's ports, not that at the piston: the pump leaks"
    if near["pump"] < -_DECISIVE:
        return "piston leak", "it follows the pressure at the piston, not that at the pump's ports"
    return (
        "piston or pump leak",
        "the pressures at the pump's ports and at the piston are too alike to tell pump from piston",
    )


def _drained(fit: BalanceFit, step: DriftStep) -> float:
    """Return by how much the lower pressure has fallen since a rise [Pa], as oil that leaves empties the circuit.

    At the rise it drops to that of the make-up, which is emptied from then on: a line that steps and bends there is
    fitted to the blocks' lower pressures, beside the size of the pressure difference, which a closed circuit takes from
    it, and a single rod's position, by which it takes oil from the make-up. 0 where no load acts, where transducers may
    drift so, where step and bend leave more of the squares than they explain, and where it merely stops rising, as a
    circuit does that has been filled.
    """
    if not (fit.keeps_slopes or loaded(fit.blocks)):
        return 0.0

    blocks = fit.blocks.chosen(fit.blocks.t > fit.blocks.t[0] + _FILLING * np.ptp(fit.blocks.t))
    after = np.clip((blocks.t - step.onset) / blocks.seconds + 0.5, 0.0, 1.0)
    if min(np.count_nonzero(after == 0.0), np.count_nonzero(after == 1.0)) < 3:
        return 0.0
    since = np.maximum(blocks.t - step.onset, 0.0)
    size = blocks.abs_dp if np.ptp(blocks.abs_dp) > _UNSTEADY * float(blocks.abs_dp.mean()) else np.zeros(len(blocks))
    place = blocks.place - blocks.place.mean() if fit.unequal else np.zeros(len(blocks))
    columns = np.stack([np.ones(len(blocks)), blocks.t, size, place, after, since], axis=1)
    columns /= np.maximum(np.abs(columns).max(axis=0), np.finfo(float).tiny)
    without, falls = (np.linalg.lstsq(part, blocks.lower, rcond=None)[0] for part in (columns[:, :4], columns))
    squares = float(np.sum((blocks.lower - columns[:, :4] @ without) ** 2))
    left = float(np.sum((blocks.lower - columns @ falls) ** 2))
    level = blocks.lower - columns[:, 2:4] @ falls[2:4]
    fallen = float(np.mean(level[after == 0.0][-3:]) - np.mean(level[after == 1.0][-3:]))
    drop = min(-float(columns[-1, 4:] @ falls[4:]), fallen)
    return drop if drop > _SENSOR_DRIFT and left < 0.5 * squares else 0.0


def _lost(fit: BalanceFit, step: DriftStep) -> float:
    """Return the flow [m^3/s] that one side loses more than the other since the rise, whatever the pressure difference.

    0 where it is no more than a bias of the pressures makes of a leak between the sides.
    """
    shape = shape_of(fit, step)
    close = np.abs(fit.blocks.t - step.onset - 0.5 * step.rise) < reach(fit) + 0.5 * step.rise
    first, last = close & (shape == 0.0), close & (shape == 1.0)
    before, after = fit.slip[first], fit.slip[last]
    if min(before.size, after.size) < 3:
        return 0.0
    leaning = fit.slip_leaning
    moved = abs(float(np.mean(leaning[last]) - np.mean(leaning[first]))) * fit.doubt
    lost = abs(float(np.mean(after) - np.mean(before)))
    deviation = float(np.sqrt(np.var(before, ddof=1) / before.size + np.var(after, ddof=1) / after.size))
    least = _LOST * step.size * float(fit.blocks.abs_dp.mean()) + 4.0 * deviation + 2.0 * moved
    return lost if lost > least else 0.0


def _whole_course(fit: BalanceFit) -> LeakCourse:
    """Return what pump and piston together pass block by block; an interval holds what all blocks share, too."""
    flow = fit.unit_flow("laminar") / LITRE_PER_MINUTE
    g = fit.g + (fit.pump or 0.0)
    shared = np.sum(fit.shared**2, axis=1) + (fit.doubt * fit.leaning) ** 2
    half = 1.96 * np.sqrt(fit.sd**2 + shared + fit.pump_sd**2 + (_LEVEL**2 + _UNKNOWN_LAW**2) * g**2) * flow
    return LeakCourse(fit.blocks.t, g * flow, g * flow - half, g * flow + half, whole=True)


def _course(fit: BalanceFit, step: DriftStep, shape: Array, unit_flow: Array) -> LeakCourse:
    """Return the leak block by block: the conductance beyond its drift, by the flow (n,) of a unit of it there."""
    flow = unit_flow / LITRE_PER_MINUTE
    lpm = (fit.g - step.level) * flow
    noise = fit.sd * max(1.0, step.noise)
    half = step.quantile * np.hypot(noise, step.size_sd * shape) * flow
    return LeakCourse(fit.blocks.t, lpm, lpm - half, lpm + half)
