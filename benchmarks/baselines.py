"""Measure the false alarms of the level tests against 1, 2, 3, 5 and 10 baseline recordings, on fresh machines.

    python benchmarks/baselines.py [--machines 24] [--days 12] [--duration 86] [--seed 0] [--json FILE]

Each machine of the bench profile is recorded on several leak-free days. It keeps what it is made of (pump, seals,
oil, duty); from day to day differ charge pressure, zeros and noise of the transducers, all drifts, and the oil's
temperature by a normal deviate of two kelvin (pump leakage 4 % a kelvin, friction -2 %, stiffness -0.5 %), and the
friction by another 3 % (how the seals lie). Every detector's level is computed once a recording; then each day is
compared with random sets of the machine's other days. One row a detector: the share of alarms at a nominal 1 % and 5 %,
and the scatter from day to day that was seen over the scale that the prior states. Days of one machine and sets of one
day are not independent: the standard error is that over machines.
"""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from sealscope.diagnosis.baseline.level import DayToDay, Level, rise_of
from sealscope.diagnosis.observer.against_baseline import day_to_day as observer_prior
from sealscope.diagnosis.observer.against_baseline import level as observer_level
from sealscope.diagnosis.observer.detector import Observer
from sealscope.diagnosis.observer.evidence import misfit
from sealscope.diagnosis.pressure_model.detector import DAY_TO_DAY, PressureModel, is_followed
from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.evidence import day_to_day as balance_prior
from sealscope.diagnosis.volume_balance.evidence import level as balance_level
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.simulate import simulate_with_truth

COUNTS, NOMINAL = (1, 2, 3, 5, 10), (0.01, 0.05)
#: Sets of baseline recordings for each day and count.
SETS = 12
KELVIN, SEALS = 2.0, 0.03
PER_KELVIN = {"pump.G_pump": 0.04, "friction.F_pr": -0.02, "friction.F_cfr": -0.02, "friction.F_v": -0.02,
              "fluid.K_oil": -0.005}  # fmt: skip
OF_THE_DAY = re.compile(r"fluid\.p_charge|sensors\.p_.*(offset|noise|hum)")
PRESSURES = ("u", "p_A", "p_B")
DETECTORS = ("volume balance", "pressure model", "observer, all channels", "observer, pressures and command")


def recorded(machine: int, day: int, seed: int, duration: float) -> Recording:
    """Return a leak-free recording of a machine on one day."""
    own = draw("bench", seed + 1000 * machine, duration=duration)
    today = draw("bench", seed + 1000 * machine + day + 1, duration=duration)
    random = np.random.default_rng((seed, machine, day))
    kelvin, seals = KELVIN * random.standard_normal(), 1.0 + SEALS * random.standard_normal()
    values = dict(own.overrides)
    values |= {name: value for name, value in today.overrides.items() if OF_THE_DAY.fullmatch(name)}
    for name, share in PER_KELVIN.items():
        number = float(values.get(name, own.rig[name]))
        values[name] = number * (1.0 + share * kelvin) * (seals if name.startswith("friction") else 1.0)
    return simulate_with_truth(
        replace(own, overrides=values, drifts=today.drifts).experiment(seed=today.seed)
    ).recording


def levels_of(recording: Recording) -> dict[str, Level]:
    """Return the levels of all detectors that follow a recording."""
    rig = load_rig("thesis")
    levels: dict[str, Level] = {}
    fit, _ = VolumeBalance(rig).fit(recording)
    if fit is not None:
        levels[DETECTORS[0]] = balance_level(fit)
    followed = PressureModel(rig).follow(recording)
    if not isinstance(followed, str) and is_followed(followed):
        levels[DETECTORS[1]] = followed.level
    for name, view in ((DETECTORS[2], recording), (DETECTORS[3], recording.only(PRESSURES))):
        series = Observer(rig).follow(view)
        if misfit(series.estimates, series.formulation, rig) is None:
            levels[name] = observer_level(series)
    return levels


def prior_of(detector: str, baseline: list[Level]) -> DayToDay:
    """Return the prior that a detector states."""
    if detector == DETECTORS[0]:
        return balance_prior(baseline)
    if detector == DETECTORS[1]:
        return DAY_TO_DAY
    return observer_prior("volume" if detector == DETECTORS[2] else "command", baseline)


def alarms_of(levels: list[list[Level]], detector: str, count: int, probability: float) -> tuple[float, float]:
    """Return the share of alarms over machines (of levels of their days), and its standard error."""
    random = np.random.default_rng(count)
    shares = []
    for days in levels:
        alarms = []
        for own, day in enumerate(days):
            others = [other for number, other in enumerate(days) if number != own]
            if len(others) < count:
                continue
            for _ in range(SETS):
                baseline = [others[k] for k in random.choice(len(others), count, replace=False)]
                rise = rise_of(day, baseline, prior_of(detector, baseline), probability)
                alarms.append(rise.score > rise.threshold)
        if alarms:
            shares.append(np.mean(alarms))
    return float(np.mean(shares)), float(np.std(shares, ddof=1) / np.sqrt(len(shares)))


def main() -> None:
    """Simulate, compute all levels, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=24)
    parser.add_argument("--days", type=int, default=12, help="recordings of each machine, at least 11")
    parser.add_argument("--duration", type=float, default=86.0, help="of a recording [s]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write all levels and errors to this file")
    chosen = parser.parse_args()
    if chosen.machines < 2 or chosen.days < max(COUNTS) + 1:
        parser.error(f"--machines must be 2 or more and --days {max(COUNTS) + 1} or more")
    levels: dict[str, list[list[Level]]] = {name: [] for name in DETECTORS}
    for machine in range(chosen.machines):
        days = [levels_of(recorded(machine, day, chosen.seed, chosen.duration)) for day in range(chosen.days)]
        for name in DETECTORS:
            levels[name].append([day[name] for day in days if name in day])
    print(
        f"{chosen.machines} machines on {chosen.days} days, {chosen.duration:g} s each; "
        "false alarms in % (standard error)"
    )
    heads = "".join(f"{f'{count} baseline(s)':>15}" for count in COUNTS)
    print(f"{'detector':<34}{'nominal':>8}{heads}{'scatter/prior':>15}")
    for name in DETECTORS:
        kept = [days for days in levels[name] if len(days) > 1]
        seen = np.sqrt(np.mean([np.var([day.value for day in days], ddof=1) for days in kept]))
        stated = np.mean([prior_of(name, days).scale for days in kept])
        for probability in NOMINAL:
            cells = []
            for count in COUNTS:
                share, error = alarms_of(kept, name, count, probability)
                cells.append(f"{f'{100 * share:.1f} ({100 * error:.1f})':>15}")
            print(f"{name:<34}{100 * probability:>6.0f} %{''.join(cells)}{seen / stated:>15.2f}", flush=True)
    if chosen.json:
        plain = {name: [[(day.value, day.error) for day in days] for days in kept] for name, kept in levels.items()}
        chosen.json.write_text(json.dumps(plain) + "\n")


if __name__ == "__main__":
    main()
