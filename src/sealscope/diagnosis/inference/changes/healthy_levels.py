"""Friction, drifts and spectra of the pressures over a whole recording, compared with healthy recordings.

- The friction is half the change of p_A - p_B from one direction of motion to the other. Its logarithm is compared,
  since friction of seals and guides changes in proportion.
- A drift of one pressure only is a drift of that sensor's offset; the charge pressure changes both pressures alike. The
  drifts are fitted over the samples in which the piston moves (`motion_fit`), and a second time over the low values of
  each pressure, which also show a loss of oil (`charge_pressure`). From day to day the zeros of both sensors are
  compared while a valve connects the chambers (`estimate_connected_difference`): the pump rests, the actuator is moved
  to and fro from outside, and the drop of pressure in the valve changes its sign with the motion.
- A filter of one sensor changes the ratio and the phase of the spectra of both pressures (`compare_spectra`).

A number is tested against its scatter between healthy recordings (`observable.compare_estimates`). Called for
recordings with both chamber pressures.

A low-pass filter of first order with the cut-off frequency f_c multiplies one pressure by

    H(f) = 1 / (1 + i f / f_c),    log abs(H) = -log(1 + (f / f_c)^2) / 2,    arg H = -arctan(f / f_c),

before the sensor's noise is added. The pressure is compared with another channel that is coherent with it: p_A with
p_B, and each with the position x and the pump's speed, since in many machines one chamber rests at the charge
pressure. With the spectra A and B of such a pair (periodograms of Hann windows, Welch), the ratio log abs(A / B) and
the phase of sum(A B*) in each octave are compared with those of healthy recordings. No change of the load, the friction
or a leak turns the phase of one pressure by arctan(f / f_c) at all frequencies.

The ratios of an octave vary between healthy recordings by an unknown variance with a prior, and neighbouring octaves
vary together: a recording's ratios follow a multivariate t distribution. The phases follow von Mises distributions.
Their variance is also estimated from the healthy recordings, and is larger where the pressures are hardly coherent; a
fraction of the phases is uniform. The test statistic is the Bayes factor of a filter, averaged over the pairs, the
filtered pressure, f_c and the noise. The mean of a Bayes factor over healthy recordings is 1, so a healthy recording
exceeds b with a probability of at most 1 / b (Markov).

Source: P. D. Welch, IEEE Transactions on Audio and Electroacoustics 15 (1967) 70; J. S. Bendat, A. G. Piersol, Random
Data, 4th ed. (2010), section 9.2 (error of a phase); K. V. Mardia, P. E. Jupp, Directional Statistics (2000), section
3.5; A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 3.6.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import MIN_HEALTHY, ScatterPrior, estimate_variance
from sealscope.diagnosis.healthy import MAX_LOGARITHM, Healthy, Magnitude, Number, Summary, Values, healthy_summaries
from sealscope.diagnosis.inference.changes.charge_pressure import (
    DRIFT,
    PUMP,
    compare_low_drifts,
    estimate_low_drifts,
    subtract_drifts,
    turned_angle,
)
from sealscope.diagnosis.inference.changes.features import SIGNALS
from sealscope.diagnosis.inference.changes.motion_fit import (
    TIME,
    fit_difference,
    fit_robustly,
    select_motion,
)
from sealscope.diagnosis.inference.equations.terms import Signals
from sealscope.diagnosis.inference.hypotheses import step_penalty
from sealscope.diagnosis.inference.machine_states import MIN_REST, flag_lowering, number_strokes, rest_limit
from sealscope.diagnosis.inference.observable import Observable, compare_estimates
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.channels import CHAMBERS, flow_source
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.smoothing import TINY

#: `Observable.data` of the comparison of spectra.
SIDES = "sides"
#: Pairs of channels whose spectra are compared, by their names in a recording's summary.
PAIRS = {
    "octaves": CHAMBERS,
    "octaves_A_x": ("p_A", "x"),
    "octaves_B_x": ("p_B", "x"),
    "octaves_A_omega": ("p_A", "omega"),
    "octaves_B_omega": ("p_B", "omega"),
}
#: Minimum number of octaves.
MIN_OCTAVES = 3
#: Power added before dividing or taking a logarithm: of pressures [Pa^2], position [m^2], pump's speed [rad^2/s^2].
MIN_POWER = {"p_A": 1e-6, "p_B": 1e-6, "x": 1e-24, "omega": 1e-18}
#: Minimum coherence, since its square is a divisor.
MIN_COHERENCE = 1e-3
#: Number of cut-off frequencies, between the limits of the prior.
CUTOFFS = 15
#: Number of samples in the windows that are transformed together.
MAX_TOGETHER = 100_000
#: Largest variance of a phase [rad^2], at which a phase is nearly uniform.
MAX_VARIANCE = 4.0


class Octaves(NamedTuple):
    """Spectra of two channels A and B of a recording in k octaves, (k,) each.

    - `log_A`, `log_B`: logarithms of the amplitudes of A and B in busy windows, up to a constant.
    - `phase`: phase of the cross-spectrum [rad], positive if A leads.
    - `phase_variance`: variance of the error of the phase [rad^2].
    """

    log_A: Array
    log_B: Array
    phase: Array
    phase_variance: Array


def compute_octaves(recording: Recording, pair: tuple[str, str] = CHAMBERS) -> Octaves | None:
    """Compute the octaves of a `pair` of channels (`compute_all_octaves`), None if the recording does not allow it."""
    return compute_all_octaves(recording, [pair])[0]


def compute_all_octaves(recording: Recording, pairs: Sequence[tuple[str, str]]) -> list[Octaves | None]:
    """Compute, for several pairs, the log amplitudes of both channels in octaves of frequency, and their phase.

    The power in an octave is a high quantile (`octaves.busy` of `priors.toml`) over windows of time, since a machine
    may often rest; the phase is that of the sum over all windows. The result is None for a pair if a channel is not
    recorded, if the recording is too short or its sampling rate too low for `MIN_OCTAVES` octaves, or if all windows
    have missing samples.
    """
    priors = CHANGES.octaves
    length = round(priors.seconds * recording.rate)  # samples in a window
    highest = min(priors.highest, priors.share * recording.rate)
    n_octaves = int(np.log2(max(highest / priors.lowest, 1.0)))
    recorded = [pair for pair in pairs if set(pair) <= set(recording.channels)]
    if not recorded or n_octaves < MIN_OCTAVES or len(recording) < length:
        return [None] * len(pairs)
    powers = _octave_powers(recording, recorded, length, _octave_edges(n_octaves))
    by_pair = {pair: _reduce_powers(pair, *sums) for pair, sums in powers.items()}
    return [by_pair.get(pair) for pair in pairs]


def _reduce_powers(
    pair: tuple[str, str], powers_A: Array, powers_B: Array, cross_powers: NDArray[np.complex128]
) -> Octaves | None:
    """Compute the octaves of a pair of channels from its powers in windows (`_octave_powers`); None if not finite."""
    priors = CHANGES.octaves
    min_A, min_B = (MIN_POWER[channel] for channel in pair)
    log_A = 0.5 * np.log(np.quantile(powers_A, priors.busy, axis=0) + min_A)
    log_B = 0.5 * np.log(np.quantile(powers_B, priors.busy, axis=0) + min_B)
    cross_power = cross_powers.sum(axis=0)
    mean_power = np.sqrt((powers_A.sum(axis=0) + min_A) * (powers_B.sum(axis=0) + min_B))  # geometric mean
    coherence_squared = np.clip(np.abs(cross_power) / mean_power, MIN_COHERENCE, 1.0) ** 2
    # (1 - c^2) / (2 n c^2) with the coherence c; n independent windows are half of all windows, which overlap by half
    phase_variance = (1.0 - coherence_squared) / coherence_squared / len(powers_A)
    phase = np.angle(cross_power)
    octaves = Octaves(log_A, log_B, phase, np.minimum(phase_variance, MAX_VARIANCE))
    return octaves if np.isfinite(octaves).all() else None


def _octave_edges(count: int) -> Array:
    """Return the limits (`count` + 1,) of `count` octaves of frequency [Hz], upwards from `octaves.lowest`."""
    edges: Array = CHANGES.octaves.lowest * np.exp2(np.arange(count + 1.0))
    return edges


#: Powers of A and of B, and their cross-power, in w windows and k octaves, (w, k) each.
_Powers = tuple[Array, Array, NDArray[np.complex128]]


def _octave_powers(
    recording: Recording, pairs: Sequence[tuple[str, str]], length: int, edges: Array
) -> dict[tuple[str, str], _Powers]:
    """Compute powers and cross-power of pairs of channels A and B in half-overlapping Hann windows, in octaves.

    `length`: samples of a window; `edges` (k + 1,): limits of the octaves [Hz]. The results for each pair are sums of
    abs(A)^2, abs(B)^2 and A B* over the lines of each octave. Windows with missing samples are left out, and a pair
    without any other window, too.
    """
    from scipy.ndimage import median_filter

    names = sorted({name for pair in pairs for name in pair})
    # the median of three removes single wrong samples
    windows = {
        name: np.lib.stride_tricks.sliding_window_view(median_filter(recording[name], 3, mode="nearest"), length)
        for name in names
    }
    first_lines = np.searchsorted(np.fft.rfftfreq(length, 1.0 / recording.rate), edges)
    hann, n_together, step = np.hanning(length), max(1, MAX_TOGETHER // length), max(length // 2, 1)
    n_windows = -(-len(next(iter(windows.values()))) // step)  # rounded up

    def sum_lines(products: NDArray[Any]) -> NDArray[Any]:
        """Sum products (windows, lines) over the lines of each octave."""
        # lines are 1 / `octaves.seconds` apart, the width of the lowest octave: every octave has a line
        return np.asarray(np.add.reduceat(products[:, : first_lines[-1]], first_lines[:-1], axis=1))

    sums: dict[tuple[str, str], list[_Powers]] = {pair: [] for pair in pairs}
    for start in range(0, n_windows, n_together):
        spectra, powers, is_known = {}, {}, {}
        for name in names:
            parts = windows[name][start * step : (start + n_together) * step : step]
            is_known[name] = np.isfinite(parts).all(axis=1)
            spectra[name] = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * hann)
            powers[name] = sum_lines(np.abs(spectra[name]) ** 2)
        for A, B in pairs:
            known = is_known[A] & is_known[B]
            cross_powers = sum_lines(spectra[A] * spectra[B].conj())
            sums[A, B].append((powers[A][known], powers[B][known], cross_powers[known]))
    joined = {pair: tuple(np.concatenate(parts) for parts in zip(*sums[pair], strict=True)) for pair in pairs}
    return {pair: (A, B, cross) for pair, (A, B, cross) in joined.items() if len(A)}


def compare_spectra(judged: Mapping[str, Octaves], healthy: Sequence[Mapping[str, Octaves]]) -> Observable | None:
    """Test for a new low-pass filter of one pressure, such as a clogged line, against healthy recordings.

    `judged`, `healthy`: spectra of each recording for pairs of channels, by their names in `PAIRS`. The result is named
    after the pressure that is most probably filtered. Its size is the most probable cut-off frequency [Hz], its p-value
    the inverse of the Bayes factor of a filter, averaged over the pairs, or 1 for a factor below 1. Its score is twice
    the log of this factor, or 0. Return None if too few healthy recordings remain for every pair (`_compare_pair`).
    """
    from scipy.special import logsumexp

    comparisons = (
        _compare_pair(octaves, [spectra[name] for spectra in healthy if name in spectra], PAIRS[name])
        for name, octaves in judged.items()
    )
    filters = [comparison for comparison in comparisons if comparison is not None]
    if not filters:
        return None
    # log of the mean Bayes factor of the pairs
    log_factor = float(logsumexp([log_factor for log_factor, _, _ in filters]) - np.log(len(filters)))
    _, channel, cutoff = max(filters, key=lambda comparison: comparison[0])
    return Observable(
        name=f"filter of {channel}",
        data=SIDES,
        score=max(2.0 * log_factor, 0.0),
        chance=float(np.exp(-max(log_factor, 0.0))),
        size=cutoff,
    )


def _compare_pair(
    judged: Octaves, healthy: Sequence[Octaves], pair: tuple[str, str]
) -> tuple[float, str, float] | None:
    """Compute the log Bayes factor of a new low-pass filter of one pressure to no filter, from the spectra of a `pair`.

    The factor is averaged over possible filters of each pressure in the pair. Returns it with the pressure and the
    cut-off frequency [Hz] of the most probable filter; None if too few healthy recordings have at least as many octaves
    as the judged one, or if the factor is not finite.
    """
    from scipy.special import logsumexp

    count = len(judged.log_A)
    known = [Octaves(*(values[:count] for values in octaves)) for octaves in healthy if len(octaves.log_A) >= count]
    if len(known) < MIN_HEALTHY:
        return None
    filters = _filter_effects(known, sides=[side for side, channel in enumerate(pair) if channel in CHAMBERS])
    log_likelihoods = _ratio_log_likelihoods(judged, known, filters) + _phase_log_likelihoods(judged, known, filters)
    log_ratios = log_likelihoods[1:] - log_likelihoods[0]  # the first hypothesis is no filter
    log_factor = float(logsumexp(log_ratios) - np.log(len(log_ratios)))
    best = 1 + int(np.argmax(log_ratios))  # index in `filters`
    return (log_factor, pair[filters.side[best]], float(filters.cutoff[best])) if np.isfinite(log_factor) else None


class _Filters(NamedTuple):
    """Effects of m filters on k octaves; the first entry stands for no filter.

    `log_ratio`, `phase` (m, k): changes of log abs(A / B) and of the phase of A B* [rad]; `side` (m,): 0 for a filter
    of channel A, 1 for channel B; `cutoff` (m,): cut-off frequency [Hz].
    """

    log_ratio: Array
    phase: Array
    side: Array
    cutoff: Array


def _filter_effects(healthy: Sequence[Octaves], sides: Sequence[int]) -> _Filters:
    """Compute how a low-pass filter of one channel changes log amplitude ratio and phase of channel A to channel B.

    `sides`: channels that may be filtered, 0 for A and 1 for B. Each is combined with several cut-off frequencies and
    levels of the sensor's white noise, which is not filtered: a fraction (`filtered.noises` in `priors.toml`) of the
    lowest power density of an octave, averaged over the `healthy` recordings.
    """
    priors, edges = CHANGES.filtered, _octave_edges(len(healthy[0].log_A))
    frequencies, widths = np.sqrt(edges[:-1] * edges[1:]), np.diff(edges)
    cases = [(0, 0.0, np.inf)]  # no filter
    cases += itertools.product(sides, priors.noises, np.geomspace(priors.lowest, priors.highest, CUTOFFS))
    side, noise_fraction, cutoff = (np.array(values) for values in zip(*cases, strict=True))
    powers = np.exp([2.0 * np.array(octaves[:2]) for octaves in healthy]).mean(axis=0)  # of A and B, (2, k)
    power = powers[side]  # (m, k)
    noise = noise_fraction[:, None] * (power / widths).min(axis=1, keepdims=True) * widths
    relative_frequency = frequencies / cutoff[:, None]
    filtered_power = (power - noise) / (1.0 + relative_frequency**2) + noise
    sign = np.where(side == 0, 1.0, -1.0)[:, None]  # ratio and phase are those of A to B
    log_ratio = sign * 0.5 * np.log(filtered_power / power)
    return _Filters(log_ratio, -sign * np.arctan(relative_frequency), side, cutoff)


def _ratio_log_likelihoods(judged: Octaves, healthy: Sequence[Octaves], filters: _Filters) -> Array:
    """Compute the log likelihood (m,) of the judged log amplitude ratios for each of m filters, up to a constant.

    The ratios of A to B in the octaves follow a multivariate t distribution about the healthy mean.
    """
    prior = CHANGES.octaves
    ratios = np.array([octaves.log_A - octaves.log_B for octaves in healthy])
    count, octave = len(ratios), np.arange(ratios.shape[1])
    mean = ratios.mean(axis=0)
    squares = ((ratios - mean) ** 2).sum(axis=0)
    variances, freedom = estimate_variance(squares, count, ScatterPrior(prior.scatter, prior.recordings))
    deviations = np.sqrt(variances)
    correlations = np.exp(-np.abs(np.subtract.outer(octave, octave)) / prior.neighbours)
    # scatter of a new recording about the mean, correlated between octaves, and an independent error of each ratio
    scale = np.outer(deviations, deviations) * correlations * (1.0 + 1.0 / count) + prior.error**2 * np.eye(len(mean))
    residuals = judged.log_A - judged.log_B - mean - filters.log_ratio
    whitened = np.linalg.solve(np.linalg.cholesky(scale), residuals.T)
    log_likelihoods: Array = -0.5 * (freedom + len(mean)) * np.log1p((whitened**2).sum(axis=0) / freedom)
    return log_likelihoods


def _phase_log_likelihoods(judged: Octaves, healthy: Sequence[Octaves], filters: _Filters) -> Array:
    """Compute the log likelihood (m,) of the judged phases between channels A and B for each of m filters.

    The phase in each octave follows a von Mises distribution about the mean direction of the healthy recordings, or is
    uniform with a small probability. The likelihood is relative to that of uniform phases.
    """
    from scipy.special import i0e

    prior, count = CHANGES.phases, len(healthy)
    directions = np.exp(1j * np.array([octaves.phase for octaves in healthy]))
    precisions = 1.0 / (prior.scatter**2 + np.array([octaves.phase_variance for octaves in healthy]))
    mean = np.angle((precisions * directions).sum(axis=0))
    squares = (np.angle(directions * np.exp(-1j * mean)) ** 2).sum(axis=0)
    variances, _ = estimate_variance(squares, count, ScatterPrior(prior.scatter, prior.recordings))
    variances = variances * (1.0 + 1.0 / count) + judged.phase_variance
    residuals = judged.phase - mean - filters.phase
    is_filtered = np.any(filters.phase != 0.0, axis=1)[:, None]
    # the phase that a filter causes in an octave is known only to within `prior.error`
    concentrations = 1.0 / (variances + np.where(is_filtered, prior.error**2, 0.0))
    # von Mises densities exp(k cos) / I_0(k) relative to the uniform one; i0e(k) is I_0(k) exp(-k)
    densities = np.exp(concentrations * (np.cos(residuals) - 1.0)) / i0e(concentrations)
    log_likelihoods: Array = np.log((1.0 - prior.uniform) * densities + prior.uniform).sum(axis=1)
    return log_likelihoods


#: Names of the observables: of friction, and of drifts, which are rival descriptions of the same data.
FRICTION, DRIFTS = "friction", ("drift of p_A", "drift of p_B", "drift of both")
#: Name of the observable of the zeros of both sensors.
ZEROS = "drift of p_A - p_B"
#: Quantile, over healthy recordings, of the size of a friction of the wrong sign over its error (`_compare_friction`).
UPPER_QUARTILE = 0.75


@dataclass(frozen=True, eq=False, kw_only=True)
class LevelSummary(Summary):
    """Friction, drifts and spectra of a healthy recording (`HealthyLevels.learn`), with standard errors.

    - `friction_pressure`: friction as a pressure difference [Pa];
    - `drift_A`, `drift_B`: drifts of the pressures in motion [Pa over the recording]; `low_A`, `low_B`: those of the
      lowest readings;
    - `connected_difference`: p_A - p_B of connected chambers [Pa];
    - `octaves` and the like (4, k): the fields of `Octaves` in k octaves, for each pair of channels in `PAIRS`.
    """

    method: ClassVar[str] = SIGNALS

    friction_pressure: Number | None = None
    friction_error: Magnitude | None = None
    drift_A: Number | None = None
    drift_A_error: Magnitude | None = None
    drift_B: Number | None = None
    drift_B_error: Magnitude | None = None
    low_A: Number | None = None
    low_A_error: Magnitude | None = None
    low_B: Number | None = None
    low_B_error: Magnitude | None = None
    connected_difference: Number | None = None
    connected_difference_error: Magnitude | None = None
    octaves: Values | None = None
    octaves_A_x: Values | None = None
    octaves_B_x: Values | None = None
    octaves_A_omega: Values | None = None
    octaves_B_omega: Values | None = None

    @property
    def friction(self) -> Estimate | None:
        """Friction as a pressure difference [Pa]."""
        return _known_estimates(friction=(self.friction_pressure, self.friction_error)).get("friction")

    @property
    def zero(self) -> Estimate | None:
        """Pressure difference p_A - p_B of connected chambers [Pa]."""
        return _known_estimates(zero=(self.connected_difference, self.connected_difference_error)).get("zero")

    @property
    def drifts(self) -> dict[str, Estimate]:
        """Known drifts of p_A and p_B in motion, by "A" and "B"."""
        return _known_estimates(A=(self.drift_A, self.drift_A_error), B=(self.drift_B, self.drift_B_error))

    @property
    def low_drifts(self) -> dict[str, Estimate]:
        """Known drifts of the lowest readings of p_A and p_B, by "A" and "B"."""
        return _known_estimates(A=(self.low_A, self.low_A_error), B=(self.low_B, self.low_B_error))

    @property
    def spectra(self) -> dict[str, Octaves]:
        """Known spectra of pairs of channels, by their names in `PAIRS`."""
        return {name: Octaves(*values) for name in PAIRS if (values := getattr(self, name)) is not None}

    def check(self) -> None:
        """Check the spectra; raise ValueError if they are not valid."""
        for name in PAIRS:
            if (values := getattr(self, name)) is None:
                continue
            if values.ndim != 2 or len(values) != len(Octaves._fields) or values.shape[1] < MIN_OCTAVES:
                shape = f"({len(Octaves._fields)}, k), k >= {MIN_OCTAVES}"
                raise ValueError(f"{name} must be of the shape {shape}, got {values.shape}")
            if not np.abs(values).max() < MAX_LOGARITHM or (values[-1] < 0.0).any():
                rule = f"must hold logarithms, phases and variances below {MAX_LOGARITHM:g} in magnitude"
                raise ValueError(f"{name} {rule}")


def _known_estimates(**pairs: tuple[float | None, float | None]) -> dict[str, Estimate]:
    """Join values and their standard errors by name, as far as both are known."""
    known = {name: (value, error) for name, (value, error) in pairs.items() if value is not None and error is not None}
    return {name: Estimate(value, error) for name, (value, error) in known.items()}


class HealthyLevels:
    """Comparison of a recording's friction, drifts and spectra with those of healthy recordings."""

    name, summary_type = SIGNALS, LevelSummary

    @np.errstate(all="ignore")
    def learn(self, recording: Recording) -> LevelSummary | None:
        """Summarise a recording by friction, drifts and spectra; None if nothing can be estimated."""
        nothing = (None, None)
        motion, drifts, zero = select_motion(recording), dict[str, Estimate](), None
        fit = fit_difference(recording)
        if motion is not None:
            # residuals may be correlated within a stroke
            drifts = {
                side: fit_robustly(motion.design, recording[f"p_{side}"][motion.rows], [TIME], motion.strokes)[0]
                for side in "AB"
            }
        flow_channel = flow_source(recording.channels)
        if flow_channel in PUMP and {"x", *CHAMBERS} <= set(recording.channels):
            zero = estimate_connected_difference(recording, turned_angle(recording, flow_channel))
        if not np.isfinite([*drifts.values()]).all():
            drifts = {}
        if zero is not None and not np.isfinite(zero).all():
            zero = None
        low_drifts = estimate_low_drifts(recording)
        drift_A, drift_B, low_A, low_B = (
            estimates.get(side, nothing) for estimates in (drifts, low_drifts) for side in "AB"
        )
        summary = LevelSummary(
            friction_pressure=None if fit is None else fit.friction,
            friction_error=None if fit is None else fit.friction_error,
            drift_A=drift_A[0],
            drift_A_error=drift_A[1],
            drift_B=drift_B[0],
            drift_B_error=drift_B[1],
            low_A=low_A[0],
            low_A_error=low_A[1],
            low_B=low_B[0],
            low_B_error=low_B[1],
            connected_difference=None if zero is None else zero.value,
            connected_difference_error=None if zero is None else zero.deviation,
        )
        all_octaves = zip(PAIRS, compute_all_octaves(recording, list(PAIRS.values())), strict=True)
        spectra: dict[str, Any] = {name: np.stack(octaves) for name, octaves in all_octaves if octaves is not None}
        summary = replace(summary, **spectra)
        return summary if summary.table() else None

    def compare(self, recording: Recording, baseline: Sequence[Healthy]) -> Iterator[Observable]:
        """Compare friction, spectra and drifts of the pressures with those of the healthy recordings in `baseline`.

        There are two kinds of drift, of the mean pressures during motion and of the lowest readings. A quantity that is
        missing in the recording or in too many healthy ones has no test.
        """
        for judged in healthy_summaries(self, [recording]):
            healthy = healthy_summaries(self, baseline)
            yield from compare_low_drifts(judged.low_drifts, [summary.low_drifts for summary in healthy])
            if (spectra := compare_spectra(judged.spectra, [summary.spectra for summary in healthy])) is not None:
                yield spectra
            if (friction := _compare_friction(judged, healthy)) is not None:
                yield friction
            yield from _compare_drifts(judged, healthy, recording.duration)
            if (zeros := _compare_zeros(judged, healthy)) is not None:
                yield zeros


