"""The compiled sums of the volume balance, beside the same formulas written with arrays."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from sealscope.diagnosis.volume_balance.blocks import DP_12, Geometry, balance_channels, cut_blocks, volumes
from sealscope.diagnosis.volume_balance.sums import beyond_pressure, block_means, carried_columns, volume_columns

from .balance_machine import AREA, DISPLACEMENT, machine

N, L, STEP, HALF = 3, 90, 0.01, 4


def smoothed(row, half=HALF):
    """Means over `half` samples to either side, over fewer at the ends."""
    padded = np.pad(row, half, constant_values=np.nan)
    return np.nanmean(sliding_window_view(padded, 2 * half + 1), axis=1)


def integral(row):
    return np.concatenate([[0.0], np.cumsum(0.5 * STEP * (row[1:] + row[:-1]))])


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(5)
    t = np.arange(L) * STEP
    x = 1e-4 * np.sin(9.0 * t + np.arange(N)[:, None]) + 1e-8 * rng.normal(size=(N, L))
    dp = 1e5 * np.cos(9.0 * t + np.arange(N)[:, None]) + 2e3 * rng.normal(size=(N, L))
    return x, 1.1 * x + 4.0 + 1e-8 * rng.normal(size=(N, L)), dp


def test_columns_are_volumes_integrals_and_ways(samples):
    x, theta, dp = samples
    columns, smooth = volume_columns(x, theta, True, dp, STEP, HALF)
    by_flow, _ = volume_columns(x, columns[:, 2].copy(), False, dp, STEP, HALF)
    for k in range(N):
        want = smoothed(dp[k])
        flow, moved = np.gradient(theta[k], STEP), np.diff(x[k], prepend=x[k, 0])
        root = np.sign(want) * np.sqrt(np.abs(want))
        ways = [np.cumsum(np.sign(of) * moved) for of in (smoothed(flow), want)]
        np.testing.assert_allclose(smooth[k], want, rtol=1e-9, atol=1e-6)
        expected = [x[k], theta[k], flow, integral(dp[k]), integral(root), *ways]
        for column, values in zip(columns[k], expected, strict=True):
            np.testing.assert_allclose(column, values, rtol=1e-9, atol=1e-9 * np.ptp(values))
        np.testing.assert_allclose(by_flow[k, 1], integral(flow), atol=1e-12 * np.ptp(theta))


def test_oil_stored_is_that_of_means_and_of_what_rings_about_them(samples):
    x, theta, dp = samples
    p_A, p_B = 3e5 + dp, 3e5 + 0.2 * np.roll(dp, 7, axis=1)
    flow = np.gradient(theta, STEP, axis=1)
    columns = carried_columns(x, p_A, p_B, flow, dp, STEP, HALF)
    for k in range(N):
        on_A = dp[k] > 0.0
        for p, on, rise, by_place in ((p_A[k], on_A, 3, 1), (p_B[k], ~on_A, 0, 2)):
            mean, ringing = smoothed(p), np.where(on, smoothed(p, HALF // 3) - smoothed(p), 0.0)
            up = np.where(on, np.diff(mean, prepend=mean[0]), 0.0)
            middle = 0.5 * (x[k] + np.concatenate([x[k, :1], x[k, :-1]]))
            up[0] = 0.0
            np.testing.assert_allclose(columns[k, rise], np.cumsum(up) + ringing, atol=1e-9 * np.ptp(p))
            wanted = np.cumsum(middle * up) + x[k] * ringing
            np.testing.assert_allclose(columns[k, by_place], wanted, atol=1e-9 * np.ptp(wanted))
        delivered = np.where(smoothed(flow[k]) * dp[k] > 0.0, np.abs(smoothed(flow[k])) * dp[k], 0.0)
        np.testing.assert_allclose(columns[k, 4], integral(delivered), rtol=1e-9, atol=1e-12)


def test_what_offset_slope_and_pressure_leave_is_that_of_least_squares(samples):
    x, theta, dp = samples
    rest, slope, stored, steady, along, pressed = beyond_pressure(np.stack([x, theta], axis=1), dp, STEP)
    tau = (np.arange(L) - 0.5 * (L - 1)) * STEP
    for k in range(N):
        basis = np.stack([np.ones(L), tau, dp[k]], axis=1)
        for j, column in enumerate((x[k], theta[k])):
            beta = np.linalg.lstsq(basis / np.ptp(basis, axis=0).clip(1.0), column, rcond=None)[0]
            beta /= np.ptp(basis, axis=0).clip(1.0)
            np.testing.assert_allclose(rest[k, j], column - basis @ beta, atol=1e-12 * np.ptp(column))
            np.testing.assert_allclose([slope[k, j], stored[k, j]], beta[1:], rtol=1e-6)
        centred = dp[k] - dp[k].mean()
        assert along[k] == pytest.approx(centred @ tau / (centred @ centred))
        assert steady[k] == pytest.approx(np.sum((tau - along[k] * centred) ** 2))
        assert pressed[k] == pytest.approx(np.sum((centred - tau * (centred @ tau) / (tau @ tau)) ** 2))


def test_means_of_blocks(samples):
    x, theta, dp = samples
    columns, smooth = volume_columns(x, theta, True, dp, STEP, HALF)
    rest = beyond_pressure(columns, dp, STEP)[0][:, 3].copy()
    both = 3e5 + theta * 1e3
    means = block_means(x, columns[:, 2].copy(), rest, dp, smooth, both, STEP, HALF)
    for k in range(N):
        root, tenth = np.sqrt(np.abs(smooth[k])).mean(), L // 10
        noise = np.mean(np.diff(dp[k], 2) ** 2) / 6.0
        reach = np.cumsum(rest[k, ::-1])
        way = np.abs(np.gradient(x[k]))
        expected = [
            noise,
            np.abs(smooth[k]).mean(),
            root,
            np.abs(smoothed(columns[k, 2])).mean(),
            np.sqrt(np.abs(dp[k])).mean() / root - 1.0,
            np.trapezoid(dp[k], x[k]) / (L * STEP),
            noise * STEP**2 * (reach @ reach) / (rest[k] @ rest[k]) ** 2,
            way[np.sign(dp[k]) != np.sign(smooth[k])].sum() / way.sum(),
            both[k, -tenth:].mean() - both[k, :tenth].mean(),
        ]
        np.testing.assert_allclose(means[:, k], expected, rtol=1e-8)
        alone = [np.ascontiguousarray(values[k : k + 1]) for values in (x, columns[:, 2], rest, dp, smooth, both)]
        assert np.array_equal(block_means(*alone, STEP, HALF)[:, 0], means[:, k])


def test_kept_slopes_and_stored_oil_give_back_the_whole_columns():
    """Sums beyond the offset alone, put together from what offset, slope and dp leave, are those of the samples."""
    recording = machine(1, duration=12.0, load=lambda t: 5e5 * np.sin(0.9 * t))
    rows = {name: recording[name][None] for name in balance_channels(recording)}
    geometry = Geometry(AREA, DISPLACEMENT)
    blocks = cut_blocks(recording.t, {name: row[0] for name, row in rows.items()}, len(recording), 200.0, geometry)
    columns, dp, _ = volumes(rows, 200.0, geometry)
    columns = np.append(columns[0], recording.t[None], axis=0)
    along = np.stack([np.ones(dp.size), recording.t, dp[0]], axis=1)
    beyond_dp = np.linalg.lstsq(along, columns[DP_12], rcond=None)[0][2]
    columns[DP_12] -= beyond_dp * dp[0]
    columns -= columns.mean(axis=1, keepdims=True)
    whole, size = blocks.whole().gram[0], np.sqrt(np.sum(columns**2, axis=1))
    np.testing.assert_allclose(whole / np.outer(size, size), columns @ columns.T / np.outer(size, size), atol=1e-9)
