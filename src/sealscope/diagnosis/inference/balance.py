"""Blocks of a balance from samples: of a recording, whole, or of a stream, piece by piece, by the same sums."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sealscope.control.drive import Drive
from sealscope.diagnosis.inference.blocks import Blocks, Columns, Weighting, solve
from sealscope.diagnosis.inference.onset import FEWEST
from sealscope.diagnosis.inference.regimes import apply_regime, has_rests, shut_odds
from sealscope.diagnosis.inference.rows.distribution import distribution
from sealscope.diagnosis.inference.rows.row_weights import RIDGE, SUPPORT
from sealscope.diagnosis.inference.rows.weak_form import (
    OVERLAP,
    SPAN,
    STRIDE,
    rows,
    stride_samples,
    weights_beside_holes,
)
from sealscope.diagnosis.inference.terms import (
    AVERAGED,
    CYLINDER,
    HALF_DIFFERENCE,
    LEAST_ABSOLUTE,
    LEAST_REST,
    REST_LEAK,
    START,
    Equation,
    Signals,
    equations,
    shut_at_rest,
    with_rests,
)
from sealscope.diagnosis.inference.zero import about_zero
from sealscope.diagnosis.priors import priors
from sealscope.recordings.channels import flow_source
from sealscope.recordings.corrections.gaps import holes
from sealscope.recordings.quality import clipped
from sealscope.recordings.recording import Array, Recording
from sealscope.storage.plain_state import array_of, part_of, plain_array
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_BLOCKS = priors("inference")["blocks"]
LONGEST: float = _BLOCKS["longest"]
SHORTEST: float = _BLOCKS["shortest"]
#: Turns by which the terms are taken about a zero of p_A - p_B, and how near to it they are, as a share of what is
#: believed of one: a root is not linear in it, nor is which side carries.
TURNS, NEAR = 2, 3.0
#: The name of the samples that are 1 in a hole that was bridged, else 0; absent where there is none.
HOLE = "hole"
#: Samples whose increments are computed at once: they stay in the processor's cache.
AT_ONCE = 8192


class BlockStream:
    """Blocks of a stream of samples; the same for pieces of any size.

    Parameters
    ----------
    balances : sequence of Equation
        The machine's balances (`terms.equations`).
    rate : float
        Sampling rate [Hz].
    seconds : float
        Length of a block [s], rounded to whole strides of the weak form.
    support : int, optional
        Blocks at the beginning whose rows are weighted together; None: all that are pushed at first.
    start : float, optional
        Time of the first sample [s].
    zero : float, optional
        What p_A - p_B reads too much [Pa].
    """

    def __init__(
        self,
        balances: Sequence[Equation],
        rate: float,
        seconds: float = LONGEST,
        support: int | None = SUPPORT,
        start: float = 0.0,
        zero: float = 0.0,
    ) -> None:
        self.columns = tuple(Columns(balance) for balance in balances)
        self._balances, self._rate, self._zero = balances, rate, zero
        self._stride = stride_samples(rate)
        self._strides = max(SPAN, round(seconds / STRIDE))
        self._margin = max(1, round(HALF_DIFFERENCE * rate)) + 2
        self._finds_rests = any(REST_LEAK in columns.names for columns in self.columns)
        if self._finds_rests:
            self._margin += round(AVERAGED * rate) + round(LEAST_REST * rate)
        self._still = (-1.0, -1.0)
        self._weighting, self._support = Weighting(self.columns), support
        self._zeros: dict[str, float] | None = None
        self._signs: tuple[float, ...] = ()
        self.restart(start)

    def restart(self, begin: float) -> None:
        """Take samples from the clock `begin` [s] on, after a gap; what was pushed before it is dropped."""
        self._begin = begin
        self._pieces: list[Mapping[str, Array]] = []  # joined only when they complete a block
        self._first = 0  # index, since `begin`, of the first sample that is kept
        self._have = 0  # ... and one past the last
        self._done = 0  # blocks since then that are closed

    def push(self, samples: Mapping[str, Array], last: bool = False) -> Blocks | None:
        """Take the next samples, each channel of the same length; return the blocks they complete, None for none.

        A missing sample is NaN. `last`: nothing follows, so that what remains is closed as well.
        """
        if samples:
            self._pieces.append(samples)
            self._have += len(next(iter(samples.values())))
        length = self._strides * self._stride
        tail = (SPAN - 1) * self._stride + 1 + (0 if last else self._margin)
        count = max(0, (self._have - tail) // length)
        waits = 1 if last or self._weighting.has_blocks else self._support or 1
        if count <= self._done or (self._done == 0 and count < waits):
            return None
        joined = self._join_pieces()
        ends = [count]
        if self._support is not None:  # those that support the stream together, then one by one, whatever the pieces
            first = self._done + 1 if self._weighting.has_blocks else min(self._support, count)
            ends = list(range(first, count + 1))
        parts = [self._close(joined, *pair) for pair in zip([self._done, *ends[:-1]], ends, strict=True)]
        blocks = parts[0] if len(parts) == 1 else Blocks.join(parts)
        self._done = count
        first_kept = max(0, count * length - self._margin)
        self._pieces = [{name: values[first_kept - self._first :].copy() for name, values in joined.items()}]
        self._first = first_kept
        return blocks

    def _join_pieces(self) -> dict[str, Array]:
        if len(self._pieces) == 1:
            return dict(self._pieces[0])
        names = self._pieces[0] if self._pieces else ()
        return {name: np.concatenate([piece[name] for piece in self._pieces]) for name in names}

    def state(self) -> dict[str, Any]:
        """Return the state of the stream in plain values for JSON."""
        return {
            "samples": {name: plain_array(values) for name, values in self._join_pieces().items()},
            "begin": self._begin,
            "first": self._first,
            "done": self._done,
            "zeros": self._zeros,
            "signs": list(self._signs),
            "weighting": self._weighting.state(),
        }

    def recall(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` with the same bits; raises InputError where it does not fit."""
        samples = part_of(state, "samples", Mapping)
        self.restart(float(part_of(state, "begin", (float, int))))
        self._pieces = [{name: array_of(values, name) for name, values in samples.items()}] if samples else []
        self._first, self._done = (int(part_of(state, name, int)) for name in ("first", "done"))
        self._have = self._first + min((len(values) for piece in self._pieces for values in piece.values()), default=0)
        zeros = part_of(state, "zeros", (Mapping, type(None)))
        self._zeros = None if zeros is None else {name: float(value) for name, value in zeros.items()}
        self._signs = tuple(float(sign) for sign in part_of(state, "signs", Sequence))
        self._weighting.recall(part_of(state, "weighting", Mapping))

    def _oriented(self, rows: Sequence[Array]) -> tuple[float, ...]:
        """Return the sign of each left side: an encoder, or the sides, may be connected the other way round.

        Friction takes work, so that p_A - p_B goes with the flow into A; oil leaks from the higher pressure to the
        lower; and where x grows with the flow into A, as it should, the sides are seldom exchanged. Each is a number z
        in its deviations, whose sign is right with probability Phi(z) but for the share of machines where something
        else makes it.
        """
        signs = []
        for balance, columns, values in zip(self._balances, self.columns, rows, strict=True):
            pressure, left = values[:, columns.leak], balance.takes * values[:, columns.left]
            moved = values[:, [k for k in columns.motion if columns.names[k].startswith("motion")]].sum(axis=1)
            odds = _odds(_leaks(values.T @ values, columns, len(values)), "leak")
            odds += _odds(_in_deviations((pressure - pressure.mean()) * left), "work") if len(values) else 0.0
            if (agreement := _in_deviations(moved * left)) > 0.0:  # else either may be the other way round
                odds += _odds(agreement, "sides")
            signs.append(-1.0 if odds < 0.0 else 1.0)
        return tuple(signs)

    def _close(self, samples: Mapping[str, Array], first: int, end: int) -> Blocks:
        """Return blocks `first` to `end`, whose rows are weighted together."""
        length = self._strides * self._stride
        if self._zeros is None:
            early = slice(0, (self._support or end) * length)
            self._zeros = {name: _gauge_to_absolute(samples[name][early]) for name in ("p_A", "p_B") if name in samples}
        if self._finds_rests and self._still[0] < 0.0:
            signals = Signals(samples, self._rate, self._zeros)
            left, moved = self._balances[0].left(signals), signals.step("x")
            self._still = still_rate(left, self._rate), still_rate(moved, self._rate)
        batch = max(1, AT_ONCE // length)
        cuts = [self._cut_rows(samples, k, min(k + batch, end)) for k in range(first, end, batch)]
        weights = np.concatenate([cut.weights for cut in cuts])
        counted, roots = weights > 0.0, np.sqrt(weights[weights > 0.0])[:, None]
        values = [np.concatenate(pieces)[counted] * roots for pieces in zip(*(cut.rows for cut in cuts), strict=True)]
        self._signs = self._signs or self._oriented(values)
        for equation_rows, columns, sign in zip(values, self.columns, self._signs, strict=True):
            equation_rows[:, columns.left] *= sign
        gram = self._weighting.close(values, np.cumsum(counted.reshape(-1, self._strides).sum(axis=1)))
        index = np.arange(first, end, dtype=float)
        start = self._begin + (index * self._strides + 0.5 * SPAN) * (self._stride / self._rate)
        last = start + (self._strides - 1) * self._stride / self._rate
        flow, pressures = (np.concatenate([getattr(cut, name) for cut in cuts]) for name in ("flow", "pressures"))
        zeros = np.full(end - first, self._zero)
        return Blocks(start, last, gram, weights.reshape(-1, self._strides).sum(axis=1), flow, pressures, zeros)

    def _cut_rows(self, samples: Mapping[str, Array], first: int, end: int) -> _Cut:
        """Return the rows of blocks `first` to `end`."""
        length = self._strides * self._stride
        start = first * length
        begin = max(self._first, start - self._margin)
        stop = end * length + (SPAN - 1) * self._stride + 1
        reach = stop + self._margin - self._first
        cut = {name: values[begin - self._first : reach] for name, values in samples.items()}
        signals = Signals(cut, self._rate, self._zeros or {}, self._zero, self._still)
        inner = slice(start - begin, stop - 1 - begin)
        whole = np.ones((end - first) * self._strides, dtype=bool)
        cut_rows, lefts = [], [balance.left(signals) for balance in self._balances]
        for balance, left in zip(self._balances, lefts, strict=True):
            columns = [*(term.increments(signals) for term in balance.terms), left]
            weak_rows = rows([column[inner] for column in columns], self._rate)
            whole &= weak_rows.whole
            cut_rows.append(weak_rows.values)
        within = slice(start - begin, start - begin + (end - first) * length)
        pressure = (cut["p_A"] - cut["p_B"])[within].reshape(-1, length)
        rate = np.abs(lefts[0][within].reshape(-1, length)) * self._rate
        known = np.isfinite(rate)
        flow = np.where(known, rate, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        parts = np.array([distribution(block, self._rate) for block in pressure])
        hole_weights = weights_beside_holes(cut[HOLE][inner.start : inner.stop + 1], self._rate) if HOLE in cut else 1.0
        return _Cut(tuple(cut_rows), np.where(whole, hole_weights, 0.0), flow, parts)


class _Cut(NamedTuple):
    """Rows (r, m) of each equation, the weight of each (r,), and `Blocks.flow` and `Blocks.pressures`.

    A row counts as a share of one that no hole touches, and not at all where a sample is missing.
    """

    rows: tuple[Array, ...]
    weights: Array
    flow: Array
    pressures: Array


def _in_deviations(products: Array) -> float:
    """Return the sum of products of two numbers a row over its deviation, were they independent."""
    size = float(np.linalg.norm(products) * np.sqrt(OVERLAP))
    return float(products.sum()) / max(size, float(np.finfo(float).tiny))


def _odds(z: float, what: str) -> float:
    """Return the logarithm of the odds that a sign is right."""
    from scipy.special import ndtr

    other = 0.5 * priors("inference")["sense"][what]
    return float(np.log((ndtr(z) + other) / (ndtr(-z) + other)))


def _leaks(gram: Array, columns: Columns, count: int) -> float:
    """Return the leak's coefficient over its deviation, by least squares over all rows; 0 where nothing tells it."""
    nuisance = [k for k in columns.nuisance if k != columns.leak]
    right = gram[np.ix_(nuisance, [columns.leak, columns.left])]
    solved = solve(gram[np.ix_(nuisance, nuisance)], right)
    rest = gram[np.ix_([columns.leak, columns.left], [columns.leak, columns.left])] - right.T @ solved
    energy, lead, square = float(rest[0, 0]), float(rest[0, 1]), float(rest[1, 1])
    if not energy > RIDGE * float(gram[columns.leak, columns.leak]) or count <= len(nuisance) + 1:
        return 0.0
    variance = OVERLAP * max(square - lead * lead / energy, 0.0) / (count - len(nuisance) - 1)
    return lead / max(float(np.sqrt(variance * energy)), np.finfo(float).tiny)


def still_rate(increments: Array, rate: float) -> float:
    """Compute the largest mean rate at rest of what moves by increments: a share of that in motion, or its noise."""
    flow = increments[np.isfinite(increments)] * rate
    size = np.abs(flow)
    moving = float(size @ size) / max(float(size.sum()), np.finfo(float).tiny)
    sixth = np.abs(np.diff(flow, 6))  # of white noise they have 924 times its variance
    noise = 1.4826 * float(np.median(sixth)) / math.sqrt(924.0) if len(sixth) else 0.0
    share: float = priors("inference")["rest"]["share"]
    return max(share * moving, 3.0 * noise / math.sqrt(max(1.0, AVERAGED * rate)))


def _gauge_to_absolute(pressure: Array) -> float:
    """Compute the offset from gauge to absolute pressure: the atmosphere, or more where the zero is surely too low."""
    finite = pressure[np.isfinite(pressure)]
    lowest = float(np.min(finite)) if finite.size else 0.0
    return max(P_ATM, LEAST_ABSOLUTE - lowest)


def whole_samples(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples of channels, NaN in `holes` and where a pressure is cut off at an end of its range."""
    samples = bridged_samples(recording, names)
    gaps = samples.pop(HOLE, np.zeros(0)) > 0.0
    return {name: np.where(gaps, np.nan, values) for name, values in samples.items()} if gaps.any() else samples


def bridged_samples(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples of channels, NaN where a pressure is cut off at an end of its range; `HOLE`: 1 in `holes`."""
    samples, gaps = {}, holes(recording)
    if gaps.any():
        samples[HOLE] = gaps.astype(float)
    for name in recording.channels:
        if name not in names:
            continue
        values = recording[name]
        rails = [rail.value for rail in clipped(values[np.isfinite(values)])] if name.startswith("p_") else []
        samples[name] = np.where(np.isin(values, rails), np.nan, values) if rails else values
    return samples


def commanded(samples: Mapping[str, Array], rig: Rig, rate: float, *, loaded: bool = False) -> dict[str, Array]:
    """Return the samples of a pump with what fades of its drive's start (`START`), and with the speed if none is there.

    The speed is what the drive makes of the command; a missing command is held, and the speed is missing with it.
    `loaded`: under p_A - p_B, whose sense is that of the command; else what the load costs the drive is in the leak's
    level.
    """
    drive = Drive.from_rig(rig)
    derived = {START: np.exp(-np.arange(len(samples["p_A"])) / (rate * drive.lag))}
    if flow_source(samples) == "u":
        u, load = _hold_missing(samples["u"]), np.zeros(len(samples["u"]))
        if loaded:
            dp = _hold_missing(samples["p_A"] - samples["p_B"])
            load = dp if float((u - u.mean()) @ (dp - dp.mean())) >= 0.0 else -dp
        speed = drive.flow(u, load, rate) / drive.displacement
        derived["omega"] = np.where(np.isnan(samples["u"]), np.nan, speed)
    return {**samples, **derived}


def _hold_missing(values: Array) -> Array:
    """Fill each missing value of an array (n,) with the one before it; 0 at the beginning."""
    last = np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(len(values))))
    return np.where(last < 0, 0.0, values[last])


def shortest(rate: float) -> int:
    """Return the fewest samples of a recording from which a step can be told: `FEWEST` blocks."""
    stride = stride_samples(rate)
    return FEWEST * max(SPAN, round(SHORTEST / STRIDE)) * stride + (SPAN - 1) * stride + 1


class RegimeBlocks(NamedTuple):
    """Blocks of a recording by one hypothesis of what rests do (`regimes`), with its equations and columns.

    `blocks` are about the zero of p_A - p_B that a change of the leak needs, `plain` as recorded; `shut`: the pump is
    cut off at rest.
    """

    blocks: Blocks
    plain: Blocks
    equations: tuple[Equation, ...]
    columns: tuple[Columns, ...]
    shut: bool = False


class RecordedBlocks(NamedTuple):
    """Blocks of a recording by either hypothesis, `shut` None where the pump never rests.

    `odds`: logarithm of those of the pump being cut off at rest.
    """

    open: RegimeBlocks
    shut: RegimeBlocks | None
    odds: float

    def regime(self, odds: float) -> RegimeBlocks:
        """Return the blocks by the hypothesis that has the `odds` of all that is known of the machine."""
        return self.shut if self.shut is not None and odds > 0.0 else self.open


def recorded_blocks(recording: Recording, rig: Rig) -> RecordedBlocks | None:
    """Return the blocks of a recording by either hypothesis of what rests do; None where it allows no balance."""
    names = frozenset(name for name in recording.channels if name in _READ)
    balances = equations(rig, names)
    if not balances:
        return None
    pumped = balances[0].name == CYLINDER and not balances[0].by_command
    streamed = tuple(with_rests(balance) for balance in balances) if pumped else balances
    needed = {"x", "p_A", "p_B", str(flow_source(names))}
    needed |= {name for balance in balances for term in balance.terms for name in term.needs}
    samples = bridged_samples(recording, needed)
    if balances[0].by_command:
        samples = commanded(samples, rig, recording.rate)
    seconds = min(LONGEST, max(SHORTEST, recording.duration / _BLOCKS["wanted"]))

    def close(zero: float) -> tuple[Blocks, tuple[Columns, ...]] | None:
        stream = BlockStream(streamed, recording.rate, seconds, None, float(recording.t[0]), zero)
        blocks = stream.push(samples, last=True)
        return None if blocks is None else (blocks, stream.columns)

    recorded = close(0.0)
    if recorded is None:
        return None
    if not pumped:
        return RecordedBlocks(_in_regime(recorded, balances, close, shut=None), None, 0.0)
    odds = shut_odds(recorded[0], recorded[1][0])
    return RecordedBlocks(
        _in_regime(recorded, balances, close, shut=False),
        _in_regime(recorded, balances, close, shut=True) if has_rests(recorded[0], recorded[1][0]) else None,
        odds,
    )


def _in_regime(
    recorded: tuple[Blocks, tuple[Columns, ...]],
    balances: tuple[Equation, ...],
    close: Callable[[float], tuple[Blocks, tuple[Columns, ...]] | None],
    shut: bool | None,
) -> RegimeBlocks:
    """Return recorded blocks by a hypothesis, about their zero; None: the only one."""
    balances = tuple(shut_at_rest(balance) for balance in balances) if shut else balances
    columns = tuple(Columns(balance) for balance in balances)

    def turned(blocks: Blocks, streamed: tuple[Columns, ...]) -> Blocks:
        return blocks if shut is None else apply_regime(blocks, streamed[0], shut)

    plain = turned(*recorded)
    blocks = about_zero(plain, columns)
    for _ in range(TURNS - 1):
        zero = float(blocks.zero[0])
        if abs(zero) < NEAR * priors("inference")["zero"]["pressure"]:
            break
        again = close(zero)
        if again is None:
            break
        blocks = about_zero(turned(*again), columns)
    return RegimeBlocks(blocks.merged(), plain.merged(), balances, columns, bool(shut))


def blocks_of(recording: Recording, rig: Rig) -> tuple[Blocks, Blocks, tuple[Columns, ...]] | None:
    """Return the blocks of a recording and where their columns stand; None where its channels allow no balance.

    They come twice: about the zero of p_A - p_B that a change of the leak needs, and as recorded.
    """
    recorded = recorded_blocks(recording, rig)
    if recorded is None:
        return None
    regime = recorded.regime(recorded.odds)
    return regime.blocks, regime.plain, regime.columns


_READ = ("u", "omega", "theta", "q_pump", "x", "p_1", "p_2", "p_A", "p_B")
