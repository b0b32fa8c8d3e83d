"""The volume balance of a running machine: the leakage conductance in each block of a few seconds.

The blocks are cut as in a recording (`block_stream.BlockStream`). All coefficients of the balance but the leak's
are estimated recursively from the last blocks (`coefficients`). The conductance is the sum of piston and pump, which
lie in parallel; `sequential` tests it for a step. In an open circuit valves cut the pump off at rest (`regimes`): the
pump's own leakage is free in each block, and the conductance is that of the piston, from rests under load; a flow whose
sign had to be restored shows only both together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from sealscope.compiled import kernel
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.block_stream import BlockStream
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.changes.volumes import VOLUMES, volume_observables
from sealscope.diagnosis.inference.equations.balances import equations, shut_at_rest
from sealscope.diagnosis.inference.equations.terms import PUMP, STATES, Equation, Flow
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.regimes import NEGLIGIBLE
from sealscope.diagnosis.inference.rows import stride_samples
from sealscope.diagnosis.inference.sensor_errors import remove_pressure_offset
from sealscope.diagnosis.live.coefficients import (
    MIN_REST_PRECISION,
    MISFIT,
    NOISE,
    OUTDATED,
    STANDSTILL,
    TINY,
    UNCERTAIN,
    Coefficients,
    add_block,
    coefficient_shapes,
    estimate_leak,
    fit_coefficients,
    is_waking,
    judge_estimate,
    load_block,
    relative_motion,
)
from sealscope.diagnosis.live.explanation import MIN_BLOCKS, WINDOW, SignalWindow
from sealscope.diagnosis.live.joining import SampleRun, format_ways
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS, flow_source
from sealscope.recordings.quality import sensor_limit
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import (
    SavedAttributes,
    require_part,
    restore_array,
    restore_attributes,
    save_attributes,
)
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRIORS = LIVE.block
#: Approximate duration of a block [s], and blocks before the first estimate.
BLOCK_SECONDS: float = _PRIORS.seconds
LEARNED: int = _PRIORS.learned
#: What `is_waking` and `judge_estimate` count; the precision of a usual block's conductance is 0 before the first fit.
_JUDGED = np.dtype([("usual_precision", "f8"), ("n_moving", "i8"), ("n_still", "i8")])


class BlockConductance(NamedTuple):
    """Leakage conductance of the machine in one block, and the pressure and flow at which it was measured."""

    # times at which the samples of the block begin and end [s]
    begin: float
    end: float
    # conductance of pump and piston, comparable between blocks, and its standard error [m^3/(s Pa)]
    g: float
    sd: float
    total: float  # conductance with the latest estimates of the other coefficients [m^3/(s Pa)]
    offset: float  # standard error that is common to all blocks, due to the other coefficients [m^3/(s Pa)]
    pressure: float  # mean of abs(p_A - p_B) [Pa]
    pump_flow: float  # mean absolute flow that moves the piston [m^3/s]

    @property
    def lpm(self) -> float:
        """Factor from a conductance to the flow at the mean |p_A - p_B| of the block [L/min per m^3/(s Pa)]."""
        return self.pressure / LITRE_PER_MINUTE

    @property
    def duty(self) -> tuple[float, float]:
        """Logarithms of the block's mean |p_A - p_B| [Pa] and mean pump flow [m^3/s]; finite even for 0."""
        return math.log(max(self.pressure, TINY)), math.log(max(self.pump_flow, TINY))


class NotJudged(NamedTuple):
    """Reason why a block has no estimate of its leakage."""

    end: float  # end of the block [s]
    status: str  # the reason in words; "" for samples before the first block
    counter: str = ""  # name of the counter to increase by one, "" for none
    restarts: bool = False  # True if later blocks cannot be compared with earlier ones
    is_outdated: bool = False  # True if nothing that was learned holds

    @classmethod
    def with_count(cls, end: float, status: str, restarts: bool = False) -> NotJudged:
        """Build the result of a block without an estimate, which increases the counter "blocks: " + `status`."""
        return cls(end, status, f"blocks: {status}", restarts)


