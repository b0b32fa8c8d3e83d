"""Measure the false-alarm rate and the detection rate of a detector on simulated records with fresh noise.

    python benchmarks/false_alarms.py [--records 100] [--leaky 20] [--probability 0.01] [--duration 180] [--seed 0]
        [--detector "rms change"] [--json FILE]

`--detector diagnose` is the verdict of all detectors together.
Each case (command, throttles, leak) is integrated once; its instruments are read once a record, each time with noise
of a seed of its own, derived from the case. A rate stands with its 95 % Clopper-Pearson interval; `onset` is the share
of the alarms within 10 s of the truth.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sealscope.diagnosis.detectors.registry import DETECTORS
from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY, Examination
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import record
from sealscope.simulation.integrate import oversampling, sized_leaks, trajectory

COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)")
LEAKS = (0.0042, 0.015)
THROTTLED = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
NEAR = 10.0


@dataclass
class Count:
    """Verdicts on the records of one case; `near`: alarms within 10 s of the onset."""

    records: int = 0
    leak: int = 0
    no_leak: int = 0
    cannot_tell: int = 0
    near: int = 0

    def __add__(self, other: Count) -> Count:
        return Count(*(a + b for a, b in zip(asdict(self).values(), asdict(other).values(), strict=True)))


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval of a binomial share (Clopper and Pearson, Biometrika 26 (1934) 404-413)."""
    from scipy.special import betaincinv

    tail = (1.0 - confidence) / 2.0
    low = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1, tail))
    high = 1.0 if successes == trials else float(betaincinv(successes + 1, trials - successes, 1.0 - tail))
    return low, high


def seeds(case: str, base: int, count: int) -> list[int]:
    """`count` seeds that depend on the case and on `base` alone."""
    state = np.random.SeedSequence([base, zlib.crc32(case.encode())]).generate_state(count, np.uint32)
    return [int(seed) for seed in state]


def records_of(
    command: str, throttled: bool, leak_lpm: float, duration: float, base: int, count: int
) -> Iterator[Recording]:
    """`count` records of one case, equal but for the noise; the leak opens half-way."""
    experiment = Experiment.of(
        command=command,
        duration=duration,
        leak=f"{leak_lpm:g} L/min from {duration / 2:g} s" if leak_lpm else None,
        set=THROTTLED if throttled else None,
    )
    path = trajectory(experiment, sized_leaks(experiment))
    volts, factor = experiment.command.volts(experiment.sample_times()), oversampling(experiment)
    for seed in seeds(f"{command} {throttled} {leak_lpm:g} {duration:g}", base, count):
        yield record(experiment.rig, path, volts, factor, seed)


def judge(records: Iterator[Recording], detector: str, probability: float, onset: float | None) -> Count:
    """A detector's verdicts (`diagnose`: of all together) on some records, and how many alarms lie near the onset."""
    count = Count()
    for one in records:
        examination = Examination(one, false_alarm_probability=probability)
        statement = examination.fused() if detector == "diagnose" else examination.evidence(detector)
        count.records += 1
        count.leak += statement.verdict == "leak"
        count.no_leak += statement.verdict == "no leak"
        count.cannot_tell += statement.verdict == "cannot tell"
        count.near += onset is not None and statement.onset_s is not None and abs(statement.onset_s - onset) <= NEAR
    return count


def row(name: str, count: Count) -> str:
    """One line of the table."""
    low, high = clopper_pearson(count.leak, count.records)
    near = f"{count.near}/{count.leak}" if count.near or not name.startswith("none") else ""
    return (
        f"{name:<34}{count.records:>8}{count.leak:>6}{count.no_leak:>9}{count.cannot_tell:>13}"
        f"{100 * count.leak / count.records:>9.1f} % ({100 * low:5.1f} .. {100 * high:5.1f}){near:>10}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=100, help="leak-free records a case")
    parser.add_argument("--leaky", type=int, default=20, help="records a case and leak")
    parser.add_argument("--probability", type=float, default=FALSE_ALARM_PROBABILITY)
    parser.add_argument("--duration", type=float, default=180.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--detector", default="rms change", choices=("diagnose", *DETECTORS))
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    if min(chosen.records, chosen.leaky) < 1:
        parser.error("--records and --leaky must be 1 or more")

    start = time.perf_counter()
    print(
        f"{chosen.detector} at a nominal {100 * chosen.probability:g} %, records of {chosen.duration:g} s, no baseline"
    )
    heads = f"{'records':>8}{'leak':>6}{'no leak':>9}{'cannot tell':>13}{'alarms (95 %)':>27}{'onset':>10}"
    print(f"{'leak [L/min], command, throttles':<34}{heads}")
    totals: dict[str, Count] = {}
    rows: dict[str, Count] = {}
    for leak in (0.0, *LEAKS):
        kind = f"{leak:g}" if leak else "none"
        for throttled in (False, True):
            total = f"{kind}, all, {'half closed' if throttled else 'none'}"
            for command in COMMANDS:
                name = f"{kind}, {command}, {'half closed' if throttled else 'none'}"
                count = chosen.leaky if leak else chosen.records
                records = records_of(command, throttled, leak, chosen.duration, chosen.seed, count)
                rows[name] = judge(records, chosen.detector, chosen.probability, chosen.duration / 2 if leak else None)
                totals[total] = totals.get(total, Count()) + rows[name]
                print(row(name, rows[name]), flush=True)
    print()
    for name, count in totals.items():
        print(row(name, count))
    clean = sum((count for name, count in totals.items() if name.startswith("none")), Count())
    leaky = sum((count for name, count in totals.items() if not name.startswith("none")), Count())
    print(f"\n{'detector':<34}{'false alarms':>20}{'leaks found':>20}")
    for name, false, detected in (
        (chosen.detector, clean.leak, leaky.leak),
        ("always fires", clean.records, leaky.records),
        ("never fires", 0, 0),
    ):
        print(f"{name:<34}{f'{false}/{clean.records}':>20}{f'{detected}/{leaky.records}':>20}")
    print(f"{time.perf_counter() - start:.0f} s")
    if chosen.json:
        partial = chosen.json.with_name(chosen.json.name + ".partial")
        partial.write_text(json.dumps({name: asdict(count) for name, count in rows.items()}, indent=2) + "\n")
        partial.replace(chosen.json)


if __name__ == "__main__":
    main()
