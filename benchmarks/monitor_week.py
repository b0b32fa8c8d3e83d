"""A week of a monitor, time compressed: resident memory and the size of the database at the end of each day.

    python benchmarks/monitor_week.py [--days 7] [--actuators 1] [--keep-days 2] [--rate 500] [--seconds 1]
        [--folder FOLDER]

Messages (p_A, p_B, x, theta, CBOR with typed arrays) of simulated actuators go through the service as fast as it takes
them, from their bytes to the database with full synchronisation. Five minutes of a duty are repeated,
the clock runs on. With `--folder` the database is kept there, and a run that was ended goes on where it was; memory is
then that of the new process. Estimates of `--keep-days` are kept and the identities of the last 100 000 blocks, so the
database grows for that long. Bytes of state are those of a checkpoint in JSON, which is what a restart reads; bytes in
memory, of what an actuator holds between blocks, are measured on as many watches beside each other.
"""

from __future__ import annotations

import argparse
import gc
import io
import json
import os
import tempfile
import time
import tracemalloc
from pathlib import Path

import cbor2
from bench_monitor import CHANNELS, resident
from cbor2 import CBORTag

import sealscope as ss
from sealscope.diagnosis.live.watch import Watch
from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings
from sealscope.monitor.sources.source_block import BlockReceiver, decode_message

DAY = 86_400
#: The duty has a cycle of 1 s, so that its end joins its beginning; so long it settles, and so long it is repeated [s].
COMMAND, SETTLED, REPEATED = "3 sin(6.283185307179586t)", 60, 300
#: Watches whose bytes in memory are measured.
WATCHES = 20


def main() -> None:
    """Print a line a day."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--days", type=float, default=7.0, help="simulated days of each actuator")
    parser.add_argument("--actuators", type=int, default=1)
    parser.add_argument("--keep-days", type=float, default=2.0, help="days of estimates that are kept")
    parser.add_argument("--rate", type=int, default=500, help="sampling rate [Hz]")
    parser.add_argument("--seconds", type=int, default=1, help="samples of a message [s]")
    parser.add_argument("--folder", type=Path, default=None, help="where the database is kept")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        names = [f"press {k}" for k in range(chosen.actuators)]
        week(folder, chosen.days, names, chosen.keep_days, chosen.rate, chosen.seconds)


def week(folder: Path, days: float, names: list[str], keep_days: float, rate: int, seconds: int) -> None:
    """Feed a service, and print its memory at the end of each day."""
    recording = ss.simulate(command=COMMAND, duration=SETTLED + REPEATED, rate=rate, seed=0).only(CHANNELS["volumes"])
    size = rate * seconds
    pieces = [recording.samples(slice(k, k + size)) for k in range(SETTLED * rate, len(recording), size)]
    channels = [{name: CBORTag(86, samples[name].tobytes()) for name in samples.channels} for samples in pieces]
    settings = MonitorSettings.model_validate(
        {
            "database": str(folder / "monitor.db"),
            "keep_days": keep_days,
            "actuator": [{"name": name} for name in names],
        }
    )
    total, day, began = round(days * DAY / seconds), DAY // seconds, time.process_time()

    def source(service: BlockReceiver) -> None:
        first = min(service.store.blocks_kept(name) for name in names)
        for k in range(first, total):
            for name in names:
                values = {"t": float(k * seconds), "rate": recording.rate, "id": k, **channels[k % len(channels)]}
                service.submit(decode_message(cbor2.dumps(values), name))
            if (k + 1) % day == 0 or k + 1 in (first + 1000, total):
                files = sum(file.stat().st_size for file in folder.iterdir())
                spent = time.process_time() - began
                print(f"day {(k + 1) / day:.2f}: resident {resident() / 1e6:.1f} MB", end=", ")
                print(f"database {files / 1e6:.1f} MB; {spent:.0f} s of processor", flush=True)

    service = Service(settings, stdout=io.StringIO(), sources=[source])
    service.run()
    _, state = service.store.checkpoint(names[0]) or ("", {})
    statuses = service.actuators.summaries()
    print(f"shown: {statuses[names[0]]['status']}, {statuses[names[0]]['counters']}; {service.actuators.counters}")
    print(f"state {len(json.dumps(state))} bytes as JSON", end="; ")
    gc.collect()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    watches = [Watch.from_state(state["watch"]) for _ in range(WATCHES)]
    print(f"{(tracemalloc.get_traced_memory()[0] - before) / len(watches):.0f} bytes of a watch in memory", end="; ")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    service.store.engine.dispose()


if __name__ == "__main__":
    main()
