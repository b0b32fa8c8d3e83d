"""Speeds and flows without a sign: an encoder or a flow meter that counts pulses does not measure the direction.

A flow meter in the supply line of a valve has no sign either: the flow is positive, and the spool chooses the chamber.
Its channel is then `q_supply`, since it sees the fed chamber alone, and while the piston rests its flow is not the
cylinder's but passes the valve (`diagnosis.inference.equations.balances`).

If a speed is never negative while the piston moves both ways, either it has no sign, or the pump turns one way and a
valve chooses the side; a pump that holds a pressure may turn back a little meanwhile. A recorded command or direction
of this valve tells the side. Without it, in both cases the flow into chamber A is about a v + c (p_A - p_B), with the
piston speed v; the pressure term is the flow that replaces leakage while the piston stands. The formula is fitted to
the signed magnitude, in turn with a search for the signs. A sign changes only where the magnitude passes zero: the
signs are the most likely path of a hidden Markov chain with two states. Without a position the sign is that of the
command. At rest the magnitude is that of noise, with a positive mean; its signs are drawn at random. Called by the
inspection.

Source: A. J. Viterbi, IEEE Trans. Inf. Theory 13 (1967) 260 (most likely path).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealscope.recordings.channels import Array, finite_range, iter_stretches
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import Finding, Severity
from sealscope.recordings.recording import Recording

_PRIORS = RECORDINGS.unsigned
_MAX_ITERATIONS = 10  # most iterations of the fit; each uses the signs of the previous one
_MAX_POSITIONS = 8  # most values of a valve that switches; of one with more, the side of its centre counts
#: Mean of the magnitude of normal noise over its standard deviation; tolerance of that ratio [standard deviations].
_FOLDED_RATIO, _TOLERANCE = float(np.sqrt(2.0 / (np.pi - 2.0))), 3.0
#: Channel -> its quantity, for messages.
UNSIGNED = {"omega": "speed", "q_pump": "flow", "q_supply": "flow"}


def restore_signs(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Restore the sign of a speed or flow that stays on one side of zero while position or command moves both ways.

    It stays so if its flow to the other side is at most the fraction `unsigned.least` (`priors.toml`), as of a pump
    that holds a pressure; if it is not only noise, the restored values must follow the motion better. The magnitude
    gets the sign that the channel `valve` states (`_find_valve_sign`) or else that of the flow into chamber A
    (`_find_sign`), and random signs within the noise (`_draw_noise_signs`). A channel whose sign cannot be found stays
    as it is. A flow q_pump without a sign that was measured in a valve's supply line (`_is_in_supply_line`) becomes the
    channel q_supply. The result lacks the channel `valve`, which serves this only. Also returns a finding for each
    channel without a sign: a warning if it cannot be restored.
    """
    channels, units, findings = dict(recording.channels), dict(recording.units), list[Finding]()
    valve = channels.pop("valve", None)
    units.pop("valve", None)
    for name, quantity in UNSIGNED.items():
        if name not in recording:
            continue
        values = recording[name]
        ends = finite_range(values)
        is_one_way = ends is not None and is_one_sided(*ends)
        if not is_one_way and _moves_both_ways(values):
            continue
        motion = _motion(recording)
        if motion is None or not _moves_both_ways(motion):
            continue
        # a channel that stays below zero is mirrored, so that all but its noise is positive
        main_side = 1.0 if np.nansum(values) >= 0.0 else -1.0
        sign = None if valve is None else _find_valve_sign(valve, np.abs(values), motion)
        source = "valve"
        if sign is None or _correlation(values * sign, motion) * main_side < _PRIORS.correlation:  # of another machine
            sign, source = _find_sign(recording, np.abs(values))
        if sign is not None and not is_one_way:
            with_sign, without_sign = (_correlation(signed, motion) for signed in (values * sign, values))
            if abs(with_sign) <= abs(without_sign):  # it has a sign, and hardly moves the piston back
                continue
        if sign is None and not is_one_way:
            continue
        text = f"{name}: the {quantity} never changes its sign and the piston does"
        if sign is None:
            text += ", and nothing recorded tells its direction; map the direction or command of the valve (valve)"
        else:
            magnitude = main_side * values
            is_rectified = not np.nanmin(magnitude) < 0.0  # else the sensor states the sign of its noise
            channels[name] = (_draw_noise_signs(magnitude, recording.rate) if is_rectified else magnitude) * sign
            text += f": its sign is taken from {source}"
            text += "" if valve is not None else "; if a valve directs the flow, record its direction (--map valve=...)"
        if (
            sign is not None
            and name == "q_pump"
            and {"x", "u"} <= channels.keys()
            and _is_in_supply_line(recording, sign)
        ):
            channels["q_supply"], units["q_supply"] = channels.pop(name), units.pop(name)
            text += ", and it counts as the flow in the valve's supply line (q_supply)"
        severity: Severity = "warning" if sign is None else "note"
        findings.append(Finding("unsigned_speed", severity, name, len(recording), float(recording.t[0]), text))
    is_changed = findings or valve is not None
    return (replace(recording, channels=channels, units=units) if is_changed else recording), findings


