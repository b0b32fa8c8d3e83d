"""Many experiments at once: eight to a vector register, over all cores, reduced to statistics while they run.

Pressures, readings and wavelet details are kept for a few seconds of each run only, which bounds the memory.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES
from sealscope.simulation.batch.run import ExperimentSet, SetRun, group_experiments, with_leak_coefficient
from sealscope.simulation.experiment import LONGEST_STEP, PRESSURE_TOLERANCE, Experiment
from sealscope.simulation.integrate import FIRST_WINDOW, MAX_STEP_REFINEMENT, integrate_run
from sealscope.simulation.sizing import size_leaks
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

if TYPE_CHECKING:
    import pandas as pd

#: Called with the completed fraction of the batch.
Progress = Callable[[float], None]
#: Runs of a set that are simulated to choose its step, and their duration [s].
_N_SAMPLE_RUNS, _SAMPLE_DURATION = 4, 2.0 * FIRST_WINDOW


@dataclass(frozen=True, repr=False)
class Batch:
    """Result of `simulate_batch`: the RMS of wavelet details by run and segment, and the leaks of the runs.

    `rms` (runs, 2, segments, 5): RMS by run, chamber pressure (`CHAMBERS`: p_A, p_B), segment and wavelet detail
    (`QUANTITIES`: d1, d2, d3, d4 [Pa], d3d4 [Pa^2]); `bounds` (segments + 1,): limits of the segments [s];
    `mean_leak_lpm` (runs,): mean leakage flow abs(Q) while the leak is open [L/min]; `coefficients` (runs,): G [m^3/(s
    Pa)] or C [m^3/(s Pa^0.5)] of the leaks; `steps` (runs,): solver's step [s].
    """

    rms: Array
    bounds: Array
    mean_leak_lpm: Array
    coefficients: Array
    steps: Array

    def __len__(self) -> int:
        return len(self.rms)

    def __repr__(self) -> str:
        bounds = ", ".join(f"{bound:g}" for bound in self.bounds)
        return f"<Batch: {len(self)} runs, segments between {bounds} s>"

    @checked_call
    def rms_of(self, channel: str, detail: str) -> Array:
        """Return the RMS (runs, segments) of a wavelet detail of a chamber pressure.

        `channel`: p_A or p_B; `detail`: d1, d2, d3 or d4 [Pa], or the product d3d4 of two [Pa^2].
        """
        for what, name, names in (("channel", channel, CHAMBERS), ("detail", detail, QUANTITIES)):
            if name not in names:
                raise InputError(f"{what} must be one of {', '.join(names)}, got {name!r}")
        return np.asarray(self.rms[:, CHAMBERS.index(channel), :, QUANTITIES.index(detail)])

    @checked_call
    def changes(self, channel: str, detail: str, *, before: int = 0, after: int = -1) -> Array:
        """Compute the relative change of a wavelet detail's RMS from one segment to another, (runs,) [%].

        The thesis detects leaks by this change. `channel`: p_A or p_B; `detail`: d1, d2, d3, d4 or d3d4; `before`,
        `after`: indices of the segments of the run to compare, by default the first and the last.

        Examples
        --------
        >>> import sealscope as ss
        >>> runs = [ss.Experiment.of(leak="0.3 L/min from 2 s", duration=4.0, seed=seed) for seed in range(3)]
        >>> ss.simulate_batch(runs).changes("p_A", "d1").shape
        (3,)
        """
        rms = self.rms_of(channel, detail)
        return np.asarray(100.0 * (rms[:, after] / rms[:, before] - 1.0))

    def to_pandas(self) -> pd.DataFrame:
        """Convert the batch to a pandas table with one row for each run and segment.

        Raises MissingExtra if pandas is not installed.
        """
        pandas = import_library("pandas", "a table", "pandas")
        runs, _, segments, _ = self.rms.shape
        run, segment = (index.ravel() for index in np.indices((runs, segments)))
        columns: dict[str, Any] = {"run": run, "segment": segment}
        columns |= {"start [s]": self.bounds[segment], "stop [s]": self.bounds[segment + 1]}
        for channel in CHAMBERS:
            for detail in QUANTITIES:
                unit = "Pa^2" if detail == "d3d4" else "Pa"
                columns[f"{detail} of {channel} [{unit}]"] = self.rms_of(channel, detail).ravel()
        columns["mean_leak [L/min]"] = self.mean_leak_lpm[run]
        columns["coefficient"] = self.coefficients[run]
        columns["step [s]"] = self.steps[run]
        return pandas.DataFrame(columns)  # type: ignore[no-any-return]


@checked_call
def simulate_batch(
    experiments: Iterable[Experiment],
    *,
    bounds: Sequence[float] | Array | None = None,
    error: float | str = PRESSURE_TOLERANCE,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Simulate many experiments at once, and compute the RMS of the db8 wavelet details of the recorded p_A and p_B.

    All runs must have the same duration and sampling rate. Rigs, drifts, faults of the machine and loads may differ. A
    run may have one leak, which opens abruptly or linearly.

    Runs with the same choices of the rig (such as the friction law), command waveform, load, method, step and error are
    a set, which is integrated together. If its runs state no step, one is chosen for the set, by the error that they
    state or else by `error`. The results of a run do not depend on `threads`. They depend on the other runs of its set
    only through a step that is chosen, and through the search for leakage coefficients where it converges for some runs
    only to a per cent: it then ends with the coefficients that suit the set best. The noise of a run differs from its
    noise in `simulate`.

    Parameters
    ----------
    experiments : iterable of Experiment
        The runs.
    bounds : sequence of float, optional
        Limits of the segments [s], by default both halves of the record; samples near the record's ends, where the
        wavelet's filters reach beyond it, are left out.
    error : float or str, optional
        Largest rms error of a pressure [Pa] in the runs that state neither a step nor an error.
    threads : int, optional
        Number of threads, by default one a core.
    progress : callable, optional
        Called with the completed fraction of the batch (0 to 1).

    Returns
    -------
    Batch
        RMS by run, channel, segment and detail, and the leaks' mean flows and coefficients.

    Raises
    ------
    InputError
        The runs cannot be in one batch.
    SimulationFailed
        A run diverged or fell below vacuum, which the message names; the step is too long for a run; or the search for
        leakage coefficients fails.

    Examples
    --------
    >>> import sealscope as ss
    >>> runs = [ss.Experiment.of(duration="4 s", seed=seed) for seed in range(3)]
    >>> ss.simulate_batch(runs, bounds=[0, 2, 4])
    <Batch: 3 runs, segments between 0, 2, 4 s>
    """
    error = parse_quantity(error, "Pa", name="error", finite=False)
    experiments = list(experiments)
    for experiment in experiments:
        if not isinstance(experiment, Experiment):
            raise InputError(f"a batch must have experiments (Experiment.of(...) makes one), got {experiment!r}")
    sets = group_experiments(experiments)
    first = experiments[0]
    edges = np.array([0.0, 0.5, 1.0]) * first.duration if bounds is None else np.asarray(bounds, dtype=np.float64)
    is_rising = edges.ndim == 1 and edges.size >= 2 and np.all(np.isfinite(edges)) and np.all(np.diff(edges) > 0)
    if not (is_rising and edges[0] >= 0 and edges[-1] <= first.duration):
        raise InputError(f"bounds must rise within 0 .. {first.duration:g} s, got {edges.tolist()}")
    n = len(experiments)
    rms = np.empty((n, len(CHAMBERS), edges.size - 1, len(QUANTITIES)))
    # the sets of runs fill the arrays one by one
    batch = Batch(rms, edges, mean_leak_lpm=np.empty(n), coefficients=np.empty(n), steps=np.empty(n))
    completed_runs = 0

    def report(fraction: float) -> None:
        """Report the batch's progress, given the completed `fraction` of the current set."""
        if progress is not None:
            progress(min(1.0, (completed_runs + fraction * len(experiment_set.members)) / n))

    for experiment_set in sets:
        set_error = error if experiment_set.experiment.error is None else experiment_set.experiment.error
        _run_set(experiment_set, batch, set_error, threads or os.cpu_count() or 1, report)
        completed_runs += len(experiment_set.members)
    return batch


