"""One running actuator, block by block: L/min with an interval, and alarms at a stated rate per operating hour."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.decision.texts import text_of
from sealscope.diagnosis.decision.verdicts import bound_worth_stating, decide_verdict
from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.diagnosis.live.balance import LEARNED, BlockConductance, LiveBalance, NotJudged, Shown
from sealscope.diagnosis.live.estimates import (
    BaselineLearning,
    BlockEstimate,
    HealthyLevel,
    WatchBaseline,
    WatchedLeak,
    estimate_rise,
    within,
)
from sealscope.diagnosis.live.joining import SampleJoiner, ways_to_watch
from sealscope.diagnosis.live.pressures import PressureEstimator
from sealscope.diagnosis.live.sequential import RECENT, StepDetector, StepEstimate
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import NO_LEAK, Evidence
from sealscope.errors import InputError
from sealscope.recordings.corrections.gaps import remove_dropouts
from sealscope.recordings.formats.timebase import clock_text, counts_from_1970
from sealscope.recordings.recording import Array, Recording
from sealscope.storage.plain_state import part_of, recall, restored, saved
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Format of the saved state.
STATE_VERSION = 14
_PRIORS = priors("live")["watch"]
#: Blocks of one mean that is compared with the baseline, and of the mean that is the leak after an alarm.
GROUP, _OF_NOW = _PRIORS["group"], _PRIORS["recent"]
#: What is kept of the last blocks: end, conductance, deviation, flow of a unit of it, the duty's logarithms, the total
#: conductance and what it is off by; and of those whose mean is not whole yet.
_LAST = np.dtype([(name, float) for name in ("end", "g", "sd", "flow", "pressure", "motion", "total", "offset")])
_GROUP = np.dtype([(name, float) for name in ("end", "g", "sd", "offset")])
#: A block whose numbers are larger says nothing: their products would overflow.
_LARGEST = 1e100
#: What a watched leak and the evidence of it call alike.
_FIGURES = ("score", "threshold", "onset_s", "onset_interval_s", "leak_lpm", "leak_interval_lpm")
#: Ways of watching, each a stream of conductances.
Estimator = LiveBalance | PressureEstimator
_WithInterval = tuple[float, float, float]
_KINDS: dict[str, type[Estimator]] = {estimator.method: estimator for estimator in (LiveBalance, PressureEstimator)}


class Watch:
    """One running actuator, whose state can be saved; `watch` makes one.

    Where the position is recorded it is watched by the balance of volumes, else by the pressures and the command.

    Parameters
    ----------
    rig, false_alarms_per_1000_h, learn_hours : Rig, float, float
        As for `watch`.
    litres : mapping of str to bool, optional
        Whether the rig states what turns a conductance into L/min, for each way of watching; by default it is asked.
    healthy : HealthyLevel, optional
        As for `watch`.

    Attributes
    ----------
    leak : WatchedLeak or None
        The leak that the tests show.
    baseline : WatchBaseline or None
        What the machine is compared with, None while it is learned.
    blocks, baseline_version : int
        Whole blocks so far, and version of the baseline, or of that which is being learned.

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
        litres: Mapping[str, bool] | None = None,
        healthy: HealthyLevel | None = None,
    ) -> None:
        self.false_alarms_per_1000_h, self.learn_hours = false_alarms_per_1000_h, learn_hours
        self._probability("step", LiveBalance.block_seconds)
        if not 0.0 < learn_hours <= 1000.0:
            raise InputError(f"learn_hours must be > 0 and at most 1000 h, got {learn_hours:g}")
        self._rig, self.healthy = rig, healthy
        self._litres = {by: kind.states_flow(rig) for by, kind in _KINDS.items()} if litres is None else litres
        self._samples = SampleJoiner(ways_to_watch(rig))
        self._estimator: Estimator | None = None
        self.baseline: WatchBaseline | None = None
        self.leak: WatchedLeak | None = None
        self.blocks, self.baseline_version = 0, 1
        self._learning, self._detector = BaselineLearning(), StepDetector()
        self._last, self._group = np.empty(0, _LAST), np.empty(0, _GROUP)

    def _probability(self, test: str, seconds: float) -> float:
        """Return the false-alarm probability of one look of a test, given the seconds between looks.

        Raises InputError where no threshold can be set for it.
        """
        rate: float = self.false_alarms_per_1000_h
        looks: float = 1000.0 / _PRIORS[test] * 3600.0 / seconds
        least, most = 1e-12 * looks, 0.05 * looks
        if not least <= rate <= most:
            raise InputError(f"false_alarms_per_1000_h must be {least:.2g} to {most:.3g}, got {rate:g}")
        return rate / looks

    @cached_property
    def _rig_text(self) -> str:
        return json.dumps(self._rig.model_dump())

    @property
    def learned_with(self) -> tuple[Rig, Mapping[str, bool], float]:
        """Rig, whether its values state L/min, and hours, by which the baseline was learnt."""
        return self._rig, self._litres, self.learn_hours

    @property
    def method(self) -> str:
        """Way of watching, "volumes" where the position is recorded, else "pressures"."""
        return "volumes" if "x" in self._samples.names or not self._samples.names else "pressures"

    @property
    def counters(self) -> dict[str, int]:
        """Counts of dropped samples, skipped blocks and interruptions, by reason."""
        return dict(self._samples.counters)

    @property
    def block_seconds(self) -> float:
        """About how long a block is [s]."""
        return LiveBalance.block_seconds if self._estimator is None else self._estimator.block_seconds

    @property
    def why_no_litres(self) -> str:
        """Why no L/min is stated, "" where it is."""
        estimator = self._estimator
        if estimator is None or estimator.litres:
            return ""
        return "L/min is not stated: areas and displacement of the machine are not, which its file states"

    @property
    def evidence(self) -> Evidence:
        """Present verdict, with the detected leak, or the 95 % bound of an undetected one."""
        leak, estimator = self.leak, self._estimator
        if leak is not None:
            figures: dict[str, Any] = {name: getattr(leak, name) for name in _FIGURES}
            cause: Any = leak.cause
            return Evidence(decide_verdict(True, math.inf, 0.0), leak.reason, cause=cause, **figures)
        bound = self._detector.bound() if estimator is not None and len(self._last) else math.inf
        if estimator is None or not math.isfinite(bound):
            why = f": {', '.join(self.counters)}" if self.counters else ""
            return Evidence(decide_verdict(False, math.inf, 0.0), f"waits for the first blocks{why}")
        last = self._last[-1]
        bound, pump = estimator.orifice * bound * float(last["flow"]), math.exp(last["motion"]) / LITRE_PER_MINUTE
        limit = f"{bound:.2g} L/min" if estimator.litres else f"{100.0 * bound / pump:.2g} % of the pump's flow"
        verdict = decide_verdict(False, bound, bound_worth_stating(pump))
        return Evidence(
            verdict,
            text_of("bound", "none" if verdict == NO_LEAK else "hidden", limit=limit),
            score=max(2.0 * self._detector.log_e(), 0.0),
            threshold=-2.0 * math.log(self._probability("step", self.block_seconds)),
            bound_lpm=bound if estimator.litres else None,
        )

    def update(self, samples: Recording, *, follows: bool = True) -> list[BlockEstimate]:
        """Take the next samples; results do not depend on how they are cut.

        Parameters
        ----------
        samples : Recording
            The next samples, in SI units: ``p_A``, ``p_B``, ``x`` and ``theta`` or ``omega``; or, of a cylinder with
            two like areas, ``p_A``, ``p_B`` and ``u``; behind a servo valve ``x``, ``u`` and all four pressures. What
            does not fit is dropped and counted (`counters`).
        follows : bool, default True
            False where the clock begins anew, as with a file of its own.

        Returns
        -------
        list of BlockEstimate
            Of every block that the samples complete.
        """
        return [estimate for estimate, _ in self.each(samples, follows=follows)]

    def each(self, samples: Recording, *, follows: bool = True) -> Iterator[tuple[BlockEstimate, WatchedLeak | None]]:
        """Yield the estimates of `update`, each with the leak at that block.

        Iterate to the end: samples are taken on the way.
        """
        if not follows:
            self._samples.restart("restart")
        for run in self._samples.runs(remove_dropouts(samples)):
            if self._estimator is None or self._estimator.method != self.method:  # a position came later
                self._estimator = self._make_estimator()
            with np.errstate(all="ignore"):  # a block whose sums overflow says nothing
                results = self._estimator.take(run)
            self._samples.settled = self._estimator.begun
            for result in results:
                if isinstance(result, NotJudged) and not result.status:
                    self._samples.count(result.counted)
                else:
                    yield self.judged(result), self.leak

    def _make_estimator(self) -> Estimator:
        litres = self._litres.get(self.method, False)
        if self.method == PressureEstimator.method:
            return PressureEstimator(self._rig, litres)
        return LiveBalance(self._rig, self._samples.names, litres)

    def continue_from(self, blocks: int, baseline_version: int) -> None:
        """Continue the counts of blocks and baselines of an earlier watch with other settings or state."""
        self.blocks, self.baseline_version = blocks, baseline_version + 1

    def relearn(self) -> None:
        """Learn a new baseline from now on: the machine was repaired, or is another."""
        self.baseline_version += 1
        self.baseline, self._learning = None, BaselineLearning()
        if self._estimator is not None:
            self._estimator.relearn()
        self.dismiss()

    def dismiss(self) -> None:
        """Withdraw the leak and compare with no block before now; keep the baseline.

        The level of the healthy recordings, which may have raised it, is not compared with any more.
        """
        self.leak = self.healthy = None
        self._forget()

    def _forget(self) -> None:
        self._detector.forget()
        self._last, self._group = self._last[:0], self._group[:0]

    def judged(self, shown: Shown) -> BlockEstimate:
        """Return the estimate of a block from its conductance, or from the reason why there is none."""
        self.blocks += 1
        if isinstance(shown, NotJudged):
            if shown.apart:
                self._forget()
            if shown.counted:
                self._samples.count(shown.counted)
            return BlockEstimate(self.blocks, shown.end, shown.status)
        assert self._estimator is not None
        for block in shown:
            estimate = self._judge(self._estimator, block)
        return estimate

    def _judge(self, estimator: Estimator, block: BlockConductance) -> BlockEstimate:
        """Test a block by all that came before, and return its estimate."""
        numbers = (block.g, block.total, block.offset, block.flow, *block.duty)
        if not (all(abs(number) < _LARGEST for number in numbers) and self._detector.resolves(block.g, block.sd)):
            self._samples.count("blocks: beyond floating point")
            return BlockEstimate(self.blocks, block.end, "beyond floating point")
        if self.baseline is not None and not within(block.duty, self.baseline.duty_low, self.baseline.duty_high):
            self._samples.count("blocks: another duty")
            return BlockEstimate(self.blocks, block.end, "another duty")
        if len(self._last) and not 0.0 <= block.end - self._last["end"][-1] <= _PRIORS["pause"]:
            self._forget()
        self._detector.take(block.begin, block.end, block.g, block.sd)
        row = np.array((block.end, block.g, block.sd, block.flow, *block.duty, block.total, block.offset), _LAST)
        self._last = np.append(self._last[1 - RECENT :], row)
        self._test_step(estimator, block)
        self._test_level(estimator, block)
        if self.baseline is None and self.leak is None:
            self._learning.add(block.g, block.flow, block.duty, GROUP)
            hours = self._learning.blocks * self.block_seconds / 3600.0
            if self._learning.blocks >= LEARNED and hours >= self.learn_hours * (1.0 - 1e-12):
                self.baseline = self._learning.frozen(
                    self.baseline_version, block.end, hours, estimator.litres and estimator.levels
                )
                self._learning = BaselineLearning()
        status = "alarm" if self.leak is not None else "learning" if self.baseline is None else "watched"
        return (
            self._estimate(estimator, status, block)
            if estimator.litres
            else BlockEstimate(self.blocks, block.end, status)
        )

    def _test_step(self, estimator: Estimator, block: BlockConductance) -> None:
        """Test for a step; an alarm that stands is stated anew while more blocks sharpen it."""
        leak = self.leak
        if leak is not None and (leak.test != "step" or block.end - leak.raised_s > RECENT * self.block_seconds):
            return
        threshold = -math.log(self._probability("step", block.end - block.begin))
        least = threshold if leak is None else 0.5 * leak.score
        if not self._detector.log_e(least) > least:
            return
        rise = self._detector.rise()
        if leak is None and self._has_duty_changed(estimator, rise):
            self._samples.count("blocks not compared: changed duty")
            self._forget()
            return
        reason = (
            f"the leakage conductance rises at {clock_text(rise.onset[0])} beyond its random walk "
            f"(score {rise.score:.1f}, threshold {2.0 * threshold:.1f})"
        )
        self._raise(estimator, rise._replace(threshold=2.0 * threshold, reason=reason), block)

    def _has_duty_changed(self, estimator: Estimator, rise: StepEstimate) -> bool:
        """Test whether the duty changed with a rise, beyond its range before and the effect of a leak."""
        pressure, motion = self._last["pressure"], self._last["motion"]
        after = self._last["end"] > rise.onset[0]
        if np.count_nonzero(~after) < _OF_NOW or not after.any():
            return False
        low, high = ((float(f(pressure[~after])), float(f(motion[~after]))) for f in (np.min, np.max))
        now = float(np.median(pressure[after])), float(np.median(motion[after]))
        lost = 1.0 - rise.size * math.exp(now[0] - now[1]) if estimator.levels else 1.0
        net = now[0], now[1] + math.log(max(lost, np.finfo(float).tiny))  # the pump may give what leaks
        return not (within(now, low, high) or within(net, low, high))

    def _test_level(self, estimator: Estimator, block: BlockConductance) -> None:
        """Gather blocks to means, and compare these with the baseline."""
        self._group = np.append(self._group, np.array((block.end, block.g, block.sd, block.offset), _GROUP))
        if len(self._group) < GROUP:
            return
        end, g, offset = (float(self._group[name].mean()) for name in ("end", "g", "offset"))
        sd = math.sqrt(sum(value**2 for value in self._group["sd"].tolist())) / GROUP
        self._group = self._group[:0]
        if self.leak is not None:
            return
        if self.baseline is None:
            self._test_healthy_level(estimator, block, math.hypot(sd, offset))
            return
        # what all conductances are off by is in the ceiling that many times
        deviation = math.hypot(sd, offset * (priors("inference")["oil"]["warmest"] - 1.0))
        rise = self.baseline.rise(end, g, deviation, self._probability("level", GROUP * self.block_seconds))
        if rise is not None:
            self._raise(estimator, rise, block, self.baseline.level)

    def _test_healthy_level(self, estimator: Estimator, block: BlockConductance, deviation: float) -> None:
        """Compare the last blocks' total conductance with that of the healthy recordings, until there is a baseline."""
        healthy = self.healthy
        if healthy is None or not estimator.levels:
            return
        total, first, now = float(self._last["total"][-GROUP:].mean()), float(self._last["end"][0]), block.end
        since = min(healthy.known_s, first) if counts_from_1970(now) else first
        probability = self._probability("level", GROUP * self.block_seconds)
        onset = first, since, now
        deviation = math.hypot(deviation, healthy.deviation)
        rise = estimate_rise(healthy, "healthy recordings", onset, total, deviation, probability)
        if rise is not None:
            self._raise(estimator, rise, block, healthy.level)

    def _raise(
        self, estimator: Estimator, rise: StepEstimate, block: BlockConductance, before: float | None = None
    ) -> None:
        leak, (onset, *ends) = self.leak, rise.onset
        if before is None:
            earlier = self._last["g"][self._last["end"] <= ends[0]][-GROUP:]
            mean_before = float(np.mean(earlier)) if earlier.size else block.g - rise.size
            before = leak.conductance_before if leak is not None else mean_before
        reason = rise.reason if estimator.litres else f"{rise.reason}; {self.why_no_litres}"
        half = WITHIN_95 * math.hypot(rise.deviation, estimator.size_error * rise.size)
        low, high = (
            estimator.inside * max(0.0, rise.size - half) * block.flow,
            estimator.orifice * (rise.size + half) * block.flow,
        )
        self.leak = WatchedLeak(
            raised_s=block.end if leak is None else leak.raised_s,
            onset_s=onset,
            onset_interval_s=(ends[0], ends[1]),
            leak_lpm=rise.size * block.flow if estimator.litres else None,
            leak_interval_lpm=(low, high) if estimator.litres else None,
            conductance_before=before,
            conductance_before_sd=rise.deviation,
            test=rise.test,
            cause=estimator.cause,
            reason=reason,
            score=rise.score,
            threshold=rise.threshold,
        )

    def _estimate(self, estimator: Estimator, status: str, block: BlockConductance) -> BlockEstimate:
        """Return the block's estimate: total flow, and its excess over the baseline, or over that before the leak."""
        flow, sd = block.flow, block.sd * math.sqrt(self._detector.noise)
        total = total_interval = leak = leak_interval = excess = None
        if self.leak is not None:
            excess = self._estimate_rise(self.leak, estimator, block, sd)
        elif self.baseline is not None:
            base, half = self.baseline, WITHIN_95 * sd
            excess = block.g - base.level, block.g - base.high - half, block.g - base.low + half
        if estimator.levels:
            half = WITHIN_95 * math.hypot(sd, block.offset)
            total = block.total * flow
            total_interval = max(0.0, block.total - half) * flow, max(0.0, block.total + half) * flow
        if excess is not None:
            leak, low, high = (value * flow for value in excess)
            leak_interval = max(0.0, low), estimator.orifice * max(0.0, high)
        return BlockEstimate(self.blocks, block.end, status, total, total_interval, leak, leak_interval)

    def _estimate_rise(
        self, leak: WatchedLeak, estimator: Estimator, block: BlockConductance, sd: float
    ) -> _WithInterval:
        """Return the conductance since the onset of a leak, and its interval, in which the oil may have warmed."""
        is_after = self._last["end"] - self.block_seconds >= leak.onset_interval_s[1]
        recent = self._last["g"][is_after][-_OF_NOW:]
        now, warming = float(np.mean(recent)) if recent.size else block.g, self._warming_factor(leak, block.end)
        before, rise = max(leak.conductance_before, 0.0), now - leak.conductance_before
        noise = sd / math.sqrt(max(len(recent), 1))
        spread = WITHIN_95 * math.hypot(noise, leak.conductance_before_sd, estimator.size_error * rise)
        return rise, estimator.inside * (now - before * warming - spread), now - before / warming + spread

    def over_cycles(self, estimate: BlockEstimate) -> BlockEstimate:
        """Return the estimate of the last block with mean flows over the cycles seen, as a recording's are.

        These are the last `RECENT` blocks since an interruption, of a leak those since its onset.
        """
        estimator, leak = self._estimator, self.leak
        if estimator is None or not (estimator.litres and estimate.judged and len(self._last)):
            return estimate
        rows = self._last
        if leak is not None:
            is_after = rows["end"] - self.block_seconds >= leak.onset_interval_s[1]
            rows = rows[is_after] if is_after.any() else rows[-1:]
        flow = rows["flow"]
        noise = math.sqrt(self._detector.noise * float(np.sum((rows["sd"] * flow) ** 2))) / len(rows)

        def mean_of(values: Array) -> tuple[float, float]:
            spread = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else 0.0
            return float(values.mean()), math.hypot(noise, spread)

        total = interval = None
        if estimator.levels:
            total, deviation = mean_of(rows["total"] * flow)
            half = WITHIN_95 * math.hypot(deviation, float(np.mean(rows["offset"] * flow)))
            interval = max(0.0, total - half), max(0.0, total + half)
        estimate = replace(estimate, total_lpm=total, total_interval_lpm=interval)
        if leak is None and self.baseline is None:
            return estimate
        if leak is not None:
            before, scale = leak.conductance_before, estimator.inside
            warming = self._warming_factor(leak, estimate.t)
            least, most = max(before, 0.0) * warming, before / warming
            deviation_before = leak.conductance_before_sd
        else:
            base = self.baseline
            assert base is not None
            before, scale, least, most, deviation_before = base.level, 1.0, base.high, base.low, 0.0
        unit = float(flow.mean())
        value, deviation = mean_of((rows["g"] - before) * flow)
        half = WITHIN_95 * math.hypot(deviation, deviation_before * unit, estimator.size_error * value)
        low = scale * (value + (before - least) * unit - half)
        high = estimator.orifice * (value + (before - most) * unit + half)
        return replace(estimate, leak_lpm=value, leak_interval_lpm=(max(0.0, low), max(0.0, high)))

    @staticmethod
    def _warming_factor(leak: WatchedLeak, t: float) -> float:
        """Return the factor by which warmer oil may have raised the conductance since the onset of a leak."""
        oil, hours = priors("inference")["oil"], max(0.0, t - leak.onset_s) / 3600.0
        return float(oil["warmest"] ** min(1.0, hours / oil["shift"]))

    def state(self) -> dict[str, Any]:
        """Return the state of the watch as plain values for JSON; its ``"version"`` is the format's."""
        estimator = self._estimator if self._estimator is not None and self._estimator.method == self.method else None
        return {
            "version": STATE_VERSION,
            "rig": self._rig_text,
            **saved(self, ("_litres", *_SAVED)),
            "estimator": None if estimator is None else estimator.state(),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Watch:
        """Return the watch that `state` was of, also after JSON; it continues with the same bits.

        Raises InputError where the state is none, of another version, or damaged.
        """
        version = part_of(state, "version", int)
        if version != STATE_VERSION:
            raise InputError(f"saved state must have version {STATE_VERSION}, got {version}")
        rate, hours = (part_of(state, name, (float, int)) for name in ("false_alarms_per_1000_h", "learn_hours"))
        litres = restored(dict[str, bool], part_of(state, "litres", Mapping), "litres")
        watch = cls(_parse_rig(part_of(state, "rig", str)), rate, hours, litres=litres)
        recall(watch, _SAVED, state, _KINDS_OF_SAVED)
        if (estimator := part_of(state, "estimator", (Mapping, type(None)))) is not None:
            watch._estimator = watch._make_estimator()
            watch._estimator.recall(estimator)
        return watch


#: Attributes that are the state beside rig and estimator; types of those that may be None.
_SAVED = (
    *("false_alarms_per_1000_h", "learn_hours", "blocks", "baseline_version", "_samples", "_detector"),
    *("_learning", "baseline", "leak", "healthy", "_last", "_group"),
)
_KINDS_OF_SAVED = {"baseline": WatchBaseline, "leak": WatchedLeak, "healthy": HealthyLevel}


@lru_cache(maxsize=256)
def _parse_rig(text: str) -> Rig:
    """Return the rig of a saved state; raises InputError where it is none."""
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
    """Watch a running actuator: blocks in, L/min with an interval and alarms out.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the piston's area and the pump's displacement; without a position all of the machine's model.
    false_alarms_per_1000_h : float, default 1
        False alarms of a healthy machine per 1000 operating hours, at most.
    learn_hours : float, default 8
        Operating hours of healthy running that the baseline is learned from; then it is frozen.
    healthy : HealthyLevel, optional
        Of a machine's healthy recordings: until there is a baseline, the total leakage is compared with it, so that a
        leak shows that is there from the first sample.

    Returns
    -------
    Watch
        Its `update` takes samples, its `state` can be saved.

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
