"""Isolation: what else than a leak stepped where a detector dates one, such as duty, a sensor, friction or the oil.

A leak across the piston damps the ringing of the pressures. It moves neither chamber's mean over a cycle, nor the mean
pressure difference of the strokes (friction sets it), nor the ringing's frequency, and never the command. Each of these
is followed over whole cycles; one that steps at the instant of the alarm, by more than healthy machines and leaks show,
is the likelier cause. A detector that sees the pressures as a whole cannot say so itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.baseline.duty import StrokeChange, duty_changes
from sealscope.diagnosis.changepoint.even_drift import step_near
from sealscope.diagnosis.rms_change.detector import FEWEST_RECORDINGS
from sealscope.diagnosis.verdict.evidence import LEAKS, Cause, Evidence
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording

#: The detector whose evidence rests on volumes, not on how the pressures swing.
BALANCED = "volume balance"
#: A block is whole cycles of about so long [s]; where the pressures are looked at as they swing, means are taken over
#: so long first, which takes the ringing out.
BLOCK_SECONDS, SMOOTH_SECONDS = 3.0, 0.016
#: Time on either side of the alarm that is compared, how far from the alarm the step may lie [s], fewest blocks a side.
REACH, NEAR, FEWEST = 60.0, 10.0, 4
#: A step must be so many times its deviation from the scatter of the blocks about an even drift.
SURE = 4.5
#: Steps that matter. Of the command's rms and rate, as logarithms; of the mean pressure difference of the strokes, as a
#: logarithm; of a chamber's mean, over that mean difference.
DUTY, FRICTION, MEAN = 0.02, 0.08, 0.04
#: Both means fall by at least this, over that mean difference, where oil is lost.
LOST = 0.05
#: Both means step by at least this, over that mean difference, where the charge pressure is another one: a leak of 0.5
#: L/min on the thesis's rig steps them by 0.02.
CHARGED = 0.1
#: A rise of the conductance of up to so many times what a fall of the pressure difference at the same flow makes of it.
SAME_FLOW = 1.5
#: Log power of the noise from which a baseline was made with other noise than the recording.
NOISY = 0.2
#: One chamber's mean moves alone where the other moves by less than this share of it, both move alike above that one.
ALONE, ALIKE = 0.3, 0.6
#: A band of half an octave that gains this factor in power while the ringing's frequency falls by this share: the
#: ringing moved there. A leak takes power.
GAIN, FALL = 4.0, 0.15
#: ... and by this factor more where no detector saw a change.
UNASKED = 1.5
#: The ringing is looked for from here [Hz] up to a share of the rate; the top of the spectrum is noise.
LOWEST, HIGHEST, NOISE = 16.0, 0.36, 0.38
#: Mains frequencies and their overtones [Hz], and what lies beside such a line [Hz].
MAINS, HUM_BESIDE = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0), (1.5, 6.0)
#: Bands of noise whose ratio shows the sensor's filter: from these shares of the rate, so wide.
TILT, TILT_WIDTH = (0.30, 0.42), 0.07
#: Steps that matter, as logarithms: of that ratio, of a hum line over what lies beside it, of the mean of such lines
#: of both chambers; no leak moves any of them so far.
FILTERED, HUMS, HUMS_BOTH = 0.5, 1.2, 0.7
#: ... and of a hum line itself: half of that over what lies beside it.
HUMS_OWN = 0.6
#: A sure step anywhere in the recording; blocks of one duty correlate by more than the one, of another phase by less
#: than the other. One of before that correlates so with one of after comes again: in programs of duties by 0.99.
SURE_ANYWHERE, SAME_PHASE, OTHER_PHASE = 6.0, 0.7, 0.35
AGAIN = 0.9
#: Where the chambers ring [Hz]; longest delay of one channel that is looked for [s], the least that matters, and how
#: sure it must be.
RINGING, LAGS, LEAST_LAG, LAGGED = (20.0, 150.0), 8e-3, 1e-3, 0.5
#: Variance of the phase between the chambers that any machine has [rad^2], the most with which a frequency counts, and
#: fewest frequencies.
OWN_VARIANCE, MOST_VARIANCE, FEWEST_LINES = 0.01, 0.25, 5
#: Fewest samples of a block.
_SHORTEST = 64


@dataclass(frozen=True)
class OtherCause:
    """What stepped, and a description that says by how much; no cause where none can be named."""

    cause: Cause | None
    description: str

    @property
    def text(self) -> str:
        """Return the description, and the cause where there is one."""
        return self.description if self.cause is None else f"{self.description}: {self.cause}"


@dataclass(frozen=True, eq=False)
class Together:
    """Spectra of p_A and p_B in n blocks at the frequencies `f` (k,) [Hz] of the ringing.

    `cross` (n, k) of p_A and p_B, `own` (2, n, k) of each.
    """

    f: Array
    cross: NDArray[np.complex128]
    own: Array


@dataclass(frozen=True, eq=False)
class Signatures:
    """A recording over n blocks of whole cycles.

    `t` (n,) middles [s]; `half` [s] half a block; `mean` (n, 2) of p_A and p_B; `swing` (n,) log of the mean
    |p_A - p_B| about its mean, the ringing averaged out; `duty` (n, 2) log of the command's rms and of its derivative's
    over it, None without a command; `power` (n, b) of p_A - p_B in bands about `frequency` (b,) [Hz]; `noise` (n,)
    power of its noise in one line of the spectrum, `lines` (b,) of each band; `motion`: where the strokes changed;
    `tilt` (n, 2) log power of the noise of p_A and p_B near half the rate over that at two thirds of it; `hum` (n, 2,
    h) log power in lines of mains frequencies over what lies beside them, `line` (n, 2, h) that in the lines alone,
    `mains` (h,) [Hz]; `alike` (n - 1, 4) correlation of p_A - p_B in each block with those before
    (`_alike`), None where the duty does not repeat; `together`: how p_A and p_B ring together; `scale` [Pa]: what steps
    of a chamber's mean are measured by, and `measure`, its name.
    """

    t: Array
    half: float
    mean: Array
    swing: Array
    duty: Array | None
    power: Array
    frequency: Array
    noise: Array
    lines: Array
    motion: tuple[StrokeChange, ...]
    tilt: Array
    hum: Array
    line: Array
    mains: Array
    alike: Array | None
    together: Together
    scale: float
    measure: str


def signatures(recording: Recording, *, behind_valve: bool = False) -> Signatures | None:
    """Return the signatures of a recording; None without both chambers or where it is too short for a step.

    A pump holds both chambers' means, which are measured by the strokes' pressure difference, and they ring against
    each other. `behind_valve` the means are the supply's and move with it, so they are measured by its pressure; each
    chamber rings by its own volume, so that a delay between them is not asked for.
    """
    if any(name not in recording for name in CHAMBERS) or len(recording) < 2 * FEWEST * _SHORTEST:
        return None
    rate = recording.rate
    cycle = find_cycle(recording) or BLOCK_SECONDS
    length = round(cycle * max(1, round(BLOCK_SECONDS / cycle)) * rate)
    count = len(recording) // max(length, 1)
    if count < 2 * FEWEST or length < _SHORTEST:
        return None

    def rows(values: Array) -> Array:
        return np.asarray(values[: count * length], dtype=np.float64).reshape(count, length)

    p_A, p_B = (rows(recording[name]) for name in CHAMBERS)
    dp = p_A - p_B
    mean = np.stack([p_A.mean(axis=1), p_B.mean(axis=1)], axis=1)
    dp = dp - dp.mean(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        swing: Array = np.log(np.abs(_smooth(dp, rate)).mean(axis=1))
        duty: Array | None = None
        if "u" in recording:
            u = _smooth(rows(recording["u"]), rate)
            size = u.std(axis=1)
            duty = np.log(np.stack([size, np.diff(u, axis=1).std(axis=1) / size], axis=1))
    power, frequency, noise, lines = _bands(dp, rate)
    t = np.asarray(float(recording.t[0]) + (np.arange(count) + 0.5) * length / rate, dtype=np.float64)
    whole = ~touched(recording, length * np.arange(count + 1))
    if np.count_nonzero(whole) < 2 * FEWEST:
        return None
    t, mean, swing, power, noise = (values[whole] for values in (t, mean, swing, power, noise))
    duty = None if duty is None else duty[whole]
    f: Array = np.fft.rfftfreq(length, 1.0 / rate).astype(np.float64)
    spectra = [np.fft.rfft((own - own.mean(axis=1, keepdims=True)) * np.hanning(length), axis=1) for own in (p_A, p_B)]
    tilt, hum, line, mains = _sensors(spectra, f, rate)
    together = _together([own[whole] for own in spectra], f if not behind_valve else np.zeros(f.size), rate)
    scale, measure = float(np.exp(np.median(swing))), "the strokes' pressure difference"
    if behind_valve:
        scale, measure = float(np.median(mean.sum(axis=1))), "the supply's pressure"
    return Signatures(
        t,
        0.5 * length / rate,
        mean,
        swing,
        duty,
        power,
        frequency,
        noise,
        lines,
        duty_changes(recording),
        tilt[whole],
        hum[whole],
        line[whole],
        mains,
        None if find_cycle(recording) is None else _alike(_smooth(dp, rate)[whole]),
        together,
        max(scale, np.finfo(float).tiny),
        measure,
    )


def _smooth(rows: Array, rate: float) -> Array:
    """Return means over `SMOOTH_SECONDS` along each row."""
    every = max(1, round(SMOOTH_SECONDS * rate))
    whole = rows.shape[1] // every * every
    return np.asarray(rows[:, :whole].reshape(len(rows), -1, every).mean(axis=2))


def _bands(dp: Array, rate: float) -> tuple[Array, Array, Array, Array]:
    """Return the power (n, b) in bands of half an octave, and what it is compared with.

    That is the middles (b,) of the bands [Hz], the power (n,) of the noise in a line of the spectrum, and the number of
    lines (b,) in each band.
    """
    length = dp.shape[1]
    spectrum = np.abs(np.fft.rfft(dp * np.hanning(length), axis=1)) ** 2
    f = np.fft.rfftfreq(length, 1.0 / rate)
    edges = LOWEST * 2.0 ** (0.5 * np.arange(max(2, 1 + int(2.0 * math.log2(max(HIGHEST * rate / LOWEST, 1.5))))))
    of = np.searchsorted(edges, f, side="right") - 1
    power = np.stack([spectrum[:, of == k].sum(axis=1) for k in range(edges.size - 1)], axis=1)
    lines = np.array([np.count_nonzero(of == k) for k in range(edges.size - 1)], dtype=np.float64)
    noise = np.median(spectrum[:, f > NOISE * rate], axis=1) / math.log(2.0)  # exponential: mean = median/ln 2
    return power, edges[:-1] * 2.0**0.25, noise, lines


def _together(spectra: Sequence[NDArray[np.complex128]], f: Array, rate: float) -> Together:
    here = (f >= RINGING[0]) & (f <= min(RINGING[1], HIGHEST * rate))
    a, b = (own[:, here] for own in spectra)
    return Together(f[here], a * np.conj(b), np.stack([np.abs(a) ** 2, np.abs(b) ** 2]))


def _sensors(spectra: Sequence[NDArray[np.complex128]], f: Array, rate: float) -> tuple[Array, Array, Array, Array]:
    """Return what shows a change of a sensor's filter or of its wiring: tilt, hum, line and mains of `Signatures`.

    `spectra` of p_A and p_B (n, f.size) at the frequencies `f` [Hz].
    """
    mains = np.array([hertz for hertz in MAINS if hertz + HUM_BESIDE[1] < 0.5 * rate])
    own = np.searchsorted(f, mains) if HUM_BESIDE[0] > 2.0 * f[1] else np.empty(0, dtype=np.intp)
    mains = mains[: own.size]
    tilts, hums, own_lines = [], [], []
    for values in spectra:
        spectrum = np.abs(values) ** 2
        low, high = ((f > share * rate) & (f <= (share + TILT_WIDTH) * rate) for share in TILT)
        with np.errstate(divide="ignore", invalid="ignore"):
            tilts.append(np.log(np.median(spectrum[:, high], axis=1) / np.median(spectrum[:, low], axis=1)))
            lines, besides = [], []
            for hertz, line in zip(mains, own, strict=True):
                off = np.abs(f - hertz)
                lines.append(np.log(spectrum[:, line - 1 : line + 2].max(axis=1)))
                besides.append(np.log(spectrum[:, (off > HUM_BESIDE[0]) & (off <= HUM_BESIDE[1])].mean(axis=1)))
            shape = len(lines), len(values)
            own_lines.append(np.reshape(lines, shape).T)
            hums.append(own_lines[-1] - np.reshape(besides, shape).T)
    return np.stack(tilts, axis=1), np.stack(hums, axis=1), np.stack(own_lines, axis=1), mains


def lag_step(seen: Signatures, onset: float) -> tuple[float, float]:
    """Return by how much later p_A is read, beside p_B, after an instant than before [s], and how sure that is.

    The chambers ring against each other, leaking or not, so the phase of their cross spectrum stays; a delay tau of one
    turns it by 2 pi f tau. tau is that of the largest mean of cos(phase - 2 pi f tau), each frequency weighted by what
    its coherence tells of its phase; what it gains over tau = 0, of 2 at most, is how sure it is.
    """
    f, none = seen.together.f, (0.0, 0.0)
    sides = [seen.t <= onset - NEAR, seen.t >= onset + NEAR]
    if min(map(np.count_nonzero, sides)) < 2 * FEWEST or not f.size:
        return none
    crosses, variance = [], np.full(f.size, OWN_VARIANCE)
    for side in sides:
        cross = seen.together.cross[side].sum(axis=0)
        own = np.prod(seen.together.own[:, side].sum(axis=1), axis=0)
        coherence = np.clip(np.abs(cross) ** 2 / np.maximum(own, np.finfo(float).tiny), 1e-6, 1.0)
        variance = variance + (1.0 - coherence) / (2.0 * np.count_nonzero(side) * coherence)
        crosses.append(cross)
    phase = np.angle(crosses[1] * np.conj(crosses[0]))
    weight = np.where(variance < MOST_VARIANCE, 1.0 / variance, 0.0)
    if np.count_nonzero(weight) < FEWEST_LINES:
        return none
    delays = LAGS * np.linspace(-1.0, 1.0, 161)
    fit = np.cos(phase + 2.0 * math.pi * np.outer(delays, f)) @ weight / weight.sum()
    best = int(np.argmax(fit))
    return float(delays[best]), float(fit[best] - fit[delays.size // 2])


def _alike(rows: Array) -> Array:
    """Return the correlation (n - 1, 4) of rows: with the one before, with two before, of means before and after, most.

    But for two before, of what is left of each beside its line: a load that swings slowly turns the line about. What
    it bends besides is in no mean. `most`: the largest of a row that lies two or more before with any as far after.
    """

    def unit(rest: Array) -> Array:
        size = np.sqrt(np.sum(rest**2, axis=1, keepdims=True))
        return np.asarray(rest / np.maximum(size, np.finfo(float).tiny))

    rest = rows - rows.mean(axis=1, keepdims=True)
    line = np.arange(rows.shape[1]) - 0.5 * (rows.shape[1] - 1)
    bent, rest = rest - np.outer(rest @ line, line) / (line @ line), unit(rest)
    sums = np.cumsum(bent, axis=0)
    means, bent = np.sum(unit(sums[:-1]) * unit(sums[-1] - sums[:-1]), axis=1), unit(bent)
    before = np.sum(bent[1:] * bent[:-1], axis=1)
    # of rows i < w and j > w + 1 about the gap after row w, which leaves out the row that it may lie in
    among = np.maximum.accumulate(np.maximum.accumulate(bent @ bent.T, axis=0)[:, ::-1], axis=1)[:, ::-1]
    most = np.concatenate([[-1.0], np.diagonal(among, 3), [-1.0]]) if len(rows) > 3 else np.full(len(rows) - 1, -1.0)
    return np.stack([before, np.append(1.0, np.sum(rest[2:] * rest[:-2], axis=1)), means, most], axis=1)


def other_cause(
    seen: Signatures, onset_s: float, strict: float = 1.0, weighed: frozenset[Cause] = frozenset()
) -> OtherCause | None:
    """Return what else stepped near `onset_s` [s], the most certain first; None where nothing did.

    `strict`: factor on what a step must be over its deviation, and over what healthy machines show; causes that are
    `weighed` already are not asked for.
    """
    causes = (find(seen, onset_s, strict) for find in (_duty, _sensor, _air, _friction, _lost))
    return next((cause for cause in causes if cause is not None and cause.cause not in weighed), None)


def unasked(seen: Signatures) -> tuple[float, OtherCause] | None:
    """Return what stepped anywhere in the recording, and about when [s]; None where nothing did.

    For recordings in which no detector dates a change; the limits are stricter, since many instants are tried.
    """
    for at in np.arange(float(seen.t[0]) + NEAR, float(seen.t[-1]), 1.5 * NEAR):
        other = other_cause(seen, float(at), UNASKED)
        if other is not None and other.cause is not None:
            return float(at), other
    return None


def elsewhere(seen: Signatures) -> OtherCause | None:
    """Return whether p_A - p_B goes on in another sense or phase somewhere in a duty that repeats."""
    if seen.alike is None or not np.median(seen.alike[:, 0]) > SAME_PHASE:
        return None
    either = np.maximum(seen.alike[:, 0], seen.alike[:, 2])
    worst = int(np.argmin(either))
    if not either[worst] < OTHER_PHASE:
        return None
    at = float(seen.t[worst + 1])
    if min(seen.alike[worst : worst + 2, 1]) < -OTHER_PHASE:
        return OtherCause("sensor fault", f"near {at:.0f} s p_A - p_B changes its sign, as if p_A and p_B were swapped")
    either = np.where(seen.alike[:, 3] > AGAIN, 1.0, either)
    worst = int(np.argmin(either))
    if not either[worst] < OTHER_PHASE:
        return None
    at = float(seen.t[worst + 1])
    return OtherCause("changed duty", f"near {at:.0f} s p_A - p_B goes on in another phase, as of another recording")


def isolated(evidence: Evidence, seen: Signatures, known: Sequence[Signatures] = ()) -> Evidence:
    """Return the evidence of a leak as `cannot tell` with another cause where one stepped at its onset.

    A sensor's filter that changed counts wherever it happened: both sides of any onset are not read alike. For evidence
    that names no cause, which comes from the spectrum alone, so does hum, and whatever else stepped plainly
    (`unasked`); a model of the machine leaves that out but at the onset. A duty that goes on in another phase or sense
    counts against all; one that changes to and fro, of which either side of the onset has all, not against a model of
    the machine. Evidence without an onset comes from the comparison with a baseline, of the signatures `known`:
    there counts what differs from all of it.
    """
    if evidence.verdict != "leak" or evidence.cause not in (None, *LEAKS):
        return evidence
    if evidence.onset_s is None:
        other = unlike(seen, known) if evidence.cause is None else None
    else:
        other = elsewhere(seen)
        if other is not None and other.cause in evidence.weighed:
            other = None
        if other is None and evidence.detector != BALANCED:
            asked = seen
            if evidence.cause is not None:
                asked = replace(seen, motion=tuple(change for change in seen.motion if not change.recurs))
            other = other_cause(asked, evidence.onset_s, weighed=evidence.weighed) or _readings(
                seen, evidence.onset_s if evidence.cause is not None else None, "friction change" in evidence.weighed
            )
        if other is None and evidence.cause is None:
            other = _anywhere(seen)
        other = other or _scale(seen, evidence) or _charge(seen, evidence.onset_s)
    if other is None:
        return evidence
    return replace(
        evidence,
        verdict="cannot tell",
        reason=f"{evidence.reason}; but {other.text}, which may be all of it",
        leak_lpm=None,
        leak_interval_lpm=None,
        cause=other.cause,
        course=None,
        relative=None,
    )


def _anywhere(seen: Signatures) -> OtherCause | None:
    stepped = unasked(seen)
    if stepped is None:
        return None
    return OtherCause(stepped[1].cause, f"near {stepped[0]:.0f} s {stepped[1].description}")


def unlike(seen: Signatures, known: Sequence[Signatures]) -> OtherCause | None:
    """Return in what a recording differs from all leak-free ones that a leak does not move; None where in nothing.

    That is a sensor's filter or hum; against fewer than `FEWEST_RECORDINGS`, whose scatter from day to day nobody
    knows, also the charge pressure (both chambers' means), friction and noise. A recording that lies within the range
    of the leak-free ones, or outside by no more than what matters, differs in nothing.
    """
    if not known:
        return None

    def outside(own: Array, others: Sequence[Array]) -> Array:
        """Return by how much medians over the blocks (..,) lie over or under those of all others."""
        value, range_ = np.median(own, axis=0), np.stack([np.median(other, axis=0) for other in others])
        low, high = range_.min(axis=0), range_.max(axis=0)
        return np.asarray(np.maximum(value - high, 0.0) + np.minimum(value - low, 0.0))

    tilt = outside(seen.tilt, [other.tilt for other in known])
    alike = [other.hum for other in known if np.array_equal(other.mains, seen.mains)]
    hum = outside(seen.hum, alike) if alike and seen.mains.size else np.zeros((len(CHAMBERS), 0))
    for chamber, name in enumerate(CHAMBERS):
        if abs(tilt[chamber]) > FILTERED:
            what = "smoother" if tilt[chamber] < 0 else "sharper"
            return OtherCause(
                "sensor fault", f"the noise of {name} is {what} than in the baseline, as by another filter"
            )
        for hertz, change in zip(seen.mains, hum[chamber], strict=True):
            if abs(change) > HUMS:
                which = "more" if change > 0 else "less"
                return OtherCause(
                    "sensor fault", f"there is {which} hum of {hertz:g} Hz in {name} than in the baseline"
                )
    for hertz, change in zip(seen.mains, hum.mean(axis=0), strict=True):
        if abs(change) > HUMS_BOTH:
            which = "more" if change > 0 else "less"
            return OtherCause("sensor fault", f"there is {which} hum of {hertz:g} Hz in both than in the baseline")
    if len(known) >= FEWEST_RECORDINGS:
        return None
    mean = outside(seen.mean / seen.scale, [other.mean / seen.scale for other in known])
    swing = float(outside(seen.swing, [other.swing for other in known]))
    with np.errstate(divide="ignore"):
        noise = float(outside(np.log(seen.noise), [np.log(other.noise) for other in known]))
    differing = []
    if np.abs(mean).max() > CHARGED:
        largest = float(mean[np.argmax(np.abs(mean))])
        differing.append(f"the chambers' means by up to {largest:+.0%} of {seen.measure}")
    if abs(swing) > FRICTION:
        differing.append(f"the strokes' pressure difference by {math.expm1(swing):+.1%}, which friction sets")
    if abs(noise) > NOISY:
        differing.append(f"the noise by {math.expm1(0.5 * noise):+.1%}")
    if not differing:
        return None
    return OtherCause(
        None,
        f"what a leak does not move differs from the baseline, too ({', '.join(differing)}), so it is of another day "
        "or another machine",
    )


def _step(seen: Signatures, values: Array, onset: float) -> tuple[float, float]:
    return step_near(seen.t, values, seen.half, onset, near=NEAR, reach=REACH, fewest=FEWEST)


def _duty(seen: Signatures, onset: float, strict: float) -> OtherCause | None:
    near = [change for change in seen.motion if abs(change.t - onset) <= NEAR]
    if near:
        text = "the " + ", ".join(change.text for change in near)
        if any(change.certain for change in near):
            return OtherCause("changed duty", text)
        return OtherCause(None, f"{text}: a changed duty")
    if seen.duty is None:
        return None
    for values, what in zip(seen.duty.T, ("size", "rate"), strict=True):
        size, surely = _step(seen, values, onset)
        if abs(size) > strict * DUTY and abs(surely) > strict * SURE:
            return OtherCause("changed duty", f"the command changed, its {what} by {math.expm1(size):+.1%}")
    return None


def _readings(seen: Signatures, onset: float | None, quiet: bool) -> OtherCause | None:
    """Return whether a sensor's filter stepped anywhere, or hum near `onset` [s], None: anywhere, too.

    Where the ringing may have become `quiet`, as by a large leak, hum stands out of what lies beside it and the
    chambers' phase is lost; then the filter alone is asked for.
    """

    def surest(values: Array, onset: float | None) -> tuple[float, float]:
        if onset is not None:
            return _step(seen, values, onset)
        middle, reach = 0.5 * float(seen.t[0] + seen.t[-1]), float(seen.t[-1] - seen.t[0])
        return step_near(seen.t, values, seen.half, middle, near=reach, reach=2.0 * reach, fewest=FEWEST)

    sure = SURE if onset is not None else SURE_ANYWHERE
    for chamber, name in enumerate(CHAMBERS):
        size, surely = surest(seen.tilt[:, chamber], None)
        if abs(size) > FILTERED and abs(surely) > SURE_ANYWHERE:
            what = "smoother" if size < 0 else "sharper"
            return OtherCause(
                "sensor fault", f"the noise of {name} became {what}, so its filter or its sampling changed"
            )
        for number, hertz in enumerate(() if quiet else seen.mains):
            size, surely = surest(seen.hum[:, chamber, number], onset)
            if abs(size) > HUMS and abs(surely) > sure:
                # a leak that damps a ringing near the mains uncovers hum that was there
                moved = surest(seen.line[:, chamber, number], onset)[0] * np.sign(size)
                if moved < HUMS_OWN:
                    continue
                verb = "began" if size > 0 else "ended"
                return OtherCause("sensor fault", f"hum of {hertz:g} Hz {verb} in {name}")
    lag, surely = lag_step(seen, onset) if onset is not None and not quiet else (0.0, 0.0)
    if abs(lag) >= LEAST_LAG and surely > LAGGED:
        return OtherCause("sensor fault", f"p_A is read {abs(lag) * 1e3:.1f} ms {'later' if lag > 0 else 'earlier'}")
    return None


def _sensor(seen: Signatures, onset: float, strict: float) -> OtherCause | None:
    size, surely = np.array([_step(seen, values / seen.scale, onset) for values in seen.mean.T]).T
    largest = int(np.argmax(np.abs(size)))
    if abs(size[largest]) < strict * MEAN or abs(surely[largest]) < strict * SURE:
        return None
    if abs(size[1 - largest]) > ALONE * abs(size[largest]):
        return None
    return OtherCause(
        "sensor fault",
        f"the mean of {CHAMBERS[largest]} alone steps by {size[largest]:+.1%} of {seen.measure}, "
        "which a piston that floats between both chambers does not allow",
    )


def _scale(seen: Signatures, evidence: Evidence) -> OtherCause | None:
    """Return whether a conductance rose because the pressure difference fell while the flow Q stayed, G = Q/|dp|.

    With the pressure difference times s, a conductance of the same flow rises by what passes (1 - s) of Q. A leak
    lowers the pressure difference only where it is many times what pump and piston passed before.
    """
    passed = None if evidence.passage is None else evidence.passage.lpm
    if evidence.onset_s is None or evidence.leak_lpm is None or passed is None:
        return None
    size, surely = _step(seen, seen.swing, evidence.onset_s)
    if size > -FRICTION or surely > -SURE or evidence.leak_lpm > SAME_FLOW * passed * -math.expm1(size):
        return None
    return OtherCause(
        None,
        f"the strokes' pressure difference falls by {-math.expm1(size):.0%} while what passes the pump and the piston "
        "stays: another scale of the pressures, or another friction",
    )


def _charge(seen: Signatures, onset: float) -> OtherCause | None:
    """Return whether both chambers' means step alike, which a leak between them does not bring about."""
    size, surely = np.array([_step(seen, values / seen.scale, onset) for values in seen.mean.T]).T
    if np.abs(size).min() < max(CHARGED, ALIKE * np.abs(size).max()) or np.abs(surely).min() < SURE:
        return None
    if size[0] * size[1] < 0.0:
        return None
    return OtherCause(
        None,
        f"both chambers' means step by {size.mean():+.0%} of {seen.measure}, which a leak between "
        "them does not bring about: another charge pressure, or another machine's readings",
    )


def _air(seen: Signatures, onset: float, strict: float) -> OtherCause | None:
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = [_step(seen, np.log(values), onset) for values in seen.power.T]
    most = max(range(len(steps)), key=lambda k: steps[k][0])
    size, surely = steps[most]
    if size < strict * math.log(GAIN) or surely < strict * SURE:
        return None
    away = np.abs(seen.t - onset)
    near = (away < REACH) & (away > seen.half)
    before, after = _ringing(seen, near & (seen.t < onset)), _ringing(seen, near & (seen.t > onset))
    if not after < (1.0 - FALL) * before:
        return None
    return OtherCause(
        "air in the oil",
        f"the ringing falls from about {before:.0f} to {after:.0f} Hz, with {math.exp(size):.1f} times the power "
        f"near {seen.frequency[most]:.0f} Hz, so the oil became softer",
    )


def _ringing(seen: Signatures, blocks: NDArray[np.bool_]) -> float:
    """Return the mean frequency [Hz] of the ringing in these blocks.

    That of the power beyond the noise times f^2, which makes the overtones of the strokes (power as 1/f^2) even.
    """
    beyond = np.median(seen.power[blocks] - seen.noise[blocks, None] * seen.lines, axis=0)
    weight = np.maximum(beyond, 0.0) * seen.frequency**2
    if not weight.sum() > 0:
        return math.nan
    return float(np.exp(weight @ np.log(seen.frequency) / weight.sum()))


def _friction(seen: Signatures, onset: float, strict: float) -> OtherCause | None:
    size, surely = _step(seen, seen.swing, onset)
    if abs(size) < strict * FRICTION or abs(surely) < strict * SURE:
        return None
    return OtherCause(
        "friction change",
        f"the mean pressure difference of the strokes steps by {math.expm1(size):+.1%}, which friction sets",
    )


def _lost(seen: Signatures, onset: float, strict: float) -> OtherCause | None:
    """Return whether oil is lost to the outside: both chambers' means fall below the line and the values before.

    They need not step, since a make-up may hold them for a while.
    """
    t = seen.t - onset
    before = (t + seen.half <= -NEAR) & (t > -NEAR - REACH)
    after = (t - seen.half >= NEAR) & (t < NEAR + REACH)
    if min(np.count_nonzero(before), np.count_nonzero(after)) < FEWEST:
        return None
    x = np.stack([np.ones(t.size), t], axis=1)
    inverse = np.linalg.inv(x[before].T @ x[before])
    at = x[after].mean(axis=0)
    fallen = []
    for values in seen.mean.T / seen.scale:
        line = inverse @ (x[before].T @ values[before])
        rest = values[before] - x[before] @ line
        variance = float(rest @ rest) / max(rest.size - 2, 1)
        deviation = math.sqrt(variance * (1.0 / np.count_nonzero(after) + float(at @ inverse @ at)))
        fall = float(at @ line - values[after].mean())
        under = float(values[before].min() - values[after].mean())
        if fall < strict * SURE * deviation or min(fall, under) < strict * LOST:
            return None
        fallen.append(fall)
    if min(fallen) < ALIKE * max(fallen):
        return None
    return OtherCause(
        "external leak",
        f"both chambers' means fall, by {np.mean(fallen):.1%} of {seen.measure}: oil leaves the circuit",
    )