def _compare_friction(judged: LevelSummary, healthy: Sequence[LevelSummary]) -> Observable | None:
    """Test whether the friction of a recording, as a pressure difference, is higher than in healthy recordings.

    The logarithms of the friction are compared. Return None if the judged friction is not usable, or fewer than
    `MIN_HEALTHY` healthy ones.

    - The sign that stands for friction against the motion depends on which channel measured the motion. It is the sign
      of the sum of friction / error over the healthy recordings.
    - A healthy friction of the other sign is an error. All errors are therefore multiplied by max(1, q), where q is the
      upper quartile of abs(friction) / error over the healthy recordings, counted as 0 where the sign is right.
    - The standard error of a logarithm is error / friction and `healthy.friction_error` (`priors.toml`), added in
      quadrature.
    - A friction is usable if it has the right sign and exceeds its error.
    """
    prior = CHANGES.healthy
    known = [friction for summary in healthy if (friction := summary.friction) is not None]
    if not known or judged.friction is None:
        return None
    ratios = np.array([pressure / max(error, TINY) for pressure, error in known])
    sign = float(np.sign(ratios.sum()))
    inflation = max(1.0, float(np.quantile(np.maximum(-sign * ratios, 0.0), UPPER_QUARTILE)))

    def log_friction(friction: Estimate) -> Estimate | None:
        """Return the logarithm of a recording's friction, or None if it is not usable."""
        pressure, error = sign * friction.value, inflation * friction.deviation
        if not pressure > error:
            return None
        return Estimate(float(np.log(pressure)), float(np.hypot(prior.friction_error, error / pressure)))

    healthy_logs = [logarithm for friction in known if (logarithm := log_friction(friction)) is not None]
    judged_log = log_friction(judged.friction)
    if judged_log is None:
        return None
    scatter = ScatterPrior(deviation=prior.friction_scatter, recordings=prior.recordings)
    return compare_estimates(FRICTION, FRICTION, judged_log, healthy_logs, scatter, above=True)


