"""Verdicts on fixed bench records, and how they differ from those of another state of the source.

    python benchmarks/verdicts.py INTO.jsonl [--against BEFORE.jsonl] [--records FOLDER]

Takes the first cases of the plan `bench-detectors`: 64 leak-free records, 16 of each size, 10 of each fault (198 in
all), and diagnoses each with all channels and with pressures and command alone. One JSON line a diagnosis: that of the
public contract without the findings, and `tag`. With --against, prints every verdict, cause and L/min that differs, and
how far scores and thresholds moved. --records keeps the simulated records, so that both states judge the same bytes.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import sealscope as ss
from sealscope.campaigns.cases.case import CampaignCase, list_cases
from sealscope.campaigns.cases.machines import case_experiment
from sealscope.campaigns.plans.reader import load_plan
from sealscope.simulation.simulate import simulate_experiment

HEALTHY, SIZE, FAULT = 64, 16, 10
VIEWS = {"all": None, "pressures": {"u", "p_A", "p_B"}}


def chosen_cases() -> Iterator[CampaignCase]:
    """Yield the first cases of each kind of record."""
    taken: Counter[tuple[float, str]] = Counter()
    for case in list_cases(load_plan("bench-detectors")):
        kind = (case.leak_lpm, case.fault)
        most = FAULT if case.fault else SIZE if case.leak_lpm else HEALTHY
        if taken[kind] < most:
            taken[kind] += 1
            yield case


def recording_of(case: CampaignCase, folder: Path | None) -> ss.Recording:
    """Return the record of a case, from the folder where it was kept."""
    file = None if folder is None else folder / f"{case.id}.nc"
    if file is not None and file.is_file():
        return ss.read(file)
    recording = simulate_experiment(case_experiment(load_plan("bench-detectors"), case)).recording
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        ss.write(recording, file)
    return recording


def diagnoses(folder: Path | None) -> Iterator[dict[str, Any]]:
    """Yield every diagnosis as plain values."""
    for case in chosen_cases():
        recording = recording_of(case, folder)
        for view, channels in VIEWS.items():
            channels_of_view = recording if channels is None else recording.only(channels & set(recording.channels))
            tree = ss.diagnose(channels_of_view, rig="thesis").as_dict()  # stated, so that L/min is compared
            del tree["quality"], tree["file"]
            yield {"tag": f"{case.id} {case.leak_lpm} L/min {case.fault} {view}", **tree}


def compare(before: dict[str, dict[str, Any]], after: dict[str, dict[str, Any]]) -> None:
    """Print what differs between two sets of diagnoses, by tag."""
    both = sorted(before.keys() & after.keys())
    print(f"{len(both)} diagnoses in both, {len(before.keys() ^ after.keys())} in one of them only")
    for key in ("verdict", "cause"):
        pairs = [(tag, before[tag][key], after[tag][key]) for tag in both if before[tag][key] != after[tag][key]]
        print(f"{key}: {len(pairs)} differ", *(f"  {tag}: {old} -> {new}" for tag, old, new in pairs), sep="\n")
    for key in ("score", "threshold", "leak_lpm", "onset_s"):
        pairs = [(before[tag][key], after[tag][key]) for tag in both]
        change = [abs(new / old - 1.0) for old, new in pairs if old and new]
        lost = sum((old is None) != (new is None) for old, new in pairs)
        print(f"{key}: relative change at most {max(change, default=0):.2g}, median {np.median(change or [0]):.2g}")
        if lost:
            print(f"  stated in one of the two only: {lost}")


def main() -> None:
    """Diagnose, write, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("into", type=Path)
    parser.add_argument("--against", type=Path, help="File of an earlier run.")
    parser.add_argument("--records", type=Path, help="Folder of the simulated records.")
    arguments = parser.parse_args()
    after = {}
    with arguments.into.open("w", encoding="utf-8") as file:
        for tree in diagnoses(arguments.records):
            after[tree["tag"]] = tree
            print(json.dumps(tree), file=file, flush=True)
    if arguments.against:
        lines = arguments.against.read_text(encoding="utf-8").splitlines()
        compare({tree["tag"]: tree for tree in map(json.loads, lines)}, after)


if __name__ == "__main__":
    main()
