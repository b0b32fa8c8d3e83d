"""The volume balance of a running machine: the leakage conductance of each block.

The sums are those of a recording (`balance.BlockStream`). All coefficients but the leak's are what the last blocks say
of them (`known`). What passes the pump beside the piston is part of the conductance: piston and pump lie in parallel.
Whether it stepped is for `sequential` to say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sealscope.compiled import kernel
from sealscope.diagnosis.inference.balance import BlockStream
from sealscope.diagnosis.inference.blocks import Blocks, Columns
from sealscope.diagnosis.inference.rows.weak_form import stride_samples
from sealscope.diagnosis.inference.terms import Equation, equations
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.known import STANDSTILL, TINY, Known, add, begin, known_shapes, motion, says, take
from sealscope.diagnosis.priors import priors
from sealscope.errors import InputError
from sealscope.storage.plain_state import array_of, part_of, recall, saved
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRIORS = priors("live")["block"]
#: About how long a block is [s], and blocks before anything is said.
BLOCK_SECONDS: float = _PRIORS["seconds"]
LEARNED: int = _PRIORS["learned"]
#: A block at standstill counts all the same where it tells of the leak more than so much of what the usual one does,
#: and after so many that move so much more, all before were of a machine at standstill.
TELLS: float = _PRIORS["tells"]
WAKES: int = _PRIORS["wakes"]


@dataclass(frozen=True)
class BlockConductance:
    """State of the machine in one block.

    `begin`, `end`: of its samples [s]; `g`, `sd`: conductance of what passes pump and piston, and its deviation
    [m^3/(s Pa)], of a series that does not move as the other coefficients become known; `total`: as these are known
    now, and its deviation `offset` beside `sd`; `flow`: mean flow of one unit of conductance [L/min]; `duty`:
    logarithms of the mean pressure difference [Pa] and of the size of the motion.
    """

    begin: float
    end: float
    g: float
    sd: float
    total: float
    offset: float
    flow: float
    duty: tuple[float, float]


class NotJudged(NamedTuple):
    """Reason why the block up to the clock `end` [s] has no estimate: its status and counter.

    `apart`: what comes after it is compared with nothing before it.
    """

    end: float
    status: str
    counted: str = ""
    apart: bool = False


#: What a block says, or why nothing.
Shown = Sequence[BlockConductance] | NotJudged


@kernel
def _learn_blocks(known: Known, grams: Any, place: Any, rows: Any) -> None:
    for k in range(len(grams)):
        take(known, grams[k], place)
        add(known, rows[k], 1.0, False)
    begin(known)


@kernel
def _solve_block(known: Known, gram: Any, place: Any, rows: float, adds: bool) -> tuple[float, float, float, float]:
    take(known, gram, place)
    return says(known, rows, adds)  # type: ignore[no-any-return]


class LiveBalance:
    """The balance of a running machine: samples in, conductances of blocks out, the same for pieces of any size.

    `rig`: gives the pump's displacement and the circuit; `names`: channels of the samples. Raises InputError where they
    allow no balance.
    """

    method, levels, inside, orifice = "volumes", True, 1.0, 1.0
    block_seconds, begun = BLOCK_SECONDS, True

    def __init__(self, rig: Rig, names: Sequence[str], litres: bool | None = None) -> None:
        self._balances = live_equations(rig, names)
        if not self._balances:
            needed = "x, u, p_A, p_B, p_1 and p_2" if _valved(rig) else "x, p_A, p_B and theta or omega"
            raise InputError(f"a live balance must have {needed}, got {', '.join(names) or 'nothing'}")
        read = {
            "x",
            "p_A",
            "p_B",
            *(name for balance in self._balances for term in balance.terms for name in term.needs),
        }
        read |= {next((name for name in ("theta", "omega") if name in names), "x")}
        self.names = tuple(name for name in names if name in read)
        self.size_error, self.cause = size_error(rig), "piston leak" if _valved(rig) else "piston or pump leak"
        self.litres = self.states_flow(rig) if litres is None else litres
        self._places, self._known = [], []
        for columns in map(Columns, self._balances):
            nuisances = [k for k in columns.nuisance if k != columns.leak]
            self._places.append(np.array([*nuisances, columns.leak, columns.left]))
            self._known.append(Known(*(np.zeros(shape) for shape in known_shapes(len(nuisances)))))
        self._precision, self._woken = 0.0, 0  # of the usual block; blocks that moved as never before
        self._waiting: Blocks | None = None
        self._stream: BlockStream | None = None
        self._rate = 0.0

    @staticmethod
    def states_flow(rig: Rig) -> bool:
        """Test whether a rig states the sizes needed for a leak in L/min."""
        return rig.states(*(("cylinder.A_A", "cylinder.A_B") if _valved(rig) else ("pump.q_b",)))

    def take(self, run: SampleRun) -> list[Shown]:
        """Take the next samples; return the result of each block they complete.

        The first blocks say nothing until there are `LEARNED`; the last of these says what all of them do. After a gap
        the balance goes on with what it knew; what lay before the gap and fills no block is dropped.
        """
        results: list[Shown] = []
        stream = self._stream
        if stream is None or not run.follows:
            if stream is not None:
                results += self._take_blocks(stream.push({}, last=True))
            if stream is None or run.rate != self._rate:
                fresh, self._rate = BlockStream(self._balances, run.rate, BLOCK_SECONDS), run.rate
                if stream is not None:
                    fresh.recall({**stream.state(), "samples": {}, "first": 0, "done": 0})
                self._stream = stream = fresh
            stream.restart(float(run.t[0]))
        return results + self._take_blocks(stream.push({name: run.channels[name] for name in self.names}))

    def _take_blocks(self, blocks: Blocks | None) -> list[Shown]:
        return [] if blocks is None else [self._take_block(block) for block in _parts(blocks)]

    def _take_block(self, block: Blocks) -> Shown:
        end, rows = float(block.end[0]) + 0.5 * stride_samples(self._rate) / self._rate, float(block.rows[0])
        if not rows:
            return NotJudged(end, "missing values", "blocks: missing values")
        if self._precision > 0.0:
            self._woken = self._woken + 1 if self._moves(block) > 1.0 / STANDSTILL else 0
            if self._woken >= WAKES:
                self.relearn()
                return NotJudged(end, "learning", "blocks: moves as never before", True)
            result = self._estimate_block(block)
            return result if isinstance(result, NotJudged) else [result]
        if not block.gram[0, 0, -1, -1] > 0.0 and self._waiting is None:
            return NotJudged(end, "at standstill", "blocks: at standstill")
        self._waiting = block if self._waiting is None else Blocks.join([self._waiting, block])
        if len(self._waiting) < LEARNED:
            return NotJudged(end, "learning")
        waiting, self._waiting = self._waiting, None
        for e, (known, place) in enumerate(zip(self._known, self._places, strict=True)):
            _learn_blocks(known, np.ascontiguousarray(waiting.gram[:, e]), place, waiting.rows)
        self._precision = float(np.median([self._solve_block(part, adds=False)[0] for part in _parts(waiting)]))
        parts = [self._estimate_block(part, adds=False) for part in _parts(waiting)]
        return [part for part in parts if not isinstance(part, NotJudged)] or NotJudged(end, "at standstill")

    def _moves(self, block: Blocks) -> float:
        """Return the motion of a block over the usual one."""
        return motion(float(block.gram[0, 0, -1, -1]), float(block.rows[0]), self._known[0].numbers)

    def _solve_block(self, block: Blocks, adds: bool = True) -> tuple[float, ...]:
        """Sum the answers of all equations on a block (`says`).

        With `adds` the block is one of those known from now on.
        """
        rows, equation_parts = float(block.rows[0]), zip(self._known, block.gram[0], self._places, strict=True)
        answers = [_solve_block(known, gram, place, rows, adds) for known, gram, place in equation_parts]
        return tuple(sum(values) for values in zip(*answers, strict=True))

    def _estimate_block(self, block: Blocks, adds: bool = True) -> BlockConductance | NotJudged:
        half = 0.5 * stride_samples(self._rate) / self._rate
        begin, end = float(block.start[0]) - half, float(block.end[0]) + half
        at_standstill = self._moves(block) < STANDSTILL
        precision, lead, shift, leaning = self._solve_block(block, adds)
        if not precision > (TELLS * self._precision if at_standstill else 0.0):
            return NotJudged(end, "at standstill", "blocks: at standstill")
        total = lead / precision
        offset = math.hypot(math.sqrt(leaning) / precision, self.size_error * lead / precision)
        pressure, rate = (max(float(size[0]), TINY) for size in (block.driving(), block.flow))
        duty = math.log(pressure), math.log(rate)
        g, sd = total - shift / precision, precision**-0.5
        return BlockConductance(begin, end, g, sd, total, offset, pressure / LITRE_PER_MINUTE, duty)

    def relearn(self) -> None:
        """Forget all coefficients: the machine was repaired, or is another."""
        for known in self._known:
            for values in known:
                values[:] = 0.0
        self._precision, self._woken, self._waiting = 0.0, 0, None

    def state(self) -> dict[str, Any]:
        """Return the state as plain values for JSON."""
        waiting, stream = self._waiting, self._stream
        return {
            **saved(self, _SAVED),
            "known": [saved(known, _KNOWN) for known in self._known],
            "waiting": None if waiting is None else saved(waiting, _BLOCK),
            "stream": None if stream is None else stream.state(),
        }

    def recall(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` with the same bits; raises InputError where it does not fit."""
        recall(self, _SAVED, state)
        known = part_of(state, "known", list)
        if len(known) != len(self._known):
            raise InputError(f"saved state's known must be of {len(self._known)} equations, got {len(known)}")
        for sums, before in zip(self._known, known, strict=True):
            recall(sums, _KNOWN, before)
        waiting, stream = (part_of(state, name, (Mapping, type(None))) for name in ("waiting", "stream"))
        if waiting is not None:
            self._waiting = Blocks(*(array_of(part_of(waiting, name, Mapping), name) for name in _BLOCK))
        if stream is not None:
            self._stream = BlockStream(self._balances, self._rate, BLOCK_SECONDS)
            self._stream.recall(stream)


_SAVED = ("litres", "_precision", "_woken", "_rate")
_KNOWN, _BLOCK = ("sums", "coefficients", "along", "numbers"), tuple(Blocks.__dataclass_fields__)


def _parts(blocks: Blocks) -> list[Blocks]:
    """Return the blocks one by one."""
    return [Blocks(*(getattr(blocks, name)[k : k + 1] for name in _BLOCK)) for k in range(len(blocks))]


def _valved(rig: Rig) -> bool:
    return bool(rig.valve.spool == "present")


def size_error(rig: Rig) -> float:
    """Return the relative error of a flow computed from the rig's size."""
    return float(priors("inference")["size"]["area" if _valved(rig) else "displacement"])


def live_equations(rig: Rig, names: Sequence[str]) -> list[Equation]:
    """Return a machine's balances with the terms that have a column.

    A term that is zero, or parallel to the leak, has none.
    """
    balances = [equation for equation in equations(rig, frozenset(names)) if not equation.by_command]
    nuisances = [
        tuple(term for term in balance.terms if term.nuisance and term.name != "pump leak") for balance in balances
    ]
    return [balance._replace(terms=terms) for balance, terms in zip(balances, nuisances, strict=True)]
