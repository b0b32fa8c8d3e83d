"""One set of runs, side by side from rest to the end, a few seconds at a time."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.errors import SimulationFailed
from sealscope.recordings.recording import Array
from sealscope.simulation.batch_plan import CHAMBERS, LaneSet, cells_of, in_lanes, leak_rows, out_of_lanes
from sealscope.simulation.instruments import FILTER_REACH, anti_alias_taps
from sealscope.simulation.integrate import VACUUM, choose_method, refuse_long, refuse_unresolved, steps_per_output

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Steps of a chunk, and so the arrays of the command's shape; the cells of a chunk never are cut.
CHUNK_STEPS = 4096


class SetRun:
    """The runs of a set: `sizes` (runs,) are the leaks' coefficients, `measured` those whose flow is accounted,
    `bounds` [s] the segments of the statistics, None for none (flows alone are then of interest)."""

    def __init__(self, part: LaneSet, step: float, sizes: Array, measured: Array, bounds: Array | None) -> None:
        from sealscope.physics.imex import IMEX_NODES
        from sealscope.physics.lane_runs import ACCOUNTS, LEAST, TOLD
        from sealscope.physics.lanes import WIDTH
        from sealscope.physics.limits import longest_step
        from sealscope.physics.rig import initial_state
        from sealscope.physics.rk4 import RK4_NODES
        from sealscope.simulation.simulate import oversampling_of

        members, common = part.members, part.experiment
        self.part, self.runs, self._width, self.told_rows = part, len(members), WIDTH, TOLD
        self.method = choose_method(common.rig, common.method)
        self.factor = oversampling_of(common.rate, step)
        rate = common.rate * self.factor
        self.every = steps_per_output(rate, step)
        self.h = 1.0 / (rate * self.every)
        self.samples = round(common.duration * common.rate)
        self.outputs = (self.samples + FILTER_REACH) * self.factor
        nodes = np.array(IMEX_NODES if self.method == "imex" else RK4_NODES)
        nodes[0], nodes[-1] = 1e-9, 1.0 - 1e-9  # the limits from inside the step
        self.nodes = nodes * self.h
        self.cells = cells_of(members, self.outputs, rate)
        self.numbers = members[0].numbers
        for member, (G, C) in zip(members, leak_rows(members, sizes, measured)[:, :2].tolist(), strict=True):
            if not member.experiment.allow_unresolved:
                refuse_unresolved(member.numbers, self.h, self.method)
                refuse_long(self.h, longest_step(member.numbers, G, C), f"the leak of run {member.place}")
        self.state = in_lanes(np.array([initial_state(m.experiment.rig, m.experiment.x_0) for m in members]), WIDTH)
        self.groups = len(self.state)
        self.drive = in_lanes(np.array([[m.gain, m.offset] for m in members]), WIDTH)
        self.leaks = in_lanes(leak_rows(members, sizes, measured), WIDTH)
        self.account = np.zeros((self.groups, ACCOUNTS, WIDTH))
        self.account[:, LEAST] = np.inf
        self._prepare_filters(rate)
        self.bounds = bounds
        if bounds is not None:
            self._prepare_statistics(bounds)

    def _prepare_filters(self, rate: float) -> None:
        """The anti-alias filter, for each lane where a channel is late: first tap `before` and last `after` outputs
        from the sample's."""
        self.taps = anti_alias_taps(self.factor)
        self.before = self.after = self.taps.size // 2
        sensors = [member.experiment.rig.sensors for member in self.part.members]
        delays = np.array([[getattr(one, name).delay * rate for name in CHAMBERS] for one in sensors])
        whole = np.floor(delays).astype(np.int64)
        if not delays.any():
            self.own_taps = np.zeros((self.groups, self.told_rows, 0, self._width))
            return
        filters = [[anti_alias_taps(self.factor, delay % 1.0) for delay in run] for run in delays]
        self.after = max(one.size // 2 for run in filters for one in run)
        self.before = self.after + int(whole.max())
        own = np.zeros((self.runs, self.told_rows, self.before + self.after + 1))
        for run, channel in np.ndindex(*delays.shape):
            taps = filters[run][channel]
            start = self.before - int(whole[run, channel]) - taps.size // 2
            own[run, channel, start : start + taps.size] = taps
        self.own_taps = in_lanes(own, self._width)

    def _prepare_statistics(self, bounds: Array) -> None:
        from sealscope.signals.filters import decomposition_filters, reach
        from sealscope.simulation.batch_signals import FILTER_ROWS, LEVELS, QUANTITIES
        from sealscope.simulation.lane_noise import keys

        rate = self.part.experiment.rate
        before, after = reach("db8", LEVELS)[-1]
        at = np.round(bounds * rate).astype(np.int64)
        self.segments = np.clip(at, before, self.samples - after)
        self.low, self.high = decomposition_filters("db8")
        shape = (self.groups, self.told_rows)
        self.walks = np.zeros((*shape, self._width))
        self.filters = np.zeros((*shape, FILTER_ROWS, self._width))
        self.sums = np.zeros((*shape, self.segments.size - 1, QUANTITIES, self._width))
        self.keys = in_lanes(keys([m.experiment.seed for m in self.part.members]), self._width)

    def all(self, pool: ThreadPoolExecutor, workers: int, progress: Callable[[float], None] | None) -> None:
        """Run all groups, shared out over the pool's threads (the compiled parts run beside each other)."""
        cuts = np.unique(np.linspace(0, self.groups, min(workers, self.groups) + 1).round().astype(int))
        lock, reached = threading.Lock(), [0.0]

        def tell(share: float) -> None:
            if progress is not None:
                with lock:
                    reached[0] += share
                    progress(reached[0])

        parts = [(int(a), int(b)) for a, b in itertools.pairwise(cuts)]
        for future in [pool.submit(self._some, part, tell) for part in parts]:
            future.result()

    def _chunks(self) -> list[tuple[int, int, int, int]]:
        """Cells first .. last and outputs start .. stop of each chunk."""
        most = max(1, CHUNK_STEPS // self.every)
        edges = self.cells.bounds
        found = []
        first = 0
        while first < edges.size - 1:
            last = first + 1
            while last < edges.size - 1 and edges[last + 1] - edges[first] <= most:
                last += 1
            start, stop = int(edges[first]), int(edges[last])
            found += [(first, last, a, min(a + most, stop)) for a in range(start, stop, most)]
            first = last
        return found

    def _some(self, groups: tuple[int, int], tell: Callable[[float], None]) -> None:
        """The groups first <= g < last from rest to the end."""
        from sealscope.physics.lane_runs import advance_lanes_imex, advance_lanes_rk4
        from sealscope.simulation.batch_signals import sense_lanes

        advance = advance_lanes_imex if self.method == "imex" else advance_lanes_rk4
        a, b = groups
        own = (0, b - a)
        state, drive, leaks, account = self.state[a:b], self.drive[a:b], self.leaks[a:b], self.account[a:b]
        table, cells = np.empty((0, 0, 0, 0)), (-1, -1)
        chunks, shapes = self._chunks(), self._shapes()
        kept = self.before + self.after + self.factor  # outputs that later samples still need
        longest = max(stop - start for _, _, start, stop in chunks)
        told = np.zeros((b - a, kept + longest, self.told_rows, self._width))
        sampled = 0
        for first, last, start, stop in chunks:
            if cells != (first, last):
                table, cells = self.cells.table(first, last, self._width)[a:b], (first, last)
            steps = np.arange(start * self.every, stop * self.every, dtype=np.float64)
            shape = shapes(steps * self.h)
            bounds = (np.clip(self.cells.bounds[first : last + 1], start, stop) - start) * self.every
            advance(
                own, state, self.h, start * self.every, self.nodes, shape, drive, leaks, table, bounds, self.numbers,
                self.every, told, kept, account,
            )  # fmt: skip
            self._check(groups, stop)
            if self.bounds is not None:
                if start == 0:
                    told[:, :kept] = told[:, kept : kept + 1]  # at rest before the beginning
                until = self.samples if stop == self.outputs else max(0, (stop - self.after - 1) // self.factor + 1)
                until = min(until, self.samples)
                if until > sampled:
                    sensors = self._sensors(groups, sampled, until)
                    begin = sampled * self.factor - self.before - (start - kept)
                    sense_lanes(
                        own, told, begin, self.factor, self.taps, self.own_taps[a:b], sampled, until, sensors,
                        self.keys[a:b], self.walks[a:b], self.filters[a:b], self.low, self.high, self.segments,
                        self.sums[a:b],
                    )  # fmt: skip
                    sampled = until
                told[:, :kept] = told[:, stop - start : stop - start + kept].copy()
            tell((stop - start) / self.outputs * (b - a) / self.groups)

    def _shapes(self) -> Callable[[Array], Array]:
        """The command's shape at the nodes of the steps that begin at given times [s], for one thread's use."""
        from sealscope.simulation.commands import Sine
        from sealscope.simulation.inputs import NodeSines

        shape = self.part.shape
        if isinstance(shape, Sine):
            sines = NodeSines(shape.omega, shape.phase)
            return lambda start: sines.at(start, self.nodes, 1.0, 0.0)
        return lambda start: np.ascontiguousarray(shape.volts(start[:, None] + self.nodes))

    def _sensors(self, groups: tuple[int, int], first: int, last: int) -> Array:
        """Instruments of the groups for samples first .. last, (groups, 2, INSTRUMENT_ROWS, width)."""
        if not hasattr(self, "_steady"):
            self._steady = self._instruments(0, self.samples)
            self._drifting = any(member.experiment.readings().adjustments for member in self.part.members)
        found = self._instruments(first, last) if self._drifting else self._steady
        return np.ascontiguousarray(in_lanes(found, self._width)[groups[0] : groups[1]])

    def _instruments(self, first: int, last: int) -> Array:
        from sealscope.simulation.batch_signals import INSTRUMENT_ROWS
        from sealscope.simulation.readings import Readings

        rate = self.part.experiment.rate
        ends = np.array([first, last]) / rate
        rows = np.zeros((self.runs, self.told_rows, INSTRUMENT_ROWS))
        for run, member in enumerate(self.part.members):
            rig = member.experiment.rig
            readings: Any = member.experiment.readings() if member.experiment.drifts else Readings()
            hum_phase = np.random.default_rng([member.experiment.seed, 1]).random(self.told_rows)
            for channel, name in enumerate(CHAMBERS):
                rows[run, channel] = instrument_row(rig, name, rate, readings, ends, last - first, hum_phase[channel])
        return rows

    def _check(self, groups: tuple[int, int], stop: int) -> None:
        """Raise SimulationFailed for a run that diverged, fell below vacuum or hit a stop too hard for the step."""
        from sealscope.physics.lane_runs import LEAST, REACH, SOUND
        from sealscope.physics.limits import longest_step_on_stop

        account = self.account[groups[0] : groups[1]]
        time = stop / (self.part.experiment.rate * self.factor)
        lowest = account[:, LEAST]
        if np.all(account[:, SOUND] == 0.0) and lowest.min() >= VACUUM and account[:, REACH].max() <= self._half:
            return
        found = out_of_lanes(account, account.shape[0] * self._width)
        for k, (reach, least, sound) in enumerate(found[:, [REACH, LEAST, SOUND]]):
            place = groups[0] * self._width + k
            if place >= self.runs:
                break
            member = self.part.members[place]
            if not sound == 0.0:
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

    @property
    def _half(self) -> float:
        return 0.5 * min(member.numbers.L for member in self.part.members)

    def rms(self) -> Array:
        """RMS of d1..d4 and d3 d4 in each segment, (runs, 2, segments, 5)."""
        count = np.diff(self.segments)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(out_of_lanes(self.sums, self.runs) / count)

    def mean_flow(self) -> Array:
        """Mean |Q| [m^3/s] of the accounted leaks while open, (runs,)."""
        from sealscope.physics.lane_runs import FLOW, OPEN

        found = out_of_lanes(self.account, self.runs)
        opened = found[:, OPEN]
        return np.where(opened > 0, found[:, FLOW] / np.where(opened > 0, opened, 1.0), 0.0)


def instrument_row(
    rig: Rig, name: str, rate: float, readings: Any, ends: Array, samples: int, hum_phase: float
) -> Array:
    """(INSTRUMENT_ROWS,) of one pressure channel, even between the two times `ends` [s], `samples` apart."""
    from sealscope.simulation import batch_signals as rows

    sensor, daq = getattr(rig.sensors, name), rig.daq
    row = np.zeros(rows.INSTRUMENT_ROWS)

    def set_even(own: str, value: float, at: int, rise: int, plus: float = 0.0) -> None:
        found = np.broadcast_to(readings.value(own, value, ends), (2,))
        row[at] = found[0] + plus
        row[rise] = (found[1] - found[0]) / samples

    set_even(f"sensors.{name}.gain_error", sensor.gain_error, rows.GAIN, rows.GAIN_RISE, 1.0)
    set_even(f"sensors.{name}.offset", sensor.offset, rows.OFFSET, rows.OFFSET_RISE)
    set_even(f"sensors.{name}.noise", sensor.noise, rows.NOISE, rows.NOISE_RISE)
    set_even("sensors.common_noise", rig.sensors.common_noise, rows.COMMON, rows.COMMON_RISE)
    row[rows.WALK] = sensor.drift / np.sqrt(rate)
    row[rows.HUM], row[rows.HUM_TURNS], row[rows.HUM_PHASE] = sensor.hum, sensor.hum_frequency / rate, hum_phase
    row[rows.LEAST], row[rows.LARGEST] = sensor.range_lo, sensor.range_hi
    row[rows.VOLTS] = daq.sensor_volts_lo
    row[rows.PER_PASCAL] = (daq.sensor_volts_hi - daq.sensor_volts_lo) / (sensor.range_hi - sensor.range_lo)
    row[rows.COUNT], row[rows.TOP] = daq.step, 2.0 ** (daq.bits - 1)
    return row
