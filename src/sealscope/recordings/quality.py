"""Find defects in a recording: they are reported, never repaired.

Quantised and slow signals pass all tests of a channel's values. Together, the readings must be able to come from a
hydraulic machine: they are no mere noise, no copied channel, and in no wrong units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import count
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.calls import checked_call
from sealscope.paragraphs import format_count
from sealscope.recordings.channels import (
    CHAMBERS,
    COUNTS,
    METERS,
    SLOW,
    UNUSED,
    Array,
    chambers_of,
    iter_stretches,
    smallest_step,
    summarize_intervals,
)
from sealscope.recordings.formats.headings.labels import Label, is_pressure
from sealscope.recordings.motion import find_runs, find_stuck, is_constant
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording

Severity = Literal["note", "warning", "fatal"]

SHORTEST = 226  # fewest samples of a recording, the length of db8's level-4 filter: (16 - 1)(2^4 - 1) + 1
_CLOCK, _HUM, _CREEP, _RAIL, _SENSOR_LIMITS, _GAPS = (
    RECORDINGS.clock, RECORDINGS.hum, RECORDINGS.creep, RECORDINGS.rail, RECORDINGS.possible, RECORDINGS.gaps
)  # fmt: skip
_LONGEST_TRANSFORM = 2**17  # most values of a Fourier transform, which stays in the processor's cache
_MAX_TEXT = 400  # longest text taken from the provenance of a file
_MAX_PLACES = 200  # most places that a finding lists
#: Intervals between these numbers of sampling steps are regular; a longer one is a gap, unless a logger polls.
_MIN_STEP, _MAX_STEP = _CLOCK.regular


#: Code of the finding on a channel that the healthy recordings have and the judged one lacks.
MISSING_CHANNEL = "missing_channel"


@dataclass(frozen=True)
class Finding:
    """One defect of a recording."""

    code: str  # kind of defect
    #: ``fatal``: the recording cannot be analysed as it is; ``warning``: check the time or the channel before you rely
    #: on a verdict; or ``note``.
    severity: Severity
    channel: str | None  # None for the time
    count: int  # number of samples or intervals
    first_t: float | None  # time of the first [s], None if it has none
    text: str  # description in words
    #: Times of the first places at which it was found [s], at most 200; empty for a defect of the whole recording.
    places: tuple[float, ...] = field(default=(), compare=False, repr=False)


def locate_rows(t: Array, rows: NDArray[Any]) -> tuple[float, ...]:
    """Return the times [s] of the first of the `rows` for `Finding.places`; `t` (n,): times of all rows."""
    times = t[rows[:_MAX_PLACES]]
    return tuple(times[np.isfinite(times)].tolist())


@checked_call
def inspect(recording: Recording) -> tuple[Finding, ...]:
    """Find the defects of a recording's times and channels.

    Codes of what was found when the file was read: ``clock_wrapped``, ``wrong_times``, ``rows_written_twice``,
    ``rows_sorted``, ``clock_set``, ``clock_restarted``, ``angle_unwrapped``, ``angle_ambiguous``. Codes of the time:
    ``too_short``, ``missing_time``, ``reversed_time``, ``duplicated_time``, ``gap``, ``rate_mismatch``,
    ``irregular_sampling``; of a channel: ``missing``, ``mixed_rate``, ``infinite``, ``constant``, ``impossible``,
    ``clipped``, ``stuck``, ``mains_hum``, ``raw_counts``; of both chambers: ``creeping_pressures``.

    Parameters
    ----------
    recording : Recording
        The recording to inspect; it is not changed.

    Returns
    -------
    tuple of Finding
        Findings on the time, then on each channel but slow ones (T_oil), then on both chambers; empty without a defect.

    Examples
    --------
    >>> import numpy as np
    >>> import sealscope as ss
    >>> t = np.arange(1000) / 500
    >>> t[400:] += 0.1
    >>> for finding in ss.inspect(ss.Recording(t, {"p_A": np.full(1000, 3e5)}, {"p_A": "Pa"}, rate=500.0)):
    ...     print(finding.severity, finding.code, "-", finding.text)
    warning gap - 1 gap, about 50 samples lost, the longest 0.102 s
    warning constant - p_A: is constant at 300000 Pa
    """
    with np.errstate(all="ignore"):
        findings = [*_reading_findings(recording), *_time_findings(recording)]
        for name, values in recording.channels.items():
            findings += _channel_findings(recording, name, values) if name not in SLOW else []
        findings += _creep_findings(recording)
    return tuple(findings)


def weigh_defects(count: float, total: int) -> Severity:
    """Return "note" for so few defective samples of `total` that no verdict depends on them, else "warning"."""
    return "note" if count <= _GAPS.few * total else "warning"


def _make_finding(
    recording: Recording, code: str, channel: str | None, count: int, rows: NDArray[Any] | int, text: str,
    severity: Severity,
) -> Finding:  # fmt: skip
    """Make a finding on `count` samples, at the `rows` (k,), or of the whole recording from a row on.

    Its time is that of the first row, None if that is unknown.
    """
    first = rows if isinstance(rows, int) else int(rows[0])
    t = float(recording.t[first]) if first < recording.t.size else np.nan
    places = () if isinstance(rows, int) else locate_rows(recording.t, rows)
    return Finding(code, severity, channel, count, t if np.isfinite(t) else None, text, places)


def _reading_findings(recording: Recording) -> list[Finding]:
    """List the findings made when a recording was read, from the entry `reading` of its provenance.

    Entries that are not written by `formats.table` are ignored: the provenance of a file may hold anything.
    """
    entries = recording.provenance.get("reading")
    findings = []
    for entry in entries if isinstance(entries, Sequence) and not isinstance(entries, str) else ():
        with suppress(KeyError, TypeError, ValueError, AttributeError, OverflowError):
            severity: Severity = "warning" if entry["severity"] == "warning" else "note"
            code, text = str(entry["code"])[:_MAX_TEXT], str(entry["text"])[:_MAX_TEXT]
            channel = "theta" if entry.get("channel") == "theta" else None
            findings.append(Finding(code, severity, channel, int(entry["count"]), float(entry["first_t"]), text))
    return findings


def _is_known_break(recording: Recording, times: Array) -> NDArray[np.bool_]:
    """Flag the times (n,) [s] at which a clock was set or a logger restarted, by the recording's provenance."""
    breaks = recording.provenance.get("clock_breaks")
    try:
        return np.isin(times, np.asarray(breaks if breaks is not None else (), dtype=np.float64))
    except (TypeError, ValueError):
        return np.zeros(times.size, dtype=bool)


