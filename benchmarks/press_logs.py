"""Logs of a press written by another simulator: 20 s at 100 Hz, sensors 0.3 bar off, six healthy recordings known.

    python benchmarks/press_logs.py [--machines 4] [--seed 1] [--share 0.05]

The press has a single rod. A pump between its chambers is driven by a motor that follows a position; an inverse shuttle
valve connects the side of lower pressure to a charge line. Its equations, written for this file and solved by LSODA,
share nothing with the package: oil with air, volumes that move, Coulomb friction. From day to day the slip of the pump
differs by 10 %, friction by 15 %, load by 10 % and the zeros of both pressures by 0.3 bar. A log is a CSV with columns
`time_s`, `stroke_mm`, `motor_rpm`, `p_bottom_bar`, `p_rod_bar` of 12 bits, read with `map="auto"`; areas and
displacement are stated, nothing else. Every machine has seven healthy days, each judged against the other six, and days
on which a share of the pump's mean flow (5 %) leaks past the piston from the first sample. Prints a
line a load, last the leaks and the false alarms of the plain regression of `plain_regression.py`.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from plain_regression import regression
from scipy.integrate import solve_ivp

import sealscope as ss
from sealscope.parameters.new_rig import rig_text

RATE, SECONDS, HEALTHY, LEAKING = 100.0, 20.0, 7, 2
LOADS = ("constant", "spring", "mixed")
MASS, CHARGE, SHUTTLE = 400.0, 8e5, 2e-9  # kg, Pa, m^3/(s Pa)


@dataclass(frozen=True)
class Day:
    """What a press is on one day: SI units throughout."""

    area: float
    rod_area: float
    stroke: float
    displacement: float  # m^3/rad
    slip: float
    friction: float
    load: float
    spring: float
    bulk: float
    leak: float
    zeros: tuple[float, float]
    period: float


def simulate(day: Day, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the channels that the press's logger writes, in the units of its columns."""
    omega = 2.0 * np.pi / day.period

    def right_hand_side(t: float, y: np.ndarray) -> list[float]:
        x, v, p_a, p_b, speed = y
        target = 0.5 * day.stroke * (1.0 - 0.6 * np.cos(omega * t))
        ahead = 0.3 * day.stroke * omega * np.sin(omega * t)
        asked = (day.area * (ahead + 6.0 * (target - x))) / day.displacement
        flow = day.displacement * speed - day.slip * (p_a - p_b)
        lower = 1.0 / (1.0 + np.exp(np.clip((p_a - p_b) / 5e4, -50.0, 50.0)))  # 1: A is the lower side
        leak = day.leak * (p_a - p_b)
        feed_a = SHUTTLE * lower * (CHARGE - p_a)
        feed_b = SHUTTLE * (1.0 - lower) * (CHARGE - p_b)
        volume_a = 3e-4 + day.area * (x + 0.01)
        volume_b = 3e-4 + day.rod_area * (day.stroke - x + 0.01)
        soft = [day.bulk / (1.0 + 2.0 * (1e5 / max(p, 1e4)) ** 1.4 * 0.01 * day.bulk / 1e5 / 1.4) for p in (p_a, p_b)]
        force = day.load + day.spring * x + day.friction * np.tanh(v / 2e-3) + 2e4 * v
        return [
            v,
            (day.area * p_a - day.rod_area * p_b - force) / MASS,
            soft[0] / volume_a * (flow + feed_a - leak - day.area * v),
            soft[1] / volume_b * (-flow + feed_b + leak + day.rod_area * v),
            (asked - speed) / 0.03,
        ]

    x0 = 0.2 * day.stroke
    start = [x0, 0.0, (day.load + day.spring * x0 + day.rod_area * CHARGE) / day.area, CHARGE, 0.0]
    t = np.arange(int(SECONDS * RATE)) / RATE
    y = solve_ivp(
        right_hand_side, (0.0, SECONDS), start, "LSODA", t, rtol=1e-6, atol=[1e-9, 1e-7, 1.0, 1.0, 1e-6], max_step=0.01
    ).y
    bits = 250e5 / 4096.0

    def measured(p: np.ndarray, zero: float) -> np.ndarray:
        return np.round((p + zero + rng.normal(0.0, 3e4, p.size)) / bits) * bits / 1e5

    return {
        "time_s": t,
        "stroke_mm": np.round(1e3 * y[0] / 0.01) * 0.01,
        "motor_rpm": y[4] * 30.0 / np.pi + rng.normal(0.0, 0.3, t.size),
        "p_bottom_bar": measured(y[2], day.zeros[0]),
        "p_rod_bar": measured(y[3], day.zeros[1]),
    }


