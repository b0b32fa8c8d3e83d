"""The volume balance of a running machine: what each block says of the leakage conductance.

The sums are those of a recording (`balance.BlockStream`). All coefficients but the leak's are what the last blocks say
of them: the leak's column is eliminated from the sums M_k of each block, which are added up and forgotten over `MEMORY`
blocks; with C, m these sums over the other columns and their products with the left side,

    c = C^-1 m,    g_k = (n_k - b_k' c) / N_k,    Var g_k = s^2 / N_k,

N_k, n_k and b_k the products of the leak's column with itself, the left side and the others over the rows of block
k, s^2 the long-run variance of a row. A leak does not enter c, so that a step of g_k is a step of the leak. What passes
the pump beside the piston is part of g: piston and pump lie in parallel. Whether g stepped is for `sequential` to say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.balance import BlockStream
from sealscope.diagnosis.inference.blocks import Blocks, Columns, overlap, solve
from sealscope.diagnosis.inference.terms import Term, equations, priors
from sealscope.diagnosis.inference.weak_form import stride_samples
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import array_of, part_of, plain_array
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: About how long a block is [s].
BLOCK_SECONDS = 3.0
#: Blocks after which what they said of the other coefficients counts for 1/e, and blocks before anything is said.
MEMORY, LEARNED = 60.0, 20
#: A block that leaves more than this many deviations counts for less.
JUMP = 4.0
#: A block rests whose motion is below this share of the usual one, unless it tells of the leak more than so much of it.
_RESTS, _TELLS = 1e-4, 0.1
#: ... and after so many that move so much more, all before were of a machine at rest.
_WAKES = 3
#: Two samples follow each other where their times differ by so many steps.
_FOLLOWS = (0.5, 1.5)


@dataclass(frozen=True)
class BlockConductance:
    """What a block shows of the machine.

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
    """Why a block that ends at the clock `end` [s] shows nothing: its status, and under what it is counted.

    `apart`: what comes after it is compared with nothing before it.
    """

    end: float
    status: str
    counted: str = ""
    apart: bool = False


_TINY = float(np.finfo(float).tiny)
#: What is left after a block of how far the series stands from the level that the coefficients give now.
_RETURNS = math.exp(-1.0 / 1200.0)
#: Where the leak's column stands in the sums.
_LEAK = -2
#: What a block says, or why nothing.
Shown = Sequence[BlockConductance] | NotJudged


class _Said(NamedTuple):
    """What a block says of the leak's coefficient, sums over the equations.

    `precision`; that times its estimate, `lead`, and times what is to be taken from it so that the series does not move
    with the other coefficients, `shift`; `leaning`: the variance that these leave, times the precision squared.
    """

    precision: float
    lead: float
    shift: float
    leaning: float


_SUMS, _NUMBERS = ("sums", "coefficients", "along"), ("rows", "motion", "noise", "energy", "shift")


