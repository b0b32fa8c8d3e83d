"""What a provider reports of a recording: observables, each with a test, and what it measures of the leak.

A provider (`detector.Detector`) follows numbers over a recording. It states neither a verdict nor a threshold; what
the numbers mean stands in `decision/events.toml`, and `decision.decide` weighs them.
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
    """The test of a change of one number that a provider follows.

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
        When it changed [s], None against other recordings.
    size : float
        The change, in the observable's own unit; negative for a fall.
    advantage : float
        Twice the logarithm of what else speaks for this description, over that of its rivals.
    """

    name: str
    data: str
    score: float
    chance: float
    onset: Interval | None = None
    size: float = 0.0
    advantage: float = 0.0

    @property
    def rarity(self) -> float:
        """Minus the logarithm of the chance."""
        return float(-np.log(max(self.chance, np.finfo(float).tiny)))

    @classmethod
    def of_test(
        cls, name: str, data: str, test: StepTest, *, looks: float = 1.0, sign: float = 1.0, advantage: float = 0.0
    ) -> Observable:
        """Return the observable of a step within the recording; `looks`: tests of which it is the likeliest one."""
        chance = min(1.0, looks * test.chance)
        return cls(
            name=name,
            data=data,
            score=test.score,
            chance=chance,
            onset=test.onset(),
            size=sign * test.fitted[0],
            advantage=advantage,
        )


class Flow(NamedTuple):
    """A leakage flow [m^3/s] and its standard deviation, that of the machine's size left out."""

    value: float
    deviation: float


class Remark(NamedTuple):
    """A key of `decision/texts.toml` with its values."""

    key: str
    values: Mapping[str, float]


class LeakMeasure(Protocol):
    """The leakage of a recording as one provider measures it: tests, flows and sizes, no verdict."""

    @property
    def provider(self) -> str:
        """Name of the detector."""

    @property
    def cause(self) -> Cause:
        """Cause of a leak, as far as the channels tell."""

    @property
    def step(self) -> StepTest | None:
        """Test of a step of the leakage within the recording."""

    @property
    def step_flow(self) -> Flow:
        """Mean flow of the step while it lasts."""

    @property
    def step_driving(self) -> float:
        """Mean flow [m^3/s] of a step of one."""

    @property
    def rise(self) -> Rise | None:
        """Rise of the mean leakage beyond the healthy recordings, None without any."""

    @property
    def rise_flow(self) -> Flow | None:
        """The rise, or without one the leakage in all, as a mean flow; None where it cannot be stated."""

    @property
    def excess(self) -> float | None:
        """Leakage in all beyond a healthy machine's by the rig's file, in deviations; None where not stated."""

    @property
    def bound_flow(self) -> float:
        """95 % upper bound of the leak's mean flow [m^3/s]."""

    @property
    def pump_flow(self) -> tuple[float, float]:
        """Mean flow of the pump [m^3/s], and that while it flows."""

    @property
    def share_after(self) -> float:
        """Share of what the recording tells of its mean leakage that lies after the step's onset."""

    @property
    def litres(self) -> float | None:
        """L/min of a flow of 1 m^3/s, None where the machine's size is not stated."""

    @property
    def size_deviation(self) -> float:
        """Relative standard deviation of the machine's size."""

    @property
    def ratio(self) -> Interval | None:
        """Displacement over area as measured, over the assumed one."""

    @property
    def remarks(self) -> Sequence[Remark]:
        """Remarks of the provider on sizes, zeros and delays."""

    def relative(self, flow: Flow) -> RelativeLeak | None:
        """Return a flow beside the pump's flow and the piston's area."""

    def total(self, findable: float | None) -> TotalLeakage | None:
        """Return the total leakage; `findable`: the smallest step that would have been found [m^3/s]."""

    def course(self, onset_s: float | None) -> LeakCourse | None:
        """Return the leakage over the recording; since an onset what came with it."""


class Ringing(NamedTuple):
    """Precision of the measured ringing of the pressures, where nothing measures the leak itself.

    `bound`: 95 % bound of the size of a change of its log RMS; `rate` [Hz]; `healthy`: recordings it was compared with,
    0 for none; `is_dated`: whether their dates are known; `unused`: recorded columns that no channel is made of.
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
        Its name.
    observables : tuple of Observable
    leak : LeakMeasure, optional
        What it measures of the leak.
    ringing : Ringing, optional
        How far it knows the ringing of the pressures.
    lack : str
        Why it reports nothing, empty where it reports something.
    share : float
        Share of the recording, 0 to 1, that the report rests on.
    has_failed : bool
        Whether it raised an error where it should have reported.
    """

    provider: str
    observables: tuple[Observable, ...] = ()
    leak: LeakMeasure | None = None
    ringing: Ringing | None = None
    lack: str = ""
    share: float = 1.0
    has_failed: bool = False
