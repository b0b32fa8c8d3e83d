"""The names in a plan's `detectors`: scorers, registered detectors and the fused verdict, each on a set of channels.

"d3 of p_A fell"                a scorer, its threshold from the plan's leak-free records
"volume balance"                a registered detector by its own threshold, for the plan's false-alarm probability
"volume balance, calibrated"    its score, the threshold from the plan's leak-free records
"diagnose"                      the fused verdict of all registered detectors
"diagnose @ pressures"          the same, given the channels of the view `pressures` alone
"diagnose, quick"               the same verdict, by the detectors down to the one that judges
"volume balance, online"        what its stream has raised by the record's end, samples coming second by second
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from sealscope.calls import nearest
from sealscope.diagnosis.calibration.scorers import CALIBRATED, SCORERS, VIEW, scorer, split_view
from sealscope.diagnosis.registry import detectors
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS

DIAGNOSE = "diagnose"
_OWN, _QUICK, _ONLINE = ", own threshold", ", quick", ", online"
#: Detectors that have a stream which raises alarms at a stated rate.
_STREAMED = ("volume balance",)
#: name -> channels; the name "" stands for what detectors see that name no view.
Views = Mapping[str, tuple[str, ...]]
#: Channels that detectors see by default: all but the flow meter of the bypass, which is no part of the machine.
ALL_CHANNELS = tuple(name for name in CHANNEL_UNITS if name != "q_leak")


@dataclass(frozen=True)
class PlanDetector:
    """One name of a plan's `detectors`, parsed.

    `of`: the scorer, the detector or `diagnose`; `own`: whether its verdict is by its own threshold; `detector`:
    whether it is a registered detector or `diagnose`; `view`: the set of channels it sees, "" where none is named;
    `quick`: whether it ends at the detector that judges (`diagnose(..., quick=True)`); `online`: whether it is the
    detector's stream.
    """

    name: str
    of: str
    own: bool
    detector: bool
    view: str
    quick: bool = False
    online: bool = False

    @property
    def key(self) -> str:
        """The name under which its statement is stored: the same for its own and for a calibrated threshold."""
        of = f"{self.of}{_QUICK if self.quick else ''}{_ONLINE if self.online else ''}"
        return f"{of}{VIEW}{self.view}" if self.view else of

    @property
    def needs_calibration(self) -> bool:
        """Whether leak-free records must set its threshold."""
        return not self.own and (self.detector or scorer(self.of).threshold is None)


@cache
def plan_detector(name: str) -> PlanDetector:
    """Parse a detector's name, known or not."""
    base, view = split_view(name)
    if base in SCORERS and not base.endswith((_OWN, CALIBRATED)):
        return PlanDetector(name, base, False, False, view)
    if base.endswith(CALIBRATED):
        return PlanDetector(name, base.removesuffix(CALIBRATED), False, True, view)
    quick, online = base == f"{DIAGNOSE}{_QUICK}", base.endswith(_ONLINE)
    of = base.removesuffix(_QUICK if quick else _ONLINE if online else _OWN)
    return PlanDetector(name, of, True, True, view, quick, online)


def check_detector(name: str, views: Views) -> None:
    """Raise InputError for a name that is no detector, or names an unknown view."""
    parsed = plan_detector(name)
    if parsed.view and parsed.view not in views:
        known_views = ", ".join(view for view in views if view) or "none"
        raise InputError(f"what stands behind '@' must be one of [views] ({known_views}), got {name!r}")
    if not parsed.detector:
        return
    known = [DIAGNOSE, *detectors()]
    if parsed.of == DIAGNOSE and not parsed.own:
        raise InputError(f"{DIAGNOSE!r} has no score of its own and cannot be calibrated, got {name!r}")
    if parsed.online and parsed.of not in _STREAMED:
        raise InputError(f"online must be one of {', '.join(_STREAMED)}, got {name!r}")
    if parsed.of in known:
        return
    choices = [*SCORERS, *known, *(f"{detector}{CALIBRATED}" for detector in known[1:])]
    near = nearest(split_view(name)[0], choices, share=0.6)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(
        f"a detector must be one of {', '.join(known)}, or a scorer's name such as 'd3 of p_A fell', got {name!r}{hint}"
    )
