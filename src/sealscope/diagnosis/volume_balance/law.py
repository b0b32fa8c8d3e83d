"""The law that a leak follows, and the zero of the pressures on which that depends.

A worn seal passes oil in proportion to the pressure difference, an orifice with its root, and a real leak by some of
each. Under a duty that shows nearly one size of the difference, as friction makes it, the laws are told apart by what
happens about the reversals alone: by some per cent of the leaked volume. There an error of the transducers' zero (10
kPa and more, where the difference is 100 kPa) bends a root as much as the law does. The leak itself shows that error:
no oil leaks without a pressure difference, so what the leaked volume lacks, evenly over time, is conductance times
zero error.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.smooth_drift import DriftStep
from sealscope.diagnosis.volume_balance.blocks import I_AB, I_ROOT
from sealscope.diagnosis.volume_balance.fit import BalanceFit, moved_share
from sealscope.recordings.recording import Array

#: Blocks within this time of the rise [s], and twelve at least, show law and place of the leak.
_REACH = 60.0
#: Usual error of the zero of p_A - p_B, and the largest, as shares of its usual size: beyond, oil leaves for good.
_ZERO, _LARGEST_ZERO = 0.3, 0.5
#: Least mean of the pressure difference, over its usual size, where it never reverses (0.89 and 1 on the rig
#: `single-rod-eha`, about 0 on the bench); zero error of a transducer that is reckoned with there, 5 psi [Pa].
ONE_SIDED, _SENSOR_ZERO = 0.75, 3.5e4
#: Deviation of the share from what the balance does not model (own bench, development families of `strangers`).
_MISSED = 0.03
#: Share of the squares of the integrated noise that passes for a root, and the relative error of that.
_BLUR, _BLUR_ERROR = 0.25, 0.5
#: Probability before the blocks are seen that a leak is laminar, and that it is one through an orifice.
_PURE = 0.4
#: Share of the leak that an uncorrected zero error may pass from one law to the other, over its share of dp.
_BENDS = 5.0


class OrificeShare(NamedTuple):
    """Share of a leak that goes with the root of the pressure difference: mean, and 95 % interval."""

    mean: float
    low: float
    high: float

    @staticmethod
    def seen(share: float, deviation: float) -> OrificeShare:
        """Return the posterior of a share that is seen as `share` with a normal error of that `deviation`.

        Before, a leak is laminar, or through an orifice, with the probability `_PURE` each, and else of any mixture.
        """
        from scipy.special import ndtr, ndtri

        share = min(max(share, -2.0 * deviation), 1.0 + 2.0 * deviation)
        first, last = float(ndtr(-share / deviation)), float(ndtr((1.0 - share) / deviation))
        pure = [
            _PURE / deviation / math.sqrt(2.0 * math.pi) * math.exp(-0.5 * ((end - share) / deviation) ** 2)
            for end in (0.0, 1.0)
        ]
        mixed = (1.0 - 2.0 * _PURE) * (last - first)
        total = sum(pure) + mixed

        def quantile(probability: float) -> float:
            within = (probability * total - pure[0]) / max(mixed, np.finfo(float).tiny)
            if within <= 0.0 or within >= 1.0:
                return float(within >= 1.0)
            return float(np.clip(share + deviation * ndtri(first + within * (last - first)), 0.0, 1.0))

        densities = (math.exp(-0.5 * ((end - share) / deviation) ** 2) for end in (0.0, 1.0))
        at_0, at_1 = densities
        between = share + deviation * (at_0 - at_1) / math.sqrt(2.0 * math.pi) / max(last - first, 1e-300)
        mean = (pure[1] + mixed * between) / total
        return OrificeShare(min(max(mean, 0.0), 1.0), quantile(0.025), quantile(0.975))


def reach(fit: BalanceFit) -> float:
    """Return within which time [s] of a rise the blocks show law and place of a leak."""
    return max(_REACH, 12.0 * fit.blocks.seconds)


def shape_of(fit: BalanceFit, step: DriftStep) -> Array:
    """Return the share (n,) of the leak that is open in each block."""
    lead, width = (0.5 * fit.blocks.seconds, fit.blocks.seconds) if step.rise == 0.0 else (0.0, step.rise)
    return np.clip((fit.blocks.t + lead - step.onset) / width, 0.0, 1.0)


def zero_error(fit: BalanceFit, step: DriftStep) -> float:
    """Return the pressure [Pa] to add to p_A - p_B so that a leak passes nothing without a pressure difference.

    With g and the flow f that nothing explains regressed on the opening of the leak, ``zero = -sense f/g``, drawn
    towards 0 by its own error against the usual zero error. 0 where the sides' areas differ, under a load, and where it
    would be so large that it is no zero error but oil that leaves for good.
    """
    seen = None if fit.unequal or fit.swinging is not None else _apparent_zero(fit, step)
    if seen is None:
        return 0.0
    zero, error = seen
    usual = _ZERO * float(fit.blocks.abs_dp.mean())
    zero *= usual**2 / (usual**2 + error**2)
    return zero if abs(zero) < _LARGEST_ZERO / _ZERO * usual else 0.0


def _apparent_zero(fit: BalanceFit, step: DriftStep) -> tuple[float, float] | None:
    """Return the zero [Pa] that the flow which nothing explains shows, and its error; None where none can be seen."""
    shape = shape_of(fit, step)
    near = np.abs(fit.blocks.t - step.onset - 0.5 * step.rise) < reach(fit) + 0.5 * step.rise
    opening = shape[near] - shape[near].mean()
    spread = float(opening @ opening)
    if near.sum() < 6 or spread == 0.0:
        return None
    slip = fit.slip[near] - fit.slip[near].mean()
    rise, flow = float(opening @ fit.g[near]) / spread, float(opening @ slip) / spread
    if rise <= 0.0:
        return None
    scatter = float(np.sum((slip - flow * opening) ** 2)) / (near.sum() - 2)
    return -fit.sense * flow / rise, math.sqrt(scatter / spread) / rise


def one_sided_share(fit: BalanceFit, step: DriftStep) -> tuple[float, float] | None:
    """Return the share of a leak that goes with the root, and its error, where the pressure difference never reverses.

    About a mean dp the root is ``sqrt(dp)/2 + delta/(2 sqrt(dp))``: half of an orifice's flow is steady, and no
    conductance explains it. With that flow over the conductance's own, ``rho = f/(g dp)``, the share is
    ``2 rho/(1 + rho)``. None where the difference reverses: there the steady halves cancel.
    """
    level, usual = float(fit.blocks.slope[:, I_AB].mean()), float(fit.blocks.abs_dp.mean())
    seen = _apparent_zero(fit, step)
    if seen is None or abs(level) < ONE_SIDED * usual:
        return None
    zero, error = seen
    rho = min(max(zero / level, -0.5), 2.0)
    return 2.0 * rho / (1.0 + rho), 2.0 * math.hypot(error, _SENSOR_ZERO) / abs(level) / (1.0 + rho) ** 2


def orifice_share(fit: BalanceFit, step: DriftStep) -> OrificeShare:
    """Return the share of a leak that goes with the root of the pressure difference.

    The share w is seen as what the coefficient of the root moved by, with the scatter of the blocks, a zero error that
    is left, and what the balance does not model. Noise that dp sums up to in its integral gives a laminar leak a
    coefficient of the root, too: ``N/2`` of the leak, with N the squares of that noise over those of the root beyond
    the integral, if all of the noise were beyond the columns; about half of it is. An orifice has none of this, so
    that ``moved = w + (1 - w) N/4`` (errors in variables: Fuller, Measurement Error Models, 1987, ch. 1).
    """
    moved = moved_share(fit, I_ROOT, step.onset, step.rise, within=reach(fit))
    steady = one_sided_share(fit.without_slopes, step)
    if moved is None:
        return OrificeShare(0.5, 0.0, 1.0) if steady is None else OrificeShare.seen(*steady)
    zero = _BENDS * abs(zero_error(fit, step)) if fit.swinging is None else 2.0 * _SENSOR_ZERO
    bent = zero / float(fit.blocks.abs_dp.mean())
    blurred = min(_BLUR * moved.noise, 0.9)
    deviation = math.hypot(moved.deviation, bent, _BLUR_ERROR * blurred, _MISSED) / (1.0 - blurred)
    share = (moved.share - blurred) / (1.0 - blurred)
    if steady is not None:
        weight = deviation**2 / (deviation**2 + steady[1] ** 2)
        share, deviation = share + weight * (steady[0] - share), deviation * math.sqrt(1.0 - weight)
    return OrificeShare.seen(share, deviation)


def evened(fit: BalanceFit, law: OrificeShare, open_: NDArray[np.bool_]) -> tuple[BalanceFit, Array]:
    """Return the fit with conductances that a leak of this law raises alike in all blocks, and the flow of one of them.

    A leak of the conductance g, the share w of it through an orifice, shows in block k as g e_k with ``e = 1 - w + w
    shown/mean(shown)``: the smaller the pressure difference, the more. Its mean flow there (n,) [m^3/s] is g times ``(1
    - w) abs(dp) + w sqrt(abs(dp))/mean(shown)``. `open_` (n,): blocks over which the mean is taken.
    """
    shown = fit.unit_flow("laminar") / fit.unit_flow("orifice") * fit.blocks.root_dp / fit.blocks.abs_dp
    usual = float(shown[open_].mean())
    even = 1.0 - law.mean + law.mean * shown / usual
    volume = fit.unit_flow("laminar") / fit.blocks.abs_dp
    flow = volume * ((1.0 - law.mean) * fit.blocks.abs_dp + law.mean * fit.blocks.root_dp / usual)
    between = fit.between
    if between is not None:
        between = replace(between, g=between.g / np.interp(between.t, fit.blocks.t, even))
    return replace(fit, g=fit.g / even, sd=fit.sd / even, shared=fit.shared / even[:, None], between=between), flow
