"""Thresholds of detectors for a false-alarm probability, set on leak-free recordings, and their files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from sealscope.diagnosis.baseline.operating_point import LEVEL_RATIO, OperatingPoint, difference, operating_point
from sealscope.diagnosis.baseline.sessions import Times, sessions_of
from sealscope.diagnosis.calibration.scorers import scorer, split_view
from sealscope.diagnosis.rms_change.by_recordings import LeakFree
from sealscope.errors import InputError, UnreadableFile
from sealscope.evaluation.thresholds import (
    FEWEST,
    LevelWander,
    Promise,
    Threshold,
    predictive_threshold,
    quantile_threshold,
    records_needed,
)
from sealscope.recordings.recording import Recording
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import open_regular, whole
from sealscope.storage.plain_values import as_type, parse_json

FORMAT = "sealscope calibration 2"
#: How far outside the calibrated pressure levels a recording may lie: this share of their range, and this ratio.
LEVEL_MARGIN = 0.25
#: How far the length of a recording may differ from those calibrated with, as a ratio: scores of short recordings
#: scatter more.
DURATION_RATIO = 1.1
#: The detector that judges single strokes by the leak-free ones themselves.
BY_STROKES = "rms change"
#: How far the mean of a score moves after the recordings of a session, in deviations of its scatter.
WANDER = LevelWander(scale=3.0, freedom=4.0)
_LARGEST_FILE = 50_000_000
#: Largest logarithm of a pressure: its exponential is still a number.
_LARGEST_LEVEL = 350.0


@dataclass(frozen=True)
class Place:
    """Where a recording was made: its operating point, and its length [s]."""

    point: OperatingPoint
    duration_s: float

    @classmethod
    def of(cls, part: Recording) -> Place:
        """Return the place of a recording without missing samples."""
        return cls(operating_point(part), part.duration)


@dataclass(frozen=True)
class Group:
    """One calibrated operating point.

    The `point` of its first recording, the ranges of all `records`, and the threshold of each detector (none where too
    few of them have a score). `leak_free`: of single strokes, what `rms change` compares a stroke with, by a threshold
    of its own; they are too short to hold a change.
    """

    point: OperatingPoint
    records: int
    levels: tuple[float, float]
    durations_s: tuple[float, float]
    thresholds: Mapping[str, Threshold]
    leak_free: LeakFree | None = None

    def judges(self, name: str) -> bool:
        """Return whether a detector has a verdict at this operating point."""
        return name in self.thresholds or (name == BY_STROKES and self.leak_free is not None)

    def refuses(self, place: Place) -> str | None:
        """Return why a recording is outside of this operating point, None where it is inside."""
        other = difference(place.point, self.point)
        if other is not None:
            return other
        low, high = self.levels
        margin = max(LEVEL_MARGIN * (high - low), math.log(LEVEL_RATIO))
        if not low - margin <= place.point.level <= high + margin:
            ratio = math.exp(place.point.level - (low if place.point.level < low else high))
            return f"another pressure level ({ratio:.2g} times the nearest calibrated one)"
        short, long = self.durations_s
        if not short / DURATION_RATIO <= place.duration_s <= long * DURATION_RATIO:
            return f"another length ({place.duration_s:.4g} s, calibrated with {_span(short, long, 's')})"
        return None


@dataclass(frozen=True)
class Calibration:
    """Thresholds of `detectors` for a `false_alarm_probability`, by operating point.

    The first detector makes the verdict, so that the probability is the verdict's own; the others are stated beside it.
    `split_share`: where detectors that compare two sides of a moment split a recording, as a share of its length.
    `made_from`: plain values that say which recordings or which campaign it was made from; `views`: name -> channels,
    for detectors that saw no other (`rms change @ pressures`).
    """

    false_alarm_probability: float
    promise: Promise
    confidence: float
    detectors: tuple[str, ...]
    split_share: float
    groups: tuple[Group, ...]
    made_from: Mapping[str, Any]
    views: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def find(self, place: Place) -> Group | str:
        """Return the calibrated operating point of a recording, or why it is outside of all, in words."""
        reasons = []
        for group in self.groups:
            reason = group.refuses(place)
            if reason is None:
                return group
            reasons.append(reason)
        # the most telling reason is that of the group that differs last, in its level or length
        late = [reason for reason in reasons if reason.startswith(("another pressure level", "another length"))]
        return f"outside the calibrated operating points: {(late or reasons)[0]}"


def _span(low: float, high: float, unit: str) -> str:
    return f"{low:.4g} {unit}" if math.isclose(low, high, rel_tol=1e-3) else f"{low:.4g} to {high:.4g} {unit}"


def grouped(places: Sequence[Place]) -> list[list[int]]:
    """Return the indices of the recordings of each operating point, both in the order given.

    Pressure levels are not distinguished, lengths within a tenth are alike.
    """
    groups: list[list[int]] = []
    for number, place in enumerate(places):
        for group in groups:
            first = places[group[0]]
            longer = max(place.duration_s, first.duration_s) / max(min(place.duration_s, first.duration_s), 1e-9)
            if difference(place.point, first.point) is None and longer <= DURATION_RATIO:
                group.append(number)
                break
        else:
            groups.append([number])
    return groups


def _wander(recordings: Sequence[Recording], point: OperatingPoint) -> LevelWander | None:
    """Return how far the mean score may move: of recordings of few sessions, which drift and are of one day."""
    if not recordings:
        return None
    sessions = sessions_of(None, Times.of(recordings), single_strokes=point.direction != 0)
    return None if sessions.exchangeable else WANDER


def calibrate(
    places: Sequence[Place],
    scores: Mapping[str, Sequence[float | None]],
    *,
    false_alarm_probability: float,
    promise: Promise = "average",
    confidence: float = 0.95,
    split_share: float = 0.5,
    made_from: Mapping[str, Any] | None = None,
    views: Mapping[str, Sequence[str]] | None = None,
    recordings: Sequence[Recording] | None = None,
) -> Calibration:
    """Set thresholds by the scores of leak-free recordings.

    `places` (n,): where each was made; `scores`: detector -> (n,) scores, None where it could not tell (such a record
    raises no alarm and counts as the lowest score); `recordings` (n,): the recordings themselves, where they are at
    hand. Each operating point gets, for each detector, the order statistic that keeps the `promise`
    (`evaluation.thresholds`), or, from fewer records and where they are of few sessions, a tail that is extrapolated
    from `FEWEST` scores or more, with `WANDER` of their mean where they are of few sessions. Raises InputError where no
    operating point has enough records, saying how many it takes.
    """
    if not places:
        raise InputError("a calibration needs leak-free recordings, got none")
    if not scores:
        raise InputError("a calibration needs at least one detector, got none")
    seen = {name: tuple(channels) for name, channels in (views or {}).items()}
    for name, values in scores.items():
        _check(name, seen)
        if len(values) != len(places):
            raise InputError(
                f"scores of {name!r} must be as many as the recordings, got {len(values)} for {len(places)}"
            )
    exact = records_needed(false_alarm_probability, confidence if promise == "bound" else None)
    limits = (false_alarm_probability, confidence, promise)
    groups = []
    for members in grouped(places):
        point = places[members[0]].point
        own = [] if recordings is None else [recordings[k] for k in members]
        wander = _wander(own, point)
        thresholds: dict[str, Threshold] = {}
        for name, values in scores.items():
            chosen = scorer(split_view(name)[0])
            if chosen.threshold is not None:
                raise InputError(f"{name!r} has a threshold of its own and cannot be calibrated")
            known = [values[k] for k in members]
            finite = [value for value in known if value is not None]
            if wander is None and finite and len(members) >= exact:
                floor = min(finite)
                thresholds[name] = quantile_threshold([floor if value is None else value for value in known], *limits)
            elif len(finite) >= FEWEST and np.ptp(finite) > 0:
                thresholds[name] = predictive_threshold(finite, *limits, power=chosen.power, wander=wander)
        strokes = None
        if own and point.direction != 0 and len(own) >= FEWEST and BY_STROKES in scores:
            strokes = LeakFree.of(own)
        levels = [places[k].point.level for k in members]
        lengths = [places[k].duration_s for k in members]
        groups.append(
            Group(
                point,
                len(members),
                (min(levels), max(levels)),
                (min(lengths), max(lengths)),
                thresholds,
                strokes if strokes is not None and np.all(np.isfinite(strokes.log_rms)) else None,
            )
        )
    if not any(group.judges(name) for group in groups for name in scores):
        most = max(group.records for group in groups)
        raise InputError(
            f"leak-free recordings must be at least {FEWEST} at an operating point, with scores that differ, got at "
            f"most {most}"
        )
    used = {view: seen[view] for name in scores if (view := split_view(name)[1])}
    return Calibration(
        false_alarm_probability,
        promise,
        confidence,
        tuple(scores),
        split_share,
        tuple(groups),
        dict(made_from or {}),
        used,
    )


def _check(name: str, views: Mapping[str, tuple[str, ...]]) -> None:
    """Raise InputError for a detector that is not known, or sees a set of channels that is not."""
    detector, view = split_view(name)
    scorer(detector)
    if view and not views.get(view):
        raise InputError(f"the channels that {name!r} sees must be known, got none for {view!r}")


def as_dict(calibration: Calibration) -> dict[str, Any]:
    """Return the calibration as plain JSON values."""
    groups = [
        {
            "point": asdict(group.point),
            "records": group.records,
            "levels": list(group.levels),
            "durations_s": list(group.durations_s),
            "thresholds": {name: asdict(threshold) for name, threshold in group.thresholds.items()},
            **({} if group.leak_free is None else {"leak_free": group.leak_free.as_dict()}),
        }
        for group in calibration.groups
    ]
    return {
        "format": FORMAT,
        "false_alarm_rate": calibration.false_alarm_probability,
        "promise": calibration.promise,
        "confidence": calibration.confidence,
        "detectors": list(calibration.detectors),
        "split_share": calibration.split_share,
        "made_from": dict(calibration.made_from),
        **({"views": {k: list(v) for k, v in calibration.views.items()}} if calibration.views else {}),
        "groups": groups,
    }


def save(calibration: Calibration, path: str | os.PathLike[str]) -> None:
    """Write the calibration as JSON, whole or not at all; raises InputError where it cannot be written."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(as_dict(calibration), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def load(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration from a file; raises UnreadableFile, naming the file, where it is none."""
    file = Path(path)
    try:
        with open_regular(file, "a calibration") as opened:
            text = opened.read(_LARGEST_FILE + 1)
        if len(text) > _LARGEST_FILE:
            raise UnreadableFile(f"a calibration must be at most {_LARGEST_FILE} bytes, got more ({file})")
        tree = parse_json(text)
    except OSError as error:
        raise UnreadableFile(f"a calibration must be readable, got: {error.strerror or error} ({file})") from None
    except InputError as error:
        raise UnreadableFile(str(error)) from None
    except ValueError:
        raise UnreadableFile(
            f"a calibration must be a JSON file of sealscope calibrate, got something else ({file})"
        ) from None
    if not isinstance(tree, dict) or tree.get("format") != FORMAT:
        got = tree.get("format") if isinstance(tree, dict) else type(tree).__name__
        raise UnreadableFile(f"a calibration must say format {FORMAT!r}, got {str(got)[:60]!r} ({file})")
    with whole("a calibration", file):
        return _from(tree)


