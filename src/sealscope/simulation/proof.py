"""A simulation's proof of itself: halve the step, and say how far each channel and each detail's RMS moves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from sealscope.errors import SimulationFailed
from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import decimate
from sealscope.simulation.integrate import Trajectory
from sealscope.simulation.simulate import Progress, oversampling, sized_leaks, trajectory

#: A run is resolved when halving the step moves no pressure by more than this rms [Pa] (a transducer's noise is 8600
#: Pa) ...
PRESSURE_TOLERANCE = 100.0
#: ... and no detail's RMS by more than this share of what it would be in a recording (truth and noise together).
DETAIL_TOLERANCE = 1e-3
_STATES = ("omega", "theta", "x", "v")


@dataclass(frozen=True)
class Difference:
    """How far one quantity moved: `difference` and `tolerance` (None: reported only) in `unit`."""

    name: str
    difference: float
    unit: str
    tolerance: float | None

    @property
    def resolved(self) -> bool:
        """Whether it moved no further than it may."""
        return self.tolerance is None or self.difference <= self.tolerance


@dataclass(frozen=True)
class Proof:
    """The halving test of one experiment: the two steps [s] and every difference."""

    method: str
    step: float
    halved: float
    differences: tuple[Difference, ...]

    @property
    def resolved(self) -> bool:
        """Whether every difference is within its tolerance."""
        return all(one.resolved for one in self.differences)

    def text(self) -> str:
        """The proof as lines of text: what moved, by how much, and how much it may."""
        lines = [f"halving the step ({self.method}, {self.step:.3g} s to {self.halved:.3g} s) moves"]
        for one in self.differences:
            limit = "" if one.tolerance is None else f" (at most {one.tolerance:.3g})"
            lines.append(
                f"  {one.name:<18} {one.difference:10.3g} {one.unit}{limit}{'' if one.resolved else '  NOT RESOLVED'}"
            )
        return "\n".join(lines)

    def worst(self) -> Difference:
        """The difference furthest beyond, or nearest to, its tolerance."""
        judged = [one for one in self.differences if one.tolerance]
        return max(judged, key=lambda one: one.difference / (one.tolerance or math.inf))


def compare(experiment: Experiment, coarse: Trajectory, fine: Trajectory) -> tuple[Difference, ...]:
    """Differences between two trajectories of one experiment: rms of each channel, and change of each detail's RMS in
    both chambers."""
    from sealscope.signals.details import details
    from sealscope.signals.windows import rms

    n = round(experiment.duration * experiment.rate)
    factor = oversampling(experiment)
    units = {"omega": "rad/s", "theta": "rad", "x": "m", "v": "m/s"}
    found = [
        Difference(name, rms(coarse[name][: n * factor] - fine[name][: n * factor]), units[name], None)
        for name in _STATES
    ]
    found += [
        Difference(name, rms(coarse[name][: n * factor] - fine[name][: n * factor]), "Pa", PRESSURE_TOLERANCE)
        for name in PRESSURES
    ]
    for name in CHAMBERS:
        one, other = (details(decimate(run[name], factor, n)) for run in (coarse, fine))
        sensor = getattr(experiment.rig.sensors, name)
        noise = math.hypot(sensor.noise, experiment.rig.sensors.common_noise)
        for level in range(1, one.levels + 1):
            a, b = rms(one[level][one.inside(level)]), rms(other[level][other.inside(level)])
            recorded = math.hypot(b, noise)
            change = abs(math.hypot(a, noise) - recorded)
            found.append(Difference(f"RMS of d{level} of {name}", change, "Pa", DETAIL_TOLERANCE * recorded))
    return tuple(found)


def prove(experiment: Experiment, progress: Progress | None = None) -> Proof:
    """Integrate the experiment twice, at its step and at half of it, and compare.

    Raises SimulationFailed, naming the worst difference, when the run is under-resolved (unless the experiment allows
    it).
    """
    leaks = sized_leaks(experiment, progress)

    def told(words: str) -> Callable[[float], None]:
        def tell(reached: float) -> None:
            if progress is not None:
                progress(words, min(1.0, reached / experiment.duration))

        return tell

    coarse = trajectory(experiment, leaks, progress=told("proving: the step"))
    fine = trajectory(experiment, leaks, step=coarse.step / 2, progress=told("proving: half the step"))
    proof = Proof(coarse.method, coarse.step, fine.step, compare(experiment, coarse, fine))
    if not (proof.resolved or experiment.allow_unresolved):
        worst = proof.worst()
        raise SimulationFailed(
            f"the run is under-resolved: halving the step of {coarse.step:.3g} s ({coarse.method}) moves "
            f"{worst.name} by "
            f"{worst.difference:.4g} {worst.unit}, which must be <= {worst.tolerance:.4g} {worst.unit}; take a "
            f"smaller step"
        )
    return proof
