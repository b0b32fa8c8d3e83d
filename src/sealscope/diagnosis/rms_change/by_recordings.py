"""RMS of the details of one recording against that of leak-free ones, by the mixed model of recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sealscope.diagnosis.baseline.mixed_model import FEWEST_FOR_COVARIATE, BaselineModel, Prediction, Prior, Spread
from sealscope.diagnosis.baseline.operating_point import LEVEL_RATIO, OperatingPoint, operating_point
from sealscope.diagnosis.baseline.sessions import Sessions, Times, sessions_of, start_seconds
from sealscope.diagnosis.rms_change.blocks import JUDGED, QUANTITIES, whole_log_rms
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.errors import InputError
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.filters import IntArray

#: What is assumed of the log RMS of a detail; `docs/decisions/0020-baselines.md` says where each figure comes from.
PRIOR = Prior(
    scatter=Spread(0.01, 2.0),
    drift=Spread(0.11, 4.0),
    drift_time=3600.0,
    session=Spread(0.35, 2.0),
    specimen=Spread(0.35, 8.0),
)
#: A change of log RMS that has to be found before `no leak` is said: the mean change of d3 of p_A in the thesis's
#: Appendix C, by 19 %.
WORTH_FINDING = 0.2
#: Recordings of a session that show how it drifts after them; where there are fewer, a later recording that differs may
#: as well be of another session.
FEWEST_OF_SESSION = 10
#: How far outside the baseline's range of levels a recording may lie, as a share of the range.
LEVEL_MARGIN = 0.25
#: Scatter of the log RMS between recordings below which they are copies of one another.
_LEAST_SCATTER = 1e-9
#: What a reason adds where d1 changed.
WITHOUT_NOISE = "; the noise (d1) changed too, and was taken out of the other details"


def outside_levels(point: OperatingPoint, levels: Array) -> str | None:
    """Return why the pressure level of a recording lies outside those (n,) of leak-free ones, None where it does not.

    From `FEWEST_FOR_COVARIATE` recordings on it may lie a share of their range outside, as they tell how the details
    follow the level.
    """
    margin = float(np.log(LEVEL_RATIO))
    if len(levels) < FEWEST_FOR_COVARIATE:
        outside = bool(np.all(np.abs(levels - point.level) > margin))
    else:
        margin = max(LEVEL_MARGIN * float(np.ptp(levels)), margin)
        outside = not levels.min() - margin <= point.level <= levels.max() + margin
    if not outside:
        return None
    return (
        f"the pressure level, {np.exp(point.level):.4g} {point.units[0]} rms, lies outside that of the "
        f"{len(levels)} comparable baseline recordings, {np.exp(levels.min()):.4g} to {np.exp(levels.max()):.4g}"
    )


def normal_threshold(probability: float) -> float:
    """Return what a standard normal deviate exceeds with `probability`, both tails together."""
    from scipy.special import ndtri

    return float(-ndtri(probability / 2.0))


@dataclass(frozen=True)
class _Judged:
    """The judged quantities of a recording, and the model of the leak-free ones.

    `values` (f,), their `inflation` (f,) of all standard deviations, `unit`: a change of log RMS by 1 in their unit.
    """

    model: BaselineModel
    columns: IntArray
    values: Array
    inflation: Array
    unit: float

    def z(self, prediction: Prediction) -> Array:
        """Return the deviates of the judged quantities."""
        return np.asarray(prediction.z(self.values, self.inflation)[self.columns])

    def smallest_found(self, prediction: Prediction, threshold: float) -> float:
        """Return the smallest change of log RMS that would be found."""
        return float(np.min((prediction.half_width(threshold) * self.inflation)[self.columns])) / self.unit


@dataclass(frozen=True, eq=False)
class LeakFree:
    """What is compared of n leak-free recordings: all that a calibration has to keep of them.

    `log_rms` (n, 5 per chamber); `levels` (n,): log pressure levels; `times`: when they were made.
    """

    log_rms: Array
    levels: Array
    times: Times

    @classmethod
    def of(cls, recordings: Sequence[Recording]) -> LeakFree:
        """Return it of recordings of one operating point."""
        return cls(
            np.stack([whole_log_rms(leak_free) for leak_free in recordings]),
            np.array([operating_point(leak_free).level for leak_free in recordings]),
            Times.of(recordings),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain JSON values."""
        return {
            "log_rms": self.log_rms.tolist(),
            "levels": self.levels.tolist(),
            "starts": list(self.times.starts),
            "lengths": list(self.times.lengths),
        }

    @classmethod
    def of_dict(cls, tree: Mapping[str, Any]) -> LeakFree:
        """Return it of what `as_dict` gave."""
        times = Times(tuple(tree["starts"]), tuple(map(float, tree["lengths"])))
        own = cls(np.array(tree["log_rms"], dtype=float), np.array(tree["levels"], dtype=float), times)
        if own.log_rms.ndim != 2 or {len(own.log_rms), len(times.starts)} != {len(own.levels), len(times.lengths)}:
            raise InputError("leak-free recordings must have a level, a start and a length each")
        return own


