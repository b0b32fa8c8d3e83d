"""What the transducers' noise does to a model that is led by its readings.

The slopes of what such a model predicts hold the noise that it was led by, and so does what is left of dp, as far as
the model is led more than the machine is shaken. The right sides, products of both, then have a mean that is not zero
where the parameters are those of the machine. Where a machine hardly rings there is little else. This mean is measured
with noise that is drawn, and taken off.

Source: P. Stoica, T. Soderstrom, Bias correction in least-squares identification, International Journal of Control 35
(1982) 449-457.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealscope.diagnosis.pressure_model.tracking.blocks import Blocks
from sealscope.diagnosis.pressure_model.tracking.laws import WORN_SEAL, Law
from sealscope.diagnosis.pressure_model.tracking.steps import ConductanceSteps, PossibleLeak, steps_in
from sealscope.diagnosis.pressure_model.tracking.track import WANDERING, Following, Track
from sealscope.recordings.recording import Array

#: Noise that is drawn, each with its negative, which takes off what is odd in it; and the largest scatter from draw to
#: draw, as a chi square of the information of a block. Beyond, noise makes a piston break away or not.
_PAIRS, _SEED, _AGREE = 3, 20261123, 10.0


def steps_beside_noise(
    blocks: Blocks,
    theta: Array,
    followed: Track,
    law: Law = WORN_SEAL,
    beside: PossibleLeak | None = None,
    warming: bool = False,
) -> ConductanceSteps:
    """Return `steps_in` what was followed, of a model that is led without what noise does to it."""
    speed = blocks.model.speed_amplitude(theta)
    return steps_in(beside_noise(blocks, theta, followed), theta, speed, law=law, beside=beside, warming=warming)


def beside_noise(blocks: Blocks, theta: Array, followed: Track) -> Track:
    """Return what was followed, its right sides without what noise adds; `theta` (14,): the first fit.

    Noise of the variance v of what is left of dp is added to what the model shows, by which it is then led. What is
    left there has the variance rho v: the machine's noise is v / rho, and the mean is proportional to it. A block is as
    it was followed where draws do not agree, and so are all where the model diverges or is not led.
    """
    if not blocks.model.correction > 0.0:
        return followed
    shown = blocks.run(followed.path[None], followed.start)[0]
    drawn = np.random.default_rng(_SEED).normal(0.0, np.sqrt(followed.variance), (_PAIRS, shown.size))
    try:
        quiet, _ = _score(blocks, theta, followed, shown)
        pairs = [[_score(blocks, theta, followed, shown + sign * noise) for sign in (1.0, -1.0)] for noise in drawn]
    except FloatingPointError:
        return followed
    left = np.mean([[variance for _, variance in pair] for pair in pairs])
    each = np.array([(plus + minus) / 2.0 - quiet for (plus, _), (minus, _) in pairs]) / left
    bias = each.mean(axis=0)
    off = (each - bias)[:, :, WANDERING]
    inverse = np.linalg.pinv(followed.N, rcond=1e-12, hermitian=True)
    scatter = np.einsum("dbi,bij,dbj->b", off, inverse, off) / (_PAIRS - 1)
    bias[~(scatter < _AGREE)] = 0.0
    return replace(followed, r=followed.r - bias[:, WANDERING], r_all=followed.r_all - bias)


def _score(blocks: Blocks, theta: Array, followed: Track, readings: Array) -> tuple[Array, float]:
    """Return slopes times what is left (b, 15) of readings (n,) where the model was followed, and its variance."""
    led = replace(blocks, model=replace(blocks.model, readings=readings), dp=readings)
    following = Following(led, theta, followed.start, None, False)
    slopes, _ = following.looked(led, followed.path, np.empty((0, *followed.path.shape)))
    linear = following.linear(slopes[0], slopes, followed.path, 0.0)
    along = np.einsum("bij,bj->bi", linear.N_all[:, :, :-1], followed.path / following.h)
    return (linear.r_all - along) * linear.variance, linear.variance
