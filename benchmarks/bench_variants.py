"""What a run and a first run cost for each variant of the rig, beside the thesis's.

    python benchmarks/bench_variants.py [--duration 60] [--rounds 5] [--variant NAME] [--against FOLDER]
        [--json FILE]

For each variant, in processor seconds: a run with instruments at the step that is chosen, compiled before; and a
first run with nothing cached, imports not counted. `--against` names a folder with another state of the package (its
`src`): runs of variants that it knows are timed in turn with this one's, and the ratio is printed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from bench_solvers import quartiles, write

THROTTLED = {"orifices": "present", "closed_A": "50 %", "closed_B": "50 %"}
LINED = {
    **THROTTLED,
    **{"p_charge": "2 MPa", "R_A": 2e9, "R_B": 5e9, "open_B": 0.3, "T_f": 0.09, "C_f": 0.03, "C_h": 60.0},
    **{"C_st": 2e-5, "A_opp": "100[mm^2]", "p_opp": "1 MPa", "C_opp": 1e-7},
}
#: Rig, its values and the command of each variant.
VARIANTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "thesis": ("thesis", {}, "3 sin(4t)"),
    "thesis, throttled": ("thesis", THROTTLED, "3 sin(4t)"),
    "thesis-closed-loop": ("thesis-closed-loop", {}, "3 sin(4t)"),
    "thesis-closed-loop, its loop closed": ("thesis-closed-loop", {}, "position 40 mm sin(1.57t)"),
    "single-rod-eha": ("single-rod-eha", {"F_l": 2000.0}, "5 sin(2t)"),
    "servo-valve": ("servo-valve", {"F_l": 1000.0}, "2 sin(2t)"),
    "lines, filters, losses, opposing cylinder": ("thesis", LINED, "3 sin(4t)"),
}
#: Printed by a process that times one variant: processor seconds of its first run, then of others as they are asked.
CHILD = """
import sys, time
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment
rig, values, command, duration = eval(sys.stdin.readline())
experiment = Experiment.of(rig=rig, set=values, command=command, duration=duration)
def timed():
    begun = time.process_time()
    simulate_experiment(experiment)
    print(time.process_time() - begun, flush=True)
timed()
for _ in sys.stdin:
    timed()
"""


class Child:
    """A process of its own, with nothing cached, that runs a variant of a state of the package when asked."""

    def __init__(self, source: Path, words: tuple[Any, ...], errors: int | None = None) -> None:
        environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1", "SEALSCOPE_CACHE_DIR": ""}
        self._process = subprocess.Popen(
            [sys.executable, "-c", CHILD],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        self._ask(repr(words))
        self.first = self._answer()

    def _ask(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def _answer(self) -> float:
        assert self._process.stdout is not None
        return float(self._process.stdout.readline())

    def run(self) -> float:
        """Processor seconds of one run."""
        self._ask("again")
        return self._answer()

    def end(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def measured(words: tuple[Any, ...], options: argparse.Namespace) -> dict[str, Any]:
    """Times of one variant."""
    here = Path(__file__).parents[1] / "src"
    child = Child(here, words)
    figures: dict[str, Any] = {"first": child.first}
    if options.against:
        try:
            other = Child(options.against / "src", words, subprocess.DEVNULL)
        except ValueError:  # it does not know the variant
            pairs = np.array([[child.run(), np.nan] for _ in range(options.rounds)])
        else:
            pairs = np.array([[child.run(), other.run()] for _ in range(options.rounds)])
            figures |= {"first before": other.first, "over before": quartiles(pairs[:, 0] / pairs[:, 1])}
            other.end()
    else:
        pairs = np.array([[child.run(), np.nan] for _ in range(options.rounds)])
    child.end()
    figures["run"] = quartiles(pairs[:, 0])
    return figures


def main() -> None:
    """Print a row for each variant."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--variant", action="append", choices=list(VARIANTS), help="this one alone; may be repeated")
    parser.add_argument("--against", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(f"processor seconds, {options.duration:g} s")
    print(f"{'variant':42} {'run':>8} {'first':>7}  over before (middle half), first")
    figures = {}
    for name in options.variant or VARIANTS:
        rig, values, command = VARIANTS[name]
        own = figures[name] = measured((rig, values, command, options.duration), options)
        row = f"{name:42} {own['run'][0]:8.4f} {own['first']:7.2f}"
        if "over before" in own:
            middle, low, high = own["over before"]
            row += f"  {middle:.2f} ({low:.2f} to {high:.2f}), {own['first'] / own['first before']:.2f}"
        print(row, flush=True)
    if options.json:
        write(options.json, figures)


if __name__ == "__main__":
    main()
