"""How a number of a recording differs from the same number of healthy recordings, whose scatter is unknown.

n healthy values are normal about an unknown mean with an unknown deviation, of which nothing is believed but that it is
no smaller than the error e of a single value (Jeffreys). The next value then follows Student's law of n - 1 degrees of
freedom,

    t = (y - mean) / sqrt((s^2 + e^2) (1 + 1/n)),

so that five values that agree to a thousandth show a sixth a few thousandths off, and two show next to nothing.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors import priors

#: Fewest healthy recordings that show a scatter.
FEWEST = 3


def difference(
    name: str, data: str, value: float, healthy: Sequence[float], error: float = 0.0, *, above: bool = False
) -> Observable | None:
    """Compare a value with those of healthy recordings.

    Parameters
    ----------
    name, data : str
        Of the observable.
    value, error : float
        Value of the judged recording, and what a single value is off by of itself (standard deviation).
    healthy : sequence of float
        Values of the healthy recordings.
    above : bool
        Whether only a value above the healthy ones counts.

    Returns
    -------
    Observable or None
        None where too few are known, or a number is not finite.
    """
    from scipy.special import stdtr

    known = np.asarray(healthy, dtype=float)
    if len(known) < FEWEST or not np.isfinite([value, error, *known]).all():
        return None
    count, change = len(known), value - float(known.mean())
    variance = (float(known.var(ddof=1)) + error**2) * (1.0 + 1.0 / count)
    t = change / max(float(np.sqrt(variance)), np.finfo(float).tiny)
    tail = float(stdtr(count - 1, -t if above else -abs(t)))
    score = t * t if t > 0.0 or not above else 0.0
    if not np.isfinite(score):
        return None
    return Observable(name=name, data=data, score=score, chance=min(1.0, tail * (1.0 if above else 2.0)), size=change)


def rarity_of_size(table: str, step: float, above: bool = False) -> float:
    """Compute -2 times the logarithm of a step's prior density over the largest; `above`: no smaller one is rare."""
    size, spread = (priors("inference")[table][name] for name in ("size", "spread"))
    away = float(np.log(max(abs(step), np.finfo(float).tiny) / size)) / spread
    return float(max(away, 0.0) ** 2 if above else away**2)
