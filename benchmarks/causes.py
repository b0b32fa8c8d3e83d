"""What else than a leak: the cause that a diagnosis names for each fault, on machines of four rigs.

    python benchmarks/causes.py [--count 4] [--seed 1] [--plans NAME ...] [--views all command] [--records FOLDER]

Machines are drawn from the packaged plans of each rig, with their duties; each recording has a duration of 60 to 180 s
and an onset of its own. A diagnosis knows the rig as designed, neither machine nor onset, and has no baseline. Each
row: verdicts, causes, and how many name the one that was put in. A fault that a set of channels cannot show counts as
missed. `--seed` draws, so that rows can be judged on others than those that they were developed on. `--records` keeps
the simulated records.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import sealscope as ss
from sealscope.campaigns.cases.case import CampaignCase, interleave_cases, list_cases
from sealscope.campaigns.cases.machines import case_experiment
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.reader import load_plan
from sealscope.simulation.simulate import simulate_experiment

PLANS = ("bench-detectors", "bench-closed-loop-development", "bench-single-rod-development", "bench-valve")
VIEWS: dict[str, tuple[str, ...] | None] = {"all": None, "command": ("u", "p_A", "p_B")}
OUTSIDE = ("piston or external leak", "piston, pump or external leak")
LEAKS = ("piston leak", "piston or pump leak", *OUTSIDE)
#: Fault -> causes that name it. The empty fault is a healthy machine.
FAULTS: dict[str, tuple[str | None, ...]] = {
    "": (None,),
    "leak": LEAKS,
    "pump leak x3": ("pump leak", "piston or pump leak", "piston, pump or external leak"),
    "rod seal A 0.01 L/min": ("external leak", *OUTSIDE),
    "rod seal B 0.01 L/min": ("external leak", *OUTSIDE),
    "friction +20 %": ("friction change",),
    "air 1 %": ("air in the oil",),
    "sensor p_A offset 5 psi": ("sensor fault",),
    "sensor p_A gain 2 %": ("sensor fault",),
    "duty amplitude x1.1": ("changed duty",),
}
#: Leak that stands beside the faults [L/min].
LEAK = 0.05


def machines(name: str, count: int, seed: int) -> Iterator[tuple[SimulatedPlan, CampaignCase]]:
    """Draw machines of a plan, healthy as they are, each with a duration and an onset of its own."""
    plan, random = load_plan(name), np.random.default_rng(seed)
    assert isinstance(plan, SimulatedPlan)
    cases = [case for case in interleave_cases(list_cases(plan)) if not case.leak_lpm and not case.fault]
    for k in random.permutation(len(cases))[:count]:
        duration = float(random.integers(60, 181))
        onset = round(float(random.uniform(0.3, 0.7)) * duration, 1)
        yield replace(plan, duration_s=duration, onset_s=onset), cases[k]


def recording_of(plan: SimulatedPlan, case: CampaignCase, fault: str, folder: Path | None) -> ss.Recording:
    """Return a machine's record with a fault, kept in a folder."""
    name = f"{plan.name}-{case.id}-{plan.duration_s:g}-{plan.onset_s:g}-{fault}.nc".replace(" ", "_").replace("/", "-")
    path = None if folder is None else folder / name
    if path is not None and path.exists():
        return ss.read(path)
    own = replace(case, leak_lpm=LEAK) if fault == "leak" else replace(case, fault=fault)
    recording = simulate_experiment(case_experiment(plan, own)).recording
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        ss.write(recording, path)
    return recording


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plans", nargs="+", default=PLANS)
    parser.add_argument("--views", nargs="+", choices=VIEWS, default=list(VIEWS))
    parser.add_argument("--faults", nargs="+", default=list(FAULTS))
    parser.add_argument("--records", type=Path)
    given = parser.parse_args()
    for name in given.plans:
        for fault in given.faults:
            records = [
                (plan, recording_of(plan, case, fault, given.records))
                for plan, case in machines(name, given.count, given.seed)
            ]
            for view in given.views:
                channels = VIEWS[view]
                verdicts, right = Counter[str](), 0
                for plan, recording in records:
                    shown = recording if channels is None else recording.only(channels)
                    diagnosis = ss.diagnose(shown, rig=plan.rig)
                    verdicts[f"{diagnosis.verdict}: {diagnosis.cause}"] += 1
                    right += diagnosis.cause in FAULTS[fault]
                listed = ", ".join(f"{count} {text}" for text, count in verdicts.most_common())
                print(f"{name} | {fault or 'healthy'} | {view} | {right} of {len(records)} | {listed}", flush=True)


if __name__ == "__main__":
    main()