def _time_findings(recording: Recording) -> list[Finding]:
    """List the defects of a recording's times and sampling rate."""
    t, findings, step = recording.t, list[Finding](), 1.0 / recording.rate

    def add(code: str, indices: NDArray[Any], text: str, severity: Severity = "warning") -> None:
        """Add a finding on the samples or intervals `indices`, if there are any."""
        if indices.size:
            findings.append(_make_finding(recording, code, None, indices.size, indices, text, severity))

    if len(recording) < SHORTEST:
        text = f"{format_count(len(recording), 'sample')}; the slowest detail needs {SHORTEST}"
        too_short = [Finding("too_short", "warning", None, len(recording), None, text)]
    else:
        too_short = []
    intervals = summarize_intervals(t)
    largest_deviation = max(abs(length / step - 1.0) for length in (intervals.shortest, intervals.longest))
    if intervals.number and largest_deviation <= min(_CLOCK.scatter, _CLOCK.rate):
        return too_short  # no interval is long, short or out of step
    timed, untimed = np.flatnonzero(np.isfinite(t)), np.flatnonzero(~np.isfinite(t))
    steps = np.diff(t[timed])
    reversed_steps, equal_steps = np.flatnonzero(steps < 0), np.flatnonzero(steps == 0)
    positive_steps = steps[steps > 0]
    severity = weigh_defects(untimed.size, len(recording))
    add("missing_time", untimed, f"{format_count(untimed.size, 'sample')} without a time", severity)
    largest_step_back = float(-steps[reversed_steps].min(initial=0.0))
    text = f"time goes back {_format_repetitions(reversed_steps.size)}, by up to {largest_step_back:g} s"
    add("reversed_time", timed[reversed_steps + 1], text)
    text = f"{format_count(equal_steps.size, 'time stamp')} equal to the one before"
    add("duplicated_time", timed[equal_steps + 1], text)
    if positive_steps.size:
        median_step = float(np.median(positive_steps))
        sampling_step = step  # from sample to sample; `step` below: from time stamp to time stamp
        if abs(median_step / step - 1.0) > _CLOCK.rate:
            # stamps of a coarse clock repeat, and their positive steps are about two sampling steps long
            n_repeats = steps.size * (1.0 - step / median_step)  # expected if no sample is lost; half is enough
            if not (step < median_step < 2.5 * step and equal_steps.size > 0.5 * n_repeats):
                text = f"time stamps show {1.0 / median_step:.6g} Hz, the recording's rate is {recording.rate:g} Hz"
                add("rate_mismatch", timed[:1], text, "fatal")
                sampling_step = median_step
            step = median_step  # gaps and scatter are those of the real clock
        max_step = _longest_regular_step(positive_steps / step)  # [step]
        if max_step > _MAX_STEP:  # a logger that polls: from sample to sample it takes the mean of its intervals
            sampling_step = float(positive_steps[positive_steps <= max_step * step].mean())
        gaps = np.flatnonzero(steps > max_step * step)
        gaps = gaps[~_is_known_break(recording, t[timed[gaps + 1]])]  # the pause of a restart is only assumed
        n_lost = np.round((steps[gaps] - step) / sampling_step).sum()  # infinite if a time is absurd
        samples = format_count(int(n_lost), "sample") if n_lost < 1e15 else f"{n_lost:.3g} samples"
        longest = float(steps[gaps].max(initial=0.0))
        text = f"{format_count(gaps.size, 'gap')}, about {samples} lost, the longest {longest:g} s"
        add("gap", timed[gaps], text, weigh_defects(float(n_lost), len(recording)))
        regular_steps = positive_steps[positive_steps <= max_step * step] / step
        scatter = float(regular_steps.std()) if regular_steps.size else 0.0
        if scatter > _CLOCK.scatter:
            is_irregular = (steps > 0) & (steps <= max_step * step) & (np.abs(steps / step - 1.0) > _CLOCK.scatter)
            text = f"intervals scatter by {100 * scatter:.0f} % of the sampling step"
            add("irregular_sampling", timed[np.flatnonzero(is_irregular)], text)
    return findings + too_short


