"""Sets of experiments that can run side by side, and the run of a set from standstill, a few seconds at a time."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.changes import Effect, Readings, blocks_of, extremes, values_of
from sealscope.simulation.commands import Command, Sine
from sealscope.simulation.courses import numbers_under, state_under
from sealscope.simulation.experiment import Experiment, choose_method, exact
from sealscope.simulation.instruments import FILTER_REACH, anti_alias_taps
from sealscope.simulation.integrate import (
    VACUUM,
    oversampling_of,
    refuse_long,
    refuse_unresolved,
    steps_per_output,
)
from sealscope.simulation.leaks import Leak

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.physics.rig import RigNumbers

#: Slope [1/s] of an abrupt opening.
ABRUPT = 1e15


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

    @cached_property
    def extremes(self) -> tuple[RigNumbers, ...]:
        """The run's numbers, and those between which valves move (`changes.extremes`)."""
        return extremes(self.effects, self.numbers)


@dataclass(frozen=True)
class LaneSet:
    """Experiments of one kind that share the shape of a command, the load, and the step or error."""

    members: tuple[Member, ...]
    shape: Command

    @property
    def experiment(self) -> Experiment:
        """One of them, for what they have in common."""
        return self.members[0].experiment


def refuse(experiment: Experiment, place: int) -> None:
    """Raise InputError for an experiment that cannot run side by side with others."""
    rig, leaks = experiment.rig, experiment.leaks
    missing = []
    if experiment.controlled is not None:
        missing.append(f"a command, got a target for a controller ({experiment.command})")
    if len(leaks) > 1:
        missing.append(f"at most one leak, got {len(leaks)}")
    if leaks and leaks[0].opening.rise is None:
        missing.append(f"a leak that opens abruptly or evenly, got {leaks[0].opening}")
    if rig.motor.integrator == "euler":
        missing.append("motor.integrator = state, got euler")
    if any(fault.row.of_sensor for fault in experiment.faults):
        missing.append(f"no fault of a sensor, got {', '.join(map(str, experiment.faults))}")
    if leaks and experiment.thins:
        missing.append("no leak while the oil's temperature changes")
    absent = ["daq.jitter"]
    absent += [
        f"sensors.{name}.{symbol}"
        for name in CHAMBERS
        for symbol in ("stuck_rate", "drop_rate", "lag", "hum_harmonics")
    ]
    missing += [f"{name} = 0, got {rig[name]}" for name in absent if rig[name] != 0]
    if missing:
        raise InputError(f"a run of a batch must have {missing[0]} (run {place}); simulate it by itself")


def _shape(command: Command) -> tuple[str, Command, float, float]:
    """Split a command into a name of its shape, the shape, and the gain and offset on it."""
    if isinstance(command, Sine):
        shape = Sine(1.0, command.omega, command.phase)
        return str(exact(shape)), shape, command.amplitude, command.offset
    return str(exact(command)), command, 1.0, 0.0


def sets_of(experiments: Sequence[Experiment]) -> list[LaneSet]:
    """Group the experiments into sets that can run side by side.

    Raises InputError where one cannot be in a batch, or their records differ in length or rate.
    """
    from sealscope.physics.rig import CHOICES

    if not experiments:
        raise InputError("a batch must have experiments, got none")
    first = experiments[0]
    by_kind: dict[Any, list[Member]] = {}
    shapes: dict[Any, Command] = {}
    numbers_by_rig: dict[Any, RigNumbers] = {}  # by rig and load: most batches have few of them
    for place, experiment in enumerate(experiments):
        for name in ("duration", "rate"):
            value, common = getattr(experiment, name), getattr(first, name)
            if value != common:
                raise InputError(f"runs of a batch must have one {name}, got {common:g} and {value:g} (run {place})")
        refuse(experiment, place)
        load = None if experiment.load is None else str(exact(experiment.load))
        if (id(experiment.rig), load) not in numbers_by_rig:
            numbers_by_rig[id(experiment.rig), load] = numbers_under(experiment.rig, experiment.load)
        numbers = numbers_by_rig[id(experiment.rig), load]
        effects = experiment.effects()
        if any(effect.field.startswith("G_ext") for effect in effects):
            numbers = numbers._replace(open_circuit=(True,))
        if any(effect.field == "air" for effect in effects):
            numbers = numbers._replace(aerated=(True,))
        key, shape, gain, offset = _shape(experiment.commanded)
        choices = tuple(getattr(numbers, name) for name in CHOICES if name != "pushed")
        method = choose_method(experiment.rig, experiment.method)
        kind = (key, load, choices, method, experiment.step, experiment.error)
        shapes[kind] = shape
        by_kind.setdefault(kind, []).append(Member(place, experiment, numbers, effects, gain, offset))
    return [LaneSet(tuple(members), shapes[kind]) for kind, members in by_kind.items()]


