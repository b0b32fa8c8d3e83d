"""Verdicts from pressures and command on machines that they were developed on.

    python benchmarks/pressures.py --machines 24 --seed 91 --leaks 0 0.0042 0.05 0.5
    python benchmarks/pressures.py --machines 28 --seed 94 --families --leaks 0 0.0042
    python benchmarks/pressures.py --machines 8 --seed 91 --leaks 0 --fault "friction +20 %"

Machines of the profile `bench`, 180 s at 500 Hz, the leak by either law in turn from 90 s on, or a fault; `--families`:
of the development families of `unmodelled` in turn. A machine counts as found where the verdict is `leak`; other
verdicts and causes are counted. The time is that of a core.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.campaigns.cases.machines import sized_once
from sealscope.diagnosis.diagnose import Examination
from sealscope.diagnosis.inference.pressures.evidence import PRIORS
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.simulate import simulate_experiment

SECONDS, ONSET = 180.0, 90.0
FAMILIES = (
    *("moving mass", "hoses", "mains hum", "slow sensors", "changing duty", "spring load"),
    "bristle friction",
)


class Answer(NamedTuple):
    """What is said of a record: whether there is a leak, flow with interval [L/min], onset [s], and in words."""

    leak: bool
    flow: float = np.nan
    interval: tuple[float, float] = (np.nan, np.nan)
    onset: float = np.nan
    words: str = ""


def answer(recording: Recording, rig: Rig, false_alarm: float) -> Answer:
    evidence = Examination(recording, false_alarm_probability=false_alarm, rig=rig).evidence("pressure response")
    if evidence.verdict != "leak":
        return Answer(False, words=evidence.summary)
    return Answer(True, evidence.leak_lpm, evidence.leak_interval_lpm, evidence.onset_s, evidence.summary)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=24)
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--leaks", type=float, nargs="+", default=[0.0, 0.0042])
    parser.add_argument("--fault", default="")
    parser.add_argument("--families", action="store_true")
    parser.add_argument("--false-alarm", type=float, default=0.01)
    given = parser.parse_args()
    rig = load_rig("thesis")
    for lpm in given.leaks:
        answers, holds, spent = [], 0, []
        for number in range(given.machines):
            family = FAMILIES[number % len(FAMILIES)] if given.families else ""
            seed = 10_000 * given.seed + round(1e4 * lpm) * 100 + number
            machine = draw("unmodelled" if family else "bench", seed, duration=SECONDS, family=family)
            leak = f"{lpm:g} L/min {('laminar', 'orifice')[number % 2]} from {ONSET:g} s" if lpm else ()
            fault = {"fault": f"{given.fault} from {ONSET:g} s"} if given.fault else {}
            run = machine.experiment(seed=seed + 5, leak=leak, **fault)
            simulated = simulate_experiment(replace(run, leaks=sized_once(run)))
            recording, begun = simulated.recording.only(("u", "p_A", "p_B")), time.process_time()
            answers.append(answer(recording, rig, given.false_alarm))
            spent.append(time.process_time() - begun)
            low, high = answers[-1].interval
            holds += bool(lpm) and low <= simulated.truth.mean_leak_lpm <= high
        detected = [answer for answer in answers if answer.leak]
        dated = sum(abs(answer.onset - ONSET) <= SECONDS / PRIORS["blocks"]["most"] for answer in detected)
        ratio = np.median([answer.flow / lpm for answer in detected]) if lpm and detected else np.nan
        print(
            f"{lpm:g} L/min {given.fault}: {len(detected)} of {given.machines} a leak; interval holds {holds}, dated "
            f"within a block {dated}; median of flow over truth {ratio:.2f}; {np.median(spent):.2f} s; "
            f"{dict(Counter(answer.words for answer in answers))}",
            flush=True,
        )


if __name__ == "__main__":
    main()
