"""What a maker of figures and tables may ask for: simulated runs, the measured sheet, other items, a quick version."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from sealscope.recordings.recording import Array, Recording
from sealscope.thesis.engine.products import Claim, Product
from sealscope.thesis.sheet import DataSheet


@dataclass(frozen=True)
class RunSpec:
    """A simulated run as text and numbers; equal specs are run once and kept on disk.

    `values`: parameters by name, as text with unit or SI number; `leaks` as `simulation.faults.parse_leak` reads
    them; `prove`: do the halving test too (its outcome is in `SimulatedRun.resolved`; an unresolved run is kept and
    marked, not raised).
    """

    command: str = "3 sin(4t)"
    duration: float = 180.0
    leaks: tuple[str, ...] = ()
    rig: str = "thesis"
    values: tuple[tuple[str, str | float], ...] = ()
    seed: int = 0
    x_0: float = 0.0
    method: Literal["auto", "rk4", "imex"] = "auto"
    step: float | None = None
    prove: bool = False


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """The result of a run.

    The recording, the true outputs at its samples (`simulation.simulate.TRUE_OUTPUTS`), the mean leak, and whether
    halving the step moved no channel too far (None: not tested), by how much each moved (`proof`). `diverged` holds the
    one-line reason of a run that failed; recording and outputs are then empty.
    """

    recording: Recording | None
    t: Array
    outputs: Mapping[str, Array]
    mean_leak_lpm: float
    resolved: bool | None
    proof: Mapping[str, float] = field(default_factory=dict)
    diverged: str = ""


class Context(Protocol):
    """Handed to every maker."""

    quick: bool

    @property
    def sheet(self) -> DataSheet | None:
        """The measured sheet, None where it was not given."""
        ...

    def run(self, spec: RunSpec) -> SimulatedRun:
        """Return the run of `spec`, simulated now or earlier."""
        ...

    def product(self, item: str) -> tuple[Product | Claim, ...]:
        """Return the products of another item, made now or earlier."""
        ...
