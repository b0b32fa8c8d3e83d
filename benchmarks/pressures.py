"""Verdicts from pressures and command on machines that they were developed on.

    python benchmarks/pressures.py --machines 24 --seed 91 --leaks 0 0.0042 0.05 0.5
    python benchmarks/pressures.py --machines 28 --seed 94 --families --leaks 0 0.0042
    python benchmarks/pressures.py --machines 8 --seed 91 --leaks 0 --fault "friction +20 %"
    python benchmarks/pressures.py --machines 16 --seed 95 --days 5 --leaks 0 0.0042 0.02 0.1

Machines of the profile `bench`, 180 s at 500 Hz, the leak by either law in turn from 90 s on, or a fault; `--families`:
of the development families of `unmodelled` in turn. `--days N`: N healthy recordings of 60 s are known, each of another
day with other oil, and the leak is there from the start of a further one. Summaries of the verdicts are counted. The
time is that of a core.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from tally import Tally, judge, print_heads, print_row

import sealscope as ss
from sealscope.campaigns.cases.machines import size_leaks_on_short_run
from sealscope.diagnosis.commissioned.machine import summarise_healthy
from sealscope.parameters import load_rig
from sealscope.simulation.bench.machines import BenchMachine, draw
from sealscope.simulation.simulate import Run, simulate_experiment

SECONDS, ONSET = 180.0, 90.0
FAMILIES = (
    *("moving mass", "hoses", "mains hum", "slow sensors", "changing duty", "spring load"),
    "bristle friction",
)


def on_day(machine: BenchMachine, day: int, **arguments: Any) -> Run:
    """Simulate 60 s of a machine on a day; its oil is warmer or colder by some 7 K than that of others."""
    random = np.random.default_rng([machine.seed, day])
    thinner = 2.0 ** (random.normal(0.0, 7.0) / 15.0)
    rig = machine.rig.with_overrides(machine.overrides, source="the machine")
    oil = {
        "pump.G_pump": rig.pump.G_pump * thinner,
        "friction.F_v": rig.friction.F_v / thinner**0.3,  # most of it is that of the seals
        "fluid.K_oil": rig.fluid.K_oil * (1.0 + 0.05 * random.normal()),
    }
    own = replace(machine, overrides={**machine.overrides, **oil}, duration=60.0)
    run = own.experiment(seed=machine.seed + 100 * day, **arguments)
    simulated = simulate_experiment(replace(run, leaks=size_leaks_on_short_run(run)))
    dated = {**simulated.recording.provenance, "start": f"2026-03-{1 + day:02d}T08:00:00"}
    return replace(simulated, recording=replace(simulated.recording.only(["u", "p_A", "p_B"]), provenance=dated))


def judge_by_days(given: argparse.Namespace) -> None:
    """Print what a machine's file of several days says of a further day."""
    rig = load_rig("thesis")
    tallies = {lpm: (Tally(), Counter[str]()) for lpm in given.leaks}
    for number in range(given.machines):
        family = FAMILIES[number % len(FAMILIES)] if given.families else ""
        seed = 10_000 * given.seed + number
        machine = draw("unmodelled" if family else "bench", seed, duration=60.0, family=family)
        known = [on_day(machine, day).recording for day in range(given.days)]
        healthy = tuple(summarise_healthy(recording, rig, f"day{k}") for k, recording in enumerate(known))
        commissioned = ss.CommissionedMachine("machine", healthy, rig)
        for lpm, (tally, said) in tallies.items():
            leak = {"leak": f"{lpm:g} L/min {('laminar', 'orifice')[number % 2]}"} if lpm else {}
            simulated = on_day(machine, given.days, **leak)
            verdict = commissioned.diagnose(simulated.recording)
            said[verdict.summary] += 1
            tally.add(verdict, simulated.truth.mean_leak_lpm if lpm else None)
    print_heads("L/min, from the start", "said")
    for lpm, (tally, said) in tallies.items():
        words = ", ".join(f"{count} {summary}" for summary, count in said.most_common())
        print_row(f"{lpm:g}", words, *tally.cells())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=24)
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--leaks", type=float, nargs="+", default=[0.0, 0.0042])
    parser.add_argument("--fault", default="")
    parser.add_argument("--families", action="store_true")
    parser.add_argument("--false-alarm", type=float, default=0.01)
    parser.add_argument("--days", type=int, metavar="N", help="healthy days that are known")
    given = parser.parse_args()
    if given.days:
        judge_by_days(given)
        return
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
