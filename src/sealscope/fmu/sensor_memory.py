"""What every soft sensor keeps, as laws over its memory `m`: the beginning without stored samples, means over blocks.

Noise and senses come from the first seconds: the variance of the finest db8 detail, whose products between channels
give that of any sum of them, and the covariances of slow signals.

The mean conductance of the last n blocks (`WINDOW` at most) has the interval

    G +- t_(n-1) sqrt(v/n),    v = max(s^2, mean of sd^2)

with the scatter s of the blocks, the filter's own deviations sd and Student's t. Its rise over the first N = `WINDOW`
blocks, d blocks before, is uncertain by theirs and by the walk of a healthy machine, w times a block's noise a block:

    variance of the rise = v/n + v_0/N + w d sigma^2,    sigma^2 = v_0/(1 + w (N + 1)/6)

(N blocks of such a walk scatter by w (N + 1)/6 beside their noise). The error of the size itself (`SIZE_ERROR`) comes
beside both. The flow is G times the mean of abs(p_A - p_B) over the last n blocks.
"""

from __future__ import annotations

import math
from typing import Any

from sealscope.compiled import law
from sealscope.diagnosis.observer.detector import WARM_UP
from sealscope.diagnosis.observer.model import G_UNIT
from sealscope.diagnosis.observer.pressure_filter import SEARCH_SECONDS
from sealscope.diagnosis.observer.stream import SLOW_SECONDS
from sealscope.signals.filters import decomposition_filters

#: Blocks of a mean, and of the baseline.
WINDOW = 20
TAPS = tuple(float(tap) for tap in decomposition_filters()[1][::-1])
N_TAPS = len(TAPS)
#: Numbers at the beginning of the memory, and the phases of a run.
SCALARS = (
    "clock", "count", "phase", "round", "turn", "push", "noise_A", "noise_B", "theta", "x", "omega", "blocks",
    "base", "base_square", "base_variance",
)  # fmt: skip
(CLOCK, COUNT, PHASE, ROUND, TURN, PUSH, NOISE_A, NOISE_B, THETA, X, OMEGA, BLOCKS, BASE, BASE_SQUARE,
 BASE_VARIANCE) = range(len(SCALARS))  # fmt: skip
SEARCHES, CHOOSES, RUNS = 0.0, 1.0, 2.0
#: Behind them: the last samples of three channels, sums of products of their finest details, slow samples and sums of
#: products of these, and the last blocks with conductance, its variance and abs(p_A - p_B).
PARTS = {"taps": 3 * N_TAPS, "fine": 6, "slow": 2, "products": 6, "ring": 3 * WINDOW}
TAPS_AT = len(SCALARS)
FINE = TAPS_AT + PARTS["taps"]
_SLOW = FINE + PARTS["fine"]
_PRODUCTS = _SLOW + PARTS["slow"]
_RING = _PRODUCTS + PARTS["products"]
LENGTH = _RING + PARTS["ring"]
#: Time that the filter's slow parameters take to settle [s].
_SETTLES = WARM_UP - SEARCH_SECONDS


@law
def fresh(m: Any) -> None:
    """Empty the memory `m`."""
    for k in range(m.size):
        m[k] = 0.0
    m[TURN] = 1.0
    m[PUSH] = 1.0


@law
def keep(m: Any, row: Any, block_s: float) -> None:
    """Put a block's estimates into the ring; the first are left out, until the slow parameters have settled."""
    if not math.isfinite(row[0]):
        fresh(m)  # the filter lost the readings: it begins anew
        return
    m[BLOCKS] += 1.0
    k = m[BLOCKS] - 1.0 - math.ceil(_SETTLES / block_s)
    if k < 0.0:
        return
    at = _RING + 3 * (int(k) % WINDOW)
    m[at], m[at + 1], m[at + 2] = row[0], max(row[1] ** 2, 0.0), row[4]
    if k < WINDOW:
        m[BASE] += row[0]
        m[BASE_SQUARE] += row[0] ** 2
        m[BASE_VARIANCE] += row[1] ** 2


