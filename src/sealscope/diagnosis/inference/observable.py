"""Report of a provider on a recording: observables, each with a test, and measurements of the leak.

A provider (`detector.Detector`) estimates numbers over a recording, without a verdict or a threshold. The meaning of
the numbers is in `decision/events.toml`, and `decision.decide` weighs them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from sealscope.diagnosis.inference.onset import Interval, StepTest
from sealscope.diagnosis.inference.scatter import Rise
from sealscope.diagnosis.verdict.evidence import Cause, LeakCourse, RelativeLeak, TotalLeakage


@dataclass(frozen=True, kw_only=True)
class Observable:
    """Test of a change of one number that a provider estimates.

    Parameters
    ----------
    name : str
        What changed: a term of the balance, "noise of the pressures", "RMS of d3 of p_A".
    data : str
        What it is computed from: "volumes", "response", "noise", "hum", "duty", "sense", "levels", "details", or the
        name of a plug-in. Observables of the same data are rival descriptions of it.
    score : float
        Twice the logarithm of the likelihood ratio of the change.
    chance : float
        Probability that a healthy recording scores as high, by the provider's own law.
    onset : Interval, optional
        Time of the change [s]; None for a comparison with other recordings.
    size : float
        The change, in the observable's own unit; negative for a fall.
    advantage : float
        Twice the log odds of this description over its rivals from other sources, such as priors on its size.
    log_ratio_to_leak : float, optional
        Log likelihood ratio of a rise described by this number to one of the leak.
    """

    name: str
    data: str
    score: float
    chance: float
    onset: Interval | None = None
    size: float = 0.0
    advantage: float = 0.0
    log_ratio_to_leak: float | None = None

    @property
    def surprisal(self) -> float:
        """Minus the natural logarithm of the chance.

        In a healthy machine it is exponentially distributed if the provider's law is right.
        """
        return float(-np.log(max(self.chance, np.finfo(float).tiny)))

    @classmethod
    def from_test(
        cls, name: str, data: str, test: StepTest, *, n_tests: float = 1.0, sign: float = 1.0, advantage: float = 0.0
    ) -> Observable:
        """Make the observable of a step within the recording, whose `test` is the best of `n_tests` (Bonferroni).

        `sign`: -1 for a step down, whose size the test states as positive.
        """
        return cls(
            name=name,
            data=data,
            score=test.score,
            chance=min(1.0, n_tests * test.chance),
            onset=test.onset(),
            size=sign * test.fitted.size,
            advantage=advantage,
        )


class Flow(NamedTuple):
    """A leakage flow [m^3/s] and its standard error, without the uncertainty of the machine's size."""

    value: float
    deviation: float


class Remark(NamedTuple):
    """Remark on a recording: the key of a text in `decision/texts.toml`, and the values to fill in."""

    key: str
    values: Mapping[str, float]


class LeakRise(NamedTuple):
    """Rise of the leakage over healthy recordings.

    `step_log_ratio`: log likelihood ratio of two sizes of the rise, the one that the step within the recording would
    cause and zero.
    """

    rise: Rise
    step_log_ratio: float = 0.0


class RiseTest(Protocol):
    """Test of a rise of the leakage, with its distribution in a healthy machine."""

    @property
    def score(self) -> float:
        """Statistic of the test."""

    @property
    def chance(self) -> float:
        """Probability that a healthy machine scores as high."""

    def threshold(self, chance: float) -> float:
        """Return the score that a healthy machine exceeds with a probability."""


class DatedTest(RiseTest, Protocol):
    """Test of a step of the leakage at an unknown instant."""

    def onset(self) -> Interval:
        """Return the most likely onset [s] with its 95 % interval."""

    def detectable_step(self, chance: float) -> float:
        """Return the conductance of a step that is detected at a false-alarm probability `chance`."""


class LeakMeasure(Protocol):
    """The leakage of a recording as one provider measures it: tests, flows and sizes, no verdict."""

    @property
    def provider(self) -> str:
        """Name of the detector."""

    @property
    def cause(self) -> Cause:
        """Cause of a leak, as far as the channels separate causes."""

    @property
    def step(self) -> DatedTest | None:
        """Test of a step of the leakage within the recording."""

    @property
    def step_flow(self) -> Flow:
        """Mean flow of the step while it lasts."""

    @property
    def flow_factors(self) -> tuple[float, float]:
        """Smallest and largest factor on the stated flow, for other paths and laws of the leak."""

    @property
    def flow_per_conductance(self) -> float:
        """Mean flow [m^3/s] of a leak with a conductance of 1 m^3/(s Pa)."""

    @property
    def rise(self) -> RiseTest | None:
        """Rise of the mean leakage beyond the healthy recordings; None without any."""

    @property
    def rise_flow(self) -> Flow | None:
        """Mean flow of the rise [m^3/s], or the total leakage without healthy recordings; None if unknown."""

    @property
    def rise_onset(self) -> Interval | None:
        """Onset of the rise if it began within the recording; None if nothing dates it."""

    @property
    def excess(self) -> float | None:
        """Total leakage above the limit in the rig's file, in standard deviations; None if no limit applies."""

    @property
    def bound_flow(self) -> float:
        """95 % upper bound of the leak's mean flow [m^3/s]."""

    @property
    def pump_flow(self) -> tuple[float, float]:
        """Mean flow of the pump [m^3/s], over the recording and while it delivers."""

    @property
    def step_rise(self) -> LeakRise | None:
        """Rise over healthy recordings, with the step's contribution; None without healthy recordings."""

    @property
    def lpm_per_flow(self) -> float | None:
        """L/min of a flow of 1 m^3/s, None where the machine's size is not stated."""

    @property
    def size_deviation(self) -> float:
        """Relative standard deviation of the machine's size."""

    @property
    def ratio(self) -> Interval | None:
        """Measured ratio of displacement to area, relative to the assumed one; None if it is not measured."""

    @property
    def remarks(self) -> Sequence[Remark]:
        """Notes on sizes, sensor offsets and delays."""

    def relative(self, flow: Flow) -> RelativeLeak | None:
        """Return a flow relative to the pump's flow and the piston's area."""

    def total(self, detectable_flow: float | None) -> TotalLeakage | None:
        """Return the total leakage; `detectable_flow`: the smallest step that would have been found [m^3/s]."""

    def history(self, onset_s: float | None) -> LeakCourse | None:
        """Return the history of the leakage: its growth since an onset, else the total leakage."""


class Ringing(NamedTuple):
    """Precision of the measured ringing of the pressures, if the leak itself is not measured.

    `bound`: 95 % bound of the size of a change of its log RMS; `rate` [Hz]; `healthy`: number of recordings it was
    compared with; `is_dated`: whether their dates are known; `unused`: recorded columns without a channel.
    """

    bound: float
    rate: float
    healthy: int
    is_dated: bool
    unused: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Observed:
    """Report of a provider on a recording.

    Parameters
    ----------
    provider : str
        Name of the detector.
    observables : tuple of Observable
    leak : LeakMeasure, optional
    ringing : Ringing, optional
    lack : str
        Reason for an empty report, else empty.
    share : float
        Fraction of the recording's samples that were used.
    judged_until : float
        Time of the last judged sample, as a fraction of the recording.
    has_failed : bool
        Whether it raised an error.
    """

    provider: str
    observables: tuple[Observable, ...] = ()
    leak: LeakMeasure | None = None
    ringing: Ringing | None = None
    lack: str = ""
    share: float = 1.0
    judged_until: float = 1.0
    has_failed: bool = False
