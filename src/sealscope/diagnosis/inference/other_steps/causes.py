"""What else stepped? The same likelihood ratio for the coefficient of every term of the balance; causes compete.

Each hypothesis says that one coefficient stepped once, at an onset that nobody knows; they differ in their term alone,
so that twice the logarithms of their likelihood ratios compare as they are. A cause is as likely as its best term,
times its odds beforehand; causes that the channels cannot tell apart share what is left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import (
    Blocks,
    Columns,
    cost_of_zero,
    information,
    solve,
    total,
    zero_of,
)
from sealscope.diagnosis.inference.onset import StepTest, step_test
from sealscope.diagnosis.inference.other_steps.step import OtherStep
from sealscope.diagnosis.inference.terms import AIR, BIAS, LEAK, MADE_UP, ORIFICE, PUMP, Equation
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import LEAKS, Cause

#: A change of the scale of the left side: displacement, angle, speed, or the position behind a valve.
SCALE = "scale"


class StepHypothesis(NamedTuple):
    """The coefficient of a term stepped: its `name`, the `cause`, the test, and what else speaks for it.

    `beside`: twice the logarithm of what is believed of the zero or the size that it needs, and of the likelihood of
    what the accumulator lost over that of none.
    """

    name: str
    cause: Cause
    test: StepTest
    beside: float = 0.0

    @property
    def score(self) -> float:
        """Twice the logarithm of the likelihood ratio, with what else speaks for it."""
        return self.test.score + self.beside


def hypotheses(
    blocks: Blocks,
    plain: Blocks,
    balances: Sequence[Equation],
    columns: Sequence[Columns],
    lost: Mapping[str, StepTest],
) -> tuple[StepHypothesis, ...]:
    """Return the test of every term's coefficient, the most likely first; steps of either sign but of what leaks.

    A leak is tested about the zero of p_A - p_B that its change shows, what else may have stepped in the `plain`
    blocks, whose zero is that of the sensors. Oil that leaves the circuit empties the accumulator as well (`lost`).
    """
    about, recorded = (own.merged(priors("inference")["blocks"]["coarse"]) for own in (blocks, plain))
    tested = []
    for index, term in enumerate(balances[0].terms):
        if term.drift == "motion" and index in columns[0].motion and term.name.startswith("motion"):
            continue  # area and displacement change together, as a scale
        if term.compared:
            continue  # it is zero within a recording
        if AIR in columns[0].names and term.cause == "air in the oil" and term.nuisance:
            continue  # free air changes them together
        if lost and term.name == BIAS:
            continue  # an accumulator's pressure drives what leaves its circuit
        replaced = columns[0].leak if term.name == ORIFICE else None
        coarse = about if term.name in (LEAK, ORIFICE, PUMP) else recorded
        tested.append((term.name, term.cause, information(coarse, columns, index, replaced)))
    orifice = columns[0].names.index(ORIFICE)
    tested.append((SCALE, "sensor fault", information(_with_scale(recorded, columns, orifice), columns, orifice)))
    stepped = []
    root = 2.0 * float(np.mean(blocks.driving(root=True)))  # dp over d sqrt(p)
    of_root = root * zero_of(blocks, columns, orifice) + float(np.mean(blocks.zero))
    # the law of a leak lies between both: it needs the lesser zero of them at least
    cost = min(map(cost_of_zero, (zero_of(blocks, columns), of_root)))
    for name, cause, own in tested:
        one_way = name != BIAS and cause in (*LEAKS, "pump leak", "external leak")
        signs = (1.0,) if one_way else (1.0, -1.0)
        best = step_test(own, signs)
        if best is not None:
            stored = lost.get(name.removesuffix(MADE_UP)) if cause == "external leak" else None
            beside = 0.0 if stored is None else _agree(best, stored)
            if name in (LEAK, ORIFICE, PUMP):
                beside -= cost
            elif name == SCALE:
                beside -= _unlikely("scale", best.fitted[0])
            elif cause == "external leak":
                beside -= _unlikely("outside", best.fitted[0] * _mean_increment(recorded, columns[0], name), above=True)
            stepped.append(StepHypothesis(name, cause, best, beside))
    return tuple(sorted(stepped, key=lambda own: -own.score))


def _unlikely(table: str, step: float, above: bool = False) -> float:
    """Return minus twice the logarithm of what is believed of a step's size, over that of the likeliest one.

    `above`: smaller ones are as likely.
    """
    size, spread = (priors("inference")[table][name] for name in ("size", "spread"))
    away = float(np.log(max(abs(step), np.finfo(float).tiny) / size)) / spread
    return float(max(away, 0.0) ** 2 if above else away**2)


def _mean_increment(blocks: Blocks, columns: Columns, name: str) -> float:
    """Return the root mean square of a term's increments over the rows, beside that of time: a mean pressure [Pa]."""
    if columns.bias is None:
        return float(np.mean(blocks.driving()))
    energy = np.einsum("keii->i", blocks.gram)
    return float(np.sqrt(energy[columns.names.index(name)] / energy[columns.bias]))


