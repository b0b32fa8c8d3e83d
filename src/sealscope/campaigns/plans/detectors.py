"""The names in a plan's `detectors`: scorers, registered detectors and `diagnose`, each on a set of channels.

"d3 of p_A fell"            a scorer; the plan's leak-free records set its threshold
"volume balance"            a registered detector, with its own verdict at the plan's false-alarm probability
"diagnose"                  the verdict of `diagnose`
"diagnose @ pressures"      `diagnose` with the channels of the view `pressures` only
"watch"                     the state of the machine's watch at the end of the record
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
#: Channels of each view, by its name; the view "" applies to detectors that name no view.
Views = Mapping[str, tuple[str, ...]]
#: Channels that detectors see by default: all except the test bench's flow meter, which measures the leak itself.
ALL_CHANNELS = tuple(name for name in CHANNEL_UNITS if name != "q_leak")


@dataclass(frozen=True)
class PlanDetector:
    """A detector that a plan names, such as "diagnose @ pressures", split into its parts.

    - `base`: the part before "@"
    - `view`: the part after "@", which names the set of channels that the detector may use, "" if there is no "@"
    - `scorer`: the scorer, a rule that only computes a score; None for a detector that states verdicts itself
    """

    name: str
    base: str
    view: str
    scorer: Scorer | None

    @property
    def needs_threshold(self) -> bool:
        """True if the detector is a scorer without a fixed threshold, so that leak-free records must set it."""
        return self.scorer is not None and self.scorer.threshold is None


@cache
def parse_detector_name(name: str) -> PlanDetector:
    """Split a detector name, such as "diagnose @ pressures", without checking that detector and view exist."""
    base, _, view = name.partition(" @ ")
    return PlanDetector(name, base, view, scorer=SCORERS.get(base))


def check_detector(name: str, views: Views) -> None:
    """Check that a plan's detector, such as "diagnose @ pressures", and its view exist; raise InputError otherwise.

    `views`: channels of each view of the plan, by its name. A name without "@" needs no view.
    """
    parsed = parse_detector_name(name)
    if parsed.view and parsed.view not in views:
        known_views = ", ".join(view for view in views if view) or "none"
        raise InputError(f"the view after '@' must be one of [views] ({known_views}), got {name!r}")
    names = [DIAGNOSE, WATCH, *detectors()]
    if parsed.scorer is not None or parsed.base in names:
        return
    near = nearest(parsed.base, [*SCORERS, *names], share=0.6)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(
        f"a detector must be one of {', '.join(names)}, or a scorer's name such as 'd3 of p_A fell', got {name!r}{hint}"
    )
