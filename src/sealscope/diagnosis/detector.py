"""What every detector is: a small class that looks at a recording, with or without leak-free ones beside it, and
states its evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


class Detector(Protocol):
    """A detector: states evidence at a false-alarm probability, never sees the truth, and says `cannot tell` rather
    than guess.

    What it is given is uniformly sampled, and its chamber pressures and command have no missing sample; any other
    channel may be absent or hold NaN. A class attribute `reads` may name the channels that it looks at where no
    baseline is given: then a campaign that shows a record through several sets of channels runs it once for all that
    agree in these.
    """

    name: str

    def usable(self, recording: Recording) -> str | None:
        """None when the recording has what the detector needs, else the reason why not, in one line."""
        ...

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Evidence on a recording that is `usable`; with an empty baseline the recording's own beginning is the
        baseline."""
        ...


#: Makes a detector for what it may assume of the machine.
Factory = Callable[["Rig"], Detector]
