"""Batches on a GPU, beside the same batches on the processor and a CUDA C++ program of one thread a run.

    python benchmarks/bench_gpu.py [--runs 100000] [--duration 180] [--rounds 3] [--json FILE]

Prints for the rig without and with throttles the seconds by the clock of a whole batch on the GPU (all our own Python,
instruments, db8 details and their RMS in both halves included; the runs have a hundred rigs and seeds of their own),
how far it is from the processor's on some of the runs, what the processor takes for these, and the seconds of the CUDA
C++ program (peers/rk4.cu, built with nvcc where there is one; integration alone, Runge-Kutta at 1e-4 s, without
throttles, where it is stable). Compilation is not timed. Without a GPU it says so and measures nothing.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_solvers import CASES, FREQUENCY, PEERS, RATE, Case, ours, quartiles, rms, write

from sealscope.errors import InputError
from sealscope.simulation.batch.batch import runner_of, simulate_batch
from sealscope.simulation.experiment import Experiment

#: Most seconds that 100 000 runs of 180 s may take, by case.
PROMISED = {CASES[0].name: 5.0, CASES[2].name: 15.0}
RIGS, COMPARED, PEER_STEP = 100, 256, 1e-4
#: Rms difference [Pa] in p_A over 5 s up to which the peer integrates the same rig.
SAME = 2.0


def experiments(case: Case, count: int, duration: float) -> list[Experiment]:
    """Runs of a case that differ in their friction, oil and noise; the step is chosen by error."""
    base = case.rig()
    shares = np.random.default_rng(1).uniform(0.9, 1.1, (RIGS, 2))
    rigs = [
        base.with_overrides({"friction.F_v": base.friction.F_v * a, "fluid.K_oil": base.fluid.K_oil * b})
        for a, b in shares.tolist()
    ]
    first = Experiment.of(rig=base, command=f"{case.amplitude} sin({FREQUENCY}t)", duration=duration)
    return [replace(first, rig=rigs[seed % RIGS], seed=seed) for seed in range(count)]


def built(folder: Path) -> Path | None:
    """The CUDA C++ program, where it can be built."""
    if shutil.which("nvcc") is None:
        print("CUDA C++ left out: no nvcc")
        return None
    program = folder / "rk4_gpu"
    call = ["nvcc", "-O3", "-arch=native", "-o", str(program), str(PEERS / "rk4.cu")]
    made = subprocess.run(call, capture_output=True, text=True, check=False)
    if made.returncode != 0:
        print(f"CUDA C++ left out: {(made.stderr.splitlines() or ['it cannot be built'])[0]}")
        return None
    return program


def theirs(program: Path, case: Case, count: int, duration: float) -> tuple[float, np.ndarray]:
    """Seconds that the CUDA C++ program takes for `count` runs, and (n, 3) x, p_A, p_B of the first."""
    file = program.with_suffix(".rows")
    call = [str(program), str(count), *case.words(), str(duration), repr(PEER_STEP), str(RATE), str(file)]
    told = subprocess.run(call, check=True, capture_output=True, text=True)
    return float(told.stdout.split()[0]), np.fromfile(file).reshape(-1, 3)


def timed(runs: list[Experiment], device: str) -> tuple[float, np.ndarray]:
    """Seconds by the clock that a batch takes, and its RMS."""
    start = time.perf_counter()
    batch = simulate_batch(runs, device=device)
    return time.perf_counter() - start, batch.rms


def measure(case: Case, program: Path | None, chosen: argparse.Namespace) -> dict[str, Any]:
    """The figures of a case, the devices in turn."""
    runs = experiments(case, chosen.runs, chosen.duration)
    few = runs[: min(COMPARED, len(runs))]
    timed(few, "gpu")  # compiles
    timed(few[:8], "cpu")
    rows, peer = [], []
    for _ in range(chosen.rounds):
        gpu, found = timed(runs, "gpu")
        cpu, expected = timed(few, "cpu")
        rows.append((gpu, cpu / len(few) * len(runs)))
        if program is not None and case.closed is None:
            peer.append(theirs(program, case, chosen.runs, chosen.duration)[0])
    figures: dict[str, Any] = {
        "gpu": quartiles(np.array(rows)[:, 0]),
        "cpu": quartiles(np.array(rows)[:, 1]),
        "difference": float(np.abs(found[: len(few)] / expected - 1.0).max()),
        "peer": quartiles(np.array(peer)) if peer else None,
    }
    if peer and program is not None:
        figures["peer_difference_pa"] = rms(
            theirs(program, case, 1, 5.0)[1][:, 1] - ours(case, "rk4", 1e-4, 5.0)()[1][:, 1]
        )
        if not figures["peer_difference_pa"] <= SAME:
            raise SystemExit(
                f"{case.name}: CUDA C++ must agree within {SAME} Pa rms: {figures['peer_difference_pa']:g}"
            )
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--duration", type=float, default=180.0, help="simulated seconds")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    chosen = parser.parse_args()
    try:
        runner_of("gpu")
    except InputError as missing:
        print(f"no GPU: not measured ({missing})")
        return
    figures: dict[str, Any] = {"runs": chosen.runs, "duration": chosen.duration, "cases": {}}
    print(f"{chosen.runs} runs of {chosen.duration:g} s; seconds by the clock, median (25 % .. 75 %) of "
          f"{chosen.rounds} rounds; the processor's from {min(COMPARED, chosen.runs)} runs")  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        program = built(Path(folder))
        for case in (CASES[0], CASES[2]):
            one = figures["cases"][case.name] = measure(case, program, chosen)
            print(f"{case.name}: promised for 100000 runs of 180 s at most {PROMISED[case.name]:g} s")
            for name in ("gpu", "cpu", "peer"):
                if one[name]:
                    m, a, b = one[name]
                    print(f"  {name:<6}{m:10.2f} ({a:.2f} .. {b:.2f})", flush=True)
            print(f"  largest relative difference of an RMS, gpu and cpu: {one['difference']:.2g}")
    if chosen.json:
        write(chosen.json, figures)


if __name__ == "__main__":
    main()
