"""Actuators watched from pressures and command while their oil warms: false alarms per 1000 h, delays of leaks.

    python benchmarks/monitor_pressures.py [--machines 8] [--pieces 6] [--piece-minutes 60] [--learn-hours 2]

Nothing is composed here: every sample is simulated, in pieces of `--piece-minutes` with pauses of 1 or 20 min between
them (a short one the response bridges, after a long one it begins anew). Each machine is the thesis's rig with a
stiffness of 550 to 750 MPa, friction within 10 %, pump leakage of 0.6e-13 to 4e-13 m^3/(s Pa) in cold oil, zeros of the
pressures within 2 psi, and a command in turn from three; the watch assumes the rig as designed. Over a shift

    oil warms from 20 to 50 C with a time constant of 1 to 3 h: conductance x 4 (and an Ornstein-Uhlenbeck process of
    3 % and 40 min), viscous friction / 4, Coulomb friction -15 % (and a process of 10 % and 3 h), stiffness -15 %;
    charge pressure is another process (20 %, 6 h), and each pressure's zero (0.25 psi, 2 h), noise 1 or 1.6 times the
    rig's from one piece to the next.

The baseline is learned over the first `--learn-hours`. Stated are 100 false alarms per 1000 h, as dozens of hours
cannot tell 1 from 0. An alarm is dismissed as a person would. Before the last piece the state is copied, with 1 per
1000 h in place of 100, and the copies go on with leaks that begin 12 min later: steps of 0.002, 0.0042, 0.015 and 0.05
L/min, 0.0042 L/min past a rod seal to the outside, and a growth from 0 to 0.05 L/min in an hour.

Each machine is a row, and each leak, of `results/monitor_pressures.csv`; a second call goes on with those that are
missing, and the sums over all rows of these settings are printed.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
from scipy.special import gammaincinv
from stored_rows import StoredRows
from threadpoolctl import threadpool_limits

import sealscope as ss
from sealscope.simulation.changes import ParameterDrift
from sealscope.simulation.commands import polyline_from_table

RESULTS = Path(__file__).parent / "results" / "monitor_pressures.csv"
ONSET_S = 720.0
COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)")
#: Stated false alarms per 1000 h of the healthy machines, and of those that leak.
HEALTHY_RATE, LEAKING_RATE = 100.0, 1.0
GROWTH = "growth to 0.05 in an hour"
SIZES = {"step 0.002": 0.002, "step 0.0042": 0.0042, "step 0.015": 0.015, "step 0.05": 0.05, "rod seal 0.0042": 0.0042}
LEAKS = {
    **{kind: {"leak": f"{lpm} L/min from {ONSET_S} s"} for kind, lpm in SIZES.items() if kind.startswith("step")},
    "rod seal 0.0042": {"fault": f"rod seal A 0.0042 L/min from {ONSET_S} s"},
    GROWTH: {"leak": f"0.05 L/min growing from {ONSET_S} s to {ONSET_S + 3600.0} s"},
}
COLUMNS = (
    *("seed", "machine", "command", "kind", "rate", "judged_hours", "false_alarms", "by_test", "delay_s"),
    *("test", "true_lpm", "stated_lpm", "stated_low_lpm", "stated_high_lpm", "counters"),
)
PSI = 6894.757
#: Noise of the pressures [psi].
NOISE_PSI = {"p_A": 0.92829, "p_B": 1.26445}


class Wander:
    """An Ornstein-Uhlenbeck process, at even times."""

    def __init__(self, random: np.random.Generator, size: float, seconds: float) -> None:
        self._random, self._size, self._seconds = random, size, seconds
        self.value = size * random.standard_normal()

    def course(self, count: int, spacing: float) -> np.ndarray:
        """Return so many values, so many seconds apart, from the present one on."""
        decay, values = math.exp(-spacing / self._seconds), []
        for _ in range(count):
            values.append(self.value)
            self.value = decay * self.value + self._size * math.sqrt(1.0 - decay**2) * self._random.standard_normal()
        return np.array(values)


class Machine:
    """A machine that works through a shift, piece by piece."""

    def __init__(self, seed: int, number: int) -> None:
        self.random = random = np.random.default_rng([seed, number])
        self.command = COMMANDS[number % len(COMMANDS)]
        self.friction, self.K_oil = random.uniform(0.9, 1.1), random.uniform(550e6, 750e6)
        self.G_pump, self.tau = random.uniform(0.6e-13, 4e-13), random.uniform(1.0, 3.0) * 3600.0
        self.zeros = {name: random.uniform(-2.0, 2.0) for name in NOISE_PSI}
        self.slow, self.rubs = Wander(random, 0.03, 2400.0), Wander(random, 0.1, 3 * 3600.0)
        self.charge, self.warm = Wander(random, 0.2, 6 * 3600.0), 0.0
        self.wandering = {name: Wander(random, 0.25 * PSI, 2 * 3600.0) for name in NOISE_PSI}
        self.clock, self.pieces = 1000.0, 0
        self._seeds = 100_000 * (seed + 1) + 1000 * number

    def piece(self, duration: float, **fails: str) -> ss.Recording:
        """Return the next piece of its life; `fails`: the leak or fault that begins in it."""
        t = np.linspace(0.0, duration, round(duration / 60.0) + 1)
        warm = 1.0 - (1.0 - self.warm) * np.exp(-t / self.tau)
        rubs = self.friction * np.exp(self.rubs.course(t.size, 60.0)) * (1.0 - 0.15 * warm)
        courses = {
            "friction.F_pr": 25.0 * rubs,
            "friction.F_cfr": 1e-6 * rubs,
            "friction.F_v": 300.0 * self.friction * 4.0**-warm,
            "pump.G_pump": self.G_pump * 4.0**warm * (1.0 + self.slow.course(t.size, 60.0)),
            "fluid.K_oil": self.K_oil * (1.0 - 0.15 * warm),
        }
        # within a run the charge pressure changes as both pressures do
        charge = 3e5 * np.exp(self.charge.course(t.size, 60.0))
        zeros = {name: charge - charge[0] + wander.course(t.size, 60.0) for name, wander in self.wandering.items()}
        noise = self.random.choice([1.0, 1.6])
        recording = ss.simulate(
            command=self.command,
            duration=duration,
            seed=self._seeds + self.pieces + (500 if fails else 0),
            **fails,
            drifts=[
                *(
                    ParameterDrift(name, polyline_from_table(t, course / course[0] - 1))
                    for name, course in courses.items()
                ),
                *(
                    ParameterDrift(f"sensors.{name}.offset", polyline_from_table(t, zero), absolute=True)
                    for name, zero in zeros.items()
                ),
            ],
            set={
                "makeup.check_valves": "present",
                "fluid.p_charge": float(charge[0]),
                **{name: float(course[0]) for name, course in courses.items()},
                **{f"sensors.{name}.noise": f"{noise * psi} psi" for name, psi in NOISE_PSI.items()},
                **{f"sensors.{name}.offset": f"{zero} psi" for name, zero in self.zeros.items()},
            },
        ).only(("p_A", "p_B", "u"))
        recording = ss.Recording(recording.t + self.clock, recording.channels, recording.units, recording.rate)
        self.warm, self.pieces = float(warm[-1]), self.pieces + 1
        self.clock += duration + self.random.choice([60.0, 1200.0])
        return recording


def watched(watch: ss.Watch, recording: ss.Recording) -> tuple[int, list[str]]:
    """Return how many blocks of a piece were judged, and the tests of its alarms, each dismissed."""
    judged, alarms = 0, []
    for first in range(0, len(recording), 500):
        for estimate in watch.update(recording.samples(slice(first, first + 500))):
            judged += estimate.status in ("watched", "alarm", "learning")
        if watch.leak is not None:
            alarms.append(watch.leak.test)
            watch.dismiss()
    return judged, alarms


def healthy(
    machine: Machine, pieces: int, seconds: float, learn_hours: float
) -> tuple[dict[str, object], str, Machine]:
    """Return the row, and the state after some hours with the machine as it was then."""
    import copy

    watch = ss.watch("thesis", false_alarms_per_1000_h=HEALTHY_RATE, learn_hours=learn_hours)
    judged, alarms, state, then = 0, list[str](), "", machine
    for k in range(pieces):
        if k == pieces - 1:
            state = json.dumps({**watch.state(), "false_alarms_per_1000_h": LEAKING_RATE})
            then = copy.deepcopy(machine)
        blocks, tests = watched(watch, machine.piece(seconds))
        judged += blocks
        alarms += tests
    row = {
        "kind": "healthy",
        "rate": HEALTHY_RATE,
        "judged_hours": f"{judged * watch.block_seconds / 3600.0:.2f}",
        "false_alarms": len(alarms),
        "by_test": " ".join(alarms),
        "counters": json.dumps(watch.counters),
    }
    return row, state, then


def leaking(state: str, machine: Machine, kind: str) -> dict[str, object]:
    """Return the row of a leak."""
    watch = ss.Watch.from_state(json.loads(state))
    duration = ONSET_S + (1800.0 if kind in SIZES else 3600.0)
    recording = machine.piece(duration, **LEAKS[kind])
    row: dict[str, object] = {"kind": kind, "rate": LEAKING_RATE, "false_alarms": 0}
    onset = float(recording.t[0]) + ONSET_S
    for first in range(0, len(recording), 500):
        estimates = watch.update(recording.samples(slice(first, first + 500)))
        if watch.leak is None:
            continue
        if watch.leak.raised_s < onset:
            row["false_alarms"] = 1
            watch.dismiss()
            continue
        after = watch.leak.raised_s - onset
        low, high = estimates[-1].leak_interval_lpm or ("", "")
        true = SIZES.get(kind, min(0.05, 0.05 * after / 3600.0))
        stated = {"stated_lpm": estimates[-1].leak_lpm, "stated_low_lpm": low, "stated_high_lpm": high}
        return {**row, "delay_s": f"{after:.0f}", "test": watch.leak.test, "true_lpm": true, **stated}
    return {**row, "counters": json.dumps(watch.counters)}


def main() -> None:
    """Watch, write rows, and print the sums."""
    import copy

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=8)
    parser.add_argument("--pieces", type=int, default=6)
    parser.add_argument("--piece-minutes", type=float, default=60.0)
    parser.add_argument("--learn-hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stop-after", type=float, default=20.0, help="no machine is begun after so many minutes")
    chosen = parser.parse_args()
    stored = StoredRows(
        RESULTS,
        COLUMNS,
        pieces=chosen.pieces,
        piece_minutes=chosen.piece_minutes,
        learn_hours=chosen.learn_hours,
    )
    began = time.monotonic()
    with threadpool_limits(limits=1):
        for number in range(chosen.machines):
            if stored.select(seed=chosen.seed, machine=number):
                continue
            if time.monotonic() - began > 60.0 * chosen.stop_after:
                break
            machine = Machine(chosen.seed, number)
            place = {"seed": chosen.seed, "machine": number, "command": machine.command}
            row, state, then = healthy(machine, chosen.pieces, 60.0 * chosen.piece_minutes, chosen.learn_hours)
            rows = [row, *(leaking(state, copy.deepcopy(then), kind) for kind in LEAKS)]
            for row in rows:
                stored.add({**place, **row})
    summarise(stored.select(), chosen.pieces * chosen.piece_minutes / 60.0)


def summarise(rows: list[dict[str, str]], hours: float) -> None:
    """Print the sums over machines of so many hours each."""
    mine = [row for row in rows if row["kind"] == "healthy"]
    judged, false = sum(float(row["judged_hours"]) for row in mine), sum(int(row["false_alarms"]) for row in mine)
    low = float(gammaincinv(false, 0.025)) if false else 0.0
    high = float(gammaincinv(false + 1, 0.975))
    print(
        f"{len(mine)} machines, {len(mine) * hours:g} h, {judged:.1f} h judged: {false} false alarms, "
        f"{1000 * false / judged:.1f} per 1000 h (95 %: {1000 * low / judged:.1f} to {1000 * high / judged:.1f}), "
        f"stated {HEALTHY_RATE:g}"
    )
    for kind in LEAKS:
        mine = [row for row in rows if row["kind"] == kind]
        alarmed = [row for row in mine if row["delay_s"]]
        line = f"{kind} L/min: {len(alarmed)} of {len(mine)} raised an alarm"
        if alarmed:
            delays = sorted(float(row["delay_s"]) for row in alarmed)
            shares = [float(row["stated_lpm"]) / float(row["true_lpm"]) for row in alarmed]
            held = sum(
                float(row["stated_low_lpm"]) <= float(row["true_lpm"]) <= float(row["stated_high_lpm"])
                for row in alarmed
            )
            line += (
                f", after {delays[0]:.0f} to {delays[-1]:.0f} s (median {np.median(delays):.0f} s), stated at "
                f"{min(shares):.2f} to {max(shares):.2f} of the truth, {held} intervals hold it"
            )
        print(line)


if __name__ == "__main__":
    main()
