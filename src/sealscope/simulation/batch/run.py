"""Sets of experiments that can be integrated together, each in a lane of a vector register, and their simulation."""

from __future__ import annotations

import itertools
import math
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
from sealscope.simulation.changes import (
    Effect,
    add_needed_laws,
    apply_effects,
    build_blocks,
    step_limiting_parameters,
)
from sealscope.simulation.commands import Command, Sine
from sealscope.simulation.experiment import FILTER_REACH, Experiment, choose_method, identity_values
from sealscope.simulation.instruments import anti_alias_taps, volts_per_pascal
from sealscope.simulation.integrate import VACUUM, oversampling_of, refuse_long, refuse_unresolved, steps_per_output
from sealscope.simulation.leaks import Leak
from sealscope.simulation.targets_and_loads import loaded_rig_numbers, loaded_standstill_state

if TYPE_CHECKING:
    from sealscope.physics.rig import RigNumbers

#: Slope [1/s] of the opening (0 to 1) of a leak that opens abruptly.
ABRUPT = 1e15


@dataclass(frozen=True)
class Member:
    """One experiment of a set of experiments that are integrated together.

    `row`: index in the batch; `numbers`: parameters of the model; `effects`: their changes within the run. The command
    is `gain` times the waveform that the set shares (`ExperimentSet.shape`), plus `offset` [V].
    """

    row: int
    experiment: Experiment
    numbers: RigNumbers
    effects: tuple[Effect, ...]
    gain: float
    offset: float

    @property
    def leak(self) -> Leak:
        """The leak of the experiment, with the coefficient 0 if there is none."""
        leaks = self.experiment.leaks
        return leaks[0] if leaks else Leak("laminar", coefficient=0.0)

    @cached_property
    def step_limiting_parameters(self) -> tuple[RigNumbers, ...]:
        """The model's parameters without changes and beside each breakpoint of a change, for the check of the step."""
        return step_limiting_parameters(self.effects, self.numbers, self.experiment.duration)


@dataclass(frozen=True)
class ExperimentSet:
    """Experiments integrated together: waveform (`shape`), load, solver and choices of the rig are equal."""

    members: tuple[Member, ...]
    shape: Command

    @property
    def experiment(self) -> Experiment:
        """The first experiment, which has the settings that all members share."""
        return self.members[0].experiment


def refuse_unbatchable(experiment: Experiment, row: int) -> None:
    """Raise InputError, which names the first broken rule, if experiment number `row` cannot be in a batch."""
    rig, leaks = experiment.rig, experiment.leaks
    violated_rules = []
    if experiment.active_controller is not None:
        violated_rules.append(f"a command, got a target for a controller ({experiment.command})")
    if len(leaks) > 1:
        violated_rules.append(f"at most one leak, got {len(leaks)}")
    if leaks and leaks[0].opening.rise is None:
        violated_rules.append(f"a leak that opens abruptly or linearly, got {leaks[0].opening}")
    if rig.motor.integrator == "euler":
        violated_rules.append("motor.integrator = state, got euler")
    if any(fault.row.is_sensor_fault for fault in experiment.faults):
        violated_rules.append(f"no fault of a sensor, got {', '.join(map(str, experiment.faults))}")
    # with the oil's viscosity a leak's flow changes, and not by a single linear rise (`leaks.Thinned`)
    if leaks and any(fault.viscosity_ratio(rig) is not None for fault in experiment.faults):
        violated_rules.append("no leak while the oil's temperature changes")
    not_modelled = ["daq.jitter"]  # parameters that the instruments of a batch do not model (`batch.signals`)
    not_modelled += [
        f"sensors.{name}.{symbol}"
        for name in CHAMBERS
        for symbol in ("stuck_rate", "drop_rate", "lag", "hum_harmonics")
    ]
    violated_rules += [f"{name} = 0, got {rig[name]}" for name in not_modelled if rig[name] != 0]
    if violated_rules:
        raise InputError(f"a run of a batch must have {violated_rules[0]} (run {row}); simulate it by itself")


