"""A sensor that is off throughout: verdict, size and what is named, beside the same record without the error.

    python benchmarks/sensor_errors.py [--leak 0.05] [--seed 5]

The thesis's rig and a single rod, three duties each, 120 s, a leak from half on; the rig is known, no baseline. Errors:
the zero of either chamber pressure by -6 to +6 bar, its gain by 3 %, a position that is recorded two samples late. Of
each error: of so many records the verdict is the same, the interval holds the mean flow, and the error is named.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

import sealscope as ss

DUTIES = {
    "thesis": ({"command": "3 sin(4t)"}, {"command": "5 sin(2t)"}, {"command": "3 sin(4t)", "load": "100 N"}),
    "single-rod-eha": (
        {"command": "3 sin(4t)"},
        {"command": "position 50 mm sin(2t)", "load": "2 kN"},
        {"command": "3 sin(4t)", "load": "100 N"},
    ),
}
ZEROS = (-6.0, -3.0, -1.0, 1.0, 2.0, 3.0, 6.0)


def changed(recording: ss.Recording, name: str, change: Callable[[np.ndarray], np.ndarray]) -> ss.Recording:
    """Return a recording with another reading of a channel."""
    return replace(recording, channels={**recording.channels, name: change(recording[name])})


def errors(recording: ss.Recording) -> Iterator[tuple[str, str, ss.Recording]]:
    """Yield errors: the row, the words by which a verdict names it, and the recording."""
    for name in ("p_A", "p_B"):
        for bar in ZEROS:
            shifted = changed(recording, name, lambda p, bar=bar: p + 1e5 * bar)  # type: ignore[misc]
            yield f"zero of {name}, {bar:+g} bar", "p_A - p_B reads", shifted
        yield f"gain of {name}, 3 %", "gain", changed(recording, name, lambda p: 1.03 * p)
    yield (
        "x two samples late",
        "x is recorded",
        changed(recording, "x", lambda x: np.concatenate([x[:1], x[:1], x[:-2]])),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--leak", type=float, default=0.05, help="L/min")
    parser.add_argument("--seed", type=int, default=5)
    given = parser.parse_args()
    rows: dict[str, list[tuple[bool, bool, bool]]] = {}
    for rig, duties in DUTIES.items():
        for duty in duties:
            recording = ss.simulate(
                rig=rig, leak=f"{given.leak} L/min from 60 s", duration=120.0, seed=given.seed, **duty
            )
            for row, words, off in errors(recording):
                diagnosis = ss.diagnose(off, rig=rig)
                low, high = diagnosis.leak_interval_lpm or (np.inf, -np.inf)
                held = low <= given.leak <= high
                rows.setdefault(row, []).append((diagnosis.verdict == "leak", held, words in diagnosis.reason))
                if not held:
                    print(
                        f"{rig}, {duty}, {row}: {diagnosis.verdict}, {diagnosis.cause}, {diagnosis.leak_lpm}",
                        flush=True,
                    )
    print("| error | `leak` | interval holds | named |\n| --- | --- | --- | --- |")
    for row, results in rows.items():
        print(f"| {row} | " + " | ".join(f"{sum(of)} of {len(of)}" for of in zip(*results, strict=True)) + " |")


if __name__ == "__main__":
    main()