class _Known:
    """What the last blocks say of all coefficients of one equation: sums over its columns, the leak's next to last."""

    def __init__(self, columns: Columns) -> None:
        self.others = [k for k in columns.nuisance if k != columns.leak]
        self._place = np.ix_(*2 * ([*self.others, columns.leak, columns.left],))
        self.relearn()

    def relearn(self) -> None:
        """Forget all."""
        count = len(self.others)
        self.sums = np.zeros((count + 2, count + 2))
        self.coefficients, self.along = np.zeros(count), np.zeros(count)
        self.rows = self.motion = self.noise = self.energy = self.shift = 0.0

    def add(self, gram: Array, rows: float, weight: float = 1.0, stepped: bool = False) -> None:
        """Add what a block says; forget a part of what those before said.

        The leak walks between blocks by as much as a block tells of it, or any distance where it `stepped`.
        """
        own, keep = gram[self._place], math.exp(-1.0 / MEMORY)
        along = self.sums[_LEAK]
        walked = float(along[_LEAK]) + (0.0 if stepped else max(float(own[_LEAK, _LEAK]), _TINY))
        if walked > 0.0:
            self.sums = self.sums - np.outer(along, along) / walked
        self.sums = keep * self.sums + weight * own
        self.along, self.energy = keep * self.along + own[:_LEAK, _LEAK], keep * self.energy + float(own[_LEAK, _LEAK])
        self.rows = keep * self.rows + weight * rows
        self.motion = keep * self.motion + weight * float(own[-1, -1])

    def begin(self) -> None:
        """Take coefficients and the variance of a row from all that was added."""
        self.coefficients = self._solved(np.zeros((len(self.others), 0)))[:, 0]
        left = self._left(self.sums, self.coefficients)
        self.noise = max(left, 1e-14 * float(self.sums[-1, -1]), _TINY) / self.rows

    def says(self, gram: Array, rows: float, adds: bool = True) -> _Said:
        """Return what a block says, beside what those before it say; with `adds` it is one of these from now on."""
        own = gram[self._place]
        along, energy = own[:_LEAK, _LEAK], max(float(own[_LEAK, _LEAK]), _TINY)
        usual = self.along / max(self.energy, _TINY)
        apart = along - energy * usual
        solved = self._solved(np.column_stack([along, apart]))
        coefficients, weight = solved[:, 0], 1.0
        g = float(own[_LEAK, -1] - along @ coefficients) / energy
        self.shift = _RETURNS * self.shift - float(usual @ (coefficients - self.coefficients))
        self.coefficients = coefficients
        if adds:
            left = max(self._left(own, coefficients), 0.0) / rows
            weight = min(1.0, JUMP**2 * self.noise / max(left, _TINY))
            before, known = self.sums[_LEAK], max(float(self.sums[_LEAK, _LEAK]), _TINY)
            moved = g - float(before[-1] - before[:_LEAK] @ coefficients) / known
            spread = overlap() * self.noise * (2.0 / (energy * weight) + 1.0 / known)
            self.add(gram, rows, weight, moved**2 > JUMP**2 * spread)
            self.noise += (1.0 - math.exp(-1.0 / MEMORY)) * (left * weight - self.noise)
        # beside its rows' noise a block has what it leans on the others otherwise than the usual one
        variance = overlap() * self.noise * (1.0 / weight + max(float(apart @ solved[:, 2]), 0.0) / energy)
        precision = energy / variance
        leaning = max(float(along @ solved[:, 1]), 0.0) * overlap() * self.noise / variance**2
        return _Said(precision, precision * g, precision * self.shift, leaning)

    def _solved(self, right: Array) -> Array:
        """Return the other coefficients, whatever the leak is, and C^-1 times further right sides."""
        leak = self.sums[_LEAK]
        sums = self.sums - np.outer(leak, leak) / max(float(leak[_LEAK]), _TINY)
        return solve(sums[:_LEAK, :_LEAK], np.column_stack([sums[:_LEAK, -1], right]))

    @staticmethod
    def _left(sums: Array, coefficients: Array) -> float:
        """Return the sum of squares that the other coefficients leave, whatever the leak is."""
        vector = np.concatenate([-coefficients, [0.0, 1.0]])
        of = sums @ vector
        return float(vector @ of - of[_LEAK] ** 2 / max(float(sums[_LEAK, _LEAK]), _TINY))

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return {name: plain_array(getattr(self, name)) for name in _SUMS} | {
            name: getattr(self, name) for name in _NUMBERS
        }

    def recall(self, state: Any) -> None:
        """Continue from a `state`; raises InputError where it does not fit."""
        for name in _SUMS:
            values = array_of(part_of(state, name, Mapping), name)
            if values.shape != getattr(self, name).shape:
                raise InputError(f"saved state's {name} must be {getattr(self, name).shape}, got {values.shape}")
            setattr(self, name, values)
        for name in _NUMBERS:
            setattr(self, name, _number(state, name))

    def wakes(self, gram: Array, rows: float) -> bool:
        """Return whether a block moves so much more that those before were of a machine at rest."""
        return _RESTS * float(gram[-1, -1]) * self.rows > self.motion * rows

    def rests(self, gram: Array, rows: float) -> bool:
        """Return whether a block moves so much less that its machine stands."""
        return float(gram[-1, -1]) * self.rows < _RESTS * self.motion * rows