def _longest_regular_step(steps: Array) -> float:
    """Find the longest interval that is no gap, of positive `steps` (n,), all in sampling steps.

    A converter loses whole samples, so that its intervals are whole numbers of sampling steps, to within
    `clock.scatter` of `priors.toml` (rms). Those of a logger that polls are not, and are no gap up to `clock.near`.
    """
    near_steps = steps[steps <= _CLOCK.near]
    deviations = near_steps - np.round(near_steps)
    is_polled = near_steps.size and math.sqrt(float(np.mean(deviations**2))) > _CLOCK.scatter
    return float(_CLOCK.near if is_polled else _MAX_STEP)


def _format_repetitions(count: int) -> str:
    """Format the number of times that something happens, such as `once` or `2 times`."""
    return "once" if count == 1 else f"{count} times"


def _creep_findings(recording: Recording) -> list[Finding]:
    """Find a steady drift of (p_A + p_B)/2 over a whole recording, which a sealed circuit does not show.

    The recording is divided into equal parts. The steps of the mean from part to part must be alike, and the drift fast
    enough (`creep` in `priors.toml`). Returns one finding or none.
    """
    duration = len(recording) / recording.rate
    if duration < _CREEP.seconds or any(recording.units.get(name) != "Pa" for name in ("p_A", "p_B")):
        return []
    pressures = (np.array_split(recording[name], _CREEP.parts) for name in ("p_A", "p_B"))
    parts = (0.5 * (p_A + p_B) for p_A, p_B in zip(*pressures, strict=True))
    means = np.array([np.nanmean(part) if np.isfinite(part).any() else np.nan for part in parts])
    steps = np.diff(means)
    creep_rate = float(np.median(steps)) * _CREEP.parts / duration
    # if the median is 0, or a part has no values, the ratios are not finite, and the steps not even
    is_even = np.all((steps / np.median(steps) > _CREEP.even[0]) & (steps / np.median(steps) < _CREEP.even[1]))
    if not (is_even and abs(creep_rate) >= _CREEP.rate):
        return []
    text = (
        f"p_A, p_B: their mean creeps evenly by {creep_rate / 1e3:+.2g} kPa/s: oil is fed or lost, or a "
        "simulator balanced volumes in place of mass"
    )
    return [_make_finding(recording, "creeping_pressures", None, len(recording), 0, text, "note")]


