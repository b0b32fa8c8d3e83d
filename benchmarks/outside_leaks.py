"""Leaks past a rod seal to the outside: the flow that a watch states, beside the flow that left the chamber.

    python benchmarks/outside_leaks.py [--development]

The prior `watch.outside` of `diagnosis/live/priors.toml` was chosen on the simulations of `--development`; the others
judge it. A rod seal's flow is given at the charge pressure; what leaves is that flow times the chamber's mean pressure
over the charge pressure. The circuit has check valves, without which it would run empty.
"""

from __future__ import annotations

import argparse

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
)
JUDGED = (
    ("2.5 sin(5t)", "A", 0.006, 0.33, 0.0),
    ("3.5 sin(3.3t)", "B", 0.003, 0.27, 0.0),
    ("3 sin(4t)", "B", 0.015, 0.5, 0.0),
    ("2 sin(4t)+1.5 sin(9t)", "A", 0.008, 0.3, 0.0),
    ("3 sin(4t)", "A", 0.0042, 0.2, 0.0),
    ("3 sin(2.5t)", "B", 0.0042, 0.3, 40.0),
    ("3 sin(4t)", "B", 0.01, 0.3, -50.0),
    ("3 sin(4t)", "A", 0.05, 0.3, 0.0),
)


def main() -> None:
    """Print a line for each simulation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--development", action="store_true", help="the simulations that the prior was chosen on")
    development = parser.parse_args().development
    with threadpool_limits(limits=1):
        for number, record in enumerate(DEVELOPMENT if development else JUDGED):
            print_statement(*record, seed=number + (1 if development else 11))


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
