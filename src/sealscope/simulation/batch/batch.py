"""Many experiments at once: eight to a vector register, over all cores, reduced to statistics as they run.

Memory does not grow with the number or the length of the runs but for what describes and what is reported of each:
pressures, readings and details exist for a few seconds of each run only.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.errors import InputError, MissingExtra
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES
from sealscope.simulation.batch.run import LaneSet, SetRun, sets_of, with_sizes
from sealscope.simulation.experiment import LONGEST_STEP, PRESSURE_TOLERANCE, Experiment
from sealscope.simulation.integrate import FINEST, FIRST_WINDOW, trajectory
from sealscope.simulation.sizing import size_leaks
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

if TYPE_CHECKING:
    import pandas as pd

#: Told how far the batch is, 0..1.
Progress = Callable[[float], None]
#: Members of a set on which its step is chosen, and for how long [s] each of them runs for that.
_SCOUTS, _SCOUTED = 4, 2.0 * FIRST_WINDOW


@dataclass(frozen=True, repr=False)
class Batch:
    """Result of `simulate_batch`: RMS of the details in segments, and the leaks of the runs.

    `rms`: (runs, 2, segments, 5), by chamber (`CHAMBERS`: p_A, p_B), segment and detail (`QUANTITIES`: d1, d2, d3, d4
    [Pa], d3d4 [Pa^2]); `bounds`: (segments + 1,) [s]; `mean_leak_lpm`: (runs,) mean abs(Q) while open [L/min];
    `coefficients`: (runs,) leaks' G [m^3/(s Pa)] or C [m^3/(s Pa^0.5)]; `steps`: (runs,) [s].
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
        """Return the RMS of one detail of one channel in each segment, (runs, segments)."""
        return np.asarray(self.rms[:, _place(channel, CHAMBERS, "channel"), :, _place(detail, QUANTITIES, "detail")])

    @checked_call
    def changes(self, channel: str, detail: str, *, before: int = 0, after: int = -1) -> Array:
        """Compute the change of an RMS from segment `before` to segment `after`, (runs,) [%]: the thesis's statistic.

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
        """Convert the batch to a table, one row for each run and segment.

        Raises MissingExtra where pandas is not installed.

        Columns: run, segment, start [s], stop [s], the RMS of each detail of each channel (`d3 of p_A [Pa]`), mean_leak
        [L/min], coefficient, step [s].
        """
        try:
            import pandas as pd
        except ImportError:
            raise MissingExtra("a table needs pandas: pip install 'sealscope[io]'") from None
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
        return pd.DataFrame(columns)


def _place(name: str, names: tuple[str, ...], what: str) -> int:
    if name not in names:
        raise InputError(f"{what} must be one of {', '.join(names)}, got {name!r}")
    return names.index(name)


@checked_call
def simulate_batch(
    experiments: Iterable[Experiment],
    *,
    bounds: Sequence[float] | Array | None = None,
    error: float | str = PRESSURE_TOLERANCE,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Simulate experiments side by side and keep the RMS of the db8 details of p_A and p_B as recorded.

    The runs have one duration and one sampling rate; rigs, leaks (one each, opening abruptly or evenly), drifts,
    faults of the machine and loads may all differ. A run's step is its own `step`, or one that is chosen by its own or
    this `error` for all runs of its kind, command and load. Results do not depend on the order of the runs, their
    number or `threads`. The noise is another stream than that of `simulate`.

    Parameters
    ----------
    experiments : iterable of Experiment
        What is simulated.
    bounds : sequence of float, optional
        Times [s] between which the segments lie, both halves by default; samples at the record's ends that the
        transform cannot see whole are left out.
    error : float or str, optional
        Error that a pressure may have [Pa rms] in the runs that state neither a step nor an error.
    threads : int, optional
        Threads of the processor, by default one a core.
    progress : callable, optional
        Called with how far the batch is (0 to 1).

    Returns
    -------
    Batch
        RMS by run, channel, segment and detail, and the leaks' mean flows and coefficients.

    Raises
    ------
    InputError
        The runs cannot be side by side.
    SimulationFailed
        A run, which the message names, diverged or fell below vacuum.

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
    sets = sets_of(experiments)
    first = experiments[0]
    edges = np.array([0.0, 0.5, 1.0]) * first.duration if bounds is None else np.asarray(bounds, dtype=np.float64)
    inside = edges.ndim == 1 and edges.size >= 2 and np.all(np.isfinite(edges)) and np.all(np.diff(edges) > 0)
    if not (inside and edges[0] >= 0 and edges[-1] <= first.duration):
        raise InputError(f"bounds must rise within 0 .. {first.duration:g} s, got {edges.tolist()}")
    n, segments = len(experiments), edges.size - 1
    batch = Batch(np.empty((n, 2, segments, 5)), edges, np.empty(n), np.empty(n), np.empty(n))
    done = 0.0
    for part in sets:

        def report(share: float, start_share: float = done, size: int = len(part.members)) -> None:
            if progress is not None:
                progress(min(1.0, start_share + share * size / n))

        stated_error = part.experiment.error
        _run(part, batch, error if stated_error is None else stated_error, threads or os.cpu_count() or 1, report)
        done += len(part.members) / n
    return batch


def _run(part: LaneSet, batch: Batch, error: float, threads: int, progress: Callable[[float], None]) -> None:
    places = [member.place for member in part.members]
    sizes = np.array([member.leak.coefficient or 0.0 for member in part.members])
    step = part.experiment.step or chosen_step(part, sizes, error)
    if any(member.leak.mean for member in part.members):
        sizes = _sized(part, step, sizes, threads)
        step = part.experiment.step or min(step, chosen_step(part, sizes, error))
    run = SetRun(part, step, sizes, sizes, batch.bounds)
    run.run_all(threads, progress)
    batch.rms[places] = run.rms()
    batch.mean_leak_lpm[places] = run.mean_flow() / LITRE_PER_MINUTE
    batch.coefficients[places] = sizes
    batch.steps[places] = run.h


def chosen_step(part: LaneSet, sizes: Array, error: float) -> float:
    """Choose the finest of the steps [s] that `trajectory` takes for some members over their first seconds.

    It is no longer than all members' numbers and leaks allow.
    """
    steps = [allowed_step(part, sizes)]
    picked = np.unique(np.linspace(0, len(part.members) - 1, _SCOUTS).round().astype(int))
    for k in picked:
        experiment = with_sizes(part.members[k].experiment, float(sizes[k]))
        scouted = min(experiment.duration, _SCOUTED)
        run = trajectory(experiment, experiment.leaks, error=error, duration=scouted)
        steps.append(run.step)
    return float(min(steps))


def allowed_step(part: LaneSet, sizes: Array) -> float:
    """Compute the longest step [s] that all members' numbers and leaks allow, down to the finest of `integrate`."""
    from sealscope.physics.solvers.limits import longest_step

    limits = []
    for member, size in zip(part.members, sizes, strict=True):
        laminar = member.leak.law == "laminar"
        leak = (size if laminar else 0.0, 0.0 if laminar else size)
        limits += [longest_step(numbers, *leak) for numbers in member.extremes]
    return max(min(limits), LONGEST_STEP / FINEST)


def _sized(part: LaneSet, step: float, sizes: Array, threads: int) -> Array:
    """Find coefficients that give the leaks' means, for all members together."""
    means = np.array([member.leak.mean or 0.0 for member in part.members])

    def measure(sizes: Array) -> tuple[Array, None]:
        measured = np.where(sizes > 0, sizes, 1.0)
        run = SetRun(part, part.experiment.step or min(step, allowed_step(part, sizes)), sizes, measured, None)
        run.run_all(threads, None)
        units = run.mean_flow() / measured
        shut = np.flatnonzero((means > 0) & (units <= 0))
        if shut.size:
            place = part.members[shut[0]].place
            raise InputError(f"a leak with a mean flow must be open within the run (run {place})")
        return units, None

    return size_leaks([member.leak for member in part.members], sizes, measure)[0]
