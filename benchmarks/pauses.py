"""Presses and lifts that pause behind a shut valve: leaks found, sized and bounded beside healthy days.

    python benchmarks/pauses.py [--machines 3] [--seed 1]

A motor-driven pump between the chambers of a single rod follows a position. While it pauses, the motor is off and a
valve shuts both lines: a press once for 20 s between strokes, a lift for 15 s at every place. A charge line feeds the
chamber of lower pressure, at half of the machines through the valve, so that a pause cuts it off. The machines share
nothing with the package: oil with air, volumes that move, Coulomb friction, steps of 0.1 ms. Every machine has six
healthy days and four with a leak, of 1 to 8 % of the pump's flow while it turns, by either law, half of them from the
first sample and half from within the recording. Load, oil and zeros differ from day to day; of every other leaking day
the load is 1.3 to 1.8 times that of the healthy ones. Known are areas and displacement. Prints a line a kind: leaks
found; intervals of `leak` that hold the mean flow while the leak is open; other bounds below it.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import Counter, namedtuple
from pathlib import Path

import numpy as np
from numba import njit

import sealscope as ss
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.units import LITRE_PER_MINUTE

DT, EVERY, RATE, HEALTHY_DAYS, LEAKING_DAYS, RAMP = 1e-4, 100, 100, 6, 4, 0.5
SECONDS = {"press": 80.0, "lift": 110.0}
PAUSE = {"press": 20.0, "lift": 15.0}

Machine = namedtuple(
    "Machine",
    "area rod_area stroke dead_a dead_b mass friction displacement slip bulk air charge feed load spring "
    "feed_behind zero_a zero_b",
)


@njit
def compliance(m, p):
    """Return the relative compression of oil with air and its volume per pressure."""
    absolute = max(p, -0.9e5) + 1.013e5
    return 1.0 / m.bulk + m.air * 1.013e5 / absolute**2


@njit
def record(m, target, is_shut, leak, exponent):
    """Return pressures, position, speed of the pump and leak, each `EVERY` steps of `DT`."""
    log = np.empty((5, target.size // EVERY))
    x, v, speed, p_b = target[0], 0.0, 0.0, m.charge
    p_a = (m.load + m.spring * x + m.rod_area * p_b) / m.area
    valve = 1.0
    for i in range(log.shape[1] * EVERY):
        difference = p_a - p_b
        leaking = leak[i] * math.copysign(abs(difference) ** exponent, difference)
        if i % EVERY == 0:
            log[:, i // EVERY] = (p_a, p_b, x, speed, leaking)
        valve += DT * ((0.0 if is_shut[i] else 1.0) - valve) / 0.02
        if is_shut[i] and valve < 1e-3:
            valve = 0.0
        ahead = (target[min(i + 100, target.size - 1)] - target[i]) / (100 * DT)
        wanted = 0.0 if is_shut[i] else m.area * (ahead + 6.0 * (target[i] - x)) / m.displacement
        speed += DT * (wanted - speed) / 0.03
        fed = valve if m.feed_behind == 0.0 else 1.0
        side = 1.0 / (1.0 + math.exp(min(max(difference / 5e4, -50.0), 50.0)))  # 1: A is the lower side
        flow = valve * (m.displacement * speed - m.slip * difference)
        in_a = flow + fed * m.feed * side * (m.charge - p_a) - leaking
        in_b = -flow + fed * m.feed * (1.0 - side) * (m.charge - p_b) + leaking
        force = p_a * m.area - p_b * m.rod_area - m.load - m.spring * x
        v += DT * (force - m.friction * math.tanh(v / 1e-3) - 3e4 * v) / m.mass
        x += DT * v
        p_a += DT * (in_a - m.area * v) / ((m.dead_a + m.area * x) * compliance(m, p_a))
        p_b += DT * (in_b + m.rod_area * v) / ((m.dead_b + m.rod_area * (m.stroke - x)) * compliance(m, p_b))
    return log


def draw_machine(kind, rng):
    """Draw a press or a lift, on no particular day."""
    area, stroke = rng.uniform(25e-4, 80e-4), rng.uniform(0.25, 0.6)
    per_turn = area * rng.uniform(2.5e-3, 5e-3)
    return Machine(
        area=area, rod_area=area * rng.uniform(0.45, 0.75), stroke=stroke, dead_a=rng.uniform(1e-4, 6e-4),
        dead_b=rng.uniform(1e-4, 6e-4), mass=400.0, friction=rng.uniform(0.7e5, 3e5) * area,
        displacement=per_turn / (2.0 * np.pi), slip=rng.uniform(0.5, 2.0) * 1e-12 * per_turn / 16e-6,
        bulk=rng.uniform(0.9e9, 1.4e9), air=rng.uniform(0.001, 0.01), charge=rng.uniform(4e5, 10e5), feed=2e-9,
        load=rng.uniform(25e5, 70e5) * area * (1.0 if kind == "lift" or rng.random() < 0.7 else -0.4),
        spring=0.0 if kind == "lift" or rng.random() < 0.5 else rng.uniform(10e5, 40e5) * area / stroke,
        feed_behind=float(rng.random() < 0.5), zero_a=rng.uniform(-5e4, 5e4), zero_b=rng.uniform(-5e4, 5e4),
    )  # fmt: skip


def draw_day(m, rng):
    """Draw the machine on a day: oil, friction, load and zeros of its own."""
    thin = math.exp(rng.normal(0.0, 0.2))  # of the oil
    return m._replace(
        slip=m.slip * thin, friction=m.friction * math.exp(rng.normal(0.0, 0.12)),
        load=m.load * (1.0 + rng.normal(0.0, 0.08)), bulk=m.bulk * (1.0 + rng.normal(0.0, 0.05)),
        zero_a=m.zero_a + rng.uniform(-1e4, 1e4), zero_b=m.zero_b + rng.uniform(-1e4, 1e4),
    )  # fmt: skip


def plan(kind, m, rng):
    """Return the position that is followed, and where the valve is shut, at each step."""
    n = int(SECONDS[kind] / DT)
    t = np.arange(n) * DT
    is_shut = np.zeros(n, dtype=bool)
    if kind == "press":
        begin, period = rng.uniform(5.0, SECONDS[kind] - PAUSE[kind] - 5.0), rng.uniform(3.0, 6.0)
        clock = np.where(t < begin, t, np.maximum(begin, t - PAUSE[kind]))
        is_shut[(t >= begin + 0.2) & (t < begin + PAUSE[kind])] = True
        return 0.5 * m.stroke * (1.0 - 0.6 * np.cos(2.0 * np.pi * clock / period)), is_shut
    times, places = [0.0], [rng.uniform(0.2, 0.8) * m.stroke]
    speed = 0.25 * m.stroke / 2.0
    while times[-1] < t[-1]:
        place = rng.uniform(0.15, 0.85) * m.stroke
        arrived = times[-1] + max(abs(place - places[-1]) / speed, 0.5)
        times += [arrived, arrived + PAUSE[kind]]
        places += [place, place]
        is_shut[(t >= arrived + 0.3) & (t < arrived + PAUSE[kind])] = True
    return np.interp(t, times, places), is_shut


def measure(m, log, rng):
    """Return the columns that the logger writes, in their units."""
    noise = rng.normal(0.0, 1.0, (4, log.shape[1]))
    step = 250e5 / 4096

    def pressure(p, zero, k):
        return np.round((p + zero + 2e4 * noise[k]) / step) * step / 1e5

    return {
        "time_s": np.arange(log.shape[1]) * DT * EVERY,
        "p_bottom_bar": pressure(log[0], m.zero_a, 0), "p_rod_bar": pressure(log[1], m.zero_b, 1),
        "stroke_mm": np.round(1e5 * log[2]) / 100, "motor_rpm": np.round(log[3] * 30 / np.pi + 0.3 * noise[3], 1),
    }  # fmt: skip


def write(folder, name, columns):
    """Write a log and return its path."""
    path = folder / f"{name}.csv"
    np.savetxt(path, np.column_stack(list(columns.values())), "%.4f", ",", header=",".join(columns), comments="")
    return path


def record_days(kind, number, seed, folder):
    """Yield the log of each day of a machine with its leak [L/min], 0 on healthy days, which come first."""
    rng = np.random.default_rng([seed, number, sum(kind.encode())])
    machine = draw_machine(kind, rng)
    yield machine
    for k in range(HEALTHY_DAYS + LEAKING_DAYS):
        day, is_leaking = draw_day(machine, rng), k >= HEALTHY_DAYS
        if is_leaking and k % 2:
            day = day._replace(load=day.load * rng.uniform(1.3, 1.8))
        target, is_shut = plan(kind, machine, rng)
        times = np.arange(target.size) * DT
        exponent = 1.0 if rng.random() < 0.5 else 0.5
        share = math.exp(rng.uniform(math.log(0.01), math.log(0.08)))
        onset = 0.0 if rng.random() < 0.5 else rng.uniform(0.2, 0.6) * times[-1]
        is_open, size = (times >= onset).astype(float), 1e-13 if is_leaking else 0.0
        for _ in range(3 if is_leaking else 0):  # until the leak has its share of the flow
            log = record(day, target, is_shut, size * is_open, exponent)
            flow = machine.displacement * float(np.abs(log[3][np.abs(log[3]) > 1.0]).mean())
            size *= share * flow / max(float(np.abs(log[4, int(onset * RATE) :]).mean()), 1e-12)
        log = record(day, target, is_shut, size * is_open, exponent)
        path = write(folder, f"{kind}{number}_202603{k + 1:02d}_0800", measure(day, log, rng))
        yield path, float(np.abs(log[4, int(onset * RATE) :]).mean()) / LITRE_PER_MINUTE


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=3, help="machines of a kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", choices=SECONDS, default=list(SECONDS))
    asked = parser.parse_args()
    print("kind   leaks found | intervals hold | bounds below the leak")
    for kind in asked.kinds:
        counts: Counter[str] = Counter()
        for number in range(asked.machines):
            with tempfile.TemporaryDirectory() as name:
                machine, *days = record_days(kind, number, asked.seed, Path(name))
                known = {"cylinder.A_A": machine.area, "cylinder.A_B": machine.rod_area}
                known["pump.q_b"] = machine.displacement * 2.0 * np.pi
                rig = unstated_rig().with_overrides(known, source="stated")
                recordings = [ss.read(path, map="auto") for path, _ in days]
                for recording, (_, leak) in list(zip(recordings, days, strict=True))[HEALTHY_DAYS:]:
                    answer = ss.diagnose(recording, recordings[:HEALTHY_DAYS], rig=rig)
                    counts["leaks"] += 1
                    if answer.verdict == "leak":
                        low, high = answer.leak_interval_lpm or (math.nan, math.nan)
                        counts.update(found=1, hold=int(low <= leak <= high))
                    elif answer.bound_lpm is not None:
                        counts.update(bounds=1, broken=int(answer.bound_lpm < leak))
        found, intervals = f"{counts['found']} of {counts['leaks']}", f"{counts['hold']} of {counts['found']}"
        print(f"{kind:6} {found:>11} | {intervals:>14} | {counts['broken']} of {counts['bounds']}", flush=True)


if __name__ == "__main__":
    main()
