"""A recording as every detector sees it: each is run once, however many ask for its evidence."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.detector import Detector
from sealscope.diagnosis.registry import detectors
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.verdict.fusion import ORDER, fuse
from sealscope.recordings.motion import does_not_move
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.diagnosis.verdict.isolation import Signatures
    from sealscope.parameters import Rig

#: Detectors that name a cause by the pressures: they say it of nothing that another cause explains, alone either.
_ISOLATED = ("pressure model", "observer")


@cache
def assumed_rig() -> Rig:
    """What detectors assume of a machine of which nothing was said: the thesis's rig."""
    from sealscope.parameters import load_rig

    return load_rig("thesis")


class Examination:
    """One recording without gaps and missing samples (`diagnose.analysable`), its leak-free `baseline`, and what the
    detectors may assume of the machine.

    `untrusted`: why the pressures cannot be trusted, None where they can; then no detector is run. A recording that is
    to be its own baseline needs pressures that move throughout.
    """

    def __init__(
        self,
        recording: Recording,
        baseline: Sequence[Recording] = (),
        *,
        false_alarm_probability: float,
        rig: Rig | None = None,
        untrusted: str | None = None,
    ) -> None:
        self.recording, self.baseline = recording, tuple(baseline)
        self.untrusted = untrusted
        if untrusted is None and not self.baseline:
            still = does_not_move(recording)
            self.untrusted = None if still is None else f"the pressures cannot be trusted: {still}"
        self.false_alarm_probability = false_alarm_probability
        self._rig = rig
        self._made: dict[str, Detector] = {}
        self._known: dict[tuple[str, frozenset[str]], Evidence] = {}

    def through(self, channels: Iterable[str]) -> Examination:
        """The same recording with these of its channels alone; a detector that reads no other is not run again."""
        wanted = set(channels)
        seen = Examination(
            self.recording.only(name for name in self.recording.channels if name in wanted),
            [one.only(name for name in one.channels if name in wanted) for one in self.baseline],
            false_alarm_probability=self.false_alarm_probability,
            rig=self._rig,
            untrusted=self.untrusted,
        )
        seen._made, seen._known = self._made, self._known
        return seen

    def _detector(self, name: str) -> Detector:
        if name not in self._made:
            self._made[name] = detectors()[name](assumed_rig() if self._rig is None else self._rig)
        return self._made[name]

    def evidence(self, name: str) -> Evidence:
        """Return that detector's evidence, `cannot tell` where the recording lacks what it needs.

        Raises KeyError for a detector that is not registered.
        """
        detector = self._detector(name)
        # a detector may state the channels that it `reads` where there is no baseline: another view differs in no other
        visible = frozenset(self.recording.channels)
        reads = visible if self.baseline else frozenset(getattr(detector, "reads", visible))
        key = (name, visible & reads)
        if key not in self._known:
            self._known[key] = self._examined(detector)
        return self._known[key]

    def fused(self) -> Evidence:
        """Return one verdict from all registered detectors.

        A detector that sees a change in the pressures and cannot name its cause is believed where nothing else stepped
        with it (`isolation`).
        """
        evidences = self._all()
        return self._named(fuse([own if own.detector == ORDER[0] else self._isolated(own) for own in evidences]))

    def _all(self) -> list[Evidence]:
        """Return the evidence of every registered detector, two run at a time.

        Compiled code runs beside the interpreter, and a detector's evidence does not depend on the others.
        """
        from concurrent.futures import ThreadPoolExecutor

        from threadpoolctl import threadpool_limits

        names = list(detectors())
        # the limit is the process's: set here, it does not change while detectors come and go
        with threadpool_limits(limits=1), ThreadPoolExecutor(2) as pool:
            return list(pool.map(self.evidence, names))

    def _named(self, fused: Evidence) -> Evidence:
        """Return a verdict other than `leak` that names no cause with that of a step which no detector asked about."""
        from sealscope.diagnosis.verdict.isolation import unasked

        if fused.verdict == "leak" or fused.cause is not None or self.untrusted is not None or self._signatures is None:
            return fused
        with np.errstate(all="ignore"):
            stepped = unasked(self._signatures)
        if stepped is None:
            return fused
        reason = f"{fused.reason}; near {stepped[0]:.0f} s {stepped[1].words}: {stepped[1].cause}"
        return replace(fused, cause=stepped[1].cause, reason=reason)

    def _isolated(self, evidence: Evidence) -> Evidence:
        from sealscope.diagnosis.verdict.isolation import isolated

        if evidence.verdict != "leak" or self._signatures is None:
            return evidence
        return isolated(evidence, self._signatures)

    @cached_property
    def _signatures(self) -> Signatures | None:
        from sealscope.diagnosis.verdict.isolation import signatures

        with np.errstate(all="ignore"):
            return signatures(self.recording)

    def _examined(self, detector: Detector) -> Evidence:
        def not_usable(reason: str) -> Evidence:
            return Evidence("cannot tell", reason, detector=detector.name, usable=False)

        from threadpoolctl import threadpool_limits

        # small matrices: threads would cost more than they give, and how they share the work may not repeat to the bit
        with np.errstate(all="ignore"), threadpool_limits(limits=1):
            unusable = detector.usable(self.recording)
            if unusable is not None:
                return not_usable(unusable)
            if self.untrusted is not None:
                return not_usable(self.untrusted)
            reasons = [detector.usable(one) for one in self.baseline]
            usable = [one for one, reason in zip(self.baseline, reasons, strict=True) if reason is None]
            if self.baseline and not usable:
                return not_usable(f"no baseline recording can be used: {reasons[0]}")
            evidence = detector.examine(self.recording, usable, self.false_alarm_probability)
        evidence = replace(evidence, detector=detector.name)
        return self._isolated(evidence) if detector.name in _ISOLATED else evidence