def _channel_findings(recording: Recording, name: str, values: Array) -> list[Finding]:
    """Find the defects in the values (n,) of the channel `name`."""
    findings = list[Finding]()
    format_value = partial(recording.format_value, name)

    def add(code: str, count: int, rows: NDArray[Any] | int, text: str, severity: Severity = "warning") -> None:
        """Add a finding on `count` samples (`_make_finding`)."""
        findings.append(_make_finding(recording, code, name, count, rows, f"{name}: {text}", severity))

    unit = recording.units[name]
    is_pressure = name.startswith("p_")
    may_rest = name in ("u", "q_leak", "q_comp")  # channels that may stay constant for long
    if is_pressure and unit == COUNTS:
        text = f"is in raw counts: state the unit (--map '{name}=COLUMN bar'), or a leak's size stays relative"
        add("raw_counts", values.size, 0, text, "note")
    if missing := _describe_missing(values, recording.rate):
        add(*missing, weigh_defects(missing[1], values.size))
    infinite = np.flatnonzero(np.isinf(values))
    if infinite.size:
        add("infinite", infinite.size, infinite, f"{format_count(infinite.size, 'infinite sample')}")
    is_impossible = flag_impossible(values, unit)
    impossible = np.flatnonzero(is_impossible)
    if impossible.size:
        first = format_value(values[impossible[0]])
        text = f"{format_count(impossible.size, 'sample')} beyond what any sensor reads, first {first}"
        add("impossible", impossible.size, impossible, text)
    is_present = np.isfinite(values) & ~is_impossible
    is_complete = bool(is_present.all())
    readings = values if is_complete else values[is_present]

    def rows_of(indices: NDArray[np.intp]) -> NDArray[np.intp]:
        """Find the rows of the readings with these indices."""
        return indices if is_complete else np.flatnonzero(is_present)[indices]

    if readings.size < 2:
        return findings
    if is_constant(readings):
        # a flow meter on a closed bypass reads one value; a pressure never does
        text = f"is constant at {format_value(readings[0])}"
        add("constant", readings.size, int(np.argmax(is_present)), text, "note" if may_rest else "warning")
        return findings
    stuck = find_stuck(readings)
    may_be_clipped = is_pressure or name == "q_leak"  # q_leak at the high end only: without flow it reads 0
    for rail in find_rails(readings, unit, stuck, low_end=is_pressure) if may_be_clipped else ():
        n_clipped = format_count(rail.samples, "sample")
        text = f"{n_clipped} at the {rail.side} end, {format_value(rail.value)}: clipped"
        add("clipped", rail.samples, rows_of(rail.first), text)
    if is_pressure:  # runs at the smallest or largest value are reported as clipped
        stuck = stuck[(readings[stuck[:, 0]] > readings.min()) & (readings[stuck[:, 0]] < readings.max())]
    elif name == "omega" or name in METERS:  # a pump or a meter that stands reads 0 without noise
        stuck = stuck[readings[stuck[:, 0]] != 0.0]
    if stuck.size and not may_rest:
        times = _format_repetitions(len(stuck))
        text = f"is stuck {times} while it should move, first for {int(stuck[0, 1]) / recording.rate:g} s"
        n_stuck = int(stuck[:, 1].sum())
        add("stuck", n_stuck, rows_of(stuck[:, 0]), text, weigh_defects(n_stuck, values.size))
    # the spectrum of a channel with many missing samples would be wrong
    for line in find_hum(readings, recording.rate) if readings.size > 0.9 * values.size else ():
        text = f"mains hum of {line.frequency:g} Hz, amplitude {format_value(line.amplitude, 3, is_span=True)}"
        text += f", {100 * line.power_fraction:.2g} % of the power over 20 Hz"
        text += ": is the sensor connected?" if line.power_fraction > _HUM.alone else ""
        severity: Severity = "warning" if line.power_fraction > _HUM.loud else "note"
        add("mains_hum", readings.size, int(np.argmax(is_present)), text, severity)
    return findings


