"""Wear over weeks: when `sealscope trend` alarms, and at which flow, on simulated machines of one recording a day.

    python benchmarks/wear.py run FOLDER [--machines 200] [--pressures-of 40] [--seconds 540]
    python benchmarks/wear.py table FOLDER [--false-alarms 200]

`run` simulates the machines and keeps what each recording states, a line each, in FOLDER/levels.jsonl; it ends after so
many seconds, and the same call goes on where it stopped. A machine is one of the profile `bench`; from day to day the
temperature of its oil wanders (deviation 2 K, of which 0.7 lasts to the next day), and with it the pump's leakage
(4.5 % a kelvin), friction and stiffness, the seals' friction scatters by 2 % and the sensors' zeros by 0.1 psi; within
a day it drifts as the bench does. The first 20 days are healthy, then the piston's seal wears by 0.002 L/min a month
(laminar, at the machine's own mean pressure difference). Recordings of 120 s at 500 Hz. Level of `all channels`: volume
balance; of `pressures and command`: pressure response.

`table` runs the trend on them, knowing that the last 1, 2, 5 or 20 healthy days were healthy (and shown no earlier
one); the detector knows neither the machine, nor its temperature, nor when the wear begins. `--false-alarms N`: as many
machine-years of healthy days are drawn with the scatter and its correlation that the healthy days of these machines
show, and go through the same test.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.diagnosis.trend.reading import estimate_reading, scatter_prior
from sealscope.diagnosis.trend.wear import Levels, find_episodes, score_changes
from sealscope.evaluation.binomial import clopper_pearson
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.bench.machines import BenchMachine, draw
from sealscope.simulation.leaks import Leak
from sealscope.simulation.simulate import simulate_experiment
from sealscope.units import DAYS_PER_MONTH, DAYS_PER_YEAR, LITRE_PER_MINUTE

HEALTHY_DAYS, WORN_DAYS, SECONDS, YEARS = 20, 84, 120.0, 10.0
WEAR = 0.002
HEALTHY_COUNTS = (1, 2, 5, 20)
VIEWS = {"all channels": "volume balance", "pressures and command": "pressure response"}
#: Temperature of the oil from day to day [K], what of it lasts, and what a kelvin changes.
_KELVIN, _LASTS = 2.0, 0.7
_PER_KELVIN = {"pump.G_pump": 0.045, "fluid.K_oil": -0.005, "friction.F_v": -0.045}
_FRICTION, _ZERO = 0.02, 0.1 * 6894.757293168


def temperatures(seed: int) -> Array:
    """Temperature of the oil over all days, from the machine's usual one [K]."""
    random = np.random.default_rng([seed, 7])
    noise = random.standard_normal(HEALTHY_DAYS + WORN_DAYS)
    for k in range(1, noise.size):
        noise[k] = _LASTS * noise[k - 1] + math.sqrt(1.0 - _LASTS**2) * noise[k]
    return _KELVIN * noise


def machine_of(seed: int, day: int, kelvin: float) -> BenchMachine:
    """The machine of a seed on a day."""
    base = draw("bench", seed, duration=SECONDS)
    today = draw("bench", 100_000 + 1000 * seed + day, duration=SECONDS)  # its drifts within the record
    random = np.random.default_rng([seed, day])
    values = dict(base.overrides)
    for name, share in _PER_KELVIN.items():
        values[name] = float(values[name]) * math.exp(share * kelvin)
    friction = math.exp(_FRICTION * random.standard_normal())
    for name in ("friction.F_pr", "friction.F_cfr", "friction.F_v"):
        values[name] = float(values[name]) * friction
    for channel in ("p_1", "p_2", "p_A", "p_B"):
        values[f"sensors.{channel}.offset"] = float(values[f"sensors.{channel}.offset"]) + _ZERO * float(
            random.standard_normal()
        )
    return replace(base, overrides=values, drifts=today.drifts)


def recording_of(seed: int, day: int, kelvin: float, conductance: float) -> Recording:
    """The recording of a day, with a worn seal of that conductance."""
    machine = machine_of(seed, day, kelvin)
    leak = {"leak": Leak(coefficient=conductance)} if conductance > 0.0 else {}
    experiment = machine.experiment(seed=10_000_000 + 1000 * seed + day, **leak)
    return simulate_experiment(experiment).recording


