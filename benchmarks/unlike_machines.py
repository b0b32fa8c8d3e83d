"""Machines unlike the rig in everything at once, seen by `pressure model`: alarms, and flows within their intervals.

    python benchmarks/unlike_machines.py [--first 0] [--machines 12]

A machine is one of the profile `bench` with another mass (+-30 %), area (+-8 %), friction (+-35 %), volume, stiffness
of the oil (500 to 850 MPa), motor and speed loop, volumes that are fixed or follow the position, commands with long
strokes among them, skews up to 3 ms, 12 to 16 bits, and hum at 50 or 60 Hz with harmonics on six of ten; see `machine`.
Each is recorded for 180 s without a leak and with 0.0042 and 0.015 L/min by both laws from an instant between 70 and
110 s on. The detector assumes the rig as designed, sees p_A, p_B and u alone, and knows neither onset nor law; nominal
1 %. What else `diagnose` holds against a leak (isolation of other causes) is not asked. Prints the tables of
docs/decisions/0024-pressure-laws.md. The detector was developed on other machines of this kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from sealscope.diagnosis.pressure_model.detector import PressureModel
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.bench.machines import BenchMachine, draw
from sealscope.simulation.commands import parse_command
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.units import to_si

SECONDS, FROM_SEED = 180.0, 77
PSI = to_si(1.0, "psi", "Pa")
COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)", "8 sin(t)", "6 sin(0.7t)")
LEAKS = ((0.0, "laminar"), *product((0.0042, 0.015), ("laminar", "orifice")))
CHANNELS = ("u", "p_A", "p_B")
#: Factors on the rig's own number, and ranges in SI.
FACTORS = {
    "cylinder.M_eq": (0.7, 1.3),
    "cylinder.V": (1.0, 1.25),
    "friction.C_c": (0.7, 1.4),
    "motor.J_M": (0.8, 1.3),
    "motor.k_p": (0.8, 1.2),
    "motor.K_i": (0.7, 1.4),
}
RANGES = {"fluid.K_oil": (5e8, 8.5e8), "friction.K_brk": (2.0, 3.5), "fluid.p_charge": (0.4e6, 0.9e6)}
#: Speed per volt over the rig's: as the strokes of a command allow.
SPEEDS = {"8 sin(t)": (0.9, 1.9), "6 sin(0.7t)": (0.8, 1.5)}
HUMMING, LONG_SKEW, SHORT_SKEW = 0.6, 3e-3, 3e-4


@dataclass(frozen=True)
class Hum:
    """Mains on the chamber pressures: frequency [Hz]; amplitudes [Pa] and phases (2, 3) of its first harmonics."""

    frequency: float
    amplitudes: np.ndarray
    phases: np.ndarray

    def on(self, recording: Recording) -> Recording:
        """Return the recording with the hum on p_A and p_B."""
        channels = dict(recording.channels)
        for name, amplitudes, phases in zip(("p_A", "p_B"), self.amplitudes, self.phases, strict=True):
            turns = 2.0 * np.pi * self.frequency * recording.t[:, None] * np.arange(1, amplitudes.size + 1)
            channels[name] = channels[name] + np.sin(turns + phases) @ amplitudes
        return replace(recording, channels=channels)


def machine(seed: int) -> tuple[BenchMachine, Hum | None, float]:
    """Return a machine, its hum and the instant [s] at which it begins to leak."""
    drawn, random = draw("bench", seed, duration=SECONDS), np.random.default_rng([seed, FROM_SEED])
    rig, values = drawn.rig, dict(drawn.overrides)
    values |= {name: float(rig[name]) * random.uniform(*limits) for name, limits in FACTORS.items()}
    values |= {name: random.uniform(*limits) for name, limits in RANGES.items()}
    area, friction = random.uniform(0.92, 1.08), random.uniform(0.75, 1.3)
    values |= {name: float(rig[name]) * area for name in ("cylinder.A_A", "cylinder.A_B")}
    for name in ("friction.F_pr", "friction.F_cfr", "friction.F_v"):
        values[name] = float(rig[name]) * friction * random.uniform(0.9, 1.1)
    values["cylinder.volumes"] = "position" if random.random() < 0.5 else "fixed"
    values |= {"makeup.check_valves": "present", "daq.bits": int(random.integers(12, 17))}
    for name in ("p_A", "p_B"):
        skew = LONG_SKEW if random.random() < 0.5 else SHORT_SKEW
        values[f"sensors.{name}.delay"] = random.uniform(0.0, skew)
        values |= {f"sensors.{name}.noise": random.uniform(0.6, 1.4) * PSI, f"sensors.{name}.hum": 0.0}
    command = COMMANDS[int(random.integers(len(COMMANDS)))]
    values["motor.omega_per_volt"] = float(rig.motor.omega_per_volt) * random.uniform(*SPEEDS.get(command, (0.9, 2.2)))
    hum = None
    if random.random() < HUMMING:
        amplitudes = random.uniform(0.0, 1.2, (2, 3)) * PSI / np.arange(1, 4)
        frequency = random.choice([50.0, 60.0]) * (1.0 + random.uniform(-1e-3, 1e-3))
        hum = Hum(float(frequency), amplitudes, random.uniform(0.0, 2.0 * np.pi, (2, 3)))
    return replace(drawn, overrides=values, command=parse_command(command)), hum, float(random.uniform(70.0, 110.0))


def judged(seed: int, lpm: float, law: str) -> tuple[Evidence, float, BenchMachine]:
    """Return what the pressure model says of a machine under a leak, and the flow [L/min] that there was."""
    own, hum, onset = machine(seed)
    leak = f"{lpm} L/min {'orifice ' if law == 'orifice' else ''}from {onset} s" if lpm else None
    number = 10 * seed + LEAKS.index((lpm, law))
    simulated = simulate_with_truth(own.experiment(seed=number, leak=leak))
    recording = simulated.recording.only(CHANNELS)
    recording = recording if hum is None else hum.on(recording)
    evidence = PressureModel(load_rig("thesis")).examine(recording, (), 0.01)
    return evidence, simulated.truth.mean_leak_lpm if lpm else 0.0, own


def rows(seeds: range) -> Iterator[str]:
    """Yield the table's lines, those of single records first."""
    table = []
    for lpm, law in LEAKS:
        verdicts, stated, holds = [], 0, 0
        for seed in seeds:
            evidence, flow, own = judged(seed, lpm, law)
            verdicts.append(evidence.verdict)
            if evidence.verdict == "leak" and lpm and evidence.leak_interval_lpm is not None:
                low, high = evidence.leak_interval_lpm
                stated, holds = stated + 1, holds + (low <= flow <= high)
            if evidence.verdict == "cannot tell" or (evidence.verdict == "leak" and not lpm):
                closed = f"{100 * own.closed:.0f} % closed"
                yield f"{seed}: {lpm:g} {law}, {own.command}, {closed}: {evidence.verdict}: {evidence.reason}"
        name = f"{law} {lpm:g} L/min" if lpm else "leak-free"
        found, open_ = verdicts.count("leak"), verdicts.count("cannot tell")
        table.append(f"| {name} | {found} of {len(verdicts)} | {open_} | {f'{holds} of {stated}' if lpm else ''} |")
    yield "| | `leak` | `cannot tell` | interval holds |\n| --- | --- | --- | --- |"
    yield from table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0, help="number of the first machine")
    parser.add_argument("--machines", type=int, default=12)
    chosen = parser.parse_args()
    for line in rows(range(chosen.first, chosen.first + chosen.machines)):
        print(line, flush=True)


if __name__ == "__main__":
    main()
