"""Runs side by side, instruments and statistics included, against scalar C++ at the same scheme and step.

    python benchmarks/bench_batch.py [--runs 256] [--duration 180] [--rounds 3] [--threads N] [--json FILE]

Builds the C++ programs of `benchmarks/peers`, checks that one run of the batch has the C++ program's pressures, and
prints for each rig and step the processor seconds for each run: of the batch (integration, instruments, db8 details and
their RMS in both halves), and of the C++ program (integration alone), in turn; their ratio with its middle half; and
how much of the wanted speed-up the threads give. Then the growth of the batch's time with the number of runs, with the
length of the runs and with the threads, each with its fitted exponent. Compilation is not timed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_solvers import CASES, FREQUENCY, RATE, Case, build, quartiles, rms, theirs, write

from sealscope.simulation.batch.batch import simulate_batch
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

PROMISED = 0.35
#: Rig, peer and steps [s].
MEASURED = ((CASES[0], "C++ RK4", (1e-3, 5e-4, 1e-4)), (CASES[2], "C++ IMEX", (1e-3, 5e-4)))
#: What growth is fitted over.
RUNS, LENGTHS = (256, 512, 1024, 2048), (180.0, 360.0, 720.0, 1440.0)


def experiments(case: Case, count: int, duration: float, step: float) -> list[Experiment]:
    """`count` runs of a case that differ in their noise."""
    words = f"{case.amplitude} sin({FREQUENCY}t)"
    first = Experiment.of(rig=case.rig(), command=words, duration=duration, step=step)
    return [replace(first, seed=seed) for seed in range(count)]


def timed(runs: list[Experiment], threads: int) -> tuple[float, float]:
    """Processor seconds and seconds by the clock that a batch takes."""
    processor, clock = time.process_time(), time.perf_counter()
    simulate_batch(runs, threads=threads)
    return time.process_time() - processor, time.perf_counter() - clock


def same_run(case: Case, program: Path, step: float) -> float:
    """Rms difference [Pa] in p_A of the C++ program from the run that the batch is tested against, over 5 s."""
    one = replace(experiments(case, 1, 5.0, step)[0], allow_unresolved=True)  # its details are not measured here
    ours = simulate_experiment(one).truth.outputs["p_A"]
    difference = rms(theirs(program, case, step, 5.0)()[1][:, 1] - ours)
    if not difference < 1.0:
        raise SystemExit(f"{case.name}: the C++ program and ours must agree within 1 Pa rms, got {difference:.3g} Pa")
    return difference


def compare(case: Case, program: Path, step: float, options: argparse.Namespace) -> dict[str, Any]:
    """Processor seconds a run of both, in turn, and their ratio."""
    runs = experiments(case, options.runs, options.duration, step)
    peer = theirs(program, case, step, options.duration)
    difference = same_run(case, program, step)
    timed(runs[:16], 1)
    rows = []
    for _ in range(options.rounds):
        processor, clock = timed(runs, options.threads)
        rows.append((processor / len(runs), clock / len(runs), min(peer()[0] for _ in range(3))))
    ours, by_clock, other = np.array(rows).T
    return {
        "difference_pa": difference,
        "ours": quartiles(ours),
        "by_clock": quartiles(by_clock),
        "peer": quartiles(other),
        "ratio": quartiles(ours / other),
    }


def exponent(sizes: Any, seconds: Any) -> tuple[float, float]:
    """Exponent of growth and its standard error, from a straight line through the logarithms."""
    x, y = np.log(np.asarray(sizes, dtype=float)), np.log(np.asarray(seconds, dtype=float))
    (slope, start), rest = np.polyfit(x, y, 1), 0.0
    if len(x) > 2:
        rest = float(np.sqrt(np.sum((y - slope * x - start) ** 2) / (len(x) - 2) / np.sum((x - x.mean()) ** 2)))
    return float(slope), rest


def growth(case: Case, rounds: int) -> dict[str, Any]:
    """Processor seconds against number and length of runs, seconds by the clock against threads."""
    step = 1e-3
    timings: dict[str, Any] = {}
    by_runs = [min(timed(experiments(case, n, 20.0, step), 1)[0] for _ in range(rounds)) for n in RUNS]
    timings["runs"] = {"sizes": RUNS, "seconds": by_runs, "exponent": exponent(RUNS, by_runs)}
    by_length = [min(timed(experiments(case, 32, length, step), 1)[0] for _ in range(rounds)) for length in LENGTHS]
    timings["run length [s]"] = {"sizes": LENGTHS, "seconds": by_length, "exponent": exponent(LENGTHS, by_length)}
    cores = [n for n in (1, 2, 4, 8, 16, 32) if n <= (os.cpu_count() or 1)]
    batch = experiments(case, 256, 20.0, step)
    by_cores = [min(timed(batch, n)[1] for _ in range(rounds)) for n in cores]
    timings["threads (by the clock)"] = {"sizes": cores, "seconds": by_cores, "exponent": exponent(cores, by_cores)}
    return timings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=256)
    parser.add_argument("--duration", type=float, default=180.0, help="simulated seconds")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    chosen = parser.parse_args()
    figures: dict[str, Any] = {"runs": chosen.runs, "duration": chosen.duration, "threads": chosen.threads, "cases": {}}
    print(f"{chosen.runs} runs of {chosen.duration:g} s, samples at {RATE:g} Hz, {chosen.threads} threads; "
          f"processor milliseconds a run, median (25 % .. 75 %) of {chosen.rounds} rounds")  # fmt: skip
    print(f"{'rig, scheme, step':<44}{'batch with statistics':>26}{'C++, integration':>26}{'ratio':>26}")
    with tempfile.TemporaryDirectory() as folder:
        peers = build(Path(folder))
        for case, name, steps in MEASURED:
            for step in steps if name in peers else ():
                one = compare(case, peers[name], step, chosen)
                label = f"{case.name}, {name[4:]}, {step:g} s"
                figures["cases"][label] = one
                cells = [f"{1e3 * m:.2f} ({1e3 * a:.2f} .. {1e3 * b:.2f})" for m, a, b in (one["ours"], one["peer"])]
                m, a, b = one["ratio"]
                print(f"{label:<44}{cells[0]:>26}{cells[1]:>26}{f'{m:.3f} ({a:.3f} .. {b:.3f})':>26}", flush=True)
    print(f"promised: a ratio of at most {PROMISED:g}")
    figures["growth"] = growth(CASES[0], chosen.rounds)
    print("\ngrowth (no throttles, h = 1e-3 s): seconds, and exponent of a fit")
    for name, one in figures["growth"].items():
        cells = ", ".join(
            f"{size:g}: {seconds:.3f}" for size, seconds in zip(one["sizes"], one["seconds"], strict=True)
        )
        print(f"{name:<24}{one['exponent'][0]:6.3f} +- {one['exponent'][1]:.3f}   {cells}")
    if chosen.json:
        write(chosen.json, figures)


if __name__ == "__main__":
    main()
