"""Judge a hold: what may leak, pass or fail against a limit, minutes that are still needed, and the reason in words."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.estimate.population import Mixture
from sealscope.diagnosis.hold.hold_equation import HeldLoad
from sealscope.diagnosis.hold.limits import decide_result
from sealscope.diagnosis.hold.plan import predict_rate_error
from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.paragraphs import join_names
from sealscope.units import BAR, LITRE_PER_MINUTE, ML_PER_MINUTE, MM_PER_MINUTE

PISTON, VALVE, ROD_SEAL, LINE, COOLING = "piston", "load-holding valve", "rod seal", "line", "cooling"
#: Longest hold that is advised [min], and the ratio of a tried duration to the one before.
LONGEST_ADVISED, TRIED_RATIO = 24 * 60.0, 1.2
_CAP = "cap the port of side {side} at the cylinder and hold again: if it sinks as before, the piston leaks"
_SWAP = "hold the load on the other side: a leak of the piston stays, one of the rod seal does not"
_CAP_LINE = "cap the port of side {side} at the cylinder and hold again: if it still sinks, the rod seal leaks"
_CLOSE = "close the line at the valve: if it still sinks, the line leaks"


def judge_hold(hold: HeldLoad) -> HoldResult:
    """Judge a hold against the limit that the caller states, if any."""
    set_up, leak, limit = hold.set_up, hold.leak, hold.set_up.limit
    creep, pressure = None if hold.creep is None else hold.creep.rate, hold.mean_pressure
    creep_ends, rate_ends, flow_ends = (rate and rate.interval for rate in (creep, leak.rate, leak.flow))
    # a creep must be within its limit as it is seen; it fails by the part that no cooling explains
    seen_ends = rate_ends
    if rate_ends is not None and creep_ends is not None:
        seen_ends = min(rate_ends[0], creep_ends[0]), max(rate_ends[1], creep_ends[1])
    reference, converted = set_up.reference_pressure, leak.converted
    converted_ends = None if converted is None else converted.interval
    compared, interval, scale = leak.rate, seen_ends, MM_PER_MINUTE
    if limit is not None and limit.kind == "flow":
        compared, interval, scale = leak.flow, flow_ends, 1.0
        if limit.pressure is not None:
            compared, interval = converted, converted_ends
    shown, shown_ends = (leak.rate, rate_ends) if leak.flow is None else (leak.flow, flow_ends)
    bound = None if limit is None else limit.value / scale
    result = None
    if bound is not None:
        result = "undecided" if interval is None else decide_result(interval, bound)
        is_fed = shown_ends is not None and shown_ends[1] < 0.0  # a leak into the chamber is a leak
        if is_fed and interval is not None and interval[0] < -bound:
            result = "undecided"
    has_leak = shown_ends is not None and shown_ends[0] > 0.0
    if shown is not None and hold.warming > HOLD.cooling.steady:  # the prior of cooling is an assumption
        has_leak &= shown.below(0.0) < HOLD.other.sure
    sinks = creep_ends is not None and creep_ends[0] > 0.0
    by_cooling = sinks and not has_leak
    causes = _list_causes(hold) if has_leak else (COOLING,) if by_cooling else ()
    minutes = None
    if result == "undecided" and compared is not None and bound is not None:
        # to mm/min; without an area a flow has no speed
        area = set_up.area(hold.loaded) if limit is not None and limit.kind == "flow" else 1.0
        minutes = find_minutes(hold, abs(compared.mean - bound) * scale / (MM_PER_MINUTE * (area or math.inf)))
    elif by_cooling and leak.rate is not None:
        minutes = find_minutes(hold, abs(leak.rate.mean))
    curve = leak.curve
    t = None if hold.recording is None else hold.recording.t
    return HoldResult(
        file=hold.file,
        start_s=None if t is None else float(t[0]),
        end_s=None if t is None else float(t[-1]),
        creep_mm_per_min=None if creep is None else creep.mean,
        creep_interval_mm_per_min=creep_ends,
        leak_lpm=None if leak.flow is None else leak.flow.mean / LITRE_PER_MINUTE,
        leak_interval_lpm=_convert_ends(flow_ends),
        pressure_bar=None if pressure is None else pressure / BAR,
        leak_at_lpm=None if converted is None else converted.mean / LITRE_PER_MINUTE,
        leak_at_interval_lpm=_convert_ends(converted_ends),
        at_bar=None if converted is None or reference is None else reference / BAR,
        result=result,
        limit=None if limit is None else limit.text,
        causes=causes,
        second_test=_second_test(hold, causes),
        minutes_needed=minutes,
        reason=_describe(hold, result, causes, minutes, _name_lack(hold) if bound and compared is None else ""),
        start=hold.start,
        areas_mm2=tuple(1e6 * area for area in set_up.areas),
        oil=describe_oil(hold),
        quality=tuple(hold.findings),
        curve=curve,
    )


def _convert_ends(ends: tuple[float, float] | None) -> tuple[float, float] | None:
    """Convert the interval of a flow from m^3/s to L/min; None for None."""
    return None if ends is None else (ends[0] / LITRE_PER_MINUTE, ends[1] / LITRE_PER_MINUTE)


def _list_causes(hold: HeldLoad) -> tuple[str, ...]:
    """List the parts that may leak, by the other side's pressure and the stated set-up."""
    set_up, loaded, other = hold.set_up, hold.loaded, hold.unloaded
    if set_up.collected is not None or (hold.recording is not None and "q_leak" in hold.recording):
        return (PISTON,)
    outlets = []
    if loaded not in set_up.capped:
        outlets = [VALVE] if set_up.valves is None or loaded in set_up.valves else []
    area, other_area = set_up.area(loaded), set_up.area(other)
    if len(set_up.areas) < 2 or area is None or other_area is None or area <= other_area:
        outlets.append(ROD_SEAL)
    if loaded not in set_up.capped:
        outlets.append(LINE)
    evidence = _weigh_piston(hold)
    if evidence > 0 or not outlets:
        return (PISTON,)
    return tuple(outlets) if evidence < 0 else (PISTON, *outlets)