def _motion(recording: Recording) -> Array | None:
    """Compute the piston speed (n,) or, without a position, return the command; None if neither is recorded."""
    if "x" in recording:
        return _piston_speed(recording["x"], recording.rate)
    return recording.channels.get("u")


def _find_valve_sign(valve: Array, magnitude: Array, motion: Array) -> Array | None:
    """Find the sign (n,), 1, -1 or 0, of the flow into chamber A that a directional valve states.

    `valve` (n,): its command or position. The samples are grouped by its value, if there are few values, else by the
    side of its centre, which is 0 or, if it has one sign, the middle of its range. The sign of a group is that of the
    sum of `magnitude` times `motion` in it, which is 0 where the valve stops the piston. None unless groups move the
    piston both ways, by more than the fraction `unsigned.least` of one another (`priors.toml`).
    """
    known = np.isfinite(valve)
    if not known.any():
        return None
    values, groups = np.unique(valve[known], return_inverse=True)
    if values.size > _MAX_POSITIONS:
        centre = 0.0 if values[0] < 0.0 < values[-1] else 0.5 * float(values[0] + values[-1])
        groups = np.sign(valve[known] - centre).astype(int) + 1
    moved = np.nan_to_num(magnitude * motion)[known]
    sums = np.bincount(groups, weights=moved)
    if not is_two_way(float(sums[sums > 0.0].sum()), float(-sums[sums < 0.0].sum())):
        return None
    signs = np.where(np.abs(sums) > _PRIORS.noise * np.abs(sums).max(), np.sign(sums), 0.0)
    rows, known_rows = np.arange(valve.size), np.flatnonzero(known)
    # a missing value is that of the last known one
    last_known = np.maximum(np.searchsorted(known_rows, rows, side="right") - 1, 0)
    return np.asarray(signs[groups][last_known])


def _is_in_supply_line(recording: Recording, sign: Array) -> bool:
    """Test whether a flow meter without a sign is in the supply line of a valve, and not in a line of the cylinder.

    Command and piston must move both ways, and one of two marks of the supply line is enough. The flow over the
    piston's speed, i.e. the area of the fed chamber, may differ between the directions, as with a single rod: its
    logarithm by more than `unsigned.unlike` (`priors.toml`). Or oil passes the valve while the piston rests, more than
    the fraction `unsigned.passes` of the mean flow in motion. `sign` (n,): signs of the flow into chamber A.
    """
    magnitude, speed = np.abs(recording["q_pump"]), _piston_speed(recording["x"], recording.rate)
    known = np.isfinite(magnitude)
    magnitude, speed, sign = magnitude[known], speed[known], sign[known]
    if not _moves_both_ways(recording["u"]) or not _moves_both_ways(speed):
        return False
    directions = ((speed > 0.0) & (sign > 0.0), (speed < 0.0) & (sign < 0.0))
    # flow over speed in each direction [unit of the flow per m/s]; 0 without motion that has the flow's sign
    areas = [
        float(magnitude[moves] @ np.abs(speed[moves])) / max(float(speed[moves] @ speed[moves]), np.finfo(float).tiny)
        for moves in directions
    ]
    if min(areas) > 0.0 and abs(float(np.log(areas[0] / areas[1]))) > _PRIORS.unlike:
        return True
    # faster than a fraction of the mean speed, which is weighted by the speed itself, so that rests do not count
    is_moving = np.abs(speed) > _PRIORS.rests * float(speed @ speed) / float(np.abs(speed).sum())
    flow_at_rest = float(magnitude[~is_moving].mean()) if not is_moving.all() else 0.0
    return flow_at_rest > _PRIORS.passes * float(magnitude[is_moving].mean())


