"""Verdicts from pressures and command on machines that they were developed on.

    python benchmarks/pressures.py --machines 24 --seed 91 --leaks 0 0.0042 0.05 0.5
    python benchmarks/pressures.py --machines 28 --seed 94 --families --leaks 0 0.0042
    python benchmarks/pressures.py --machines 8 --seed 91 --leaks 0 --fault "friction +20 %"

Machines of the profile `bench`, 180 s at 500 Hz, the leak by either law in turn from 90 s on, or a fault; `--families`:
of the development families of `unmodelled` in turn. Summaries of the
verdicts are counted. The time is that of a core.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace

import numpy as np
from tally import Tally, judge, print_heads, print_row

from sealscope.campaigns.cases.machines import size_leaks_on_short_run
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.simulate import simulate_experiment

SECONDS, ONSET = 180.0, 90.0
FAMILIES = (
    *("moving mass", "hoses", "mains hum", "slow sensors", "changing duty", "spring load"),
    "bristle friction",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=24)
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--leaks", type=float, nargs="+", default=[0.0, 0.0042])
    parser.add_argument("--fault", default="")
    parser.add_argument("--families", action="store_true")
    parser.add_argument("--false-alarm", type=float, default=0.01)
    given = parser.parse_args()
    print_heads("L/min, fault", "said", "s")
    for lpm in given.leaks:
        tally, said, spent = Tally(), Counter[str](), []
        for number in range(given.machines):
            family = FAMILIES[number % len(FAMILIES)] if given.families else ""
            seed = 10_000 * given.seed + round(1e4 * lpm) * 100 + number
            machine = draw("unmodelled" if family else "bench", seed, duration=SECONDS, family=family)
            leak = f"{lpm:g} L/min {('laminar', 'orifice')[number % 2]} from {ONSET:g} s" if lpm else ()
            fault = {"fault": f"{given.fault} from {ONSET:g} s"} if given.fault else {}
            run = machine.experiment(seed=seed + 5, leak=leak, **fault)
            simulated, begun = (
                simulate_experiment(replace(run, leaks=size_leaks_on_short_run(run))),
                time.process_time(),
            )
            evidence = judge(
                simulated.recording, "pressure response", channels="u,p_A,p_B", false_alarm=given.false_alarm
            )
            spent.append(time.process_time() - begun)
            said[evidence.summary] += 1
            tally.add(evidence, simulated.truth.mean_leak_lpm if lpm else None, ONSET if lpm else None)
        words = ", ".join(f"{count} {summary}" for summary, count in said.most_common())
        print_row(f"{lpm:g} {given.fault}", words, f"{np.median(spent):.2f}", *tally.cells())


if __name__ == "__main__":
    main()
