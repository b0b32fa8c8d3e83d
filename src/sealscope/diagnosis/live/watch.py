"""Watch a running actuator block by block: leakage in L/min with an interval, and alarms at a stated rate."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sealscope.calls import checked_call
from sealscope.diagnosis.decision.case import HealthyNull
from sealscope.diagnosis.decision.decide import decide
from sealscope.diagnosis.estimate.interval import UPPER_95, WITHIN_95, Estimate, Interval
from sealscope.diagnosis.inference.observable import LeakMeasure, Observed
from sealscope.diagnosis.live.estimates import (
    GROUP,
    BaselineLearning,
    BlockEstimate,
    HealthyLevel,
    WatchBaseline,
    WatchedLeak,
    find_level_rise,
    is_known_duty,
    level_before_leak,
    mean_flow,
)
from sealscope.diagnosis.live.explanation import OUTSIDE, UNKNOWN, RiseExplanation, append_row, explain_rise
from sealscope.diagnosis.live.joining import SampleJoiner, find_way
from sealscope.diagnosis.live.live_balance import LEARNED, BlockConductance, BlockResult, LiveBalance, NotJudged
from sealscope.diagnosis.live.sequential import LEVEL, RECENT, STEP, LiveRise, StepDetector, StepNull
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.verdict.evidence import Cause, Evidence
from sealscope.errors import InputError
from sealscope.recordings.corrections.gaps import remove_dropouts
from sealscope.recordings.formats.times.timebase import clock_text, counts_from_1970
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import require_part, restore_attributes, save_attributes
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Name of the watch as a detector (`Evidence.detector`).
WATCH = "watch"
#: Version of the format of the saved state.
STATE_VERSION = 28
_PRIORS, _EXPLANATION = LIVE.watch, LIVE.explanation
#: Type of a stored block, with the fields of `BlockConductance`.
_BLOCK = np.dtype([(name, float) for name in BlockConductance._fields])
#: Blocks with larger numbers are refused, as their products would overflow.
_MAX_NUMBER = 1e100


def _rate_of_certain_alarms(test: str, seconds: float) -> float:
    """Compute the rate of all false alarms [per 1000 h] at which a test made once in `seconds` always raises one.

    The `test`, `STEP` or `LEVEL`, raises a fixed fraction of all false alarms (`priors.toml`).
    """
    return float(1000.0 / getattr(_PRIORS, test) * 3600.0 / seconds)


def _check_false_alarm_rate(rate: float) -> None:
    """Raise InputError unless each test has a false-alarm probability of 1e-12 to 0.05."""
    rates = [
        _rate_of_certain_alarms(test, blocks * LiveBalance.block_seconds)
        for test, blocks in ((STEP, 1), (LEVEL, GROUP))
    ]
    min_rate, max_rate = 1e-12 * max(rates), 0.05 * min(rates)
    if not min_rate <= rate <= max_rate:
        raise InputError(f"false_alarms_per_1000_h must be {min_rate:.2g} to {max_rate:.5g}, got {rate:g}")


class Watch:
    """Watch one running actuator for leaks; created by the function `watch`, with a state that can be saved.

    The leakage is estimated from the balance of volumes, which needs a position. Without one, judge recordings that are
    cut from the stream by `diagnose`, as the monitor does.

    Parameters
    ----------
    rig, false_alarms_per_1000_h, learn_hours : Rig, float, float
        Arguments of `watch`.
    states_litres : bool, optional
        Whether L/min can be stated; by default found from the rig.
    healthy : HealthyLevel, optional
        Argument of `watch`.

    Attributes
    ----------
    leak : WatchedLeak or None
        The leak that a test has detected, None if there is none.
    baseline : WatchBaseline or None
        Healthy state that the machine is compared with, None while it is being learned.
    blocks, baseline_version : int
        Number of complete blocks so far, and version of the baseline that is in use or being learned.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", duration="2 min", leak="0.0042 L/min from 90 s", seed=1)
    >>> watch = ss.watch("thesis", learn_hours=0.02)
    >>> estimates = watch.update(recording.between(0, 70)) + watch.update(recording.between(70, 120))
    >>> estimates[-1].status, f"{estimates[-1].leak_lpm:.3f} L/min", abs(watch.leak.onset_s - 90.0) < 1.0
    ('alarm', '0.004 L/min', True)
    >>> again = ss.Watch.from_state(watch.state())
    >>> again.leak == watch.leak
    True
    """

    def __init__(
        self,
        rig: Rig,
        false_alarms_per_1000_h: float,
        learn_hours: float,
        *,
        states_litres: bool | None = None,
        healthy: HealthyLevel | None = None,
    ) -> None:
        _check_false_alarm_rate(false_alarms_per_1000_h)
        self.false_alarms_per_1000_h, self.learn_hours = false_alarms_per_1000_h, learn_hours
        if not 0.0 < learn_hours <= 1000.0:
            raise InputError(f"learn_hours must be > 0 and at most 1000 h, got {learn_hours:g}")
        self._rig, self.healthy = rig, healthy
        self._states_litres = LiveBalance.states_flow(rig) if states_litres is None else states_litres
        self._samples = SampleJoiner(rig.circuit.watched_by)
        self._estimator: LiveBalance | None = None  # None until samples have arrived
        self.baseline: WatchBaseline | None = None
        self.leak: WatchedLeak | None = None
        self.blocks, self.baseline_version = 0, 1
        self._learning, self._detector, self._null = BaselineLearning(), StepDetector(), StepNull()
        self._compared = np.empty(0, _BLOCK)  # the last blocks with which the next is compared, at most `RECENT`
        self._grouped = 0  # number of these that await the test of their mean
        self._unjudged = 0  # number of blocks since the last judged one
        self._is_known = True  # True if the last block's duty (pressure and flow) was in the baseline's range
        self._since = math.nan  # beginning of the first block since the tests restarted [s]

    def _false_alarm_probability(self, test: str, seconds: float) -> float:
        """Compute the false-alarm probability of a test, `STEP` or `LEVEL`, that is made once in `seconds`."""
        return self.false_alarms_per_1000_h / _rate_of_certain_alarms(test, seconds)

    @cached_property
    def _rig_text(self) -> str:
        """The rig as JSON text, for the saved state."""
        return json.dumps(self._rig.model_dump())

    @property
    def learned_with(self) -> tuple[Rig, bool, float]:
        """Rig of the baseline, True if L/min are stated, and the time to learn [h]."""
        return self._rig, self._states_litres, self.learn_hours

    @property
    def has_begun(self) -> bool:
        """True once samples have come that can be watched."""
        return bool(self._samples.names)

    def lacks_channels(self, samples: Recording) -> bool:
        """Return True if `samples` have too few channels for the volume balance, such as no position."""
        return not find_way(self._rig.circuit.watched_by, samples.channels)

    @property
    def counters(self) -> dict[str, int]:
        """Numbers of dropped samples, skipped blocks and interruptions, by reason."""
        return dict(self._samples.counters)

    @property
    def block_seconds(self) -> float:
        """Approximate length of a block [s]."""
        return LiveBalance.block_seconds

    @property
    def why_no_litres(self) -> str:
        """Reason why leaks are not stated in L/min, in words; "" if they are, or if no samples have arrived."""
        if self._estimator is None or self._states_litres:
            return ""
        return "L/min is not stated, as the machine's file does not state its areas and displacement"

    @property
    def evidence(self) -> Evidence:
        """Present verdict, with the detected leak or the 95 % upper bound of an undetected one.

        The verdict is "cannot tell" until enough blocks have arrived, and after `GROUP` blocks that cannot be judged.
        """
        leak = self.leak
        probability = self._false_alarm_probability(STEP, self.block_seconds) if leak is None else leak.allowed
        is_blind = leak is None and (self._unjudged >= GROUP or not len(self._compared))
        measure = None if is_blind else self._measure(probability)
        report = Observed(WATCH, leak=measure)
        if measure is None or (leak is None and not math.isfinite(measure.bound_flow)):
            reasons = f": {', '.join(self.counters)}" if self.counters else ""
            report = Observed(WATCH, lack=f"waits for blocks that can be judged{reasons}")
        # other causes were weighed before the alarm (`_explain`)
        return decide(report, (), HealthyNull(), probability, weigh_rivals=False)

    def _measure(self, probability: float) -> LeakMeasure:
        """Describe the detected leak or, without one, the present score and the bound of the test for a step.

        The score is limited to just below the threshold, which a healthy machine exceeds with the `probability`. Flows
        are those of a laminar leak, conductance times mean pressure, and for a leak to the outside usually more;
        `flow_factors` are the ratios of the smallest and the largest possible flow to these.
        """
        leak, estimator = self.leak, self._used_estimator
        if leak is not None:  # the verdict on a detected leak uses neither a bound nor the pump's flow
            test, cause, pressure, bound, pump_flow = leak.estimate, leak.cause, leak.pressure, math.inf, 0.0
        else:
            # a step may exceed the threshold before it is explained: it must not be reported as a leak yet
            threshold = -2.0 * math.log(probability)
            score = min(max(2.0 * self._detector.log_e(), 0.0), threshold * (1.0 - 1e-6))  # twice the log e-value
            test, cause = LiveRise(STEP, score), estimator.cause
            pressure, pump_flow = (float(self._compared[name].mean()) for name in ("pressure", "pump_flow"))
            max_flow = self._detector.bound() * pressure
            bound = max_flow * (1.0 + UPPER_95 * estimator.leak_error)
        least, usual, most = self._flow_ratios()
        # mean increase of the leakage
        flow = Estimate(usual * test.size * pressure, usual * test.deviation * pressure)
        return LeakMeasure(
            provider=WATCH,
            cause=cause,
            step=test if test.test == STEP else None,
            step_flow=flow,
            rise=test if test.test == LEVEL else None,
            rise_flow=flow,
            rise_onset=test.interval,
            flow_per_conductance=pressure,
            flow_factors=(least / usual, most / usual),
            bound_flow=bound,
            pump_flow=(pump_flow, pump_flow),  # mean over all samples, and while the pump delivers
            lpm_per_flow=1.0 / LITRE_PER_MINUTE if self._states_litres else None,
            size_deviation=estimator.leak_error,
        )

    def _flow_ratios(self) -> tuple[float, float, float]:
        """Return the smallest, usual and largest ratio of a leak's flow to the increase of the estimated leakage."""
        is_outside = self.leak is not None and self.leak.cause == OUTSIDE
        return LIVE.watch.outside if is_outside else (1.0, 1.0, 1.0)

    def update(self, samples: Recording, *, follows: bool = True) -> list[BlockEstimate]:
        """Process the next samples; the estimates do not depend on how the samples are divided into calls.

        Parameters
        ----------
        samples : Recording
            The next samples, in SI units. A pump-controlled cylinder needs ``p_A``, ``p_B``, ``x`` and ``theta`` or
            ``omega``, a valve-controlled cylinder ``x``, ``u`` and all four pressures. Samples that cannot be used are
            dropped and counted (`counters`).
        follows : bool, default True
            False if the clock starts anew, as at the beginning of a separate file.

        Returns
        -------
        list of BlockEstimate
            One estimate for every block that the samples complete.
        """
        return [estimate for estimate, _ in self.each(samples, follows=follows)]

    def each(self, samples: Recording, *, follows: bool = True) -> Iterator[tuple[BlockEstimate, WatchedLeak | None]]:
        """Process samples as `update` does, and yield the estimate of each block with the leak detected so far."""
        if not follows:
            self._samples.restart("pauses between samples")
        for run in self._samples.runs(remove_dropouts(samples)):
            results = self._used_estimator.take(run)
            while True:
                with np.errstate(all="ignore"):  # sums of impossible readings may overflow
                    result = next(results, None)
                if result is None:
                    break
                yield self.judge(result), self.leak

    @property
    def _used_estimator(self) -> LiveBalance:
        """Estimator of the conductance for the channels in use."""
        if self._estimator is None:
            self._estimator = LiveBalance(self._rig, self._samples.names)
        return self._estimator

    def continue_from(self, blocks: int, baseline_version: int) -> None:
        """Continue the number of blocks and the version of the baseline of an earlier watch with other settings."""
        self.blocks, self.baseline_version = blocks, baseline_version + 1

    def relearn(self) -> None:
        """Learn a new baseline from now on, after a repair or an exchange of the machine; withdraws the alarm."""
        self.baseline_version += 1
        self.baseline, self._learning = None, BaselineLearning()
        if self._estimator is not None:
            self._estimator.relearn()
        self.dismiss()
        self._null = StepNull()

    def dismiss(self) -> None:
        """Withdraw the alarm and the level of healthy recordings; restart the tests, but keep the learned baseline.

        A step that was no leak raises the threshold of later steps (`sequential.StepNull`).
        """
        if self.leak is not None and self.leak.test == STEP:
            self._null.add_window(0.5 * self.leak.score)
        self.leak = self.healthy = None
        self._forget()

    def _forget(self) -> None:
        """Restart the tests for a leak, without the blocks so far."""
        self._detector.forget()
        self._compared, self._grouped = self._compared[:0], 0

    def judge(self, result: BlockResult) -> BlockEstimate:
        """Test the conductances in a `result` of the estimator for a leak, and return the estimate of its last block.

        A `result` that is no `NotJudged` has at least one block.
        """
        self.blocks += 1
        self._unjudged = self._unjudged + 1 if isinstance(result, NotJudged) else 0
        if isinstance(result, NotJudged):
            if result.is_outdated:
                self._detector = StepDetector()
            if result.restarts:
                self._forget()
            if result.counter:
                self._samples.count(result.counter)
            return BlockEstimate(self.blocks, result.end, result.status)
        for block in result:
            estimate = self._judge_block(block)
        return estimate

    def _judge_block(self, block: BlockConductance) -> BlockEstimate:
        """Test the conductance of a block against those of earlier blocks, and estimate the leak in this block.

        The block is added to the baseline, the healthy state, while that is being learned and no leak has been
        detected. No flows are stated for a duty (pressure difference and pump flow) other than the baseline's. A block
        with numbers that are too large or not finite is not tested.
        """
        is_small = all(abs(number) < _MAX_NUMBER for number in block)  # False for NaN, too
        if not (is_small and self._detector.is_representable(block.g, block.sd)):
            self._samples.count("blocks: beyond floating point")
            return BlockEstimate(self.blocks, block.end, "beyond floating point")
        baseline = self.baseline
        has_known_duty = baseline is None or is_known_duty(block.duty, baseline.duty_low, baseline.duty_high)
        self._add_to_tests(block, has_known_duty=has_known_duty)
        awaits_explanation = self._test_step(block)
        if not has_known_duty:
            return BlockEstimate(self.blocks, block.end, "another duty" if self.leak is None else "alarm")
        # blocks since a step that may not be a leak must not count in the test of the mean: begin a new group
        self._grouped = 0 if awaits_explanation else self._grouped + 1
        if self._grouped == GROUP:
            self._grouped = 0
            if self.leak is None:
                self._test_level(block)
        if self.baseline is None and self.leak is None:
            self._learn(block)
        status = "alarm" if self.leak is not None else "learning" if self.baseline is None else "watched"
        estimate = BlockEstimate(self.blocks, block.end, status)
        if self.leak is None:
            return self._add_flows(estimate, np.array([block], _BLOCK))
        return self._add_flows(estimate, self._blocks_of_leak(self.leak)[-_PRIORS.recent :])

    def _add_to_tests(self, block: BlockConductance, *, has_known_duty: bool) -> None:
        """Add a block to the tests for a leak, which restart after a pause, a clock set back or a change of duty.

        The duty changes if it leaves the baseline's range, or returns to it (`has_known_duty`).
        """
        if not has_known_duty:
            self._samples.count("blocks: another duty")
        if has_known_duty != self._is_known:  # blocks under different duties are not compared
            self._is_known = has_known_duty
            self._forget()
        if len(self._compared) and not 0.0 <= block.end - self._compared["end"][-1] <= _PRIORS.pause:
            self._forget()
        if not len(self._compared):
            self._since = block.begin
        self._detector.take(block.begin, block.end, block.g, block.sd)
        self._compared = append_row(self._compared, np.array(block, _BLOCK), RECENT)

    def _learn(self, block: BlockConductance) -> None:
        """Add a block to the baseline; freeze it after `learn_hours` of operation, but at least `LEARNED` blocks."""
        self._learning.add(block.g, block.lpm, block.duty)
        hours = self._learning.blocks * self.block_seconds / 3600.0
        if self._learning.blocks >= LEARNED and hours >= self.learn_hours * (1.0 - 1e-12):  # rounding of `hours`
            self.baseline = self._learning.freeze(
                self.baseline_version, block.end, hours, states_litres=self._states_litres
            )
            self._learning = BaselineLearning()

    def _test_step(self, block: BlockConductance) -> bool:
        """Test for a step of the conductance up to `block`, and raise the alarm if a leak explains the step.

        For `RECENT` blocks after the alarm, a step with a higher score replaces onset and size of the leak; its cause
        is found once more when enough blocks have followed. While the baseline is learned, the evidence of a step in
        the healthy machine is stored in `_null`. Returns True if a step was found that a leak does not explain, or that
        cannot be explained yet.
        """
        leak = self.leak
        if leak is not None and leak.test == STEP and not leak.is_settled:
            leak = self._settle_cause(leak, block)
        if leak is not None and (leak.test != STEP or block.end - leak.raised_s > RECENT * self.block_seconds):
            return False
        log_threshold = self._null.log_threshold(self._false_alarm_probability(STEP, block.end - block.begin))
        min_log_e = log_threshold if leak is None else 0.5 * leak.score  # a score is twice the log e-value
        is_learning = leak is None and self.baseline is None
        # -inf: the exact value, which is stored while the baseline is learned
        log_e = self._detector.log_e(-math.inf if is_learning else min_log_e)
        if not log_e > min_log_e:
            if is_learning:
                self._null.add(log_e)
            return False
        rise = self._detector.rise()
        if leak is None:
            explanation = self._explain(rise, block)
            if not explanation.is_leak:
                # no other event explains the step, and the tests did not restart
                if is_learning and explanation == UNKNOWN and len(self._compared):
                    self._null.add(log_e)
                return True
            cause = OUTSIDE if explanation.is_outside else None
        else:
            cause = leak.cause
        reason = f"the leakage conductance rises at {clock_text(rise.interval.value)} beyond its random walk"
        self._raise_leak(rise, block, threshold=2.0 * log_threshold, reason=reason, cause=cause)
        return False

    def _settle_cause(self, leak: WatchedLeak, block: BlockConductance) -> WatchedLeak:
        """Find the cause of the detected `leak` once more, when enough blocks up to `block` have followed its onset.

        These are the `outside` blocks (`priors.toml`) from which on a leak to the outside surely shows.
        """
        if self._count_since(leak.estimate.interval) < _EXPLANATION.outside:
            return leak
        explanation = self._weigh_events(leak.estimate.interval, block, is_settled=True)
        if explanation is not None and explanation.is_leak:
            leak = replace(leak, cause=OUTSIDE if explanation.is_outside else self._used_estimator.cause)
        self.leak = self._with_flow(replace(leak, is_settled=True))
        return self.leak

    def _count_since(self, onset: Interval) -> int:
        """Return the number of stored blocks that end after the latest time of an onset."""
        return int(np.count_nonzero(self._compared["end"] > onset.high))

    def _weigh_events(self, onset: Interval, block: BlockConductance, *, is_settled: bool) -> RiseExplanation | None:
        """Find the cause of a rise at `onset` by the blocks up to `block`; None if they are no longer stored."""
        with threadpool_limits(limits=1):  # faster for small matrices, and the results do not depend on the machine
            observables = self._used_estimator.observables(self._since, block.end, onset.value)
        return None if observables is None else explain_rise(observables, self._used_estimator.data, onset, is_settled)

    def _explain(self, rise: LiveRise, block: BlockConductance) -> RiseExplanation:
        """Find the cause of the increase `rise` of the conductance, from changes of other quantities up to `block`.

        The result is `UNKNOWN` if too few blocks have followed the onset, or if the onset lies shortly after the tests
        last restarted (at a start of the machine, after a pause, at a change of duty); such a rise is counted as one of
        a start, and the tests restart. If the blocks around the onset are no longer stored, the rise counts as a leak.
        If other events explain the rise and enough blocks have followed, the tests restart and the estimator learns
        anew.
        """
        n_since = self._count_since(rise.interval)
        if n_since < _EXPLANATION.fewest_blocks:
            return UNKNOWN
        if rise.interval.value < self._since + _EXPLANATION.start * (block.end - block.begin):
            self._samples.count("changes that are no leak: a start")
            self._forget()
            return UNKNOWN
        is_settled = n_since >= _EXPLANATION.settles
        explanation = self._weigh_events(rise.interval, block, is_settled=is_settled)
        if explanation is None:
            return RiseExplanation(is_leak=True)
        if explanation.other_events and is_settled:
            self._samples.count(f"changes that are no leak: {explanation.other_events}")
            self._used_estimator.relearn(rise.interval.high)
            self._forget()
        return explanation

    def _test_level(self, block: BlockConductance) -> None:
        """Test the mean conductance of the last `GROUP` blocks, up to `block`, and raise the alarm if it is too high.

        The blocks are weighted by their precisions. The mean is compared with the baseline or, before there is one,
        with healthy recordings. Without either, nothing is tested. An error of the machine's sizes scales both alike,
        and does not count.
        """
        healthy = self.baseline or self.healthy
        if healthy is None:
            return
        has_baseline = healthy is self.baseline
        blocks = self._compared[-GROUP:]
        first_end_s = float(self._compared["end"][0])
        max_ratio = INFERENCE.oil.warmest
        precisions = blocks["sd"] ** -2.0
        sd, weights = float(np.sum(precisions)) ** -0.5, precisions / np.sum(precisions)
        g, total, offset = (float(weights @ blocks[name]) for name in ("g", "total", "offset"))
        if has_baseline:
            name, mean, onset_s = "baseline", g, float(blocks["end"].mean())
            # the mean is compared with `max_ratio` times the baseline, and both contain the same error `offset`
            deviation = math.hypot(sd, offset * (max_ratio - 1.0))
        else:
            name, mean, onset_s = "healthy recordings", total, first_end_s
            deviation = math.hypot(sd, offset)
        # the leak began after the machine was known to be healthy, if that time is on the clock of the blocks
        has_same_clock = has_baseline or counts_from_1970(block.end)
        earliest_s = min(healthy.known_s, first_end_s) if has_same_clock else first_end_s
        onset = Interval(onset_s, earliest_s, block.end)
        probability = self._false_alarm_probability(LEVEL, GROUP * self.block_seconds)
        rise = find_level_rise(healthy, onset, mean, deviation, probability)
        if rise is not None:
            reason = (
                f"the leakage conductance is {mean:.3g} m^3/(s Pa), over {max_ratio:g} times the least of the {name}: "
                "more than the warmest oil can cause"
            )
            threshold = rise.threshold(probability)
            # as later conductances `g`, which differ from the `total` by what the other coefficients have changed
            before = healthy.level if has_baseline else healthy.level + g - total
            self._raise_leak(rise, block, threshold=threshold, reason=reason, before=before)

    def _raise_leak(
        self,
        rise: LiveRise,
        block: BlockConductance,
        threshold: float,
        reason: str,
        before: float | None = None,
        cause: Cause | None = None,
    ) -> None:
        """Set the leak alarm, `self.leak`, from a significant increase `rise` of the conductance up to `block`.

        `before` is the conductance before the onset: by default its mean over the last blocks before the onset, at most
        `GROUP`, or that of `block` less the rise if none is stored. `cause` is by default the estimator's. An earlier
        alarm keeps its time and its conductance before the onset.
        """
        raised_s = block.end
        if self.leak is not None:
            before, raised_s = self.leak.conductance_before, self.leak.raised_s
        elif before is None:
            earlier_g = self._compared["g"][self._compared["end"] <= rise.interval.low][-GROUP:]
            before = float(np.mean(earlier_g)) if earlier_g.size else block.g - rise.size
        texts = [f"{reason} (score {rise.score:.1f}, threshold {threshold:.1f})", self.why_no_litres]
        self.leak = WatchedLeak(
            raised_s=raised_s,
            onset_s=rise.interval.value,
            onset_interval_s=rise.interval[1:],  # low and high
            leak_lpm=None,
            leak_interval_lpm=None,
            conductance_before=before,
            rise=rise.size,
            rise_sd=rise.deviation,
            pressure=block.pressure,
            test=rise.test,
            cause=cause or self._used_estimator.cause,
            reason="; ".join(filter(None, texts)),
            score=rise.score,
            threshold=threshold,
            is_settled=self.leak is not None and self.leak.is_settled,
        )
        self.leak = self._with_flow(self.leak)

    def _with_flow(self, leak: WatchedLeak) -> WatchedLeak:
        """Compute the flow of a detected leak from its rise and cause."""
        self.leak = leak  # `evidence` states its flow
        evidence = self.evidence
        return replace(leak, leak_lpm=evidence.leak_lpm, leak_interval_lpm=evidence.leak_interval_lpm)

    def _blocks_of_leak(self, leak: WatchedLeak) -> NDArray[Any]:
        """Return the stored blocks that begin after the latest possible onset of the leak; if none, the last block."""
        is_after = self._compared["end"] - self.block_seconds >= leak.onset_interval_s[1]
        return self._compared[is_after] if is_after.any() else self._compared[-1:]

    def with_cycle_means(self, estimate: BlockEstimate) -> BlockEstimate:
        """Replace the flows in the last block's estimate by means over more blocks, which cover cycles of the machine.

        These are the blocks, at most `RECENT`, since the tests last restarted or, after an alarm, since the onset of
        the leak. An estimate of a block that was not judged is returned unchanged.
        """
        if not (estimate.judged and len(self._compared)):
            return estimate
        return self._add_flows(estimate, self._compared if self.leak is None else self._blocks_of_leak(self.leak))

    def _add_flows(self, estimate: BlockEstimate, blocks: NDArray[Any]) -> BlockEstimate:
        """Add the mean total flow and leak of `blocks` [L/min], with 95 % intervals, to an estimate.

        `blocks` (n,) have the fields of `BlockConductance`. The leak is the flow above that of the baseline or, after
        an alarm, above that before the onset. It is left out if there is neither a baseline nor an alarm. Both flows
        are left out without L/min. The limits of the leak are those above the highest and the lowest reference level,
        minus and plus a half-width, times the smallest and the largest ratio of a true to the estimated leak; both at
        least 0.
        """
        if not self._states_litres:
            return estimate
        estimator = self._used_estimator
        lpm = blocks["pressure"] / LITRE_PER_MINUTE  # flow per unit of conductance
        mean_lpm = float(lpm.mean())
        # `noise`: actual over stated variance of the conductances
        errors = blocks["sd"] * lpm * math.sqrt(self._detector.noise)
        total = mean_flow(blocks["total"] * lpm, errors)
        offset = float(np.mean(blocks["offset"] * lpm))
        half_width = WITHIN_95 * math.hypot(total.deviation, offset, estimator.size_error * total.value)
        interval = max(0.0, total.value - half_width), max(0.0, total.value + half_width)
        estimate = replace(estimate, total_lpm=total.value, total_interval_lpm=interval)
        if self.leak is not None:
            reference, reference_sd = level_before_leak(self.leak, estimate.t), self.leak.rise_sd
            least, usual, most = self._flow_ratios()
        elif self.baseline is not None:
            reference = Interval(self.baseline.level, self.baseline.low, self.baseline.high)
            reference_sd, least, usual, most = 0.0, 1.0, 1.0, 1.0
        else:
            return estimate
        leak = mean_flow((blocks["g"] - reference.value) * lpm, errors)
        half_width = WITHIN_95 * math.hypot(leak.deviation, reference_sd * mean_lpm, estimator.leak_error * leak.value)
        low = least * (leak.value + (reference.value - reference.high) * mean_lpm - half_width)
        high = most * (leak.value + (reference.value - reference.low) * mean_lpm + half_width)
        return replace(estimate, leak_lpm=usual * leak.value, leak_interval_lpm=(max(0.0, low), max(0.0, high)))

    def state(self) -> dict[str, Any]:
        """Return the state of the watch as plain values for JSON, for `from_state`."""
        return {
            "version": STATE_VERSION,
            "rig": self._rig_text,
            **save_attributes(self, ("_states_litres", *_SAVED)),
            "estimator": None if self._estimator is None else self._estimator.state(),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Watch:
        """Restore a watch exactly from its saved `state`; raise InputError if it is of another version or damaged."""
        version = require_part(state, "version", int)
        if version != STATE_VERSION:
            raise InputError(f"saved state must have version {STATE_VERSION}, got {version}")
        rate, hours = (require_part(state, name, (float, int)) for name in ("false_alarms_per_1000_h", "learn_hours"))
        states_litres = require_part(state, "states_litres", bool)
        watch = cls(_parse_rig(require_part(state, "rig", str)), rate, hours, states_litres=states_litres)
        restore_attributes(watch, _SAVED, state, _SAVED_TYPES)
        if (estimator := require_part(state, "estimator", (Mapping, type(None)))) is not None:
            watch._used_estimator.load_state(estimator)
        return watch


#: Attributes saved in addition to rig, litres and estimator; below, the types of those that may be None.
_SAVED = (
    *("false_alarms_per_1000_h", "learn_hours", "blocks", "baseline_version", "_samples", "_detector", "_null"),
    *("_learning", "baseline", "leak", "healthy", "_compared", "_grouped", "_unjudged", "_since", "_is_known"),
)
_SAVED_TYPES = {"baseline": WatchBaseline, "leak": WatchedLeak, "healthy": HealthyLevel}


@lru_cache(maxsize=256)
def _parse_rig(text: str) -> Rig:
    """Parse the rig of a saved state; raise InputError if it is not valid."""
    from sealscope.parameters import Rig

    try:
        return Rig.model_validate(json.loads(text))
    except ValueError as error:
        raise InputError(f"saved state's rig does not fit: {str(error).splitlines()[0][:200]}") from None


@checked_call
def watch(
    rig: Rig | str | os.PathLike[str] = "thesis",
    *,
    false_alarms_per_1000_h: float = 1.0,
    learn_hours: float = 8.0,
    healthy: HealthyLevel | None = None,
) -> Watch:
    """Watch a running actuator: estimate its leakage block by block, and alarm at a stated rate of false alarms.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Sizes of the machine, of which piston area and pump displacement are used.
    false_alarms_per_1000_h : float, default 1
        Largest number of false alarms of a healthy machine per 1000 operating hours.
    learn_hours : float, default 8
        Operating hours over which the baseline is learned; after them it is frozen.
    healthy : HealthyLevel, optional
        Leakage level of the machine's healthy recordings. Until there is a baseline, the total leakage is compared
        with this level. A leak that is present from the first sample can then be detected.

    Returns
    -------
    Watch
        The watch. Its method `update` processes samples, and its method `state` returns a state that can be saved.

    Raises
    ------
    InputError
        For a rig that cannot be read, or a rate of false alarms for which no threshold can be set.

    Examples
    --------
    >>> import sealscope as ss
    >>> watch = ss.watch("thesis", false_alarms_per_1000_h=2.0, learn_hours=24.0)
    >>> watch.blocks, watch.counters, watch.leak is None
    (0, {}, True)
    """
    from sealscope.parameters import load_rig

    return Watch(load_rig(rig), false_alarms_per_1000_h, learn_hours, healthy=healthy)
