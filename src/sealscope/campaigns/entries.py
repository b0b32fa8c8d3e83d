"""What a plan's `detectors` may name: scorers, registered detectors, the fused verdict, each through a set of channels.

"d3 of p_A fell"                a scorer, its threshold from the plan's leak-free records
"volume balance"                a registered detector by its own threshold, for the plan's false-alarm rate
"volume balance, calibrated"    its score, the threshold from the plan's leak-free records
"diagnose"                      the fused verdict of all registered detectors
"diagnose @ pressures"          the same, given the channels of the view `pressures` alone
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from sealscope.campaigns.statement import Statement, finite
from sealscope.diagnosis.calibration.scorers import CALIBRATED, SCORERS, VIEW, Look, Sides, scorer, split_view
from sealscope.diagnosis.plugins import PlugIn
from sealscope.diagnosis.registry import detectors
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS

DIAGNOSE = "diagnose"
_OWN = ", own threshold"
#: name -> channels; the name "" stands for what detectors see that name no view.
Views = Mapping[str, tuple[str, ...]]
#: What detectors may see where a plan says nothing: all but the flow meter of the bypass, which is no part of the
#: machine.
ALL_CHANNELS = tuple(name for name in CHANNEL_UNITS if name != "q_leak")


@dataclass(frozen=True)
class Entry:
    """One name of a plan's `detectors`.

    `of`: the scorer, the detector or `diagnose`; `own`: whether its verdict counts, by its own threshold; `detector`:
    whether it is a registered detector or `diagnose`; `view`: the set of channels it sees, "" where none is named.
    """

    name: str
    of: str
    own: bool
    detector: bool
    view: str

    @property
    def key(self) -> str:
        """The name under which its statement is kept: the same whichever threshold judges it."""
        return f"{self.of}{VIEW}{self.view}" if self.view else self.of

    @property
    def needs_calibration(self) -> bool:
        """Whether leak-free records must set its threshold."""
        return not self.own and (self.detector or scorer(self.of).threshold is None)


@cache
def entry(name: str) -> Entry:
    """What a name stands for, known or not."""
    words, view = split_view(name)
    if words in SCORERS and not words.endswith((_OWN, CALIBRATED)):
        return Entry(name, words, False, False, view)
    if words.endswith(CALIBRATED):
        return Entry(name, words.removesuffix(CALIBRATED), False, True, view)
    return Entry(name, words.removesuffix(_OWN), True, True, view)


def check_entry(name: str, views: Views) -> None:
    """Raise InputError for a name that stands for nothing."""
    found = entry(name)
    if found.view and found.view not in views:
        there = ", ".join(one for one in views if one) or "none"
        raise InputError(f"what stands behind '@' must be one of [views] ({there}), got {name!r}")
    if not found.detector:
        return
    known = [DIAGNOSE, *detectors()]
    if found.of == DIAGNOSE and not found.own:
        raise InputError(f"{DIAGNOSE!r} has no score of its own and cannot be calibrated, got {name!r}")
    if found.of in known:
        return
    import difflib

    choices = [*SCORERS, *known, *(f"{one}{CALIBRATED}" for one in known[1:])]
    near = difflib.get_close_matches(split_view(name)[0], choices, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(
        f"a detector must be one of {', '.join(known)}, or a scorer's name such as 'd3 of p_A fell', got {name!r}{hint}"
    )


def plug_ins_of(entries: Sequence[Entry]) -> dict[str, str]:
    """The detectors of other distributions that the entries run, each with a hash of its source."""
    asked = {one.of for one in entries if one.detector}
    return {
        name: made.fingerprint
        for name, made in detectors().items()
        if isinstance(made, PlugIn) and (name in asked or DIAGNOSE in asked)
    }


def looks(look: Look, entries: Sequence[Entry], views: Views) -> dict[str, Look]:
    """The recording through each view that is asked for; what one detector reads in two of them is examined once."""
    return {view: look.through(views.get(view, ALL_CHANNELS)) for view in dict.fromkeys(one.view for one in entries)}


def stated(
    look: Look, names: Sequence[str], views: Views
) -> tuple[dict[str, tuple[float | None, float | None]], dict[str, Statement]]:
    """Score and onset of each entry, and the statement of each detector under its key; every detector is run once."""
    entries = [entry(name) for name in names]
    seen = looks(look, entries, views)
    scores: dict[str, tuple[float | None, float | None]] = {}
    statements: dict[str, Statement] = {}
    for one in entries:
        through = seen[one.view]
        if one.detector and one.key not in statements:
            examination = through.examination
            evidence = examination.fused() if one.of == DIAGNOSE else examination.evidence(one.of)
            statements[one.key] = Statement.of(evidence)
        if one.own:
            said = statements[one.key]
            scores[one.name] = (_share(said) if one.of == DIAGNOSE else said.rank, said.onset_s)
        else:
            found = scorer(split_view(one.name)[0]).score(through)
            scores[one.name] = (finite(found.value), finite(found.onset_s))
    return scores, statements


def scored(sides: Sides, names: Sequence[str], views: Views) -> dict[str, tuple[float | None, float | None]]:
    """The same scores as `stated` gives, of entries that need no more than the RMS on both sides; none has an onset."""
    scores: dict[str, tuple[float | None, float | None]] = {}
    for name in names:
        one = entry(name)
        of_sides = scorer(one.of).of_sides
        if one.detector or of_sides is None:
            raise InputError(f"a detector scored from the RMS on both sides must need no more, got {name!r}")
        scores[name] = (finite(of_sides(sides.through(views.get(one.view, ALL_CHANNELS))).value), None)
    return scores


def _share(said: Statement) -> float | None:
    """The fused verdict's score as a share of its threshold: the judge is not the same in every record."""
    if said.rank is None or said.threshold is None:
        return None
    return said.rank / said.threshold if said.threshold > 0 else said.rank - said.threshold
