"""Steps of the coefficients of a balance's terms, as observables: rival descriptions of the same residual.

Each says that one coefficient stepped once, at an onset that nobody knows; they differ in their term alone, so that
twice the logarithms of their likelihood ratios compare as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

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
from sealscope.diagnosis.inference.differences import rarity_of_size
from sealscope.diagnosis.inference.leak_law import law_shapes
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.onset import Information, StepTest, step_tests
from sealscope.diagnosis.inference.terms import AIR, BIAS, LEAK, MADE_UP, ORIFICE, PUMP, Equation, Term
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array

#: Name of the data that these observables describe.
VOLUMES = "volumes"
#: A change of the scale of the left side: displacement, angle, speed, or the position behind a valve.
SCALE = "scale"
#: What is lost whatever the pressures are, where the flow has no other zero.
OUTSIDE = "loss to the outside"
#: Coefficients that a worn part can only raise: those of leaks.
_ONE_WAY = ("piston leak", "piston or pump leak", "pump leak", "external leak")


def volume_observables(
    blocks: Blocks,
    plain: Blocks,
    balances: Sequence[Equation],
    columns: Sequence[Columns],
    lost: Mapping[str, StepTest],
) -> tuple[Observable, ...]:
    """Test every term's coefficient for a step, up or down; leaks only grow.

    Parameters
    ----------
    blocks : Blocks
        About the zero of p_A - p_B that a change of the leak shows: leaks are tested on these.
    plain : Blocks
        About the zero as recorded: all other terms are tested on these.
    balances, columns : sequence of Equation, of Columns
    lost : mapping of str to StepTest
        What the accumulator lost, by the name of the external leak's term.

    Returns
    -------
    tuple of Observable
        The largest score first.
    """
    centred, recorded = (series.merged(priors("inference")["blocks"]["coarse"]) for series in (blocks, plain))
    first = columns[0]
    orifice = first.names.index(ORIFICE)
    tests: list[tuple[str, Sequence[float], Information, Array | None]] = []
    for index, term in enumerate(balances[0].terms):
        if not _is_tested(term, index, first, bool(lost)):
            continue
        coarse = centred if term.name in (LEAK, PUMP) else recorded
        both: Sequence[float] = (1.0,) if term.cause in _ONE_WAY and term.name != BIAS else (1.0, -1.0)
        tests.append((_name_of(term), both, information(coarse, columns, index), None))
    leak = information(centred, columns, first.leak)
    shapes = law_shapes(centred, columns).items()
    tests += [(f"{LEAK} of exponent {exponent:g}", (1.0,), leak, shape) for exponent, shape in shapes if exponent < 1.0]
    scaled = information(_with_scale(recorded, columns, orifice), columns, orifice)
    tests.append((SCALE, (1.0, -1.0), scaled, None))
    cost = cost_of_zero(zero_of(blocks, columns))
    observables = []
    for name, signs, values, shape in tests:
        steps = step_tests(values, signs, shape)
        if not steps:
            continue
        best = max(range(len(steps)), key=lambda k: steps[k].score)
        step = steps[best]
        advantage = 0.0
        if name.startswith(LEAK) or name == PUMP:
            advantage = -cost
        elif name == SCALE:
            advantage = -rarity_of_size("scale", step.fitted[0])
        elif name == OUTSIDE:
            advantage = -rarity_of_size("outside", step.fitted[0], above=True)
        elif name.startswith("external leak"):
            stored = lost.get(name.removesuffix(MADE_UP))
            advantage = 0.0 if stored is None else _agreement(step, stored)
            flow = step.fitted[0] * _mean_increment(recorded, first, name)
            advantage -= rarity_of_size("outside", flow, above=True)
        observables.append(
            Observable.of_test(name, VOLUMES, step, looks=len(steps), sign=signs[best], advantage=advantage)
        )
    return tuple(sorted(observables, key=lambda observable: -observable.score))


def _is_tested(term: Term, index: int, columns: Columns, has_lost: bool) -> bool:
    """Test whether a term's coefficient is to be tested by itself."""
    if term.drift == "motion" and index in columns.motion and term.name.startswith("motion"):
        return False  # area and displacement change together, as a scale
    if term.compared or term.name == ORIFICE:
        return False  # zero within a recording; by its shape
    if AIR in columns.names and term.cause == "air in the oil" and term.nuisance:
        return False  # free air changes them together
    return not (has_lost and term.name == BIAS)  # an accumulator's pressure drives what leaves its circuit


def _name_of(term: Term) -> str:
    if term.name != BIAS:
        return term.name
    return OUTSIDE if term.cause == "external leak" else "zero of the flow"


def _mean_increment(blocks: Blocks, columns: Columns, name: str) -> float:
    """Compute the root mean square of a term's increments over that of time: a mean pressure [Pa]."""
    if columns.bias is None:
        return float(np.mean(blocks.driving()))
    energy = np.einsum("keii->i", blocks.gram)
    return float(np.sqrt(energy[columns.names.index(name)] / energy[columns.bias]))


def _agreement(test: StepTest, stored: StepTest) -> float:
    """Compute twice the log likelihood of what the accumulator lost with a step, over that of none."""
    nearest = int(np.abs(stored.onsets - test.onsets[test.best]).argmin())
    lost, expected = np.array([stored.size[nearest], test.fitted[0]]) / stored.deviation[nearest]
    return float(lost**2 - (lost - expected) ** 2)


def _with_scale(blocks: Blocks, columns: Sequence[Columns], index: int) -> Blocks:
    """Replace one column by the fitted motion: its coefficient is then the motion's scale."""
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
