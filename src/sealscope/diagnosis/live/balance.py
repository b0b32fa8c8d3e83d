"""The volume balance of a running machine: the leakage conductance of each block.

The blocks are those of a recording (`balance.BlockStream`). All coefficients but the leak's are estimated recursively
from the last blocks (`coefficients`). The conductance is that of piston and pump, which lie in parallel; `sequential`
tests it for a step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sealscope.compiled import kernel
from sealscope.diagnosis.inference.balance import BlockStream
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.changes.volumes import VOLUMES, volume_observables
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.pressure_offset import remove_pressure_offset
from sealscope.diagnosis.inference.rows.weak_form import stride_samples
from sealscope.diagnosis.inference.terms import PUMP, Equation, equations
from sealscope.diagnosis.live.coefficients import (
    STANDSTILL,
    TINY,
    Coefficients,
    add_block,
    coefficient_shapes,
    estimate_leak,
    fit_coefficients,
    load_block,
    relative_motion,
)
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.signals import MIN_BLOCKS, WINDOW, SignalWindow
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import require_part, restore_array, restore_attributes, save_attributes
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRIORS = LIVE.block
#: Approximate duration of a block [s], and blocks before the first estimate.
BLOCK_SECONDS: float = _PRIORS.seconds
LEARNED: int = _PRIORS.learned
#: A block at standstill counts if its precision is over this fraction of the usual one. After `N_WAKING` blocks that
#: move far more than usual, the machine is taken to have stood still before.
MIN_REST_PRECISION: float = _PRIORS.tells
N_WAKING: int = _PRIORS.wakes


class BlockConductance(NamedTuple):
    """Leakage conductance and duty of the machine in one block.

    `begin`, `end`: times of its samples [s]; `g`, `sd`: conductance of pump and piston and its standard error [m^3/(s
    Pa)]. Values of `g` are comparable between blocks, as later estimates of the other coefficients do not shift them.
    `total`: conductance by the latest estimates of the other coefficients; `offset`: standard error common to all
    blocks, due to these coefficients and the machine's size; `pressure`: mean of abs(p_A - p_B) [Pa]; `pump_flow`: mean
    absolute flow that moves the piston [m^3/s].
    """

    begin: float
    end: float
    g: float
    sd: float
    total: float
    offset: float
    pressure: float
    pump_flow: float

    @property
    def lpm(self) -> float:
        """Flow per unit of conductance at the mean pressure difference [L/min over m^3/(s Pa)]."""
        return self.pressure / LITRE_PER_MINUTE

    @property
    def duty(self) -> tuple[float, float]:
        """Logarithms of the mean pressure difference [Pa] and the mean flow [m^3/s], finite also for zero values."""
        return math.log(max(self.pressure, TINY)), math.log(max(self.pump_flow, TINY))


class NotJudged(NamedTuple):
    """Reason why the block up to the time `end` [s] has no estimate.

    `status`: reason as text; `counter`: counter to increase by one, "" for none; `restarts`: True if later blocks
    cannot be compared with earlier ones.
    """

    end: float
    status: str
    counter: str = ""
    restarts: bool = False

    @classmethod
    def with_count(cls, end: float, status: str, restarts: bool = False) -> NotJudged:
        """Make a reason that increases the counter named after its status."""
        return cls(end, status, f"blocks: {status}", restarts)


#: The conductances that a block completes, or the reason for none.
BlockResult = Sequence[BlockConductance] | NotJudged


@kernel
def _fit_to_blocks(model: Coefficients, grams: Any, column_order: Any, rows: Any) -> None:
    """Fit a model's coefficients to K blocks together, by their Gram matrices (K, m, m) and counts of `rows` (K,)."""
    for k in range(len(grams)):
        load_block(model, grams[k], column_order)
        add_block(model, rows[k], 1.0, False)  # full weight, no step of the leak
    fit_coefficients(model)


@kernel
def _estimate_leak(
    model: Coefficients, gram: Any, column_order: Any, rows: float, is_learned: bool
) -> tuple[float, float, float, float]:
    """Estimate the leak's coefficient from a block's Gram matrix (m, m); arguments and result as of `estimate_leak`."""
    load_block(model, gram, column_order)
    return estimate_leak(model, rows, is_learned)  # type: ignore[no-any-return]