@law
def search(
    m: Any, a: float, b: float, c: float, slow_a: float, slow_b: float, slow_c: float, h: float, moved: bool
) -> None:
    """Sum products of the finest details of three channels, and of three slow signals for their senses.

    `h` [s]: since the sample before; `moved`: of the first two slow signals their differences count.
    """
    for k in range(N_TAPS - 1):
        for channel in range(3):
            m[TAPS_AT + channel * N_TAPS + k] = m[TAPS_AT + channel * N_TAPS + k + 1]
    m[TAPS_AT + N_TAPS - 1], m[TAPS_AT + 2 * N_TAPS - 1], m[TAPS_AT + 3 * N_TAPS - 1] = a, b, c
    if m[COUNT] >= N_TAPS - 1:
        d_a, d_b, d_c = 0.0, 0.0, 0.0
        for k in range(N_TAPS):  # from the oldest difference on, so that a large level costs no digits
            d_a += TAPS[k] * (m[TAPS_AT + k] - a)
            d_b += TAPS[k] * (m[TAPS_AT + N_TAPS + k] - b)
            d_c += TAPS[k] * (m[TAPS_AT + 2 * N_TAPS + k] - c)
        m[FINE] += d_a * d_a
        m[FINE + 1] += d_b * d_b
        m[FINE + 2] += d_c * d_c
        m[FINE + 3] += d_a * d_b
        m[FINE + 4] += d_a * d_c
        m[FINE + 5] += d_b * d_c
    if m[COUNT] % max(1.0, round(SLOW_SECONDS / h)) == 0.0:
        if m[COUNT] > 0.0:
            s_a = slow_a - m[_SLOW] if moved else slow_a
            s_b = slow_b - m[_SLOW + 1] if moved else slow_b
            m[_PRODUCTS] += s_a
            m[_PRODUCTS + 1] += s_b
            m[_PRODUCTS + 2] += slow_c
            m[_PRODUCTS + 3] += s_a * s_b
            m[_PRODUCTS + 4] += slow_c * s_b
            m[_PRODUCTS + 5] += 1.0
        m[_SLOW], m[_SLOW + 1] = slow_a, slow_b
    m[COUNT] += 1.0


@law
def senses(m: Any) -> None:
    """Write the senses in which the first and the third slow signal count, by their covariance with the second."""
    n = max(m[_PRODUCTS + 5], 1.0)
    m[TURN] = -1.0 if m[_PRODUCTS + 3] - m[_PRODUCTS] * m[_PRODUCTS + 1] / n < 0.0 else 1.0
    m[PUSH] = -1.0 if m[_PRODUCTS + 4] - m[_PRODUCTS + 2] * m[_PRODUCTS + 1] / n < 0.0 else 1.0


@law
def mean_of_blocks(m: Any, newest: int, n: int) -> tuple[float, float, float]:
    """Return mean conductance, variance of that mean and mean abs(p_A - p_B) of `n` blocks up to the `newest`."""
    G, square, own, dp = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        at = _RING + 3 * ((newest - k) % WINDOW)
        G += m[at] / n
        own += m[at + 1] / n
        dp += m[at + 2] / n
    for k in range(n):
        square += (m[_RING + 3 * ((newest - k) % WINDOW)] - G) ** 2 / (n - 1.0)
    return G, max(square, own) / n, dp


@law
def write_results(
    m: Any, block_s: float, misfit: float, size_error: float, walk: float, quantiles: Any, out: Any
) -> None:
    """Write the outputs (`sensor.RESULTS`).

    `walk`: variance of a block's walk over that of its noise; `quantiles`: Student's t for 1, 2, ... degrees of
    freedom.
    """
    for k in range(out.size):
        out[k] = 0.0
    out[7], out[8] = misfit, m[BLOCKS]
    count = int(m[BLOCKS] - math.ceil(_SETTLES / block_s))
    n = min(count, WINDOW)
    if n < 2:
        return
    G, variance, dp = mean_of_blocks(m, count - 1, n)
    unit, half = G_UNIT * dp, math.hypot(quantiles[n - 2] * math.sqrt(variance), size_error * G)
    out[0], out[1], out[2], out[6] = unit * G, unit * (G - half), unit * (G + half), G_UNIT * G
    n = min(count - WINDOW, WINDOW)
    if n < 2:
        return
    G, variance, dp = mean_of_blocks(m, count - 1, n)
    base = m[BASE] / WINDOW
    scatter = (m[BASE_SQUARE] - WINDOW * base**2) / (WINDOW - 1.0)
    before = max(scatter, m[BASE_VARIANCE] / WINDOW)
    distance = count - 0.5 * (n + WINDOW)
    variance += before * (1.0 / WINDOW + walk * distance / (1.0 + walk * (WINDOW + 1.0) / 6.0))
    rise, unit = G - base, G_UNIT * dp
    half = math.hypot(quantiles[n - 2] * math.sqrt(variance), size_error * rise)
    out[3], out[4], out[5], out[9] = unit * rise, unit * (rise - half), unit * (rise + half), 1.0
