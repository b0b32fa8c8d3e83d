"""Which healthy recordings a machine leaves out, as the others judge them."""

from __future__ import annotations

from typing import Any, cast

import pytest

from sealscope.diagnosis.commissioned.summary import BY_OTHERS, cross_check
from sealscope.diagnosis.healthy import SummarisedRecording
from sealscope.diagnosis.verdict.diagnosis import Diagnosis


class Verdict:
    """The parts of a diagnosis that count here."""

    summary, reason, cause = "leak", "leakage steps up", None

    def __init__(self, verdict: str, onset_s: float | None) -> None:
        self.verdict, self.onset_s = verdict, onset_s


def days(count: int = 6, *, dated: bool = True) -> list[SummarisedRecording]:
    return [
        SummarisedRecording(f"day{k}", str(k), {}, 100.0, 60.0, 86400.0 * k if dated else None, {})
        for k in range(count)
    ]


def names_left(leaking: dict[str, float | None], healthy: list[SummarisedRecording], **options: Any) -> set[str]:
    def judge(recording: SummarisedRecording, _: tuple[SummarisedRecording, ...]) -> Diagnosis:
        is_leak = recording.file in leaking
        return cast(Diagnosis, Verdict("leak" if is_leak else "no leak", leaking.get(recording.file)))

    remaining, reasons = cross_check(healthy, judge, **options)
    noted = {recording.file for recording in remaining if BY_OTHERS in str(recording.about.get("wrong", ""))}
    assert noted | {reason.partition(":")[0] for reason in reasons} == set(leaking)
    return {recording.file for recording in remaining}


@pytest.mark.parametrize(
    ("leaking", "dated", "is_kept"),
    [
        ({"day2": 20.0}, True, True),  # the leak begins on a day after which others are healthy: it would have healed
        ({"day5": 20.0}, True, False),  # on the last day
        ({"day4": 20.0, "day5": None}, True, False),  # and is there on the next day
        ({"day2": None}, True, False),  # leaks throughout, as a recording of another machine would
        ({"day2": 20.0}, False, False),  # nobody knows which recordings are later
    ],
)
def test_a_leak_that_heals_is_none(leaking: dict[str, float | None], dated: bool, is_kept: bool) -> None:
    healthy = days(dated=dated)
    kept = names_left(leaking, healthy)
    assert kept == {recording.file for recording in healthy} - (set() if is_kept else set(leaking))


def test_all_are_kept_if_told_so_or_without_a_healthy_majority() -> None:
    everything = {f"day{k}" for k in range(6)}
    assert names_left({"day5": 20.0}, days(), keep=True) == everything
    assert names_left({"day3": None, "day4": None, "day5": None}, days()) == everything
