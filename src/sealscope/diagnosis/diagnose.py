"""Diagnosis of a recording: inspect the data, run the detectors that its channels allow, state one verdict."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.decision.case import DecisionContext
from sealscope.diagnosis.decision.combination import ORDER, combine, is_decided, rank
from sealscope.diagnosis.decision.decide import decide
from sealscope.diagnosis.decision.null import HealthyNull
from sealscope.diagnosis.detectors.observation import null_of, run_detector
from sealscope.diagnosis.detectors.registry import detectors
from sealscope.diagnosis.inference.changes.signals import SIGNALS, observe_signals
from sealscope.diagnosis.inference.observable import Observed
from sealscope.diagnosis.inference.volumes.balance_leak import BalanceLeak
from sealscope.diagnosis.inspection import comparable, inspected
from sealscope.diagnosis.learnt import Healthy, Learnt
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import RMS_CHANGE, Evidence
from sealscope.diagnosis.verdict.machine import assumed_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording

#: Probability of `leak` on a leak-free recording, unless the caller asks for another.
_ALLOWED = priors("verdict")["false_alarm"]
FALSE_ALARM_PROBABILITY: float = _ALLOWED["probability"]


def check_probability(probability: float) -> None:
    """Raise InputError for a false-alarm probability that no threshold can be set for."""
    least, most = _ALLOWED["rarest"], _ALLOWED["largest"]
    if not (isinstance(probability, float | int) and least <= probability <= most):
        raise InputError(f"false-alarm probability must be {least:g} to {most:g}, got {probability!r}")


@dataclass(frozen=True, eq=False)
class Examination:
    """One recording, gaps bridged and without missing samples, and the other inputs of detectors.

    `baseline`: leak-free recordings of the machine; `rig`: what detectors may assume of it; `distrust`: why the
    pressures cannot be judged, None where they can: then no detector is run; `refusal`: why none of the baselines that
    were given can be compared; `share` of what was to be judged that the recording is.
    """

    recording: Recording
    baseline: Sequence[Healthy] = ()
    _: KW_ONLY
    false_alarm_probability: float
    rig: Rig | str | os.PathLike[str] = "thesis"
    distrust: str | None = None
    refusal: str | None = None
    share: float = 1.0
    _reports: dict[str, Observed] = field(default_factory=dict)

    def through(self, channels: Iterable[str]) -> Examination:
        """Return the same recording with these channels alone."""
        names_wanted = set(channels)
        recording, *baseline = (
            healthy.only(name for name in healthy.channels if name in names_wanted)
            for healthy in (self.recording, *self.baseline)
            if isinstance(healthy, Recording)
        )
        return replace(self, recording=recording, baseline=baseline, _reports={})

    def report(self, name: str) -> Observed:
        """Return a detector's observations, or the reason why it has none.

        Raises KeyError for a detector that is not registered.
        """
        if name not in self._reports:
            self._reports[name] = run_detector(name, self.recording, self.baseline, self.rig, self.distrust)
        return self._reports[name]

    @cached_property
    def signals(self) -> Observed:
        """Observations of duty, noise, hum and levels, which no detector of leaks makes."""
        return Observed(SIGNALS, lack=self.distrust) if self.distrust else observe_signals(self.recording)

    @cached_property
    def null(self) -> HealthyNull:
        """Distribution of every observable over the healthy recordings."""
        leak = self.report(ORDER[0]).leak if ORDER[0] in detectors() else None
        return null_of(self.baseline, self.rig, shut=isinstance(leak, BalanceLeak) and leak.balance.shut)

    def evidence(self, name: str) -> Evidence:
        """Decide by one detector alone; the change of RMS by its own rule, whatever else changed."""
        context = DecisionContext(
            false_alarm_probability=self.false_alarm_probability,
            refusal=self.refusal,
            is_weighed=name != RMS_CHANGE,
        )
        return self._decide(name, [self.signals], context)

    def fused(self) -> Evidence:
        """Decide by all registered detectors: the first that measures the leak and can tell judges.

        Where one that measures the leak fails, nobody else may say that there is none.
        """
        context = DecisionContext(false_alarm_probability=self.false_alarm_probability, refusal=self.refusal)
        names = sorted(detectors(), key=rank)
        decisions = dict[str, Evidence]()
        reports = [self.signals, *(self.report(name) for name in names if name not in ORDER)]
        for name in names:
            if name not in ORDER or not any(is_decided(decision) for decision in decisions.values()):
                decisions[name] = self._decide(name, reports, context)
        failed = next(
            (self.report(name).lack for name in ORDER if name in decisions and self.report(name).has_failed), None
        )
        return combine(list(decisions.values()), replace(context, refusal=self.refusal or failed))

    def _decide(self, name: str, reports: Sequence[Observed], context: DecisionContext) -> Evidence:
        report = self.report(name)
        with np.errstate(all="ignore"):
            evidence = decide(report, reports, self.null, context)
        return replace(evidence, share=self.share * evidence.share)


@checked_call
@np.errstate(all="ignore")  # what overflows is a finding, not a warning
def diagnose(
    recording: Recording,
    baseline: Recording | Sequence[Healthy] = (),
    *,
    false_alarm_probability: float = FALSE_ALARM_PROBABILITY,
    rig: Rig | str | os.PathLike[str] | None = None,
    limit: str | None = None,
    file: str | os.PathLike[str] | None = None,
) -> Diagnosis:
    """Decide whether oil bypasses the piston in a recording.

    The balance of volumes judges; where the channels allow none, the response of the pressures does, then plug-ins,
    last the change of RMS. What plug-ins and the change of RMS say is stated beside the verdict.

    Parameters
    ----------
    recording : Recording
        The recording to judge.
    baseline : Recording or sequence of Recording, optional
        Leak-free recordings of the same machine; what cannot be compared is left out, and a finding says so. Without
        any a leak that begins within the recording is looked for.
    false_alarm_probability : float, optional
        Probability of `leak` on a leak-free recording, 1e-4 to 0.2.
    rig : Rig, str or path-like, optional
        What may be assumed of the machine: a Rig, the name of a packaged one or the path of a TOML file; by default
        the thesis's, stated for a recording that was simulated with it, else a mere assumption.
    limit : str, optional
        Leak from which the machine is to be repaired: a flow (``"5 mL/min"``) or a creep (``"8 mm/min"``, the default).
    file : str or path-like, optional
        Name of the recording in the diagnosis; by default that of the file it was read from.

    Returns
    -------
    Diagnosis
        Verdict, onset and L/min with intervals, score and threshold, evidence of each detector, findings on the data.

    Raises
    ------
    InputError
        An argument breaks one of these rules, or `rig` cannot be read.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", leak="0.05 L/min from 30 s", duration="60 s", seed=1)
    >>> diagnosis = ss.diagnose(recording)
    >>> diagnosis.verdict, round(diagnosis.onset_s)
    ('leak', 30)
    """
    repair, baselines = RepairLimit.of(limit), _checked(recording, baseline)
    check_probability(false_alarm_probability)
    known, machine = assumed_rig(rig, recording)
    inspection = inspected(recording)
    compared = comparable(inspection, baselines)
    evidence = Examination(
        inspection.part,
        compared.parts,
        false_alarm_probability=false_alarm_probability,
        rig=known,
        distrust=inspection.distrust,
        refusal=compared.refusal,
        share=inspection.share,
    ).fused()
    return Diagnosis.of(
        evidence,
        recording,
        machine,
        file=os.fspath(file) if file else None,
        quality=(*inspection.findings, *compared.findings),
        false_alarm_probability=false_alarm_probability,
        baselines=len(compared.parts),
        limit=repair,
    )


def _checked(recording: object, baseline: Recording | Sequence[Healthy]) -> list[Healthy]:
    """Return the baselines; InputError where they, or the recording, are something else."""
    single = isinstance(baseline, Recording | str | os.PathLike)
    try:
        healthy: list[Any] = [baseline] if single else [*baseline]  # type: ignore[misc]
    except TypeError:
        kind = type(baseline).__name__
        raise InputError(f"baseline must be a Recording or a sequence of Recordings, got {kind}") from None
    named = [("baseline" if single else f"baseline[{k}]", entry, Recording | Learnt) for k, entry in enumerate(healthy)]
    for name, value, kinds in (("recording", recording, Recording), *named):
        if not isinstance(value, kinds):
            hint = "; sealscope.read makes one of a file" if isinstance(value, str | os.PathLike) else ""
            raise InputError(f"{name} must be a Recording, got {type(value).__name__} {value!r:.40}{hint}")
    return healthy
