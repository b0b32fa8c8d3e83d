"""The questions asked of a recording, how they share the false-alarm probability, and which is answered with a leak."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from sealscope.diagnosis.inference.onset import StepTest
from sealscope.diagnosis.inference.scatter import Rise
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import LEAKS, RAREST, Cause, Evidence, Verdict

SECOND: float = priors("inference")["verdict"]["second"]
#: The three questions, by name.
WITHIN, AGAINST, LEVEL = "within the recording", "against the baseline", "against the rig's file"


class Question(NamedTuple):
    """A question asked: its score and threshold, the chance of the score, its share of the false-alarm probability."""

    name: str
    score: float
    threshold: float
    chance: float
    probability: float


class Answer(NamedTuple):
    """What the questions come to: the verdict, the question that judges, the causes of a step where one was asked."""

    verdict: Verdict
    judging: Question
    causes: dict[Cause, float]


def answer(
    possible: Sequence[Question], causes_of: Callable[[], dict[Cause, float]], bound: float, flow: float
) -> Answer:
    """Return what the questions come to.

    `causes_of` gives the probabilities of what may have stepped within the recording; `bound`: the 95 % upper bound of
    a leak beside the `flow` of the pump [m^3/s].
    """
    yes = next((own for own in possible if own.chance < own.probability), None)
    causes = causes_of() if yes is not None and yes.name == WITHIN else {}
    if yes is not None and (yes.name != WITHIN or is_leak(causes)):
        return Answer("leak", yes, causes)
    enough = bounds_enough(bound, flow) and not may_be_leak(causes)
    return Answer("no leak" if enough else "cannot tell", possible[0], causes)


def bounds_enough(bound: float, flow: float) -> bool:
    """Whether the bound of a leak is small beside the flow of the pump: a larger leak than it shows without it."""
    return flow > 0.0 and bound <= priors("inference")["worth"]["share"] * flow


def bound_text(verdict: Verdict, limit: str, possible: Sequence[Question]) -> str:
    """Return in words what a 95 % bound says; against a baseline it is that of the mean over the recording."""
    limit += " on average" if any(own.name == AGAINST for own in possible) else ""
    return f"no leak above {limit} (95 %)" if verdict == "no leak" else f"a leak of up to {limit} would not show (95 %)"


def questions(
    test: StepTest | None, against: Rise | None, probability: float, level: float | None = None
) -> list[Question]:
    """Return the questions that can be asked, each with its share of the false-alarm probability.

    `level`: that of the leak above a healthy machine's, in deviations.
    """
    from scipy.special import ndtr, ndtri

    possible = []
    second = SECOND * probability if test is not None and (against is not None or level is not None) else 0.0
    if test is not None:
        share = second if against is not None else probability - second
        possible.append(Question(WITHIN, test.score, test.threshold(share), test.chance, share))
    if against is not None:
        share = probability - second
        possible.append(Question(AGAINST, against.score, against.threshold(share), against.chance, share))
    if level is not None:
        share = second or probability
        possible.append(Question(LEVEL, level, float(-ndtri(share)), float(ndtr(-level)), share))
    return possible


def is_leak(causes: dict[Cause, float]) -> bool:
    """Whether a leak past piston or pump is more probable than every other cause; either may be the pump's alone.

    They lie in parallel, and often are one hypothesis under two names: their probabilities do not add.
    """
    pump = causes.get("pump leak", 0.0)
    leak = sum(causes.get(cause, 0.0) for cause in LEAKS)
    others = max((share for cause, share in causes.items() if cause not in (*LEAKS, "pump leak")), default=0.0)
    return max(leak, pump) > others and leak > RAREST * pump


def may_be_leak(causes: dict[Cause, float]) -> bool:
    """Whether a change that has one of these causes may as well be a leak past the piston."""
    sure: float = priors("inference")["verdict"]["sure"]
    return sum(causes.get(own, 0.0) for own in LEAKS) >= 1.0 - sure


def asked(evidence: Evidence, questions: Sequence[Question], judging: Question, what: str) -> Evidence:
    """Return the evidence with the figures of the question that judges, and where there are several with all of them.

    `what`: what the questions are about.
    """
    parts = tuple(
        Evidence(
            "leak" if evidence.verdict == "leak" and own is judging else "no leak",
            f"{what} {own.name}",
            own.score,
            own.threshold,
            detector=own.name,
            chance=max(own.chance, RAREST),
        )
        for own in questions
    )
    return replace(
        evidence,
        score=judging.score,
        threshold=judging.threshold,
        chance=max(judging.chance, RAREST),
        parts=parts if len(parts) > 1 else (),
    )
