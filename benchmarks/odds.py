"""Measure how often leak-free recordings of fresh bench machines reach a stated chance, for every detector.

    python benchmarks/odds.py [--machines 100] [--duration 90] [--seed 0]

`Evidence.chance` says how probable it is that a leak-free recording scores as high. If that is true, a share c of
leak-free recordings has a chance of c or less; a smaller share is careful. One row a detector and set of channels: the
recordings that it states a chance for, and the share at or below each level.
"""

from __future__ import annotations

import argparse

import numpy as np

import sealscope as ss
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.simulate import simulate_experiment

LEVELS = (0.2, 0.1, 0.05, 0.02, 0.01)
VIEWS = {"all channels": None, "pressures and command": ("u", "p_A", "p_B")}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument("--duration", type=float, default=90.0, help="of a recording [s]")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    chances: dict[tuple[str, str], list[float]] = {}
    for machine in range(chosen.machines):
        own = draw("bench", chosen.seed + machine, duration=chosen.duration)
        recording = simulate_experiment(own.experiment(seed=own.seed)).recording
        for view, channels in VIEWS.items():
            diagnosis = ss.diagnose(recording if channels is None else recording.only(channels))
            for detector in diagnosis.parts:
                if detector.chance is not None:
                    chances.setdefault((detector.detector, view), []).append(detector.chance)
    print(f"{'':44s}    n" + "".join(f"{f'<= {level:g}':>10s}" for level in LEVELS))
    for (detector, view), values in chances.items():
        shares = "".join(f"{100 * np.mean(np.array(values) <= level):8.1f} %" for level in LEVELS)
        print(f"{f'{detector}, {view}':44s} {len(values):4d}{shares}")


if __name__ == "__main__":
    main()
