"""What turns blocks of samples into conductances: the contract of the two ways in which an actuator is watched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from sealscope.monitor.stream.decisions import ConductanceRise
from sealscope.recordings.recording import Array, Recording

#: Blocks are not compared across a pause of over so many seconds.
PAUSE_S = 300.0


@dataclass(frozen=True, eq=False)
class BlockConductance:
    """What a block shows of the machine.

    `t`: its middle [s]; `g`, `sd`: conductance of what passes pump and piston, and its deviation [m^3/(s Pa)];
    `offset`: deviation that all conductances share; `flow`: mean flow of one unit of conductance [L/min]; `duty` (2,):
    logarithms of the mean pressure difference [Pa] and of the size of the motion; `source`: what the estimator keeps.
    """

    t: float
    g: float
    sd: float
    offset: float
    flow: float
    duty: Array
    source: Any


class NotJudged(NamedTuple):
    """Why a block shows nothing: its status, and under what and how many times it is counted ("": it is not).

    `apart`: what comes after it is compared with nothing before it.
    """

    status: str
    counted: str = ""
    number: int = 1
    apart: bool = False


class RecentBlocks(NamedTuple):
    """The last blocks: middles `t` (n,), conductances `g` (n,), flows of a unit of it `flow` (n,) [L/min]."""

    t: Array
    g: Array
    flow: Array


class ConductanceEstimator(Protocol):
    """An estimator of the conductance, block by block.

    `levels`: whether the conductance itself can be stated, and not only its changes; `size_error`: relative error of a
    size; `orifice`: mean flow of an orifice over that of a laminar leak that shows as the same conductance, by which
    the upper end of an interval is wider; `pace`: blocks between two looks for a step.
    """

    levels: bool
    size_error: float
    orifice: float
    pace: int

    @property
    def litres(self) -> bool:
        """Whether a change can be stated in L/min."""
        ...

    def seconds_of(self, first: Recording) -> float | None:
        """Return the length of a block [s] for a duty whose first minute is known; None where nothing moves."""
        ...

    def take(self, block: Recording, to_learn: int) -> Sequence[BlockConductance] | NotJudged:
        """Return what a block shows, or blocks that had to wait for it; `to_learn`: blocks of the baseline."""
        ...

    def append(self, block: BlockConductance) -> RecentBlocks:
        """Keep a block that is judged; return the last ones, up to a pause."""
        ...

    def series(self) -> RecentBlocks:
        """Return the last blocks."""
        ...

    def step(self, probability: float, *, again: bool) -> tuple[ConductanceRise | None, str | None]:
        """Return the rise that the last blocks show, and what forbids to compare them, in a few words.

        It is asked after each block and looks after each `pace` of them.

        `again`: an alarm stands, and is to be stated anew.
        """
        ...

    def forget(self, keep: int = 0) -> None:
        """Compare with nothing before the last `keep` blocks."""
        ...

    def relearn(self) -> None:
        """Learn again what belongs to the machine."""
        ...

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        ...