def is_one_sided(lowest: float, highest: float) -> bool:
    """Test whether a channel with this range is on one side of zero, except for noise (`unsigned.noise`)."""
    smaller, larger = sorted((max(0.0, -lowest), max(0.0, highest)))
    return larger > 0.0 and smaller <= _PRIORS.noise * larger


def is_two_way(outward: float, inward: float) -> bool:
    """Test whether the smaller of two distances is more than the fraction `unsigned.least` of the larger one."""
    smaller, larger = sorted((outward, inward))
    return smaller > _PRIORS.least * larger > 0.0


def restore_flow(values: Array, x: Array, difference: Array, rate: float, flow_per_speed: tuple[float, float]) -> Array:
    """Restore the sign of a speed or flow (n,) that has none, in a part of a stream.

    `x`, `difference` (n,): position [m] and p_A - p_B [Pa]; `rate`: sampling rate [Hz]; `flow_per_speed`: magnitude
    over the piston's speed while x grows and while it falls, known from earlier parts.
    """
    main_side = 1.0 if np.nansum(values) >= 0.0 else -1.0
    speed = _piston_speed(x, rate)
    sign = _fit_signs(difference, speed, np.abs(values), rate, np.array(flow_per_speed))
    return _draw_noise_signs(main_side * values, rate) * sign


def _find_sign(recording: Recording, magnitude: Array) -> tuple[Array | None, str]:
    """Find the signs (n,), +1 or -1, of the flow into chamber A; also return the source of the signs, in words.

    The signs are fitted to the position (`_fit_signs`) or, without a position, are those of the command. Returns (None,
    "") if neither is recorded, or if the one used moves one way only or hardly correlates with the `magnitude` (n,).
    """
    has_position = "x" in recording
    if not has_position and "u" not in recording:
        return None, ""
    motion = _piston_speed(recording["x"], recording.rate) if has_position else recording["u"]
    if not _moves_both_ways(motion) or _correlation(np.abs(motion), magnitude) < _PRIORS.correlation:
        return None, ""
    if has_position:
        has_pressures = {"p_A", "p_B"} <= recording.channels.keys()
        difference = recording["p_A"] - recording["p_B"] if has_pressures else np.zeros(len(recording))
        signs = _fit_signs(difference, motion, magnitude, recording.rate)
        return signs, "the position's rate and the pressures"
    return np.where(motion < 0.0, -1.0, 1.0), "the command"


def _piston_speed(x: Array, rate: float) -> Array:
    """Compute the piston speed (n,) [m/s] from positions `x` (n,) [m] `unsigned.half` [s] before and after a sample.

    `rate`: sampling rate [Hz]. Missing positions are interpolated; the speed is 0 if all are missing.
    """
    n_half = _half_span(rate)
    x = _interpolate_missing(x)
    # the position is taken as constant before the beginning and after the end
    padded = np.concatenate([x[:1].repeat(n_half), x, x[-1:].repeat(n_half)])
    return np.asarray((padded[2 * n_half :] - padded[: -2 * n_half]) * (0.5 * rate / n_half))


def _half_span(rate: float) -> int:
    """Round `unsigned.half` of `priors.toml` to samples at `rate` [Hz], at least one."""
    return max(1, round(_PRIORS.half * rate))


