"""Leaks past a rod seal to the outside: the flow that a watch states, beside the flow that left the chamber.

    python benchmarks/outside_leaks.py [--development]

The priors `watch.outside` and `explanation.outside` of `diagnosis/live/priors.toml` were chosen on the simulations of
`--development`; others, drawn at random, judge them. A rod seal's flow is given at the charge pressure; what leaves is
that flow times the chamber's mean pressure over the charge pressure. The circuit has check valves, without which it
would run empty.
"""

from __future__ import annotations

import argparse

import numpy as np
from threadpoolctl import threadpool_limits

import sealscope as ss

ONSET_S, DURATION_S = 120.0, 240.0
#: Command, leaking side, flow at the charge pressure [L/min], charge pressure [MPa], force of the load [N].
DEVELOPMENT = (
    ("3 sin(4t)", "A", 0.0042, 0.3, 0.0),
    ("3 sin(4t)", "B", 0.0042, 0.3, 0.0),
    ("3 sin(4t)", "A", 0.0042, 0.24, 0.0),
    ("2 sin(3t)", "A", 0.01, 0.36, 0.0),
    ("2 sin(3t)+1 sin(7t)", "B", 0.02, 0.3, 0.0),
    ("3 sin(4t)", "A", 0.0042, 0.3, 60.0),
    ("3 sin(4t)", "A", 0.0042, 0.3, -60.0),
    ("3 sin(4t)", "A", 0.0042, 0.3, -300.0),
    ("2.5 sin(5t)", "A", 0.006, 0.33, 0.0),
    ("3.5 sin(3.3t)", "B", 0.003, 0.27, 0.0),
    ("3 sin(4t)", "B", 0.015, 0.5, 0.0),
    ("2 sin(4t)+1.5 sin(9t)", "A", 0.008, 0.3, 0.0),
    ("3 sin(4t)", "A", 0.0042, 0.2, 0.0),
    ("3 sin(2.5t)", "B", 0.0042, 0.3, 40.0),
    ("3 sin(4t)", "B", 0.01, 0.3, -50.0),
    ("3 sin(4t)", "A", 0.05, 0.3, 0.0),
)

#: Seed of the simulations that judge, and their number.
JUDGED, N_JUDGED = 20261130, 12
Leak = tuple[str, str, float, float, float]


def draw_leak(random: np.random.Generator) -> Leak:
    """Draw a leak and its machine, as in `DEVELOPMENT`: a sine or two, and a load in half of the cases."""
    command = f"{random.uniform(2, 4):.2g} sin({random.uniform(2, 6):.2g}t)"
    if random.random() < 0.4:
        command += f"+{random.uniform(0.5, 2):.2g} sin({random.uniform(5, 9):.2g}t)"
    side, lpm = "AB"[random.integers(2)], np.exp(random.uniform(np.log(0.003), np.log(0.05)))
    charge, load = random.uniform(0.2, 0.5), random.choice([0, 0, 0, 0, 30, -40, 50, -60])
    return command, side, float(f"{lpm:.2g}"), float(f"{charge:.2g}"), float(load)


def main() -> None:
    """Print a line for each simulation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--development", action="store_true", help="the simulations that the prior was chosen on")
    development = parser.parse_args().development
    random = np.random.default_rng(JUDGED)
    leaks = DEVELOPMENT if development else [draw_leak(random) for _ in range(N_JUDGED)]
    with threadpool_limits(limits=1):
        for number, leak in enumerate(leaks):
            print_statement(*leak, seed=number + (1 if development else 100))


def print_statement(command: str, side: str, lpm: float, charge: float, load: float, seed: int) -> None:
    """Simulate a leak, watch it, and print the stated cause and flow."""
    recording = ss.simulate(
        command=command,
        duration=DURATION_S,
        seed=seed,
        set={"makeup.check_valves": "present", "p_charge": f"{charge} MPa", "cylinder.F_l": f"{load} N"},
        fault=f"rod seal {side} {lpm} L/min from {ONSET_S} s",
    )
    watch = ss.watch("thesis", learn_hours=100.0 / 3600.0)
    estimate = watch.update(recording)[-1]
    true = lpm * float(recording.between(ONSET_S, DURATION_S)[f"p_{side}"].mean()) / (1e6 * charge)
    print(f"{command}, rod seal {side}, {charge:g} MPa, {load:g} N: {true:.5f} L/min leaves", end="; ")
    if watch.leak is None or estimate.leak_lpm is None or estimate.leak_interval_lpm is None:
        print("no leak")
        return
    low, high = estimate.leak_interval_lpm
    print(f"{watch.leak.cause}, {estimate.leak_lpm:.5f} ({low:.5f} to {high:.5f}),", end=" ")
    print(f"{estimate.leak_lpm / true:.2f} of it, {'within' if low <= true <= high else 'NOT within'}", flush=True)


if __name__ == "__main__":
    main()