def _compare_drifts(judged: LevelSummary, healthy: Sequence[LevelSummary], duration: float) -> Iterator[Observable]:
    """Compare the drifts of p_A and p_B during motion [Pa over the recording] with those of healthy recordings.

    `duration` [s]: that of the judged recording. Yields a test for each of three alternative explanations: p_A drifts,
    p_B drifts, or both drift alike. Yields nothing unless the judged recording and enough healthy ones have both
    drifts. If both drift alike, p_A - p_B does not drift, and p-value and score of this explanation are

        chance = min(1, chance_A chance_B / chance_difference),    score = max(0, score_A + score_B - score_difference).

    A score is the square of a z score. With equal errors of both drifts, z_A^2 + z_B^2 = z_mean^2 + z_difference^2, so
    that what remains is the score of their mean; a p-value is about exp(-z^2 / 2).
    """
    judged_drifts = judged.drifts
    if len(judged_drifts) < 2:
        return
    healthy_drifts = [drifts for summary in healthy if len(drifts := summary.drifts) > 1]
    prior = CHANGES.healthy
    scatter = ScatterPrior(prior.drift, recordings=prior.drift_recordings, inflation=prior.drift_inflation)
    drift_A, drift_B = (
        compare_estimates(name, DRIFT, judged_drifts[side], [drifts[side] for drifts in healthy_drifts], scatter)
        for side, name in zip("AB", DRIFTS[:2], strict=True)
    )
    differences = [subtract_drifts(drifts) for drifts in healthy_drifts]
    # named "drift of both", since it becomes that test at the end; its size, which is not used, stays that of p_A - p_B
    difference = compare_estimates(DRIFTS[2], DRIFT, subtract_drifts(judged_drifts), differences, scatter)
    if drift_A is None or drift_B is None or difference is None:
        return
    for drift in (drift_A, drift_B):  # a drift that is fast for the zero of a sensor is rather one of the load
        yield replace(drift, advantage=-step_penalty(drift.size / duration, CHANGES.zero_drift, above=True))
    chance = drift_A.chance * drift_B.chance / max(difference.chance, TINY)
    score = max(drift_A.score + drift_B.score - difference.score, 0.0)
    yield replace(difference, chance=min(chance, 1.0), score=score)