def group_experiments(experiments: Sequence[Experiment]) -> list[ExperimentSet]:
    """Group experiments into sets for joint integration; raise InputError for any that cannot be in the batch."""
    from sealscope.physics.rig import CHOICES

    if not experiments:
        raise InputError("a batch must have experiments, got none")
    first = experiments[0]
    members_by_kind: dict[Any, list[Member]] = {}
    shapes: dict[Any, Command] = {}
    numbers_by_rig: dict[Any, RigNumbers] = {}  # by rig and load; most batches have few different rigs
    for row, experiment in enumerate(experiments):
        for name in ("duration", "rate"):
            value, common = getattr(experiment, name), getattr(first, name)
            if value != common:
                raise InputError(f"runs of a batch must have one {name}, got {common:g} and {value:g} (run {row})")
        refuse_unbatchable(experiment, row)
        load = None if experiment.load is None else str(identity_values(experiment.load))
        if (id(experiment.rig), load) not in numbers_by_rig:
            numbers_by_rig[id(experiment.rig), load] = loaded_rig_numbers(experiment.rig, experiment.load)
        effects = experiment.effects()
        numbers = add_needed_laws(numbers_by_rig[id(experiment.rig), load], effects)
        shape, gain, offset = experiment.voltage_command, 1.0, 0.0
        if isinstance(shape, Sine):  # sines of one frequency and phase share a waveform
            gain, offset, shape = shape.amplitude, shape.offset, replace(shape, amplitude=1.0, offset=0.0)
        # "pushed" is left out: it has the tables of the load, which `load` identifies
        choices = tuple(getattr(numbers, name) for name in CHOICES if name != "pushed")
        method = choose_method(experiment.rig, experiment.method)
        # what the experiments of a set have in common
        kind = (str(identity_values(shape)), load, choices, method, experiment.step, experiment.error)
        shapes[kind] = shape
        members_by_kind.setdefault(kind, []).append(Member(row, experiment, numbers, effects, gain, offset))
    return [ExperimentSet(tuple(members), shapes[kind]) for kind, members in members_by_kind.items()]


def pack_lanes(values: Array, width: int) -> Array:
    """Rearrange `values` (runs, ...) as vectors (groups, ..., width); copies of the last run fill the last vectors."""
    groups = math.ceil(len(values) / width)
    padded = np.concatenate([values, np.repeat(values[-1:], groups * width - len(values), axis=0)])
    return np.ascontiguousarray(np.moveaxis(padded.reshape(groups, width, *values.shape[1:]), 1, -1))


def unpack_lanes(lanes: Array, runs: int) -> Array:
    """Rearrange an array (groups, ..., width) as (runs, ...), the inverse of `pack_lanes`."""
    lanes_second = np.moveaxis(lanes, -1, 1)
    return lanes_second.reshape(-1, *lanes_second.shape[2:])[:runs]


def build_leak_rows(members: Sequence[Member], coefficients: Array, flow_coefficients: Array) -> Array:
    """Build the table (runs, LEAK_ROWS) of the leaks' parameters that the compiled model takes.

    `coefficients` (runs,): those of the leaks that act in the runs; `flow_coefficients` (runs,): those of the leaks
    whose mean flow is computed. They differ for leaks of coefficient 0 while coefficients are searched for: the flow is
    then that of a coefficient of 1.
    """
    rows = []
    for member, coefficient, flow_coefficient in zip(members, coefficients, flow_coefficients, strict=True):
        leak = member.leak
        start, stop = leak.opening.rise or (0.0, 0.0)  # a batch has no leak without a rise (`refuse_unbatchable`)
        slope = 1.0 / (stop - start) if stop > start else ABRUPT
        if leak.law == "laminar":
            rows.append([coefficient, 0.0, start, slope, flow_coefficient, 0.0])
        else:
            rows.append([0.0, coefficient, start, slope, 0.0, flow_coefficient])
    return np.array(rows)


