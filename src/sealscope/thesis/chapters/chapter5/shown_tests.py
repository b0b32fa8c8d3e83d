"""What the ten simulated tests of chapter 5 show in numbers: onset, speed, drift of the piston, pressures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.windows import rms
from sealscope.thesis.chapters.appendix_c.simulated_sheet import SETTLING
from sealscope.thesis.chapters.chapter5.tests import TESTS, ShownTest
from sealscope.thesis.chapters.chapter5.views import (
    Mask,
    changes,
    mean_slope,
    omega_of,
    recording_of,
    spec_of,
    windowed,
)
from sealscope.thesis.engine.context import Context

Pair = tuple[float, float]


@dataclass(frozen=True)
class Shown:
    """One simulated test, each pair without and with the leak.

    `rms`: as Appendix C; `speed`: RMS of the motor's speed [rad/s]; `drift`: of the piston's mean [mm/s];
    `velocity`: RMS of the piston's [mm/s]; `range_MPa`: 5 to 95 % range
    of each chamber's true pressure; `mean_MPa`: its mean; `step_s`: where a single step fits the windowed RMS of d3 of
    each chamber best [s]; `onset_s`: the true onset [s].
    """

    test: ShownTest
    rms: dict[str, dict[str, Pair]]
    speed: Pair
    drift: Pair
    velocity: Pair
    range_MPa: dict[str, Pair]
    mean_MPa: dict[str, Pair]
    step_s: dict[str, float]
    onset_s: float
    resolved: bool | None


def best_step(t: Array, y: Array, least: int = 5) -> float:
    """Time at which a single step fits a series best by least squares, halfway between two points; at least `least`
    points stay on each side."""
    n = y.size
    places = np.arange(least, n - least + 1)
    total, squares = np.cumsum(y), float(np.sum(y**2))
    left, right = total[places - 1], total[-1] - total[places - 1]
    misfit = squares - left**2 / places - right**2 / (n - places)
    k = int(places[np.argmin(misfit)])
    return float((t[k - 1] + t[k]) / 2.0)


def _spread(values: Array) -> float:
    low, high = np.percentile(values, [5.0, 95.0])
    return float(high - low)


def _mean(values: Array) -> float:
    return float(values.mean())


_MEASURES = {"rms": rms, "range": _spread, "mean": _mean}


def _whole_cycles(recording: Recording, start: float, stop: float, omega: float) -> Mask:
    """Samples of the last whole number of the command's periods before `stop`, none before `start` [s]."""
    period = 2.0 * np.pi / omega
    cycles = np.floor((stop - start) / period)
    return np.asarray((recording.t >= stop - cycles * period) & (recording.t < stop))


def shown(context: Context, test: ShownTest, leak: bool = True) -> Shown:
    """The numbers of one of the ten tests, or of the same run with its leak left out."""
    spec = spec_of(test)
    run = context.run(spec if leak else replace(spec, leaks=(), prove=False))
    recording = recording_of(run, test)
    omega = omega_of(test.command)
    parts = [
        _whole_cycles(recording, SETTLING, test.half, omega),
        _whole_cycles(recording, test.half, 2 * test.half, omega),
    ]
    t, x = recording.t, run.outputs["x"]

    def pair(values: Array, of: str) -> Pair:
        return _MEASURES[of](values[parts[0]]), _MEASURES[of](values[parts[1]])

    steps = {}
    for chamber in CHAMBERS:
        centres, curves = windowed(recording, chamber)
        settled = centres >= SETTLING
        steps[chamber] = best_step(centres[settled], curves["d3"][settled])
    return Shown(
        test=test,
        rms=changes(recording, test),
        speed=pair(run.outputs["omega"], "rms"),
        drift=(mean_slope(t[parts[0]], x[parts[0]], omega) * 1e3, mean_slope(t[parts[1]], x[parts[1]], omega) * 1e3),
        velocity=pair(run.outputs["v"] * 1e3, "rms"),
        range_MPa={chamber: pair(run.outputs[chamber] / 1e6, "range") for chamber in CHAMBERS},
        mean_MPa={chamber: pair(run.outputs[chamber] / 1e6, "mean") for chamber in CHAMBERS},
        step_s=steps,
        onset_s=test.half,
        resolved=run.resolved,
    )


def all_shown(context: Context) -> dict[str, Shown]:
    """The ten tests by section."""
    return {test.section: shown(context, test) for test in TESTS}
