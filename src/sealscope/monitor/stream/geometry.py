"""The balance of volumes with its shared coefficients frozen: one conductance a block, at the cost of a few products.

`fit_balance` finds the coefficients that all blocks share (displacement over area, lag, line volumes). They belong to
the machine and do not drift, so a running machine is fitted once, and each block then gives its conductance

    g = -sense v' M e_I / (e_I' M e_I),    v = e_Y - sum_j beta_j e_j,

with M the block's sums of products and e_I the integral of dp. The residual v' M v - (v' M e_I)^2/(e_I' M e_I) shows
whether the block balances.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.volume_balance.blocks import FLOW, I_AB, THETA, BalanceBlocks
from sealscope.diagnosis.volume_balance.evidence import states_flow
from sealscope.diagnosis.volume_balance.fit import BalanceFit
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import array_of, part_of, plain_array
from sealscope.units import LITRE_PER_MINUTE

#: A block stands where the integral of dp has under this many times the sum of squares that noise makes of it.
_STILL = 10.0
#: A block does not balance where its residual is over this many times the usual one, and over this share of the volume.
_SPOILT, _UNBALANCED = 5.0, 0.05
#: Displacement over area is known to this share: a change of it passes for a conductance.
_SCALE_KNOWN = 5e-4
#: Relative deviation of a conductance from what is not modelled.
LEVEL = 0.02


@dataclass(frozen=True, eq=False)
class FrozenBalance:
    """Coefficients of a balance, frozen.

    `weights` (c,): v of the columns of a block; `sense`: 1 or -1; `residual`: usual rms residual [m^3]; `volume`:
    factor of a flow (1, or over the scale where the sides' areas differ); `offset_sd`: deviation that all conductances
    share [m^3/(s Pa)]; `litres`: whether L/min can be stated.
    """

    weights: Array
    sense: int
    residual: float
    volume: float
    offset_sd: float
    litres: bool

    @classmethod
    def of(cls, fit: BalanceFit) -> FrozenBalance:
        """Return the coefficients of a fit."""
        offset = float(np.sqrt(np.mean(np.sum(fit.shared**2, axis=1))))
        volume = 1.0 / abs(fit.scale) if fit.by_pump else 1.0
        return cls(fit.weights, fit.sense, fit.residual, volume, offset, states_flow(fit))

    def conductances(self, blocks: BalanceBlocks) -> tuple[Array, Array]:
        """Return conductances (n,) of blocks and their deviations (n,) [m^3/(s Pa)]."""
        own = np.maximum(blocks.gram[:, I_AB, I_AB], np.finfo(float).tiny)
        g = -self.sense * (blocks.gram[:, I_AB] @ self.weights) / own
        return g, np.sqrt(self.residual**2 / own + g**2 * blocks.walk)

    def offset(self, blocks: BalanceBlocks) -> Array:
        """Return the deviation (n,) by which a conductance may be off for good [m^3/(s Pa)]."""
        own = np.maximum(blocks.gram[:, I_AB, I_AB], np.finfo(float).tiny)
        leaning = np.abs(self.weights[THETA] * blocks.gram[:, I_AB, THETA]) / own
        g, _ = self.conductances(blocks)
        return np.asarray(np.sqrt(self.offset_sd**2 + (_SCALE_KNOWN * leaning) ** 2 + (LEVEL * g) ** 2))

    def flow(self, blocks: BalanceBlocks) -> Array:
        """Return the mean flow (n,) of one unit of conductance over each block [L/min]."""
        return self.volume * blocks.abs_dp / LITRE_PER_MINUTE

    def unusable(self, blocks: BalanceBlocks) -> str | None:
        """Return why a single block is not judged, None where it is: the machine stands, or it does not balance."""
        if not in_motion(blocks).all():
            return "at rest"
        gram = blocks.gram[0]
        across = float(gram[I_AB] @ self.weights)
        left = float(self.weights @ gram @ self.weights) - across**2 / gram[I_AB, I_AB]
        spoilt = left > _SPOILT**2 * self.residual**2 * blocks.samples
        if spoilt and left > (_UNBALANCED * self.weights[THETA]) ** 2 * gram[THETA, THETA]:
            return "does not balance"
        return None

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return {
            "weights": plain_array(self.weights),
            "sense": self.sense,
            "residual": self.residual,
            "volume": self.volume,
            "offset_sd": self.offset_sd,
            "litres": self.litres,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> FrozenBalance:
        """Return what `state` was of; raises InputError where it does not fit."""
        residual, volume, offset_sd = (
            float(part_of(state, name, (float, int))) for name in ("residual", "volume", "offset_sd")
        )
        weights = array_of(part_of(state, "weights", Mapping), "weights")
        sense, litres = int(part_of(state, "sense", int)), bool(part_of(state, "litres", bool))
        return cls(weights, sense, residual, volume, offset_sd, litres)


def in_motion(blocks: BalanceBlocks) -> NDArray[np.bool_]:
    """Return the blocks (n,) in which the integral of dp is more than noise."""
    step = blocks.seconds / blocks.samples
    noise = blocks.noise * step**2 * blocks.samples**2 / 15.0
    return np.asarray(blocks.gram[:, I_AB, I_AB] > _STILL * noise)


def duty_of(blocks: BalanceBlocks) -> Array:
    """Return the duty of each block (n, 2): logarithms of the mean pressure difference and of the pump's rms flow."""
    tiny = np.finfo(float).tiny
    flow = np.sqrt(blocks.gram[:, FLOW, FLOW] / blocks.samples)
    return np.asarray(np.log(np.maximum(np.stack([blocks.abs_dp, flow], axis=1), tiny)))
