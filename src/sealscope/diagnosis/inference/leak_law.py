"""A step of the leak under laws between laminar and an orifice's, in blocks of a conductance.

A leak c |p_A - p_B|^e beside what pump and piston pass anyway adds to a block's conductance c r_k, with r_k the
regression of the law's flow on the pressure difference within the block. So one test of a step, its size in each block
in proportion to r_k, serves every law, and the laminar leakage of pump and piston stays what it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns
from sealscope.diagnosis.inference.onset import Information, StepTest, step_test
from sealscope.diagnosis.inference.terms import ORIFICE
from sealscope.recordings.recording import Array

#: Exponents of the pressure difference that are tried.
EXPONENTS = (1.0, 0.75, 0.5)


class LeakLaw(NamedTuple):
    """The test of a step under a law of an `exponent`, and the mean flow of a unit of it in each block (K,)."""

    exponent: float
    test: StepTest
    driving: Array


def law_shapes(blocks: Blocks, columns: Sequence[Columns]) -> dict[float, Array]:
    """Compute what a leak of each exponent adds to the conductance of each block, shapes (K,).

    Between laminar and orifice by interpolation of the logarithm.
    """
    leak, orifice = columns[0].leak, columns[0].names.index(ORIFICE)
    gram = blocks.gram.sum(axis=1)
    energy = np.maximum(gram[:, leak, leak], np.finfo(float).tiny)
    root = np.maximum(gram[:, orifice, leak] / energy, np.finfo(float).tiny)
    return {exponent: root ** (2.0 * (1.0 - exponent)) for exponent in EXPONENTS}


def leak_laws(blocks: Blocks, columns: Sequence[Columns], leak: Information) -> tuple[LeakLaw, ...]:
    """Test a step of the leak under each law; none where too few blocks say anything."""
    pressure, root = blocks.driving(), blocks.driving(root=True)
    laws = []
    for exponent, shape in law_shapes(blocks, columns).items():
        test = step_test(leak, shape=shape if exponent < 1.0 else None)
        if test is not None:
            share = 2.0 * (1.0 - exponent)
            laws.append(LeakLaw(exponent, test, pressure ** (1.0 - share) * root**share))
    return tuple(laws)