def _describe_missing(values: Array, rate: float) -> tuple[str, int, NDArray[Any] | int, str] | None:
    """Describe the missing samples of a channel (n,): (code, number, rows, text); None if there are none.

    The code is "mixed_rate" for a channel with a value on every k-th row only, else "missing".
    """
    is_missing = np.isnan(values)
    if not is_missing.any():
        return None
    runs = find_runs(is_missing)
    n_missing = int(np.count_nonzero(is_missing))
    period = _row_period(np.flatnonzero(~is_missing))
    if period:
        text = f"has a value on every {_format_ordinal(period)} row only ({rate / period:g} Hz among {rate:g} Hz)"
        return "mixed_rate", n_missing, int(runs[0, 0]), text
    if n_missing == values.size:
        return "missing", n_missing, 0, "has no values at all"
    text = f"{format_count(n_missing, 'sample')} missing in {format_count(len(runs), 'stretch')}"
    return "missing", n_missing, runs[:, 0], f"{text}, the longest {runs[:, 1].max() / rate:g} s"


def sensor_limit(unit: str) -> float:
    """Return the largest magnitude in `unit` that a sensor can read (`possible` of `priors.toml`)."""
    return float(_SENSOR_LIMITS.get(unit, _SENSOR_LIMITS["any"]))


def flag_impossible(values: Array, unit: str) -> NDArray[np.bool_]:
    """Flag the finite samples (n,) in `unit` whose magnitude no sensor can read (`possible` of `priors.toml`)."""
    limit = sensor_limit(unit)
    return np.asarray(np.isfinite(values) & ((values > limit) | (values < -limit)))


def _row_period(present: NDArray[np.intp]) -> int:
    """Find the period k >= 2 [rows] of a channel that has a value on every k-th row only; 0 for any other channel.

    `present` (m,): indices of the rows with a value. The distance from value to value must be k in over 95 % of cases.
    """
    steps = np.diff(present)
    period = int(np.median(steps)) if present.size >= 3 else 0
    is_regular = period >= 2 and np.mean(steps == period) > 0.95  # some values may be missing
    return period if is_regular else 0


def _format_ordinal(number: int) -> str:
    """Format an ordinal number, such as `1st` or `12th`."""
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def uniform_segments(recording: Recording, channels: Sequence[str] | None = None) -> list[slice]:
    """Split a recording into stretches with even sampling and no missing values; return them as slices.

    In a stretch, each interval lasts between half and one and a half sampling steps, and each of the `channels`, by
    default all but the slow ones, has a value in every row. Raises InputError for a channel that the recording lacks.
    """
    n = len(recording)
    names = [name for name in recording.channels if name not in SLOW] if channels is None else channels
    is_complete = np.all([np.isfinite(values) for values in (recording.t, *map(recording.__getitem__, names))], axis=0)
    with np.errstate(invalid="ignore"):
        steps = np.diff(recording.t) * recording.rate
        is_even = (steps > _MIN_STEP) & (steps < _MAX_STEP)
    continues = is_complete[1:] & is_complete[:-1] & is_even
    # without samples, n = 0, [:n] drops the added True; there are then no stops, as there are no starts
    starts = np.flatnonzero(is_complete & np.r_[True, ~continues][:n])
    stops = np.flatnonzero(is_complete & np.r_[~continues, True]) + 1 if n else starts
    return [slice(int(a), int(b)) for a, b in zip(starts, stops, strict=True)]


class Rail(NamedTuple):
    """An end of a channel's range at which it is clipped."""

    side: str  # "low" or "high"
    value: float
    samples: int  # number of samples with this value
    first: NDArray[np.intp]  # index of the first sample of each run of them, (k,)


def is_mostly_clipped(values: Array, unit: str) -> bool:
    """Test whether more than half of the finite values (n,) are clipped, as in a chamber that drains to the tank."""
    finite = values[np.isfinite(values)]
    return sum(rail.samples for rail in find_rails(finite, unit)) > len(finite) / 2