def by_recordings(recording: Recording, leak_free: LeakFree, probability: float) -> Evidence:
    """Evidence from the distribution of one more recording, given leak-free ones of its operating point.

    `leak`: the recording is not of
    that distribution, whichever session it may belong to. `no leak`: it is, and a change `WORTH_FINDING` would have
    been found, or it is of a session of the baseline and differs no more than a repetition would. Else `cannot tell`:
    it differs as drift, another session or another machine would, too.
    """
    from scipy.special import ndtr

    known, measured = leak_free.log_rms, whole_log_rms(recording)
    point, levels = operating_point(recording), leak_free.levels
    level = point.level
    if (refusal := outside_levels(point, levels)) is not None:
        return Evidence("cannot tell", refusal)
    sessions = sessions_of(start_seconds(recording), leak_free.times, single_strokes=point.direction != 0)
    copies = len(known) > 1 and np.any(np.ptp(known, axis=0) < _LEAST_SCATTER)
    if copies or not np.all(np.isfinite(measured)) or not np.all(np.isfinite(known)):
        return Evidence(
            "cannot tell",
            f"the {len(known)} comparable baseline recordings do not scatter, or a pressure does not move: "
            "nothing to judge a change by",
        )
    names = [f"{quantity} of {chamber}" for chamber in chambers_of(recording) for quantity in QUANTITIES]
    columns = np.array([k for k, name in enumerate(names) if name.split()[0] in JUDGED])
    own, threshold = normal_threshold(probability), normal_threshold(probability / len(columns))
    model = BaselineModel(known, levels, PRIOR, times=sessions.times, sessions=sessions.labels)
    shown = _shown(sessions)
    expected = model.predict(level, sessions.time, shown)
    changes, single = measured - expected.mean, expected.z(measured)
    parts = parts_against(names, single, np.full(len(names), own), changes)
    judged = _Judged(model, columns, measured, np.ones(len(names)), 1.0)
    noisy = any(single[k] > own for k, name in enumerate(names) if name.startswith("d1 "))
    if noisy:
        judged = _beyond_noise(known, measured, model, level, columns)
        expected = judged.model.predict(level, sessions.time, shown)
    z = judged.z(expected)
    score = float(np.max(z))
    chance = min(1.0, 2.0 * len(columns) * float(ndtr(-score)))
    chosen = [names[k] for k in columns]
    against = f"against {len(known)} comparable leak-free recording{'s' if len(known) > 1 else ''}"
    figures = f"largest deviation {score:.1f}, threshold {threshold:.1f}"
    note = WITHOUT_NOISE if noisy else ""
    if score > threshold:
        changed = largest_changes(chosen, z, changes[columns], np.full(len(z), threshold))
        return Evidence("leak", f"{changed} {against} ({figures}){note}", score, threshold, parts=parts, chance=chance)
    smallest = judged.smallest_found(expected, threshold)
    percent = float(100.0 * np.expm1(smallest))
    sensitivity = f"a change of {percent:.{0 if percent >= 10 else 1}f} % would have been found"
    if smallest <= WORTH_FINDING:
        reason = f"no change of the details' RMS {against} ({figures}; {sensitivity}){note}"
        return Evidence("no leak", reason, score, threshold, parts=parts, chance=chance)
    repetitions = _repetitions(sessions)
    if not repetitions:
        reason = f"no change of the details' RMS {against}, but only {sensitivity} ({figures}){note}"
        return Evidence("cannot tell", reason, score, threshold, parts=parts, chance=chance)
    near = [judged.z(judged.model.predict(level, time, label)) for time, label in repetitions]
    nearest = int(np.argmin([np.max(own_z) for own_z in near]))
    if np.max(near[nearest]) <= threshold:
        reason = f"no change of the details' RMS {against} beyond that of a repetition ({figures}){note}"
        if sessions.label is not None:
            return Evidence("no leak", reason, score, threshold, parts=parts, chance=chance)
        reason += f"; but it may be of another session or of another machine, and then only {sensitivity}"
        return Evidence("cannot tell", reason, score, threshold, parts=parts, chance=chance)
    changes = measured - model.predict(level, *repetitions[nearest]).mean
    changed = largest_changes(chosen, near[nearest], changes[columns], np.full(len(z), threshold))
    reason = f"{changed} {against}: {_possible(sessions)} ({figures}; only {sensitivity}){note}"
    return Evidence("cannot tell", reason, score, threshold, parts=parts, chance=chance)