def _moves_both_ways(values: Array) -> bool:
    """Test whether a speed or command (n,) moves far enough in both directions.

    Of the sums of its positive and of its negative values, the smaller must exceed `unsigned.least` times the larger.
    """
    outward = inward = 0.0
    for stretch in iter_stretches(values.size):
        outward += float(np.nansum(np.maximum(values[stretch], 0.0)))
        inward -= float(np.nansum(np.minimum(values[stretch], 0.0)))
    return is_two_way(outward, inward)


def _correlation(first: Array, second: Array) -> float:
    """Compute the correlation of two channels (n,) over the rows known in both; 0 if constant or under three rows."""
    known = np.isfinite(first) & np.isfinite(second)
    if np.count_nonzero(known) < 3 or not (np.ptp(first[known]) > 0.0 and np.ptp(second[known]) > 0.0):
        return 0.0
    return float(np.corrcoef(first[known], second[known])[0, 1])


def _fit_signs(
    difference: Array, speed: Array, magnitude: Array, rate: float, known_areas: Array | None = None
) -> Array:
    """Estimate the signs (n,) of the flow into chamber A from the piston speed and the chamber pressures.

    The model is sign x `magnitude` = a v + c (p_A - p_B), with the piston speed v = `speed` [m/s], a coefficient a for
    each direction, `known_areas` (2,) if these are known, and the leakage conductance c. The last term is 0 without
    pressures, a `difference` (n,) [Pa] of zeros. Fits alternate with searches for the signs, at first those of the
    speed, until no sign changes or `_MAX_ITERATIONS` are reached. `rate`: sampling rate [Hz].
    """
    known = np.isfinite(speed) & np.isfinite(difference) & np.isfinite(magnitude)
    speed, difference = (np.where(known, values, 0.0) for values in (speed, difference))  # evidence for neither sign
    magnitude = _interpolate_missing(magnitude)  # with 0, a change of sign beside a gap would cost nothing
    motion = np.column_stack([np.maximum(speed, 0.0), np.minimum(speed, 0.0)])
    step_scale = _average_nearby(np.abs(np.diff(magnitude)), rate)  # of the Laplace density below
    step_scale = np.maximum(step_scale, np.finfo(float).eps * magnitude.max() + np.finfo(float).tiny)
    # log odds against a change of sign after a sample: a change makes the step of the signed values larger by twice the
    # smaller magnitude, such steps have a Laplace density, and changes are rare
    cost_of_change = 2.0 * np.minimum(magnitude[1:], magnitude[:-1]) / step_scale
    cost_of_change += max(0.0, np.log(rate / _PRIORS.changes))
    speed_variance = _noise_variance(speed, rate)
    sign = np.where(speed < 0.0, -1.0, 1.0)
    # at first all flow replaces leakage; in motion, where this is wrong, the variance is large
    leak_flow = magnitude * np.sign(difference)
    for _ in range(_MAX_ITERATIONS):
        # the pump moves the piston and replaces leakage, so that no coefficient is negative
        areas = known_areas
        if areas is None:
            areas = np.maximum(np.linalg.lstsq(motion, sign * magnitude, rcond=None)[0], 0.0)
        motion_flow = motion @ areas
        # the variance is due to noise of the position, and to errors in proportion to the flow, such as by delays
        variance = areas.max() ** 2 * speed_variance + (_PRIORS.error * magnitude) ** 2 + np.finfo(float).tiny
        # weighted least squares; 0 without a pressure difference
        weights = variance.min() / variance
        information = max(float(np.sum(difference**2 * weights)), np.finfo(float).tiny)
        conductance = max(float(np.sum(difference * leak_flow * weights)) / information, 0.0)
        predicted = motion_flow + conductance * difference
        # log of the ratio of two normal densities, that for a positive sign over that for a negative one
        log_odds = 2.0 * magnitude * predicted / variance
        previous_sign = sign
        sign = _most_likely_signs(log_odds, cost_of_change)
        if np.array_equal(sign, previous_sign):
            break
        leak_flow = sign * magnitude - motion_flow
    return sign


