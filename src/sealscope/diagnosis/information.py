"""What a recording says of the leak, block by block: the form in which every provider hands over its evidence."""

from __future__ import annotations

from typing import NamedTuple

from sealscope.recordings.recording import Array
from sealscope.units import LITRE_PER_MINUTE


class Information(NamedTuple):
    """Information on the leak's coefficient g of K blocks, all nuisance parameters eliminated.

    The likelihood of g (K,), one conductance [m^3/(s Pa)] a block, is ``exp(-g' precision g / 2 + vector' g)``.

    `time` (K,): middles of the blocks [s]; `precision` (K, K): symmetric, positive semidefinite; `vector` (K,);
    `pressure` (K,): mean of |p_A - p_B| [Pa], by which g is a flow; `scale`: standard deviation of the factor that all
    g share [1]; `laws`: flow of the leak over g `pressure`, of the law with the least and of that with the largest.
    """

    time: Array
    precision: Array
    vector: Array
    pressure: Array
    scale: float
    laws: tuple[float, float]

    def flow(self, step: float, deviation: float) -> tuple[float, tuple[float, float]]:
        """Return the mean flow [L/min] of a step of g [m^3/(s Pa)] and its 95 % interval.

        `deviation` of the step; the interval holds those of all `laws` and the doubt in the scale, the flow is that of
        their middle.
        """
        unit = float(self.pressure.mean()) / LITRE_PER_MINUTE
        reach = 1.96 * (deviation**2 + (self.scale * step) ** 2) ** 0.5
        least, most = self.laws
        return 0.5 * (least + most) * step * unit, (
            max(0.0, least * (step - reach) * unit),
            max(0.0, most * (step + reach) * unit),
        )