def simulate(folder: Path, machines: int, pressures_of: int, seconds: float) -> None:
    """Simulate what is not yet there, machine by machine, for so many seconds."""
    begun, rig, path = time.monotonic(), load_rig("thesis"), folder / "levels.jsonl"
    folder.mkdir(parents=True, exist_ok=True)
    there = {(row["machine"], row["day"], row["view"]) for row in rows_of(path)}
    for seed in range(machines):
        views = dict(list(VIEWS.items())[: 1 + (seed < pressures_of)])
        warm, slope = temperatures(seed), math.nan
        for day in range(HEALTHY_DAYS + WORN_DAYS):
            wanted = [view for view in views if (seed, day, view) not in there]
            if not wanted:
                continue
            if time.monotonic() - begun > seconds:
                print(f"stopped at machine {seed} of {machines}, day {day}; call again to go on")
                return
            worn = max(0, day - HEALTHY_DAYS + 1)
            if worn and math.isnan(slope):
                first = recording_of(seed, 0, float(warm[0]), 0.0)
                pressure = float(np.mean(np.abs(first["p_A"] - first["p_B"])))
                slope = WEAR * LITRE_PER_MINUTE / pressure / DAYS_PER_MONTH
            recording = recording_of(seed, day, float(warm[day]), worn * slope if worn else 0.0)
            with path.open("a", encoding="utf-8") as file:
                for view in wanted:
                    channels_of_view = recording if view == "all channels" else recording.only(("u", "p_A", "p_B"))
                    own = estimate_reading(channels_of_view, rig)
                    row = {
                        "machine": seed,
                        "day": day,
                        "view": view,
                        "basis": own.basis,
                        "value": own.level if math.isfinite(own.level) else None,
                        "error": own.error if math.isfinite(own.error) else None,
                        "pressure": own.pressure,
                    }
                    file.write(json.dumps(row) + "\n")
    print(f"complete: {machines} machines")


