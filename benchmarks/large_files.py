"""How memory and time grow with a log's size: read, convert, cut into parts and, with --diagnose, diagnose text logs.

The first figure is the time of `read` over that of `pandas.read_csv`, by the clock and by the processor, for 15 MB.
``python benchmarks/large_files.py [--minutes 20] [--diagnose] [--parts-alone]`` writes a log of so many minutes at
500 Hz (7 columns) and one of twice as many into a temporary folder, and prints for each command the bytes that each
further value needs at the peak, and the ratio of the times: 2 where both grow with the file and no faster.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from subprocess import DEVNULL

import numpy as np
import psutil

RATE, COLUMNS = 500, 7
HEADER = "t [s],u [V],theta [rad],x [m],p_A [Pa],p_B [Pa],omega [rad/s]"


def write_log(path: Path, minutes: float) -> int:
    """Write a leak-free log in blocks, and return its values."""
    rng, rows = np.random.default_rng(1), round(60 * minutes * RATE)
    with path.open("w", encoding="utf-8") as file:
        file.write(HEADER + "\n")
        for begin in range(0, rows, 50_000):
            t = np.arange(begin, min(begin + 50_000, rows)) / RATE
            swing, noise = np.sin(4 * t), rng.normal(0, 2e3, (2, t.size))
            columns = (3 * swing, 20 * swing, 0.05 * swing, 3e5 + 6e4 * swing + noise[0], 3e5 - 6e4 * swing + noise[1])
            np.savetxt(file, np.column_stack([t, *columns, 31 * np.cos(4 * t)]), delimiter=",", fmt="%.7g")
    return rows * COLUMNS


def run(*words: str) -> tuple[float, int]:
    """Run a command and return its seconds of processor and its peak resident bytes."""
    process = psutil.Popen([sys.executable, "-m", "sealscope", *words], stdout=DEVNULL)
    peak, seconds = 0, 0.0
    while process.poll() is None:
        try:
            peak = max(peak, process.memory_info().rss)
            seconds = sum(process.cpu_times()[:2])
        except psutil.Error:
            break
        time.sleep(0.02)
    if process.wait() != 0:
        raise SystemExit(f"sealscope {' '.join(words)} ended with status {process.returncode}")
    return seconds, peak


def beside_pandas(path: Path, rounds: int = 9) -> tuple[float, float]:
    """Return the ratio of the times of `read` and `pandas.read_csv`, by the clock and by the processor."""
    import pandas as pd

    from sealscope.recordings import read

    best = np.full((2, 2), np.inf)
    for _ in range(rounds):
        for row, reader in enumerate((read, pd.read_csv)):
            begin = np.array([time.perf_counter(), time.process_time()])
            reader(path)
            best[row] = np.minimum(best[row], [time.perf_counter(), time.process_time()] - begin)
    clock, processor = best[0] / best[1]
    return float(clock), float(processor)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--diagnose", action="store_true", help="diagnose the logs, too: takes long")
    parser.add_argument("--parts-alone", action="store_true", help="convert into parts of ten minutes, nothing else")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        write_log(Path(name) / "15MB.csv", 8.0)
        clock, processor = beside_pandas(Path(name) / "15MB.csv")
        print(f"15 MB: {clock:.2f} times pandas.read_csv by the clock, {processor:.2f} by the processor")
        logs = [Path(name) / "one.csv", Path(name) / "two.csv"]
        values = [
            write_log(log, minutes) for log, minutes in zip(logs, (options.minutes, 2 * options.minutes), strict=True)
        ]
        print(f"{values[0]} and {values[1]} values in {logs[0].stat().st_size} and {logs[1].stat().st_size} bytes")
        commands = {"inspect": lambda log: ("inspect", log), "convert": lambda log: ("convert", log, f"{log}.nc")}
        commands["parts"] = lambda log: ("convert", log, f"{log}.parts", "--every", "10 min")
        if options.parts_alone:
            commands = {"parts": commands["parts"]}
        if options.diagnose:
            commands["diagnose"] = lambda log: ("diagnose", log)
        run("--version")
        for command, words in commands.items():
            one, two = (run(*words(str(log))) for log in logs)
            further = (two[1] - one[1]) / (values[1] - values[0])
            print(f"{command:9} {further:6.1f} bytes at the peak for each further value (8: a double); "
                  f"time x {two[0] / one[0]:.2f} for twice the file; {two[1] / 1e6:.0f} MB in all")  # fmt: skip


if __name__ == "__main__":
    main()