@dataclass(frozen=True)
class Cells:
    """Model parameters of the runs of a set over time, constant within cells, which are spans of the solver's outputs.

    `bounds` (cells + 1,): outputs at which the cells begin, and the end of the last; `base` (runs, parameters): values
    without changes; `blocks`: for each run the bounds (blocks + 1,) of its own blocks (`build_blocks`), and the values
    (blocks,) of its changing parameters, by index. A cell begins where a block of any run does.
    """

    bounds: np.ndarray
    base: Array
    blocks: tuple[tuple[np.ndarray, dict[int, Array]], ...]

    def table(self, first: int, last: int, groups: tuple[int, int], width: int) -> Array:
        """Build the table (groups, cells, parameters, width) of the parameters in the cells first <= cell < last.

        The groups of `width` runs are groups[0] <= g < groups[1].
        """
        runs = slice(groups[0] * width, groups[1] * width)
        table = np.repeat(self.base[runs, None, :], last - first, axis=1)
        for rows, (bounds, values) in zip(table, self.blocks[runs], strict=True):
            block = np.searchsorted(bounds, self.bounds[first:last], side="right") - 1  # in which each cell begins
            for parameter, series in values.items():
                rows[:, parameter] = series[block]
        return pack_lanes(table, width)


def build_cells(members: Sequence[Member], n_out: int, rate: float) -> Cells:
    """Compute the model's parameters for `n_out` outputs at `rate` [Hz], in time spans (cells) of constant values."""
    from sealscope.physics.rig import NUMBERS

    # most members share their parameters: convert each distinct object once
    distinct_numbers = {id(member.numbers): member.numbers for member in members}
    rows = {key: [float(getattr(numbers, name)) for name in NUMBERS] for key, numbers in distinct_numbers.items()}
    base = np.array([rows[id(member.numbers)] for member in members])
    blocks = []
    for member in members:
        bounds, values = build_blocks(member.effects, member.numbers, n_out, rate)
        blocks.append((bounds, {NUMBERS.index(name): series for name, series in values.items()}))
    return Cells(np.unique(np.concatenate([bounds for bounds, _ in blocks])), base, tuple(blocks))


def with_leak_coefficient(experiment: Experiment, coefficient: float) -> Experiment:
    """Return an experiment with its first leak only, of the given leakage coefficient; unchanged without a leak."""
    if not experiment.leaks:
        return experiment
    return replace(experiment, leaks=(replace(experiment.leaks[0], mean=None, coefficient=coefficient),))


def build_instrument_rows(experiment: Experiment, first: int, last: int) -> Array:
    """Build the parameters (2, INSTRUMENT_ROWS) of a run's instruments of p_A and p_B for first <= sample < last.

    Constants of `batch.signals` index the last axis. Gain, offset, hum and noises may change within a run; they are
    stored as the value at sample `first` (such as `GAIN`) and the mean change per sample (such as `GAIN_RISE`).
    """
    from sealscope.simulation.batch import signals

    rig, effects = experiment.rig, experiment.instrument_effects()
    ends = np.array([first, last]) / experiment.rate
    rows, daq = np.zeros((len(CHAMBERS), signals.INSTRUMENT_ROWS)), rig.daq
    for row, name in zip(rows, CHAMBERS, strict=True):
        sensor = getattr(rig.sensors, name)
        for start_row, rise_row, parameter, value, addend in (
            (signals.GAIN, signals.GAIN_RISE, f"sensors.{name}.gain_error", sensor.gain_error, 1.0),
            (signals.OFFSET, signals.OFFSET_RISE, f"sensors.{name}.offset", sensor.offset, 0.0),
            (signals.NOISE, signals.NOISE_RISE, f"sensors.{name}.noise", sensor.noise, 0.0),
            (signals.HUM, signals.HUM_RISE, f"sensors.{name}.hum", sensor.hum, 0.0),
            (signals.COMMON, signals.COMMON_RISE, "sensors.common_noise", rig.sensors.common_noise, 0.0),
        ):
            start_value, end_value = np.broadcast_to(apply_effects(value, effects, parameter, ends), (2,))
            # `addend`: the gain is 1 plus the gain error
            row[start_row], row[rise_row] = start_value + addend, (end_value - start_value) / (last - first)
        row[signals.DRIFT_STEP] = sensor.drift / np.sqrt(daq.sample_rate)
        row[signals.HUM_CYCLES] = sensor.hum_frequency / daq.sample_rate
        row[signals.RANGE_MIN], row[signals.RANGE_MAX] = sensor.range_lo, sensor.range_hi
        row[signals.VOLTS_AT_MIN] = daq.sensor_volts_lo
        row[signals.VOLTS_PER_PASCAL] = volts_per_pascal(sensor, daq)
        row[signals.VOLTS_PER_CODE], row[signals.MAX_CODE] = daq.step, 2.0 ** (daq.bits - 1)
    if rows[:, signals.HUM].any():
        random = np.random.default_rng([experiment.seed, 1])  # 1: a stream independent of the noise
        rows[:, signals.HUM_PHASE] = random.random(len(CHAMBERS))
    return rows