def rows_of(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows that are whole."""
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


def machines_of(folder: Path, view: str) -> list[list[dict[str, Any]]]:
    """Return the days of each machine that is complete."""
    days: dict[int, dict[int, dict[str, Any]]] = defaultdict(dict)
    for row in rows_of(folder / "levels.jsonl"):
        if row["view"] == view:
            days[row["machine"]][row["day"]] = row
    whole = [own for own in days.values() if len(own) == HEALTHY_DAYS + WORN_DAYS]
    return [[own[day] for day in sorted(own)] for own in whole]


def levels_at(t: Array, value: Array, error: Array | float, basis: str, healthy_days: int, unit: float) -> Levels:
    """Return levels of recordings that can all be compared, with the prior as `sealscope trend` sets it."""
    zeros, own = np.zeros(len(t)), scatter_prior(basis, float(np.mean(value[:healthy_days])) / unit)  # type: ignore[arg-type]
    prior = own._replace(scale=own.scale * unit)
    return Levels(t, value, zeros + error, zeros.astype(np.int64), zeros, prior)


def levels_of(days: Sequence[dict[str, Any]], basis: str, healthy_days: int = HEALTHY_DAYS) -> tuple[Levels, float]:
    """Return the levels in L/min that the detector states, and the pressure for which."""
    kept = [row for row in days if row["basis"] == basis]
    pressure = float(np.median([row["pressure"] for row in kept]))
    unit = pressure / LITRE_PER_MINUTE
    t, value, error = (np.array([row[name] for row in kept], dtype=float) for name in ("day", "value", "error"))
    return levels_at(t, value * unit, error * unit, basis, healthy_days, unit), unit


def first_alarm(levels: Levels, healthy_days: int) -> float | None:
    """Return the day of the first alarm when each day was the last one, None where there is none."""
    alarm = score_changes(levels, healthy_days).find_alarm(YEARS * DAYS_PER_YEAR)
    return None if alarm is None else float(levels.t[alarm])


def delays(folder: Path) -> None:
    """Print delay and flow at the alarm."""
    print(f"wear of {WEAR} L/min a month for {WORN_DAYS} days, 1 false alarm in {YEARS:g} machine-years\n")
    print(
        "| view | known healthy | machines | alarmed | before the wear | delay [d]: median (5 to 95 %) | L/min then |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for view, basis in VIEWS.items():
        machines = machines_of(folder, view)
        for healthy_days in HEALTHY_COUNTS if machines else ():
            waits, early, silent = [], 0, 0
            for days in machines:
                levels, _ = levels_of(days[HEALTHY_DAYS - healthy_days :], basis, healthy_days)
                alarm = first_alarm(levels, healthy_days)
                if alarm is None:
                    silent += 1
                elif alarm < HEALTHY_DAYS:
                    early += 1
                else:
                    waits.append(alarm - HEALTHY_DAYS + 1)
            n = len(machines)
            quantiles = np.quantile([*waits, *[np.inf] * silent], [0.5, 0.05, 0.95], method="inverted_cdf")
            shown = [f"{q:.0f}" if math.isfinite(q) else "never" for q in quantiles]
            flows = [f"{q * WEAR / DAYS_PER_MONTH:.4f}" if math.isfinite(q) else "never" for q in quantiles]
            print(
                f"| {view} | {healthy_days} | {n} | {len(waits)} | {early} | {shown[0]} ({shown[1]} to {shown[2]}) | "
                f"{flows[0]} ({flows[1]} to {flows[2]}) |"
            )


def measured(folder: Path, view: str, basis: str) -> tuple[list[tuple[float, float, float, float]], float]:
    """Return level, scatter beyond the stated error, stated error and unit of each machine's healthy days, and their
    mean correlation from day to day."""
    machines, products, squares = [], 0.0, 0.0
    for days in machines_of(folder, view):
        levels, unit = levels_of(days[:HEALTHY_DAYS], basis)
        if len(levels) < HEALTHY_DAYS // 2:
            continue
        residual = levels.value - levels.value.mean()
        scatter = float(np.std(residual, ddof=1))
        machines.append((float(levels.value.mean()), scatter, float(levels.error.mean()), unit))
        products += float(np.sum(residual[1:] * residual[:-1])) / scatter**2
        squares += float(np.sum(residual[1:] ** 2)) / scatter**2
    return machines, products / squares if squares else 0.0


def false_alarms(folder: Path, years: int) -> None:
    """Print how often healthy machine-years alarm."""
    print("\n| view | known healthy | machine-years | false alarms | in 10 machine-years (95 %) | scatter | lasts |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for view, basis in VIEWS.items():
        machines, lasts = measured(folder, view, basis)
        if not machines:
            continue
        # the correlation of a short series is low by about (1 + 3 lasts)/n
        lasts = min(max(lasts + (1.0 + 3.0 * lasts) / HEALTHY_DAYS, 0.0), 0.95)
        for healthy_days in HEALTHY_COUNTS:
            alarms, random = 0, np.random.default_rng(healthy_days)
            for year in range(years):
                mean, scatter, error, unit = machines[year % len(machines)]
                noise = random.standard_normal(365)
                for k in range(1, noise.size):
                    noise[k] = lasts * noise[k - 1] + math.sqrt(1.0 - lasts**2) * noise[k]
                levels = levels_at(np.arange(365.0), mean + scatter * noise, error, basis, healthy_days, unit)
                few = levels.average_neighbours()
                known = max(1, round(healthy_days * len(few) / len(levels)))
                begin = 0
                while begin < len(few) - 1:  # an alarm is looked into, and the series goes on
                    alarm = score_changes(few.select(slice(begin, None)), known).find_alarm(YEARS * DAYS_PER_YEAR)
                    if alarm is None:
                        break
                    alarms, begin = alarms + 1, begin + alarm + 1
            low, high = clopper_pearson(min(alarms, years), years)
            usual = np.median([own[1] / own[0] for own in machines])
            print(
                f"| {view} | {healthy_days} | {years} | {alarms} | {10 * alarms / years:.2f} ({10 * low:.2f} to "
                f"{10 * high:.2f}) | {usual:.1%} | {lasts:.2f} |"
            )


def growths(folder: Path) -> None:
    """Print how well the growth is known after the 84 days; the truth is that at the trend's pressure."""
    print("\n| view | machines | alarmed | growth [L/min a month]: median | 95 % intervals that hold the truth |")
    print("| --- | --- | --- | --- | --- |")
    for view, basis in VIEWS.items():
        values, held, count = [], 0, 0
        for days in machines_of(folder, view):
            levels, _ = levels_of(days, basis)
            own = find_episodes(levels, years=YEARS, n_healthy=HEALTHY_DAYS)[-1]
            count += 1
            if own.alarm is not None:
                values.append(own.wear.growth.value)
                truth = WEAR * float(np.median([row["pressure"] for row in days])) / days[0]["pressure"]
                held += own.wear.growth.low <= truth <= own.wear.growth.high
        if count:
            print(f"| {view} | {count} | {len(values)} | {np.median(values):.4f} | {held} of {len(values)} |")


def main() -> None:
    """Simulate, or print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run")
    run.add_argument("folder", type=Path)
    run.add_argument("--machines", type=int, default=200)
    run.add_argument("--pressures-of", type=int, default=40)
    run.add_argument("--seconds", type=float, default=540.0)
    table = commands.add_parser("table")
    table.add_argument("folder", type=Path)
    table.add_argument("--false-alarms", type=int, default=0, metavar="YEARS")
    given = parser.parse_args()
    if given.command == "run":
        simulate(given.folder, given.machines, given.pressures_of, given.seconds)
        return
    delays(given.folder)
    growths(given.folder)
    if given.false_alarms:
        false_alarms(given.folder, given.false_alarms)


if __name__ == "__main__":
    main()
