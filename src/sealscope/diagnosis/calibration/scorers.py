"""Scorers: one number of a recording before any threshold, higher where it looks more like a leak.

A threshold comes from leak-free recordings (`thresholds`); a scorer that has one of its own (a bare sign rule, a
detector with a threshold from within the recording) states it as `threshold`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.calls import closest
from sealscope.diagnosis.diagnose import Examination
from sealscope.diagnosis.registry import detectors
from sealscope.diagnosis.rms_change.blocks import QUANTITIES, mean_squares
from sealscope.diagnosis.verdict.evidence import LEAKS, Evidence
from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import details, edge_samples
from sealscope.signals.filters import IntArray

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What is left out at the beginning of a recording: this long, but no more than this share of the first part, so that
#: the machine's start does not stand against its running.
START_SECONDS, START_SHARE = 2.0, 0.05


@dataclass(frozen=True)
class Score:
    """A score, None where the scorer cannot tell (`reason`); `onset_s` [s] where it finds one."""

    value: float | None
    onset_s: float | None = None
    reason: str = ""


def side_bounds(n: int, rate: float, split: int) -> IntArray:
    """Return first and last (exclusive) sample (2, 2) of each side of the sample `split` of `n` at `rate` [Hz].

    Without the start (`START_SECONDS`), and without details that saw the other side or the recording's ends. A side
    that has no sample left ends before it begins.
    """
    before, after = (int(samples) for samples in edge_samples()[-1])
    begin = max(before, int(min(START_SECONDS * rate, START_SHARE * split)))
    return np.array([[begin, split - after], [split + before, n - after]])


@dataclass(frozen=True)
class Sides:
    """Chamber -> log RMS of d1..d4 and d3d4, (5,) each: before the split, after it, over both.

    All that a scorer needs which compares two sides or judges the level, of a recording or of a batch of runs.
    """

    log_rms: Mapping[str, tuple[Array, Array, Array]]

    @classmethod
    def of_squares(cls, squares: Mapping[str, Array], bounds: IntArray) -> Sides:
        """Make them of the mean squares (2, 5) of each chamber's details on the two sides, of `bounds` (2, 2)."""
        log_rms = {}
        with np.errstate(divide="ignore"):
            for chamber, parts in squares.items():
                both = np.average(parts, axis=0, weights=np.diff(bounds)[:, 0])
                log_rms[chamber] = (0.5 * np.log(parts[0]), 0.5 * np.log(parts[1]), 0.5 * np.log(both))
        return cls(log_rms)

    def through(self, channels: Iterable[str]) -> Sides:
        """Return the sides of these of its chambers alone."""
        visible = set(channels)
        return Sides({chamber: values for chamber, values in self.log_rms.items() if chamber in visible})

    def of(self, chamber: str, quantity: str, what: Literal["change", "level"]) -> float | None:
        """Return the change of a quantity's log RMS over the split, or its level; None where it has none."""
        if chamber not in self.log_rms:
            return None
        before, after, both = (float(log_rms[QUANTITIES.index(quantity)]) for log_rms in self.log_rms[chamber])
        value = after - before if what == "change" else both
        return value if math.isfinite(value) else None


class Look:
    """A recording as all scorers see it, each transform computed once.

    `split_s` [s]: the moment on the recording's time axis before and after which it is compared, half-way by default;
    `false_alarm_probability`: what a detector with a threshold of its own sets it for; `rig`: what detectors may
    assume of the machine. The recording is uniformly sampled without missing samples (`baseline.inspection`).
    """

    def __init__(
        self,
        recording: Recording,
        split_s: float | None = None,
        false_alarm_probability: float = 0.01,
        rig: Rig | str = "thesis",
    ) -> None:
        self.recording = recording
        start = float(recording.t[0]) if len(recording) else 0.0
        self.split_s = start + recording.duration / 2 if split_s is None else float(split_s)
        self.examination = Examination(recording, false_alarm_probability=false_alarm_probability, rig=rig)

    def through(self, channels: Iterable[str]) -> Look:
        """Return the same recording with these channels alone; a detector that reads no other is not run again."""
        examination = self.examination.through(channels)
        view = Look(examination.recording, self.split_s, examination.false_alarm_probability)
        view.examination = examination
        return view

    @cached_property
    def sides(self) -> Sides:
        """The log RMS before the split, after it and over both, of each chamber whose two sides have details."""
        recording = self.recording
        n, rate = len(recording), recording.rate
        bounds = side_bounds(n, rate, round((self.split_s - float(recording.t[0])) * rate))
        squares = {}
        for chamber in CHAMBERS if np.diff(bounds).min() > 0 else ():
            if chamber in recording:
                transformed = details(recording[chamber])
                squares[chamber] = np.array([mean_squares(transformed, side)[0] for side in bounds])
        return Sides.of_squares(squares, bounds)

    def evidence(self, detector: str) -> Evidence:
        """Return the evidence of a registered detector, with no baseline."""
        return self.examination.evidence(detector)


@dataclass(frozen=True)
class Scorer:
    """One method of scoring a recording.

    `timing`: whether it compares the two sides of the split, judges the whole, or searches for the onset; `threshold`:
    its own, None where leak-free recordings must set one; `of_sides`: the score from the RMS on both sides alone, None
    where it needs the whole recording; `power`: the power of a score that cannot be negative which is nearly normal.
    """

    name: str
    timing: Literal["split", "whole", "search"]
    about: str
    score: Callable[[Look], Score]
    threshold: float | None = None
    of_sides: Callable[[Sides], Score] | None = None
    power: float = 1.0


#: Powers of scores that are nearly normal: of the size of a normal deviate and of a sum of squares (E. B. Wilson, M. M.
#: Hilferty, Proc. Natl. Acad. Sci. 17 (1931) 684-688), and of a detector's own score, which may be either.
_OF_SIZES, _OF_SQUARES, _OF_ANY = 2.0 / 3.0, 1.0 / 3.0, 1.0 / 2.0


