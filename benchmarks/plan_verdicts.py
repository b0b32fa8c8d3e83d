"""What `diagnose` says of the machines of packaged plans from all channels or some: a part of each kind of record.

    python benchmarks/plan_verdicts.py [--records 200] [--false-alarm 0.01] [--channels u,p_A,p_B] [PLAN ...]

The records are the plan's own, each kind in its proportion. The verdict knows the channels and the rig as designed, not
the drawn machine, no onset, no size, no baseline. "Interval", "onset": how many of the stated 95 % intervals hold the
true mean flow, and the true onset; "bound": median of what is stated with `no leak`; seconds of one core a record.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from sealscope.campaigns.cases.case import cases_of, interleave_cases
from sealscope.campaigns.cases.machines import experiment_of
from sealscope.campaigns.plans.reader import load_plan
from sealscope.diagnosis.diagnose import diagnose
from sealscope.simulation.simulate import simulate_experiment

PLANS = ("bench-detectors", "bench-unmodelled-development", "bench-closed-loop-development", "bench-load-development")


@dataclass
class Kind:
    """What was said of the records of one kind."""

    verdicts: list[str] = field(default_factory=list)
    intervals: list[bool] = field(default_factory=list)
    onsets: list[bool] = field(default_factory=list)
    bounds: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def judged(plan_name: str, records: int, false_alarm: float, channels: str) -> dict[tuple[float, str], Kind]:
    """Return what is said of the first records of a plan, by leak [L/min] and fault."""
    plan = load_plan(plan_name)
    kinds: dict[tuple[float, str], Kind] = defaultdict(Kind)
    for case in interleave_cases(cases_of(plan))[:records]:
        simulated = simulate_experiment(experiment_of(plan, case))
        kind, started = kinds[case.leak_lpm, case.fault], time.process_time()
        viewed = simulated.recording.only(channels.split(",")) if channels else simulated.recording
        verdict = diagnose(viewed, rig=plan.rig, false_alarm_probability=false_alarm)
        kind.seconds.append(time.process_time() - started)
        kind.verdicts.append(verdict.verdict)
        if verdict.bound_lpm is not None:
            kind.bounds.append(verdict.bound_lpm)
        if verdict.verdict == "leak" and case.leak_lpm and verdict.leak_interval_lpm and verdict.onset_interval_s:
            low, high = verdict.leak_interval_lpm
            kind.intervals.append(low <= simulated.truth.mean_leak_lpm <= high)
            first, last = verdict.onset_interval_s
            kind.onsets.append(first <= plan.onset_s <= last)
    return kinds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plans", nargs="*", default=PLANS)
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--false-alarm", type=float, default=0.01)
    parser.add_argument("--channels", default="", help="Channels, by commas (default: all).")
    options = parser.parse_args()
    print("| plan | leak [L/min] or fault | `leak` | `cannot tell` | interval | onset | bound [L/min] | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in options.plans:
        for (leak, fault), kind in sorted(judged(name, options.records, options.false_alarm, options.channels).items()):
            count, unsure = (kind.verdicts.count(own) for own in ("leak", "cannot tell"))
            number = len(kind.verdicts)
            hold = (f"{sum(own)} of {len(own)}" if own else "" for own in (kind.intervals, kind.onsets))
            bound = f"{np.median(kind.bounds):.2g}" if kind.bounds else ""
            what = fault or f"{leak:g}"
            cells = (name, what, f"{count} of {number}", unsure, *hold, bound, f"{np.median(kind.seconds):.2f}")
            print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


if __name__ == "__main__":
    main()