class LiveBalance:
    """The balance of a running machine: samples in, conductances of blocks out, the same for pieces of any size.

    Parameters
    ----------
    rig : Rig
        Gives the pump's displacement and the circuit.
    names : sequence of str
        Channels of the samples.

    Raises
    ------
    InputError
        Where the channels allow no balance.
    """

    def __init__(self, rig: Rig, names: Sequence[str]) -> None:
        balances = equations(rig, frozenset(names))
        self._balances = [own._replace(terms=tuple(filter(_is_told, own.terms))) for own in balances]
        if not self._balances:
            raise InputError(f"a live balance must have {_needed(rig)}, got {', '.join(names) or 'nothing'}")
        needed = {"x", "p_A", "p_B", *(name for each in self._balances for term in each.terms for name in term.needs)}
        needed |= {next(name for name in ("theta", "omega", "u") if name in names)}
        self.names = tuple(name for name in names if name in needed)
        columns = [Columns(balance) for balance in self._balances]
        self._known = [_Known(own) for own in columns]
        self._precision = 0.0  # of the usual block
        self._size_error = size_error(rig)
        self._woken = 0
        self._waiting: Blocks | None = None
        self._stream: BlockStream | None = None
        self._rate, self._next = 0.0, -math.inf

    def take(self, t: Array, samples: Mapping[str, Array], rate: float) -> list[Shown]:
        """Take samples that follow each other at the times `t` [s]; return what each block says that they complete.

        The first blocks say nothing until there are `LEARNED`; the last of these says what all of them do.

        After a gap the balance goes on with what it knew; what lay before the gap and fills no block is dropped.
        """
        shown: list[Shown] = []
        steps = (float(t[0]) - self._next) * rate + 1.0
        if self._stream is None or rate != self._rate or not _FOLLOWS[0] < steps < _FOLLOWS[1]:
            shown += self.finish()
            if self._stream is None or rate != self._rate:
                before = self._stream
                self._stream, self._rate = BlockStream(self._balances, rate, BLOCK_SECONDS), rate
                if before is not None:
                    self._stream.recall({**before.state(), "samples": {}, "first": 0, "done": 0})
            self._stream.restart(float(t[0]))
        self._next = float(t[-1]) + 1.0 / rate
        return shown + self._said(self._stream.push({name: samples[name] for name in self.names}))

    @property
    def _stride(self) -> float:
        """Time between rows [s]."""
        return stride_samples(self._rate) / self._rate

    def interrupt(self) -> None:
        """Take the next samples as those after a gap, whatever their time is."""
        self._next = -math.inf

    def finish(self) -> list[Shown]:
        """Return what the blocks say that are whole though nothing follows."""
        return [] if self._stream is None else self._said(self._stream.push({}, last=True))

    def _said(self, blocks: Blocks | None) -> list[Shown]:
        if blocks is None:
            return []
        return [self._taken(block) for block in _parts(blocks)]

    def _taken(self, block: Blocks) -> Shown:
        end, rows = float(block.end[0]) + 0.5 * self._stride, float(block.rows[0])
        if not rows:
            return NotJudged(end, "missing values", "blocks: missing values")
        if self._precision > 0.0:
            self._woken = self._woken + 1 if self._known[0].wakes(block.gram[0, 0], rows) else 0
            if self._woken >= _WAKES:
                self.relearn()
                return NotJudged(end, "learning", "blocks: moves as never before", True)
            shown = self._shown(block)
            return shown if isinstance(shown, NotJudged) else [shown]
        if not block.gram[0, 0, -1, -1] > 0.0 and self._waiting is None:
            return NotJudged(end, "at rest", "blocks: at rest")
        self._waiting = block if self._waiting is None else Blocks.joined([self._waiting, block])
        if len(self._waiting) < LEARNED:
            return NotJudged(end, "learning")
        waiting, self._waiting = self._waiting, None
        for e, known in enumerate(self._known):
            for gram, own in zip(waiting.gram[:, e], waiting.rows, strict=True):
                known.add(gram, own)
            known.begin()
        self._precision = float(np.median([self._says(part, adds=False).precision for part in _parts(waiting)]))
        parts = [self._shown(part, adds=False) for part in _parts(waiting)]
        return [part for part in parts if not isinstance(part, NotJudged)] or NotJudged(end, "at rest")

    def _says(self, block: Blocks, adds: bool = True) -> _Said:
        """Return what a block says by all equations."""
        rows = float(block.rows[0])
        said = [known.says(gram, rows, adds) for known, gram in zip(self._known, block.gram[0], strict=True)]
        return _Said(*(sum(values) for values in zip(*said, strict=True)))

    def _shown(self, block: Blocks, adds: bool = True) -> BlockConductance | NotJudged:
        begin, end = float(block.start[0]) - 0.5 * self._stride, float(block.end[0]) + 0.5 * self._stride
        at_rest = self._known[0].rests(block.gram[0, 0], float(block.rows[0]))
        precision, lead, shift, leaning = self._says(block, adds)
        if not precision > (_TELLS * self._precision if at_rest else 0.0):
            return NotJudged(end, "at rest", "blocks: at rest")
        total, offset = (
            lead / precision,
            math.hypot(math.sqrt(leaning) / precision, self._size_error * lead / precision),
        )
        pressure, _, rate = (max(float(value), _TINY) for value in block.means[0])
        duty = math.log(pressure), math.log(rate)
        g, sd = total - shift / precision, precision**-0.5
        return BlockConductance(begin, end, g, sd, total, offset, pressure / LITRE_PER_MINUTE, duty)

    def relearn(self) -> None:
        """Forget all coefficients: the machine was repaired, or is another."""
        for known in self._known:
            known.relearn()
        self._precision, self._woken, self._waiting = 0.0, 0, None

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values that JSON holds."""
        waiting, stream = self._waiting, self._stream
        return {
            "names": list(self.names),
            "known": [known.state() for known in self._known],
            "precision": self._precision,
            "woken": self._woken,
            "waiting": None
            if waiting is None
            else {name: plain_array(getattr(waiting, name)) for name in _BLOCK_FIELDS},
            "rate": self._rate,
            "next": self._next if math.isfinite(self._next) else None,
            "stream": None if stream is None else stream.state(),
        }

    @classmethod
    def from_state(cls, rig: Rig, state: Mapping[str, Any]) -> LiveBalance:
        """Return the balance that `state` was of; raises InputError where it does not fit."""
        live = cls(rig, tuple(part_of(state, "names", list)))
        known = part_of(state, "known", list)
        if len(known) != len(live._known):
            raise InputError(f"saved state's known must be of {len(live._known)} equations, got {len(known)}")
        for own, saved in zip(live._known, known, strict=True):
            own.recall(saved)
        live._precision, live._rate = (_number(state, name) for name in ("precision", "rate"))
        live._woken = int(part_of(state, "woken", int))
        waiting, stream = (part_of(state, name, (Mapping, type(None))) for name in ("waiting", "stream"))
        after = part_of(state, "next", (float, int, type(None)))
        if waiting is not None:
            live._waiting = Blocks(*(array_of(part_of(waiting, name, Mapping), name) for name in _BLOCK_FIELDS))
        live._next = -math.inf if after is None else float(after)
        if stream is not None:
            live._stream = BlockStream(live._balances, live._rate, BLOCK_SECONDS)
            live._stream.recall(stream)
        return live


_BLOCK_FIELDS = tuple(Blocks.__dataclass_fields__)


def _parts(blocks: Blocks) -> list[Blocks]:
    """Return the blocks one by one."""
    return [Blocks(*(getattr(blocks, name)[k : k + 1] for name in _BLOCK_FIELDS)) for k in range(len(blocks))]


def _number(state: Any, name: str) -> float:
    return float(part_of(state, name, (float, int)))


def size_error(rig: Rig) -> float:
    """Return how far a flow by the rig's size is known, relative."""
    return priors()["size"]["area" if rig.valve.spool == "present" else "displacement"].value


def states_flow(rig: Rig) -> bool:
    """Return whether a rig states what turns the balance into L/min."""
    return rig.states(*(("cylinder.A_A", "cylinder.A_B") if rig.valve.spool == "present" else ("pump.q_b",)))


def _is_told(term: Term) -> bool:
    """Return whether a term has a column: what may be zero, or lies beside the leak, has none."""
    return term.nuisance and term.name != "pump leak"


def _needed(rig: Rig) -> str:
    if rig.valve.spool == "present":
        return "x, u, p_A, p_B, p_1 and p_2"
    return "x, p_A, p_B and theta, omega or u"
