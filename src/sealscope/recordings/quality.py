"""The quality of a recording: what is wrong with it is found and named, never repaired.

Each test of a channel's values lets quantised, slow and constant signals pass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.calls import checked_call
from sealscope.recordings.channels import COUNTS, SLOW, Array
from sealscope.recordings.formats.columns import counted
from sealscope.recordings.motion import constant, runs_of, spacing, stuck
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of
from sealscope.units import from_si

Severity = Literal["note", "warning", "fatal"]

#: Samples that the level 4 detail of db8 looks at together: (16 - 1)(2^4 - 1) + 1.
SHORTEST = 226
#: An interval over this many sampling steps is a gap, one under the inverse share of a step is crowded.
_GAP = 1.5
_CROWDED = 0.5
_FEWEST_AT_RAIL = 5
_LONG_RUN = 20
_PRIORS = priors_of("sealscope.recordings")
_CLOCK, _HUM, _CREEP = (_PRIORS[table] for table in ("clock", "hum", "creep"))
_POSSIBLE = _PRIORS["possible"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a recording.

    `code` names it; `severity` is ``fatal`` (the recording cannot be analysed as it is), ``warning`` (the time or the
    channel needs a look before a verdict is believed) or ``note``; `channel` is None for the time; `count`: samples or
    intervals concerned; `first_t`: where first [s]; `text`: a sentence.
    """

    code: str
    severity: Severity
    channel: str | None
    count: int
    first_t: float | None
    text: str


@checked_call
def inspect(recording: Recording) -> tuple[Finding, ...]:
    """Find what is wrong with the time base and the channels of a recording.

    Codes of the time: ``too_short``, ``missing_time``, ``reversed_time``, ``duplicated_time``, ``gap``,
    ``rate_mismatch``, ``irregular_sampling``; of a channel: ``missing``, ``mixed_rate``, ``infinite``, ``constant``,
    ``clipped``, ``stuck``, ``mains_hum``, ``raw_counts``; of both chambers: ``creeping_pressures``.

    Parameters
    ----------
    recording : Recording
        The recording to inspect; it is not changed.

    Returns
    -------
    tuple of Finding
        Those on the time first, then those on each channel; empty where nothing is wrong.

    Raises
    ------
    InputError
        If the call has another argument.

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
        findings = _time_findings(recording)
        for name, values in recording.channels.items():
            findings += _channel_findings(recording, name, values) if name not in SLOW else []
        findings += _creep_findings(recording)
    return tuple(findings)


def _moment(recording: Recording, index: int) -> float | None:
    t = float(recording.t[index]) if index < recording.t.size else np.nan
    return t if np.isfinite(t) else None


def _time_findings(recording: Recording) -> list[Finding]:
    t, findings, step = recording.t, list[Finding](), 1.0 / recording.rate

    def add(code: str, where: NDArray[Any], text: str, severity: Severity = "warning") -> None:
        if where.size:
            findings.append(Finding(code, severity, None, where.size, _moment(recording, int(where[0])), text))

    unknown, known = np.flatnonzero(~np.isfinite(t)), np.flatnonzero(np.isfinite(t))
    steps = np.diff(t[known])
    back, same, forward = np.flatnonzero(steps < 0), np.flatnonzero(steps == 0), steps[steps > 0]
    add("missing_time", unknown, f"{counted(unknown.size, 'sample')} without a time")
    worst = float(-steps[back].min(initial=0.0))
    add("reversed_time", known[back + 1], f"time goes back {_times(back.size)}, by up to {worst:g} s")
    add("duplicated_time", known[same + 1], f"{counted(same.size, 'time stamp')} equal to the one before")
    if forward.size:
        typical = float(np.median(forward))
        if abs(typical / step - 1.0) > _CLOCK["rate"] and not (same.size and typical < 2.5 * step):
            text = f"time stamps tell {1.0 / typical:.6g} Hz, the recording's rate is {recording.rate:g} Hz"
            add("rate_mismatch", known[:1], text, "fatal")
            step = typical
        gaps = np.flatnonzero(steps > _GAP * step)
        lost = np.round(steps[gaps] / step - 1.0).sum()
        samples = counted(int(lost), "sample") if lost < 1e15 else f"{lost:.3g} samples"
        longest = float(steps[gaps].max(initial=0.0))
        add("gap", known[gaps], f"{counted(gaps.size, 'gap')}, about {samples} lost, the longest {longest:g} s")
        usual = forward[forward <= _GAP * step] / step
        scatter = float(usual.std()) if usual.size else 0.0
        if scatter > _CLOCK["scatter"]:
            odd = np.flatnonzero(
                (steps > 0) & (steps <= _GAP * step) & (np.abs(steps / step - 1.0) > _CLOCK["scatter"])
            )
            text = f"intervals scatter by {100 * scatter:.0f} % of the sampling step"
            add("irregular_sampling", known[odd], text)
    if len(recording) < SHORTEST:
        text = f"{counted(len(recording), 'sample')}; the slowest detail needs {SHORTEST}"
        findings.append(Finding("too_short", "warning", None, len(recording), None, text))
    return findings


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _creep_findings(recording: Recording) -> list[Finding]:
    """Return the finding on chambers whose mean pressure creeps evenly all the while, as no sealed circuit's does."""
    duration = len(recording) / recording.rate
    if duration < _CREEP["seconds"] or any(recording.units.get(name) != "Pa" for name in ("p_A", "p_B")):
        return []
    mean = 0.5 * (recording["p_A"] + recording["p_B"])
    levels = np.array([np.nanmean(part) if np.isfinite(part).any() else np.nan for part in np.array_split(mean, 8)])
    steps = np.diff(levels)
    rate = float(np.median(steps)) * 8.0 / duration
    even = np.all((steps / np.median(steps) > 0.5) & (steps / np.median(steps) < 2.0))
    if not (even and abs(rate) >= _CREEP["rate"]):
        return []
    text = (
        f"p_A, p_B: their mean creeps evenly by {rate / 1e3:+.2g} kPa/s: oil is fed or lost, or a simulator balanced "
        "volumes in place of mass"
    )
    return [Finding("creeping_pressures", "note", None, len(recording), _moment(recording, 0), text)]


