"""What the balance finds on the machines of the packaged plans, circuit by circuit.

    python benchmarks/circuits.py [--count 20] [PLAN ...]

Each row: records judged, how many score as rarely as 1 % of healthy ones, the size over the true mean flow, and what
the balance knew of a machine: the rig as designed (never the drawn machine), no baseline.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from sealscope.campaigns.cases.case import CampaignCase, cases_of, interleave_cases
from sealscope.campaigns.cases.machines import experiment_of
from sealscope.campaigns.plans.reader import load_plan
from sealscope.diagnosis.inference.balance import blocks_of
from sealscope.diagnosis.inference.blocks import information, zero_of
from sealscope.diagnosis.inference.onset import step_test
from sealscope.errors import SealscopeError
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate_experiment
from sealscope.units import LITRE_PER_MINUTE

PLANS = ("bench-single-rod-development", "bench-closed-loop-development", "bench-load-development", "bench-valve")
#: Views: the channels a balance is judged without.
VIEWS = {"all channels": (), "speed": ("theta",), "command": ("theta", "omega")}
RARE = 0.01


def chosen(plan_name: str, count: int) -> Iterator[tuple[CampaignCase, Recording, float]]:
    """Yield cases of a plan, the same number of each kind, with their recordings and true mean flows [L/min]."""
    plan = load_plan(plan_name)
    taken: dict[tuple[float, str], int] = defaultdict(int)
    for case in interleave_cases(cases_of(plan)):
        kind = case.leak_lpm, case.fault
        if taken[kind] == count:
            continue
        taken[kind] += 1
        try:
            run = simulate_experiment(experiment_of(plan, case))
        except SealscopeError as error:
            print(f"{case.id}: {error}")
            continue
        yield case, run.recording, run.truth.mean_leak_lpm if case.leak_lpm else 0.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plans", nargs="*", default=PLANS)
    parser.add_argument("--count", type=int, default=5, help="records of each kind")
    arguments = parser.parse_args()
    print("plan | view | put in | records | rarer than 1 % | size over true flow, median (5 to 95 %)")
    for name in arguments.plans:
        rig = load_plan(name).rig
        rows: dict[tuple[str, float, str], list[tuple[bool, float]]] = defaultdict(list)
        for case, recording, flow in chosen(name, arguments.count):
            for view, dropped in VIEWS.items():
                if view != "all channels" and not set(dropped) <= set(recording.channels):
                    continue
                made = blocks_of(recording.only([own for own in recording.channels if own not in dropped]), rig)
                if made is None:
                    continue
                blocks, columns = made
                test = step_test(information(blocks, columns, columns[0].leak))
                if test is None:
                    continue
                after = np.where(blocks.time >= test.onsets[test.best], np.maximum(blocks.rows, 1e-9), 1e-9)
                size = test.fitted[0] * np.average(blocks.driving(zero_of(blocks, columns)), weights=after)
                ratio = size / LITRE_PER_MINUTE / flow if flow else np.nan
                rows[view, case.leak_lpm, case.fault].append((test.chance < RARE, ratio))
        for (view, leak, fault), results in sorted(rows.items()):
            ratios = np.array([ratio for _, ratio in results])
            spread = "" if not leak else "{:.2f} ({:.2f} to {:.2f})".format(*np.quantile(ratios, [0.5, 0.05, 0.95]))
            put_in = fault or (f"{leak:g} L/min" if leak else "nothing")
            print(
                f"{name} | {view} | {put_in} | {len(results)} | {sum(hit for hit, _ in results)} | {spread}", flush=True
            )


if __name__ == "__main__":
    main()