def _compare_zeros(judged: LevelSummary, healthy: Sequence[LevelSummary]) -> Observable | None:
    """Compare p_A - p_B of connected chambers with that of healthy recordings; None if it is missing in too many."""
    if judged.zero is None:
        return None
    healthy_zeros = [zero for summary in healthy if (zero := summary.zero) is not None]
    prior = CHANGES.healthy
    scatter = ScatterPrior(prior.drift, recordings=prior.drift_recordings, inflation=prior.drift_inflation)
    return compare_estimates(ZEROS, DRIFT, judged.zero, healthy_zeros, scatter)


#: Minimum number of strokes in either direction, for a standard error.
MIN_STROKES = 2


def estimate_connected_difference(recording: Recording, turned: Array) -> Estimate | None:
    """Estimate the mean of p_A - p_B [Pa] of connected chambers.

    `turned` (n - 1,): angle by which the pump turns in each sampling interval [rad]. Strokes are motions of the piston
    past the resting pump (`flag_lowering`) in one direction. The means over the strokes of either direction are
    averaged. Return None for fewer than `MIN_STROKES` strokes in a direction, as of a load that is lowered.
    """
    signals = Signals(recording.channels, recording.rate)
    slowest = rest_limit(signals.step("x"), recording.rate, fraction=CHANGES.healthy.slowest)
    speed = signals.speed[1:]
    is_lowered = flag_lowering(turned, signals["x"], signals.compute_pressure_difference(), recording.rate)
    rows = np.flatnonzero(is_lowered & (np.abs(speed) > slowest))
    if not rows.size:
        return None
    strokes = number_strokes(speed[rows], rows, longest_gap=MIN_REST * recording.rate)
    first, lengths = np.unique(strokes, return_index=True, return_counts=True)[1:]
    is_outward = speed[rows[first]] > 0.0
    if min(is_outward.sum(), (~is_outward).sum()) < MIN_STROKES:
        return None
    difference = (recording["p_A"] - recording["p_B"])[1:][rows]
    means = np.add.reduceat(difference, first) / lengths
    ways = [means[is_outward], means[~is_outward]]
    errors = [values.std(ddof=1) / np.sqrt(len(values)) for values in ways]
    return Estimate(0.5 * float(ways[0].mean() + ways[1].mean()), 0.5 * float(np.hypot(*errors)))
