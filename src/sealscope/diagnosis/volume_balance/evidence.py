"""What a volume balance comes to, as evidence in words, L/min and a course over time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealscope.diagnosis.changepoint.step_in_drift import FEWEST, StepFound
from sealscope.diagnosis.verdict.evidence import LEAKS, Cause, Evidence, Figure, LeakCourse
from sealscope.diagnosis.volume_balance.blocks import Y
from sealscope.diagnosis.volume_balance.fit import BalanceFit, told_apart
from sealscope.recordings.recording import Array

#: L/min in one m^3/s.
LPM = 6.0e4
#: Displacement over area may differ by this share from the assumed before L/min is not stated.
GEOMETRY = 0.15
#: Relative deviation of what every L/min is multiplied by: scale of the position, mean pressure difference.
_RELATIVE = 0.003
#: The motion must be this many times what the balance leaves unexplained.
_CLEAR = 20.0
#: ... and follow the angle's within this time [s]: more is no skew of channels and no filter.
_LONGEST_LAG = 0.1
_MOST_LEFT_OUT = 0.3
_RESTS = 1e-3
#: Relative deviation of a whole conductance from what is not modelled (noise in the stored oil, the reversals).
_LEVEL = 0.02
#: One place or law of a leak is told from another where it explains the blocks better by this (twice the log
#: likelihood).
_TOLD_APART = 10.0
_SLIPPED = 20.0
#: Flow that leaves for good, over what the rise of the conductance alone leaks, from which oil is lost to the outside.
_LOST = 0.6
#: A drift over this share of the conductance at the start is more than warm oil does within a recording.
_LARGE_DRIFT = 0.5
#: Blocks within this time of the rise [s], and twelve at least, tell where the oil goes.
_REACH = 60.0


def trouble(fit: BalanceFit) -> str | None:
    """Why a balance means nothing, in one line, or None."""
    n = len(fit.blocks)
    if not np.isfinite(fit.residual) or not np.all(np.isfinite(fit.g)):
        return "the balance cannot be computed: values are beyond floating point"
    if fit.share_left_out > _MOST_LEFT_OUT or n < FEWEST:
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


def t_quantile(freedom: float) -> float:
    """Factor of a deviation that gives a 95 % interval."""
    from scipy.special import stdtrit

    return float(stdtrit(max(freedom, 1.0), 0.975))


def level_interval(fit: BalanceFit) -> tuple[float, float, float]:
    """Mean conductance of the whole recording and its 95 % interval [m^3/(s Pa)], the shared errors included."""
    weight = 1.0 / fit.sd**2
    weight = weight / weight.sum()
    mean = float(weight @ fit.g)
    common = weight @ fit.shared
    sd = float(np.sqrt(np.sum((weight * fit.sd) ** 2) + common @ common + (_LEVEL * mean) ** 2))
    return mean, mean - 1.96 * sd, mean + 1.96 * sd


def geometry_fits(fit: BalanceFit) -> bool:
    """Whether displacement over area is near the assumed one, whichever way the encoders count."""
    return abs(abs(fit.scale) - 1.0) <= GEOMETRY


def refused(fit: BalanceFit, metres: bool) -> frozenset[Figure]:
    """L/min where another geometry is the reason not to state it: no other detector knows the geometry better."""
    return frozenset({"leak_lpm"}) if metres and not geometry_fits(fit) else frozenset()


def _geometry_words(fit: BalanceFit) -> str:
    return (
        f"; L/min is not stated: displacement over area is {abs(fit.scale):.3g} times the assumed one, so the geometry "
        "is another"
    )


def _left_out_words(fit: BalanceFit) -> str:
    if not len(fit.left_out):
        return ""
    return (
        f"; {len(fit.left_out)} of {len(fit.left_out) + len(fit.blocks)} blocks do not balance and were left out, the "
        f"first at {fit.left_out.t[0]:.4g} s"
    )


def lpm_words(conductance: float, fit: BalanceFit, metres: bool) -> str:
    """A conductance as a flow under the recording's own mean pressure difference, or as a share where no unit fits."""
    if metres and geometry_fits(fit):
        return f"{conductance * float(fit.blocks.abs_dp.mean()) * LPM:.2g} L/min"
    return f"{conductance / max(abs(level_interval(fit)[0]), np.finfo(float).tiny):.0%} of the conductance"


