"""Verdicts of `pressure model` on machines of the bench that it was developed on, from pressures and command.

    python benchmarks/pressure_model.py slow --newtons 10 45 --machines 16 --seed 61
    python benchmarks/pressure_model.py slow --newtons 8 28 --machines 40 --seed 62 [--leaks 0 0.0042 0.05 0.5]
    python benchmarks/pressure_model.py slow --newtons 6 28 --machines 60 --seed 63 --leaks 0
    python benchmarks/pressure_model.py quick --newtons 5 28 --machines 48 --seed 64 --leaks 0
    python benchmarks/pressure_model.py warm --machines 16 --seed 61
    python benchmarks/pressure_model.py warm --machines 24 --seed 66
    python benchmarks/pressure_model.py warm --machines 40 --seed 72
    python benchmarks/pressure_model.py one-sided --machines 40 --seed 65 --leaks 0 0.0042
    python benchmarks/pressure_model.py plain --machines 120 --seed 71 --leaks 0
    python benchmarks/pressure_model.py plain --machines 40 --seed 70 --leaks 0 0.0042 0.1
    python benchmarks/pressure_model.py plain --rate 100 --machines 48 --seed 67 --leaks 0 0.015 0.1 0.5
    python benchmarks/pressure_model.py plain --rate 140 --machines 48 --seed 68 --leaks 0 0.015 0.1
    python benchmarks/pressure_model.py plain --rate 100 --machines 24 --seed 69 --leaks 0 0.1 --family "mains hum"

Machines of the profile `bench`, 180 s, the leak by either law in turn from 90 s on, sized in cold oil. `slow`: a force
that ramps, or swings at 0.015 to 0.06 rad/s; `quick`: at 0.1 to 0.6 rad/s; `warm`: oil that warms by 15 to 35 K within
60 to 180 s; `one-sided`: friction of the way back 0.6 to 1.6 times that of the way out; `plain`: nothing of these.
`--rate` is that of the recording [Hz], 500 where it is not given; `--family`: a development family of
`bench-strangers`. The detector knows the rig as designed, and neither onset, force nor temperature; it was developed on
these machines (docs/decisions/0058 to 0062). A record takes 2 to 15 s of a core.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

from sealscope.campaigns.cases.machines import sized_once
from sealscope.diagnosis.pressure_model.detector import PressureModel
from sealscope.parameters import load_rig
from sealscope.simulation.bench.machines import BenchMachine, draw
from sealscope.simulation.courses import parse_force
from sealscope.simulation.simulate import simulate_with_truth

SECONDS, ONSET = 180.0, 90.0
#: Rates of the forces [rad/s]; length of a kind's first name in the seed of its draws, which keeps them what they were.
RATES = {"slow": (0.015, 0.06), "quick": (0.1, 0.6)}
_NAMED = {"slow": 5, "quick": 5, "warm": 4, "one-sided": 4, "plain": 5}


def disturbed(
    kind: str, seed: int, number: int, newtons: tuple[float, float], family: str
) -> tuple[BenchMachine, str | None]:
    """Return a machine of the bench with a disturbance, and its fault in words."""
    profile = "strangers" if family else "bench"
    machine = draw(profile, 1000 * seed + number, duration=SECONDS, family=family)
    random = np.random.default_rng([seed, number, _NAMED[kind]])
    if kind == "plain":
        return machine, None
    if kind == "warm":
        kelvin, until = random.uniform(15, 35), random.uniform(60, 180)
        return machine, f"oil +{kelvin:.0f} K growing from 0 s to {until:.0f} s"
    if kind == "one-sided":
        back = float(random.uniform(0.6, 1.6))
        return replace(machine, overrides={**machine.overrides, "friction.backward": back}), None
    size, _, rate = random.uniform(*newtons), random.uniform(10, 30), random.uniform(*RATES[kind])
    words = f"{size:.0f} N sin({rate:.4f}t)"
    if kind == "slow" and number % 2 == 0:
        words = f"ramp {size:.0f} N from {20 + 5 * number % 60} s to {100 + 7 * number % 70} s"
    return replace(machine, load=parse_force(words)), None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=sorted(_NAMED))
    parser.add_argument("--newtons", type=float, nargs=2, default=(10.0, 45.0))
    parser.add_argument("--machines", type=int, default=16)
    parser.add_argument("--seed", type=int, default=61)
    parser.add_argument("--rate", type=float)
    parser.add_argument("--family", default="")
    parser.add_argument("--leaks", type=float, nargs="+", default=[0.0, 0.0042])
    given = parser.parse_args()
    model = PressureModel(load_rig("thesis"))
    for lpm in given.leaks:
        verdicts, held = Counter[str](), Counter[str]()
        for number in range(given.machines):
            machine, fault = disturbed(given.kind, given.seed, number, tuple(given.newtons), given.family)
            if given.rate is not None:
                machine = replace(machine, overrides={**machine.overrides, "daq.sample_rate": given.rate})
            law = ("laminar", "orifice")[number % 2]
            leak = f"{lpm:g} L/min {law} from {ONSET:g} s" if lpm else ()
            run = machine.experiment(seed=77 * given.seed + number, fault=fault or (), leak=leak)
            simulated = simulate_with_truth(replace(run, leaks=sized_once(run)))
            evidence = model.examine(simulated.recording.only(("u", "p_A", "p_B")), [], 0.01)
            verdicts[evidence.verdict] += 1
            if lpm and evidence.leak_interval_lpm is not None:
                low, high = evidence.leak_interval_lpm
                held["holds" if low <= simulated.truth.mean_leak_lpm <= high else "misses"] += 1
        print(
            f"{lpm:g} L/min: "
            + ", ".join(f"`{verdict}` {verdicts[verdict]}" for verdict in ("leak", "no leak", "cannot tell"))
            + f" of {given.machines}; intervals that hold: {held['holds']} of {held.total()}",
            flush=True,
        )


if __name__ == "__main__":
    main()