def press(load: str, rng: np.random.Generator) -> Day:
    """Return a press, on no particular day."""
    area = rng.uniform(30e-4, 80e-4)
    stroke = rng.uniform(0.25, 0.6)
    spring = 0.0 if load == "constant" else rng.uniform(20e5, 60e5) * area / stroke
    return Day(
        area=area,
        rod_area=area * rng.uniform(0.45, 0.75),
        stroke=stroke,
        displacement=rng.uniform(12e-6, 28e-6) / (2.0 * np.pi),
        slip=rng.uniform(0.5, 2.0) * 1e-12,
        friction=rng.uniform(1e5, 3e5) * area,
        load=(0.0 if load == "spring" else rng.uniform(20e5, 60e5)) * area,
        spring=spring,
        bulk=rng.uniform(0.9e9, 1.4e9),
        leak=0.0,
        zeros=(0.0, 0.0),
        period=rng.uniform(3.0, 6.0),
    )


def other_day(machine: Day, rng: np.random.Generator) -> Day:
    """Return the press on a day of its own."""
    return replace(
        machine,
        slip=machine.slip * (1.0 + rng.normal(0.0, 0.1)),
        friction=machine.friction * (1.0 + rng.normal(0.0, 0.15)),
        load=machine.load * (1.0 + rng.normal(0.0, 0.1)),
        bulk=machine.bulk * (1.0 + rng.normal(0.0, 0.1)),
        zeros=tuple(rng.uniform(-3e4, 3e4, 2)),
    )


def leaking(day: Day, share: float, rng: np.random.Generator) -> tuple[Day, float]:
    """Return the day with a leak of a share of the pump's mean flow, and that leak [L/min]."""
    channels = simulate(day, rng)
    flow = float(np.mean(np.abs(channels["motor_rpm"]))) * np.pi / 30.0 * day.displacement
    difference = float(np.mean(np.abs(channels["p_bottom_bar"] - channels["p_rod_bar"]))) * 1e5
    return replace(day, leak=share * flow / difference), share * flow * 6e4


def log(folder: Path, name: str, channels: dict[str, np.ndarray]) -> Path:
    """Write a log as the press's program does."""
    path = folder / f"{name}.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(channels)
        writer.writerows(zip(*(np.round(values, 4) for values in channels.values()), strict=True))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=4, help="presses a load")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--share", type=float, default=0.05, help="the leak over the pump's mean flow")
    asked = parser.parse_args()
    print("load       leaks: leak, no leak, cannot tell, intervals hold | healthy: leak, no leak, cannot tell | plain")
    for load in LOADS:
        rng = np.random.default_rng([asked.seed, LOADS.index(load)])
        verdicts: dict[str, list[str]] = {"healthy": [], "leak": []}
        held = stated = plain_leaks = plain_false = 0
        for _ in range(asked.machines):
            machine = press(load, rng)
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                rig = folder / "press.toml"
                per_rev = machine.displacement * 2.0 * np.pi
                rig.write_text(rig_text("press", machine.area, machine.rod_area, machine.stroke, per_rev))
                days = [other_day(machine, rng) for _ in range(HEALTHY)]
                healthy = [
                    ss.read(log(folder, f"healthy{k}", simulate(day, rng)), map="auto") for k, day in enumerate(days)
                ]
                for k, recording in enumerate(healthy):
                    others = healthy[:k] + healthy[k + 1 :]
                    verdicts["healthy"].append(ss.diagnose(recording, baseline=others, rig=str(rig)).verdict)
                    plain_false += regression(recording, others, per_rev)
                for k in range(LEAKING):
                    day, flow = leaking(other_day(machine, rng), asked.share, rng)
                    recording = ss.read(log(folder, f"leak{k}", simulate(day, rng)), map="auto")
                    answer = ss.diagnose(recording, baseline=healthy[:6], rig=str(rig))
                    verdicts["leak"].append(answer.verdict)
                    plain_leaks += regression(recording, healthy[:6], per_rev)
                    if answer.leak_interval_lpm is not None and answer.verdict == "leak":
                        stated += 1
                        held += answer.leak_interval_lpm[0] <= flow <= answer.leak_interval_lpm[1]
        counts = {
            kind: [answers.count(verdict) for verdict in ("leak", "no leak", "cannot tell")]
            for kind, answers in verdicts.items()
        }
        plain = f"{plain_leaks}, {plain_false}"
        print(
            f"{load:10} {counts['leak'][0]:6} {counts['leak'][1]:8} {counts['leak'][2]:12} {held:10} of {stated:2}  |"
            f" {counts['healthy'][0]:12} {counts['healthy'][1]:8} {counts['healthy'][2]:12}  | {plain}"
        )


if __name__ == "__main__":
    main()
