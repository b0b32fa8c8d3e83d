"""The names in a plan's `detectors`: scorers, registered detectors and `diagnose`, each on a set of channels.

"d3 of p_A fell"            a scorer, its threshold from the plan's leak-free records
"volume balance"            a registered detector by its own verdict at the plan's false-alarm probability
"diagnose"                  the verdict of `diagnose`
"diagnose @ pressures"      the same, given the channels of the view `pressures` alone
"watch"                     what the watch of the machine has raised by the record's end, second by second
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from sealscope.calls import nearest
from sealscope.campaigns.plans.scorers import SCORERS, Scorer
from sealscope.diagnosis.detectors.registry import detectors
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS

DIAGNOSE = "diagnose"
WATCH = "watch"
_VIEW = " @ "
#: name -> channels; the name "" stands for what detectors see that name no view.
Views = Mapping[str, tuple[str, ...]]
#: Channels that detectors see by default: all but the flow meter of the bypass, which is no part of the machine.
ALL_CHANNELS = tuple(name for name in CHANNEL_UNITS if name != "q_leak")


@dataclass(frozen=True)
class PlanDetector:
    """One name of a plan's `detectors`, parsed.

    `base`: the scorer, the detector, `diagnose` or `watch`; `scorer`: None where it is judged by its own verdict;
    `view`: the set of channels it sees, "" where none is named.
    """

    name: str
    base: str
    view: str
    scorer: Scorer | None = None

    @property
    def needs_threshold(self) -> bool:
        """True if leak-free records must set its threshold."""
        return self.scorer is not None and self.scorer.threshold is None


@cache
def plan_detector(name: str) -> PlanDetector:
    """Parse a detector's name, known or not."""
    base, _, view = name.partition(_VIEW)
    if base in SCORERS:
        return PlanDetector(name, base, view, SCORERS[base])
    return PlanDetector(name, base, view)


def check_detector(name: str, views: Views) -> None:
    """Raise InputError for a name that is no detector, or names an unknown view."""
    parsed = plan_detector(name)
    if parsed.view and parsed.view not in views:
        known_views = ", ".join(view for view in views if view) or "none"
        raise InputError(f"what stands behind '@' must be one of [views] ({known_views}), got {name!r}")
    names = [DIAGNOSE, WATCH, *detectors()]
    if parsed.scorer is not None or parsed.base in names:
        return
    near = nearest(name.partition(_VIEW)[0], [*SCORERS, *names], share=0.6)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(
        f"a detector must be one of {', '.join(names)}, or a scorer's name such as 'd3 of p_A fell', got {name!r}{hint}"
    )