#: Conductances that became known with a block (those of all first blocks arrive together), or why there are none.
BlockResult = Sequence[BlockConductance] | NotJudged


@kernel
def _fit_to_blocks(model: Coefficients, grams: Any, column_order: Any, rows: Any) -> None:
    """Fit the coefficients of a volume balance to K blocks together and store them in `model`.

    `grams` (K, m, m) are the products of all m columns in each block, `column_order` (n + 2,) selects the columns as
    for `load_block`, and `rows` (K,) are the numbers of equations.
    """
    for k in range(len(grams)):
        load_block(model, grams[k], column_order)
        add_block(model, rows[k], weight=1.0, has_stepped=False)
    fit_coefficients(model)


@kernel
def _estimate_leak(
    model: Coefficients, gram: Any, column_order: Any, n_equations: float, updates_model: bool
) -> tuple[float, float, float, float]:
    """Estimate the leak's coefficient in one block, of the Gram matrix `gram`; results as of `estimate_leak`."""
    load_block(model, gram, column_order)
    return estimate_leak(model, n_equations, updates_model)  # type: ignore[no-any-return]


@kernel
def _is_waking(judged: Any, motion: float) -> bool:
    """Count a block by its relative `motion`, by `is_waking`; `judged` (1,) is a record."""
    return is_waking(judged[0], motion)  # type: ignore[no-any-return]


@kernel
def _judge_estimate(
    judged: Any, motion: float, misfit: float, results: float, precision: float, min_precision: float
) -> int:
    """Decide whether an estimate counts, by `judge_estimate`; `judged` (1,) is a record."""
    return judge_estimate(judged[0], motion, misfit, results, precision, min_precision)  # type: ignore[no-any-return]


