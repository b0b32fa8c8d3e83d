"""What a detector's stream has raised by a record's end: the verdict of a machine that is watched, not recorded."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Samples arrive in portions of this length [s].
_PORTION = 1.0


def online(recording: Recording, rig: Rig | str | os.PathLike[str], false_alarm: float) -> Evidence:
    """Return the alarm of the volume balance's stream as it stands at the record's end, or its last word without one.

    Its rate of alarms is the one at which a healthy machine alarms within the record with the probability
    `false_alarm` at most. An alarm that was raised stays, whatever came later. A record without its channels is
    `cannot tell`.
    """
    from sealscope.diagnosis.inference.live.stream import SequentialBalance

    stream = SequentialBalance(rig, alarms_per_hour=false_alarm * 3600.0 / recording.duration)
    begin = float(recording.t[0])
    try:
        for second in range(math.ceil(recording.duration / _PORTION)):
            stream.update(recording.between(begin + second * _PORTION, begin + (second + 1) * _PORTION))
    except InputError as error:
        return Evidence("cannot tell", str(error))
    return stream.state.alarm or stream.state.evidence
