"""Leaks past a rod seal to the outside, as a watch states them: L/min against what left the chamber.

    python benchmarks/outside_leaks.py [--development] [--pressures]

The flow of a rod seal is stated at the charge pressure; what leaves is that flow times the chamber's mean pressure over
it. The circuit has a make-up, without which it would run empty. With `--pressures` the watch gets the chamber pressures
and the command alone, and longer records.
"""

from __future__ import annotations

import argparse

from threadpoolctl import threadpool_limits

import sealscope as ss

ONSET_S, DURATION_S = 120.0, 240.0
#: Command, side, L/min at the charge pressure, charge pressure [MPa], force of the load [N].
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
    """Print a line a record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--development", action="store_true", help="the records on which the factors were chosen")
    parser.add_argument("--pressures", action="store_true", help="watched from pressures and command")
    chosen = parser.parse_args()
    with threadpool_limits(limits=1):
        for number, record in enumerate(DEVELOPMENT if chosen.development else JUDGED):
            stated(*record, seed=number + (1 if chosen.development else 11), pressures=chosen.pressures)


def stated(command: str, side: str, lpm: float, charge: float, load: float, *, seed: int, pressures: bool) -> None:
    """Simulate a record, watch it, and print what is stated of its leak."""
    onset, duration, learned = (900.0, 1500.0, 300.0) if pressures else (ONSET_S, DURATION_S, 100.0)
    recording = ss.simulate(
        command=command,
        duration=duration,
        seed=seed,
        set={"makeup.check_valves": "present", "p_charge": f"{charge} MPa", "cylinder.F_l": f"{load} N"},
        fault=f"rod seal {side} {lpm} L/min from {onset} s",
    )
    watch = ss.watch("thesis", learn_hours=learned / 3600.0)
    estimate = watch.update(recording.only(("p_A", "p_B", "u")) if pressures else recording)[-1]
    true = lpm * float(recording.between(onset, duration)[f"p_{side}"].mean()) / (1e6 * charge)
    print(f"{command}, rod seal {side}, {charge:g} MPa, {load:g} N: {true:.5f} L/min leave", end="; ")
    if watch.leak is None or estimate.leak_lpm is None or estimate.leak_interval_lpm is None:
        print("no leak", watch.counters)
        return
    low, high = estimate.leak_interval_lpm
    print(f"{watch.leak.cause}, {estimate.leak_lpm:.5f} ({low:.5f} to {high:.5f}),", end=" ")
    print(f"{estimate.leak_lpm / true:.2f} of it, {'within' if low <= true <= high else 'NOT within'}", flush=True)


if __name__ == "__main__":
    main()