def in_lanes(values: Array, width: int) -> Array:
    """Arrange values of runs (runs, ...) as (groups, ..., width); the last run fills the spare lanes."""
    groups = -(-len(values) // width)
    filled = np.concatenate([values, np.repeat(values[-1:], groups * width - len(values), axis=0)])
    return np.ascontiguousarray(np.moveaxis(filled.reshape(groups, width, *values.shape[1:]), 1, -1))


def out_of_lanes(lanes: Array, runs: int) -> Array:
    """Arrange (groups, ..., width) as (runs, ...), the inverse of `in_lanes`."""
    lanes_second = np.moveaxis(lanes, -1, 1)
    return lanes_second.reshape(-1, *lanes_second.shape[2:])[:runs]


def leak_rows(members: Sequence[Member], sizes: Array, measured: Array) -> Array:
    """Build (runs, LEAK_ROWS): leaks of the stated sizes, and the sizes whose flow is accounted."""
    rows = []
    for member, size, accounted in zip(members, sizes, measured, strict=True):
        leak = member.leak
        laminar = leak.law == "laminar"
        start, stop = leak.opening.rise or (0.0, 0.0)
        when = start, (1.0 / (stop - start) if stop > start else ABRUPT)
        laws = (size, 0.0, accounted, 0.0) if laminar else (0.0, size, 0.0, accounted)
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
        """Build (groups, cells, fields, width) of cells first .. last."""
        table = np.repeat(self.base[:, None, :], last - first, axis=1)
        for k, field in enumerate(self.changing):
            table[:, :, field] = self.values[:, k, first:last]
        return in_lanes(table, width)


def cells_of(members: Sequence[Member], n_out: int, rate: float) -> Cells:
    """Build the cells of a set at `rate` [Hz] of outputs: the blocks of all effects of its members."""
    from sealscope.physics.rig import NUMBERS

    numbers = {id(member.numbers): member.numbers for member in members}
    rows = {
        key: [float(getattr(numbers_of_block, name)) for name in NUMBERS] for key, numbers_of_block in numbers.items()
    }
    base = np.array([rows[id(member.numbers)] for member in members])
    effects = [effect for member in members for effect in member.effects]
    bounds = blocks_of(effects, n_out, rate)
    middles = 0.5 * (bounds[:-1] + bounds[1:]) / rate
    fields = tuple(sorted({NUMBERS.index(effect.field) for effect in effects}))
    values = np.repeat(base[:, list(fields), None], middles.size, axis=2)
    for run, member in enumerate(members):
        for name, series in values_of(member.effects, member.numbers, middles).items():
            values[run, fields.index(NUMBERS.index(name))] = series
    return Cells(bounds, base, fields, values)


def with_sizes(experiment: Experiment, size: float) -> Experiment:
    """Set the coefficient of an experiment's leak."""
    if not experiment.leaks:
        return experiment
    return replace(experiment, leaks=(replace(experiment.leaks[0], mean=None, coefficient=size),))


def instrument_rows(members: Sequence[Member], first: int, last: int) -> Array:
    """Build (runs, 2, INSTRUMENT_ROWS) of p_A and p_B for samples first .. last, linear between these."""
    from sealscope.simulation.batch.signals import HUM, HUM_PHASE

    ends = np.array([first, last]) / members[0].experiment.rate
    experiments = [member.experiment for member in members]
    rows = np.array(
        [_channels(experiment.rig, experiment.readings(), ends, last - first) for experiment in experiments]
    )
    for row, experiment in zip(rows, experiments, strict=True):
        if row[:, HUM].any():
            row[:, HUM_PHASE] = np.random.default_rng([experiment.seed, 1]).random(len(CHAMBERS))
    return rows


def _channels(rig: Rig, readings: Readings, ends: Array, samples: int) -> Array:
    """Build (2, INSTRUMENT_ROWS) of p_A and p_B, linear between the two times `ends` [s], `samples` apart."""
    from sealscope.simulation.batch import signals as at

    rows, daq = np.zeros((len(CHAMBERS), at.INSTRUMENT_ROWS)), rig.daq
    for row, name in zip(rows, CHAMBERS, strict=True):
        sensor = getattr(rig.sensors, name)
        for place, rise, parameter, value, plus in (
            (at.GAIN, at.GAIN_RISE, f"sensors.{name}.gain_error", sensor.gain_error, 1.0),
            (at.OFFSET, at.OFFSET_RISE, f"sensors.{name}.offset", sensor.offset, 0.0),
            (at.NOISE, at.NOISE_RISE, f"sensors.{name}.noise", sensor.noise, 0.0),
            (at.COMMON, at.COMMON_RISE, "sensors.common_noise", rig.sensors.common_noise, 0.0),
        ):
            start_value, end_value = np.broadcast_to(readings.value(parameter, value, ends), (2,))
            row[place], row[rise] = start_value + plus, (end_value - start_value) / samples
        row[at.WALK] = sensor.drift / np.sqrt(daq.sample_rate)
        row[at.HUM], row[at.HUM_TURNS] = sensor.hum, sensor.hum_frequency / daq.sample_rate
        row[at.LEAST], row[at.LARGEST] = sensor.range_lo, sensor.range_hi
        row[at.VOLTS] = daq.sensor_volts_lo
        row[at.PER_PASCAL] = (daq.sensor_volts_hi - daq.sensor_volts_lo) / (sensor.range_hi - sensor.range_lo)
        row[at.COUNT], row[at.TOP] = daq.step, 2.0 ** (daq.bits - 1)
    return rows


#: Steps of a chunk, and so the arrays of the command's shape; the cells of a chunk never are cut.
CHUNK_STEPS = 4096


class SetRun:
    """The runs of a set.

    `sizes` (runs,) are the leaks' coefficients, `measured` those whose flow is accounted, `bounds` [s] the segments of
    the statistics, None for none (flows alone are then of interest).
    """

    #: Runs of a group.
    width: ClassVar[int] = 8

    def __init__(self, part: LaneSet, step: float, sizes: Array, measured: Array, bounds: Array | None) -> None:
        from sealscope.physics.solvers.advance import EXPLICIT, IMPLICIT, nodes_of
        from sealscope.physics.solvers.limits import longest_step
        from sealscope.physics.vector.runs import ACCOUNTS, CHANNELS, LEAST

        members, common = part.members, part.experiment
        self.part, self.runs, self.channels = part, len(members), CHANNELS
        self.method = choose_method(common.rig, common.method)
        self.factor = oversampling_of(common.rate, step)
        rate = common.rate * self.factor
        self.every = steps_per_output(rate, step)
        self.h = 1.0 / (rate * self.every)
        self.samples = round(common.duration * common.rate)
        self.outputs = (self.samples + FILTER_REACH) * self.factor
        self.nodes = nodes_of(IMPLICIT if self.method == "imex" else EXPLICIT, self.h)
        self.cells = cells_of(members, self.outputs, rate)
        self.numbers = members[0].numbers  # of which the choices count; the numbers stand in the table
        leaks = leak_rows(members, sizes, measured)
        checked = set()
        for member, (G, C) in zip(members, leaks[:, :2].tolist(), strict=True):
            for numbers in member.extremes:
                what = id(numbers), G, C
                if not (member.experiment.allow_unresolved or what in checked):
                    checked.add(what)
                    refuse_unresolved(numbers, self.h, self.method)
                    refuse_long(self.h, longest_step(numbers, G, C), f"the leak of run {member.place}")
        experiments = [member.experiment for member in members]
        states = [state_under(experiment.rig, experiment.load, experiment.x_0) for experiment in experiments]
        self.state = in_lanes(np.array(states), self.width)
        self.groups = len(self.state)
        self.drive = in_lanes(np.array([[m.gain, m.offset] for m in members]), self.width)
        self.leaks = in_lanes(leaks, self.width)
        self.account = np.zeros((self.groups, ACCOUNTS, self.width))
        self.account[:, LEAST] = np.inf
        self._prepare_filters(rate)
        self.bounds = bounds
        if bounds is not None:
            self._prepare_statistics(bounds)

    def _prepare_filters(self, rate: float) -> None:
        """Lay out the anti-alias filter of each lane: tap k is of the output k - `before` steps from the sample."""
        sensors = [member.experiment.rig.sensors for member in self.part.members]
        delays = np.array([[getattr(group, name).delay * rate for name in CHAMBERS] for group in sensors])
        taps_by_delay = {delay: anti_alias_taps(self.factor, delay % 1.0) for delay in set(delays.ravel().tolist())}
        self.after = max(taps.size // 2 for taps in taps_by_delay.values())
        self.before = self.after + int(delays.max())
        filters = np.zeros((self.runs, self.channels, self.before + self.after + 1))
        for place, delay in np.ndenumerate(delays):
            taps = taps_by_delay[float(delay)]
            start = self.before - int(delay) - taps.size // 2
            filters[place][start : start + taps.size] = taps
        self.taps = in_lanes(filters, self.width)

    def _prepare_statistics(self, bounds: Array) -> None:
        from sealscope.signals.filters import reach
        from sealscope.simulation.batch.noise import keys
        from sealscope.simulation.batch.signals import QUANTITIES

        before, after = reach()[-1]
        samples = np.round(bounds * self.part.experiment.rate).astype(np.int64)
        self.segments = np.clip(samples, before, self.samples - after)
        self.sums = np.zeros((self.groups, self.channels, self.segments.size - 1, QUANTITIES, self.width))
        self.keys = in_lanes(keys([m.experiment.seed for m in self.part.members]), self.width)

    def run_all(self, threads: int, progress: Callable[[float], None] | None) -> None:
        """Run all groups, shared out over `threads` (the compiled parts run in parallel)."""
        cuts = np.unique(np.linspace(0, self.groups, min(threads, self.groups) + 1).round().astype(int)).tolist()
        lock, progressed = threading.Lock(), 0.0

        def tell(share: float) -> None:
            nonlocal progressed
            if progress is not None:
                with lock:
                    progressed += share
                    progress(progressed)

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda part: self._run_groups(part, tell), itertools.pairwise(cuts)))

    def _chunks(self) -> list[tuple[int, int, int, int]]:
        """List the chunks: cells first .. last and outputs start .. stop of each."""
        most = max(1, CHUNK_STEPS // self.every)
        edges = self.cells.bounds
        chunks = []
        first = 0
        while first < edges.size - 1:
            last = first + 1
            while last < edges.size - 1 and edges[last + 1] - edges[first] <= most:
                last += 1
            start, stop = int(edges[first]), int(edges[last])
            chunks += [(first, last, a, min(a + most, stop)) for a in range(start, stop, most)]
            first = last
        return chunks

    def _due(self, stop: int) -> int:
        """Count the samples that can be read once the outputs up to `stop` are computed."""
        if stop == self.outputs:
            return self.samples
        return min(max(0, (stop - self.after - 1) // self.factor + 1), self.samples)

    def _run_groups(self, groups: tuple[int, int], tell: Callable[[float], None]) -> None:
        """Run the groups first <= g < last from standstill to the end."""
        from sealscope.physics.vector.runs import advance_lanes_imex, advance_lanes_rk4
        from sealscope.signals.streams import DetailStream
        from sealscope.simulation.batch.signals import sense_lanes

        advance = advance_lanes_imex if self.method == "imex" else advance_lanes_rk4
        a, b = groups
        part = (0, b - a)
        state, drive, leaks, account = self.state[a:b], self.drive[a:b], self.leaks[a:b], self.account[a:b]
        table, cells = np.empty((0, 0, 0, 0)), (-1, -1)
        chunks = self._chunks()
        history = self.before + self.after + self.factor  # outputs that later samples still need
        longest = max(stop - start for _, _, start, stop in chunks)
        pressures = np.zeros((b - a, history + longest, self.channels, self.width))
        walks = np.zeros((b - a, self.channels, self.width))
        wavelet = DetailStream((self.channels, (b - a) * self.width))
        sampled = 0
        for first, last, start, stop in chunks:
            if cells != (first, last):
                table, cells = self.cells.table(first, last, self.width)[a:b], (first, last)
            bounds = (np.clip(self.cells.bounds[first : last + 1], start, stop) - start) * self.every  # in steps
            advance(
                part, state, self.h, start * self.every, self.nodes, self._shape(start, stop), drive, leaks, table,
                bounds, self.numbers, self.every, pressures, history, account,
            )  # fmt: skip
            self._check(groups, stop)
            if self.bounds is not None:
                if start == 0:
                    pressures[:, :history] = pressures[:, history : history + 1]  # at standstill before the beginning
                until = self._due(stop)
                if until > sampled:
                    begin = sampled * self.factor - self.before - (start - history)
                    sense_lanes(
                        part, pressures, begin, self.factor, self.taps[a:b], sampled, until,
                        self._sensors(groups, sampled, until), self.keys[a:b], walks, wavelet.taps, wavelet.buffers,
                        self.segments, self.sums[a:b],
                    )  # fmt: skip
                    sampled = until
                pressures[:, :history] = pressures[:, stop - start : stop - start + history].copy()
            tell((stop - start) / self.outputs * (b - a) / self.groups)

    def _shape(self, start: int, stop: int) -> Array:
        """Compute the command's shape at the nodes of the steps between two outputs, with a load's forces behind it."""
        t = np.arange(start * self.every, stop * self.every, dtype=np.float64) * self.h
        times, load = t[:, None] + self.nodes, self.part.experiment.load
        volts = self.part.shape.volts(times)
        return np.ascontiguousarray(
            volts if load is None else np.hstack([volts, np.broadcast_to(load.value_at(times), times.shape)])
        )

    def _sensors(self, groups: tuple[int, int], first: int, last: int) -> Array:
        """Build the instruments of the groups for samples first .. last, (groups, 2, INSTRUMENT_ROWS, width)."""
        if self._steady is not None:
            return self._steady[groups[0] : groups[1]]
        members = self.part.members[groups[0] * self.width : groups[1] * self.width]
        return in_lanes(instrument_rows(members, first, last), self.width)

    @cached_property
    def _steady(self) -> Array | None:
        """The instruments of all groups, None where some change within a run."""
        if any(member.experiment.readings().effects for member in self.part.members):
            return None
        return in_lanes(instrument_rows(self.part.members, 0, self.samples), self.width)

    def _check(self, groups: tuple[int, int], stop: int) -> None:
        """Raise SimulationFailed for a run that diverged, fell below vacuum or hit a stop too hard for the step."""
        from sealscope.physics.solvers.limits import longest_step_on_stop
        from sealscope.physics.vector.runs import DIVERGED, LEAST, REACH

        account = self.account[groups[0] : groups[1]]
        time = stop / (self.part.experiment.rate * self.factor)
        half = 0.5 * float(min(member.numbers.L for member in self.part.members))
        finite = np.all(account[:, DIVERGED] == 0.0) and account[:, LEAST].min() >= VACUUM
        if finite and account[:, REACH].max() <= half:
            return
        accounts = out_of_lanes(account, account.shape[0] * self.width)
        for k, (reach, least, diverged) in enumerate(accounts[:, [REACH, LEAST, DIVERGED]]):
            place = groups[0] * self.width + k
            if place >= self.runs:
                break
            member = self.part.members[place]
            if not diverged == 0.0:
                raise SimulationFailed(
                    f"run {member.place} diverged before t = {time:.4g} s; take a smaller step or smaller gains"
                )
            if member.experiment.allow_unresolved:
                continue
            if reach > 0.5 * member.numbers.L:
                limit = longest_step_on_stop(member.numbers)
                refuse_long(self.h, limit, f"the hard stop (cylinder.k_stop, d_stop) of run {member.place}")
            if least < VACUUM:
                raise SimulationFailed(
                    f"pressures of run {member.place} must stay above vacuum ({VACUUM:g} Pa gauge: the model has no "
                    f"cavitation), got {least:.4g} Pa before t = {time:.4g} s; simulate it by itself for the place"
                )

    def rms(self) -> Array:
        """RMS of d1..d4 and d3 d4 in each segment, (runs, 2, segments, 5)."""
        count = np.diff(self.segments)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(out_of_lanes(self.sums, self.runs) / count)

    def mean_flow(self) -> Array:
        """Mean |Q| [m^3/s] of the accounted leaks while open, (runs,)."""
        from sealscope.physics.vector.runs import FLOW, OPEN

        accounts = out_of_lanes(self.account, self.runs)
        opened = accounts[:, OPEN]
        return np.where(opened > 0, accounts[:, FLOW] / np.where(opened > 0, opened, 1.0), 0.0)
