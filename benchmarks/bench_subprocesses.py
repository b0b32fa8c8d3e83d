"""Time reading a foreign HDF5 file in the program against reading it by a process of its own, as `read` does.

    python benchmarks/bench_subprocesses.py [--rounds 15]

Four channels of 90 000 samples. Prints the median and the middle half (25 % to 75 %) of each [s] and the ratio of the
medians. `first file` starts the process of its own; its library is then loaded in the program already.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np

from sealscope.recordings import files, read
from sealscope.recordings.subprocesses import _idle

SAMPLES, RATE = 90_000, 500.0


def foreign_file(path: Path) -> None:
    """Write the channels as another program does."""
    rng = np.random.default_rng(7)
    with h5py.File(path, "w") as file:
        file["t"] = np.arange(SAMPLES) / RATE
        file["t"].attrs["units"] = "s"
        for name in ("p_A", "p_B", "p_1", "p_2"):
            file[name] = 3e5 + 1e4 * rng.standard_normal(SAMPLES)
            file[name].attrs["units"] = "Pa"


def timed(call: Callable[[], object], rounds: int) -> np.ndarray:
    """Return the wall time of each call [s]."""
    taken = np.empty(rounds)
    for k in range(rounds):
        start = time.perf_counter()
        call()
        taken[k] = time.perf_counter() - start
    return taken


def row(title: str, taken: np.ndarray) -> None:
    """Print the median and the middle half."""
    low, middle, high = np.percentile(taken, [25, 50, 75])
    print(f"{title:28s} {middle:.4f} ({low:.4f} to {high:.4f}) s")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    with TemporaryDirectory() as folder:
        path = Path(folder) / "foreign.h5"
        foreign_file(path)

        def fresh() -> None:
            while _idle:
                _idle.pop().end()
            read(path)

        def in_program() -> None:
            elsewhere, files._SAFE_FORMATS = files._SAFE_FORMATS, (*files._SAFE_FORMATS, "netcdf")
            try:
                read(path)
            finally:
                files._SAFE_FORMATS = elsewhere

        in_program()
        here, there = np.empty(0), np.empty(0)
        first = timed(fresh, min(rounds, 7))
        for _ in range(rounds):
            here, there = np.append(here, timed(in_program, 1)), np.append(there, timed(lambda: read(path), 1))
        row("subprocess, first file", first)
        row("subprocess, each further file", there)
        row("in the program", here)
        print(f"ratio of the medians         {np.median(there) / np.median(here):.2f}")


if __name__ == "__main__":
    main()