def _weigh_piston(hold: HeldLoad) -> int:
    """Weigh what the other side's pressure tells: 1 for the piston, -1 against it, 0 if it tells nothing.

    A closed other side gains what passes the piston. Its pressure rises by it, and falls as the piston sinks.
    """
    gain, leak = hold.gain, hold.leak
    if gain is None or leak.rate is None:
        return 0
    low, high = gain.interval
    prior, is_material = HOLD.other, abs(gain.mean) > HOLD.other.material * abs(leak.rate.mean)
    if hold.is_closed and is_material and low > 0.0:
        return 1
    area, other_area = hold.set_up.area(hold.loaded), hold.set_up.area(hold.unloaded)
    ratio = 1.0 if area is None or other_area is None else other_area / area
    travel = Mixture(np.ones(1), np.zeros(1), np.zeros(1)) if hold.creep is None else hold.creep.rate
    gained = ratio * (travel.mean + gain.mean)
    # oil of that side that may cool unlogged
    kelvin = min(HOLD.cooling.sizes) if hold.warming > HOLD.cooling.steady else 0.0
    cooled = 1e3 * hold.set_up.column(hold.unloaded, None)[0] * HOLD.cooling.expansion * kelvin / (hold.duration / 60.0)
    highest = gained + WITHIN_95 * ratio * math.hypot(travel.deviation, gain.deviation, cooled)
    falls = is_material and high < 0.0
    is_shut = hold.unloaded in hold.set_up.capped or falls
    return -1 if is_shut and highest < prior.minor * leak.rate.interval[0] else 0


def _second_test(hold: HeldLoad, causes: Sequence[str]) -> str:
    """Return the test that separates the causes of a leak; "" if there is one cause only, or none."""
    outlets = [cause for cause in causes if cause in (VALVE, LINE)]
    if len(causes) < 2:
        return ""
    if PISTON in causes:
        return _CAP.format(side=hold.loaded) if outlets else _SWAP
    return _CAP_LINE.format(side=hold.loaded) if ROD_SEAL in causes else _CLOSE


