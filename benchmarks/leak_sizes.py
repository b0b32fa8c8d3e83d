"""Leaks of every size, and none, on the rig as designed or on machines that drift: found, sized, dated, by chance.

    python benchmarks/leak_sizes.py [--lpm 0 0.0042 0.5 ...] [--times 1] [--detector NAME] [--channels u,p_A,p_B]
        [--machines] [--duration 120] [--false-alarm 0.01] [--seed 0]

Each size is made under three commands with throttles open and half closed, by both laws of a leak: 12 records,
`--times` as many, each with noise and onset of its own, the leak open from somewhere about the middle on.
`--machines`: each record is of a machine that is drawn from the profile `bench`, which drifts. A size that a command's
pump cannot feed is left out and counted. `--detector diagnose` (the default) is the verdict of all together; it knows
the rig as designed, neither onset nor law. The last lines: the share of leak-free records whose chance is at or below
each level, which is to be no larger than the level.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product

import numpy as np
from tally import Tally, judge, print_heads, print_row

from sealscope.diagnosis.detectors.registry import DETECTORS
from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY
from sealscope.errors import InputError, SimulationFailed
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

SIZES = (0.0, 0.0002, 0.0005, 0.001, 0.0042, 0.015, 0.05, 0.1, 0.2, 0.5, 1.0)
COMMANDS = ("3 sin(4t)", "5 sin(2t)", "8 sin(t)")
HALF_CLOSED = {"line.orifices": "present", "line.closed_A": "50[%]", "line.closed_B": "50[%]"}
LAWS = ("laminar", "orifice")
LEVELS = (0.2, 0.1, 0.05, 0.02, 0.01)


def experiments(lpm: float, chosen: argparse.Namespace) -> Iterator[tuple[Experiment | None, float]]:
    """Yield experiments with a leak of that size, None where it cannot be, and their onsets."""
    settings = [*product(COMMANDS, ({}, HALF_CLOSED), LAWS)] * chosen.times
    for number, (command, throttles, law) in enumerate(settings):
        seed = 1000 * chosen.seed + number
        onset = chosen.duration * float(np.random.default_rng([seed, round(1e6 * lpm)]).uniform(0.46, 0.54))
        leak = f"{lpm} L/min {law} from {onset:.3f} s" if lpm else None
        try:
            if chosen.machines:
                machine = draw("bench", seed, duration=chosen.duration)
                yield machine.experiment(seed=seed, leak=leak or ()), onset
            else:
                words = {"command": command, "duration": chosen.duration, "set": throttles}
                yield Experiment.of(**words, leak=leak, seed=seed), onset
        except InputError:
            yield None, onset


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lpm", type=float, nargs="+", default=SIZES, metavar="LPM")
    parser.add_argument("--times", type=int, default=1, help="dozens of records of each size")
    parser.add_argument("--detector", default="diagnose", choices=("diagnose", *DETECTORS))
    parser.add_argument("--channels", default="", help="channels, by commas (default: all)")
    parser.add_argument("--machines", action="store_true", help="machines of the profile bench")
    parser.add_argument("--duration", type=float, default=120.0)
    parser.add_argument("--false-alarm", type=float, default=FALSE_ALARM_PROBABILITY)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    chances: dict[str, list[float]] = {}
    print_heads("L/min", "beyond the pump")
    for lpm in chosen.lpm:
        tally, impossible = Tally(), 0
        for experiment, onset in experiments(lpm, chosen):
            try:
                simulated = None if experiment is None else simulate_experiment(experiment)
            except (InputError, SimulationFailed):
                simulated = None
            if simulated is None:
                impossible += 1
                continue
            statement = judge(
                simulated.recording, chosen.detector, channels=chosen.channels, false_alarm=chosen.false_alarm
            )
            tally.add(statement, simulated.truth.mean_leak_lpm if lpm else None, onset if lpm else None)
            for part in () if lpm else statement.parts or (statement,):
                if part.chance is not None:
                    chances.setdefault(part.detector, []).append(part.chance)
        print_row(f"{lpm:g}", impossible or "", *tally.cells())
    print()
    print_row("leak-free: chance by", "records", *(f"<= {level:g}" for level in LEVELS))
    print_row(*("---" for _ in range(2 + len(LEVELS))))
    for detector, values in chances.items():
        print_row(detector, len(values), *(f"{100 * np.mean(np.array(values) <= level):.1f} %" for level in LEVELS))


if __name__ == "__main__":
    main()