def _channel_findings(recording: Recording, name: str, values: Array) -> list[Finding]:
    findings, rate, unit = list[Finding](), recording.rate, recording.units[name]
    pressure, steady = name.startswith("p_"), name in ("u", "q_leak", "q_comp")

    def add(code: str, count: int, first: int, text: str, severity: Severity = "warning") -> None:
        findings.append(Finding(code, severity, name, count, _moment(recording, first), f"{name}: {text}"))

    def in_log(value: float, digits: int = 6, *, is_span: bool = False) -> str:
        shown = recording.unit_in_log(name) or unit
        if shown != unit:
            value = from_si(value, shown, unit) - (from_si(0.0, shown, unit) if is_span else 0.0)
        return f"{value:.{digits}g} {shown}"

    if pressure and unit == COUNTS:
        text = f"is in raw counts: state the unit (--map '{name}=COLUMN bar'), or a leak's size stays relative"
        add("raw_counts", values.size, 0, text, "note")
    absent = np.isnan(values)
    if absent.any():
        runs = runs_of(absent)
        samples, first = int(np.count_nonzero(absent)), int(runs[0, 0])
        every = _every(np.flatnonzero(~absent))
        if every:
            text = f"has a value on every {_ordinal(every)} row only ({rate / every:g} Hz among {rate:g} Hz)"
            add("mixed_rate", samples, first, text)
        elif samples == values.size:
            add("missing", samples, 0, "has no values at all")
        else:
            missed = f"{counted(samples, 'sample')} missing in {counted(len(runs), 'stretch')}"
            add("missing", samples, first, f"{missed}, the longest {runs[:, 1].max() / rate:g} s")
    extreme = np.flatnonzero(np.isinf(values))
    if extreme.size:
        add("infinite", extreme.size, int(extreme[0]), f"{counted(extreme.size, 'infinite sample')}")
    impossible = flag_impossible(values, unit)
    wild = np.flatnonzero(impossible)
    if wild.size:
        text = f"{counted(wild.size, 'sample')} beyond what any sensor reads, first {in_log(values[wild[0]])}"
        add("impossible", wild.size, int(wild[0]), text)
    present = np.flatnonzero(np.isfinite(values) & ~impossible)
    kept = values[present]
    if kept.size < 2:
        return findings
    if constant(kept):
        # a command may be constant, and a flow meter on a closed bypass reads one value; a pressure never does
        text = f"is constant at {in_log(kept[0])}"
        add("constant", kept.size, int(present[0]), text, "note" if steady else "warning")
        return findings
    held = stuck(kept)
    for rail in clipped(kept, held, low=pressure) if pressure or name == "q_leak" else ():
        text = f"{counted(rail.samples, 'sample')} at the {rail.side} end, {in_log(rail.value)}: clipped"
        add("clipped", rail.samples, int(present[rail.first]), text)
    if pressure:  # at an end of its values it is clipped
        held = held[(kept[held[:, 0]] > kept.min()) & (kept[held[:, 0]] < kept.max())]
    if held.size and not steady:
        first, length = (int(v) for v in held[0])
        text = f"does not move {_times(len(held))} while it should, first for {length / rate:g} s"
        add("stuck", int(held[:, 1].sum()), int(present[first]), text)
    for frequency, amplitude, share in hum(kept, rate) if kept.size > 0.9 * values.size else ():
        text = f"mains hum of {frequency:g} Hz, amplitude {in_log(amplitude, 3, is_span=True)}"
        text += f", {100 * share:.2g} % of the power over 20 Hz"
        text += ": is the sensor connected?" if share > _HUM["alone"] else ""
        add("mains_hum", kept.size, int(present[0]), text, "warning" if share > _HUM["loud"] else "note")
    return findings


