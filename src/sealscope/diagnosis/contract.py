"""What every detector is: a small class that looks at a recording, with or without leak-free ones beside it, and
states its evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

from sealscope.diagnosis.verdict import Evidence
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


def _rms_change(rig: Rig) -> Detector:
    from sealscope.diagnosis.rms_change import RmsChange

    return RmsChange()


def _volume_balance(rig: Rig) -> Detector:
    from sealscope.diagnosis.volume_balance import VolumeBalance

    return VolumeBalance(rig)


def _pressure_model(rig: Rig) -> Detector:
    from sealscope.diagnosis.pressure_model import PressureModel

    return PressureModel(rig)


def _observer(rig: Rig) -> Detector:
    from sealscope.diagnosis.observer import Observer

    return Observer(rig)


#: The built-in detectors by name; `diagnose` runs those that the channels allow, and one contract test runs them all.
DETECTORS: dict[str, Factory] = {
    "volume balance": _volume_balance,
    "pressure model": _pressure_model,
    "observer": _observer,
    "rms change": _rms_change,
}


def detectors() -> Mapping[str, Factory]:
    """Every detector by name: the built-in ones, then those that installed distributions bring (`plugins`)."""
    from sealscope.diagnosis.plugins import plug_ins

    return {**DETECTORS, **{one.name: one for one in plug_ins(frozenset(DETECTORS))}}