class LiveBalance:
    """Estimate the leakage conductance of a running machine block by block, by the balance of volumes.

    `rig`: states displacement and circuit; `names`: channels of the samples. Raises InputError if they allow no
    balance. The estimates do not depend on how the samples are divided into calls.
    """

    method, data, states_level = "volumes", VOLUMES, True
    min_internal_fraction = orifice_factor = 1.0  # the leak is surely internal, whatever its law
    block_seconds, has_begun = BLOCK_SECONDS, True

    def __init__(self, rig: Rig, names: Sequence[str], litres: bool | None = None) -> None:
        """Start without blocks; `litres`: the rig states the sizes that L/min need, by default found from it."""
        self._balances = live_equations(rig, names, with_tested_terms=True)
        if not self._balances:
            needed = "x, u, p_A, p_B, p_1 and p_2" if _has_valve(rig) else "x, p_A, p_B and theta or omega"
            raise InputError(f"a live balance must have {needed}, got {', '.join(names) or 'nothing'}")
        # of the pump's angle and speed the one that is recorded, behind a valve neither
        needed_names = {"x", "p_A", "p_B", next((name for name in ("theta", "omega") if name in names), "x")}
        needed_names |= {name for balance in self._balances for term in balance.terms for name in term.needs}
        self.names = tuple(name for name in names if name in needed_names)
        self.size_error = size_error(rig)
        self.cause: Cause = "piston leak" if _has_valve(rig) else "piston or pump leak"
        self.litres = self.states_flow(rig) if litres is None else litres
        self._roles = tuple(map(ColumnRoles, self._balances))
        self._n_columns = self._roles[0].left + 1
        nuisances = [[k for k in roles.nuisance if k != roles.leak] for roles in self._roles]
        self._column_orders = [
            np.array([*nuisance, roles.leak, roles.left])
            for nuisance, roles in zip(nuisances, self._roles, strict=True)
        ]
        self._models = [
            Coefficients(*(np.zeros(shape) for shape in coefficient_shapes(len(nuisance)))) for nuisance in nuisances
        ]
        self._precision = 0.0  # of a usual block's conductance; 0 before the coefficients are learned
        self._moving = 0  # number of successive blocks that move far more than the usual ones
        self._stored: Blocks | None = None  # the last blocks, packed
        self._waiting = 0  # number of these that the coefficients are to be learned from
        self._signals = SignalWindow()
        self._closed_samples: list[tuple[float, Mapping[str, Array], float]] = []  # begin, channels, rate of each block
        self._stream: BlockStream | None = None
        self._rate = 0.0

    @staticmethod
    def states_flow(rig: Rig) -> bool:
        """Test whether a rig states the sizes needed for a leak in L/min."""
        return rig.states(*(("cylinder.A_A", "cylinder.A_B") if _has_valve(rig) else ("pump.q_b",)))

    def take(self, run: SampleRun) -> Iterator[BlockResult]:
        """Process the next samples; yield the result of each block they complete before the next block is processed.

        The first `LEARNED` blocks are estimated together. After a gap the estimates of the coefficients stay; samples
        before the gap that fill no block are dropped.
        """
        stream = self._stream
        if stream is None or not run.follows:
            if stream is not None:
                yield from self._take_blocks(stream.push({}, last=True))
            if stream is None or run.rate != self._rate:
                self._rate = run.rate
                new_stream = self._make_stream()
                if stream is not None:  # offsets, signs and weights of the rows stay, samples at the other rate do not
                    new_stream.load_state({**stream.state(), "samples": {}, "first": 0, "done": 0})
                self._stream = stream = new_stream
            stream.restart(float(run.t[0]))
        yield from self._take_blocks(stream.push({name: run.channels[name] for name in self.names}))

    def _make_stream(self) -> BlockStream:
        """Make the stream that cuts samples at the present rate into blocks, and stores each block's samples."""

        def store_samples(begin: float, samples: Mapping[str, Array]) -> None:
            self._closed_samples.append((begin, samples, self._rate))

        return BlockStream(self._balances, self._rate, BLOCK_SECONDS, on_samples=store_samples)

    def _take_blocks(self, blocks: Blocks | None) -> Iterator[BlockResult]:
        """Process completed blocks, each with its stored samples; yield the result of each."""
        closed_samples, self._closed_samples = self._closed_samples, []
        for block, samples in zip([] if blocks is None else _split(blocks), closed_samples, strict=True):
            self._signals.take(*samples)
            yield self._take_block(block)

    def _take_block(self, block: Blocks) -> BlockResult:
        """Estimate the conductance of a block; without coefficients, store it until they can be fitted."""
        end = self._sample_times(block)[1]
        if not block.rows[0]:
            return NotJudged.with_count(end, "missing values")
        packed = block.pack()
        self._stored = packed if self._stored is None else Blocks.join([self._stored, packed])[-WINDOW:]
        if self._precision > 0.0:
            self._moving = self._moving + 1 if self._relative_motion(block) > 1.0 / STANDSTILL else 0
            if self._moving >= N_WAKING:
                self.relearn()
                return NotJudged(end, "learning", "blocks: moves as never before", restarts=True)
            estimate = self._estimate_block(block)
            return estimate if isinstance(estimate, NotJudged) else [estimate]
        if not block.gram[0, 0, -1, -1] > 0.0 and not self._waiting:
            return NotJudged.with_count(end, "at standstill")
        self._waiting += 1
        if self._waiting < LEARNED:
            return NotJudged(end, "learning")
        blocks, self._waiting = self._stored[-self._waiting :].unpack(self._n_columns), 0
        return self._estimate_first_blocks(blocks) or NotJudged(end, "at standstill")

    def _estimate_first_blocks(self, blocks: Blocks) -> list[BlockConductance]:
        """Fit coefficients and usual precision to the first blocks; return the estimates of those not at standstill."""
        for e, (model, column_order) in enumerate(zip(self._models, self._column_orders, strict=True)):
            _fit_to_blocks(model, np.ascontiguousarray(blocks.gram[:, e]), column_order, blocks.rows)
        solutions = [self._solve_block(part, is_learned=False) for part in _split(blocks)]
        self._precision = float(np.median([precision for precision, *_ in solutions]))
        estimates = (self._estimate_block(part, is_learned=False) for part in _split(blocks))
        return [estimate for estimate in estimates if not isinstance(estimate, NotJudged)]

    @property
    def _half_stride(self) -> float:
        """Half the time between two rows [s], by which a block's samples reach beyond its first and last row."""
        return 0.5 * stride_samples(self._rate) / self._rate

    def _sample_times(self, block: Blocks) -> tuple[float, float]:
        """Return the begin and end of a block's samples [s]."""
        return float(block.start[0]) - self._half_stride, float(block.end[0]) + self._half_stride

    def _relative_motion(self, block: Blocks) -> float:
        """Compute the mean square of a block's left side, relative to that of earlier blocks (`relative_motion`)."""
        return relative_motion(float(block.gram[0, 0, -1, -1]), float(block.rows[0]), self._models[0].numbers)

    def _solve_block(self, block: Blocks, is_learned: bool = True) -> tuple[float, ...]:
        """Estimate the leak in a block by all equations: add up the weighted results of `estimate_leak` (4,)."""
        rows, equation_parts = float(block.rows[0]), zip(self._models, block.gram[0], self._column_orders, strict=True)
        results = [
            _estimate_leak(model, gram, column_order, rows, is_learned) for model, gram, column_order in equation_parts
        ]
        return tuple(sum(values) for values in zip(*results, strict=True))

    def _estimate_block(self, block: Blocks, is_learned: bool = True) -> BlockConductance | NotJudged:
        """Estimate the conductance in a block, or report a standstill; with `is_learned`, update the coefficients."""
        begin, end = self._sample_times(block)
        at_standstill = self._relative_motion(block) < STANDSTILL
        precision, weighted_total, weighted_shift, weighted_variance = self._solve_block(block, is_learned)
        if not precision > (MIN_REST_PRECISION * self._precision if at_standstill else 0.0):
            return NotJudged.with_count(end, "at standstill")
        total = weighted_total / precision
        offset = math.hypot(math.sqrt(weighted_variance) / precision, self.size_error * total)
        g, sd = total - weighted_shift / precision, precision**-0.5
        pressure, pump_flow = float(block.mean_pressure()[0]), float(block.flow[0])
        return BlockConductance(begin, end, g, sd, total, offset, pressure, pump_flow)

    def relearn(self, since: float = math.inf) -> None:
        """Drop all coefficients, as after a repair, and learn them anew from the blocks begun `since` a time [s]."""
        for model in self._models:
            for values in model:
                values[:] = 0.0
        self._precision, self._moving = 0.0, 0
        self._waiting = 0 if self._stored is None else int(np.count_nonzero(self._stored.start >= since))

    def observables(self, since: float, end: float, onset: float) -> tuple[Observable, ...] | None:
        """Test terms and signals for changes in the blocks from the clock `since` to the one that ends at `end` [s].

        None if these blocks are not stored back to `onset`; empty if they are too few.
        """
        stored = self._stored
        if stored is None:
            return None
        if abs(self._sample_times(stored[-1:])[1] - end) > self._half_stride or stored.start[0] > onset:
            return None
        blocks = stored[stored.start >= since - self._half_stride].unpack(self._n_columns)
        if len(blocks) < MIN_BLOCKS:
            return ()
        centred = remove_pressure_offset(blocks, self._roles)
        volumes = volume_observables(centred, blocks, self._balances, self._roles, {})
        return (*volumes, *self._signals.observables(since - BLOCK_SECONDS))

    def state(self) -> dict[str, Any]:
        """Return the state as plain values for JSON."""
        return {
            **save_attributes(self, _SAVED),
            "known": [save_attributes(model, _MODEL) for model in self._models],
            "stored": None if self._stored is None else save_attributes(self._stored, _BLOCK),
            "stream": None if self._stream is None else self._stream.state(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore a saved `state`; later results are bit-identical. Raises InputError if the state does not fit."""
        restore_attributes(self, _SAVED, state)
        saved_models = require_part(state, "known", list)
        if len(saved_models) != len(self._models):
            raise InputError(f"saved state's known must be of {len(self._models)} equations, got {len(saved_models)}")
        for model, saved in zip(self._models, saved_models, strict=True):
            restore_attributes(model, _MODEL, saved)
        stored, stream = (require_part(state, name, (Mapping, type(None))) for name in ("stored", "stream"))
        if stored is not None:
            self._stored = Blocks(*(restore_array(require_part(stored, name, Mapping), name) for name in _BLOCK))
            self._stored.unpack(self._n_columns)  # raises InputError for other shapes
        if stream is not None:
            self._stream = self._make_stream()
            self._stream.load_state(stream)


_SAVED = ("litres", "_precision", "_moving", "_waiting", "_rate", "_signals")
_MODEL, _BLOCK = ("sums", "values", "leak_products", "numbers"), tuple(Blocks.__dataclass_fields__)


def _split(blocks: Blocks) -> list[Blocks]:
    """Split blocks into parts of a single block each."""
    return [blocks[k : k + 1] for k in range(len(blocks))]


def _has_valve(rig: Rig) -> bool:
    """Test whether a servo valve feeds the cylinder."""
    return bool(rig.valve.spool == "present")


def size_error(rig: Rig) -> float:
    """Return the relative standard error of a flow due to the rig's sizes."""
    return float(INFERENCE.size.area if _has_valve(rig) else INFERENCE.size.displacement)


def live_equations(rig: Rig, names: Sequence[str], with_tested_terms: bool = False) -> list[Equation]:
    """Build the balances for live use from the channels `names`, except those driven by the command.

    The pump's leakage is left out, as it cannot be told from the piston's. `with_tested_terms`: include terms that are
    zero in a healthy machine and only tested.
    """
    return [
        balance._replace(
            terms=tuple(term for term in balance.terms if (term.nuisance or with_tested_terms) and term.name != PUMP)
        )
        for balance in equations(rig, frozenset(names))
        if not balance.by_command
    ]
