"""Areas over displacement, stiffness and leakage from the balance of volumes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.control.identification.estimate import Estimate, instrumented
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

Array = NDArray[np.float64]
#: Length of a block [s], half length of the averages at its ends [s], least |p_A - p_B| [Pa].
BLOCK, _HALF, _LEAST_DP = 0.25, 0.01, 20e3
#: Blocks whose errors may follow each other, fewest blocks of a side.
_LAGS, _FEWEST = 12, 20
#: The pilot-operated valve of the side with the higher pressure is shut beyond so many times its pressures to open;
#: an estimate of a few blocks in a loop must do with less, one of a whole recording need not.
_SHUT = 3.0
#: Share of the delivered volume that may be left over.
UNBALANCED = 0.05


@dataclass(frozen=True)
class Balanced:
    """Estimates from the balance, and the share of the delivered volume that is left over."""

    estimates: tuple[Estimate, ...]
    left_over: float
    blocks: int


def balanced(recordings: Sequence[Recording], rig: Rig) -> Balanced | str:
    """Return what the balance of volumes tells, or why it tells nothing.

    Over each block, on the side with the higher pressure (the other may be fed): D dtheta = A dx + (1/K) (V(x) dp +
    D dtheta_in |p_A - p_B|) + G integral of |p_A - p_B|, signs turned for side B. D = q_b/(2 pi) and V are the rig's as
    stated; A_A, A_B, K and G are found. The pressures at the ends are averaged twice, from the even and from the odd
    samples: the one is the column and the other its instrument, so that their noise biases nothing.
    """
    pilots = rig.makeup.check_valves == "pilot-operated"
    held = _SHUT * (rig.makeup.p_crack + rig.makeup.p_open) if pilots else 0.0
    first = _fitted(recordings, rig, rig.cylinder.A_A, rig.cylinder.A_B, held)
    if isinstance(first, str) and held > 0.0:  # small pressures: then the valves may be open
        held = 0.0
        first = _fitted(recordings, rig, rig.cylinder.A_A, rig.cylinder.A_B, held)
    if isinstance(first, str):
        return first
    areas = {estimate.name: estimate.value for estimate in first.estimates}
    areas = {name: value for name, value in areas.items() if value > 0}
    A_A, A_B = areas.get("cylinder.A_A", rig.cylinder.A_A), areas.get("cylinder.A_B", rig.cylinder.A_B)
    return _fitted(recordings, rig, A_A, A_B, held)


def _fitted(recordings: Sequence[Recording], rig: Rig, A_A: float, A_B: float, held: float) -> Balanced | str:
    """Return the estimates, volumes moving by the areas A_A, A_B [m^2], from blocks in which |dp| >= `held` [Pa]."""
    rows = [_rows(recording, rig, A_A, A_B, held) for recording in recordings]
    table = np.concatenate(rows) if rows else np.empty((0, 6))
    if len(table) < 2 * _FEWEST:
        return (
            f"the balance of volumes needs {2 * _FEWEST} blocks of {BLOCK:g} s in which the pressures differ by "
            f"{_LEAST_DP / 1e3:g} kPa and keep their order, got {len(table)}"
        )
    y, dx, on_A = table[:, 0], table[:, 1], table[:, 2] > 0
    pressed, instrument, flow = table[:, 3], table[:, 4], table[:, 5]
    sides = {side: on for side, on in (("A_A", on_A), ("A_B", ~on_A)) if np.count_nonzero(on) >= _FEWEST}
    used = np.any(np.stack(list(sides.values())), axis=0)
    columns = [np.where(on, dx, 0.0) for on in sides.values()]
    X = np.stack([*columns, pressed, flow], axis=1)[used]
    Z = np.stack([*columns, instrument, flow], axis=1)[used]
    b, covariance, rest = instrumented(y[used], X, Z, _LAGS)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates = [Estimate(f"cylinder.{side}", float(b[k]), float(sd[k])) for k, side in enumerate(sides)]
    if b[-2] > 0:
        estimates.append(Estimate("fluid.K_oil", float(1.0 / b[-2]), float(sd[-2] / b[-2] ** 2)))
    estimates.append(Estimate("pump.G_pump", float(b[-1]), float(sd[-1])))
    left = float(np.sqrt(np.mean(rest**2)) / max(np.sqrt(np.mean(y[used] ** 2)), 1e-30))
    return Balanced(tuple(estimates), left, int(np.count_nonzero(used)))


def _rows(recording: Recording, rig: Rig, A_A: float, A_B: float, held: float) -> Array:
    rate, c = recording.rate, rig.cylinder
    D, moves = rig.pump.q_b / (2.0 * math.pi), c.volumes == "position"
    conserves = moves and c.balance == "mass"
    theta, x, p_A, p_B = (recording[name] for name in ("theta", "x", "p_A", "p_B"))
    length, half = max(4, round(BLOCK * rate)), max(1, round(_HALF * rate))
    offsets = np.arange(-half, half + 1)
    ends = np.arange(half, len(recording) - half, length)
    even, odd = offsets[offsets % 2 == 0], offsets[offsets % 2 == 1]
    dp = p_A - p_B
    smooth = np.convolve(dp, np.ones(2 * half + 1) / (2 * half + 1), mode="same")
    x_ends, theta_ends = (v[ends[:, None] + offsets].mean(axis=1) for v in (x, theta))
    rows = []
    for k in range(len(ends) - 1):
        part = slice(ends[k], ends[k + 1] + 1)
        low, high = smooth[part].min(), smooth[part].max()
        if low * high <= 0 or min(abs(low), abs(high)) < held or abs(smooth[part].mean()) < _LEAST_DP:
            continue
        sign = 1.0 if smooth[ends[k]] > 0 else -1.0
        p, V_0, area = (p_A, c.V + c.V_hose_A, A_A) if sign > 0 else (p_B, c.V - c.V_rod + c.V_hose_B, A_B)
        V = V_0 + (sign * area * x_ends[k : k + 2] if moves else np.zeros(2))
        swept = sign * area * np.diff(x[part]) if moves else np.zeros(length)
        middle = 0.5 * (p[part][1:] + p[part][:-1])
        turned, over = sign * np.diff(theta[part]), sign * 0.5 * (dp[part][1:] + dp[part][:-1])
        into = turned > 0.0 if conserves else np.zeros(length, dtype=bool)
        drawn = D * float(turned[into] @ over[into])
        # integral of V dp by parts: the noise at the ends alone is left, and there it is averaged
        columns = []
        for chosen in (even, odd):
            first, last = p[ends[k] + chosen].mean(), p[ends[k + 1] + chosen].mean()
            columns.append(V[1] * last - V[0] * first - float(swept @ middle) + drawn)
        leaked = (over.sum() - float((over[into] ** 2).sum()) / rig.fluid.K_oil) / rate
        dx, dtheta = x_ends[k + 1] - x_ends[k], theta_ends[k + 1] - theta_ends[k]
        rows.append([sign * D * dtheta, sign * dx, sign, *columns, leaked])
    table = np.array(rows).reshape(-1, 6)
    return np.asarray(table[np.isfinite(table).all(axis=1)])
