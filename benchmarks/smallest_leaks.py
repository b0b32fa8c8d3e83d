"""What `sealscope plan` and a machine's file predict against what is found: leaks of the predicted size times a factor.

    python benchmarks/smallest_leaks.py [--seeds 12] [--duration 60]
    python benchmarks/smallest_leaks.py FILE...

Simulated, the leak opens at mid-record, laminar, at the predicted conductance times a factor; `diagnose`'s volume
balance judges all channels at a false-alarm probability of 1 %. Predicted is what 90 % of records show. FILE: logs of a
real machine, as for `real_eha.py`, all of one set-up and of two days or more: each run is judged by the file of a
machine that was commissioned on those of the other days, with leaks put into it; the size that it shows is looked for
by bisection.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from real_eha import AREAS, DISPLACEMENT, MAP, leaking

import sealscope as ss
from sealscope.campaigns.smallest import PlannedDuty, detectable_leak, duty_experiment
from sealscope.diagnosis.diagnose import Examination
from sealscope.parameters import load_rig
from sealscope.simulation.leaks import Leak, opening_from
from sealscope.simulation.simulate import simulate_experiment
from sealscope.units import LITRE_PER_MINUTE

CASES = (("thesis", "3 sin(4t)"), ("thesis-closed-loop", "3 sin(3t)"), ("thesis", "8 sin(t)"))
FACTORS = (0.5, 1.0 / 1.3, 1.0, 1.3)
#: A size is looked for up to so many times the predicted one, in so many halvings.
LARGEST, HALVINGS = 8.0, 7


def shown(machine: ss.CommissionedMachine, run: ss.Recording, largest: float) -> float:
    """Return the smallest leak [L/min] that a run shows, 0 where it needs none, inf where the largest does not do."""

    def detected(lpm: float) -> bool:
        return machine.diagnose(leaking(run, lpm) if lpm else run).verdict == "leak"

    low, high = 0.0, largest
    if detected(low) or not detected(high):
        return 0.0 if detected(low) else np.inf
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if detected(middle) else (middle, high)
    return high


def real(files: Sequence[str]) -> None:
    """Print the table of a real machine's runs."""
    stated = {"cylinder.A_A": AREAS[0], "cylinder.A_B": AREAS[1], "pump.q_b": DISPLACEMENT}
    whole = ss.commission(files, rig=load_rig("single-rod-eha").with_overrides(stated), map=MAP)
    predicted, sizes = [], []
    days = {own.file: (own.start_s or 0.0) // 86_400.0 for own in whole.healthy}
    files = [file for file in files if Path(file).name in days]
    for file in files:
        day = days[Path(file).name]
        machine = replace(whole, healthy=tuple(own for own in whole.healthy if days[own.file] != day))
        predicted.append(machine.summary.smallest.lpm)
        sizes.append(shown(machine, machine.read(file), LARGEST * predicted[-1]))
    level, size = np.median(predicted), np.quantile(sizes, 0.9, method="inverted_cdf")
    factors = (*FACTORS, 2.0)
    print("| runs | predicted [L/min] | " + " | ".join(f"x {own:.2g}" for own in factors) + " | 90 % show | ratio |")
    print("| --- | --- | " + "--- | " * len(factors) + "--- | --- |")
    counts = [f"{np.count_nonzero(sizes <= own * level)} of {len(files)}" for own in factors]
    print(f"| {len(files)} | {level:.2g} | " + " | ".join(counts) + f" | {size:.2g} | {size / level:.2f} |")


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("files", nargs="*")
    given = parser.parse_args()
    if given.files:
        real(given.files)
        return
    print(
        f"| rig, command, {given.duration:g} s | L/min | " + " | ".join(f"x {factor:.2g}" for factor in FACTORS) + " |"
    )
    print("| --- | --- | " + "--- | " * len(FACTORS))
    for name, command in CASES:
        rig, duty = load_rig(name), PlannedDuty(command)
        predicted = detectable_leak(rig, duty, given.duration)
        counts = []
        for factor in FACTORS:
            opening = opening_from(0.5 * given.duration)
            leak = Leak("laminar", coefficient=factor * predicted.conductance, opening=opening)
            detected = 0
            for seed in range(given.seeds):
                experiment = replace(duty_experiment(rig, duty, given.duration, 1000 + seed), leaks=(leak,))
                recording = simulate_experiment(experiment).recording
                examination = Examination(recording, false_alarm_probability=0.01, rig=rig)
                detected += examination.evidence("volume balance").verdict == "leak"
            counts.append(f"{detected} of {given.seeds}")
        size = predicted.conductance * predicted.pressure / LITRE_PER_MINUTE
        print(f"| {name}, {command} | {size:.2g} | " + " | ".join(counts) + " |", flush=True)


if __name__ == "__main__":
    main()