def _noise_variance(speed: Array, rate: float) -> float:
    """Estimate the noise variance [(m/s)^2] of a piston speed (n,) sampled at `rate` [Hz]; 0 for a short recording.

    It is half the median of the locally averaged squared differences of samples just over twice `unsigned.half` apart,
    whose speeds share no position. Motion changes only some of these averages, and hardly their median.
    """
    n_lag = 2 * _half_span(rate) + 1
    steps = speed[n_lag:] - speed[:-n_lag]
    return 0.5 * float(np.median(_average_nearby(steps**2, rate))) if steps.size else 0.0


def _average_nearby(values: Array, rate: float) -> Array:
    """Average values (n,) over the time `unsigned.nearby` [s] of `priors.toml` on either side of each value."""
    n_half = max(1, round(_PRIORS.nearby * rate))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    first = np.maximum(np.arange(values.size) - n_half, 0)
    after = np.minimum(np.arange(values.size) + n_half + 1, values.size)
    return np.asarray((sums[after] - sums[first]) / (after - first))


def _interpolate_missing(values: Array) -> Array:
    """Interpolate missing values (n,) linearly; those at the ends equal the nearest known one, or 0 without any."""
    known, rows = np.isfinite(values), np.arange(len(values))
    return np.interp(rows, rows[known], values[known]) if known.any() else np.zeros(len(values))


def _draw_noise_signs(values: Array, rate: float) -> Array:
    """Restore the zero mean of noise that is recorded without its sign, by random signs; missing values (n,) stay so.

    The magnitude of normal noise has a mean of sqrt(2 / (pi - 2)) = 1.32 times its standard deviation. Where the ratio
    of the local mean of `values` (n,) to their local standard deviation, from second differences, is at most 1.32 plus
    three standard errors, they are taken for noise and get random signs. `rate`: sampling rate [Hz].
    """
    if values.size < 3:
        return values
    known = np.isfinite(values)
    values = _interpolate_missing(values)  # with 0, a gap would have the second difference of much noise
    mean = _average_nearby(values, rate)
    # the mean square of the second difference of white noise is six times the variance
    squares = np.pad(np.diff(values, 2) ** 2, 1, mode="edge") / 6.0
    deviation = np.sqrt(_average_nearby(squares, rate))
    n_nearby = 2 * max(1, round(_PRIORS.nearby * rate)) + 1
    # the root is the standard error of mean / deviation from `n_nearby` samples
    max_ratio = _FOLDED_RATIO + _TOLERANCE * np.sqrt((1.0 + 0.5 * _FOLDED_RATIO**2) / n_nearby)
    is_noise = mean <= max_ratio * deviation
    signs = np.where(np.random.default_rng(0).random(values.size) < 0.5, -1.0, 1.0)
    return np.where(known, np.where(is_noise, signs * values, values), np.nan)


def _most_likely_signs(log_odds: Array, cost_of_change: Array) -> Array:
    """Find the most likely sequence of signs (n,), +1 or -1, by the Viterbi algorithm.

    `log_odds` l (n,): log odds of a positive over a negative sign, from each sample alone; `cost_of_change` c (n - 1,):
    log odds against a change of sign after each sample. From the best paths up to sample k, the log odds of its sign
    are o_k = l_k + min(max(o_(k-1), -c_(k-1)), c_(k-1)). Sample k has the sign of o_k if |o_k| > c_k, else that of
    sample k + 1; the last sample has the sign of its o_k.
    """
    path_odds = np.empty(log_odds.size)
    odds = 0.0
    for k, (evidence, cost) in enumerate(zip(log_odds.tolist(), [0.0, *cost_of_change.tolist()], strict=True)):
        odds = min(max(odds, -cost), cost) + evidence
        path_odds[k] = odds
    # if its odds exceed the cost of the next change, a sample keeps its sign whatever follows
    decided = np.abs(path_odds) > np.append(cost_of_change, 0.0)
    decided[-1:] = True  # a slice, as there may be no samples
    # the first decided sample from each sample on
    following = np.flatnonzero(decided)[np.searchsorted(np.flatnonzero(decided), np.arange(log_odds.size))]
    return np.where(path_odds[following] < 0.0, -1.0, 1.0)
