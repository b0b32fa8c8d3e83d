"""What `sealscope plan` predicts against what is found: leaks of the predicted size times a factor, simulated afresh.

    python benchmarks/smallest_leaks.py [--seeds 12] [--duration 60]

The leak opens at mid-record, laminar, at the predicted conductance times a factor; `diagnose`'s volume balance judges
all channels at a false-alarm probability of 1 %. Predicted is what 90 % of records show.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from sealscope.campaigns.smallest import PlannedDuty, experiment_of, findable
from sealscope.diagnosis.inference.detector import VolumeBalance
from sealscope.parameters import load_rig
from sealscope.simulation.leaks import From, Leak
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.units import LITRE_PER_MINUTE

CASES = (("thesis", "3 sin(4t)"), ("thesis-closed-loop", "3 sin(3t)"), ("thesis", "8 sin(t)"))
FACTORS = (0.5, 1.0 / 1.3, 1.0, 1.3)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--duration", type=float, default=60.0)
    given = parser.parse_args()
    print(
        f"| rig, command, {given.duration:g} s | L/min | " + " | ".join(f"x {factor:.2g}" for factor in FACTORS) + " |"
    )
    print("| --- | --- | " + "--- | " * len(FACTORS))
    for name, command in CASES:
        rig, duty = load_rig(name), PlannedDuty(command)
        predicted = findable(rig, duty, given.duration)
        counts = []
        for factor in FACTORS:
            leak = Leak("laminar", coefficient=factor * predicted.conductance, opening=From(0.5 * given.duration))
            found = 0
            for seed in range(given.seeds):
                experiment = replace(experiment_of(rig, duty, given.duration, 1000 + seed), leaks=(leak,))
                recording = simulate_with_truth(experiment).recording
                found += VolumeBalance(rig).examine(recording, [], 0.01).verdict == "leak"
            counts.append(f"{found} of {given.seeds}")
        size = predicted.conductance * predicted.pressure / LITRE_PER_MINUTE
        print(f"| {name}, {command} | {size:.2g} | " + " | ".join(counts) + " |", flush=True)


if __name__ == "__main__":
    main()
