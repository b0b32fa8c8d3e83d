"""Intervals of `sealscope identify` on simulated rigs that it does not know: how often they hold the truth.

    python benchmarks/identification.py [--rigs 30] [--seed 28] [--base thesis-closed-loop] [-o FILE]

Each rig is the base with areas, bulk modulus, pump leakage, friction, load and speed loop of its own (behind a servo
valve: rated flow and overlaps in place of areas and speed loop), recorded twice for 60 s: a closed loop over a
multi-sine whose controller knows the base, with and without a load that swings. With `-o FILE` each rig is a line of
JSON there, and rigs that the file has are not run again. A rig that cannot be run (a pressure below vacuum) is counted.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from sealscope.control.identification import identify
from sealscope.errors import SimulationFailed
from sealscope.parameters import load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_with_truth

#: Parameters that differ from rig to rig, by how much either way.
SHARES = {
    "cylinder.A": 0.05,
    "fluid.K_oil": 0.2,
    "friction.F_pr": 0.3,
    "friction.F_v": 0.3,
    "friction.K_brk": 0.2,
    "motor.k_p": 0.2,
    "motor.K_i": 0.3,
    "motor.omega_per_volt": 0.05,
}
#: Those of a machine behind a servo valve, whose areas are stated.
VALVE_SHARES = {name: share for name, share in SHARES.items() if name.startswith(("fluid", "friction"))} | {
    "valve.Q_N": 0.2
}
#: Overlaps of its edges, either way [m], and vapour pressure [Pa]: a load pulls some pistons faster than oil comes.
LAP, P_VAP = 10e-6, 1e3


def drawn_rig(base: str, number: int, seed: int = 15) -> dict[str, float]:
    """Return the overrides of a rig of its own."""
    random, rig = np.random.default_rng([seed, number]), load_rig(base)
    values: dict[str, float] = {}
    valved = rig.valve.spool == "present"
    for name, share in (VALVE_SHARES if valved else SHARES).items():
        factor = 1.0 + share * random.uniform(-1.0, 1.0)
        for side in ("_A", "_B") if name == "cylinder.A" else ("",):
            values[name + side] = float(rig[name + side]) * factor
    values["pump.G_pump"] = random.uniform(0.0, 2e-12)
    for edge in ("PA", "AT", "PB", "BT") if valved else ():
        values[f"valve.o_{edge}"] = random.uniform(-LAP, LAP)
    values["cylinder.F_l"] = random.uniform(-200.0, 200.0)
    if valved:
        values["fluid.p_vap"] = P_VAP
    return values


def judged(task: tuple[str, int, int]) -> dict[str, dict[str, float]]:
    """Simulate a rig's recordings, identify, and return the truth and the interval of each estimate."""
    base, number, seed = task
    values = drawn_rig(base, number, seed)
    size = 0.6 if base == "single-rod-eha" else 1.0
    loads = (None, "1 kN sin(0.7t) + 1 kN")
    recordings = []
    for k, load in enumerate(loads):
        experiment = Experiment.of(
            rig=base,
            set=values,
            command=f"position {60 * size} mm sin(0.9t) + {14 * size} mm sin(3.1t)",
            controller=None if k == 0 else "pi",
            load=load,
            duration=60.0,
            seed=1000 * number + k,
        )
        recordings.append(simulate_with_truth(experiment).recording)
    found = identify(recordings, base)
    if found.mismatch:
        return {"mismatch": {"truth": 0.0, "low": 1.0, "high": 1.0, "value": 0.0}}
    result = {}
    for estimate in found.estimates:
        if estimate.name == "cylinder.F_l":
            continue  # the load that swings is in it
        low, high = estimate.interval
        result[estimate.name] = {"truth": values[estimate.name], "low": low, "high": high, "value": estimate.value}
    return result


def main() -> None:
    """Print the share of intervals that hold the truth, and the width of each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rigs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=28, help="15: the rigs that the model's errors were found on")
    parser.add_argument("--base", default="thesis-closed-loop")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    lines = (
        options.output.read_text(encoding="utf-8").splitlines() if options.output and options.output.exists() else []
    )
    results = [json.loads(line) for line in lines]
    for number in range(len(results), options.rigs):
        try:
            results.append(judged((options.base, number, options.seed)))
        except SimulationFailed as failure:
            results.append(str(failure))
        if options.output:
            with options.output.open("a", encoding="utf-8") as file:
                file.write(json.dumps(results[-1]) + "\n")
    rows = [result for result in results if isinstance(result, dict)]
    names = sorted({name for row in rows for name in row})
    total = held = 0
    print(f"{options.base}, {len(rows)} rigs, {len(results) - len(rows)} that could not be run")
    for name in names:
        of = [row[name] for row in rows if name in row]
        inside = sum(r["low"] <= r["truth"] <= r["high"] for r in of)
        total, held = total + len(of), held + inside
        error = np.median([abs(r["value"] - r["truth"]) for r in of])
        width = np.median([0.5 * (r["high"] - r["low"]) for r in of])
        bias = np.mean([(r["value"] - r["truth"]) / max(0.25 * (r["high"] - r["low"]), 1e-300) for r in of])
        print(f"{name:22} {inside:3}/{len(of):<3} +-{width:.3g} (median error {error:.3g}, mean z {bias:.2f})")
    print(f"all: {held}/{total} = {100 * held / max(1, total):.1f} %")


if __name__ == "__main__":
    main()
