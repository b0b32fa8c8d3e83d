"""What is found on a real electro-hydrostatic actuator: healthy runs of one set-up, each judged against the others.

    python benchmarks/real_eha.py FILE... [--leaks 0 0.02 0.05 0.1 0.4] [--plain] [--commissioned FILE...]

FILE: the logs of the public repository ivliev123/Electro-Hydraulic-Actuator (semicolon CSV, raw counts, 1 kHz), fetched
by yourself: it has no licence, and none of it is part of this project. A leak of so many L/min, at the run's mean
pressure difference, is put into the judged run: for the same motion the motor turns faster by G (p_A - p_B) over the
displacement. The verdict knows the areas and the displacement that the builder states, the other runs, no onset and no
size. `--plain`: beside it the plain regression of `plain_regression.py`.
`--commissioned`: the runs are judged by the file of a machine commissioned on these runs alone, in place of the others.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

import numpy as np
from plain_regression import regression

import sealscope as ss
from sealscope.parameters import load_rig

MAP = {
    "t": "time ms",
    "p_A": "ch2*0.0625-0.625 bar",
    "p_B": "ch3*0.07576-18.333 bar",
    "x": "ch14*0.025 mm",
    "omega": "ch10 rpm",
}
AREAS, DISPLACEMENT = ("1963.5 mm^2", "1649.3 mm^2"), "1.6 cm^3/rev"
LPM = 1e-3 / 60.0


def leaking(recording: ss.Recording, lpm: float) -> ss.Recording:
    """Return the run as it would have been with a leak."""
    dp = recording["p_A"] - recording["p_B"]
    turned = 1.6e-6 / (2.0 * np.pi)
    omega = recording["omega"] + lpm * LPM / np.mean(np.abs(dp)) * dp / turned
    return replace(recording, channels={**recording.channels, "omega": omega})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--leaks", nargs="*", type=float, default=[0.0, 0.01, 0.02, 0.05, 0.1, 0.4])
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--commissioned", nargs="+", default=[])
    parser.add_argument("--known", type=int, help="each run is judged by so many others, chosen at random, not by all")
    parser.add_argument("--choices", type=int, default=1, help="how often they are chosen for a run")
    options = parser.parse_args()
    rig = load_rig("single-rod-eha").with_overrides(
        {"cylinder.A_A": AREAS[0], "cylinder.A_B": AREAS[1], "pump.q_b": DISPLACEMENT}
    )
    machine = ss.commission(options.commissioned, rig=rig, map=MAP) if options.commissioned else None
    if machine is not None:
        print(f"commissioned on {len(machine.healthy)} runs: the next one shows {machine.summary.smallest}")
    runs = [ss.read(path, map=MAP) for path in options.files if path not in options.commissioned]
    print("| leak [L/min] | leak | cannot tell | size, median | intervals hold | bound, median |", end="")
    print(
        " plain regression |\n| --- | --- | --- | --- | --- | --- | --- |"
        if options.plain
        else "\n" + "| --- " * 6 + "|"
    )
    for lpm in options.leaks:
        verdicts, plain, random = [], 0, np.random.default_rng(0)  # the same choices for every leak
        for k, run in options.choices * list(enumerate(runs)):
            others = [own for j, own in enumerate(runs) if j != k]
            if options.known:
                others = [others[j] for j in random.choice(len(others), options.known, replace=False)]
            judged = leaking(run, lpm) if lpm else run
            by = partial(ss.diagnose, baseline=others, rig=rig) if machine is None else machine.diagnose
            verdicts.append(by(judged))
            plain += regression(judged, others, 1.6e-6) if options.plain else 0
        detected = [own for own in verdicts if own.verdict == "leak"]
        sizes = [own.leak_lpm for own in detected if own.leak_lpm is not None]
        hold = sum(
            own.leak_interval_lpm[0] <= lpm <= own.leak_interval_lpm[1] for own in detected if own.leak_lpm is not None
        )
        bounds = [own.bound_lpm for own in verdicts if own.bound_lpm is not None]
        size = f"{np.median(sizes):.3g}" if sizes else ""
        bound = f"{np.median(bounds):.2g}" if bounds else ""
        unsure = sum(own.verdict == "cannot tell" for own in verdicts)
        line = (
            f"| {lpm:g} | {len(detected)} of {len(verdicts)} | {unsure} | {size} | {hold} of {len(sizes)} | {bound} |"
        )
        print(line + (f" {plain} |" if options.plain else ""), flush=True)


if __name__ == "__main__":
    main()
