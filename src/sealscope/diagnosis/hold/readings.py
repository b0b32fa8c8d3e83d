"""Reduce the samples of a hold to some hundred readings with known times, and find the holds of a log.

Means over parts of a hold lose nothing of a line, but the rounding of a position does not average out where its noise
is smaller than a step of the encoder. Such a position says exactly when it passes from one step to the next, and
otherwise only that it is within a step: its readings are these passages, and both ends of the hold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.priors.hold import HOLD
from sealscope.recordings.channels import estimate_quantum
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array
from sealscope.units import BAR

#: Number of parts of a hold in which passages between encoder steps are sought.
N_PARTS = 960
#: Largest distance of a mean from a step of the encoder, in steps, at which all samples are at that step.
AT_STEP = 0.02
#: Share of parts with the same step as the part before, above which a position is read by its passages.
SHARE_AT_STEP = 0.3
#: Number of times between passages at which a position that stands is read.
N_BETWEEN = 10
#: Degree of the polynomial, time constants of the exponentials [durations of the hold] of a smooth course, and largest
#: correlation of neighbouring residuals about it.
SMOOTH_DEGREE, SMOOTH_TIMES, MAX_CORRELATION = 4, (0.02, 0.06, 0.2), 0.3
#: Largest residual of such a course, root mean square over the noise of the means.
MAX_MISFIT = 1.5
#: Quantile of a chamber's pressure that counts as the pressure held.
HIGHEST = 0.9
#: Largest number of bins in which holds are sought.
MAX_BINS = 20_000


class Readings(NamedTuple):
    """Readings of a channel in a hold.

    `t` (m,) [s]: times since the hold's start; `values` (m,); `loose` (m,): standard deviation of readings that are
    only known to be within a step of the encoder, 0 for others; `quantum`: size of that step, 0 for means; `step`
    [s], `n_samples`: time between the samples of a mean, and their number on average.
    """

    t: Array
    values: Array
    loose: Array
    quantum: float
    step: float = 0.0
    n_samples: float = 1.0

    def decay(self, time: float) -> Array:
        """Compute exp(-t/time) as the readings see it: means are averaged over their samples."""
        u = 0.5 * self.step / time
        factor = math.sinh(self.n_samples * u) / (self.n_samples * math.sinh(u)) if u > 0.0 else 1.0
        return np.asarray(np.exp(-self.t / time) * factor)


def average_parts(t: Array, values: Array, n_parts: int) -> tuple[Array, Array]:
    """Average samples (n,) at `t` [s] over `n_parts` equal times; return mean times and means of the parts with any."""
    starts = np.unique(np.searchsorted(t, t[0] + (t[-1] - t[0]) / n_parts * np.arange(n_parts)))
    counts = np.diff(starts, append=len(t))
    times, means = (np.add.reduceat(series - series[0], starts) / counts + series[0] for series in (t, values))
    return times, means


def sample_course(readings: Readings, t: Array, course: Array) -> Array:
    """Compute a course, known at fine times `t` (k,), as the readings (m,) see it: as means of parts, or at times."""
    if readings.quantum:
        return np.asarray(np.interp(readings.t, t, course))
    part_t, means = average_parts(t, course, HOLD.noise.nodes)
    return np.asarray(np.interp(readings.t, part_t, means))


def read_channel(t: Array, values: Array, least_step: float) -> Readings:
    """Reduce the finite samples (n,) of a channel at `t` [s since the hold's start] to readings.

    `least_step`: step of the encoder that is assumed where all samples are equal.
    """
    quantum = estimate_quantum(values)
    quantum = quantum or least_step
    fine_t, fine = average_parts(t, values, N_PARTS)
    position = (fine - values.min()) / quantum
    code = np.round(position)
    is_at_step = np.abs(position - code) < AT_STEP
    is_same = is_at_step[1:] & is_at_step[:-1] & (code[1:] == code[:-1])
    if is_same.mean() > SHARE_AT_STEP and np.abs(np.diff(code)).sum() <= HOLD.noise.nodes:
        return _read_passages(t, fine_t, position, float(values.min()), quantum)
    mean_t, means = average_parts(t, values, HOLD.noise.nodes)
    step = float(t[-1] - t[0]) / max(len(t) - 1, 1)
    return Readings(mean_t, means, np.zeros(len(means)), 0.0, step, len(t) / len(means))


def _read_passages(t: Array, fine_t: Array, position: Array, origin: float, quantum: float) -> Readings:
    """Read a coarsely rounded position where it passes from one step of its encoder to the next, and at both ends.

    `position` (k,): means over parts at `fine_t`, in steps of the size `quantum` above `origin`. Passages through one
    boundary that follow each other, as noise makes them, are one reading at their mean time. A single passage bounds
    the slope by the longer part beside it alone.
    """
    cell = np.floor(position + 0.5)
    changes = np.flatnonzero(np.diff(cell))
    times, boundaries = list[float](), list[float]()
    for k in changes.tolist():
        first, last = sorted((cell[k], cell[k + 1]))
        passed = np.arange(first, last) + 0.5  # boundaries between the two means
        order = passed if cell[k + 1] > cell[k] else passed[::-1]
        fractions = (order - position[k]) / (position[k + 1] - position[k])
        times += (fine_t[k] + fractions * (fine_t[k + 1] - fine_t[k])).tolist()
        boundaries += order.tolist()
    starts = [k for k in range(len(boundaries)) if k == 0 or boundaries[k] != boundaries[k - 1]]
    groups = np.split(np.array(times), starts[1:]) if times else []
    passage_t = np.array([float(group.mean()) for group in groups])
    levels = np.array([boundaries[k] for k in starts])
    ends = [(float(t[0]), cell[0]), (float(t[-1]), cell[-1])]
    if len(groups) == 1:
        ends = [max(ends, key=lambda end: abs(end[0] - passage_t[0]))]
    # between passages the position is known to be within a step, which excludes a motion and its return
    between = np.linspace(fine_t[0], fine_t[-1], N_BETWEEN + 2)[1:-1]
    near = np.abs(between[:, None] - passage_t).min(axis=1, initial=np.inf) < 0.5 * (between[1] - between[0])
    between = between[~near]
    codes = cell[np.minimum(np.searchsorted(fine_t, between), len(cell) - 1)]
    all_t = np.concatenate([passage_t, [end[0] for end in ends], between])
    values = np.concatenate([levels, [end[1] for end in ends], codes]) * quantum + origin
    loose = np.concatenate([np.zeros(len(groups)), np.full(len(ends), 12.0**-0.5), np.ones(len(between))]) * quantum
    order_t = np.argsort(all_t, kind="stable")
    return Readings(all_t[order_t], values[order_t], loose[order_t], quantum)


def course_basis(z: Array, degree: int, times: Sequence[float] = ()) -> Array:
    """Compute polynomials up to a `degree`, and exponentials of `times`, at z (m,) from 0 to 1: columns of a matrix."""
    powers = np.polynomial.chebyshev.chebvander(2.0 * z - 1.0, degree)
    return np.column_stack([powers, *(np.exp(-z / time) for time in times)])


def smooth_course(t: Array, values: Array) -> tuple[Array, Array]:
    """Average samples (n,) over fine parts of a hold, and smooth the means unless they wander; return times and values.

    The noise of a pressure that serves as a regressor would hide its effect. The smooth course is a polynomial with
    exponentials; it is taken where what it leaves, averaged to readings, is white and no larger than their noise.
    """
    part_t, means = average_parts(t, values, N_PARTS)
    size = max(len(means) // HOLD.noise.nodes, 1)
    if len(means) <= 2 * (SMOOTH_DEGREE + 1 + len(SMOOTH_TIMES)):
        return part_t, means
    z = (part_t - part_t[0]) / (part_t[-1] - part_t[0])
    basis = course_basis(z, SMOOTH_DEGREE, SMOOTH_TIMES)
    starts = np.arange(0, len(means) - size + 1, size)
    noise = 1.4826 * float(np.median(np.abs(np.diff(np.add.reduceat(means, starts) / size, 2)))) / 6.0**0.5
    for n_columns in (1, 2, basis.shape[1]):  # the simplest course that suffices
        smooth = basis[:, :n_columns] @ np.linalg.lstsq(basis[:, :n_columns], means, rcond=None)[0]
        residual = np.add.reduceat(means - smooth, starts) / size
        power = float(residual @ residual)
        is_white = float(residual[1:] @ residual[:-1]) < MAX_CORRELATION * power
        if is_white and power < len(residual) * (MAX_MISFIT * noise) ** 2:
            return part_t, smooth
    return part_t, means


def find_held_parts(
    t: Array, x: Array | None, pressures: Sequence[Array] = (), flow: Array | None = None
) -> list[tuple[int, int]]:
    """Find the holds of a log: first and last index of the samples between which neither position nor pressure moves.

    `t` [s], `x` [m], `pressures` [Pa], leakage `flow` [m^3/s] (n,): samples without gaps, of which some may be absent.
    A flow begins and ends with the hold. What moves differs from
    the hold about it: means over `part.bin` of `priors.toml` change `part.ratio` times as fast as the slowest quarter
    of them, within `part.creep` and `part.speed`, or faster than `part.decay` of the highest pressure and
    `part.pressure`; and together they move by more than slips and settling do (`part.travel`, `part.fall`).
    """
    prior = HOLD.part
    step = float(np.median(np.diff(t)))
    n_bins = int(min(max((t[-1] - t[0]) / max(prior.bin, step), 1.0), MAX_BINS))
    held = max((float(np.quantile(p, HIGHEST)) for p in pressures), default=0.0)  # a leak may empty the chamber
    usual = 0.0 if flow is None else float(np.quantile(np.abs(flow), HIGHEST))
    decay = min(prior.pressure * BAR, prior.decay * held) if held > 0.0 else prior.pressure * BAR
    speeds, decays = (prior.creep * 1e-3, prior.speed * 1e-3), (decay, decay)
    is_moving, bin_t = np.zeros(0, dtype=bool), t
    limits = (
        *([] if x is None else [(x, speeds, prior.position * 1e-3, prior.travel * 1e-3)]),
        *((p, decays, prior.scatter * BAR, prior.fall * held) for p in pressures),
        *([] if flow is None else [(flow, (prior.decay * usual, prior.decay * usual), math.inf, prior.fall * usual)]),
    )
    for values, (slowest, fastest), largest, travel in limits:
        bin_t, means = average_parts(t, values, n_bins)
        changes, times = np.diff(means), np.diff(bin_t)
        scatter = 1.4826 * float(np.median(np.abs(np.diff(means, 2)))) / 6.0**0.5 if len(means) > 2 else 0.0
        held_rate = float(np.quantile(np.abs(changes) / times, 0.25)) if len(means) > 1 else 0.0
        rate = min(max(prior.ratio * held_rate, slowest), fastest)
        moves = np.abs(changes) > rate * times + prior.noise * 2.0**0.5 * min(scatter, largest)
        for first, length in find_runs(moves).tolist():
            moves[first : first + length] &= np.abs(changes[first : first + length]).sum() > travel
        is_moving = moves if not is_moving.size else is_moving | moves
    runs = find_runs(~is_moving)
    parts = []
    for first, length in runs.tolist():
        # the bins beside a motion may contain some of it
        begin, end = first + (first > 0), first + length - (first + length < len(is_moving))
        if end > begin:
            inside = np.flatnonzero((t >= bin_t[begin]) & (t <= bin_t[end]))
            parts.append((int(inside[0]) if begin else 0, int(inside[-1]) if end < len(bin_t) - 1 else len(t) - 1))
    return parts