def flag_impossible(values: Array, unit: str) -> NDArray[np.bool_]:
    """Flag the samples (n,), in an SI unit, of a size that no sensor reads; missing and infinite ones are not."""
    largest: float = _POSSIBLE.get(unit, _POSSIBLE["any"])
    return np.asarray(np.isfinite(values) & (np.abs(values) > largest))


def _every(present: NDArray[np.intp]) -> int:
    """Return k where only each k-th row has a value, as of a slower channel among others; else 0."""
    steps = np.diff(present)
    usual = int(np.median(steps)) if present.size >= 3 else 0
    return usual if usual >= 2 and np.mean(steps == usual) > 0.95 else 0


def _ordinal(number: int) -> str:
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def uniform_segments(recording: Recording, channels: Sequence[str] | None = None) -> list[slice]:
    """Return the maximal stretches, as slices, sampled uniformly with the named channels finite.

    `channels`: by default all but those that change slowly. Each interval of a stretch lies between half and one and a
    half steps of `recording.rate`. Raises InputError for a channel that the recording does not have.
    """
    count = len(recording)
    whole = np.isfinite(recording.t)
    for name in (name for name in recording.channels if name not in SLOW) if channels is None else channels:
        whole = whole & np.isfinite(recording[name])
    joined = whole[1:] & whole[:-1] & _even_steps(recording)
    starts = np.flatnonzero(whole & np.r_[True, ~joined][:count])
    stops = np.flatnonzero(whole & np.r_[~joined, True][-count:]) + 1 if count else starts
    return [slice(int(a), int(b)) for a, b in zip(starts, stops, strict=True)]


def _even_steps(recording: Recording) -> NDArray[np.bool_]:
    """Flag the intervals (n - 1,) between half and one and a half steps of the recording's rate."""
    with np.errstate(invalid="ignore"):
        steps = np.diff(recording.t) * recording.rate
    return np.asarray((steps > _CROWDED) & (steps < _GAP))


class Rail(NamedTuple):
    """Samples at one end of a clipped channel: `low` or `high` side, the value there, how many, where first."""

    side: str
    value: float
    samples: int
    first: int


def mostly_clipped(values: Array) -> bool:
    """Test whether more than half of the finite values (n,) are cut off, as in a chamber that empties into the tank."""
    finite = values[np.isfinite(values)]
    return sum(rail.samples for rail in clipped(finite)) > len(finite) / 2