def no_step(fit: BalanceFit, found: StepFound, fall: StepFound | None, part: Evidence, *, metres: bool) -> Evidence:
    """Evidence where no rise of the conductance stands out from its drift."""
    told = f"score {found.score:.1f}, threshold {found.threshold:.1f}"
    mean, low, high = level_interval(fit)
    total = ""
    if metres and geometry_fits(fit) and high - low < max(abs(mean), abs(high)):
        flow = float(fit.blocks.abs_dp.mean()) * LPM
        total = f" {mean * flow:.2g} L/min ({max(low, 0.0) * flow:.2g} to {high * flow:.2g}) throughout"
        if fit.pump is None:
            total = f"; pump and piston together leak{total}, in which a leak from the start would be hidden"
        else:
            total = f"; the piston leaks{total}, the pump {fit.pump * flow:.2g} L/min at the same pressure difference"
    rise = float(found.level[-1, 0] - found.level[0, 0])
    if rise > _LARGE_DRIFT * max(high - 0.5 * rise, 0.0) and rise > 6.0 * float(np.median(fit.sd)):
        reason = (
            f"the conductance rises smoothly by {lpm_words(rise, fit, metres)} over the recording, more than oil that "
            f"warms up explains: a growing leak would look alike ({told}){_left_out_words(fit)}"
        )
        return Evidence("cannot tell", reason, found.score, found.threshold, parts=(part,))
    if fall is not None and fall.found:
        fell = (
            f"the conductance falls at {fall.onset:.1f} s by {lpm_words(-float(fall.size[0]), fit, metres)}, which no "
            f"leak does, and never rises beyond its drift ({told})"
        )
        return Evidence("no leak", fell + total + _left_out_words(fit), found.score, found.threshold, parts=(part,))
    reason = f"the leakage conductance does not rise beyond its smooth drift ({told}){total}{_left_out_words(fit)}"
    return Evidence("no leak", reason, found.score, found.threshold, parts=(part,))


def _shape(fit: BalanceFit, found: StepFound) -> Array:
    """Share (n,) of the leak that is open in each block."""
    lead, width = (0.5 * fit.blocks.seconds, fit.blocks.seconds) if found.rise == 0.0 else (0.0, found.rise)
    return np.clip((fit.blocks.t + lead - found.onset) / width, 0.0, 1.0)


def describe_leak(fit: BalanceFit, found: StepFound, part: Evidence, *, metres: bool) -> Evidence:
    """Evidence where the conductance rises: where the oil goes, since when, how much."""
    shape = _shape(fit, found)
    near = told_apart(fit, found.onset, found.rise, within=max(_REACH, 12.0 * fit.blocks.seconds))
    cause, place = _place(fit, found, shape, near)
    open_ = shape >= 1.0 if found.rise == 0.0 else shape > 0.0
    flow = LPM * float(np.mean((fit.blocks.abs_dp * shape)[open_])) if open_.any() else 0.0
    size, size_sd = float(found.size[0]), float(found.size_sd[0])
    law = _law(near)
    lpm, interval, course, words = None, None, None, ""
    if metres and geometry_fits(fit) and flow > 0:
        lpm = size * flow
        wide = t_quantile(found.freedom) * float(np.hypot(size_sd, _RELATIVE * size)) * flow
        interval = (max(0.0, lpm - wide), lpm + wide)
        course = _course(fit, found, shape)
        words = f" by {lpm:.2g} L/min ({interval[0]:.2g} to {interval[1]:.2g})"
    elif not metres:
        words = f" by {lpm_words(size, fit, metres)}; L/min is not stated: the position is in counts"
    else:
        words = f" by {lpm_words(size, fit, metres)}{_geometry_words(fit)}"
    grows = f", over {found.rise:.0f} s" if found.rise > 0 else ""
    told = f"score {found.score:.1f}, threshold {found.threshold:.1f}"
    reason = f"the leakage conductance rises at {found.onset:.1f} s{grows}{words}; {place}{law} ({told})"
    evidence = Evidence(
        "leak" if cause in LEAKS else "cannot tell" if cause == "sensor fault" else "no leak",
        reason + _left_out_words(fit),
        found.score,
        found.threshold,
        found.onset,
        found.onset_interval,
        lpm,
        interval,
        (part,),
        cause,
        course,
        refused(fit, metres),
    )
    if evidence.verdict == "leak":
        return evidence
    return replace(evidence, leak_lpm=None, leak_interval_lpm=None, course=None)


