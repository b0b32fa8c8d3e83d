"""Streaming over many actuators against PyWavelets' batch transform, in turn, in processor time.

    python benchmarks/bench_streams.py [--rounds 7] [--json FILE]

Prints, for fleets and blocks of several sizes, nanoseconds for each sample of each channel: of db8 details with
windowed RMS (`FleetRms`) and of all of it with the sequential tests (`Fleet`), and the ratio PyWavelets' wavedec /
ours of each round (above 1: ours is faster; wavedec gets one long signal, its best case, and gives no RMS). Then how
many actuators of two pressures at 500 Hz one core keeps up with, and the growth of the time with their number.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pywt
from bench_signals import LEVELS

from sealscope.diagnosis.fleet.fleet import Fleet
from sealscope.signals.streams import FleetRms

RATE = 500.0
#: Actuators and samples a block.
CASES = ((8, 500), (8, 50), (64, 500), (64, 50), (64, 5), (1024, 500), (1024, 50), (10_000, 500), (10_000, 50))
#: What growth is fitted over: fleets beyond the processor's caches, so that all of them meet the same memory.
ACTUATORS = (2048, 4096, 8192, 16_384)
PEER = 180_000
#: Samples of all channels that one measurement takes at least.
ENOUGH = 2_000_000


def processor(call: Callable[[], object]) -> float:
    """Processor time of one call [s]."""
    start = time.process_time()
    call()
    return time.process_time() - start


def repeated(update: Callable[[np.ndarray], object], block: np.ndarray, seconds: float = 0.0) -> tuple[Callable, int]:
    """A call that feeds a block again and again, and how many samples it takes."""
    times = max(1, -(-ENOUGH // block.size), round(seconds * RATE / block.shape[-1]))

    def run() -> None:
        for _ in range(times):
            update(block)

    return run, times * block.size


def windows_of(actuators: int, samples: int) -> Callable[[np.ndarray], object]:
    """A stream of windowed RMS that writes into one array."""
    stream = FleetRms(actuators)
    out = np.empty((samples // stream.step + 1, 2, len(stream.quantities), actuators))
    return lambda block: stream.update(block, out)


def fleet_of(actuators: int) -> Callable[[np.ndarray], object]:
    """A fleet whose actuators have all learned (from noise), so that every test runs."""
    fleet = Fleet(RATE, actuators, learn_s=200.0)
    rng = np.random.default_rng(1)
    from sealscope.diagnosis.fleet.sequential_tests import judge

    for decision in range(100):
        judge(rng.normal(size=fleet._y.shape), decision, fleet._learn, fleet._limits, *fleet._tests)
    return fleet.update


def quartiles(values: np.ndarray) -> list[float]:
    """Median and middle half."""
    return [float(q) for q in np.percentile(values, [50, 25, 75])]


def compare(actuators: int, samples: int, rounds: int) -> dict[str, list[float]]:
    """Nanoseconds a sample of ours and of the peer, in turn, and the ratio of each round."""
    rng = np.random.default_rng(0)
    block, x = rng.normal(size=(2, actuators, samples)), rng.normal(size=PEER)
    ways = [
        repeated(windows_of(actuators, samples), block, 1.0),
        repeated(fleet_of(actuators), block, 10.0 if actuators < 5000 else 2.0),
        (lambda: [pywt.wavedec(x, "db8", level=LEVELS) for _ in range(5)], 5 * PEER),
    ]
    for run, _ in ways:
        run()
    found = np.array([[1e9 * processor(run) / count for run, count in ways] for _ in range(rounds)])
    return {
        "windows_ns": quartiles(found[:, 0]),
        "fleet_ns": quartiles(found[:, 1]),
        "wavedec_ns": quartiles(found[:, 2]),
        "windows_ratio": quartiles(found[:, 2] / found[:, 0]),
        "fleet_ratio": quartiles(found[:, 2] / found[:, 1]),
    }


def growth(rounds: int) -> dict[str, object]:
    """Processor time of 2 s of data against the number of actuators, in turn, and the fitted exponent."""
    rng = np.random.default_rng(0)
    calls = []
    for actuators in ACTUATORS:
        update, block = fleet_of(actuators), rng.normal(size=(2, actuators, 250))
        calls.append(lambda update=update, block=block: [update(block) for _ in range(4)])
    for call in calls:
        call()
    seconds = np.min([[processor(call) for call in calls] for _ in range(rounds)], axis=0)
    (slope, _), covariance = np.polyfit(np.log(ACTUATORS), np.log(seconds), 1, cov=True)
    return {"actuators": ACTUATORS, "seconds": seconds.tolist(), "exponent": [slope, float(covariance[0, 0] ** 0.5)]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    chosen = parser.parse_args()
    print(f"processor ns a sample and channel, median of {chosen.rounds} rounds in turn (middle half of the ratio)")
    print(f"{'actuators':>9}{'block':>7}{'windows':>9}{'fleet':>8}{'wavedec':>9}"
          f"{'wavedec / windows':>24}{'wavedec / fleet':>24}{'actuators a core':>18}")  # fmt: skip
    figures: dict[str, object] = {"cases": {}}
    for actuators, samples in CASES:
        one = compare(actuators, samples, chosen.rounds)
        one["actuators_a_core"] = 1e9 / (one["fleet_ns"][0] * 2.0 * RATE)
        figures["cases"][f"{actuators} x {samples}"] = one
        ratios = [f"{m:.2f} ({a:.2f} .. {b:.2f})" for m, a, b in (one["windows_ratio"], one["fleet_ratio"])]
        ours, all_of_it, peer = (one[name][0] for name in ("windows_ns", "fleet_ns", "wavedec_ns"))
        times = f"{ours:>9.2f}{all_of_it:>8.2f}{peer:>9.2f}{ratios[0]:>24}{ratios[1]:>24}"
        print(f"{actuators:>9}{samples:>7}{times}{one['actuators_a_core']:>18,.0f}", flush=True)
    grown = figures["growth"] = growth(chosen.rounds)
    cells = ", ".join(f"{n}: {s:.3f}" for n, s in zip(grown["actuators"], grown["seconds"], strict=True))
    slope, error = grown["exponent"]
    print(f"growth with the actuators: exponent {slope:.3f} +- {error:.3f}   (seconds for 2 s of data: {cells})")
    if chosen.json:
        partial = chosen.json.with_name(chosen.json.name + ".partial")
        partial.write_text(json.dumps(figures, indent=2) + "\n")
        partial.replace(chosen.json)


if __name__ == "__main__":
    main()