def _run_set(
    experiment_set: ExperimentSet, batch: Batch, error: float, threads: int, progress: Callable[[float], None]
) -> None:
    """Simulate a set of experiments, and write the results into `batch`.

    `error` [Pa rms]: largest error of the pressures, for the choice of the step; not used if the experiments state one.
    """
    members, stated_step = experiment_set.members, experiment_set.experiment.step
    rows = [member.row for member in members]
    coefficients = np.array([member.leak.coefficient or 0.0 for member in members])
    step = stated_step or choose_step(experiment_set, coefficients, error)
    if any(member.leak.mean for member in members):
        coefficients = _size_leaks(experiment_set, step, coefficients, threads)
        # choose again with the coefficients found, because large leaks need short steps
        step = stated_step or min(step, choose_step(experiment_set, coefficients, error))
    run = SetRun(experiment_set, step, coefficients, flow_coefficients=coefficients, bounds=batch.bounds)
    run.run_all(threads, progress)
    batch.rms[rows] = run.rms()
    batch.mean_leak_lpm[rows] = run.mean_flow() / LITRE_PER_MINUTE
    batch.coefficients[rows] = coefficients
    batch.steps[rows] = run.step


def choose_step(experiment_set: ExperimentSet, coefficients: Array, error: float) -> float:
    """Choose the solver's step [s] for a set of experiments with leakage `coefficients` (runs,).

    It is the shortest of `longest_allowed_step` and of the steps that `integrate_run` finds for a pressure error of
    `error` [Pa rms] in the first 4 s of up to four runs, evenly spread over the set.
    """
    members, steps = experiment_set.members, [longest_allowed_step(experiment_set, coefficients)]
    for k in np.unique(np.linspace(0, len(members) - 1, _N_SAMPLE_RUNS).round().astype(int)):
        experiment = with_leak_coefficient(members[k].experiment, float(coefficients[k]))
        duration = min(experiment.duration, _SAMPLE_DURATION)
        steps.append(integrate_run(experiment, experiment.leaks, error=error, duration=duration).step)
    return float(min(steps))


