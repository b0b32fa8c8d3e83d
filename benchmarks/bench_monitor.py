"""What watching costs: processor time a block, actuators a core, bytes of state, and time from message to store.

    python benchmarks/bench_monitor.py [--seconds 900] [--actuators 20]

Simulated actuators (p_A, p_B, x, theta at 500 Hz, blocks of about 3 s in messages of 1 s) are watched by the library
alone, then by the service with its database in a temporary folder: each message is one transaction with full
synchronisation. The share of blocks that were searched for a rise is part of the cost.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

import sealscope as ss
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.memory.store import MonitorStore
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.source_block import SourceBlock
from sealscope.monitor.stream import decisions

CHANNELS = ("p_A", "p_B", "x", "theta")
LEARN_H = 100.0 / 3600.0


def pieces(seconds: float, seed: int, leak: str | None = None) -> list[ss.Recording]:
    """Messages of 1 s."""
    recording = ss.simulate(command="3 sin(4t)", duration=seconds, seed=seed, leak=leak).only(CHANNELS)
    return [recording.samples(slice(k, k + 500)) for k in range(0, len(recording), 500)]


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=900.0, help="simulated time of each actuator")
    parser.add_argument("--actuators", type=int, default=20, help="actuators in the service")
    chosen = parser.parse_args()

    messages = pieces(chosen.seconds, 0)
    watch = ss.watch("thesis", learn_hours=LEARN_H)
    warm = 200
    for samples in messages[:warm]:
        watch.update(samples)
    searched = 0
    fit = decisions.fit_balance

    def counted(*arguments: object, **options: object) -> object:
        nonlocal searched
        searched += 1
        return fit(*arguments, **options)  # type: ignore[arg-type]

    decisions.fit_balance = counted  # type: ignore[assignment]
    blocks, start = watch.blocks, time.process_time()
    for samples in messages[warm:]:
        watch.update(samples)
    spent, blocks = time.process_time() - start, watch.blocks - blocks
    decisions.fit_balance = fit
    state = json.dumps(watch.state())
    print(f"library: {1e3 * spent / blocks:.2f} ms a block of {(len(messages) - warm) / blocks:.2f} s", end="; ")
    print(f"{blocks / spent:.0f} blocks/s, {(len(messages) - warm) / spent:.0f} actuators a core", end="; ")
    print(f"{searched} of {blocks} blocks searched; state {len(state)} bytes as JSON")

    names = [f"press {k}" for k in range(chosen.actuators)]
    settings = [ActuatorSettings(name=name, learn_hours=LEARN_H) for name in names]
    with tempfile.TemporaryDirectory() as folder:
        store = MonitorStore(str(Path(folder) / "monitor.db"))
        actuators = WatchedActuators(settings, store)
        took = []
        start = time.process_time()
        for number, samples in enumerate(messages[: 60 + int(chosen.seconds // 4)]):
            for name in names:
                began = time.perf_counter()
                actuators.take(SourceBlock(name, str(number), samples))
                took.append(time.perf_counter() - began)
        spent = time.process_time() - start
        rows = len(took)
        median, rare = (1e3 * value for value in np.percentile(took, [50, 99]))
        print(f"service: {1e3 * spent / rows:.2f} ms of processor a message of 1 s, {rows / spent:.0f}", end=" ")
        print(f"actuators a core; message to stored: median {median:.1f} ms, p99 {rare:.1f} ms, most {max(took):.2f} s")
        store.engine.dispose()


if __name__ == "__main__":
    main()
