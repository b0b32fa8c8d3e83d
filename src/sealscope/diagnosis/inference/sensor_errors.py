"""Errors of sensors that the volume balance shows and that are removed: the zero of p_A - p_B, and changes of delays.

With a sensor offset z, the flow of a leak with the coefficient g is g (d - z), where d is the recorded difference p_A -
p_B. A change of g then also changes the constant flow (the flow offset of the balance), by -g z. A small z is a term of
every fit (`blocks`). Here z is estimated even if it is larger than the pressure difference itself. In block k the Gram
matrix determines two values: g_k, from the dependence of the flow on d within the block, and the flow o_k at the
block's mean difference d_k. The leak's coefficient has a slow change F a (level and slope), a random walk w, and a step
delta whose shape s is 0 before the onset and 1 after it. The constant flow has a slow change B b (level, slope and
curvature). With the variance kappa of the noise and q kappa of the walk in a block,

    g_k = F_k a + w_k + delta s_k,    o_k = (d_k - z) g_k + B_k b,    cov(w_k, w_l) = kappa q min(k, l);

F and B are projected out. z maximises its prior times the restricted likelihood, over onsets and (q, kappa). The prior
is a normal density for good sensors, with small odds of a wide density. The walk may be no larger than the one fitted
without z; otherwise z and a free walk would describe changes that no leak explains. The residual of the volume balance
repeats from cycle to cycle, so no more than `tempering.readings` residuals count as independent. If the leak does not
change, there is no information on z. It then stays near zero, and no result depends on it. Behind a servo valve both
chambers have the same leak, step and z, so their whitened rows are stacked.

z also decides which side carries the load. A large z therefore has to explain the areas of the piston, too: the blocks
are computed again with it, and it is kept only if the areas that they then show are no more improbable than z makes the
course of the leakage more probable (`area_mismatch`).

Source: D. A. Harville, J. Am. Statist. Assoc. 72 (1977) 320 (restricted likelihood).

A channel c that arrives later by tau from some time on reads c(t - tau). To the first order in tau, the volume balance
then misses the term tau dV/dt, where V is what the channel contributes: A dx for the position, C dp for a pressure. The
columns of these terms are the second differences of the channels (`equations.balances.with_delays`, `terms.LAG`).

The coefficient of such a column is tested for a step while the leakage by either law, the constant flow and the
chambers' compliances are free in each block. A leak, air or another zero of a sensor thus never counts as a delay,
however they change. The posterior odds that the delay has changed are

    odds = r mean(L(onset)) / L_0 * sqrt(2 pi) s f(tau),

with the likelihoods L and L_0 with a step and without (`change`), their mean being over all onsets, the fitted change
tau with its standard error s, the prior density f of its size, and the prior odds r (`delay` in `priors.toml`). If they
exceed 1, and the shifted channel leaves a smaller residual, the channel is shifted back by tau, and its samples about
the onset count as missing. The search is repeated until no further change is found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.change import (
    MIN_BLOCKS,
    RANK_TOLERANCE,
    WALKS,
    StepTest,
    largest_step_likelihood,
    step_sizes,
    step_test,
)
from sealscope.diagnosis.estimate.interval import Estimate, Interval
from sealscope.diagnosis.estimate.linear import Gaussian, solve
from sealscope.diagnosis.estimate.special import find_minimum
from sealscope.diagnosis.inference.blocks import (
    Blocks,
    ColumnRoles,
    estimate_leak_and_bias,
    information,
    offset_cost,
    sum_blocks,
)
from sealscope.diagnosis.inference.equations.balances import motions_of_side
from sealscope.diagnosis.inference.equations.terms import LAG, ORIFICE, Equation, delay_name
from sealscope.diagnosis.inference.hypotheses import compare_residuals, step_penalty
from sealscope.diagnosis.inference.rows import half_width
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Number of offsets on the first grid, which reaches to three standard deviations of the wide prior on either side.
N_GRID = 21


class OffsetFit(NamedTuple):
    """Blocks after subtracting the most probable sensor offset of p_A - p_B, and the log posterior density of it.

    The density is relative to that of no offset; it contains the prior (`offset_cost`).
    """

    blocks: Blocks
    log_posterior: float


def remove_pressure_offset(blocks: Blocks, columns: Sequence[ColumnRoles]) -> Blocks:
    """Estimate the sensor offset of p_A - p_B in a recording, and return the blocks after subtracting it."""
    return fit_pressure_offset(blocks, columns).blocks


def fit_pressure_offset(blocks: Blocks, columns: Sequence[ColumnRoles], max_offset: float = np.inf) -> OffsetFit:
    """Estimate the sensor offset of p_A - p_B in a recording, of a magnitude up to `max_offset` [Pa], and subtract it.

    The most probable offset is subtracted in the Gram matrices and added to `Blocks.zero` [Pa]. The blocks are returned
    unchanged if too few of them determine the leak, or if an equation has no column for a constant flow.
    """
    if len(blocks) < MIN_BLOCKS or any(roles.bias is None for roles in columns):
        return OffsetFit(blocks, 0.0)
    coarse = blocks.merge(INFERENCE.blocks.coarse)  # fewer blocks: the time of the leak's onset need not be exact
    equations = [
        whitened
        for k, roles in enumerate(columns)
        if (whitened := _whiten_steps(replace(coarse, gram=coarse.gram[:, k : k + 1]), roles)) is not None
    ]
    if not equations:
        return OffsetFit(blocks, 0.0)
    leak_steps, flow_offset_steps, residuals = (np.concatenate(parts) for parts in zip(*equations, strict=True))
    # prior standard deviation of the offset of good sensors [Pa], smaller for pressures in counts
    unit = columns[0].offset_deviation(columns[0].leak, blocks)
    relative_offset, log_posterior = _find_relative_offset(
        leak_steps, unit * flow_offset_steps, residuals, max_offset / INFERENCE.zero.pressure
    )
    offset = unit * relative_offset
    gram = blocks.gram.copy()
    for k, roles in enumerate(columns):
        assert roles.bias is not None
        # (p_A - p_B) dt minus offset dt, in the rows and in the columns of the Gram matrices
        gram[:, k, roles.leak] -= offset * gram[:, k, roles.bias]
        gram[:, k, :, roles.leak] -= offset * gram[:, k, :, roles.bias]
    return OffsetFit(replace(blocks, gram=gram, zero=blocks.zero + offset), log_posterior)


def _find_relative_offset(
    leak_steps: Array, flow_offset_steps: Array, residuals: Array, max_offset: float
) -> tuple[float, float]:
    """Find the most probable sensor offset of p_A - p_B, in units of its prior standard deviation.

    The magnitude is at most `max_offset`. Also returns the log posterior density relative to that of no offset.

    `residuals` (n,): whitened residuals of leak and constant flow in K blocks. Column k of `leak_steps` (n, K) is their
    change by a unit step of the leak's coefficient from block k on. Such a step also lowers the constant flow, in
    proportion to the offset: column k of `flow_offset_steps` (n, K) is the effect of this change for an offset of -1.
    With S = leak_steps - offset flow_offset_steps, and a leak that steps up by `size` in block k,

        residuals = size S[:, k] + noise,    cov noise = kappa (I + q S S'),

    where q S S' is the random walk of the leak's coefficient, kappa the variance of the noise, and I the identity. The
    likelihood is maximised over size > 0, k, kappa and q; `offset_cost` states the prior on the offset. The search is
    over asinh(offset), which covers small and large offsets alike.
    """
    usual, far = INFERENCE.zero.pressure, INFERENCE.zero.far  # standard deviations of the prior [Pa]
    # no walk larger than the best one without an offset: otherwise an offset could explain changes that no leak causes
    walks = WALKS[largest_step_likelihood(leak_steps, residuals)[1] >= WALKS]

    # the residual of the balance repeats from cycle to cycle, so not all residuals are independent
    independent_fraction = min(1.0, INFERENCE.tempering.readings / len(residuals))

    def log_likelihood(positions: Array | float) -> Array:
        """Compute the log likelihoods at asinh(offset) = `positions`, scaled to the number of independent residuals."""
        steps = leak_steps - np.sinh(positions)[..., None, None] * flow_offset_steps
        return independent_fraction * largest_step_likelihood(steps, residuals, walks)[0]

    def cost(position: float) -> float:
        """Compute minus the log posterior density at asinh(offset) = `position`, up to a constant."""
        # in the prior, a relative offset of 1 is `usual` [Pa], also for pressures in counts
        return 0.5 * float(offset_cost(usual * float(np.sinh(position)))) - float(log_likelihood(position))

    positions = np.arcsinh(min(3.0 * far / usual, max_offset)) * np.linspace(-1.0, 1.0, N_GRID)
    # search about offset 0, where the prior has its maximum, and about the maximum of the likelihood
    starts = {N_GRID // 2, int(np.argmax(log_likelihood(positions)))}
    minima = []
    for start in starts:
        low, high = positions[max(start - 1, 0)], positions[min(start + 1, N_GRID - 1)]  # neighbours on the grid
        minima.append(find_minimum(cost, low, high, tolerance=1e-3))
    position, lowest_cost = min(minima, key=lambda minimum: minimum[1])
    return float(np.sinh(position)), cost(0.0) - lowest_cost


def area_mismatch(blocks: Blocks, columns: Sequence[ColumnRoles], equation: Equation, ratio_deviation: float) -> float:
    """Compute how much the fitted areas of the piston contradict each other: -2 log of their likelihood.

    A wrong offset attributes motion to the wrong side of the load. The coefficients a_j of the motion, in up to two
    directions for each side, should be the side's area times a common factor, to within `between.motion`
    (`priors.toml`) and the errors e_j of the fit. These variances are divided by the column's share of the motion, as
    much of a small share belongs to the other side. The log ratio of the areas of B and A is normal about that of the
    `equation`, with the standard deviation `ratio_deviation`. The result is the smallest sum of squares over the common
    factor and the ratio; 0 without a motion of the piston.
    """
    roles, total = columns[0], sum_blocks(blocks, columns)[0]
    if not roles.piston:
        return 0.0
    nuisance = list(roles.nuisance)
    fit = Gaussian.from_gram(total).among(nuisance)
    coefficients, variances = fit.mean, np.diag(fit.covariance)
    places = [nuisance.index(column) for column in roles.piston if total[column, column] > 0.0]
    areas, names = coefficients[places], [roles.names[nuisance[place]] for place in places]
    # a coefficient that is not known to its order of magnitude tells nothing
    relative_errors = np.sqrt(np.maximum(variances[places], 0.0)) / np.maximum(np.abs(areas), np.finfo(float).tiny)
    is_known = relative_errors < 1.0
    is_side_B = np.array([name in motions_of_side(equation, "B") for name in names], dtype=float)[is_known]
    logarithms = np.log(np.abs(areas[is_known])) - is_side_B * np.log(equation.area_ratio)
    energies = np.diag(total)[[nuisance[place] for place in places]][is_known]
    shares = energies / max(float(energies.max(initial=0.0)), np.finfo(float).tiny)
    covariance = np.diag((INFERENCE.between.motion**2 + relative_errors[is_known] ** 2) / shares)
    covariance += ratio_deviation**2 * np.outer(is_side_B, is_side_B)
    weights = np.linalg.inv(covariance)
    deviations = logarithms - weights.sum(axis=0) @ logarithms / max(float(weights.sum()), np.finfo(float).tiny)
    return float(deviations @ weights @ deviations)


def _whiten_steps(blocks: Blocks, roles: ColumnRoles) -> tuple[Array, Array, Array] | None:
    """Convert the estimates of leak and constant flow in K blocks to residuals with independent unit noise.

    The 2 K estimates by the first equation (K leaks, K constant flows) have the inverse covariance P. With R such that
    P = R' R, the residuals are R times the estimates. Slow changes are then projected out: level and slope of the leak,
    and a quadratic drift of the constant flow. Returns the arguments of `_find_relative_offset`, for unit steps of
    1 m^3/(s Pa) and 1 m^3/s; None if too few blocks determine the estimates.
    """
    count = len(blocks)
    # the constant flow is stated at each block's mean pressure difference `pressure`; a leak g adds g `pressure` to it
    precision, vector, pressure = estimate_leak_and_bias(blocks, roles)
    energies = np.diag(precision).reshape(2, count)  # rows: leak and constant flow; zero in some blocks at rest
    floors = np.maximum(np.finfo(float).eps * energies.max(axis=1), np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(energies, floors[:, None])).ravel()
    eigenvalues, eigenvectors = np.linalg.eigh(precision / np.outer(scale, scale))
    is_informative = eigenvalues > RANK_TOLERANCE * max(float(eigenvalues[-1]), 0.0)
    position = np.linspace(-1.0, 1.0, count)  # from the first block to the last
    trend, drift = (np.polynomial.legendre.legvander(position, degree) for degree in (1, 2))
    trend_and_drift = np.block([[trend, np.zeros_like(drift)], [pressure[:, None] * trend, drift]])
    # `MIN_BLOCKS` already includes level and slope, two of the columns of trend and drift
    if np.count_nonzero(is_informative) < trend_and_drift.shape[1] + MIN_BLOCKS - 2:
        return None
    root_eigenvalues = np.sqrt(eigenvalues[is_informative])
    whitening = (eigenvectors[:, is_informative] * root_eigenvalues).T * scale  # R, informative directions only
    slow_changes = whitening @ trend_and_drift
    slow_changes /= np.maximum(np.linalg.norm(slow_changes, axis=0), np.finfo(float).tiny)
    complement = np.linalg.qr(slow_changes, mode="complete")[0][:, slow_changes.shape[1] :].T  # orthogonal to these
    # R times the estimates, which are P^-1 vector
    residuals = complement @ ((eigenvectors[:, is_informative].T @ (vector / scale)) / root_eigenvalues)
    unit_steps = np.tril(np.ones((count, count)))  # column k: 1 from block k on
    flow_offset = complement @ whitening[:, count:]
    leak = complement @ whitening[:, :count] + flow_offset * pressure
    return leak @ unit_steps, flow_offset @ unit_steps, residuals


#: Channels whose delay is tested.
DELAYED = ("x", "p_A", "p_B")
#: Largest number of changes that are removed from one recording, and of corrections of the size of each.
MAX_CHANGES, MAX_CORRECTIONS = 4, 4
#: Fraction of the information on a delay below which a block has none, once other coefficients are free in it.
MIN_INFORMATION = 1e-6


class DelayTest(NamedTuple):
    """Test for a change of the delay of a `channel`, at the onset [s] of `test`, the step test of its term.

    `change`: fitted change [s], positive if the channel arrives later than before; `log_odds`: posterior log odds that
    the delay has changed; `onset`: time of the change, estimated with the same compliances in all blocks.
    """

    channel: str
    test: StepTest
    change: Estimate
    log_odds: float
    onset: Interval


class DelayChange(NamedTuple):
    """Change of the delay of a `channel` by `seconds`, positive if it arrives later than before, at an `onset` [s].

    `rival_channel`: that of the flow, if the position may instead be unchanged and the flow be earlier by as much; else
    "".
    """

    channel: str
    seconds: float
    onset: Interval
    rival_channel: str = ""


def drop_delay_columns(blocks: Blocks, roles: ColumnRoles) -> Blocks:
    """Drop the columns that `equations.balances.with_delays` adds from Gram matrices with the given `roles`."""
    added = {delay_name(channel) for channel in DELAYED}
    names = (*roles.names, "left")  # the last column is the left side of the balance
    kept = [k for k, name in enumerate(names) if name not in added]
    return replace(blocks, gram=np.asarray(blocks.gram[..., kept, :][..., kept]))


class SampleClock(NamedTuple):
    """Sampling of a recording: its `rate` [Hz], time of the first sample `begin` [s], and channel of the pump's flow.

    `flow_channel` is "" if no channel shows the flow.
    """

    rate: float
    begin: float
    flow_channel: str


class AlignedSamples(NamedTuple):
    """Samples of a recording without changes of delays: arrays by channel name, and their blocks with delay columns.

    `changes`: changes that were removed; `tests`: one test for each channel, of its first change if there is one.
    """

    samples: Mapping[str, Array]
    blocks: Blocks
    changes: tuple[DelayChange, ...]
    tests: tuple[DelayTest, ...]


def align_samples(
    samples: Mapping[str, Array],
    blocks: Blocks,
    compute_blocks: Callable[[Mapping[str, Array]], Blocks | None],
    columns: Sequence[ColumnRoles],
    clock: SampleClock,
) -> AlignedSamples:
    """Find changes of the delays of channels within a recording, and shift the channels back.

    `samples`: arrays by channel name; `blocks`: their blocks, with the roles `columns`, which include the columns of
    delays; `compute_blocks` computes those of shifted samples, None if there are too few.
    """
    changes, found = list[DelayChange](), dict[str, DelayTest]()
    while True:
        tests = {test.channel: test for test in score_delays(blocks, columns, clock)}
        best = max(tests.values(), key=lambda test: test.log_odds, default=None)
        if best is None or best.log_odds <= 0.0 or len(changes) == MAX_CHANGES:
            break
        shift = _find_shift(samples, best, compute_blocks, columns, clock)
        # the test is of the first order in the delay: the shifted channel itself must describe the flow better
        if shift is None or not shift.residual < _residual_square(blocks, columns):
            break
        samples, blocks = shift.samples, shift.blocks
        found.setdefault(best.channel, best)
        changes.append(DelayChange(shift.channel, shift.seconds, best.onset, shift.rival_channel))
    return AlignedSamples(samples, blocks, tuple(changes), tuple({**tests, **found}.values()))


def score_delays(blocks: Blocks, columns: Sequence[ColumnRoles], clock: SampleClock) -> list[DelayTest]:
    """Test the delay of each channel for a step, while leakage, constant flow and compliances are free in each block.

    A channel is left out if the balance has no column for its delay, or if too few blocks show it. The interval of the
    onset is widened by half a test function, since a row shows a part of a change within it.
    """
    coarse = blocks.merge(INFERENCE.blocks.coarse)  # a delay need be dated to a fraction of the recording only
    leakage = [_leakage_columns(roles) for roles in columns]
    leak_free = _free_in_blocks(coarse, columns, leakage)
    all_free = _free_in_blocks(
        coarse, columns, [[*free, *roles.compliance] for free, roles in zip(leakage, columns, strict=True)]
    )
    total = coarse.gram.sum(axis=0)
    tests = []
    for channel in DELAYED:
        index, unit = _delay_column(columns[0], channel), _coefficient_per_second(total[0], columns[0], channel)
        if index is None or not unit:
            continue
        test, dating_test = (_score_delay(coarse, reduced, columns, index) for reduced in (all_free, leak_free))
        if test is None or dating_test is None:
            continue
        change = Estimate(test.sign * test.fitted.value / unit, test.fitted.deviation / abs(unit))
        (value, low, high), margin = dating_test.onset(), half_width(clock.rate)
        onset = Interval(value, low - margin, high + margin)
        tests.append(DelayTest(channel, test, change, _change_log_odds(test, change), onset))
    return tests


def _leakage_columns(roles: ColumnRoles) -> list[int | None]:
    """Return the indices of leakage by either law, laminar or through an orifice, and of the constant flow."""
    return [roles.leak, roles.names.index(ORIFICE) if ORIFICE in roles.names else None, roles.bias]


def _delay_column(roles: ColumnRoles, channel: str) -> int | None:
    """Return the index of the column of a channel's delay, None if the balance has none."""
    names = (LAG, delay_name(channel)) if channel == "x" else (delay_name(channel),)
    return next((roles.names.index(name) for name in names if name in roles.names), None)


def _free_in_blocks(blocks: Blocks, columns: Sequence[ColumnRoles], free: Sequence[Sequence[int | None]]) -> Blocks:
    """Eliminate coefficients that are free in each block from its Gram matrices.

    `free`: indices of their columns for each equation, None for a column that an equation lacks.
    """
    gram = blocks.gram.copy()
    for e in range(len(columns)):
        indices = sorted({index for index in free[e] if index is not None})
        for k, block in enumerate(gram[:, e]):
            # not `Gaussian.drop`: where two channels explain a delay alike, the last digits choose between them
            gram[k, e] -= block[:, indices] @ solve(block[np.ix_(indices, indices)], block[indices])
        gram[:, e, indices] = 0.0
        gram[:, e, :, indices] = 0.0
    return replace(blocks, gram=gram)


def _score_delay(blocks: Blocks, reduced: Blocks, columns: Sequence[ColumnRoles], index: int) -> StepTest | None:
    """Test the coefficient of a delay's column, `index`, for a step in blocks with coefficients that are free in each.

    `reduced`: the blocks after `_free_in_blocks`. Those that then tell nothing of the column are dropped. Return None
    if too few remain.
    """
    energy, reduced_energy = (series.gram[..., index, index] for series in (blocks, reduced))
    is_informed = reduced_energy > MIN_INFORMATION * energy
    if np.count_nonzero(is_informed.any(axis=1)) < MIN_BLOCKS:
        return None
    is_kept = is_informed | (energy == 0.0)  # an equation without the column tells the other coefficients
    informed = replace(reduced, gram=np.where(is_kept[..., None, None], reduced.gram, 0.0))
    return step_test(information(informed, columns, index), signs=(1.0, -1.0))


def _coefficient_per_second(total: Array, roles: ColumnRoles, channel: str) -> float:
    """Compute the coefficient of a channel's delay column for a delay of 1 s, from its fitted contribution; 0 if none.

    It is the regression coefficient of the fitted volume that the channel contributes on the channel itself, such as
    the piston's area [m^2] of a position. `total` (m, m): Gram matrix of the recording.
    """
    if channel == "x":
        parts = [k for k in roles.motion if roles.names[k].startswith("motion")]
        reference = parts
        if not parts:  # behind a servo valve, the column is the displaced volume itself
            return 1.0
    else:
        side = channel[-1]
        parts = [k for k in roles.compliance if f" {side}" in roles.names[k]]
        reference = parts[:1]  # the constant compliance, whose increments are those of the pressure
    if not parts:
        return 0.0
    nuisance = list(roles.nuisance)
    fitted = dict(zip(nuisance, Gaussian.from_gram(total).among(nuisance).mean, strict=True))
    products = total[np.ix_(parts, reference)].sum(axis=1) @ [fitted[k] for k in parts]
    return float(products) / max(float(total[np.ix_(reference, reference)].sum()), np.finfo(float).tiny)


def _change_log_odds(test: StepTest, change: Estimate) -> float:
    """Compute the posterior log odds that a delay has changed, by the formula of the module.

    The density of the change is log-normal in its magnitude, for either sign.
    """
    prior = INFERENCE.delay
    size = max(abs(change.value), np.finfo(float).tiny)
    log_density = -0.5 * step_penalty(size, prior) - np.log(2.0 * np.sqrt(2.0 * np.pi) * prior.spread * size)
    log_mean = float(np.log(np.mean(np.exp(test.likelihood - test.likelihood.max()))))
    log_occam = float(np.log(np.sqrt(2.0 * np.pi) * max(change.deviation, np.finfo(float).tiny)) + log_density)
    return float(np.log(prior.odds)) + 0.5 * test.score + log_mean + min(log_occam, 0.0)


class _Shift(NamedTuple):
    """A `channel` whose delay changed by `seconds`: the `samples` without the change, and their `blocks`.

    `residual`: mean square of the rows' residuals; `rival_channel`: as in `DelayChange`.
    """

    channel: str
    seconds: float
    samples: Mapping[str, Array]
    blocks: Blocks
    residual: float
    rival_channel: str = ""


def _find_shift(
    samples: Mapping[str, Array],
    found: DelayTest,
    compute_blocks: Callable[[Mapping[str, Array]], Blocks | None],
    columns: Sequence[ColumnRoles],
    clock: SampleClock,
) -> _Shift | None:
    """Find the shift of a channel that removes a change of a delay; None if the samples then allow no blocks.

    A change of the position's delay may as well be one of the flow, by as much in the other direction. The one that
    leaves the smaller residual counts, and if the difference is not clear the position, with the flow as
    `rival_channel`.
    """
    by_channel = _fit_shift(samples, found, found.channel, 1.0, compute_blocks, columns, clock)
    if by_channel is None or found.channel != "x" or not clock.flow_channel:
        return by_channel
    by_flow = _fit_shift(samples, found, clock.flow_channel, -1.0, compute_blocks, columns, clock)
    if by_flow is None:
        return by_channel
    tiny = float(np.finfo(float).tiny)
    log_odds = compare_residuals(max(by_channel.residual, tiny), max(by_flow.residual, tiny))  # of the position
    if abs(log_odds) < np.log(1.0 / INFERENCE.delay.other):
        return by_channel._replace(rival_channel=clock.flow_channel)
    return by_channel if log_odds > 0.0 else by_flow


def _fit_shift(
    samples: Mapping[str, Array],
    found: DelayTest,
    channel: str,
    sign: float,
    compute_blocks: Callable[[Mapping[str, Array]], Blocks | None],
    columns: Sequence[ColumnRoles],
    clock: SampleClock,
) -> _Shift | None:
    """Fit the shift of a `channel` that removes the change of delay `found`, by Gauss-Newton steps.

    `sign`: that of the channel's change over the change of `found`. Return None if the shifted samples allow no blocks.
    """
    onset, seconds, shift = found.onset, sign * found.change.value, None
    for _ in range(MAX_CORRECTIONS):
        shifted = {**samples, channel: shift_back(samples[channel], seconds, onset, clock)}
        blocks = compute_blocks(shifted)
        if blocks is None or len(blocks) < MIN_BLOCKS:
            break
        shift = _Shift(channel, seconds, shifted, blocks, _residual_square(blocks, columns))
        remaining = _remaining_change(blocks, columns, found)
        if remaining is None or abs(remaining.value) <= remaining.deviation:
            break
        seconds += sign * remaining.value
    return shift


def _remaining_change(blocks: Blocks, columns: Sequence[ColumnRoles], found: DelayTest) -> Estimate | None:
    """Estimate the change of a delay [s] that remains at the onset of a change that was found; None if unknown."""
    coarse = blocks.merge(INFERENCE.blocks.coarse)
    index = _delay_column(columns[0], found.channel)
    unit = _coefficient_per_second(coarse.gram.sum(axis=0)[0], columns[0], found.channel)
    if index is None or not unit:
        return None
    delay = information(coarse, columns, index)
    test = step_test(delay)
    if test is None:
        return None
    nearest = np.array([int(np.abs(test.onsets - found.onset.value).argmin())])
    _, sizes, deviations = step_sizes(delay, nearest, np.ones(len(coarse)), 0.0)
    return Estimate(float(sizes[0]) / unit, float(deviations[0]) / abs(unit))


def _residual_square(blocks: Blocks, columns: Sequence[ColumnRoles]) -> float:
    """Compute the mean square of the rows' residuals, after a fit of all coefficients that any machine has.

    Leakage and constant flow are free in each block.
    """
    free = [_leakage_columns(roles) for roles in columns]
    total = _free_in_blocks(blocks.merge(INFERENCE.blocks.coarse), columns, free).gram.sum(axis=0)
    square = 0.0
    for equation, roles in zip(total, columns, strict=True):
        nuisance = [k for k in roles.nuisance if k not in (roles.leak, roles.bias)]
        square += Gaussian.from_gram(equation).among(nuisance).residual_square
    return max(square, 0.0) / max(float(blocks.rows.sum()), 1.0)


def shift_back(values: Array, seconds: float, onset: Interval, clock: SampleClock) -> Array:
    """Undo a delay of a channel by `seconds` (negative: an advance) that began within the interval `onset` [s].

    `values` (n,): samples of the `clock`. Values after the onset's interval are interpolated by cubics through four
    samples. Those within the interval, and those without samples, become NaN.
    """
    shift = seconds * clock.rate
    whole = int(np.floor(shift))
    fraction = shift - whole
    count = len(values)
    weights = (  # Lagrange's cubic through the samples -1, 0, 1, 2
        -fraction * (fraction - 1.0) * (fraction - 2.0) / 6.0,
        (fraction + 1.0) * (fraction - 1.0) * (fraction - 2.0) / 2.0,
        -(fraction + 1.0) * fraction * (fraction - 2.0) / 2.0,
        (fraction + 1.0) * fraction * (fraction - 1.0) / 6.0,
    )
    indices = np.arange(count) + whole
    shifted = np.zeros(count)
    for step, weight in zip((-1, 0, 1, 2), weights, strict=True):
        if weight:
            source = indices + step
            is_recorded = (source >= 0) & (source < count)
            shifted += weight * np.where(is_recorded, values[np.clip(source, 0, count - 1)], np.nan)
    time = clock.begin + np.arange(count) / clock.rate
    aligned = np.where(time > onset.high, shifted, values)
    aligned[(time >= onset.low) & (time <= onset.high)] = np.nan
    return aligned
