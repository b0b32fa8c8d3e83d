"""Leaks of every size on the rig as designed, all channels: found, intervals that hold, onsets, by `volume balance`.

    python benchmarks/large_leaks.py [--lpm 0.0005 0.5 ...] [--healthy 6] [--times 1] [--detector NAME]

Each size is made under three commands with throttles open and half closed, by both laws of a leak: 12 records of 120 s,
`--times` as many, each with noise and onset of its own, the leak open from an instant between 55 and 65 s on. A size
that a command's pump cannot feed is left out there and counted. The detector was developed on this rig, which it also
assumes; it knows neither onset nor law. Prints the table of docs/decisions/0063-one-inference.md: of so many records
found, of so many intervals that hold the flow, how far the stated onset is off. `--healthy` leak-free records a setting
of the throttles and command come first.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product

import numpy as np

from sealscope.diagnosis.diagnose import Examination
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

SIZES = (0.0002, 0.0005, 0.001, 0.0042, 0.015, 0.05, 0.1, 0.2, 0.5, 1.0)
COMMANDS = ("3 sin(4t)", "5 sin(2t)", "8 sin(t)")
HALF_CLOSED = {"line.orifices": "present", "line.closed_A": "50[%]", "line.closed_B": "50[%]"}
LAWS = ("laminar", "orifice")
SECONDS, EARLIEST, LATEST = 120.0, 55.0, 65.0


def settings() -> Iterator[tuple[str, dict[str, str]]]:
    """Yield every command with the throttles open and half closed."""
    yield from product(COMMANDS, ({}, HALF_CLOSED))


def examined(recording: Recording, detector: str) -> Evidence:
    """Return what the detector says of a recording at 1 %."""
    return Examination(recording, false_alarm_probability=0.01).evidence(detector)


def row(lpm: float, detector: str, times: int) -> str:
    """Return the line of one size."""
    detected = stated = holds = records = impossible = 0
    errors = []
    for number, ((command, throttles), law) in enumerate([*product(settings(), LAWS)] * times):
        onset = float(np.random.default_rng([number, round(1e6 * lpm)]).uniform(EARLIEST, LATEST))
        leak = f"{lpm} L/min {'orifice ' if law == 'orifice' else ''}from {onset:.3f} s"
        try:
            experiment = Experiment.of(command=command, duration=SECONDS, leak=leak, set=throttles, seed=number)
            simulated = simulate_experiment(experiment)
        except (InputError, SimulationFailed):
            impossible += 1
            continue
        records += 1
        evidence = examined(simulated.recording, detector)
        if evidence.verdict != "leak":
            continue
        detected += 1
        if evidence.onset_s is not None:
            errors.append(abs(evidence.onset_s - onset))
        if evidence.leak_interval_lpm is not None:
            stated += 1
            low, high = evidence.leak_interval_lpm
            holds += low <= simulated.truth.mean_leak_lpm <= high
    off = f"{np.median(errors):.2f} s, {max(errors):.2f} s" if errors else ""
    note = f"; {impossible} beyond the pump" if impossible else ""
    return f"| {lpm:g} | {detected} of {records} | {holds} of {stated} | {off} |{note}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lpm", type=float, nargs="+", default=SIZES, metavar="LPM")
    parser.add_argument("--healthy", type=int, default=1, help="leak-free records of each setting")
    parser.add_argument("--times", type=int, default=1, help="dozens of records of each size")
    parser.add_argument("--detector", default="volume balance")
    chosen = parser.parse_args()
    verdicts = [
        examined(simulate_experiment(experiment).recording, chosen.detector).verdict
        for seed in range(chosen.healthy)
        for command, throttles in settings()
        for experiment in [Experiment.of(command=command, duration=SECONDS, set=throttles, seed=seed)]
    ]
    print(f"leak-free: {verdicts.count('leak')} leak, {verdicts.count('cannot tell')} cannot tell of {len(verdicts)}")
    print("| L/min | found | intervals that hold | error of the onset, median and worst |\n| --- | --- | --- | --- |")
    for lpm in chosen.lpm:
        print(row(lpm, chosen.detector, chosen.times), flush=True)


if __name__ == "__main__":
    main()
