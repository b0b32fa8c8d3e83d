"""Results of hold tests in the diagnosis of a recording of a held load, and read back from JSON lines.

Healthy results are part of a commissioned machine, and later ones are compared with them, as recordings are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.population import ScatterPrior, estimate_variance
from sealscope.diagnosis.healthy import Magnitude, Number, Positive, SummarisedRecording, Summary
from sealscope.diagnosis.hold.judgement import COOLING, format_estimate
from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.priors.trend import TREND
from sealscope.diagnosis.verdict.evidence import TotalLeakage
from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.formats.times.timebase import parse_epoch
from sealscope.storage.plain_values import convert_type, parse_json
from sealscope.units import BAR

#: Next check where hold tests show a growing leak.
SEPARATE_LEAKS = (
    "Look for oil outside: rod seal, fittings, hoses. If there is none, cap the port of the loaded side at the "
    "cylinder and hold again: if it sinks as before, the piston leaks, else the valve or its line."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class HoldSummary(Summary):
    """Leak `lpm` of the longest healthy hold with half its 95 % interval `half_lpm` [L/min], at the pressure `bar`."""

    method: ClassVar[str] = "hold test"

    lpm: Number
    half_lpm: Magnitude
    bar: Positive


class HeldGrowth(NamedTuple):
    """Growth of the leak of a held load over that of `n_healthy` healthy holds, at the same pressure.

    `ratio`: leak over that of the healthy holds; `low`, `high`: its 95 % interval.
    """

    ratio: float
    low: float
    high: float
    n_healthy: int


def summarise_hold(holds: Sequence[HoldResult]) -> HoldSummary | None:
    """Summarise the longest hold of a healthy recording for `estimate_growth`; None if its leak is unknown."""
    leakage = held_leakage(holds) if holds else None
    if leakage is None or leakage.lpm is None or leakage.interval_lpm is None or not leakage.pressure > 0.0:
        return None
    low, high = leakage.interval_lpm
    return HoldSummary(lpm=leakage.lpm, half_lpm=0.5 * (high - low), bar=leakage.pressure / BAR)


def date_hold(result: HoldResult) -> float | None:
    """Return the time at which a hold begins [s since 1970]; None if its recording states no date."""
    start = None if result.start is None else parse_epoch(result.start)
    return None if start is None else start + (result.start_s or 0.0)


def summarise_result(result: HoldResult) -> SummarisedRecording:
    """Summarise the result of a healthy hold test as a recording without channels, for `estimate_growth` alone.

    Raises InputError if it states no leak, no pressure or no duration.
    """
    summary, seconds = summarise_hold([result]), (result.end_s or 0.0) - (result.start_s or 0.0)
    if summary is None or not seconds > 0.0:
        raise InputError(f"a healthy hold test must state leak and pressure (--area), got neither ({result.file})")
    table = summary.table()
    digest = sha256(f"{result.start} {result.start_s} {table}".encode()).hexdigest()
    summaries = {summary.method: table}
    return SummarisedRecording(result.file, digest, {}, 1.0 / seconds, seconds, date_hold(result), summaries)


def estimate_growth(hold: HoldSummary | None, healthy: Sequence[HoldSummary]) -> HeldGrowth | None:
    """Compare a hold with `healthy` ones (`summarise_hold`); None if a leak is unknown or the healthy ones have none.

    Leaks per pressure scatter between healthy tests, by their oil and loads (`between.hold_test` of a trend's priors):
    the interval is that of Student's t, with the degrees of freedom of the prior and of the recordings.
    """
    if hold is None or not healthy:
        return None
    levels = np.array([entry.lpm / entry.bar for entry in healthy])
    halves = np.array([entry.half_lpm / entry.bar for entry in healthy])
    from scipy.special import stdtrit

    n, usual, between = len(levels), float(levels.mean()), TREND.between
    if not usual > float(np.sqrt((halves**2).sum())) / n:
        return None  # a ratio to nothing has no value
    prior = ScatterPrior(between.hold_test * usual, between.freedom)
    variance, freedom = estimate_variance(float(((levels - usual) ** 2).sum()), n, prior)
    scatter = math.sqrt(variance * (1.0 + 1.0 / n))
    half = math.hypot(float(stdtrit(freedom, 0.975)) * scatter, hold.half_lpm / hold.bar)
    level = hold.lpm / hold.bar
    return HeldGrowth(level / usual, (level - half) / usual, (level + half) / usual, n)


def find_shown_leak(holds: Sequence[HoldResult], growth: HeldGrowth | None) -> str | None:
    """Find the reason why holds do not allow `no leak`: a leak above the healthy ones or, without these, any leak."""
    if growth is None:
        is_shown = any(set(hold.causes) - {COOLING} for hold in holds)
        return "the holds show a leak" if is_shown else None
    return "the holds leak more than the healthy ones" if growth.low > 1.0 else None


def describe_holds(holds: Sequence[HoldResult], growth: HeldGrowth | None = None) -> str:
    """Describe a recording of a held load by the results of its holds, and by its `growth` over healthy ones."""
    texts = [hold.reason if hold.result is None else f"{hold.result} ({hold.limit}): {hold.reason}" for hold in holds]
    if growth is not None:
        ratio = format_estimate(growth.ratio, growth.low, growth.high)
        texts.append(f"the leak is {ratio} times that of {growth.n_healthy} healthy holds")
    return "a load held by shut valves (`sealscope hold`): " + "; ".join(texts)


def held_leakage(holds: Sequence[HoldResult]) -> TotalLeakage | None:
    """Return the flow out of the loaded chamber in the longest hold; None if its flow or its pressure is unknown."""
    longest = max(holds, key=lambda hold: (hold.end_s or 0.0) - (hold.start_s or 0.0))
    if longest.leak_lpm is None or longest.pressure_bar is None:
        return None
    return TotalLeakage(longest.leak_lpm, longest.leak_interval_lpm, abs(longest.pressure_bar) * BAR)


@dataclass(frozen=True, kw_only=True)
class _StoredHold:
    """Entries of a JSON line of `sealscope hold` that a trend reads; other entries are ignored."""

    file: str
    start: str | None
    start_s: float | None
    end_s: float | None
    leak_lpm: float | None
    leak_interval_lpm: tuple[float, float] | None
    pressure_bar: float | None
    areas_mm2: tuple[float, ...]


def is_hold_results(path: Path) -> bool:
    """Test whether a file begins as the JSON lines of `sealscope hold`."""
    try:
        with path.open("rb") as content:
            head = content.read(400).lstrip()
    except OSError:
        return False  # the error is reported when the file is read
    return head.startswith(b"{") and b'"creep_mm_per_min"' in head


def read_hold_results(path: Path) -> list[HoldResult]:
    """Read results of hold tests from the JSON lines of `sealscope hold`, without what a trend does not need.

    Raises UnreadableFile if the file cannot be read, InputError for a line that is no result.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeError) as error:
        raise UnreadableFile(f"cannot read {path}: {error}") from None
    results = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                results.append(HoldResult(**vars(convert_type(_StoredHold, parse_json(line)))))
            except ValueError as error:
                raise InputError(
                    f"a line must be a result of a hold test, got {error} ({path}, line {number})"
                ) from None
    return results
