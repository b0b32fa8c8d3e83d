"""Time the package `signals` against PyWavelets, in turn and in one run, so that a busy machine burdens both alike.

    python benchmarks/bench_signals.py [--samples 180000] [--rounds 31] [--json FILE]

Prints, per case, the median and the middle half (25 % to 75 %) of our time, PyWavelets' time and the ratio
theirs / ours of each round (above 1: ours is faster).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pywt

from sealscope.signals.details import details
from sealscope.signals.streams import DetailStream
from sealscope.signals.windows import RmsStream, windowed_rms

LEVELS = 4


def seconds(call: Callable[[], object]) -> float:
    """Wall time of one call [s]."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def compare(ours: Callable[[], object], theirs: Callable[[], object], rounds: int) -> dict[str, list[float]]:
    """Quartiles [ms] of both, measured in turn after one unmeasured round, and of the ratio theirs / ours."""
    ours(), theirs()
    pairs = np.array([(seconds(ours), seconds(theirs)) for _ in range(rounds)])

    def quartiles(values: np.ndarray) -> list[float]:
        return [float(q) for q in np.percentile(values, [50, 25, 75])]

    return {
        "ours_ms": quartiles(1e3 * pairs[:, 0]),
        "theirs_ms": quartiles(1e3 * pairs[:, 1]),
        "ratio": quartiles(pairs[:, 1] / pairs[:, 0]),
    }


def in_blocks(stream: DetailStream, x: np.ndarray, block: int) -> Callable[[], None]:
    """A call that feeds all of `x` to `stream` in blocks."""
    out = np.empty((*x.shape[:-1], LEVELS, block))

    def run() -> None:
        for start in range(0, x.shape[-1] - block + 1, block):
            stream.update(x[..., start : start + block], out=out)

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=180_000, help="samples of the signal (default: 180 s at 1 kHz)")
    parser.add_argument("--rounds", type=int, default=31)
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    chosen = parser.parse_args()
    x = np.random.default_rng(0).normal(size=chosen.samples)
    channels = x[: chosen.samples // 64 * 64].reshape(64, -1)
    levels = details(x)

    def swt() -> object:
        return pywt.swt(x[: x.size // 16 * 16], "db8", level=LEVELS, trim_approx=True)

    def wavedec() -> object:
        return pywt.wavedec(x, "db8", level=LEVELS)

    def windows_live() -> None:
        stream = RmsStream()
        for start in range(0, x.size, 500):
            stream.update(levels.values[:, start : start + 500])

    cases = {
        "stream, one block | pywt.swt": (in_blocks(DetailStream(), x, x.size), swt),
        "stream, one block | pywt.wavedec": (in_blocks(DetailStream(), x, x.size), wavedec),
        "stream, blocks of 500 | pywt.swt": (in_blocks(DetailStream(), x, 500), swt),
        "stream, blocks of 500 | pywt.wavedec": (in_blocks(DetailStream(), x, 500), wavedec),
        "stream, 64 channels, blocks of 50 | pywt.swt": (in_blocks(DetailStream(64), channels, 50), swt),
        "details() | pywt.swt": (lambda: details(x), swt),
        "details(decimated) | pywt.wavedec": (lambda: details(x, transform="decimated"), wavedec),
        "windowed_rms of 4 levels | pywt.wavedec": (lambda: windowed_rms(levels), wavedec),
        "RmsStream of 4 levels, blocks of 500 | pywt.wavedec": (windows_live, wavedec),
    }
    print(f"{x.size} samples in all, db8, {LEVELS} levels, {chosen.rounds} rounds; median (25 % .. 75 %)")
    print(f"{'ours | theirs':<54}{'ours [ms]':>24}{'theirs [ms]':>24}{'theirs / ours':>24}")
    figures = {}
    for name, (ours, theirs) in cases.items():
        figures[name] = compare(ours, theirs, chosen.rounds)
        columns = "".join(f"{f'{m:.2f} ({a:.2f} .. {b:.2f})':>24}" for m, a, b in figures[name].values())
        print(f"{name:<54}{columns}", flush=True)
    if chosen.json:
        partial = chosen.json.with_name(chosen.json.name + ".partial")
        partial.write_text(json.dumps(figures, indent=2) + "\n")
        partial.replace(chosen.json)


if __name__ == "__main__":
    main()
