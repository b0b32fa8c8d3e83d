"""Report of a detector on a recording: observables and measurements of the leak.

An observable is the result of testing one quantity for a change. A detector (`registry.Detector`) estimates quantities
from a recording, without a verdict or a threshold. `decision/events.toml` states what a change of each quantity means,
and `decision.decide` weighs the reports.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from sealscope.diagnosis.estimate.change import StepTest
from sealscope.diagnosis.estimate.interval import Estimate, Interval
from sealscope.diagnosis.estimate.population import MIN_HEALTHY, ScatterPrior, estimate_variance, predict_estimate
from sealscope.diagnosis.inference.comparison import Rise
from sealscope.diagnosis.verdict.evidence import Cause, LeakCourse, RelativeLeak, TotalLeakage
from sealscope.signals.smoothing import TINY

#: Key of the comparisons of a kind of data with healthy recordings (`Observable.key`).
COMPARISON_KEY = "{}: against"


@dataclass(frozen=True, kw_only=True)
class Observable:
    """Result of testing one quantity, estimated by a detector, for a change.

    Parameters
    ----------
    name : str
        Name of the quantity: a term of the volume balance, "noise of the pressures", "RMS of d3 of p_A".
    data : str
        Kind of data from which the quantity is computed, such as "volumes", "rise", "drift" or "details", as the
        patterns in `decision/events.toml` list it, or "plug-in". Observables of the same data are alternative
        descriptions of one change in these data.
    score : float
        Twice the logarithm of the likelihood ratio of the change.
    chance : float
        Probability that a healthy recording scores as high, as stated by the detector.
    onset : Interval, optional
        Time of the change [s]; None for a comparison with other recordings.
    size : float
        Amount of the change, in the unit of the quantity; negative for a fall.
    advantage : float
        Twice the log odds of this description over the alternative ones, from sources other than the score, such as a
        prior on its size.
    log_ratio_to_leak : float, optional
        Log likelihood ratio of this change to a leak, as explanations of a difference from healthy recordings.
    pressure_scale : Estimate, optional
        Logarithm of a factor on both recorded pressures that would cause this change without a change of the machine;
        None if it is unknown, or if no factor would.
    """

    name: str
    data: str
    score: float
    chance: float
    onset: Interval | None = None
    size: float = 0.0
    advantage: float = 0.0
    log_ratio_to_leak: float | None = None
    pressure_scale: Estimate | None = None

    @property
    def key(self) -> str:
        """Key of the test among those of healthy recordings, such as "noise: noise of the pressures".

        Observables without an onset are comparisons with healthy recordings, and share one key for their kind of data.
        """
        return COMPARISON_KEY.format(self.data) if self.onset is None else f"{self.data}: {self.name}"

    @property
    def surprisal(self) -> float:
        """Minus the natural logarithm of `chance`; in a healthy machine it is exponentially distributed."""
        return float(-np.log(max(self.chance, np.finfo(float).tiny)))

    @classmethod
    def from_test(
        cls,
        name: str,
        data: str,
        test: StepTest,
        *,
        n_tests: float = 1.0,
        advantage: float = 0.0,
        pressure_scale: Estimate | None = None,
    ) -> Observable:
        """Make an observable from a step test within the recording, the best of `n_tests` tests.

        Its p-value is multiplied by `n_tests` (Bonferroni correction). The other arguments are fields of the class.
        """
        return cls(
            name=name,
            data=data,
            score=test.score,
            chance=min(1.0, n_tests * test.chance),
            onset=test.onset(),
            size=test.sign * test.fitted.value,
            advantage=advantage,
            pressure_scale=pressure_scale,
        )


#: Flow of a leak that was not tested.
UNKNOWN_FLOW = Estimate(0.0, math.inf)


class Remark(NamedTuple):
    """Remark on a recording: `key` of a text in `decision/texts.toml`, and the `values` to fill in by name."""

    key: str
    values: Mapping[str, float | str]


class LeakRise(NamedTuple):
    """Leakage of a recording above that of healthy recordings (`rise`), and whether a step within it explains the rise.

    `step_log_ratio`: log of p(rise | a leak began within the recording, with the size of the tested step) / p(rise | no
    leak).
    """

    rise: Rise
    step_log_ratio: float = 0.0


class RiseTest(Protocol):
    """Test for increased leakage, with the distribution of its score in a healthy machine."""

    @property
    def score(self) -> float:
        """Statistic of the test, such as a z score; it grows with the leakage."""

    @property
    def chance(self) -> float:
        """Probability that a healthy machine has at least this score."""

    def threshold(self, chance: float) -> float:
        """Return the score of the test that a healthy machine exceeds with the probability `chance`."""


class DatedTest(RiseTest, Protocol):
    """Test for a step of the leakage, i.e. a leak that begins at an unknown time of the recording."""

    def onset(self) -> Interval:
        """Return the most likely onset of the leak [s] with its 95 % interval."""

    def detectable_step(self, chance: float) -> float:
        """Return the smallest increase of the leak's conductance [m^3/(s Pa)] that is detected with 90 % probability.

        `chance`: false-alarm probability of the test. The result is infinite if it is unknown.
        """


@dataclass(frozen=True, eq=False, kw_only=True)
class LeakMeasure:
    """Leakage that one detector measures in a recording: tests and flows, without a verdict.

    The standard errors of flows exclude the errors of the piston's area and the pump's displacement, which scale all
    flows (`size_deviation`). A subclass may replace fields by properties, which are computed when they are first read
    (`BalanceLeak`), and overrides the methods, which here return `total_leakage` or None.

    Parameters
    ----------
    provider : str
        Name of the detector that measured the leakage.
    cause : str
        Cause of a leak, e.g. "piston or pump leak", as precise as the recorded channels allow.
    step : DatedTest, optional
        Test for a leak that begins within the recording; None if the recording is too short.
    step_flow : Estimate
        Mean flow [m^3/s] of a leak that begins within the recording, averaged from its onset to the end.
    flow_factors : tuple of two floats
        Smallest and largest ratio of the leak's true flow to the stated one, if its path or law is unknown.
    flow_per_conductance : float
        Mean flow [m^3/s] that a leak with a conductance of 1 m^3/(s Pa) has at the recording's pressures.
    rise : RiseTest, optional
        Test of the mean leakage against the leakage of healthy recordings; None without such recordings.
    rise_flow : Estimate, optional
        Mean leakage [m^3/s] above that of healthy recordings, or in total if there are none; None if unknown.
    rise_onset : Interval, optional
        Onset [s] of the leakage above that of healthy recordings; None if nothing shows its beginning.
    step_rise : LeakRise, optional
        The rise, and the evidence that a step within the recording explains it; None without healthy recordings.
    excess : float, optional
        Total leakage minus the limit in the rig's file (`pump.G_healthy`) [standard deviations]; None if unknown.
    bound_flow : float
        95 % upper bound of the mean flow of an undetected leak [m^3/s]; infinite if nothing was tested.
    pump_flow : tuple of two floats
        Mean flow of the pump [m^3/s] over the whole recording, and while the pump delivers.
    lpm_per_flow : float, optional
        Factor from this detector's flows [m^3/s], computed with an assumed machine, to the true flows [L/min]. None if
        they depend on dimensions that the rig's file does not state, such as the piston's area.
    size_deviation : float
        Relative standard deviation of the dimension that scales all flows: pump's displacement or piston's area.
    ratio : Interval, optional
        Measured over assumed ratio of the pump's displacement to the piston's area; None if it is not measured.
    remarks : sequence of Remark
        Remarks for the reader of the verdict: contradicting dimensions, offsets of sensors, delays of channels.
    total_leakage : TotalLeakage, optional
        Total leakage, if the detector does not state the smallest detectable leak with it (`total`).
    """

    provider: str
    cause: Cause
    step: DatedTest | None = None
    step_flow: Estimate = UNKNOWN_FLOW
    flow_factors: tuple[float, float] = (1.0, 1.0)
    flow_per_conductance: float = 0.0
    rise: RiseTest | None = None
    rise_flow: Estimate | None = None
    rise_onset: Interval | None = None
    step_rise: LeakRise | None = None
    excess: float | None = None
    bound_flow: float = math.inf
    pump_flow: tuple[float, float] = (0.0, 0.0)
    lpm_per_flow: float | None = None
    size_deviation: float = 0.0
    ratio: Interval | None = None
    remarks: Sequence[Remark] = ()
    total_leakage: TotalLeakage | None = None

    def relative(self, flow: Estimate) -> RelativeLeak | None:
        """Convert a leak's flow to a fraction of the pump's flow and a creep speed [m/s]; None if both are unknown."""
        return None

    def total(self, detectable_flow: float | None) -> TotalLeakage | None:
        """Return the total leakage and the smallest detectable leak; None if both are unknown.

        `detectable_flow`: flow [m^3/s] of the smallest leak that would be detected, None if it is unknown; a stated
        `total_leakage` does not depend on it.
        """
        return self.total_leakage

    def history(self, onset_s: float | None) -> LeakCourse | None:
        """Return the leakage over time, or its growth since `onset_s` [s] if that is given; None if it is unknown."""
        return None


class Ringing(NamedTuple):
    """Facts on the comparison of the pressures' ringing, for a recording whose leakage cannot be measured.

    - `bound`: 95 % upper bound of an undetected change of the ringing, the logarithm of the RMS of wavelet details
      without noise; `rate`: sampling rate [Hz];
    - `healthy`: number of healthy recordings in the comparison; `is_dated`: true if their dates are known;
    - `unused`: recorded columns that are not assigned to a channel.
    """

    bound: float
    rate: float
    healthy: int
    is_dated: bool
    unused: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Observed:
    """Report of one detector on a recording.

    Parameters
    ----------
    provider : str
        Name of the detector.
    observables : tuple of Observable
        Tests of the quantities that the detector estimates.
    leak : LeakMeasure, optional
        The leakage, if the detector measures it.
    ringing : Ringing, optional
        Facts on the comparison of the pressures' ringing, if the detector makes one.
    lack : str
        Reason for an empty report, else "".
    share : float
        Fraction of the recording's samples that were used.
    judged_until : float
        Time of the last judged sample, as a fraction of the recording.
    has_failed : bool
        True if the detector raised an error.
    refusal : str
        Reason why none of the given healthy recordings could be compared, else "".
    """

    provider: str
    observables: tuple[Observable, ...] = ()
    leak: LeakMeasure | None = None
    ringing: Ringing | None = None
    lack: str = ""
    share: float = 1.0
    judged_until: float = 1.0
    has_failed: bool = False
    refusal: str = ""


def compare_with_healthy(
    name: str,
    data: str,
    value: float,
    healthy: Sequence[float],
    error: float = 0.0,
    *,
    above: bool = False,
    prior_change: float = np.inf,
) -> Observable | None:
    """Test a value by Student's t for a difference from the values of healthy recordings.

    The n healthy values are normal about an unknown mean with an unknown standard deviation (Jeffreys prior). With
    their mean and variance s^2 (`population.estimate_variance`), the value y then follows Student's t with n - 1
    degrees of freedom, to which the standard error e of a single value is added, since values may agree by chance:

        t = (y - mean) / sqrt((s^2 + e^2) (1 + 1/n)).

    - `name`, `data`: name of the quantity and its kind of data, for the result (`Observable`);
    - `error`: standard error e of a single value;
    - `above`: count only a value above the healthy ones;
    - `prior_change`: standard deviation of a true change, infinite if unknown. With the Bayes factor B of such a change
      to no change, the p-value is at least 1/B, and 1 if B < 1: a true change then explains the value no better than
      scatter does.

    The observable's size is the difference from the healthy mean, its score the square of t (with `above`, 0 for a
    value below the mean), and its chance the p-value. Return None for fewer than `MIN_HEALTHY` healthy recordings, or
    if a number is not finite.
    """
    from scipy.special import stdtr

    values, count = np.asarray(healthy, dtype=float), len(healthy)
    if count < MIN_HEALTHY or not np.isfinite([value, error, *values]).all():
        return None
    change = value - float(values.mean())
    variance, freedom = estimate_variance(count * float(values.var()), count)
    variance = (variance + error**2) * (1.0 + 1.0 / count)
    t = change / max(math.sqrt(variance), TINY)
    chance = float(stdtr(freedom, -t if above else -abs(t))) * (1.0 if above else 2.0)
    score = t * t if t > 0.0 or not above else 0.0
    if not math.isfinite(score):
        return None
    if math.isfinite(prior_change):
        # Bayes factor of a true change: ratio of two densities of Student's t at the value, with the variance of such a
        # change added, and without it
        variance_ratio = 1.0 + prior_change**2 / max(variance, TINY)
        log_factor = 0.5 * (freedom + 1.0) * np.log1p(t * t / freedom)
        log_factor -= 0.5 * (freedom + 1.0) * np.log1p(t * t / variance_ratio / freedom) + 0.5 * np.log(variance_ratio)
        chance = max(chance, float(np.exp(-max(log_factor, 0.0))))
    return Observable(name=name, data=data, score=score, chance=min(1.0, chance), size=change)


def compare_estimates(
    name: str,
    data: str,
    judged: Estimate,
    healthy: Sequence[Estimate],
    prior: ScatterPrior,
    *,
    above: bool = False,
    further_deviation: float = 0.0,
) -> Observable | None:
    """Test an estimate for a difference from the estimates of healthy recordings, each with a known standard error.

    The prediction is that of `population.predict_estimate`.

    - `name`, `data`: name of the quantity and its kind of data, for the result;
    - `prior`: prior on the scatter between recordings;
    - `above`: count only an estimate above the healthy ones;
    - `further_deviation`: standard deviation of the judged estimate from further causes, such as an unusual load.

    The observable's size is the difference from the predicted mean, its score the square of this difference over its
    variance (with `above`, 0 for a negative one), and its chance the p-value. Return None for fewer than `MIN_HEALTHY`
    healthy recordings, or if a number is not finite.
    """
    if len(healthy) < MIN_HEALTHY or not np.isfinite([judged, *healthy]).all():
        return None
    values, errors = np.array(healthy, dtype=float).T
    predicted = predict_estimate(values, errors, judged.deviation, prior, further_deviation)
    chance = predicted.chance_above(judged.value) if above else predicted.chance_beyond(judged.value)
    change = judged.value - float(predicted.weights @ predicted.centres)
    variance = float(predicted.weights @ predicted.deviations**2)
    score = change**2 / max(variance, TINY) if change > 0.0 or not above else 0.0
    return Observable(name=name, data=data, score=score, chance=min(1.0, chance), size=change)