def find_minutes(hold: HeldLoad, margin: float) -> float | None:
    """Find the minutes to hold in addition until the interval's half-width is below a `margin` [mm/min].

    None if that takes more than `LONGEST_ADVISED`, or if nothing was fitted.
    """
    fit, minutes = hold.leak.fit, hold.duration / 60.0
    if fit is None:
        return None
    length, _ = hold.column
    noise, n_readings = fit.noise, len(fit.fit) / minutes

    def suffices(total: float) -> bool:
        """Test whether a hold of `total` minutes makes the half-width small enough."""
        error = predict_rate_error(total, n_readings * total, noise, fit.s, hold.duration, length, hold.warming)
        return WITHIN_95 * math.hypot(error, hold.thermal_error / total) < margin

    n_tried = max(math.ceil(math.log(LONGEST_ADVISED / minutes) / math.log(TRIED_RATIO)), 0)
    totals = [minutes * TRIED_RATIO**k for k in range(1, n_tried + 1)]
    k = bisect_left(totals, True, key=suffices)
    return float(math.ceil(totals[k] - minutes)) if k < len(totals) else None


def describe_oil(hold: HeldLoad) -> str:
    """Describe what is known of the oil's temperature."""
    if hold.recording is not None and "T_oil" in hold.recording:
        T = hold.recording["T_oil"] - 273.15
        T = T[np.isfinite(T)]
        return f"logged, {T[0]:.3g} to {T[-1]:.3g} degC" if T.size else "not logged"
    stated = hold.set_up.oil_temperature, hold.set_up.oil_course
    words = ["" if stated[0] is None else f"{stated[0]:.3g} degC", stated[1]]
    return " ".join(filter(None, words)) + " (stated)" if any(words) else "not logged"


def format_estimate(value: float, low: float, high: float) -> str:
    """Format a value with its interval, "0.674 (0.670 to 0.678)", to two digits of the interval's half-width."""
    half = 0.5 * (high - low)
    decimals = min(max(1 - math.floor(math.log10(half)), 0), 6) if half > 0.0 else 3
    value, low, high = (round(number, decimals) + 0.0 for number in (value, low, high))
    return f"{value:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f})"


def _name_lack(hold: HeldLoad) -> str:
    """Name what a limit cannot be compared without: the pressure held, to convert a flow, or the area."""
    if hold.leak.flow is not None and hold.set_up.limit is not None and hold.set_up.limit.kind == "flow":
        return "the pressure that was held" + (" ('... at 200 bar')" if hold.set_up.collected else "")
    return "the piston's area (--area)"


def _describe(hold: HeldLoad, result: str | None, causes: Sequence[str], minutes: float | None, lack: str) -> str:
    """Describe the result of a hold in a sentence or two; `lack`: what the limit needs that is not known, or ""."""
    parts, leak = [], hold.leak
    place = "" if hold.mean_pressure is None else f" at {hold.mean_pressure / BAR:.3g} bar"
    if hold.creep is not None:
        mean, (low, high) = hold.creep.rate.mean, hold.creep.rate.interval
        if high < 0.0:
            parts.append(f"rises by {format_estimate(-mean, -high, -low)} mm/min{place}")
        else:
            parts.append(f"sinks by {format_estimate(mean, low, high)} mm/min{place}")
    if leak.flow is not None:
        mean, (low, high) = leak.flow.mean / ML_PER_MINUTE, (end / ML_PER_MINUTE for end in leak.flow.interval)
        if low > 0.0:
            words = f"leak {format_estimate(mean, low, high)} mL/min"
        elif high < 0.0:
            words = f"oil enters, {format_estimate(-mean, -high, -low)} mL/min: past the piston, a valve, or it warms"
        else:
            words = f"no leak above {high:.2g} mL/min"
        stop = ", if the piston rests on its stop: log its position" if leak.fit is not None else ""
        parts.append(words + ("" if hold.creep is not None else place + stop))
    text = "; ".join(parts) or "neither creep nor leak can be estimated"
    if lack:
        text += f"; the limit needs {lack}"
    advice = ["log the oil's temperature"] if hold.warming else []
    advice += [] if minutes is None else [f"hold for {minutes:.0f} min more"]
    if COOLING in causes and hold.creep is not None:
        length, _ = hold.column
        kelvin = hold.creep.rate.mean * hold.duration / 60.0 / (HOLD.cooling.expansion * length)
        text += f"; cooling by {kelvin:.2g} K would do the same{': ' if advice else ''}{', or '.join(advice)}"
    elif result == "undecided" and not lack:
        text += f"; too close to the limit{f': hold for {minutes:.0f} min more' if minutes is not None else ''}"
    elif causes:
        text += f"; {' or '.join(causes) if len(causes) < 3 else join_names(causes[:-1]) + ' or ' + causes[-1]}"
    return text
