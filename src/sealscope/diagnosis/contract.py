"""What every detector is: a small class that looks at a recording, with or without leak-free ones beside it, and
states its evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

from sealscope.diagnosis.verdict import Evidence
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


class Detector(Protocol):
    """A detector: states evidence at a false-alarm probability, never sees the truth, and says `cannot tell` rather
    than guess."""

    name: str

    def usable(self, recording: Recording) -> str | None:
        """None when the recording has what the detector needs, else the reason why not, in one line."""
        ...

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Evidence on a recording that is `usable`; with an empty baseline the recording's own beginning is the
        baseline."""
        ...


def _rms_change(rig: Rig) -> Detector:
    from sealscope.diagnosis.rms_change import RmsChange

    return RmsChange()


#: Every detector by name, made for what it may assume of the machine; `diagnose` runs those that the channels allow,
#: and one contract test runs them all.
DETECTORS: dict[str, Callable[[Rig], Detector]] = {"rms change": _rms_change}