def _from(tree: Mapping[str, Any]) -> Calibration:
    detectors = tuple(str(name) for name in tree["detectors"])
    groups = []
    for group in tree["groups"]:
        thresholds = {str(name): as_type(Threshold, values) for name, values in group["thresholds"].items()}
        for name, threshold in thresholds.items():
            if name not in detectors or not math.isfinite(threshold.value):
                raise InputError(
                    f"a threshold must be a finite number of a listed detector, got {threshold.value} of {name!r}"
                )
        low, high = (float(value) for value in group["levels"])
        if max(abs(low), abs(high)) > _LARGEST_LEVEL:
            raise InputError(f"levels must be logarithms of pressures, got {low}, {high}")
        short, long = (float(value) for value in group["durations_s"])
        point = as_type(OperatingPoint, group["point"])
        if point.rate <= 0 or abs(point.level) > _LARGEST_LEVEL:
            raise InputError(f"an operating point must have a rate > 0 Hz and a level, got {point.rate}, {point.level}")
        strokes = None if group.get("leak_free") is None else LeakFree.of_dict(group["leak_free"])
        groups.append(Group(point, int(group["records"]), (low, high), (short, long), thresholds, strokes))
    views = {str(name): tuple(map(str, channels)) for name, channels in tree.get("views", {}).items()}
    for name in detectors:
        _check(name, views)
    if not detectors or not groups:
        raise InputError("a calibration must have detectors and operating points")
    probability, confidence, split = (float(tree[name]) for name in ("false_alarm_rate", "confidence", "split_share"))
    promise = tree["promise"]
    if promise not in get_args(Promise):
        raise InputError(f"promise must be one of {', '.join(get_args(Promise))}, got {str(promise)[:60]!r}")
    if not (0.0 < probability < 1.0 and 0.0 < confidence < 1.0 and 0.0 < split < 1.0):
        raise InputError("false_alarm_rate, confidence and split_share must be between 0 and 1")
    return Calibration(
        probability,
        promise,
        confidence,
        detectors,
        split,
        tuple(groups),
        dict(tree["made_from"]),
        views,
    )


def with_judge(calibration: Calibration, name: str) -> Calibration:
    """Return the calibration with another of its detectors making the verdict.

    Raises InputError for a detector that it does not hold.
    """
    if name not in calibration.detectors:
        known = ", ".join(calibration.detectors)
        raise InputError(f"the judging detector must be one of {known}, got {name!r}")
    return replace(calibration, detectors=(name, *(other for other in calibration.detectors if other != name)))
