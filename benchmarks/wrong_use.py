"""Verdicts of a machine's file that is used wrongly: no leak is there but in one row, so that each `leak` is false.

    python benchmarks/wrong_use.py [--seeds N]

A machine is commissioned on five healthy recordings of 20 s of one day, and judges recordings of another day: of
another actuator, of a logger whose scale, offset or unit has changed, of warmer and colder oil, and of other duties;
each with N seeds.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import sealscope as ss
from sealscope.diagnosis.commissioned.machine import learn
from sealscope.parameters import load_rig

DUTY, SECONDS = "3 sin(4t)", 20.0
#: The pump of the healthy machine leaks as a new one may.
HEALTHY = {"pump.G_pump": "4e-13 m^3/(s Pa)"}
#: Name -> keywords of `simulate`, and channel -> factor and offset of what the logger makes of it.
CASES: dict[str, tuple[dict, dict[str, tuple[float, float]]]] = {
    "the same machine": ({}, {}),
    "the same machine, 0.02 L/min past its piston": ({"leak": "0.02 L/min"}, {}),
    "another actuator: area +10 %": ({"set": {"cylinder.A_A": "696 mm^2", "cylinder.A_B": "696 mm^2"}}, {}),
    "another actuator: displacement -15 %": ({"set": {"pump.q_b": "4.2 cm^3/rev"}}, {}),
    "logger: gain of p_A +3 %": ({}, {"p_A": (1.03, 0.0)}),
    "logger: gain of x +5 %": ({}, {"x": (1.05, 0.0)}),
    "logger: p_B by +2 bar": ({}, {"p_B": (1.0, 2e5)}),
    "logger: pressures in bar read as psi": ({}, {"p_A": (0.06895, 0.0), "p_B": (0.06895, 0.0)}),
    "logger: speed reversed": ({}, {"omega": (-1.0, 0.0), "theta": (-1.0, 0.0)}),
    "oil: 15 K warmer, leakage of the pump twice": ({"set": {"pump.G_pump": "8e-13 m^3/(s Pa)"}}, {}),
    "oil: 30 K warmer, four times": ({"set": {"pump.G_pump": "16e-13 m^3/(s Pa)"}}, {}),
    "oil: 15 K colder, leakage of the pump half": ({"set": {"pump.G_pump": "2e-13 m^3/(s Pa)"}}, {}),
    "oil: bulk modulus -30 %": ({"set": {"fluid.K_oil": "4.8e8 Pa"}}, {}),
    "duty: 5 sin(2t)": ({"command": "5 sin(2t)"}, {}),
    "duty: 2 sin(8t)": ({"command": "2 sin(8t)"}, {}),
    "duty: load of 0.2 kN": ({"load": "0.2 kN"}, {}),
}


def logged(recording: ss.Recording, changes: dict[str, tuple[float, float]]) -> ss.Recording:
    """Return the recording of another day, as another logger has it."""
    changed = {name: factor * recording[name] + offset for name, (factor, offset) in changes.items()}
    return dated(replace(recording, channels={**recording.channels, **changed}), "2026-03-02")


def dated(recording: ss.Recording, day: str) -> ss.Recording:
    """Return the recording of a day."""
    return replace(recording, provenance={**recording.provenance, "start": f"{day}T08:00:00"})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    seeds = range(100, 100 + parser.parse_args().seeds)
    rig = load_rig("thesis")
    runs = [
        dated(ss.simulate(command=DUTY, duration=SECONDS, set=HEALTHY, seed=seed), "2026-03-01") for seed in range(1, 6)
    ]
    healthy = tuple(learn(run, rig, f"run{k + 1}") for k, run in enumerate(runs))
    machine = ss.CommissionedMachine("actuator 7", healthy, rig)
    print("| used with | leak | cannot tell | no leak | named as another machine |\n| --- | --- | --- | --- | --- |")
    for name, (keywords, changes) in CASES.items():
        stated = {"command": DUTY, **keywords, "set": {**HEALTHY, **keywords.get("set", {})}}
        runs = [ss.simulate(**stated, duration=SECONDS, seed=seed) for seed in seeds]
        verdicts = [machine.diagnose(logged(run, changes)) for run in runs]
        counts = Counter(own.verdict for own in verdicts)
        named = sum("another machine" in own.reason for own in verdicts)
        print(f"| {name} | {counts['leak']} | {counts['cannot tell']} | {counts['no leak']} | {named} |", flush=True)


if __name__ == "__main__":
    main()
