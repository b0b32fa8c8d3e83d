"""How far the oil of a cylinder's sides gives: what is believed of it, as readings beside those of a recording.

While valves shut a cylinder, a leak shows as pressures that fall at a rate, and so does the leak of another cylinder
whose oil gives more: only what compresses the oil in motion tells them apart, and often little of it is recorded. But
the volume of oil is known about: the piston displaces m (x_end - x_begin) over the stroke that is recorded, m the
coefficient of the motion, and dead volume adds a share; its compressibility with hoses and free air is that of oil.
With x_m the middle of the stroke,

    C(x_m) = m L (1/2 + dead) kappa,    dC/dx = +-m kappa,    free air -V alpha p_0,    dissolving air 0 +- V alpha,

each within a width, stand in the sums as one reading each, of the weight that rows have. So does that a side displaces
the same both ways, but for what the pump loses: a side that only gives way under a leak tells its area by nothing else.

Source: Merritt, Hydraulic Control Systems, 1967, section 6.3; what is believed stands in `priors.toml`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns, solve
from sealscope.diagnosis.inference.rows.weak_form import OVERLAP
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM


def with_oil_readings(blocks: Blocks, columns: Sequence[Columns], x: Array) -> Blocks:
    """Add what is believed of the oil's compliance to the sums of blocks.

    Parameters
    ----------
    blocks : Blocks
    columns : sequence of Columns
        Of one balance of a cylinder.
    x : array of float, shape (n,)
        Position of the piston [m], NaN where missing.

    Returns
    -------
    Blocks
        The blocks themselves where nothing moves.
    """
    (column,) = columns
    total, known = blocks.gram[:, 0].sum(axis=0), x[np.isfinite(x)]
    chosen = list(column.nuisance)
    coefficients = solve(total[np.ix_(chosen, chosen)], total[chosen, column.left])
    square = total[column.left, column.left] - total[chosen, column.left] @ coefficients
    variance = OVERLAP * max(float(square), 0.0) / max(float(blocks.rows.sum()), 1.0)
    by_name = dict(zip((column.names[k] for k in chosen), coefficients, strict=True))
    gram, size = np.zeros_like(total), len(total)
    if not known.size or not np.ptp(known) > 0.0 or not variance > 0.0:
        return blocks
    low, high = (float(end) for end in np.quantile(known, (0.01, 0.99)))
    for side, fills in (("A", 1.0), ("B", -1.0)):
        motions = [column.names.index(f"motion {way}, {side} carries") for way in ("out", "in")]
        energy = np.diag(total)[motions]
        if not energy.sum() > 0.0:
            continue
        displaced = float(energy @ [by_name[column.names[k]] for k in motions] / energy.sum())
        for reading, value, deviation in _oil_readings(side, fills, displaced, low, high):
            row = np.zeros(size)
            for name, share in reading.items():
                if name in column.names:
                    row[column.names.index(name)] = share
            row[column.left] = value
            if row[: column.left].any() and deviation > 0.0:
                gram += np.outer(row, row) * (variance / deviation**2)
    shares = np.maximum(blocks.rows, 0.0) / max(float(blocks.rows.sum()), 1.0)
    summed = blocks.gram.copy()
    summed[:, 0] += shares[:, None, None] * gram
    return replace(blocks, gram=summed)


def _oil_readings(
    side: str, fills: float, displaced: float, low: float, high: float
) -> list[tuple[dict[str, float], float, float]]:
    """Return readings of one side's terms: shares of the terms by name, value and deviation.

    `fills`: 1 where oil that comes in raises the balance, -1 where it lowers it; `displaced`: area of the piston in the
    balance's unit, with the sign of x.
    """
    believed = priors("inference")["oil_column"]
    area, stroke, middle = abs(displaced), high - low, 0.5 * (low + high)
    grows = fills * np.sign(displaced)  # the side's volume with x
    volume = area * stroke * (0.5 + believed["dead"])
    give, wide = believed["compressibility"], believed["deviation"]
    air = believed["air"] * volume
    compliance, slope = f"compliance {side}", f"compliance {side} over the stroke"
    out, back = (f"motion {way}, {side} carries" for way in ("out", "in"))
    return [
        ({out: 1.0, back: -1.0}, 0.0, area * believed["ways"]),
        ({compliance: 1.0, slope: middle}, fills * volume * give, volume * give * wide),
        ({slope: 1.0}, fills * grows * area * give, area * give * wide),
        ({f"free air {side}": 1.0}, -fills * air * P_ATM, air * P_ATM),
        ({f"dissolving air {side}": 1.0}, 0.0, air),
    ]