def longest_allowed_step(experiment_set: ExperimentSet, coefficients: Array) -> float:
    """Compute the longest step [s] that resolves the rig and the leak (`coefficients`, (runs,)) of every run of a set.

    It is at least LONGEST_STEP / MAX_STEP_REFINEMENT, the shortest step of the search in `integrate`.
    """
    from sealscope.physics.solvers.limits import longest_step

    limits = []
    for member, coefficient in zip(experiment_set.members, coefficients, strict=True):
        G, C = (coefficient, 0.0) if member.leak.law == "laminar" else (0.0, coefficient)
        limits += [longest_step(numbers, G, C) for numbers in member.step_limiting_parameters]
    return max(min(limits), LONGEST_STEP / MAX_STEP_REFINEMENT)


def _size_leaks(experiment_set: ExperimentSet, step: float, coefficients: Array, threads: int) -> Array:
    """Find the leakage coefficients (runs,) for which the leaks of a set have their stated mean flows.

    `coefficients`: start values of the search (`size_leaks`); `step` [s]: longest step of the solver if the set does
    not state one.
    """
    members, stated_step = experiment_set.members, experiment_set.experiment.step
    mean_flows = np.array([member.leak.mean or 0.0 for member in members])

    def measure_unit_flows(trial_coefficients: Array) -> tuple[Array, None]:
        """Simulate the set; return the flows per unit of coefficient (runs,) that `size_leaks` needs, and no run."""
        # the first trial may be 0: then the flow of a leak of coefficient 1 is computed (`build_leak_rows`)
        flow_coefficients = np.where(trial_coefficients > 0, trial_coefficients, 1.0)
        run_step = stated_step or min(step, longest_allowed_step(experiment_set, trial_coefficients))
        run = SetRun(experiment_set, run_step, trial_coefficients, flow_coefficients=flow_coefficients, bounds=None)
        run.run_all(threads, None)
        unit_flows = run.mean_flow() / flow_coefficients
        never_open = np.flatnonzero((mean_flows > 0) & (unit_flows <= 0))
        if never_open.size:
            raise InputError(f"a leak with a mean flow must be open within the run (run {members[never_open[0]].row})")
        return unit_flows, None

    leaks = [member.leak for member in members]
    sized_coefficients, _ = size_leaks(leaks, coefficients, measure_unit_flows, independent=True)
    return sized_coefficients