#: Most steps of a chunk, which bounds the memory of its arrays.
MAX_CHUNK_STEPS = 4096


class SetRun:
    """The simulation of all runs of an `ExperimentSet` on several threads: call `run_all`, then `rms`, `mean_flow`."""

    #: Runs of a group.
    width: ClassVar[int] = 8

    def __init__(
        self,
        experiment_set: ExperimentSet,
        step: float,
        coefficients: Array,
        *,
        flow_coefficients: Array,
        bounds: Array | None,
    ) -> None:
        """Prepare the runs of a set at standstill, to be integrated with a step of at most `step` [s].

        `coefficients`, `flow_coefficients`: as in `build_leak_rows`; `bounds` [s]: limits of the segments for the RMS
        of the wavelet details, None for mean flows only. Raises SimulationFailed if the step is too long for a run.
        """
        from sealscope.physics.solvers.advance import EXPLICIT, IMPLICIT, step_nodes
        from sealscope.physics.solvers.limits import longest_step
        from sealscope.physics.vector.runs import CHANNELS, MIN_PRESSURE, N_TOTALS

        members = experiment_set.members
        common = experiment_set.experiment  # has the settings that all members share
        self.experiment_set, self.n_runs, self.channels = experiment_set, len(members), CHANNELS
        self.method = choose_method(common.rig, common.method)
        self.oversampling = oversampling_of(common.rate, step)
        rate = common.rate * self.oversampling
        self.steps_per_output = steps_per_output(rate, step)
        self.step = 1.0 / (rate * self.steps_per_output)
        self.n_samples = round(common.duration * common.rate)
        self.n_outputs = (self.n_samples + FILTER_REACH) * self.oversampling
        self.nodes = step_nodes(IMPLICIT if self.method == "imex" else EXPLICIT, self.step)
        self.cells = build_cells(members, self.n_outputs, rate)
        self.numbers = members[0].numbers  # for the model's optional parts only: `cells` has the numbers
        leaks = build_leak_rows(members, coefficients, flow_coefficients)
        checked_cases = set()  # members that share parameters and leak are checked once
        for member, (G, C) in zip(members, leaks[:, :2].tolist(), strict=True):
            for numbers in member.step_limiting_parameters:
                case = id(numbers), G, C
                if not (member.experiment.allow_unresolved or case in checked_cases):
                    checked_cases.add(case)
                    refuse_unresolved(numbers, self.step, self.method)
                    refuse_long(self.step, longest_step(numbers, G, C), f"the leak of run {member.row}")
        experiments = [member.experiment for member in members]
        states = [loaded_standstill_state(run.rig, run.load, run.x_0) for run in experiments]
        self.state = pack_lanes(np.array(states), self.width)
        self.n_groups = len(self.state)
        self.gains_and_offsets = pack_lanes(np.array([[member.gain, member.offset] for member in members]), self.width)
        self.leaks = pack_lanes(leaks, self.width)
        self.totals = np.zeros((self.n_groups, N_TOTALS, self.width))
        self.totals[:, MIN_PRESSURE] = np.inf
        self._prepare_filters(rate)
        self.bounds = bounds
        if bounds is not None:
            self._prepare_statistics(bounds)

    def _prepare_filters(self, rate: float) -> None:
        """Set `taps` to the coefficients of each run's anti-alias filter, which includes the transducers' delays.

        `rate` [Hz]: that of the solver's outputs. A sample at output n is computed from the outputs n - `taps_before`
        to n + `taps_after`; both numbers are set, too.
        """
        sensors = [member.experiment.rig.sensors for member in self.experiment_set.members]
        delays = np.array([[getattr(group, name).delay * rate for name in CHAMBERS] for group in sensors])
        taps_by_delay = {delay: anti_alias_taps(self.oversampling, delay % 1.0) for delay in np.unique(delays).tolist()}
        self.taps_after = FILTER_REACH * self.oversampling
        self.taps_before = self.taps_after + int(delays.max())
        filters = np.zeros((self.n_runs, self.channels, self.taps_before + self.taps_after + 1))
        for run_and_channel, delay in np.ndenumerate(delays):
            taps = taps_by_delay[float(delay)]
            # the middle of the taps is `int(delay)` outputs before output n; the taps contain the rest of the delay
            start = self.taps_before - int(delay) - taps.size // 2
            filters[run_and_channel][start : start + taps.size] = taps
        self.taps = pack_lanes(filters, self.width)

    def _prepare_statistics(self, bounds: Array) -> None:
        """Set the sums of squared wavelet details between `bounds` [s] to zero, and make the keys of the noise.

        Samples at the ends of the record for which the wavelet's filters would need samples beyond it are left out.
        """
        from sealscope.signals.filters import reach
        from sealscope.simulation.batch.noise import noise_keys
        from sealscope.simulation.batch.signals import QUANTITIES

        before, after = reach()[-1]  # [-1]: the highest level reaches furthest
        samples = np.round(bounds * self.experiment_set.experiment.rate).astype(np.int64)
        self.segments = np.clip(samples, before, self.n_samples - after)
        self.sums = np.zeros((self.n_groups, self.channels, self.segments.size - 1, QUANTITIES, self.width))
        seeds = [member.experiment.seed for member in self.experiment_set.members]
        self.noise_keys = pack_lanes(noise_keys(seeds), self.width)

    def run_all(self, threads: int, progress: Callable[[float], None] | None) -> None:
        """Simulate all runs on `threads` threads; `progress` is called with the completed fraction of the set."""
        # a thread simulates the groups between two successive bounds
        n_threads = min(threads, self.n_groups)
        group_bounds = np.unique(np.linspace(0, self.n_groups, n_threads + 1).round().astype(int)).tolist()
        lock, completed = threading.Lock(), 0.0

        def add_progress(fraction: float) -> None:
            """Add `fraction` to the completed fraction of the set, and report the sum; called by all threads."""
            nonlocal completed
            with lock:
                completed += fraction
                if progress is not None:
                    progress(completed)

        with ThreadPoolExecutor(threads) as pool:
            # `list` waits for all threads, and raises an exception of any of them
            list(pool.map(lambda groups: self._run_groups(groups, add_progress), itertools.pairwise(group_bounds)))

    def _chunks(self) -> list[tuple[int, int, int, int]]:
        """Divide the solver's outputs into chunks of at most `MAX_CHUNK_STEPS` steps, or of a single output.

        Returns for each chunk the first cell that it has a part of, the cell after the last, the first output and the
        output after the last.
        """
        max_outputs = max(1, MAX_CHUNK_STEPS // self.steps_per_output)
        edges, chunks = self.cells.bounds, []
        for start in range(0, self.n_outputs, max_outputs):
            stop = min(start + max_outputs, self.n_outputs)
            first, last = np.searchsorted(edges, start, side="right") - 1, np.searchsorted(edges, stop, side="left")
            chunks.append((int(first), int(last), start, stop))
        return chunks

    def _run_groups(self, groups: tuple[int, int], add_progress: Callable[[float], None]) -> None:
        """Simulate the groups of runs groups[0] <= g < groups[1], chunk by chunk from standstill to the end.

        If segments of time are defined (`bounds`), the pressures are sampled after each chunk as the sensors read them,
        and the squares of their wavelet details are added to the sums of the segments. `add_progress` is called after
        each chunk with its share of the whole set's work. `table` has the parameters of the chunk's cells (`Cells`).
        """
        from sealscope.physics.vector.runs import advance_lanes_imex, advance_lanes_rk4
        from sealscope.signals.streams import DetailStream
        from sealscope.simulation.batch.signals import sense_lanes

        advance = advance_lanes_imex if self.method == "imex" else advance_lanes_rk4
        a, b = groups
        state, leaks, totals = self.state[a:b], self.leaks[a:b], self.totals[a:b]
        table, cells = np.empty((0, 0, 0, 0)), (-1, -1)  # no table yet
        chunks = self._chunks()
        # outputs that later samples need, with a margin: a sample is read once its last tap is known, so that the next
        # one begins fewer outputs back than the filter is long
        history = self.taps_before + self.taps_after + self.oversampling
        longest = max(stop - start for _, _, start, stop in chunks)
        # (groups, outputs of history and chunk, channels, width)
        pressures = np.zeros((b - a, history + longest, self.channels, self.width))
        offset_drifts = np.zeros((b - a, self.channels, self.width))
        # used for its taps, and its buffers (groups, channels, levels, samples, width), which `sense_lanes` updates
        wavelet = DetailStream((self.channels, (b - a) * self.width))
        n_read = 0  # samples read so far
        output_steps = self.steps_per_output
        for first, last, start, stop in chunks:  # cells first <= cell < last, outputs start <= output < stop
            if cells != (first, last):
                table, cells = self.cells.table(first, last, groups, self.width), (first, last)
            cell_bounds = (np.clip(self.cells.bounds[first : last + 1], start, stop) - start) * output_steps  # in steps
            advance(
                state, self.step, start * output_steps, self.nodes, self._inputs_at_nodes(start, stop),
                self.gains_and_offsets[a:b], leaks, table, cell_bounds, self.numbers, output_steps, pressures, history,
                totals,
            )  # fmt: skip
            self._check_groups(groups, stop)
            if self.bounds is not None:
                if start == 0:
                    pressures[:, :history] = pressures[:, history : history + 1]  # constant before the beginning
                end_sample = self.n_samples
                if stop < self.n_outputs:  # else the samples that the anti-alias filter can compute so far
                    end_sample = min(max(0, (stop - self.taps_after - 1) // self.oversampling + 1), end_sample)
                if end_sample > n_read:
                    # index in `pressures` of the first output that sample `n_read` needs; index 0 is start - history
                    first_tap = n_read * self.oversampling - self.taps_before - (start - history)
                    sense_lanes(
                        pressures, first_tap, self.oversampling, self.taps[a:b], n_read, end_sample,
                        self._sensors(groups, n_read, end_sample), self.noise_keys[a:b], offset_drifts,
                        wavelet.taps, wavelet.buffers, self.segments, self.sums[a:b],
                    )  # fmt: skip
                    n_read = end_sample
                # the last outputs become the history of the next chunk
                pressures[:, :history] = pressures[:, stop - start : stop - start + history].copy()
            add_progress((stop - start) / self.n_outputs * (b - a) / self.n_groups)

    def _inputs_at_nodes(self, start: int, stop: int) -> Array:
        """Compute the command's waveform [V] at the solver's nodes in the steps of the outputs start <= output < stop.

        It is an array (steps, nodes) or, followed by the load [N] at the nodes if there is one, (steps, 2 nodes).
        """
        t = np.arange(start * self.steps_per_output, stop * self.steps_per_output, dtype=np.float64) * self.step
        times = t[:, None] + self.nodes
        waveform, load = self.experiment_set.shape.volts(times), self.experiment_set.experiment.load
        if load is None:
            return np.ascontiguousarray(waveform)
        return np.ascontiguousarray(np.hstack([waveform, np.broadcast_to(load.value_at(times), times.shape)]))

    def _sensors(self, groups: tuple[int, int], first: int, last: int) -> Array:
        """Build the instruments' parameters (groups, 2, INSTRUMENT_ROWS, width) for some groups of runs.

        The groups are groups[0] <= g < groups[1], the samples first <= sample < last (`build_instrument_rows`).
        """
        if self._constant_sensors is not None:
            return self._constant_sensors[groups[0] : groups[1]]
        members = self.experiment_set.members[groups[0] * self.width : groups[1] * self.width]
        rows = [build_instrument_rows(member.experiment, first, last) for member in members]
        return pack_lanes(np.array(rows), self.width)

    @cached_property
    def _constant_sensors(self) -> Array | None:
        """The instruments' parameters of all groups, as in `_sensors`; None if any of them change within a run."""
        experiments = [member.experiment for member in self.experiment_set.members]
        if any(experiment.instrument_effects() for experiment in experiments):
            return None
        rows = [build_instrument_rows(experiment, 0, self.n_samples) for experiment in experiments]
        return pack_lanes(np.array(rows), self.width)

    def _check_groups(self, groups: tuple[int, int], stop: int) -> None:
        """Raise SimulationFailed if a run of the groups groups[0] <= g < groups[1] has diverged before output `stop`.

        Unless unresolved runs are allowed, a pressure below vacuum or a step too long for an end stop raises it, too.
        """
        from sealscope.physics.solvers.limits import longest_step_on_stop
        from sealscope.physics.vector.runs import DIVERGED, MAX_TRAVEL, MIN_PRESSURE

        totals = self.totals[groups[0] : groups[1]]
        time = stop / (self.experiment_set.experiment.rate * self.oversampling)
        # a quick test of all runs together; only if it fails, each run is tested
        min_half_stroke = 0.5 * float(min(member.numbers.L for member in self.experiment_set.members))
        is_valid = np.all(totals[:, DIVERGED] == 0.0) and totals[:, MIN_PRESSURE].min() >= VACUUM
        if is_valid and totals[:, MAX_TRAVEL].max() <= min_half_stroke:
            return
        totals_by_run = unpack_lanes(totals, totals.shape[0] * self.width)
        extremes = totals_by_run[:, [MAX_TRAVEL, MIN_PRESSURE, DIVERGED]]
        for k, (max_travel, min_pressure, diverged) in enumerate(extremes):
            index = groups[0] * self.width + k
            if index >= self.n_runs:  # the lanes from here on have copies of the last run
                break
            member = self.experiment_set.members[index]
            if not diverged == 0.0:  # NaN once a state was not finite
                raise SimulationFailed(
                    f"run {member.row} diverged before t = {time:.4g} s; take a smaller step or smaller gains"
                )
            if member.experiment.allow_unresolved:
                continue
            if max_travel > 0.5 * member.numbers.L:
                limit = longest_step_on_stop(member.numbers)
                refuse_long(self.step, limit, f"the hard stop (cylinder.k_stop, d_stop) of run {member.row}")
            if min_pressure < VACUUM:
                raise SimulationFailed(
                    f"pressures of run {member.row} must stay above vacuum ({VACUUM:g} Pa gauge: the rig's oil does "
                    f"not boil), got {min_pressure:.4g} Pa before t = {time:.4g} s; simulate it by itself to find where"
                )

    def rms(self) -> Array:
        """Compute the RMS (runs, 2, segments, 5) of the details d1 .. d4 [Pa] and d3 d4 [Pa^2]; NaN without samples."""
        n_samples = np.diff(self.segments)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(unpack_lanes(self.sums, self.n_runs) / n_samples)

    def mean_flow(self) -> Array:
        """Compute the mean flow |Q_L| (runs,) [m^3/s] of each run's leak, as `sizing.mean_while_open` does."""
        from sealscope.physics.vector.runs import FLOW, OPENING

        totals_by_run = unpack_lanes(self.totals, self.n_runs)
        opening = totals_by_run[:, OPENING]
        return np.where(opening > 0, totals_by_run[:, FLOW] / np.where(opening > 0, opening, 1.0), 0.0)