def _law(near: dict[str, float]) -> str:
    """Words on the law of the leak, where the recording tells."""
    if near.get("orifice", 0.0) < -_TOLD_APART:
        return "; it is laminar, as of a worn seal"
    if near.get("orifice", 0.0) > _TOLD_APART:
        return "; it goes with the root of the pressure, as of an orifice"
    return ""


def _place(fit: BalanceFit, found: StepFound, shape: Array, near: dict[str, float]) -> tuple[Cause, str]:
    """Where the oil goes, as a cause, and in words."""
    lost = _lost(fit, found, shape)
    if lost > 0.0:
        return "external leak", (
            f"from then on the sides lose oil unevenly, {lost * LPM:.2g} L/min whichever way the pressure acts: it "
            "leaves to the outside"
        )
    if near.get("scale", 0.0) > max(_SLIPPED, 2.0 * near.get("pump", 0.0)):
        return "sensor fault", (
            "it is no leak but a change of the scale of position, angle or displacement: an encoder slips"
        )
    if "pump" not in near:
        return "piston or pump leak", "pump and piston cannot be told apart without the pressures at the pump's ports"
    if near["pump"] > _TOLD_APART:
        return "pump leak", "it follows the pressure at the pump's ports, not that at the piston: the pump leaks"
    if near["pump"] < -_TOLD_APART:
        return "piston leak", "it follows the pressure at the piston, not that at the pump's ports"
    return (
        "piston or pump leak",
        "the pressures at the pump's ports and at the piston are too alike to tell pump from piston",
    )


def _lost(fit: BalanceFit, found: StepFound, shape: Array) -> float:
    """Flow [m^3/s] that one side loses more than the other since the rise, whatever the pressure difference; 0 where it
    is no more than a bias of the pressures makes of a leak between the sides."""
    reach = max(_REACH, 12.0 * fit.blocks.seconds)
    close = np.abs(fit.blocks.t - found.onset - 0.5 * found.rise) < reach + 0.5 * found.rise
    before, after = fit.slip[close & (shape == 0.0)], fit.slip[close & (shape == 1.0)]
    if min(before.size, after.size) < 3:
        return 0.0
    lost = abs(float(np.mean(after) - np.mean(before)))
    deviation = float(np.sqrt(np.var(before, ddof=1) / before.size + np.var(after, ddof=1) / after.size))
    least = _LOST * float(found.size[0]) * float(fit.blocks.abs_dp.mean()) + 4.0 * deviation
    return lost if lost > least else 0.0


def _course(fit: BalanceFit, found: StepFound, shape: Array) -> LeakCourse:
    """The leak block by block: the conductance beyond its drift, under each block's own pressure difference."""
    flow = fit.blocks.abs_dp * LPM
    lpm = (fit.g - found.level[:, 0]) * flow
    noise = fit.sd * max(1.0, float(found.noise[0]))
    wide = t_quantile(found.freedom) * np.hypot(noise, float(found.size_sd[0]) * shape) * flow
    return LeakCourse(fit.blocks.t, lpm, lpm - wide, lpm + wide)
