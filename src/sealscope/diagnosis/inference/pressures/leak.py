"""Leakage measured by the response of the pressures: only changes of the conductance, as its level is uncertain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.estimate.change import Information, StepTest, fit_history, step_test
from sealscope.diagnosis.estimate.interval import WITHIN_95, Estimate
from sealscope.diagnosis.inference.comparison import Rise, rise
from sealscope.diagnosis.inference.equations.terms import LEAK
from sealscope.diagnosis.inference.observable import UNKNOWN_FLOW, LeakMeasure, LeakRise
from sealscope.diagnosis.inference.pressures.fit import Priors
from sealscope.diagnosis.inference.pressures.reduced_rig import PARAMETERS, G
from sealscope.diagnosis.inference.pressures.samples import ResponseSummary
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE, Cause, LeakCourse, TotalLeakage
from sealscope.recordings.recording import Array
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Mean flow of a leak over that of a laminar one of the same fitted conductance: mean, deviation and upper limit.
_LAW_RATIO, _LAW_DEVIATION = PRESSURE.conductance.law
HIGH_LAW_RATIO = _LAW_RATIO + WITHIN_95 * _LAW_DEVIATION


def conductance_scale_error() -> float:
    """Compute the relative standard deviation of the scale error that all fitted conductances share.

    The response determines G M/A^2, so errors of the stated mass M and piston area A scale the conductance G.
    """
    return math.hypot(PRESSURE.scale.mass, 2.0 * PRESSURE.scale.area)


def states_flow(rig: Rig) -> bool:
    """Return True if the rig's file states piston areas and moving mass, which convert a conductance to L/min."""
    return rig.states("cylinder.A_A", "cylinder.A_B", "cylinder.M_eq")


class ResponseColumns:
    """Columns of the Gram matrices of p parameters and the left side (`fit.Joint.sums`), as `coefficients` reads them.

    `between` (p,): standard deviations of the parameters' differences between recordings of one machine.
    """

    def __init__(self, between: Array) -> None:
        self.names = tuple(LEAK if k == G else name for k, name in enumerate(PARAMETERS))
        self.compared = tuple(range(len(PARAMETERS)))
        self.leak, self.left, self.healthy_conductance = G, len(PARAMETERS), math.inf
        self.between_deviation = between

    def difference_precisions(self, indices: Sequence[int], coefficients: Array, leak_coefficient: float) -> Array:
        """Return the prior precisions (c,) of the differences of c parameters between recordings."""
        return np.asarray(self.between_deviation[indices] ** -2)


