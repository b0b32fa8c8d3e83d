"""Before anyone measures: the smallest leak that each detector will find on this rig, and the bound beside it.

A record of T seconds has the leak from its middle on. The rig is simulated with leaks of rising size; the instruments'
own noise is laid over it many times; the scorers judge the records as a campaign's would. With a bench, every record
is a machine of its own that drifts as the bench says, and the scatter holds both.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sealscope.campaigns.bound import UNKNOWN, LeakBound, in_lpm, leak_bound, noise_covariance
from sealscope.campaigns.outlook import BoundFigures, CommandRow, Outlook
from sealscope.campaigns.prediction import THESIS_DETECTORS, ChangeDetector, Prediction, Responses, predict
from sealscope.diagnosis.scorers import Look
from sealscope.errors import InputError, SealscopeError
from sealscope.parameters import Rig
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.commands import Command, parse_command
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import LITRE_PER_MINUTE, From, Leak
from sealscope.simulation.sensitivity import CHAMBERS, clean_channels
from sealscope.simulation.simulate import run

Progress = Callable[[str, float], None]

#: The commands of the thesis's tests that a plan compares, and the closings of both throttles (None: no throttles).
STANDARD_COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)")
STANDARD_CLOSINGS = (None, 0.25, 0.50, 0.75)
#: Sizes of leaks that are simulated [L/min]; a prediction never goes beyond the largest.
SIZES = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032)
TABLE_SIZES = (0.001, 0.004, 0.016)
#: Shortest record planned for [s]: each half must hold whole cycles of the slowest standard command.
SHORTEST = 20.0
#: Noise records laid over the run: for the rig's own command, and for each row of the table.
NOISES, TABLE_NOISES = 24, 12
#: Records with a leak that each size's change is averaged over; they carry the noise of the leak-free ones.
_PAIRED = 2


def ideal_sweep(command: Command, rig: Rig, t: Array) -> Array:
    """Position [m] at the times `t` if the speed loop followed at once and no oil slipped: the pump's volume over the
    piston's area."""
    speed = rig.motor.omega_per_volt * command.volts(t)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))])
    return np.asarray(angle * rig.pump.q_b / (2.0 * math.pi) / rig.cylinder.A_A)


def centred_start(command: Command, rig: Rig, duration: float) -> float:
    """The piston's position at the start [m] that puts the middle of the sweep at mid-stroke, within the stroke."""
    t = np.arange(max(2, round(duration * rig.daq.sample_rate))) / rig.daq.sample_rate
    x = ideal_sweep(command, rig, t)
    half = rig.cylinder.L / 2.0
    return float(np.clip(-0.5 * (x.min() + x.max()), -half, half))


def with_closing(rig: Rig, closing: float | None) -> Rig:
    """The rig without throttles, or with both closed by this share."""
    if closing is None:
        return rig.with_values({"orifices": "absent"}, source="varied for a plan")
    values: dict[str, float | str] = {"orifices": "present", "closed_A": closing, "closed_B": closing}
    return rig.with_values(values, source="varied for a plan")


def closing_words(rig: Rig) -> str:
    """How the rig is throttled, in words."""
    if rig.line.orifices == "absent":
        return "none"
    a, b = (100.0 * closed for closed in (rig.line.closed_A, rig.line.closed_B))
    return f"{a:g} %" if a == b else f"{a:g} % at A, {b:g} % at B"


@dataclass(frozen=True, eq=False)
class Noise:
    """What the instruments add to the chamber pressures: (r, c, n) [Pa] of r records."""

    values: Array

    def over(self, clean: Array, record: int, rate: float) -> Recording:
        """A record of the clean pressures (c, n) under one of the noises."""
        n = clean.shape[1]
        channels = dict(zip(CHAMBERS, clean + self.values[record, :, :n], strict=True))
        return Recording(np.arange(n) / rate, channels, dict.fromkeys(CHAMBERS, "Pa"), rate)


def instrument_noise(experiment: Experiment, clean: Array, records: int, seed: int) -> Noise:
    """Readings less the truth of `records` leak-free records, by the rig's own instruments; samples that would be
    lost or stuck are not."""
    whole = {f"sensors.{name}.{rate}": 0.0 for name in CHAMBERS for rate in ("stuck_rate", "drop_rate")}
    rig = experiment.rig.with_values(whole, source="varied for a plan")
    seeds = np.random.SeedSequence(seed).generate_state(records, np.uint32)
    made = []
    for one in seeds:
        recording = run(replace(experiment, rig=rig, leaks=(), seed=int(one))).recording
        made.append(np.stack([recording[name] for name in CHAMBERS]) - clean)
    return Noise(np.stack(made))


def _changes(recording: Recording, detectors: Sequence[ChangeDetector]) -> Array:
    look = Look(recording)
    return np.array([detector.change(look) for detector in detectors])


def responses(
    experiment: Experiment,
    sizes: Sequence[float],
    detectors: Sequence[ChangeDetector],
    noise: Noise,
    told: Callable[[float], None] = lambda share: None,
) -> tuple[Responses, float]:
    """How the detectors' changes answer to leaks of about these `sizes` [L/min] from the middle on, under noise alone;
    and the mean pressure difference [Pa] that drives them."""
    middle = experiment.duration / 2.0
    steps = len(sizes) + 1
    clean = clean_channels(experiment)
    later = slice(clean.shape[1] // 2, None)
    dp = float(np.mean(np.abs(clean[0, later] - clean[1, later])))
    told(1.0 / steps)
    free = np.stack(
        [_changes(noise.over(clean, k, experiment.rate), detectors) for k in range(len(noise.values))]
    )
    scatter = free.std(axis=0, ddof=1)
    got, mean = [], [free.mean(axis=0)]
    for number, size in enumerate(sizes, start=2):
        G = size * LITRE_PER_MINUTE / dp
        leaky = clean_channels(experiment, (Leak("laminar", coefficient=G, opening=From(middle)),))
        got.append(in_lpm(G, float(np.mean(np.abs(leaky[0, later] - leaky[1, later])))))
        paired = [_changes(noise.over(leaky, k, experiment.rate), detectors) - free[k] for k in range(_PAIRED)]
        mean.append(mean[0] + np.mean(paired, axis=0))
        told(number / steps)
    table = np.stack(mean)
    return Responses(np.array(got), table, np.broadcast_to(scatter, table.shape), len(free)), dp


def _workers() -> int:
    return max(1, min(4, os.cpu_count() or 1))


def _in_parallel(jobs: Sequence[Callable[[], object]], words: str, progress: Progress) -> list[object]:
    """Results of the jobs in their order; compiled kernels run outside the interpreter's lock, so threads serve."""
    done = 0
    results: list[object] = []
    progress(words, 0.0)
    with ThreadPoolExecutor(_workers()) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in futures:
                results.append(future.result())
                done += 1
                progress(words, done / len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