class LiveBalance(SavedAttributes):
    """Estimate the leakage conductance of a running machine block by block, from the balance of volumes.

    `names` are the channels of the samples; InputError is raised if they allow no balance. The estimates do not depend
    on how the samples are divided into calls. `data` is the kind of data (`Observable.data`) from which the conductance
    is estimated.
    """

    data = VOLUMES
    block_seconds = BLOCK_SECONDS
    SAVED = ("_judged", "_waiting", "_n_meanings", "_rate", "_signals", "_signs")
    SAVED_TYPES: ClassVar = {"_signs": tuple[float, ...]}

    def __init__(self, rig: Rig, names: Sequence[str]) -> None:
        self._balances = live_equations(rig, names, with_tested_terms=True)
        if rig.circuit.feeds_one_chamber:
            self._balances = [shut_at_rest(balance) for balance in self._balances]
        if not self._balances:
            needed = format_ways(rig.circuit.watched_by)
            raise InputError(f"a live balance must have {needed}, got {', '.join(names) or 'nothing'}")
        needed_names = {"x", "p_A", "p_B", flow_source(names)}
        needed_names |= {name for balance in self._balances for term in balance.terms for name in term.needs}
        self.names = tuple(name for name in names if name in needed_names)  # channels that the balances read
        self._limits = [sensor_limit(CHANNEL_UNITS[name]) for name in self.names]  # beyond which a reading is none
        self.size_error = size_error(rig)  # relative standard error of all flows, and that of a leak's flow
        self.leak_error = math.hypot(self.size_error, LIVE.watch.law)
        self._roles = tuple(map(ColumnRoles, self._balances))
        self._n_columns = self._roles[0].left + 1  # the left side is the last column
        self._column_orders, self._models = [], list[Coefficients]()
        # columns of the pump's own leakage: free in each block, or left out if the flow's sign had to be restored
        self._pump_columns = [[k for k, name in enumerate(roles.names) if name in STATES] for roles in self._roles]
        for roles, pump_columns in zip(self._roles, self._pump_columns, strict=True):
            nuisance = [k for k in roles.nuisance if k not in (roles.leak, *pump_columns)]
            self._column_orders.append(np.array([*nuisance, roles.leak, roles.left]))
            self._models.append(Coefficients(*map(np.zeros, coefficient_shapes(len(nuisance)))))
        self._judged = np.zeros(1, _JUDGED)
        # factor on the left side of each balance (`BlockStream.left_signs`), as of the first fit
        self._signs = (1.0,) * len(self._balances)
        self._stored: Blocks | None = None  # the last blocks, packed
        self._waiting = 0  # number of stored blocks that await the first fit of the coefficients
        self._circuit, self._n_meanings, self._is_unsigned = rig.circuit, 0, False
        self._signals = SignalWindow()
        # begin, channels, rate, `BlockStream.n_meanings` and `is_unsigned` of each block
        self._closed_samples: list[tuple[float, Mapping[str, Array], float, int, bool]] = []
        self._stream: BlockStream | None = None
        self._rate = 0.0

    @staticmethod
    def states_flow(rig: Rig) -> bool:
        """Return True if a rig states the sizes, piston areas or pump displacement, for flows in L/min."""
        return rig.states(*rig.circuit.size_parameters)

    def take(self, run: SampleRun) -> Iterator[BlockResult]:
        """Process the next samples, and yield the result of each block of the volume balance that they complete.

        The first `LEARNED` blocks are estimated together: the result of the last one has the conductances of all. After
        a gap, or a change of the sampling rate, the coefficients of the balance are kept, and earlier samples that do
        not fill a block are dropped.
        """
        stream = self._stream
        if stream is None or not run.follows:
            if stream is not None:  # complete the blocks before the gap
                yield from self._take_blocks(stream.push({}, last=True))
            if stream is None or run.rate != self._rate:
                self._rate = run.rate
                new_stream = self._make_stream()
                if stream is not None:  # keep offsets, signs and weights of the equations, drop samples at the old rate
                    new_stream.load_state(stream.state())
                self._stream = stream = new_stream
            stream.restart(float(run.t[0]))
        # the samples complete at most one block at a time, as one may change what the next is compared with
        channels, size = self._mark_missing(run.channels), math.ceil(0.5 * BLOCK_SECONDS * self._rate)
        for first in range(0, len(run.t), size):
            piece = {name: values[first : first + size] for name, values in channels.items()}
            yield from self._take_blocks(stream.push(piece))

    def _mark_missing(self, channels: Mapping[str, Array]) -> dict[str, Array]:
        """Select the channels in use, NaN in each sample that lacks one of them or has a value that no sensor reads."""
        selected = {name: channels[name] for name in self.names}
        if all(np.abs(values).max() <= limit for values, limit in zip(selected.values(), self._limits, strict=True)):
            return selected
        is_present = np.logical_and.reduce(
            [np.abs(values) <= limit for values, limit in zip(selected.values(), self._limits, strict=True)]
        )
        return {name: np.where(is_present, values, np.nan) for name, values in selected.items()}

    def _make_stream(self) -> BlockStream:
        """Build the object that divides samples at the present rate into blocks, and stores the samples of each."""
        return BlockStream(
            self._balances,
            self._rate,
            BLOCK_SECONDS,
            on_samples=self._take_samples,
            flow_channel=str(flow_source(self.names)) if self._circuit.pump_moves_piston else "",
            feeds_one_chamber=self._circuit.feeds_one_chamber,
        )

    def _take_samples(self, begin: float, samples: Mapping[str, Array]) -> None:
        """Store the samples of a block that begins at `begin` [s], and the meaning of its terms."""
        assert self._stream is not None
        self._closed_samples.append((begin, samples, self._rate, self._stream.n_meanings, self._stream.is_unsigned))

    def _take_blocks(self, blocks: Blocks | None) -> Iterator[BlockResult]:
        """Yield the result of each complete block, if any, and store the features of its samples in `_signals`."""
        closed_samples, self._closed_samples = self._closed_samples, []
        for block, samples in zip([] if blocks is None else _split(blocks), closed_samples, strict=True):
            begin, channels, rate, n_meanings, self._is_unsigned = samples
            self._signals.take(begin, channels, rate)
            is_complete = all(np.isfinite(values).all() for values in channels.values())
            yield self._take_block(block, n_meanings, is_complete)

    def _take_block(self, block: Blocks, n_meanings: int, is_complete: bool) -> BlockResult:
        """Estimate the leakage conductance in a block, or store the block until the coefficients can be fitted.

        Learning begins with the first block that moves: `LEARNED` - 1 blocks give a `NotJudged`, and the next one the
        conductances of all `LEARNED`. Learning begins again when a machine wakes that stood still before, or when the
        terms or the sign of the flow change their meaning. The last `WINDOW` blocks with at least one complete equation
        are stored. `n_meanings`: `BlockStream.n_meanings` of the block; `is_complete`: no sample is missing.
        """
        _, end = self._sample_times(block)
        if n_meanings != self._n_meanings:
            self._n_meanings = n_meanings
            if self._stored is not None:
                self._stored = None
                self.relearn()
                return NotJudged(end, "learning", counter="blocks: the pump's flow counts otherwise", restarts=True)
        if not block.rows[0]:  # number of complete equations
            return NotJudged.with_count(end, "at standstill" if is_complete else "missing values")
        packed = block.pack()
        self._stored = packed if self._stored is None else Blocks.join([self._stored, packed])[-WINDOW:]
        if self._judged["usual_precision"][0] > 0.0:  # the coefficients are known
            if _is_waking(self._judged, self._relative_motion(block)):
                self.relearn()
                return NotJudged(end, "learning", counter="blocks: moves as never before", restarts=True)
            estimate = self._estimate_block(block)
            return estimate if isinstance(estimate, NotJudged) else [estimate]
        if not self._waiting and not _volume_square(block) > 0.0:
            return NotJudged.with_count(end, "at standstill")
        self._waiting += 1
        if self._waiting < LEARNED:
            return NotJudged(end, "learning")
        first_blocks = self._stored[-self._waiting :].unpack(self._n_columns)
        self._waiting = 0
        return self._estimate_first_blocks(first_blocks) or NotJudged.with_count(end, "at standstill")

    def _estimate_first_blocks(self, blocks: Blocks) -> list[BlockConductance]:
        """Fit the balances to the first blocks together, then estimate the conductance in each that is not at rest.

        The sign of the flow is that which all blocks so far show: it holds until the next first fit.
        """
        assert self._stream is not None
        self._signs = self._stream.left_signs
        grams_of_blocks = [self._fitted_grams(block) for block in _split(blocks)]
        grams_of_balances = zip(*grams_of_blocks, strict=True)
        for model, column_order, grams in zip(self._models, self._column_orders, grams_of_balances, strict=True):
            _fit_to_blocks(model, np.array(grams), column_order, blocks.rows)
        # updates_model=False: the fit already contains these blocks
        precisions = np.array([self._solve_block(block, updates_model=False)[0] for block in _split(blocks)])
        if self._has_own_leakage:  # only rests under load tell of the leak
            precisions = precisions[precisions > NEGLIGIBLE * precisions.max(initial=0.0)]
        self._judged["usual_precision"] = np.median(precisions) if precisions.size else 0.0
        estimates = (self._estimate_block(block, updates_model=False) for block in _split(blocks))
        return [estimate for estimate in estimates if not isinstance(estimate, NotJudged)]

    @property
    def _half_stride(self) -> float:
        """Half the time between equations [s]; a block's samples extend this far beyond its first and last equation."""
        return 0.5 * stride_samples(self._rate) / self._rate

    def _sample_times(self, block: Blocks) -> tuple[float, float]:
        """Return the times at which the samples of a block begin and end [s]."""
        return float(block.start[0]) - self._half_stride, float(block.end[0]) + self._half_stride

    def _relative_motion(self, block: Blocks) -> float:
        """Compute the mean square of the volume that the machine moves in a block, relative to earlier blocks."""
        return relative_motion(_volume_square(block), float(block.rows[0]), self._models[0].numbers)

    @property
    def is_unsigned(self) -> bool:
        """True if the recorded flow has no sign, which was restored."""
        return self._stream is not None and self._stream.is_unsigned

    @property
    def has_lowered(self) -> bool:
        """True once a load has been lowered past the resting pump."""
        return self._stream is not None and self._stream.has_lowered

    @property
    def cause(self) -> Cause:
        """Cause of a leak, as precise as the conductance shows it."""
        shows_pump = self._circuit.pump_moves_piston and not self._has_own_leakage
        return "piston or pump leak" if shows_pump else "piston leak"

    @property
    def _has_own_leakage(self) -> bool:
        """True if the pump's own leakage is free in each block."""
        return any(self._pump_columns) and not self._is_unsigned

    def _fitted_grams(self, block: Blocks) -> list[Array]:
        """Compute the products of each balance's columns in a block, with the sign of the flow.

        The pump's own leakage is eliminated, if it is free in each block.
        """
        grams = []
        for gram, columns, sign in zip(block.gram[0], self._pump_columns, self._signs, strict=True):
            signed = _with_sign(gram, sign)
            grams.append(Gaussian.from_gram(signed).drop(columns).gram if self._has_own_leakage else signed)
        return grams

    def _solve_block(self, block: Blocks, updates_model: bool = True) -> tuple[float, ...]:
        """Sum the results (w, w g, w s, w^2 V) of `coefficients.estimate_leak` over the volume balances for a block."""
        n_equations = float(block.rows[0])
        results = [
            _estimate_leak(model, gram, column_order, n_equations, updates_model)
            for model, gram, column_order in zip(
                self._models, self._fitted_grams(block), self._column_orders, strict=True
            )
        ]
        return tuple(sum(values) for values in zip(*results, strict=True))

    def _estimate_block(self, block: Blocks, updates_model: bool = True) -> BlockConductance | NotJudged:
        """Estimate the leakage conductance in a block; a `NotJudged` if the estimate does not count (`judge_estimate`).

        With `updates_model`, the block updates the other coefficients. If what was learned is outdated, all is learned
        anew, from the samples after the block on.
        """
        begin, end = self._sample_times(block)
        motion = self._relative_motion(block)
        results = self._solve_block(block, updates_model)
        precision, weighted_total, weighted_shift, weighted_variance = results
        noise = sum(float(model.numbers[NOISE]) for model in self._models)
        misfit = float(self._models[0].numbers[MISFIT]) if updates_model else 1.0
        needs_rest = self._has_own_leakage
        usual_precision = float(self._judged["usual_precision"][0])
        min_precision = MIN_REST_PRECISION * usual_precision if needs_rest else 0.0
        judgement = _judge_estimate(self._judged, motion, misfit, sum(results) + noise, precision, min_precision)
        if judgement == OUTDATED:
            self._learn_anew()
            counter = "blocks: what was learned was not the machine's"
            return NotJudged(end, "learning", counter=counter, restarts=True, is_outdated=True)
        if judgement == UNCERTAIN:
            at_standstill = motion < STANDSTILL or not needs_rest
            return NotJudged.with_count(end, "at standstill" if at_standstill else "without a rest under load")
        total = weighted_total / precision
        return BlockConductance(
            begin,
            end,
            g=total - weighted_shift / precision,
            sd=math.sqrt(1.0 / precision),
            total=total,
            offset=math.sqrt(weighted_variance) / precision,
            pressure=float(block.mean_pressure()[0]),
            pump_flow=float(block.flow[0]),
        )

    def relearn(self, since: float = math.inf) -> None:
        """Drop the coefficients, and learn new ones from all later blocks and the stored ones from `since` [s] on.

        These are the stored blocks that begin at `since` or later, by default none.
        """
        for model in self._models:
            for values in model:
                values[:] = 0.0
        self._judged[:] = np.zeros(1, _JUDGED)
        self._waiting = 0 if self._stored is None else int(np.count_nonzero(self._stored.start >= since))

    def _learn_anew(self) -> None:
        """Drop all that the samples so far have told of the machine."""
        self._stored, self._signals = None, SignalWindow()
        self.relearn()
        if self._stream is not None:
            self._stream.forget()

    def observables(self, since: float, end: float, onset: float) -> tuple[Observable, ...] | None:
        """Test terms of the volume balance and signals of the last blocks, from `since` to `end` [s], for changes.

        The result is None unless the stored blocks reach from the onset of the leakage's increase, `onset` [s], to
        `end`, to half a stride. It is empty if too few blocks begin at `since` or later.
        """
        stored = self._stored
        if stored is None:
            return None
        _, stored_end = self._sample_times(stored[-1:])
        if abs(stored_end - end) > self._half_stride or stored.start[0] > onset:
            return None
        blocks = stored[stored.start >= since - self._half_stride].unpack(self._n_columns)
        if len(blocks) < MIN_BLOCKS:
            return ()
        grams = [_with_sign(blocks.gram[:, e], sign) for e, sign in enumerate(self._signs)]
        blocks = replace(blocks, gram=np.stack(grams, axis=1))
        centred = remove_pressure_offset(blocks, self._roles)
        volumes = volume_observables(  # few blocks, so without an orifice; a loss of oil is not estimated
            centred, blocks, self._balances, self._roles, oil_loss={}, with_orifice=False
        )
        # the samples of a block begin less than a block before the time range of its equations
        return (*volumes, *self._signals.observables(since - BLOCK_SECONDS))

    def state(self) -> dict[str, Any]:
        """Return the learned coefficients and stored blocks as plain values for JSON, for `load_state`."""
        return {
            **super().state(),
            "known": [save_attributes(model, _MODEL) for model in self._models],
            "stored": None if self._stored is None else save_attributes(self._stored, _BLOCK),
            "stream": None if self._stream is None else self._stream.state(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore, to the last bit, the values that `state` saved; raise InputError for another rig or channels."""
        super().load_state(state)
        saved_models = require_part(state, "known", list)
        if len(saved_models) != len(self._models):
            raise InputError(f"saved state's known must have {len(self._models)} equations, got {len(saved_models)}")
        for model, saved in zip(self._models, saved_models, strict=True):
            restore_attributes(model, _MODEL, saved)
        stored, stream = (require_part(state, name, (Mapping, type(None))) for name in ("stored", "stream"))
        if stored is not None:
            self._stored = Blocks(*(restore_array(require_part(stored, name, Mapping), name) for name in _BLOCK))
            self._stored.unpack(self._n_columns)  # raises InputError for other shapes
        if stream is not None:
            self._stream = self._make_stream()
            self._stream.load_state(stream)


#: Saved attributes of a `Coefficients`, without its work arrays, and of stored `Blocks`.
_MODEL, _BLOCK = ("sums", "values", "leak_products", "numbers"), tuple(Blocks.__dataclass_fields__)


def _split(blocks: Blocks) -> list[Blocks]:
    """Split several blocks of samples into a list of single blocks."""
    return [blocks[k : k + 1] for k in range(len(blocks))]


def _with_sign(gram: Array, sign: float) -> Array:
    """Multiply the left side, the last column of Gram matrices (..., m, m), by its `sign`, 1 or -1."""
    if sign > 0.0:
        return gram
    factors = np.ones(gram.shape[-1])
    factors[-1] = sign
    return np.asarray(gram * factors * factors[:, None])


def _volume_square(block: Blocks) -> float:
    """Return the sum of squares of the volume, such as the pump's, on the left side of the first volume balance."""
    return float(block.gram[0, 0, -1, -1])  # first block and balance; the left side is the last column


def size_error(rig: Rig) -> float:
    """Return the relative standard error of all flows: that of the pump displacement or, with a valve, of the area."""
    return float(getattr(INFERENCE.size, rig.circuit.flow_size))


def live_equations(rig: Rig, names: Sequence[str], with_tested_terms: bool = False) -> list[Equation]:
    """Build the volume balances of a running machine that the channels `names` allow.

    Balances whose flow is computed from the command are left out, as a stream does not simulate the drive for it. The
    term of the pump's leakage is left out, too, as it cannot be distinguished from the piston's. `with_tested_terms`
    includes terms that are only tested for a change, not fitted.
    """
    balances = []
    for balance in equations(rig, frozenset(names)):
        if balance.flow is Flow.COMMAND:
            continue
        # fitted terms (`Term.is_fitted`) have unknown coefficients in any machine, as the leak past the piston has
        terms = [term for term in balance.terms if (term.is_fitted or with_tested_terms) and term.name != PUMP]
        balances.append(balance._replace(terms=tuple(terms)))
    return balances
