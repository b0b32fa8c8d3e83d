"""Diagnose a recording: inspect the data, observe what changed, explain the changes, decide, and state one verdict.

`inspection` checks the data, each detector that the channels allow reports its observations
(`detectors.registry`), `decision` explains them and decides, and `Diagnosis` states the result.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.assumed_rig import assumed_rig
from sealscope.diagnosis.decision.case import HealthyNull
from sealscope.diagnosis.decision.decide import ORDER, combine, decide, is_decided, rank, text_of
from sealscope.diagnosis.detectors.registry import detectors, healthy_null, limit_threads, observe_rivals, run_detector
from sealscope.diagnosis.healthy import Healthy, SummarisedRecording
from sealscope.diagnosis.hold.hold_test import judge_held_recording
from sealscope.diagnosis.hold.recorded_holds import (
    HoldSummary,
    describe_holds,
    estimate_growth,
    find_shown_leak,
    held_leakage,
    summarise_hold,
)
from sealscope.diagnosis.inference.hypotheses import Valves
from sealscope.diagnosis.inference.observable import Observed
from sealscope.diagnosis.inference.volumes.balance_leak import BalanceLeak
from sealscope.diagnosis.inspection import inspect_recording, select_comparable
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAK, RMS_CHANGE, VOLUME_BALANCE, Evidence
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.quality import MISSING_CHANNEL
from sealscope.recordings.recording import Recording

#: Probability of `leak` on a leak-free recording, unless the caller asks for another.
FALSE_ALARM_PROBABILITY: float = DECISION.false_alarm.probability


def check_probability(probability: float) -> None:
    """Check that a false-alarm probability is 1e-4 to 0.2 (`priors.toml`); raise InputError otherwise."""
    min_probability, max_probability = DECISION.false_alarm.rarest, DECISION.false_alarm.largest
    if not (isinstance(probability, float | int) and min_probability <= probability <= max_probability):
        rule = f"false-alarm probability must be {min_probability:g} to {max_probability:g}"
        raise InputError(f"{rule}, got {probability!r}")


@dataclass(frozen=True, eq=False)
class Examination:
    """A recording to judge and its healthy baseline, prepared for one detector or all of them."""

    recording: Recording  # samples to judge; gaps are bridged and no sample is missing
    baseline: Sequence[Healthy] = ()  # leak-free recordings of the same machine
    _: KW_ONLY
    false_alarm_probability: float  # allowed probability of the verdict "leak" on a leak-free recording
    rig: Rig | str | os.PathLike[str] = "thesis"  # sizes of the machine that the detectors assume
    distrust: str | None = None  # reason why the pressures cannot be trusted, in which case no detector runs
    refusal: str | None = None  # reason why none of the given healthy recordings can be compared
    # fractions of the original samples: those that `recording` contains, those before it, those up to its last time
    share: float = 1.0
    judged_from: float = 0.0
    judged_until: float = 1.0
    _reports: dict[str, Observed] = field(default_factory=dict, init=False)  # by detector; `replace` starts anew

    def with_channels(self, channels: Iterable[str]) -> Examination:
        """Return a copy in which all recordings have only the given channels.

        Healthy recordings of which only summaries are stored are left out, as these may rest on other channels.
        """
        names = set(channels)
        healthy = [entry for entry in self.baseline if isinstance(entry, Recording)]
        judged, *baseline = (
            recording.only(name for name in recording.channels if name in names)
            for recording in (self.recording, *healthy)
        )
        return replace(self, recording=judged, baseline=baseline)

    def report(self, name: str) -> Observed:
        """Return the observations of the detector called `name`, which runs at the first call only."""
        if name not in self._reports:
            rig = load_rig(self.rig)
            self._reports[name] = run_detector(name, self.recording, self.baseline, rig, distrust=self.distrust)
        return self._reports[name]

    @cached_property
    def signals(self) -> Observed:
        """Report on changes of duty, noise, friction and the like, which may explain an alarm (`observe_rivals`)."""
        return observe_rivals(self.recording, self.baseline, distrust=self.distrust)

    @cached_property
    def null(self) -> HealthyNull:
        """Distributions of the detectors' p-values in the healthy recordings (`baseline`), test by test.

        If valves cut the pump off at rest in the judged recording, the same is assumed for the healthy ones.
        """
        # tests may replace the built-in detectors, so that there is no volume balance
        leak = self.report(VOLUME_BALANCE).leak if VOLUME_BALANCE in detectors() else None
        is_shut = isinstance(leak, BalanceLeak) and leak.balance.valves is not Valves.OPEN
        return healthy_null(self.baseline, load_rig(self.rig), Valves.SHUT if is_shut else Valves.OPEN)

    def evidence(self, name: str) -> Evidence:
        """Decide from the observations of the detector called `name` alone if the machine leaks.

        Changes in `signals` compete with a leak, except for `rms change`: alone, as in the thesis, its alarm is a leak.
        """
        return self._decide_by(name, [self.signals], weigh_rivals=name != RMS_CHANGE)

    def decide_by_all(self) -> Evidence:
        """Decide from the observations of all registered detectors if the machine leaks.

        Detectors that measure the leak (`ORDER`) run one after the other until one of them decides; all others always
        run. The verdict cannot be "no leak" if a measuring detector failed, or if none of the given healthy recordings
        could be compared, by all detectors or by a measuring one.
        """
        names = sorted(detectors(), key=rank)  # the detectors of `ORDER` first
        # the test results in these reports may show causes other than a leak, whichever detector decides
        reports = [self.signals, *(self.report(name) for name in names if name not in ORDER)]
        decisions = dict[str, Evidence]()
        for name in names:
            if name not in ORDER or not any(is_decided(decision) for decision in decisions.values()):
                decisions[name] = self._decide_by(name, reports)
        reports_in_order = [self.report(name) for name in ORDER if name in decisions]  # of measuring detectors
        refusals = [report.lack if report.has_failed else report.refusal for report in reports_in_order]
        # reason not to state "no leak"
        refusal = self.refusal or next(filter(None, refusals), None) or self._unseen_beginning()
        return combine(list(decisions.values()), refusal)

    def _unseen_beginning(self) -> str | None:
        """Give the reason why a leak from before the first judged sample stays unseen; None if it does not."""
        if self.baseline or self.judged_from <= DECISION.worth.unjudged:
            return None
        return text_of("doubt", "beginning", percent=100.0 * self.judged_from)

    def _decide_by(self, name: str, reports: Sequence[Observed], *, weigh_rivals: bool = True) -> Evidence:
        """Decide from the observations of the detector called `name` if the machine leaks (`decide`)."""
        probability = self.false_alarm_probability
        with np.errstate(all="ignore"):
            evidence = decide(self.report(name), reports, self.null, probability, weigh_rivals=weigh_rivals)
        # the detector states fractions of the examined part; converted to fractions of the whole recording
        judged_until = self.judged_until - self.share * (1.0 - evidence.judged_until)
        return replace(evidence, share=self.share * evidence.share, judged_until=judged_until)


def _summarise_holds(healthy: Sequence[Healthy], areas: Sequence[float] | None) -> list[HoldSummary]:
    """Summarise the longest hold of each healthy recording of a held load (`summarise_hold`); `areas` [m^2]."""
    summaries = (
        entry.summary(HoldSummary)
        if isinstance(entry, SummarisedRecording)
        else summarise_hold(judge_held_recording(entry, areas))
        for entry in healthy
    )
    return [summary for summary in summaries if summary is not None]


@checked_call
@np.errstate(all="ignore")  # an overflow becomes a finding, not a warning
def diagnose(
    recording: Recording,
    baseline: Recording | Sequence[Healthy] = (),
    *,
    false_alarm_probability: float = FALSE_ALARM_PROBABILITY,
    rig: Rig | str | os.PathLike[str] | None = None,
    limit: str | None = None,
    file: str | os.PathLike[str] | None = None,
) -> Diagnosis:
    """Decide if oil bypasses the piston in a recording.

    Four methods are asked in this order: the balance of volumes, the response of the pressures, plug-ins, and the
    change of RMS. The first one that the channels allow, and that reaches a decision, gives the verdict; the change of
    RMS gives it only if the channels allow neither of the first two. The results of plug-ins and of the change of RMS
    are always stated in addition. If a load is held nearly all the time, a hold test states the total leakage and the
    reason, and the verdict is not `no leak` where it shows a leak that the healthy holds do not have.

    Parameters
    ----------
    recording : Recording
        The recording to judge.
    baseline : Recording or sequence of Recording, optional
        Leak-free recordings of the same machine. Those that cannot be compared are left out, and a finding names them.
        Without a baseline, the recording is tested for a leak that begins within it, and its total leakage against the
        limit for a healthy pump if the rig's file states one.
    false_alarm_probability : float, optional
        Probability of `leak` on a leak-free recording, 1e-4 to 0.2.
    rig : Rig, str or path-like, optional
        Sizes of the machine: a Rig, the name of a packaged rig or the path of a TOML file. By default the rig of the
        thesis is used, or that of a servo valve if the recording shows one (`infer_rig`). It counts as stated for a
        recording that was simulated with the same sizes. For any other recording it is a mere assumption, and L/min are
        stated only if a flow meter was recorded.
    limit : str, optional
        Smallest leak that calls for a repair: a flow (``"5 mL/min"``) or a creep speed of the piston
        (``"8 mm/min"``, the default).
    file : str or path-like, optional
        Name of the recording in the diagnosis; by default the name of the file it was read from.

    Returns
    -------
    Diagnosis
        Verdict, onset and leak in L/min with their intervals, the evidence of each detector, and findings on the data.

    Raises
    ------
    InputError
        An argument is of a wrong type or out of its range, or `rig` cannot be read.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", leak="0.05 L/min from 30 s", duration="60 s", seed=1)
    >>> diagnosis = ss.diagnose(recording)
    >>> diagnosis.verdict, round(diagnosis.onset_s)
    ('leak', 30)
    """
    repair_limit = RepairLimit.parse(limit)
    healthy = _list_baseline(recording, baseline)
    check_probability(false_alarm_probability)
    used_rig, machine = assumed_rig(rig, recording)
    stated_areas = machine.areas if machine.area_stated else None
    with limit_threads():
        inspection = inspect_recording(recording)
        recorded = [
            entry for entry in healthy if isinstance(entry, Recording) or entry.units
        ]  # no result of a hold test
        comparable = select_comparable(inspection, recorded)
        holds = judge_held_recording(recording, stated_areas, limit)
        growth = estimate_growth(summarise_hold(holds), _summarise_holds(healthy, stated_areas)) if holds else None
        examination = Examination(
            comparable.judged,
            comparable.parts,
            false_alarm_probability=false_alarm_probability,
            rig=used_rig,
            distrust=inspection.distrust,
            refusal=comparable.refusal or find_shown_leak(holds, growth),
            share=inspection.share,
            judged_from=inspection.judged_from,
            judged_until=inspection.judged_until,
        )
        evidence = examination.decide_by_all()
    if holds:
        evidence = replace(evidence, reason=describe_holds(holds, growth), total_leakage=held_leakage(holds))
    missing = [str(finding.channel) for finding in comparable.findings if finding.code == MISSING_CHANNEL]
    if missing and evidence.verdict != LEAK:
        doubt = text_of("remark", "channels missing", names=join_names(missing))
        evidence = replace(evidence, reason=f"{evidence.reason}{doubt}")
    return Diagnosis.from_evidence(
        evidence,
        recording,
        machine,
        file=os.fspath(file) if file else None,
        quality=comparable.findings,
        false_alarm_probability=false_alarm_probability,
        baselines=len(comparable.parts),
        limit=repair_limit,
        holds=holds,
    )


def _list_baseline(recording: object, baseline: Recording | Sequence[Healthy]) -> list[Healthy]:
    """Return the baseline as a list; raise InputError if `recording` or an entry is of a wrong type, such as a path."""
    is_single = isinstance(baseline, Recording | str | os.PathLike)  # a path is refused below, with a hint
    if not is_single and not isinstance(baseline, Iterable):
        raise InputError(f"baseline must be a Recording or a sequence of Recordings, got {type(baseline).__name__}")
    healthy: list[Any] = [baseline] if is_single else list(cast(Iterable[Any], baseline))
    arguments: list[tuple[str, object, Any]] = [("recording", recording, Recording)]
    for k, entry in enumerate(healthy):
        arguments.append(("baseline" if is_single else f"baseline[{k}]", entry, Recording | SummarisedRecording))
    for name, value, allowed_type in arguments:
        if not isinstance(value, allowed_type):
            hint = "; sealscope.read makes one from a file" if isinstance(value, str | os.PathLike) else ""
            raise InputError(f"{name} must be a Recording, got {type(value).__name__} {value!r:.40}{hint}")
    return healthy
