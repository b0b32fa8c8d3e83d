"""Evidence from pressures and command, provider by provider, on machines of the bench that it was developed on.

    python benchmarks/pressures.py ring_down --machines 24 --seed 91 --leaks 0 0.0042 0.015
    python benchmarks/pressures.py response --machines 24 --seed 91 --leaks 0 0.0042 0.1 0.5
    python benchmarks/pressures.py response --machines 28 --seed 94 --families --leaks 0 0.0042

Machines of the profile `bench`, 180 s at 500 Hz, the leak by either law in turn from 90 s on; `--families`: of the
development families of `strangers` in turn. A machine counts as found where the step of the conductance has a chance
below `--false-alarm` (`sealscope.diagnosis.inference.onset`). The time is that of a core, the step's test left out.
"""

from __future__ import annotations

import argparse
import importlib
import time
from dataclasses import replace

import numpy as np

from sealscope.campaigns.cases.machines import sized_once
from sealscope.diagnosis.inference.blocks import Information
from sealscope.diagnosis.inference.onset import step_test
from sealscope.parameters import load_rig
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.simulate import simulate_with_truth

SECONDS, ONSET, UNIT = 180.0, 90.0, 1e-12
FAMILIES = (
    *("moving mass", "hoses", "mains hum", "slow sensors", "changing duty", "spring load"),
    "bristle friction",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("provider", choices=("ring_down", "response"))
    parser.add_argument("--machines", type=int, default=24)
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--leaks", type=float, nargs="+", default=[0.0, 0.0042])
    parser.add_argument("--families", action="store_true")
    parser.add_argument("--false-alarm", type=float, default=0.01)
    given = parser.parse_args()
    provider, rig = importlib.import_module(f"sealscope.diagnosis.{given.provider}"), load_rig("thesis")
    for lpm in given.leaks:
        found, silent, holds, dated, ratios, spent = 0, 0, 0, 0, [], []
        for number in range(given.machines):
            family = FAMILIES[number % len(FAMILIES)] if given.families else ""
            seed = 10_000 * given.seed + round(1e4 * lpm) * 100 + number
            machine = draw("strangers" if family else "bench", seed, duration=SECONDS, family=family)
            leak = f"{lpm:g} L/min {('laminar', 'orifice')[number % 2]} from {ONSET:g} s" if lpm else ()
            run = machine.experiment(seed=seed + 5, leak=leak)
            simulated = simulate_with_truth(replace(run, leaks=sized_once(run)))
            begun = time.process_time()
            evidence = provider.evidence(simulated.recording.only(("u", "p_A", "p_B")), rig)
            spent.append(time.process_time() - begun)
            if evidence is None:
                silent += 1
                continue
            moment, precision, vector = evidence.information[:3]
            test = step_test(Information(moment, UNIT**2 * precision, UNIT * vector))
            if test is None or test.chance >= given.false_alarm:
                continue
            found += 1
            flow, (low, high) = evidence.flow(*(UNIT * value for value in test.fitted))
            holds += low <= simulated.truth.mean_leak_lpm <= high
            dated += abs(test.onset().value - ONSET) <= SECONDS / len(moment)
            ratios.append(flow / lpm if lpm else np.nan)
        print(
            f"{lpm:g} L/min: {found} of {given.machines} found, {silent} silent; interval holds {holds}, dated within "
            f"a block {dated}; median of flow over truth {np.median(ratios) if lpm and ratios else np.nan:.2f}; "
            f"{np.median(spent):.2f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
