"""What `diagnose` or one detector says of the machines of packaged plans, from all channels or some.

    python benchmarks/plan_verdicts.py [--records 200] [--false-alarm 0.01] [--channels u,p_A,p_B]
        [--detector "volume balance"] [PLAN ...]

The records are the plan's own, each kind in its proportion. The verdict knows the channels and the rig as designed, not
the drawn machine, no onset, no size, no baseline. The bound is the median of what is stated; seconds are of one core, a
record.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict

import numpy as np
from tally import Tally, judge, print_heads, print_row

from sealscope.campaigns.cases.case import interleave_cases, list_cases
from sealscope.campaigns.cases.machines import case_experiment
from sealscope.campaigns.plans.reader import load_plan
from sealscope.diagnosis.detectors.registry import DETECTORS
from sealscope.errors import SealscopeError
from sealscope.simulation.simulate import simulate_experiment

PLANS = ("bench-detectors", "bench-unmodelled-development", "bench-closed-loop-development", "bench-load-development")
Kind = tuple[float, str]


def judge_plan(name: str, chosen: argparse.Namespace) -> dict[Kind, tuple[Tally, list[float]]]:
    """Judge the first records of a plan: what is stated and the seconds, by leak [L/min] and fault."""
    plan = load_plan(name)
    kinds: dict[Kind, tuple[Tally, list[float]]] = defaultdict(lambda: (Tally(), []))
    for case in interleave_cases(list_cases(plan))[: chosen.records]:
        try:
            simulated = simulate_experiment(case_experiment(plan, case))
        except SealscopeError as error:
            print(f"{case.id}: {error}")
            continue
        tally, seconds = kinds[case.leak_lpm, case.fault]
        started = time.process_time()
        statement = judge(
            simulated.recording, chosen.detector, rig=plan.rig, channels=chosen.channels, false_alarm=chosen.false_alarm
        )
        seconds.append(time.process_time() - started)
        leaks = bool(case.leak_lpm)
        tally.add(statement, simulated.truth.mean_leak_lpm if leaks else None, plan.onset_s if leaks else None)
    return kinds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plans", nargs="*", default=PLANS)
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--false-alarm", type=float, default=0.01)
    parser.add_argument("--channels", default="", help="channels, by commas (default: all)")
    parser.add_argument("--detector", default="diagnose", choices=("diagnose", *DETECTORS))
    chosen = parser.parse_args()
    print_heads("plan", "leak [L/min] or fault", "s")
    for name in chosen.plans:
        for (leak, fault), (tally, seconds) in sorted(judge_plan(name, chosen).items(), key=lambda item: item[0]):
            print_row(name, fault or f"{leak:g}", f"{np.median(seconds):.2f}", *tally.cells())


if __name__ == "__main__":
    main()
