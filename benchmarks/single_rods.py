"""Single-rod machines drawn at random: leaks found and sized by the volume balance, by the family of the load.

    python benchmarks/single_rods.py [--half developed|judged] [--machines 8] [--seed 1]

Each machine has areas, stroke, pump, oil, friction, charge and load of its own, drawn about `single-rod-eha`; the
detector is given its areas and its displacement and nothing else. A family departs in one way. The volume balance was
developed on the families of the first half, and is judged on the others. Every other one follows a position. Each is
recorded with a leak of 1 to 10 % of its pump's mean flow, by either law in turn, that opens half way, and once without.
Prints a line a family: of so many leaks found; of so many intervals of L/min that hold the mean flow while the leak is
open, where no end stop is reached; and of so many leak-free records called a leak.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tally import Tally, judge, print_heads, print_row

from sealscope.errors import InputError, SimulationFailed
from sealscope.evaluation.binomial import clopper_pearson
from sealscope.parameters import Rig, load_rig
from sealscope.parameters.new_rig import rig_text
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import Run, simulate_experiment
from sealscope.units import LITRE_PER_MINUTE

DEVELOPED = ("constant load", "swinging load")
JUDGED = ("spring", "damper", "bristles", "one-sided friction", "unequal hoses")
LAWS = ("laminar", "orifice")
SECONDS, P = 80.0, 0.01
#: Largest force of a load over the piston's larger area [Pa].
_PRESSED = 2.5e6


@dataclass(frozen=True)
class Machine:
    """A machine: its rig, which is the assumed one, too, its command, its load and the size of its leak."""

    rig: Rig
    command: str
    load: str
    lpm: float
    seed: int

    def experiment(self, law: str | None) -> Experiment:
        """Return the machine's record, with a leak by a law, or without."""
        leak = None
        if law is not None:
            leak = f"{self.lpm:.6g} L/min {'orifice ' if law == 'orifice' else ''}from {SECONDS / 2} s"
        return Experiment.of(
            rig=self.rig, command=self.command, load=self.load, duration=SECONDS, leak=leak, seed=self.seed
        )


def stopped(simulated: Run, stroke: float) -> bool:
    """Return whether the piston reaches an end stop, where the leak has another pressure than in motion."""
    return bool(np.any(np.abs(simulated.truth.outputs["x"]) >= 0.5 * stroke))


def machine(family: str, number: int, seed: int) -> Machine:
    """Draw a machine of a family."""
    random = np.random.default_rng([seed, number, sum(family.encode())])
    area = 1e-4 * np.exp(random.uniform(np.log(8.0), np.log(50.0)))
    small = area * random.uniform(0.4, 0.85)
    stroke, pump = random.uniform(0.2, 0.6), area * 5e-3 * random.uniform(0.7, 1.4)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.toml"
        path.write_text(rig_text("machine", area, small, stroke, pump), encoding="utf-8")
        rig = load_rig(path)
    factor = {
        name: float(random.uniform(*limits))
        for name, limits in {
            "friction.F_pr": (0.5, 2.5),
            "friction.F_cfr": (0.5, 3.0),
            "friction.F_v": (0.5, 2.0),
            "fluid.K_oil": (0.6, 1.6),
            "fluid.p_charge": (0.5, 2.0),
            "cylinder.V": (0.9, 1.4),
            "cylinder.M_eq": (0.5, 2.0),
            "makeup.p_crack": (0.5, 2.0),
        }.items()
    }
    numbers: dict[str, Any] = {}
    for name, value in factor.items():
        part, field = name.split(".")
        numbers[name] = getattr(getattr(rig, part), field) * value
    numbers["pump.G_pump"] = float(rig.pump.G_pump * pump / 16e-6 * random.uniform(0.3, 2.0))
    volts, rate = ((3, 2), (5, 2), (4, 1), (2, 1), (6, 3))[random.integers(5)]
    amplitude = volts * rig.motor.omega_per_volt * pump / (2.0 * np.pi) / (area * rate)
    command = f"position {1e3 * amplitude:.4g} mm sin({rate}t)" if number % 2 else f"{volts} sin({rate}t)"
    force = area * _PRESSED * random.uniform(-1.0, 1.0)
    load = f"{force:.3f} N"
    if family == "swinging load":
        swing = 0.5 * area * _PRESSED * random.uniform(0.2, 1.0)
        load = f"{swing:.3f} N sin({random.uniform(0.2, 1.5):.3g}t) {'-' if force < 0.0 else '+'} {abs(force):.3f} N"
    elif family == "spring":
        numbers["cylinder.k_load"] = area * _PRESSED * random.uniform(0.2, 1.0) / (0.1 * stroke)
    elif family == "damper":
        numbers["cylinder.d_load"] = area * _PRESSED * random.uniform(0.2, 1.0) / 0.1
        load = f"{0.3 * force:.3f} N"
    elif family == "bristles":
        numbers["friction.law"] = "lugre"
    elif family == "one-sided friction":
        numbers["friction.backward"] = random.uniform(0.5, 2.0)
    elif family == "unequal hoses":
        numbers["cylinder.V_hose_A"] = rig.cylinder.V * random.uniform(0.0, 1.0)
        numbers["cylinder.V_hose_B"] = rig.cylinder.V * random.uniform(0.0, 0.5)
    share = float(np.exp(random.uniform(np.log(0.01), np.log(0.1))))
    flow = 2.0 / np.pi * volts * rig.motor.omega_per_volt * pump / (2.0 * np.pi) / LITRE_PER_MINUTE
    return Machine(rig.with_overrides(numbers), command, load, flow * share, number)


def machines(family: str, count: int, seed: int) -> Iterator[Machine]:
    """Yield machines of a family."""
    yield from (machine(family, number, seed) for number in range(count))


def tally_family(family: str, count: int, seed: int) -> tuple[Tally, Tally]:
    """Judge the machines of a family: their records with a leak, and without."""
    leaking, healthy = Tally(), Tally()
    for number, drawn in enumerate(machines(family, count, seed)):
        for law in (LAWS[number % 2], None):
            try:
                simulated = simulate_experiment(drawn.experiment(law))
            except (InputError, SimulationFailed):
                continue
            evidence = judge(simulated.recording, "volume balance", rig=drawn.rig, false_alarm=P)
            if law is None:
                healthy.add(evidence)
                continue
            sized = not stopped(simulated, drawn.rig.cylinder.L)
            leaking.add(evidence, simulated.truth.mean_leak_lpm if sized else None)
    return leaking, healthy


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=("developed", "judged"), default="judged")
    parser.add_argument("--machines", type=int, default=8, help="of each family")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    print_heads("family", "leak-free")
    total: list[bool] = []
    for family in DEVELOPED if chosen.half == "developed" else JUDGED:
        leaking, healthy = tally_family(family, chosen.machines, chosen.seed)
        total += leaking.holds
        print_row(family, healthy.leaks(), *leaking.cells())
    low, high = clopper_pearson(sum(total), len(total))
    print(f"{sum(total)} of {len(total)} intervals hold ({100.0 * low:.0f} to {100.0 * high:.0f} %)")


if __name__ == "__main__":
    main()
