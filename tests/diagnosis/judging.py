"""Verdicts by one built-in detector alone, made for the rig that a test states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sealscope.diagnosis.diagnose import Examination
from sealscope.diagnosis.healthy import Healthy
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.recording import Recording


def judge(detector: Any, recording: Recording, baseline: Sequence[Healthy] = (), probability: float = 0.01) -> Evidence:
    """Decide on a recording by a detector and its rig."""
    rig = getattr(detector, "rig", "thesis")
    return Examination(recording, baseline, false_alarm_probability=probability, rig=rig).evidence(detector.name)