def find_rails(values: Array, unit: str, stuck: NDArray[np.intp] | None = None, low_end: bool = True) -> list[Rail]:
    """Find the ends of the range of a channel's finite values (n,) at which they are clipped.

    With `low_end` False only the high end is examined. The low end of a pressure, in the `unit` Pa, lies at the
    transducer's zero (`rail.zero` of `priors.toml`): a chamber at the charge pressure, read in coarse steps, is not
    clipped. An end is clipped in two cases:

    - Five samples or more have this value, over five times as many as any of the five nearest values, and the signal
      enters or leaves the longest run of them (3 or more) by a jump of more than 3.5 quantisation steps, or 1.5 for a
      run of 20 or more. This excludes crests of a slow quantised signal, whose nearest values are nearly as frequent.
    - One of the runs `stuck` (k, 2), first index and length of each as from `find_stuck`, has this value.

    A channel with fewer than three different values, such as a square wave, has no clipped end.
    """
    if not values.size:
        return []
    stuck_values = np.empty(0) if stuck is None else values[stuck[:, 0]]
    ends = values.min(), values.max()
    max_count = max(np.count_nonzero(values == end) for end in ends)
    if max_count < _RAIL.samples and not any(end in stuck_values for end in ends):  # neither case: no need to sort
        return []
    distinct, counts = np.unique(values, return_counts=True)
    if distinct.size < 3:
        return []
    quantum = smallest_step(distinct)
    rails = []
    # index of the end among the distinct values, and slice of the five nearest ones
    for side, index, nearest in (("high", -1, slice(-6, -1)), ("low", 0, slice(1, 6))):
        if side == "low" and (not low_end or (unit == "Pa" and distinct[0] > _RAIL.zero)):
            continue
        runs = find_runs(values == distinct[index])
        first, length = runs[np.argmax(runs[:, 1])]  # the longest
        # a run that begins or ends the channel has no jump there: its own value is taken
        before, after = values[max(first - 1, 0)], values[min(first + length, values.size - 1)]
        jump = max(abs(before - distinct[index]), abs(after - distinct[index]))
        is_crowded = counts[index] >= _RAIL.samples and counts[index] > _RAIL.crowd * counts[nearest].max()
        is_entered_by_jump = length >= 3 and jump > (_RAIL.long_jump if length >= _RAIL.run else _RAIL.jump) * quantum
        if (is_crowded and is_entered_by_jump) or (stuck_values == distinct[index]).any():
            rails.append(Rail(side, float(distinct[index]), int(counts[index]), runs[:, 0]))
    return rails


