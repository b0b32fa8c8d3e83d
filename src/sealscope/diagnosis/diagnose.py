"""Diagnose a recording: inspect the data first, run every detector its channels allow, state one verdict."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sealscope.calls import checked_call
from sealscope.diagnosis.baseline.inspection import comparable, inspected
from sealscope.diagnosis.examination import Examination
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Probability of `leak` on a leak-free recording, unless the caller asks for another.
FALSE_ALARM_PROBABILITY = 0.01
_PROBABILITIES = (1e-4, 0.2)


def check_probability(probability: float) -> None:
    """Raise InputError for a false-alarm probability that no threshold can be set for."""
    low, high = _PROBABILITIES
    if not (isinstance(probability, float | int) and low <= probability <= high):
        raise InputError(f"false-alarm probability must be {low:g} to {high:g}, got {probability!r}")


@checked_call
def diagnose(
    recording: Recording,
    baseline: Recording | Sequence[Recording] = (),
    *,
    false_alarm_probability: float = FALSE_ALARM_PROBABILITY,
    rig: Rig | str | os.PathLike[str] = "thesis",
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
        What the detectors may assume of the machine: a Rig, the name of a packaged rig or the path of a TOML file.
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
        The false-alarm probability is outside 1e-4 to 0.2, `recording` or `baseline` is no Recording, or `rig` cannot
        be read.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", leak="0.05 L/min from 30 s", duration="60 s", seed=1)
    >>> diagnosis = ss.diagnose(recording)
    >>> diagnosis.verdict, round(diagnosis.onset_s)
    ('leak', 30)
    """
    from sealscope.parameters import load_rig

    check_probability(false_alarm_probability)
    _check_recording("recording", recording)
    baselines = [baseline] if isinstance(baseline, Recording) else _sequence(baseline)
    judged = inspected(recording)
    compared = comparable(judged, baselines)
    fused = Examination(
        judged.part,
        compared.parts,
        false_alarm_probability=false_alarm_probability,
        rig=load_rig(rig),
        distrust=judged.distrust,
        no_baseline=compared.refusal,
    ).fused()
    return Diagnosis(
        **vars(fused),
        file=os.fspath(file) if file else str(recording.provenance.get("file", "recording")),
        false_alarm_probability=false_alarm_probability,
        quality=(*judged.findings, *compared.findings),
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
