"""A set of runs on a GPU: one thread a run, the laws and the instruments of the processor's lanes compiled for it.

A group is the threads that run in step (a warp), a lane is a thread's place in it; arrays are laid out as for lanes, so
that the threads of a warp load and store neighbours. Time goes in chunks, as on the processor: a chunk is integrated
by one kernel and read, transformed and summed up by another; nothing comes back before the end but sums and accounts.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import cuda

from sealscope.errors import InputError, SimulationFailed
from sealscope.physics.lanes import WARP, load, store
from sealscope.physics.rig import NUMBERS, RigNumbers
from sealscope.physics.vector.fixed import left_to_table
from sealscope.physics.vector.runs import CHANNELS, advance
from sealscope.recordings.recording import Array
from sealscope.simulation.batch.run import LaneSet, SetRun
from sealscope.simulation.batch.signals import FILTER_ROWS, INSTRUMENT_ROWS, sense

#: Whether numba's simulator stands in for a GPU: threads of plain Python, for tests of a few runs.
SIMULATED = bool(cuda.config.ENABLE_CUDASIM)
#: Threads of a block.
THREADS = 64
#: Share of the GPU's free memory that a piece of a set may take.
_SHARE = 0.8
#: How many runs of a set, and samples of these, are compared with the processor's, and how far RMS may differ by
#: rounding and by a few counts of the converter.
CHECKED_RUNS, CHECKED_SAMPLES = 8, 1024
ROUNDING, COUNTS = 1e-6, 1e-2


def require_device() -> None:
    """Raise InputError unless a GPU can be used."""
    if not (SIMULATED or cuda.is_available()):
        raise InputError("device gpu needs an NVIDIA GPU and its driver, and none is found; use device cpu")


@cuda.jit
def _advance_rk4(y, h, start, nodes, shape, drive, leaks, table, bounds, p, every, pressures, begin, account):  # type: ignore[no-untyped-def]
    group = cuda.grid(1) // y.shape[2]
    if group < y.shape[0]:
        own = (group, group + 1)
        advance(False, own, y, h, start, nodes, shape, drive, leaks, table, bounds, p, every, pressures, begin, account)


@cuda.jit
def _advance_imex(y, h, start, nodes, shape, drive, leaks, table, bounds, p, every, pressures, begin, account):  # type: ignore[no-untyped-def]
    group = cuda.grid(1) // y.shape[2]
    if group < y.shape[0]:
        own = (group, group + 1)
        advance(True, own, y, h, start, nodes, shape, drive, leaks, table, bounds, p, every, pressures, begin, account)


@cuda.jit
def _sense(  # type: ignore[no-untyped-def]
    pressures, begin, factor, taps, own_taps, first, last, sensors, keys, walks, filters, low, high, bounds, sums
):
    group = cuda.grid(1) // pressures.shape[3]
    if group < pressures.shape[0]:
        own = (group, group + 1)
        sense(
            own, pressures, begin, factor, taps, own_taps, first, last, sensors, keys, walks, filters, low, high,
            bounds, sums,
        )  # fmt: skip


@cuda.jit
def _move(pressures, source, step, count):  # type: ignore[no-untyped-def]
    """Move outputs source, source + step, .. to outputs 0 .. count - 1 of each run."""
    group = cuda.grid(1) // pressures.shape[3]
    if group < pressures.shape[0]:
        at = group * pressures.shape[1] * CHANNELS
        for k in range(count):
            for channel in range(CHANNELS):
                store(
                    pressures,
                    at + CHANNELS * k + channel,
                    load(pressures, at + CHANNELS * (source + step * k) + channel),
                )


@cuda.jit
def _clear(rows):  # type: ignore[no-untyped-def]
    group = cuda.grid(1) // rows.shape[3]
    if group < rows.shape[0]:
        count = rows.shape[1] * rows.shape[2]
        for k in range(count):
            store(rows, group * count + k, 0.0)


def refuse_disagreement(gpu: Array, processor: Array, places: Sequence[int]) -> None:
    """Raise SimulationFailed unless the RMS of runs (runs, ...) from a GPU and from the processor agree to rounding.

    Three quarters of them must within ROUNDING, and all within COUNTS: where rounding moves a reading across the edge
    of one count of the converter, the RMS of the details around it move by the count's share in them.
    """
    gpu, processor = gpu.reshape(len(places), -1), processor.reshape(len(places), -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.abs(gpu / processor - 1.0)
    off[(gpu == processor) | (np.isnan(gpu) & np.isnan(processor))] = 0.0  # NaN: a record without details
    if np.quantile(off, 0.75) <= ROUNDING and off.max() <= COUNTS:
        return
    run, what = np.unravel_index(np.argmax(np.nan_to_num(off, nan=np.inf)), off.shape)
    computed, expected = gpu[run, what], processor[run, what]
    raise SimulationFailed(
        f"the GPU must find what the processor finds, but in the first seconds of run {places[int(run)]} an RMS is "
        f"{computed:.10g} on the GPU and {expected:.10g} on the processor; use device cpu and report this"
    )


class DeviceRun(SetRun):
    """The runs of a set on a GPU."""

    width = 2 if SIMULATED else WARP
    _checked = False

    def all(self, pool: ThreadPoolExecutor, workers: int, progress: Callable[[float], None] | None) -> None:
        """Run all groups, in pieces that the GPU's memory holds; the pool is the processor's and has nothing to do."""
        if self.bounds is not None and not (SIMULATED or self._checked):
            self._check_against_processor(pool)
        for a, b in self._pieces():
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Grid size")  # few runs leave a GPU idle: that is known
                self._piece(a, b)
            if progress is not None:
                progress(b / self.groups)
        self._check((0, self.groups), self.outputs)

    def _constants(self, numbers: RigNumbers) -> RigNumbers:
        """Return what a kernel is compiled for: the choices, and which numbers are one for all runs throughout.

        The others stand in the table.
        """
        if len(numbers.pushed) > 1:
            raise InputError("a load over position or velocity needs device cpu, got device gpu")
        differ = np.any(self.cells.base != self.cells.base[0], axis=0)
        differ[list(self.cells.changing)] = True
        own = [name for name, differs in zip(NUMBERS, differ, strict=True) if differs]
        return left_to_table(numbers, own, choices=True)

    def _check_against_processor(self, pool: ThreadPoolExecutor) -> None:
        """Run the beginning of some of the runs on both, with the kernels of all, and compare."""
        picked = np.unique(np.linspace(0, self.runs - 1, CHECKED_RUNS).round().astype(int))
        part = LaneSet(tuple(self.part.members[k] for k in picked), self.part.shape)
        sizes, until = self.sizes[picked], min(self.samples, CHECKED_SAMPLES)
        bounds = np.array([0.0, until / part.experiment.rate])
        ours = DeviceRun(part, self.asked_step, sizes, sizes, bounds, until)
        ours.numbers, ours._checked = self.numbers, True
        theirs = SetRun(part, self.asked_step, sizes, sizes, bounds, until)
        for runs in (ours, theirs):
            runs.all(pool, 1, None)
        refuse_disagreement(ours.rms(), theirs.rms(), [member.place for member in part.members])

    def _pieces(self) -> list[tuple[int, int]]:
        chunks = self._chunks()
        rows = CHANNELS * (
            self._kept + max(stop - start for _, _, start, stop in chunks) + FILTER_ROWS + INSTRUMENT_ROWS
        )
        rows += CHANNELS * self.own_taps.shape[2] + 100
        rows += max(last - first for first, last, _, _ in chunks) * self.cells.base.shape[1]
        free = 1e9 if SIMULATED else cuda.current_context().get_memory_info()[0]
        most = max(1, int(_SHARE * free / (8 * rows * self.width)))
        cuts = np.linspace(0, self.groups, -(-self.groups // most) + 1).round().astype(int).tolist()
        return list(itertools.pairwise(cuts))

    def _piece(self, a: int, b: int) -> None:
        """Run the groups a <= g < b from rest to the end."""
        threads = 2 * self.width if SIMULATED else THREADS
        grid = -(-(b - a) * self.width // threads), threads
        chunks, shapes, kept = self._chunks(), self._shapes(), self._kept
        state, drive, leaks, account = (
            cuda.to_device(rows[a:b]) for rows in (self.state, self.drive, self.leaks, self.account)
        )
        nodes = cuda.to_device(self.nodes)
        longest = max(stop - start for _, _, start, stop in chunks)
        pressures = cuda.device_array((b - a, kept + longest, CHANNELS, self.width))
        advance_chunk: Any = _advance_imex if self.method == "imex" else _advance_rk4
        senses = None if self.bounds is None else _Senses(self, a, b, grid)
        table, cells = None, (-1, -1)
        for first, last, start, stop in chunks:
            if cells != (first, last):
                table, cells = cuda.to_device(self.cells.table(first, last, self.width)[a:b]), (first, last)
            advance_chunk[grid](
                state, self.h, start * self.every, nodes, cuda.to_device(np.ascontiguousarray(shapes(start, stop))),
                drive, leaks, table, cuda.to_device(self._cell_bounds(first, last, start, stop)), self.numbers,
                self.every, pressures, kept, account,
            )  # fmt: skip
            if senses is not None:
                if start == 0:
                    _move[grid](pressures, kept, 0, kept)  # at rest before the beginning
                senses.read(pressures, start, self._due(stop))
                _move[grid](pressures, stop - start, 1, kept)
        self.account[a:b] = account.copy_to_host()
        if senses is not None:
            self.sums[a:b] = senses.sums.copy_to_host()


class _Senses:
    """What stays on the GPU of the instruments and filters of groups a <= g < b of a run."""

    def __init__(self, run: DeviceRun, a: int, b: int, grid: tuple[int, int]) -> None:
        self.run, self.groups, self.grid, self.sampled = run, (a, b), grid, 0
        shape = (b - a, CHANNELS)
        self.walks, self.sums = cuda.to_device(np.zeros((*shape, run.width))), cuda.to_device(run.sums[a:b])
        self.filters = cuda.device_array((*shape, FILTER_ROWS, run.width))
        _clear[grid](self.filters)
        self.fixed = [cuda.to_device(rows) for rows in (run.taps, run.own_taps[a:b])]
        self.keys = cuda.to_device(run.keys[a:b])
        self.wavelet = (run.low, run.high, cuda.to_device(run.segments))
        self.sensors: Any = None

    def read(self, pressures: Any, start: int, until: int) -> None:
        """Read the samples before `until`, with outputs from `start` on behind those that were kept."""
        run, first = self.run, self.sampled
        if until <= first:
            return
        if self.sensors is None or run.drifting:
            self.sensors = cuda.to_device(run.sensors(self.groups, first, until))
        begin = first * run.factor - run.before - (start - run._kept)
        _sense[self.grid](
            pressures, begin, run.factor, *self.fixed, first, until, self.sensors, self.keys, self.walks, self.filters,
            *self.wavelet, self.sums,
        )  # fmt: skip
        self.sampled = until