def _on_sides(
    name: str,
    timing: Literal["split", "whole"],
    about: str,
    of_sides: Callable[[Sides], Score],
    threshold: float | None = None,
    power: float = 1.0,
) -> Scorer:
    return Scorer(name, timing, about, lambda look: of_sides(look.sides), threshold, of_sides, power)


def _of_detail(chamber: str, quantity: str, what: Literal["change", "level"], sign: float) -> Callable[[Sides], Score]:
    """Return the score `sign` times the change or level of a quantity's log RMS, its size where `sign` is 0."""

    def score(sides: Sides) -> Score:
        value = sides.of(chamber, quantity, what)
        if value is not None:
            value = sign * value if sign else abs(value)
        return _number(value, f"the {what} of {quantity} of {chamber}")

    return score


def _number(value: float | None, what: str) -> Score:
    if value is None:
        return Score(None, reason=f"{what} cannot be computed: too short, or its reading does not move")
    return Score(value)


def _of_details() -> Iterator[Scorer]:
    """Yield the scorers on one quantity of one chamber."""
    for chamber, quantity in product(CHAMBERS, QUANTITIES):
        name = f"{quantity} of {chamber}"
        for word, sign in (("fell", -1.0), ("rose", 1.0)):
            moved = _of_detail(chamber, quantity, "change", sign)
            about = f"the RMS of {name} {word} after the split, as change of its logarithm"
            yield _on_sides(f"{name} {word}", "split", about, moved)
            yield _on_sides(f"sign rule: {name} {word}", "split", f"{about}; any change at all", moved, 0.0)
        about = f"the RMS of {name} changed either way over the split, as size of the change of its logarithm"
        size = _of_detail(chamber, quantity, "change", 0.0)
        yield _on_sides(f"{name} changed", "split", about, size, power=_OF_SIZES)
        for word, sign in (("low", -1.0), ("high", 1.0)):
            about = f"the RMS of {name} over the whole recording is {word}, as its logarithm"
            yield _on_sides(f"{name} {word}", "whole", about, _of_detail(chamber, quantity, "level", sign))


def _both_products(sides: Sides) -> Score:
    """Score the thesis's cumulative rule: d3d4 fell in chamber A and rose in chamber B, the lesser of both."""
    a, b = (sides.of(chamber, "d3d4", "change") for chamber in CHAMBERS)
    return _number(None if a is None or b is None else min(-a, b), "the change of d3d4 in both chambers")


def _scan(look: Look) -> Score:
    evidence = look.evidence("rms change")
    return Score(evidence.score, evidence.onset_s, evidence.reason)


def _own_scan(look: Look) -> Score:
    evidence = look.evidence("rms change")
    if evidence.verdict == "cannot tell" or evidence.score is None or evidence.threshold is None:
        return Score(None, reason=evidence.reason)
    return Score(evidence.score - evidence.threshold, evidence.onset_s, evidence.reason)


def _all() -> Iterator[Scorer]:
    yield from _of_details()
    both = "d3d4 of both chambers as the thesis says"
    about = "the RMS of d3d4 fell in p_A and rose in p_B, the lesser of both changes"
    yield _on_sides(both, "split", about, _both_products)
    yield _on_sides(f"sign rule: {both}", "split", f"{about}; any change at all", _both_products, 0.0)
    about = "the largest T2 of a step of d2..d4 of both chambers at any instant"
    yield Scorer("rms change", "search", about, _scan, power=_OF_SQUARES)
    about = "T2 less the threshold that random orders of the recording's own blocks with a healthy machine's drift give"
    yield Scorer("rms change, own threshold", "search", about, _own_scan, 0.0)


#: What follows a detector's name where leak-free recordings are to set its threshold, and what stands before the name
#: of a set of channels where it sees those alone.
CALIBRATED, VIEW = ", calibrated", " @ "


def _calibrated(detector: str) -> Scorer:
    """Return the scorer of a registered detector, for a threshold from leak-free recordings.

    It has no score where the detector attributes the change to something else than a piston leak.
    """

    def score(look: Look) -> Score:
        evidence = look.evidence(detector)
        if evidence.score is None or not math.isfinite(evidence.score) or evidence.cause not in (None, *LEAKS):
            return Score(None, reason=evidence.reason)
        return Score(evidence.score, evidence.onset_s, evidence.reason)

    about = f"the score of the detector {detector!r}, against a threshold from leak-free recordings"
    return Scorer(f"{detector}{CALIBRATED}", "search", about, score, power=_OF_ANY)


#: Every scorer by name, but for the calibrated form of the registered detectors.
SCORERS: Mapping[str, Scorer] = MappingProxyType({scorer.name: scorer for scorer in _all()})


def scorer(name: str) -> Scorer:
    """Return the scorer of that name, or a registered detector's with `, calibrated` behind it.

    Raises InputError for a name that is not known.
    """
    if name in SCORERS:
        return SCORERS[name]
    known = detectors()
    if name.endswith(CALIBRATED) and name.removesuffix(CALIBRATED) in known:
        return _calibrated(name.removesuffix(CALIBRATED))
    names = [*SCORERS, *(f"{detector}{CALIBRATED}" for detector in known)]
    hint = closest(repr(str(name)), map(repr, names))
    raise InputError(f"a detector must be a scorer's name such as 'd3 of p_A fell' or 'rms change', got {name!r}{hint}")


def split_view(name: str) -> tuple[str, str]:
    """Return a detector's name and that of the set of channels it sees, "" for all: `rms change @ pressures`."""
    detector, _, view = name.partition(VIEW)
    return detector, view