@lru_cache(maxsize=16)
def fast_length(count: int) -> int:
    """Find the smallest length n >= `count` with no prime factors but 2, 3 and 5, for a fast Fourier transform.

    The result equals `scipy.fft.next_fast_len(count, real=True)`, but scipy.fft is not loaded.
    """
    odd_factors = (3**i * 5**j for i in range(40) for j in range(28) if 3**i * 5**j < 2 * count)
    # each odd factor times the smallest power of two that makes the product >= count; 3**40 and 5**28 exceed any count.
    # `default`: for 0, for which there is no factor
    return min((factor << max(0, (-(-count // factor) - 1).bit_length()) for factor in odd_factors), default=count)


class HumLine(NamedTuple):
    """Spectral line of the mains: frequency [Hz], amplitude in the channel's unit, share of the power over 20 Hz."""

    frequency: float
    amplitude: float
    power_fraction: float


def find_hum(values: Array, rate: float) -> list[HumLine]:
    """Find spectral lines of the mains, at 50 or 60 Hz, in values (n,) sampled at `rate` [Hz] for 1.5 s or more.

    X is the spectrum of the detrended values times a Hann window w; the amplitude at a frequency is 2 |X| / sum(w). The
    amplitude of a line must exceed 10 times the median and 4 times the largest of the amplitudes around it, i.e. within
    5 Hz but outside its own peak. A line is only searched for if half the sampling rate is more than 5 Hz above it.
    """
    n = values.size
    frequencies = [mains for mains in (50.0, 60.0) if mains + _HUM.around < rate / 2]
    if n / rate < _HUM.shortest or not frequencies:
        return []
    n_fft = fast_length(n)
    bin_width = rate / n_fft
    trend = _fit_trend(values)
    bins = np.arange(
        int((frequencies[0] - _HUM.around) / bin_width), int((frequencies[-1] + _HUM.around) / bin_width) + 2
    )
    amplitudes = np.abs(_transform_at(bins, values, trend, n_fft)) * (4.0 / (n - 1))  # 2 over the window's sum
    lines = []
    for mains in frequencies:
        distance = np.abs(bins * bin_width - mains)
        # the main lobe of the window ends 2 rate / n from a line; a mains frequency varies by 0.1 Hz
        is_line = distance <= max(0.1, 0.5 * rate / n)
        is_background = (distance > max(0.5, 2.5 * rate / n)) & (distance <= _HUM.around)
        peak, background = float(amplitudes[is_line].max(initial=0.0)), amplitudes[is_background]
        if (
            background.size >= 10  # fewer amplitudes show no background
            and peak > _HUM.over_rest * background.max()
            and peak > _HUM.over_median * np.median(background)
        ):
            lines.append(HumLine(mains, peak, min(1.0, peak**2 / 2 / _fast_power(values, trend, rate, n_fft))))
    return lines


def _fit_trend(values: Array) -> tuple[float, float]:
    """Fit a straight line to values (n,) by least squares; return its mean and its slope [1/sample]."""
    n = values.size
    mean = float(values.mean())
    moments = ((np.arange(part.start, part.stop) - (n - 1) / 2) @ (values[part] - mean) for part in iter_stretches(n))
    return mean, float(sum(moments)) * 12.0 / (n * (n**2 - 1.0))


def _transform_at(bins: NDArray[np.intp], values: Array, trend: tuple[float, float], n_fft: int) -> NDArray[Any]:
    """Compute some `bins` (m,) of the Fourier transform of values (n,) without their `trend`, times a Hann window.

    Zeros are added to `n_fft` values. With n_fft = P Q, the transform is the sum over r of exp(-2 pi i k r / n_fft)
    F_r(k mod Q), where F_r is that of the Q values r, r + P, r + 2 P, ...; none is longer than `_LONGEST_TRANSFORM`.
    """
    n, (mean, slope) = values.size, trend
    n_parts = next(number for number in count(1) if n_fft % number == 0 and n_fft // number <= _LONGEST_TRANSFORM)
    length = n_fft // n_parts
    rows, turn = np.arange(0, n, n_parts), _turn_window(n, n_parts)
    step, phase = np.exp(-2j * np.pi / n_fft * bins), np.ones(bins.size, dtype=complex)
    places = bins % length
    is_mirrored = places > length // 2  # a transform of real values states only one half
    places = np.where(is_mirrored, length - places, places)
    total = np.zeros(bins.size, dtype=complex)
    for first in range(n_parts):
        part = values[first::n_parts]
        shifted = np.exp(2j * np.pi / (n - 1) * first) * turn[: part.size]
        window = 0.5 - 0.5 * shifted.real
        detrended = part - (mean + slope * (rows[: part.size] + (first - (n - 1) / 2)))
        transform = np.fft.rfft(detrended * window, length)[places]
        total += phase * np.where(is_mirrored, transform.conj(), transform)
        phase *= step
    return total


@lru_cache(maxsize=1)
def _turn_window(n: int, step: int) -> NDArray[Any]:
    """Compute exp(2 pi i k / (n - 1)), whose real part makes a Hann window, for k = 0, `step`, ... below n."""
    return np.asarray(np.exp(2j * np.pi / (n - 1) * np.arange(0, n, step)))


def _fast_power(values: Array, trend: tuple[float, float], rate: float, n_fft: int) -> float:
    """Compute the power of values (n,) without their `trend` at frequencies from `hum.lowest` on."""
    n, (mean, slope) = values.size, trend
    detrended = values - (mean + slope * (np.arange(n) - (n - 1) / 2))
    window = np.hanning(n)
    spectrum = np.fft.rfft(detrended * window, n_fft)
    squared_amplitudes = (spectrum.real**2 + spectrum.imag**2) * (2.0 / window.sum()) ** 2
    # 1e-9: rounding; a Hann window makes the sum over the bins 1.5 n_fft / n times larger
    return float(squared_amplitudes[math.ceil(_HUM.lowest * n_fft / rate - 1e-9) :].sum()) / 2 / (1.5 * n_fft / n)


_PRIORS = RECORDINGS.readings
_COPY_TOLERANCE = 1e-6  # largest difference of a copied channel, by rounding, as a fraction of its standard deviation


def find_implausibility(recording: Recording) -> str | None:
    """Find a reason, in words, why the channels cannot come from one hydraulic machine; None if there is none.

    There are four such reasons:

    - p_B is a copy of p_A, up to a constant.
    - The motor speed differs from the rate of the motor angle by a large constant factor.
    - Pressures in Pa stay below `readings.pressure` of `priors.toml`, as those in another unit would.
    - p_A - p_B, or the only chamber pressure that varies, is nothing but noise.

    Constant and absent channels are ignored: a chamber may rest at charge pressure. Raw counts may have any range. The
    chamber pressures must have no missing samples, which would count as noise.
    """
    # the third difference of `_is_noise` needs four samples
    names = [name for name in chambers_of(recording) if len(recording) > 3 and not is_constant(recording[name])]
    signals = {name: recording[name] for name in names}
    if len(names) == 2:
        signals["p_A - p_B"] = difference = signals["p_A"] - signals["p_B"]
        if np.std(difference) <= _COPY_TOLERANCE * max(np.std(signals[name]) for name in CHAMBERS):
            return "p_B is a copy of p_A, but chambers on either side of a piston move against each other"
    if reason := _describe_speed_mismatch(recording):
        return reason
    pressures = [np.abs(recording[name]).max() for name in names if recording.units[name] == "Pa"]
    if pressures and max(pressures) < _PRIORS.pressure:
        return f"the pressures stay below {max(pressures):.3g} Pa: is their unit right?"
    noise_tested = "p_A - p_B" if len(names) == 2 else next(iter(names), "")
    if noise_tested and _is_noise(signals[noise_tested], is_zero_known=len(names) == 2):
        return f"{noise_tested} is noise: the machine's motion does not show in it"
    return None


def _describe_speed_mismatch(recording: Recording) -> str | None:
    """Describe the factor between the motor speed and the rate of the motor angle if a unit seems to be wrong.

    Speed and angle are averaged to `readings.rate` of `priors.toml`. Returns None if the least-squares factor is
    between 1 / m and m, with m = `readings.misfit`. Also None if the speed hardly correlates with the rate of the
    angle, if either channel is absent or in raw counts, or if averages are missing or fewer than `readings.samples`.
    """
    if not {"theta", "omega"} <= {name for name, unit in recording.units.items() if unit != COUNTS}:
        return None
    n_mean = max(1, round(recording.rate / _PRIORS.rate))  # samples averaged to one, against noise
    n_samples = len(recording) // n_mean * n_mean
    theta, omega = (recording[name][:n_samples].reshape(-1, n_mean).mean(axis=1) for name in ("theta", "omega"))
    if theta.size < _PRIORS.samples or not np.isfinite(theta + omega).all():
        return None
    turning_rate = np.gradient(theta, n_mean / recording.rate)
    product, square = abs(float(turning_rate @ omega)), float(turning_rate @ turning_rate)  # a unit changes no sign
    ratio = product / max(square, np.finfo(float).tiny)  # least-squares scale of the speed
    is_correlated = product >= _PRIORS.correlation * np.sqrt(square * float(omega @ omega)) > 0.0
    if not is_correlated or 1.0 / _PRIORS.misfit <= ratio <= _PRIORS.misfit:
        return None
    return f"the speed is {ratio:.3g} times that at which the angle turns: is the unit of the time right?"


def _is_noise(values: Array, is_zero_known: bool) -> bool:
    """Test whether a signal (n,) is mostly white noise (`readings.noise` of `priors.toml`), or has missing samples.

    With `is_zero_known`, i.e. for p_A - p_B, zero means no load, and the mean square is taken instead of the variance:
    then a constant load is a signal. A single pressure has the charge pressure as an offset.
    """
    power = np.mean(values**2) if is_zero_known else np.var(values)
    # the third difference of white noise has 20 times its variance; `not <=`: missing samples count as noise
    return not np.mean(np.diff(values, 3) ** 2) <= 20.0 * _PRIORS.noise * power


def describe_missing_chambers(recording: Recording) -> str | None:
    """Describe the lack of a chamber pressure, with the file's unused columns; None if there is a chamber pressure."""
    if chambers_of(recording):
        return None
    unused = [line for line in recording.history if line.startswith(UNUSED)]
    pressures = [name for name in recording.unused if is_pressure(Label.parse(name))]
    maps = [f"--map '{channel}={name}'" for channel, name in zip(("p_A", "p_B"), pressures, strict=False)]
    hint = f", such as by {' '.join(maps)}" if maps else ""
    return "; ".join([f"needs the pressure of a chamber (p_A or p_B){hint}", *unused])
