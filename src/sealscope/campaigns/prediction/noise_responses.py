"""How detectors answer to leaks on one machine under its instruments' noise alone: one run of each size, the noise of
many leak-free records laid over all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sealscope.campaigns.prediction.bound import in_lpm
from sealscope.campaigns.prediction.detection import ChangeDetector, Responses
from sealscope.diagnosis.calibration.scorers import side_bounds
from sealscope.diagnosis.rms_change.blocks import QUANTITIES, mean_squares
from sealscope.physics.rig import OUTPUTS
from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.recordings.recording import Array
from sealscope.signals.details import Details, details
from sealscope.signals.filters import IntArray
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults.faults import From, Leak
from sealscope.simulation.instruments import decimate, record
from sealscope.simulation.integrate import Trajectory
from sealscope.simulation.sensitivity import clean_channels
from sealscope.simulation.simulate import oversampling, trajectory
from sealscope.units import LITRE_PER_MINUTE

#: Blocks of a half over which the noise is taken as independent.
BLOCKS = 16


def filtered(experiment: Experiment) -> Trajectory:
    """The leak-free trajectory at the recording's samples, pressures behind the anti-alias filter: what many records
    of one run have in common."""
    path, factor = trajectory(experiment, ()), oversampling(experiment)
    n = round(experiment.duration * experiment.rate)
    rows = path.rows[: n * factor : factor].copy()
    for name in PRESSURES:
        rows[:, OUTPUTS.index(name)] = decimate(path[name], factor, n)
    return Trajectory(path.t[: n * factor : factor], rows, path.method, path.step)


def instrument_noise(experiment: Experiment, records: int, seed: int) -> Array:
    """What the instruments add to the chamber pressures: readings less the truth (r, c, n) [Pa] of `records` leak-free
    records, by the rig's own instruments; samples that would be lost or stuck are not."""
    whole = {f"sensors.{name}.{rate}": 0.0 for name in CHAMBERS for rate in ("stuck_rate", "drop_rate")}
    rig = experiment.rig.with_overrides(whole, source="varied for a plan")
    times = experiment.sample_times()
    path, u = filtered(experiment), experiment.command.volts(times)
    clean = np.stack([path[name] for name in CHAMBERS])
    made = []
    for one in np.random.SeedSequence(seed).generate_state(records, np.uint32):
        read = record(rig, path, u, 1, int(one))
        made.append(np.stack([read[name] for name in CHAMBERS]) - clean)
    return np.stack(made)


def halves(n: int, rate: float) -> tuple[IntArray, IntArray]:
    """Bounds (BLOCKS + 1,) of the blocks before and after the middle, over the samples that the scorers compare."""
    sides = side_bounds(n, rate, n // 2)
    first, second = (np.linspace(start, stop, BLOCKS + 1).astype(np.int64) for start, stop in sides)
    return first, second


def block_squares(runs: Sequence[Array], noise: Array, rate: float) -> tuple[Array, Array]:
    """Mean squares of the details in every block: before the middle without a leak (r, c, B, 5), after it in each run
    (m + 1, r, c, B, 5).

    `runs`: noise-free pressures (c, n), the first without a leak; the transform is linear, so that each run and each
    noise (r, c, n) is transformed once.
    """
    first, second = halves(runs[0].shape[1], rate)
    shape = (len(noise), len(CHAMBERS), BLOCKS, len(QUANTITIES))
    before, after = np.empty(shape), np.empty((len(runs), *shape))

    def part(found: Details, bounds: IntArray) -> Array:
        return found.values[:, bounds[0] : bounds[-1]]

    def squares(found: Details, values: Array, bounds: IntArray) -> Array:
        cut = Details(values, values[0], found.edges, found.wavelet, found.transform, found.edge)
        return mean_squares(cut, bounds - bounds[0])

    for c in range(len(CHAMBERS)):
        free = details(runs[0][c])
        earlier = part(free, first).copy()
        later = [part(free, second).copy(), *(part(details(run[c]), second).copy() for run in runs[1:])]
        for k in range(len(noise)):
            found = details(noise[k, c])
            before[k, c] = squares(found, earlier + part(found, first), first)
            for i, clean in enumerate(later):
                after[i, k, c] = squares(found, clean + part(found, second), second)
    return before, after


def _variance(squares: Array) -> Array:
    """Relative variance over the records of a half's mean square, (..., c, 5), from blocks (..., r, c, B, 5)."""
    found = squares.var(axis=-4, ddof=1).mean(axis=-2) / BLOCKS
    return np.asarray(found / squares.mean(axis=(-4, -2)) ** 2)


def responses(
    experiment: Experiment,
    sizes: Sequence[float],
    detectors: Sequence[ChangeDetector],
    noise: Array,
    told: Callable[[float], None] = lambda share: None,
) -> tuple[Responses, float]:
    """How the detectors' changes answer to leaks of about these `sizes` [L/min] from the middle on, under the `noise`
    (r, c, n) [Pa] alone; and the mean pressure difference [Pa] that drives them.

    A half's mean square is the mean of its blocks', whose noise is independent (the filters reach over a thousandth of
    a block), so ``Var(change) = 1/4 sum_halves Var(mean square) / (mean square)^2`` with the variance of each block
    taken over the records: `BLOCKS` times the freedom that the records' changes alone would give.
    """
    middle, rate = experiment.duration / 2.0, experiment.rate
    runs, got = [clean_channels(experiment)], []
    later = slice(runs[0].shape[1] // 2, None)

    def driving(run: Array) -> float:
        return float(np.mean(np.abs(run[0, later] - run[1, later])))

    dp = driving(runs[0])
    for number, size in enumerate(sizes, start=1):
        told(number / (len(sizes) + 2))
        G = size * LITRE_PER_MINUTE / dp
        runs.append(clean_channels(experiment, (Leak("laminar", coefficient=G, opening=From(middle)),)))
        got.append(in_lpm(G, driving(runs[-1])))
    told((len(sizes) + 1) / (len(sizes) + 2))
    before, after = block_squares(runs, noise, rate)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_before, log_after = (0.5 * np.log(squares.mean(axis=-2)) for squares in (before, after))
        mean = (log_after - log_before).mean(axis=1)
        scatter = np.sqrt(0.25 * (_variance(before) + _variance(after)))
        error = (log_after - log_after[0]).std(axis=1, ddof=1) / np.sqrt(len(noise))
    chosen = [(CHAMBERS.index(one.chamber), QUANTITIES.index(one.quantity)) for one in detectors]

    def columns(table: Array) -> Array:
        return np.stack([table[:, c, q] for c, q in chosen], axis=1)

    freedom = 2 * BLOCKS * (len(noise) - 1)
    found = Responses(np.array(got), columns(mean), columns(scatter), len(noise), freedom, error=columns(error))
    return found, dp
