"""Fuzz for a given time, outside the test suite: ``python -m tests.fuzz --seconds 600 [--seed 1] [KIND...]``.

It prints the counts of each kind and whatever escaped, with the seed that makes it again.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import traceback
import warnings
from pathlib import Path

from .runs import KINDS, attack, peak_memory


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("kinds", nargs="*", help=f"some of: {', '.join(KINDS)}")
    words.add_argument("--seconds", type=float, default=600.0, help="time for all kinds together")
    words.add_argument("--seed", type=int, default=1)
    given = words.parse_args()
    warnings.simplefilter("ignore")
    kinds = given.kinds or list(KINDS)
    escapes, here = 0, Path.cwd()
    for kind in kinds:
        with tempfile.TemporaryDirectory() as name:
            before = peak_memory()
            until = time.perf_counter() + given.seconds / len(kinds)
            first = given.seed * 10**9
            count = attack(kind, Path(name), range(first, first + 10**8), until, stop=False)
            more = (peak_memory() - before) / 1e6
            os.chdir(here)
        escaped = count.escaped or {}
        escapes += len(escaped)
        total = count.taken + count.refused + len(escaped)
        print(
            f"{kind:<17} {total:>8} inputs, {count.taken:>7} taken, {count.refused:>7} refused, {len(escaped):>4} "
            f"escaped, slowest {count.slowest:.2f} s, {more:.0f} MB more memory",
            flush=True,
        )
        lines: dict[str, list[int]] = {}
        for seed, error in escaped.items():
            place = traceback.extract_tb(error.__traceback__)[-1]
            text = f"{type(error).__name__} at {place.filename.rpartition('sealscope/')[2]}:{place.lineno}"
            lines.setdefault(f"{text}: {str(error)[:150]!r}", []).append(seed)
        for text, seeds in sorted(lines.items(), key=lambda item: -len(item[1])):
            print(f"    {len(seeds):>5} times {text} (seed {seeds[0]})")
    raise SystemExit(1 if escapes else 0)


if __name__ == "__main__":
    main()