class ResponseLeak(LeakMeasure):
    """The leakage of a recording as measured by the response of its pressures.

    - `parameters`: likelihood in K blocks of each parameter of the response, by the parameter's name; "G" is the
      conductance past the piston [m^3/(s Pa)].
    - `pressure` (K,): mean of abs(p_A - p_B) in each block [Pa].
    - `conditions`: summary of the recording, with its law of friction and the likelihood of its parameters.
    - `priors`: priors of the rig's parameters.
    - `stated`: true if the rig's file states the sizes that convert a conductance to L/min.
    - `healthy`: healthy recordings of the machine with this law of friction.

    Without healthy recordings there is no `rise_flow`, since the level of the conductance depends on the assumed
    friction. There is no leak's share of the pump's flow (`relative`), which is only assumed from the command.
    """

    provider = PRESSURE_RESPONSE
    #: Without a position, external leakage has the same effect.
    cause: Cause = "piston, pump or external leak"
    size_deviation = conductance_scale_error()

    def __init__(
        self,
        parameters: Mapping[str, Information],
        pressure: Array,
        conditions: ResponseSummary,
        *,
        priors: Priors,
        stated: bool,
        healthy: Sequence[ResponseSummary] = (),
    ) -> None:
        self.parameters, self.pressure, self.conditions = parameters, pressure, conditions
        self.priors, self.stated, self.healthy = priors, stated, healthy

    @property
    def information(self) -> Information:
        """Likelihood of the conductance past the piston [m^3/(s Pa)] in each of the K blocks."""
        return self.parameters["G"]

    @property
    def level(self) -> Estimate:
        """Conductance over the recording [m^3/(s Pa)], as if it were constant."""
        precision = max(float(self.information.precision.sum()), np.finfo(float).tiny)
        return Estimate(float(self.information.vector.sum()) / precision, precision**-0.5)

    @cached_property
    def step(self) -> StepTest | None:
        """Test for a step of the conductance within the recording; None if too few blocks have information."""
        return step_test(self.information)

    @property
    def step_flow(self) -> Estimate:
        """Mean flow [m^3/s] of a leak that begins within the recording, at the recording's mean abs(p_A - p_B)."""
        return UNKNOWN_FLOW if self.step is None else self._flow_of(self.step.fitted)

    @property
    def rise_flow(self) -> Estimate | None:
        """Mean flow [m^3/s] of the leakage above that of the healthy recordings; None without these."""
        return None if self.rise is None else self._flow_of(Estimate(self.rise.value, self.rise.deviation))

    def _flow_of(self, conductance: Estimate) -> Estimate:
        """Compute the mean flow [m^3/s] of a leak at the recording's mean abs(p_A - p_B).

        The law of the leak is not known (`conductance.law` of `priors.toml`).
        """
        size, deviation = conductance
        unit = self.flow_per_conductance
        error = float(np.hypot(_LAW_RATIO * deviation, _LAW_DEVIATION * size))
        return Estimate(_LAW_RATIO * size * unit, error * unit)

    @property
    def flow_per_conductance(self) -> float:
        """Mean flow [m^3/s] of a leak with a conductance of 1 m^3/(s Pa): the mean of abs(p_A - p_B)."""
        return float(self.pressure.mean())

    @cached_property
    def rise(self) -> Rise | None:
        """Excess of a constant conductance [m^3/(s Pa)] over that of the healthy recordings; None without these."""
        if not self.healthy:
            return None
        # parameters that no recording tells are those of the rig
        prior = self.priors.sums / len(self.healthy)
        healthy = [
            replace(response, sums=(self.priors.machine_likelihood(response.sums[0], G) + prior)[None])
            for response in self.healthy
        ]
        return rise(
            self.conditions,
            healthy,
            [ResponseColumns(self.priors.between)],
            # levels are compared by their differences, as they are uncertain by the assumed friction
            min_crossover=INFERENCE.scatter.largest * self.conditions.conductance_of_flow,
            session_deviation=PRESSURE.conductance.level,
        )

    @property
    def bound_flow(self) -> float:
        """95 % upper bound of the mean flow [m^3/s] of a leak; infinite if nothing was tested.

        It bounds a leak that begins within the recording and, with healthy recordings, the leakage above theirs, for
        the upper limits of the ratio of the leak's law and of the scale.
        """
        bounds = [test.bound() for test in (self.step, self.rise) if test is not None]
        max_scale = 1.0 + WITHIN_95 * conductance_scale_error()
        return max(bounds, default=np.inf) * HIGH_LAW_RATIO * self.flow_per_conductance * max_scale

    @property
    def step_rise(self) -> LeakRise | None:
        """Leakage above that of healthy recordings, and whether a step within the recording explains it.

        The rise of the mean conductance is compared with the one that the step causes. None without healthy recordings.
        """
        if self.rise is None:
            return None
        step = self.step
        rise_by_step = 0.0 if step is None else step.fitted.value * self.information.fraction_after(step.onset().value)
        return LeakRise(self.rise, step_log_ratio=self.rise.log_ratio(rise_by_step))

    @property
    def pump_flow(self) -> tuple[float, float]:
        """Mean flow of the pump [m^3/s] over the recording, which also stands for the flow while it delivers."""
        return self.conditions.flow, self.conditions.flow

    @property
    def lpm_per_flow(self) -> float | None:
        """Factor from a flow [m^3/s] to L/min; None if the rig's file does not state piston areas and moving mass."""
        return 1.0 / LITRE_PER_MINUTE if self.stated else None

    def total(self, detectable_flow: float | None) -> TotalLeakage:
        """Return a `TotalLeakage` that states only the smallest detectable leak, as the pressures show only changes."""
        pump_flow, lpm_per_flow = self.conditions.flow, self.lpm_per_flow
        return TotalLeakage(
            lpm=None,
            interval_lpm=None,
            pressure=self.flow_per_conductance,  # a flow over a conductance is a pressure, the mean of abs(p_A - p_B)
            findable_lpm=None if detectable_flow is None or lpm_per_flow is None else detectable_flow * lpm_per_flow,
            findable_share=None if detectable_flow is None or not pump_flow > 0.0 else detectable_flow / pump_flow,
        )

    def history(self, onset_s: float | None) -> LeakCourse | None:
        """Compute the leakage over time [L/min], with its 95 % interval, relative to its mean before `onset_s` [s].

        Return None without an onset or a step test, or if the rig's file does not state the machine's sizes.
        """
        if onset_s is None or self.step is None or not self.stated:
            return None
        time = self.information.time
        growth = fit_history(self.information, self.step, with_step=True).relative_to(time < onset_s)
        unit = self.pressure * _LAW_RATIO / LITRE_PER_MINUTE  # [L/min] per conductance
        value = growth.mean * unit
        half_width = WITHIN_95 * np.sqrt(np.maximum(np.diag(growth.covariance), 0.0)) * unit
        return LeakCourse(time, value, value - half_width, value + half_width)