def clipped(values: Array, held: NDArray[np.intp] | None = None, low: bool = True) -> list[Rail]:
    """Find the ends at which finite values (n,) are cut off; the low one only where `low`.

    A cut-off piles up at its value what lay beyond: far more samples than any of the five levels next to it, in runs
    that the signal enters or leaves by more than three quantisation steps (one, for a long run). The crest of a slow
    quantised signal also holds many samples, but its neighbours hold nearly as many and it is entered step by step; a
    channel that stays at two levels, such as a square wave, has as many samples at the other. A run among `held`, as
    `stuck` gives them, at an end of the values is a cut-off too.
    """
    if not values.size:
        return []
    starts, ends = np.empty(0) if held is None else values[held[:, 0]], (values.min(), values.max())
    at_ends = max(np.count_nonzero(values == end) for end in ends)
    if at_ends < _FEWEST_AT_RAIL and not np.isin(starts, ends).any():
        return []
    levels, counts = np.unique(values, return_counts=True)
    if levels.size < 3:
        return []
    fine = spacing(levels)
    rails = []
    for side, top, neighbours in (("high", -1, slice(-6, -1)), ("low", 0, slice(1, 6))):
        if side == "low" and not low:
            continue
        runs = runs_of(values == levels[top])
        first, length = runs[np.argmax(runs[:, 1])]
        before, after = values[max(first - 1, 0)], values[min(first + length, values.size - 1)]
        drop = max(abs(before - levels[top]), abs(after - levels[top]))
        piled = counts[top] >= _FEWEST_AT_RAIL and counts[top] > 5 * counts[neighbours].max()
        entered = length >= 3 and drop > (1.5 if length >= _LONG_RUN else 3.5) * fine
        if (piled and entered) or (starts == levels[top]).any():
            rails.append(Rail(side, float(levels[top]), int(counts[top]), int(runs[0, 0])))
    return rails


def fast_length(count: int) -> int:
    """Return the least length from `count` on without a prime factor beyond 5, of which a transform is fast.

    As `scipy.fft.next_fast_len(count, real=True)`, without the modules that scipy.fft loads.
    """
    powers = (3**i * 5**j for i in range(40) for j in range(28) if 3**i * 5**j < 2 * count)
    return min((power << max(0, (-(-count // power) - 1).bit_length()) for power in powers), default=count)


def hum(values: Array, rate: float) -> list[tuple[float, float, float]]:
    """Return (frequency [Hz], amplitude, share of the power over 20 Hz) of the lines of the mains, 50 or 60 Hz.

    They stand clear of the spectrum within 5 Hz.

    Hann-windowed periodogram of the values less their straight line; the amplitude of a line is 2 |X| / sum(w). Clear
    means 10 times the median and 4 times the largest of what lies beside it. Nothing is looked for in under 1.5 s.
    """
    count = values.size
    if count / rate < 1.5:
        return []
    x = np.arange(count) - (count - 1) / 2
    centred = values - values.mean()
    centred -= x * ((x @ centred) / (x @ x))
    if not centred.any():
        return []
    window = _hann(count)
    size = fast_length(count)
    centred *= window
    spectrum = np.fft.rfft(centred, size)
    squares = (spectrum.real**2 + spectrum.imag**2) * (2.0 / window.sum()) ** 2
    step = rate / size
    # amplitude^2/2 summed over bins counts each line's power 1.5 size/count times, as wide as Hann's window makes it
    power = float(squares[math.ceil(_HUM["from"] / step - 1e-9) :].sum()) / 2 / (1.5 * size / count)
    lines = []
    for mains in (50.0, 60.0):
        if mains + _HUM["around"] >= rate / 2:
            continue
        bins = np.arange(int((mains - _HUM["around"]) / step), int((mains + _HUM["around"]) / step) + 2)
        off, amplitudes = np.abs(bins * step - mains), np.sqrt(squares[bins])
        near = off <= max(0.1, 0.5 * rate / count)
        surroundings = (off > max(0.5, 2.5 * rate / count)) & (off <= _HUM["around"])
        peak, rest = float(amplitudes[near].max(initial=0.0)), amplitudes[surroundings]
        if rest.size >= 10 and peak > _HUM["over_rest"] * rest.max() and peak > _HUM["over_median"] * np.median(rest):
            lines.append((mains, peak, min(1.0, peak**2 / 2 / power)))
    return lines


@lru_cache(2)
def _hann(count: int) -> Array:
    """Return Hann's window (count,), the same for all channels of a recording."""
    return np.hanning(count)
