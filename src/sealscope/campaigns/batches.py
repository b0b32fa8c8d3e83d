"""A plan's cases many at a time: simulated side by side, scored from the RMS of the details on both sides of the onset.

The scores are the same functions of the same samples as those of a recording (`scorers.Sides`); nothing else of a
record is there, so that a plan is refused where something asks for more.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.campaigns.cases import Case
from sealscope.campaigns.entries import entry, scored
from sealscope.campaigns.machines import fault_of, sized_once, sizing_run, unsized
from sealscope.campaigns.plan import Plan
from sealscope.campaigns.short_runs import Steps, place_of_run, stepped
from sealscope.campaigns.work import Row, failed
from sealscope.diagnosis.calibration.scorers import Sides, scorer, side_bounds
from sealscope.errors import InputError, SealscopeError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.signals.filters import IntArray

if TYPE_CHECKING:
    from sealscope.simulation.experiment import Experiment

#: Runs of a batch, after each of which the rows are on disk.
RUNS = {"cpu": 256, "gpu": 4096}


def way(device: str) -> str:
    """How rows of batches were made: they are not mixed with those of another way, the noise being another."""
    return f"in batches on the {device}"


def bounds_of(plan: Plan) -> IntArray:
    """The samples (2, 2) of a record that the scorers compare."""
    rate = plan.rig.daq.sample_rate
    return side_bounds(round(plan.duration_s * rate), rate, round(plan.onset_s * rate))


def check_plan(plan: Plan, cases: Sequence[Case]) -> None:
    """Raise InputError, naming it, for what of a plan no batch can do."""
    from sealscope.simulation.batch.layout import refuse

    def no(rule: str) -> InputError:
        return InputError(f"a plan in batches must have {rule}; run it without --batch ({plan.place})")

    for name in plan.detectors:
        one = entry(name)
        if one.detector or scorer(one.of).of_sides is None:
            raise no(
                f"detectors of the RMS on both sides of the onset alone, got {name!r}, which needs whole recordings"
            )
    if plan.keep_recordings:
        raise no("keep_recordings = false, got true")
    if np.diff(bounds_of(plan)).min() < 1:
        raise no(f"records with details on both sides of the onset, got {plan.duration_s:g} s with {plan.onset_s:g} s")
    for kind in plan.records:
        fault = fault_of(kind.fault, plan.onset_s) if kind.fault else None
        if fault is not None and (fault.adjustments() or fault.holds()):
            raise no(f"no fault of a sensor, got {kind.fault!r}")
    for case in {repr(case.levels): case for case in reversed(cases)}.values():  # one of each cell
        try:
            experiment = unsized(plan, case)
        except SealscopeError:  # then its row tells
            continue
        if experiment.rate != plan.rig.daq.sample_rate:
            raise no(f"one sampling rate, {plan.rig.daq.sample_rate:g} Hz, got {experiment.rate:g} Hz by a factor")
        try:
            refuse(experiment, 0)
        except InputError as error:
            raise no(f"runs that can stand side by side, got: {error}") from None


def check_device(plan: Plan, device: str) -> None:
    """Raise InputError for a device that is not there, before the work and not as the error of every row."""
    from sealscope.simulation.batch.batch import runner_of

    if device not in RUNS:
        raise InputError(f"--device must be {' or '.join(RUNS)}, got {device}")
    runner_of(device)


def in_batches(plan: Plan, cases: Sequence[Case], threads: int, device: str = "cpu") -> Generator[Row, None, None]:
    """The rows of the cases, batch by batch; one that cannot be carried out is a row with its error and costs no other.

    A row derives from its case alone, whatever stands beside it.
    """
    batches = _Batches(plan, threads, device)
    for start in range(0, len(cases), RUNS[device]):
        yield from batches.rows(cases[start : start + RUNS[device]])


class _Batches:
    """Carries out the cases of one plan."""

    def __init__(self, plan: Plan, threads: int, device: str) -> None:
        from sealscope.simulation.bench.profile import load_profile

        self._plan, self._threads, self._device = plan, threads, device
        self._profile = load_profile(plan.profile) if plan.profile else None
        self._steps = Steps(plan, self._profile)
        self._bounds = bounds_of(plan)

    def rows(self, cases: Sequence[Case]) -> list[Row]:
        started = time.process_time()
        drawn: list[tuple[Case, Experiment]] = []
        rows: list[Row] = []
        for case in cases:
            try:
                experiment = unsized(self._plan, case, self._profile)
                drawn.append((case, replace(experiment, step=self._steps.of(case, experiment))))
            except Exception as error:
                rows.append(failed(case, _words(error)))
        rows += self._carried_out(drawn)
        seconds = round((time.process_time() - started) / max(1, len(cases)), 4)
        return [replace(row, seconds=seconds) for row in rows]

    def _carried_out(self, drawn: Sequence[tuple[Case, Experiment]]) -> list[Row]:
        """The rows of one batch; where it fails, of its halves, down to the run that is to blame."""
        try:
            return self._made(drawn) if drawn else []
        except Exception as error:
            if len(drawn) == 1:
                return [failed(drawn[0][0], _words(error))]
        middle = len(drawn) // 2
        return self._carried_out(drawn[:middle]) + self._carried_out(drawn[middle:])

    def _made(self, drawn: Sequence[tuple[Case, Experiment]]) -> list[Row]:
        from sealscope.simulation.batch.batch import simulate_batch

        cases = [case for case, _ in drawn]
        experiments = self._sized([experiment for _, experiment in drawn])
        places = [asdict(place_of_run(one)) for one in experiments]
        edges = self._bounds.ravel() / self._plan.rig.daq.sample_rate
        batch = simulate_batch(experiments, bounds=edges, threads=self._threads, device=self._device)
        squares = batch.rms[:, :, [0, 2]] ** 2
        rows = []
        for k, case in enumerate(cases):
            sides = Sides.of_squares(dict(zip(CHAMBERS, squares[k], strict=True)), self._bounds)
            rows.append(
                Row(
                    id=case.id,
                    use=case.use,
                    leak_lpm=case.leak_lpm,
                    fault=case.fault,
                    levels=case.levels,
                    replicate=case.replicate,
                    flow_lpm=float(batch.mean_leak_lpm[k]) if case.leak_lpm else 0.0,
                    place=places[k],
                    scores=scored(sides, self._plan.detectors, self._plan.views),
                )
            )
        return rows

    def _sized(self, experiments: Sequence[Experiment]) -> list[Experiment]:
        """The experiments with their leaks sized as `machines.sized_once` does, side by side, and steps that resolve
        them."""
        from sealscope.physics.rig import rig_numbers
        from sealscope.physics.solvers.limits import longest_step
        from sealscope.simulation.batch.batch import simulate_batch
        from sealscope.simulation.batch.layout import with_sizes
        from sealscope.simulation.simulate import oversampling

        found = list(experiments)
        leaky = [k for k, one in enumerate(experiments) if one.leaks]
        if not leaky:
            return found
        short = [sizing_run(experiments[k]) for k in leaky]
        try:
            sizes = simulate_batch(short, threads=self._threads, device=self._device).coefficients.tolist()
        except SealscopeError:
            if len(experiments) > 1:  # the one that is to blame is found by halving
                raise
            sizes = [one.coefficient for one in sized_once(replace(experiments[0], step=None))]
        for k, size in zip(leaky, sizes, strict=True):
            one = with_sizes(experiments[k], size)
            laminar = one.leaks[0].law == "laminar"
            limit = longest_step(rig_numbers(one.rig), size if laminar else 0.0, 0.0 if laminar else size)
            if one.step is not None and one.step > limit:
                one = replace(one, step=stepped(one.rate * oversampling(one), limit))
            found[k] = one
        return found


def _words(error: Exception) -> str:
    if isinstance(error, SealscopeError):
        return str(error)
    return f"{type(error).__name__}: {error}".splitlines()[0]
