"""The friction of the piston from its pressures at several speeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.control.identification.estimate import Estimate, least_squares
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

Array = NDArray[np.float64]
#: Length of a row [s], rows whose errors may follow each other, fewest rows, least speed over v_th.
_ROW, _LAGS, _FEWEST, _SLIDES = 0.1, 20, 60, 2.0
#: Share of the forces' deviation that friction may leave where the load is constant.
_LOADED = 0.5
#: Least ratio of the highest to the lowest speed.
_SPREAD = 2.0
#: Rows ring whose forces scatter by so many times that of the calmest tenth of them.
_RINGS = 1.5


def friction(recordings: Sequence[Recording], rig: Rig, area_A: float, area_B: float) -> tuple[Estimate, ...] | str:
    """Return preload, viscous friction, breakaway and the constant load, or why they cannot be told.

    A_A p_A - A_B p_B - M a = F_l + sign(v) (F_pr + F_cfr (p_A + p_B)) (1 + (K_brk - 1) exp(-C_c |v|)) + F_v v
    (eqs. (4.20), (4.21)) over rows in which the piston slides; F_cfr, C_c, M_eq are the rig's as stated. Areas in m^2.
    Where friction falls with speed a piston rings, and the mean of its friction is not that of its mean speed: rows in
    which the forces scatter by more than their noise are left out.
    """
    if rig.cylinder.A_opp > 0:
        return "friction is not told from the force of an opposing cylinder (cylinder.A_opp > 0)"
    tables = [_rows(recording, rig, area_A, area_B) for recording in recordings]
    steady = [table for table in tables if len(table) and _constant_load(table)]
    if not steady:
        return "friction needs a recording in which the load is constant"
    table = np.concatenate(steady)
    table = table[np.abs(table[:, 1]) > _SLIDES * rig.friction.v_th]
    if len(table) < _FEWEST or min(np.count_nonzero(table[:, 1] > 0), np.count_nonzero(table[:, 1] < 0)) < _FEWEST // 4:
        return f"friction needs strokes both ways above {_SLIDES * rig.friction.v_th:g} m/s for 6 s or more"
    force, v, pressures = table.T
    speed = np.abs(v)
    low, high = np.quantile(speed, [0.05, 0.95])
    f = rig.friction
    if high < _SPREAD * low:
        return f"friction needs speeds that differ by {_SPREAD:g} times or more, got {low:.3g} to {high:.3g} m/s"

    def residual(q: Array) -> Array:
        F_l, F_pr, K_brk, F_v = q
        level = (F_pr + f.F_cfr * pressures) * (1.0 + (K_brk - 1.0) * np.exp(-f.C_c * speed))
        return np.asarray(F_l + np.sign(v) * level + F_v * v - force)

    start = (float(np.median(force)) or 1.0, max(f.F_pr, 1.0), f.K_brk, max(f.F_v, 1.0))
    q, covariance, _ = least_squares(residual, start, _LAGS)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    names = ("cylinder.F_l", "friction.F_pr", "friction.K_brk", "friction.F_v")
    return tuple(Estimate(name, float(a), float(s)) for name, a, s in zip(names, q, sd, strict=True))


def _constant_load(table: Array) -> bool:
    """Return whether a constant, a force of either sign and a slope leave little of the forces, as friction does."""
    force, v = table[:, 0], table[:, 1]
    X = np.stack([np.ones(len(v)), np.sign(v), v], axis=1)
    rest = force - X @ np.linalg.lstsq(X, force, rcond=None)[0]
    return bool(np.std(rest) < _LOADED * np.std(force))


def _rows(recording: Recording, rig: Rig, area_A: float, area_B: float) -> Array:
    rate = recording.rate
    step = max(2, round(_ROW * rate))
    n = (len(recording) - 1) // step
    x = recording["x"]
    half = max(1, step // 5)
    smooth = np.convolve(np.pad(x, half, mode="edge"), np.ones(2 * half + 1) / (2 * half + 1), mode="valid")
    at = np.arange(n + 1) * step
    v = np.diff(smooth[at]) * rate / step
    a = np.gradient(v) * rate / step
    sides = [recording[name][: n * step].reshape(n, step) for name in ("p_A", "p_B")]
    p_A, p_B = (side.mean(axis=1) for side in sides)
    force = area_A * p_A - area_B * p_B - rig.cylinder.M_eq * a
    scatter = _scatter(area_A * sides[0] - area_B * sides[1])
    rows = np.stack([force, v, p_A + p_B], axis=1)[1:-1]
    steady = (np.sign(v[:-2]) == np.sign(v[1:-1])) & (np.sign(v[2:]) == np.sign(v[1:-1]))
    calm = np.abs(a[1:-1]) < 0.5 * np.abs(v[1:-1]) / _ROW
    even = (scatter <= _RINGS * np.nanquantile(scatter, 0.1))[1:-1]
    return np.asarray(rows[steady & calm & even & np.isfinite(rows).all(axis=1)])


def _scatter(rows: Array) -> Array:
    """Return the standard deviation of each row's samples (n, m) from a straight line of its own: (n,)."""
    line = np.linspace(-1.0, 1.0, rows.shape[1])
    rest = rows - rows.mean(axis=1, keepdims=True)
    rest = rest - (rest @ line)[:, None] / (line @ line) * line
    return np.asarray(rest.std(axis=1))
