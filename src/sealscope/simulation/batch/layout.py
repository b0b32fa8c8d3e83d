"""Sort experiments into sets that can run side by side, and lay out their numbers lane by lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.changes import LONGEST_BLOCK, SHORTEST_BLOCK, Effect, jumps_of, moved_per_block, values_of
from sealscope.simulation.commands import Command, Sine
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import From, Growing, Leak

if TYPE_CHECKING:
    from sealscope.physics.rig import RigNumbers

#: Slope [1/s] of an opening that is open at once.
AT_ONCE = 1e15


@dataclass(frozen=True)
class Member:
    """One experiment of a set.

    Its place among all, its numbers and what changes them, the command's gain and offset [V].
    """

    place: int
    experiment: Experiment
    numbers: RigNumbers
    effects: tuple[Effect, ...]
    gain: float
    offset: float

    @property
    def leak(self) -> Leak:
        """The one leak of the run, or one of no size."""
        leaks = self.experiment.leaks
        return leaks[0] if leaks else Leak("laminar", 0.0)


@dataclass(frozen=True)
class LaneSet:
    """Experiments of one kind under one shape of a command."""

    members: tuple[Member, ...]
    shape: Command

    @property
    def experiment(self) -> Experiment:
        """One of them, for what they have in common."""
        return self.members[0].experiment


def refuse(experiment: Experiment, place: int) -> None:
    """Raise InputError for an experiment that cannot run side by side with others."""

    def no(what: str) -> InputError:
        return InputError(f"a run of a batch must have {what} (run {place}); simulate it by itself")

    if len(experiment.leaks) > 1:
        raise no(f"at most one leak, got {len(experiment.leaks)}")
    if experiment.leaks and not isinstance(experiment.leaks[0].opening, From | Growing):
        raise no(f"a leak that opens at once or evenly, got {experiment.leaks[0].opening}")
    if experiment.rig.motor.integrator == "euler":
        raise no("motor.integrator = state, got euler")
    if any(fault.adjustments() or fault.holds() for fault in experiment.faults):
        raise no(f"no fault of a sensor, got {', '.join(str(fault) for fault in experiment.faults)}")
    for name in CHAMBERS:
        sensor = getattr(experiment.rig.sensors, name)
        for field in ("stuck_rate", "drop_rate"):
            if getattr(sensor, field) != 0:
                raise no(f"sensors.{name}.{field} = 0, got {getattr(sensor, field)}")


def _shape(command: Command) -> tuple[Any, Command, float, float]:
    """Return what commands of one shape have in common, that shape, and gain and offset that make the command of it."""
    if isinstance(command, Sine):
        shape = Sine(1.0, command.omega, command.phase)
        return ("sine", command.omega, command.phase), shape, command.amplitude, command.offset
    from sealscope.simulation.experiment import exact

    return str(exact(command)), command, 1.0, 0.0


def sets_of(experiments: Sequence[Experiment]) -> list[LaneSet]:
    """Return the experiments in sets.

    Raises InputError where one cannot be in a batch, or their records differ in length or rate.
    """
    from sealscope.physics.rig import CHOICES, rig_numbers
    from sealscope.simulation.experiment import choose_method

    if not experiments:
        raise InputError("a batch must have experiments, got none")
    first = experiments[0]
    found: dict[Any, list[Member]] = {}
    shapes: dict[Any, Command] = {}
    known: dict[int, RigNumbers] = {}  # by rig: most batches have few of them
    for place, one in enumerate(experiments):
        for name, own, common in (("duration", one.duration, first.duration), ("rate", one.rate, first.rate)):
            if own != common:
                raise InputError(f"runs of a batch must have one {name}, got {common:g} and {own:g} (run {place})")
        refuse(one, place)
        numbers = known.get(id(one.rig)) or known.setdefault(id(one.rig), rig_numbers(one.rig))
        effects = one.effects()
        if any(effect.field.startswith("G_ext") for effect in effects):
            numbers = numbers._replace(open_circuit=(True,))
        if any(effect.field == "air" for effect in effects):
            numbers = numbers._replace(aerated=(True,))
        key, shape, gain, offset = _shape(one.commanded)
        choices = tuple(getattr(numbers, name) for name in CHOICES)
        kind = (key, choices, choose_method(one.rig, one.method))
        shapes[kind] = shape
        found.setdefault(kind, []).append(Member(place, one, numbers, effects, gain, offset))
    return [LaneSet(tuple(members), shapes[kind]) for kind, members in found.items()]


def in_lanes(values: Array, width: int) -> Array:
    """Values of runs (runs, ...) as (groups, ..., width); the last run fills the lanes that are over."""
    groups = -(-len(values) // width)
    filled = np.concatenate([values, np.repeat(values[-1:], groups * width - len(values), axis=0)])
    return np.ascontiguousarray(np.moveaxis(filled.reshape(groups, width, *values.shape[1:]), 1, -1))


def out_of_lanes(lanes: Array, runs: int) -> Array:
    """Return the inverse of `in_lanes`: (groups, ..., width) as (runs, ...)."""
    moved = np.moveaxis(lanes, -1, 1)
    return moved.reshape(-1, *moved.shape[2:])[:runs]


def leak_rows(members: Sequence[Member], sizes: Array, measured: Array) -> Array:
    """Return (runs, LEAK_ROWS): leaks of the stated sizes, and the sizes of which the flow is accounted."""
    rows = []
    for member, size, told in zip(members, sizes, measured, strict=True):
        leak = member.leak
        laminar = leak.law == "laminar"
        opening = leak.opening
        if isinstance(opening, Growing):
            when = (opening.start, 1.0 / (opening.stop - opening.start))
        else:
            when = (opening.onset(), AT_ONCE)
        laws = (size, 0.0, told, 0.0) if laminar else (0.0, size, 0.0, told)
        rows.append([laws[0], laws[1], *when, laws[2], laws[3]])
    return np.array(rows)


@dataclass(frozen=True)
class Cells:
    """Numbers over the run, held within cells: `bounds` (cells + 1,) in outputs.

    `base` (runs, fields); `changing`, the fields that change, with `values` (runs, changing, cells).
    """

    bounds: np.ndarray
    base: Array
    changing: tuple[int, ...]
    values: Array

    def table(self, first: int, last: int, width: int) -> Array:
        """Return (groups, cells, fields, width) of cells first .. last."""
        table = np.repeat(self.base[:, None, :], last - first, axis=1)
        for k, field in enumerate(self.changing):
            table[:, :, field] = self.values[:, k, first:last]
        return in_lanes(table, width)


def cells_of(members: Sequence[Member], n_out: int, rate: float) -> Cells:
    """Cells for a set at `rate` [Hz] of outputs.

    0.5 s long, or so short (down to 0.05 s) that no effect moves by more than its resolution; a jump begins a cell.
    """
    from sealscope.physics.rig import NUMBERS

    numbers = {id(one.numbers): one.numbers for one in members}
    rows = {key: [float(getattr(one, name)) for name in NUMBERS] for key, one in numbers.items()}
    base = np.array([rows[id(one.numbers)] for one in members])
    effects = [effect for one in members for effect in one.effects]
    if not effects:
        return Cells(np.array([0, n_out]), base, (), np.empty((len(members), 0, 1)))
    coarse = np.arange(0, n_out + 1, max(1, round(LONGEST_BLOCK * rate)))
    parts = max(float(moved_per_block(effect, coarse, rate).max(initial=1.0)) for effect in effects)
    length = max(LONGEST_BLOCK / parts, SHORTEST_BLOCK)
    grid = np.arange(0, n_out, max(1, round(length * rate)))
    bounds = np.unique(np.r_[grid, n_out, jumps_of(effects, n_out, rate)])
    middles = 0.5 * (bounds[:-1] + bounds[1:]) / rate
    fields = tuple(sorted({NUMBERS.index(effect.field) for effect in effects}))
    values = np.repeat(base[:, list(fields), None], middles.size, axis=2)
    for run, one in enumerate(members):
        for name, found in values_of(one.effects, one.numbers, middles).items():
            values[run, fields.index(NUMBERS.index(name))] = found
    return Cells(bounds, base, fields, values)


def with_sizes(one: Experiment, size: float) -> Experiment:
    """Return the experiment with its leak's coefficient found."""
    if not one.leaks:
        return one
    return replace(one, leaks=(replace(one.leaks[0], mean=None, coefficient=size),))
