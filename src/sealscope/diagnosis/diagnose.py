"""Diagnosis of a recording: inspect the data, run every detector that its channels allow, state one verdict."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.baseline.inspection import comparable, inspected
from sealscope.diagnosis.detector import Detector, checked, failure, unusable
from sealscope.diagnosis.isolation import Signatures, elsewhere, isolated, signatures, unasked
from sealscope.diagnosis.registry import detectors
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.verdict.fusion import ORDER, fuse, judges, rank
from sealscope.diagnosis.verdict.machine import assumed_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.recordings.motion import does_not_move
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_log = logging.getLogger(__name__)
#: Probability of `leak` on a leak-free recording, unless the caller asks for another.
FALSE_ALARM_PROBABILITY = 0.01
_PROBABILITIES = (1e-4, 0.2)
#: Least share of a recording that `no leak` rests on.
WHOLE = 0.95
#: Detectors that name a cause by the pressures: they do so of nothing that another cause explains, alone either.
_ISOLATED = ("pressure model", "observer")
#: Why the change of RMS alone judges no valve-controlled machine.
_DAMPED = "behind a servo valve, whose edges damp the ringing as well, that tells no leak from a sound machine"
#: Why it calls no single rod sound: of 24 leaks of 0.05 L/min and 24 of 0.5 on development machines it saw none.
_UNSEEN = "on a single rod leaks of 0.5 L/min may change nothing in them"


def check_probability(probability: float) -> None:
    """Raise InputError for a false-alarm probability that no threshold can be set for."""
    low, high = _PROBABILITIES
    if not (isinstance(probability, float | int) and low <= probability <= high):
        raise InputError(f"false-alarm probability must be {low:g} to {high:g}, got {probability!r}")


class Examination:
    """One recording, its gaps bridged, without missing samples, and what detectors are given beside it.

    `baseline`: leak-free recordings that can be compared with it (`baseline.inspection`); `no_baseline`: why there is
    none where one was asked for: then a leak within the recording is all that can be stated; `rig`: what detectors may
    assume of the machine; `distrust`: why the pressures cannot be judged, None where they can: then no detector is run;
    `share` of what was to be judged that the recording is: `no leak` needs `WHOLE` of it; `machine`: leak-free
    recordings of the machine at any operating point, and `doubt`: why the pressures alone cannot be judged: a
    balance of volumes takes the former and needs no heed of the latter.
    A recording that is to be its own baseline needs pressures that move throughout (`recordings.motion`).
    """

    def __init__(
        self,
        recording: Recording,
        baseline: Sequence[Recording] = (),
        *,
        false_alarm_probability: float,
        rig: Rig | str | os.PathLike[str] = "thesis",
        distrust: str | None = None,
        no_baseline: str | None = None,
        share: float = 1.0,
        machine: Sequence[Recording] | None = None,
        doubt: str | None = None,
        unreadable: str | None = None,
    ) -> None:
        self.share, self.doubt, self.unreadable = share, doubt, unreadable
        self.machine = tuple(baseline if machine is None else machine)
        self.recording, self.baseline, self.rig = recording, tuple(baseline), rig
        self.false_alarm_probability = false_alarm_probability
        self.distrust, self.no_baseline = distrust, no_baseline
        if doubt is None and not self.baseline and (still := does_not_move(recording)) is not None:
            self.doubt = f"the pressures cannot be trusted: {still}"
        self._detectors: dict[str, Detector] = {}
        self._evidence: dict[tuple[str, frozenset[str]], Evidence] = {}

    def through(self, channels: Iterable[str]) -> Examination:
        """Return the same recording with these channels alone; a detector that reads no other is not run again."""
        wanted = set(channels)
        view = Examination(
            self.recording.only(name for name in self.recording.channels if name in wanted),
            [own.only(name for name in own.channels if name in wanted) for own in self.baseline],
            false_alarm_probability=self.false_alarm_probability,
            rig=self.rig,
            distrust=self.distrust,
            no_baseline=self.no_baseline,
            share=self.share,
            machine=[own.only(name for name in own.channels if name in wanted) for own in self.machine],
            doubt=self.doubt,
            unreadable=self.unreadable,
        )
        view._detectors, view._evidence = self._detectors, self._evidence
        return view

    def evidence(self, name: str) -> Evidence:
        """Return a detector's evidence, `cannot tell` where the recording lacks what it needs or where it fails.

        Raises KeyError for a detector that is not registered.
        """
        from threadpoolctl import threadpool_limits

        from sealscope.parameters import load_rig

        factory = detectors()[name]
        # a detector may state the channels that it `reads` where there is no baseline: another view differs in no other
        visible = frozenset(self.recording.channels)
        key = (name, visible)
        try:
            if name not in self._detectors:
                self._detectors[name] = factory(load_rig(self.rig))
            detector = self._detectors[name]
            reads = visible if self.baseline else frozenset(getattr(detector, "reads", visible))
            key = (name, visible & reads)
            if key not in self._evidence:
                # small matrices: threads would cost more than they give, and how they share the work may not repeat to
                # the bit
                with np.errstate(all="ignore"), threadpool_limits(limits=1):
                    self._evidence[key] = self._run(name, detector)
        except Exception as error:
            self._evidence[key] = Evidence(
                "cannot tell", failure(name, getattr(factory, "distribution", None), error), detector=name, usable=False
            )
        return self._evidence[key]

    def _run(self, name: str, detector: Detector) -> Evidence:
        if detector.name != name:
            raise ValueError(f"its name must be that of its entry point, {name!r}, got {detector.name!r}")
        reason = unusable(detector, self.recording) or self.distrust
        if name == ORDER[0]:
            reason = reason or self.unreadable
        if name == ORDER[0] and reason is None:
            evidence = detector.examine(self.recording, self.machine, self.false_alarm_probability)
            evidence = self._with_share(replace(checked(evidence), detector=name))
            return evidence if self.machine else self._without_baseline(evidence)
        baseline, reason = self.baseline, reason or self.doubt
        if reason is None and self.baseline:
            reasons = [unusable(detector, own) for own in self.baseline]
            baseline = tuple(own for own, why in zip(self.baseline, reasons, strict=True) if why is None)
            if not baseline:
                reason = f"no baseline recording can be used: {reasons[0]}"
        if reason is not None:
            return Evidence("cannot tell", reason, detector=name, usable=False)
        evidence = checked(detector.examine(self.recording, baseline, self.false_alarm_probability))
        evidence = self._with_share(replace(evidence, detector=name))
        evidence = self._without_baseline(evidence)
        if self._behind_valve and name == ORDER[-1] and evidence.verdict != "cannot tell":
            reason = f"{evidence.reason}; {_DAMPED}"
            evidence = replace(
                evidence, verdict="cannot tell", reason=reason, cause=None, onset_s=None, onset_interval_s=None
            )
        if self._single_rod and name == ORDER[-1] and evidence.verdict == "no leak":
            evidence = replace(evidence, verdict="cannot tell", reason=f"{evidence.reason}; {_UNSEEN}")
        return self._isolated(evidence) if name in _ISOLATED else evidence

    def _without_baseline(self, evidence: Evidence) -> Evidence:
        """Return the evidence where a baseline was asked for and none can be compared: no change is no health."""
        if self.no_baseline is None:
            return evidence
        if evidence.verdict == "leak" or evidence.cause is not None or evidence.alarmed:
            return replace(evidence, reason=f"{evidence.reason}; {self.no_baseline}")
        return replace(evidence, verdict="cannot tell", reason=self.no_baseline)

    def _with_share(self, evidence: Evidence) -> Evidence:
        """Return the evidence with the share of all that was recorded it rests on; `no leak` needs nearly all."""
        share = self.share * evidence.share
        evidence = replace(evidence, share=share)
        if evidence.verdict == "cannot tell" or share >= 1.0:
            return evidence
        reason = f"{evidence.reason}; this rests on {100.0 * share:.3g} % of the recording"
        if evidence.verdict == "no leak" and share < WHOLE:
            reason += f", and the rest may hide a leak ({WHOLE:.0%} are needed)"
            return replace(evidence, verdict="cannot tell", reason=reason)
        return replace(evidence, reason=reason)

    def fused(self, quick: bool = False) -> Evidence:
        """Return one verdict from all registered detectors; `quick`: from those down to the one that judges.

        Two run at a time: compiled code runs beside the interpreter, and a detector's evidence does not depend on the
        others. A detector that sees a change in the pressures and cannot name its cause is believed where nothing else
        stepped with it, and a verdict other than `leak` that names no cause gets that of a plain step (`isolation`).
        """
        from concurrent.futures import ThreadPoolExecutor

        from threadpoolctl import threadpool_limits

        # the limit is the process's: set here, it does not change while detectors come and go
        with threadpool_limits(limits=1), ThreadPoolExecutor(2) as pool:
            evidences = [] if quick else [self._isolated(own) for own in pool.map(self.evidence, detectors())]
            for name in sorted(detectors(), key=rank) if quick else ():
                evidences.append(self._isolated(self.evidence(name)))
                if judges(evidences[-1]):
                    break
        fused = fuse(evidences)
        if (
            fused.detector == ORDER[0]
            or fused.verdict == "leak"
            or self.distrust is not None
            or self._signatures is None
        ):
            return fused
        other = elsewhere(self._signatures)
        if other is not None:  # of two recordings in one, or of swapped channels, nothing is said
            reason = f"{fused.reason}; but {other.text}"
            return replace(fused, verdict="cannot tell", cause=other.cause, reason=reason)
        if fused.cause is not None:
            return fused
        with np.errstate(all="ignore"):
            stepped = unasked(self._signatures)
        if stepped is None:
            return fused
        onset, other = stepped
        reason = f"{fused.reason}; near {onset:.0f} s {other.text}"
        return replace(fused, cause=other.cause, reason=reason)

    def _isolated(self, evidence: Evidence) -> Evidence:
        if evidence.verdict != "leak" or evidence.detector == ORDER[0] or self._signatures is None:
            return evidence
        with np.errstate(all="ignore"):
            return isolated(evidence, self._signatures, self._known if evidence.onset_s is None else ())

    @cached_property
    def _behind_valve(self) -> bool:
        from sealscope.parameters import load_rig

        return load_rig(self.rig).valve.spool == "present"

    @cached_property
    def _single_rod(self) -> bool:
        from sealscope.parameters import load_rig

        return load_rig(self.rig).cylinder.single_rod

    @cached_property
    def _signatures(self) -> Signatures | None:
        return _signatures(self.recording, self._behind_valve)

    @cached_property
    def _known(self) -> list[Signatures]:
        """Signatures of the baseline."""
        return [seen for own in self.baseline if (seen := _signatures(own, self._behind_valve)) is not None]


def _signatures(recording: Recording, behind_valve: bool) -> Signatures | None:
    try:
        with np.errstate(all="ignore"):
            return signatures(recording, behind_valve=behind_valve)
    except (ArithmeticError, np.linalg.LinAlgError):
        _log.debug("what else stepped cannot be computed", exc_info=True)
        return None


@checked_call
@np.errstate(all="ignore")  # what overflows is a finding, not a warning
def diagnose(
    recording: Recording,
    baseline: Recording | Sequence[Recording] = (),
    *,
    false_alarm_probability: float = FALSE_ALARM_PROBABILITY,
    rig: Rig | str | os.PathLike[str] | None = None,
    limit: str | None = None,
    quick: bool = False,
    file: str | os.PathLike[str] | None = None,
) -> Diagnosis:
    """Say whether oil bypasses the piston in a recording.

    Every detector that the channels allow is run. The most specific of those with a verdict judges (volume balance,
    pressure model, observer, rms change, then plug-ins); the others are stated beside it.

    Parameters
    ----------
    recording : Recording
        The recording to judge.
    baseline : Recording or sequence of Recording, optional
        Leak-free recordings of the same machine. Those that cannot be compared (other direction, command or rate,
        a pressure that does not move, copies) are left out, and a finding of the diagnosis says so. By default the
        recording's own beginning is the baseline, and the onset is looked for.
    false_alarm_probability : float, optional
        Probability of `leak` on a leak-free recording, 1e-4 to 0.2.
    rig : Rig, str or path-like, optional
        What the detectors may assume of the machine: a Rig, the name of a packaged rig or the path of a TOML file. By
        default the thesis's: stated for a recording that was simulated with it, else a mere assumption. Then L/min is
        stated only where displacement over area, measured, is that of this rig.
    limit : str, optional
        Leak from which the machine is to be repaired, as a flow (``"5 mL/min"``) or as the speed at which the piston
        would creep (``"8 mm/min"``, the default).
    quick : bool, optional
        Run the detectors one after the other, the most specific first, and stop at the one that judges. The verdict and
        the judge's figures are the same, in a fraction of the time; what less specific detectors would lend it, or name
        as another cause, is missing.
    file : str or path-like, optional
        Name of the recording in the diagnosis; by default that of the file it was read from.

    Returns
    -------
    Diagnosis
        Verdict (`leak`, `no leak`, or `cannot tell` where the data do not allow one), onset, L/min with intervals, the
        score and threshold behind it, the evidence of each detector, and findings on the data.

    Raises
    ------
    InputError
        The false-alarm probability is outside 1e-4 to 0.2, `recording` or `baseline` is no Recording, `rig` cannot be
        read, or `limit` is neither a flow nor a speed.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", leak="0.05 L/min from 30 s", duration="60 s", seed=1)
    >>> diagnosis = ss.diagnose(recording)
    >>> diagnosis.verdict, round(diagnosis.onset_s)
    ('leak', 30)
    """
    repair = RepairLimit.of(limit)
    check_probability(false_alarm_probability)
    _check_recording("recording", recording)
    known, machine = assumed_rig(rig, recording)
    baselines = [baseline] if isinstance(baseline, Recording) else _sequence(baseline)
    judged = inspected(recording)
    compared = comparable(judged, baselines)
    fused = Examination(
        judged.part,
        compared.parts,
        false_alarm_probability=false_alarm_probability,
        rig=known,
        distrust=judged.distrust,
        no_baseline=compared.refusal,
        share=judged.share,
        machine=compared.machine,
        doubt=judged.doubt,
        unreadable=judged.unreadable,
    ).fused(quick)
    return Diagnosis.of(
        fused,
        recording,
        machine,
        file=os.fspath(file) if file else None,
        false_alarm_probability=false_alarm_probability,
        quality=(*judged.findings, *compared.findings),
        baselines=len(compared.machine if fused.detector == ORDER[0] else compared.parts),
        limit=repair,
    )


def _sequence(baseline: Sequence[Recording]) -> list[Recording]:
    if isinstance(baseline, str | os.PathLike):
        _check_recording("baseline", baseline)
    try:
        recordings = list(baseline)
    except TypeError:
        raise InputError(
            f"baseline must be a Recording or a sequence of Recordings, got {type(baseline).__name__}"
        ) from None
    for k, recording in enumerate(recordings):
        _check_recording(f"baseline[{k}]", recording)
    return recordings


def _check_recording(name: str, value: object) -> None:
    if not isinstance(value, Recording):
        hint = "; sealscope.read makes one of a file" if isinstance(value, str | os.PathLike) else ""
        raise InputError(f"{name} must be a Recording, got {type(value).__name__} {value!r:.40}{hint}")
