"""Diagnosis of a recording: inspect the data, run the detectors that its channels allow, state one verdict."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.detector import Detector, checked, failure, unusable
from sealscope.diagnosis.inference.other_steps.step import other_step
from sealscope.diagnosis.inspection import comparable, inspected
from sealscope.diagnosis.judgement import ORDER, combined, deciding, rank
from sealscope.diagnosis.learnt import Healthy, Learnt
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.registry import detectors
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import RAREST, Evidence
from sealscope.diagnosis.verdict.machine import assumed_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.motion import does_not_move
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
    """One recording, its gaps bridged, without missing samples, and what detectors are given beside it.

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
    _detectors: dict[str, Detector] = field(default_factory=dict)
    _evidence: dict[tuple[str, frozenset[str]], Evidence] = field(default_factory=dict)
    _failures: dict[str, str] = field(default_factory=dict)

    def through(self, channels: Iterable[str]) -> Examination:
        """Return the same recording with these channels alone."""
        wanted = set(channels)
        recording, *baseline = (
            own.only(name for name in own.channels if name in wanted)
            for own in (self.recording, *self.baseline)
            if isinstance(own, Recording)
        )
        return replace(self, recording=recording, baseline=baseline)

    def evidence(self, name: str) -> Evidence:
        """Return a detector's evidence, `cannot tell` where the recording lacks what it needs or where it fails.

        Raises KeyError for a detector that is not registered.
        """
        from threadpoolctl import threadpool_limits

        factory, visible = detectors()[name], frozenset(self.recording.channels)
        try:
            if name not in self._detectors:
                self._detectors[name] = factory(load_rig(self.rig))
            detector = self._detectors[name]
            key = (name, visible)
            if key not in self._evidence:
                # small matrices: threads would cost more than they give, and how they share the work may not repeat to
                # the bit
                with np.errstate(all="ignore"), threadpool_limits(limits=1):
                    self._evidence[key] = self._run(name, detector)
            return self._evidence[key]
        except Exception as error:
            why = failure(name, getattr(factory, "distribution", None), error)
            self._failures[name] = why
            return Evidence("cannot tell", why, detector=name, usable=False)

    def _run(self, name: str, detector: Detector) -> Evidence:
        if detector.name != name:
            raise ValueError(f"its name must be that of its entry point, {name!r}, got {detector.name!r}")
        reason = unusable(detector, self.recording) or self.distrust
        if reason is None and name != ORDER[0] and not self.baseline:
            reason = does_not_move(self.recording)
        baseline = self.baseline
        if reason is None and baseline:
            reasons = [_unusable(detector, own) for own in baseline]
            baseline = tuple(own for own, why in zip(baseline, reasons, strict=True) if why is None)
            reason = None if baseline else f"no baseline recording can be used: {reasons[0]}"
        if reason is not None:
            return Evidence("cannot tell", reason, detector=name, usable=False)
        evidence = checked(detector.examine(self.recording, baseline, self.false_alarm_probability))
        return replace(evidence, detector=name, share=self.share * evidence.share)

    def fused(self) -> Evidence:
        """Return one verdict from all registered detectors but those that only stand in for one which judges.

        Where a main detector fails, nobody else may say that there is no leak.
        """
        evidences: list[Evidence] = []
        for name in sorted(detectors(), key=rank):
            if name not in ORDER or deciding(evidences) is None:
                evidences.append(self.evidence(name))
        other = None if self.distrust else other_step(self.recording, RAREST)
        failed = next((self._failures[name] for name in ORDER if name in self._failures), None)
        return combined(evidences, other, self.refusal or failed)


def _unusable(detector: Detector, healthy: Healthy) -> str | None:
    if isinstance(healthy, Recording):
        return unusable(detector, healthy)
    return None if detector.name in healthy.lessons else "it has taught this method nothing"


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
    """Say whether oil bypasses the piston in a recording.

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
    named = [("baseline" if single else f"baseline[{k}]", own, Recording | Learnt) for k, own in enumerate(healthy)]
    for name, value, kinds in (("recording", recording, Recording), *named):
        if not isinstance(value, kinds):
            hint = "; sealscope.read makes one of a file" if isinstance(value, str | os.PathLike) else ""
            raise InputError(f"{name} must be a Recording, got {type(value).__name__} {value!r:.40}{hint}")
    return healthy