def _shown(sessions: Sessions) -> int | None:
    """Return the recording's session where the baseline shows its drift: by enough of it, or all around."""
    if sessions.labels is None or sessions.times is None or sessions.label is None or sessions.time is None:
        return None
    times = sessions.times[sessions.labels == sessions.label]
    margin = 0.1 * float(np.ptp(times))
    around = times.min() - margin <= sessions.time <= times.max() + margin
    return sessions.label if around or times.size >= FEWEST_OF_SESSION else None


def _repetitions(sessions: Sessions) -> list[tuple[float, int]]:
    """Return time and session of a recording right after the last one of each session of the baseline."""
    if sessions.times is None or sessions.labels is None:
        return []
    labels = np.unique(sessions.labels)
    return [(float(sessions.times[sessions.labels == label].max()), int(label)) for label in labels]


def _possible(sessions: Sessions) -> str:
    """Return what a difference from the baseline may come from where it is no leak beyond doubt."""
    if sessions.label is not None:
        return "differs from the baseline: drift since then (temperature), or wear"
    count = len(np.unique(sessions.labels)) if sessions.labels is not None else 0
    known = f"{count} session{'s' if count > 1 else ''}"
    return f"differs from the baseline: another machine, temperature or wear, which {known} cannot tell apart"


def _beyond_noise(known: Array, measured: Array, model: BaselineModel, level: float, columns: IntArray) -> _Judged:
    """Return the judged quantities' energy beyond that of their chamber's d1, which white noise raises alike.

    It is relative to the energy that is expected of the quantity at its pressure level. More noise means more scatter
    of the energy, in proportion to it.
    """
    noise = columns - columns % len(QUANTITIES)
    fitted, expected = model.fitted[:, columns], model.at(level)[columns]
    before = np.exp(2.0 * (known[:, columns] - fitted)) - np.exp(2.0 * (known[:, noise] - fitted))
    after = np.exp(2.0 * (measured[columns] - expected)) - np.exp(2.0 * (measured[noise] - expected))
    added = np.exp(2.0 * (measured[noise] - expected)) - np.exp(2.0 * (model.at(level)[noise] - expected))
    energies = BaselineModel(
        before, np.zeros(len(known)), model.prior.scaled(2.0), times=model.times, sessions=model.sessions
    )
    return _Judged(energies, np.arange(len(columns)), after, 1.0 + np.maximum(added, 0.0), 2.0)


def parts_against(names: list[str], scores: Array, thresholds: Array, changes: Array) -> tuple[Evidence, ...]:
    """Return the evidence of each quantity against its threshold."""
    return tuple(
        part(name, float(scores[k]), thresholds[k], f"{100 * np.expm1(changes[k]):+.1f} % against the baseline")
        for k, name in enumerate(names)
    )


def part(name: str, score: float, threshold: float, reason: str) -> Evidence:
    """Return one quantity's evidence; a change of d1 alone is a change of the noise, never a leak."""
    verdict: Verdict = "no leak"
    if abs(score) > threshold:
        verdict = "cannot tell" if name.startswith("d1 ") else "leak"
    return Evidence(verdict, reason, abs(score), float(threshold), detector=f"RMS of {name}")


def change_text(name: str, change: float) -> str:
    """Return a change of log RMS as text."""
    percent = 100.0 * np.expm1(change)
    return f"RMS of {name} {'rose' if percent > 0 else 'fell'} by {abs(percent):.1f} %"


def largest_changes(names: list[str], single: Array, changes: Array, thresholds: Array) -> str:
    """Return the significant changes as text, the clearest first, at most three."""
    order = [k for k in np.argsort(-np.abs(single) / thresholds) if not names[k].startswith("d3d4")]
    significant = [k for k in order if abs(single[k]) > thresholds[k]][:3] or order[:1]
    return ", ".join(change_text(names[k], float(changes[k])) for k in significant)
