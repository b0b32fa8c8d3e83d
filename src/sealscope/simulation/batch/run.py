"""One set of runs, side by side from rest to the end, a few seconds at a time."""

from __future__ import annotations

import itertools
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sealscope.errors import SimulationFailed
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.batch.instruments import instrument_rows
from sealscope.simulation.batch.layout import LaneSet, cells_of, in_lanes, leak_rows, out_of_lanes
from sealscope.simulation.experiment import choose_method
from sealscope.simulation.instruments import FILTER_REACH, anti_alias_taps
from sealscope.simulation.integrate import VACUUM, refuse_long, refuse_unresolved, steps_per_output

if TYPE_CHECKING:
    from sealscope.physics.rig import RigNumbers

#: Steps of a chunk, and so the arrays of the command's shape; the cells of a chunk never are cut.
CHUNK_STEPS = 4096


class SetRun:
    """The runs of a set.

    `sizes` (runs,) are the leaks' coefficients, `measured` those whose flow is accounted, `bounds` [s] the segments of
    the statistics, None for none (flows alone are then of interest). `most` samples are run where that is less than
    all.
    """

    #: Runs of a group.
    width: ClassVar[int] = 8

    def __init__(
        self,
        part: LaneSet,
        step: float,
        sizes: Array,
        measured: Array,
        bounds: Array | None,
        most: int | None = None,
    ) -> None:
        from sealscope.physics.rig import initial_state
        from sealscope.physics.solvers.imex import IMEX_NODES
        from sealscope.physics.solvers.limits import longest_step
        from sealscope.physics.solvers.rk4 import RK4_NODES
        from sealscope.physics.vector.runs import ACCOUNTS, LEAST, TOLD
        from sealscope.simulation.integrate import oversampling_of

        members, common = part.members, part.experiment
        self.asked_step, self.sizes = step, sizes
        self.part, self.runs, self.told_rows = part, len(members), TOLD
        self.method = choose_method(common.rig, common.method)
        self.factor = oversampling_of(common.rate, step)
        rate = common.rate * self.factor
        self.every = steps_per_output(rate, step)
        self.h = 1.0 / (rate * self.every)
        self.samples = min(round(common.duration * common.rate), most or sys.maxsize)
        self.outputs = (self.samples + FILTER_REACH) * self.factor
        nodes = np.array(IMEX_NODES if self.method == "imex" else RK4_NODES)
        nodes[0], nodes[-1] = 1e-9, 1.0 - 1e-9  # the limits from inside the step
        self.nodes = nodes * self.h
        self.cells = cells_of(members, self.outputs, rate)
        self.numbers = self._constants(members[0].numbers)
        leaks = leak_rows(members, sizes, measured)
        checked = set()
        for member, (G, C) in zip(members, leaks[:, :2].tolist(), strict=True):
            what = id(member.numbers), G, C
            if not (member.experiment.allow_unresolved or what in checked):
                checked.add(what)
                refuse_unresolved(member.numbers, self.h, self.method)
                refuse_long(self.h, longest_step(member.numbers, G, C), f"the leak of run {member.place}")
        self.state = in_lanes(
            np.array([initial_state(m.experiment.rig, m.experiment.x_0) for m in members]), self.width
        )
        self.groups = len(self.state)
        self.drive = in_lanes(np.array([[m.gain, m.offset] for m in members]), self.width)
        self.leaks = in_lanes(leaks, self.width)
        self.account = np.zeros((self.groups, ACCOUNTS, self.width))
        self.account[:, LEAST] = np.inf
        self._prepare_filters(rate)
        self.bounds = bounds
        if bounds is not None:
            self._prepare_statistics(bounds)

    def _constants(self, numbers: RigNumbers) -> RigNumbers:
        """Return what the compiled code takes as constants of the set: the choices; the numbers stand in the table."""
        from sealscope.physics.rig import NUMBERS
        from sealscope.physics.vector.fixed import left_to_table

        return left_to_table(numbers, NUMBERS)

    def _prepare_filters(self, rate: float) -> None:
        """Lay out the anti-alias filter, for each lane where a channel is late.

        Its first tap is `before` and its last `after` outputs from the sample's.
        """
        from sealscope.simulation.batch.signals import TILE

        taps = anti_alias_taps(self.factor)
        self.before = self.after = taps.size // 2
        self.taps = np.pad(taps, (TILE - 1) * self.factor)
        sensors = [member.experiment.rig.sensors for member in self.part.members]
        delays = np.array([[getattr(one, name).delay * rate for name in CHAMBERS] for one in sensors])
        whole = np.floor(delays).astype(np.int64)
        if not delays.any():
            self.own_taps = np.zeros((self.groups, self.told_rows, 1, self.width))
            return
        filters = [[anti_alias_taps(self.factor, delay % 1.0) for delay in run] for run in delays]
        self.after = max(one.size // 2 for run in filters for one in run)
        self.before = self.after + int(whole.max())
        own = np.zeros((self.runs, self.told_rows, self.before + self.after + 1))
        for run, channel in np.ndindex(*delays.shape):
            taps = filters[run][channel]
            start = self.before - int(whole[run, channel]) - taps.size // 2
            own[run, channel, start : start + taps.size] = taps
        self.own_taps = in_lanes(own, self.width)

    def _prepare_statistics(self, bounds: Array) -> None:
        from sealscope.signals.filters import decomposition_filters, reach
        from sealscope.simulation.batch.noise import keys
        from sealscope.simulation.batch.signals import LEVELS, QUANTITIES

        rate = self.part.experiment.rate
        before, after = reach("db8", LEVELS)[-1]
        at = np.round(bounds * rate).astype(np.int64)
        self.segments = np.clip(at, before, self.samples - after)
        self.low, self.high = (tuple(taps.tolist()) for taps in decomposition_filters("db8"))
        shape = (self.groups, self.told_rows)
        self.sums = np.zeros((*shape, self.segments.size - 1, QUANTITIES, self.width))
        self.keys = in_lanes(keys([m.experiment.seed for m in self.part.members]), self.width)

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

    @property
    def _kept(self) -> int:
        """Outputs that later samples still need."""
        return self.before + self.after + self.factor

    def _due(self, stop: int) -> int:
        """Return the sample before which all can be read once outputs up to `stop` are there."""
        if stop == self.outputs:
            return self.samples
        return min(max(0, (stop - self.after - 1) // self.factor + 1), self.samples)

    def _some(self, groups: tuple[int, int], tell: Callable[[float], None]) -> None:
        """Run the groups first <= g < last from rest to the end."""
        from sealscope.physics.vector.runs import advance_lanes_imex, advance_lanes_rk4
        from sealscope.simulation.batch.signals import FILTER_ROWS, sense_lanes

        advance = advance_lanes_imex if self.method == "imex" else advance_lanes_rk4
        a, b = groups
        own = (0, b - a)
        state, drive, leaks, account = self.state[a:b], self.drive[a:b], self.leaks[a:b], self.account[a:b]
        table, cells = np.empty((0, 0, 0, 0)), (-1, -1)
        chunks, shapes, kept = self._chunks(), self._shapes(), self._kept
        longest = max(stop - start for _, _, start, stop in chunks)
        told = np.zeros((b - a, kept + longest, self.told_rows, self.width))
        walks = np.zeros((b - a, self.told_rows, self.width))
        filters = np.zeros((b - a, self.told_rows, FILTER_ROWS if self.bounds is not None else 0, self.width))
        sampled = 0
        for first, last, start, stop in chunks:
            if cells != (first, last):
                table, cells = self.cells.table(first, last, self.width)[a:b], (first, last)
            advance(
                own, state, self.h, start * self.every, self.nodes, shapes(start, stop), drive, leaks, table,
                self._cell_bounds(first, last, start, stop), self.numbers, self.every, told, kept, account,
            )  # fmt: skip
            self._check(groups, stop)
            if self.bounds is not None:
                if start == 0:
                    told[:, :kept] = told[:, kept : kept + 1]  # at rest before the beginning
                until = self._due(stop)
                if until > sampled:
                    sensors = self.sensors(groups, sampled, until)
                    begin = sampled * self.factor - self.before - (start - kept)
                    sense_lanes(
                        own, told, begin, self.factor, self.taps, self.own_taps[a:b], sampled, until, sensors,
                        self.keys[a:b], walks, filters, self.low, self.high, self.segments, self.sums[a:b],
                    )  # fmt: skip
                    sampled = until
                told[:, :kept] = told[:, stop - start : stop - start + kept].copy()
            tell((stop - start) / self.outputs * (b - a) / self.groups)

    def _cell_bounds(self, first: int, last: int, start: int, stop: int) -> np.ndarray:
        """Return the steps of the chunk of outputs start .. stop at which its cells begin."""
        return np.asarray((np.clip(self.cells.bounds[first : last + 1], start, stop) - start) * self.every)

    def _shapes(self) -> Callable[[int, int], Array]:
        """Return the command's shape at the nodes of the steps between two outputs, for one thread's use."""
        from sealscope.simulation.commands import Sine
        from sealscope.simulation.integrate import NodeSines

        def times(start: int, stop: int) -> Array:
            return np.arange(start * self.every, stop * self.every, dtype=np.float64) * self.h

        shape = self.part.shape
        if isinstance(shape, Sine):
            sines = NodeSines(shape.omega, shape.phase)
            return lambda start, stop: sines.at(times(start, stop), self.nodes, 1.0, 0.0)
        return lambda start, stop: np.ascontiguousarray(shape.volts(times(start, stop)[:, None] + self.nodes))

    def sensors(self, groups: tuple[int, int], first: int, last: int) -> Array:
        """Instruments of the groups for samples first .. last, (groups, 2, INSTRUMENT_ROWS, width)."""
        if not self.drifting:
            return np.asarray(in_lanes(self._steady, self.width)[groups[0] : groups[1]])
        own = self.part.members[groups[0] * self.width : groups[1] * self.width]
        return np.asarray(in_lanes(instrument_rows(own, first, last), self.width))

    @cached_property
    def drifting(self) -> bool:
        """Whether instruments change within a run."""
        return any(member.experiment.readings().adjustments for member in self.part.members)

    @cached_property
    def _steady(self) -> Array:
        return instrument_rows(self.part.members, 0, self.samples)

    def _check(self, groups: tuple[int, int], stop: int) -> None:
        """Raise SimulationFailed for a run that diverged, fell below vacuum or hit a stop too hard for the step."""
        from sealscope.physics.solvers.limits import longest_step_on_stop
        from sealscope.physics.vector.runs import LEAST, REACH, SOUND

        account = self.account[groups[0] : groups[1]]
        time = stop / (self.part.experiment.rate * self.factor)
        lowest = account[:, LEAST]
        if np.all(account[:, SOUND] == 0.0) and lowest.min() >= VACUUM and account[:, REACH].max() <= self._half:
            return
        found = out_of_lanes(account, account.shape[0] * self.width)
        for k, (reach, least, sound) in enumerate(found[:, [REACH, LEAST, SOUND]]):
            place = groups[0] * self.width + k
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
        from sealscope.physics.vector.runs import FLOW, OPEN

        found = out_of_lanes(self.account, self.runs)
        opened = found[:, OPEN]
        return np.where(opened > 0, found[:, FLOW] / np.where(opened > 0, opened, 1.0), 0.0)