def _agree(test: StepTest, stored: StepTest) -> float:
    """Return twice the logarithm of the likelihood of what the accumulator lost, beside that of none."""
    at = int(np.abs(stored.onsets - test.onsets[test.best]).argmin())
    lost, expected = np.array([stored.size[at], test.fitted[0]]) / stored.deviation[at]
    return float(lost**2 - (lost - expected) ** 2)


def _with_scale(blocks: Blocks, columns: Sequence[Columns], index: int) -> Blocks:
    """Return the blocks with the fitted motion in place of one column: its coefficient is the motion's scale."""
    gram = blocks.gram.copy()
    for e, (column, sums) in enumerate(zip(columns, total(blocks, columns), strict=True)):
        chosen, motion = list(column.nuisance), list(column.motion)
        coefficients = np.zeros(len(sums))
        coefficients[chosen] = solve(sums[np.ix_(chosen, chosen)], sums[chosen, column.left])
        turn = np.eye(len(sums))
        turn[:, index] = 0.0
        turn[motion, index] = coefficients[motion]
        gram[:, e] = turn.T @ gram[:, e] @ turn
    return replace(blocks, gram=gram)


def probabilities(
    tested: Sequence[StepHypothesis], other: OtherStep | None = None, share: float = 0.0
) -> dict[Cause, float]:
    """Return the probability of each cause, given that one of them is present, the most probable first.

    A cause is as likely as its best term; what stepped at the same time in what a leak does not move (`other`) speaks
    for its cause, and another duty may change any coefficient with it. A leak of a large `share` of the pump's flow
    slows the piston, and friction changes with its speed: it speaks the less for friction. Logarithms of likelihoods
    are believed to within a share of the largest.
    """
    if not tested:
        return {}
    believed = priors("inference")["causes"]
    terms = [(own.cause, own.test.score, own.beside) for own in tested]
    if other is not None and _coincides(tested[0].test, other):
        with_it = [score for cause, score, _ in terms if other.cause in (cause, "changed duty")]
        slowed = min(max(share, 0.0) / priors("inference")["worth"]["share"], 1.0)
        own = other.score * (1.0 - slowed if other.cause == "friction change" else 1.0)
        terms.append((other.cause, max(*with_it, 0.0, 0.0) + own, 0.0))
    temper = 2.0 * (1.0 + believed["model"] * max(score for _, score, _ in terms))
    logs = dict[Cause, float]()
    for cause, score, beside in terms:
        odds = float(np.log(believed["leak" if cause in (*LEAKS, "pump leak") else cause]))
        logs[cause] = max(odds + score / temper + 0.5 * beside, logs.get(cause, -np.inf))
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {cause: float(np.exp(own - total)) for cause, own in sorted(logs.items(), key=lambda item: -item[1])}


def _coincides(test: StepTest, other: OtherStep) -> bool:
    onset = test.onset()
    return abs(onset.value - other.onset) <= other.doubt + onset.high - onset.low


def stepped(tested: Sequence[StepHypothesis], chance: float, other: OtherStep | None = None) -> Cause | None:
    """Return what stepped beside a leak: the most probable cause, what else stepped (`other`) counted.

    That where a step of its term is as rare as `chance` among so many, or it is the other's; None where nothing is.
    """
    named = next(iter(probabilities(tested, other)), None)
    if tested and other is not None:
        own = named == other.cause if _coincides(tested[0].test, other) else other.score > tested[0].score
        if own:
            return other.cause
    best = max((own.test for own in tested if own.cause == named), key=lambda test: test.score, default=None)
    return named if best is not None and best.chance * len(tested) < chance else None
