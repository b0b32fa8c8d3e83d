"""Logs of four machines by other equations, judged by their areas or displacement alone, without and with healthy days.

    python benchmarks/foreign_machines.py [--seed 1] [--count 4] [--machines eha crane press servo]

The machines share nothing with the package: chambers with air in the oil, LuGre friction, oil that warms and thins,
steps of 50 us. Their logs are CSV with columns, units, separators and clocks of such loggers, read with `map="auto"`.

eha    double rod, 8 cm^3 pump, compliant load that swings, sine or random moves; pressures, position, speed; 500 Hz
crane  single rod, fixed pump, proportional valve with overlap, relief valve, load checks; flow meter in line A; 100 Hz
press  single rod, 16 cm^3 servo pump, pilot-operated checks, accumulator; holds against a workpiece; 50 Hz
servo  double rod, servo-valve with dither and lap leakage, random moves; flow meter in line A; 1 kHz

Every log is a day of its own: oil, moves, noise and (not of servo) load differ; zeros, scales, air, slip and lap are
the machine's. Known are the areas, the press's displacement and the name of a flow meter; no rig, onset or size.
A leak is laminar, of so many L/min at 40 to 80 bar. `alone` judges a log by itself, its leak open from the middle on;
`baseline` against five healthy days, its leak open from the first sample. Prints the verdicts by nominal leak, how many
intervals of `leak` hold the mean of |Q_leak| while open, how many bounds of `no leak` do; last every answer that is
wrong. The package was mended on logs like those of seed 1.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import Counter, namedtuple
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from itertools import count
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit

import sealscope as ss
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.units import LITRE_PER_MINUTE

DT, TANK, HEALTHY_DAYS, LOGS = 5e-5, 2e5, 5, 2  # s, Pa gauge, healthy days, logs of a machine with a leak

# SI units. `low`: lower pressure when a log begins; `wall`: stiffness of a workpiece at 0.09 m; `joint`: stiffness
# between piston and load; 0 makes them one mass. `gas`: volume in the accumulator; inf makes it a charge line. `edge`:
# flow over root of pressure of an open edge; `pump`: flow of the fixed pump behind the valve; 0: constant supply.
Cylinder = namedtuple("Cylinder", "area_a area_b stroke dead air mass coulomb viscous low spring wall joint load_mass")
Pump = namedtuple("Pump", "displacement gain fastest slip case piloted gas")
Valve = namedtuple("Valve", "gain edge overlap bandwidth lap dither supply pump")


@njit
def compressibility(p, air):
    absolute = max(p, -0.9e5) + 1.013e5
    return 1.0 / 1.4e9 + air / 1.4 * (1.013e5 / absolute) ** (1.0 / 1.4) / absolute


@njit
def orifice(c, difference):
    return c * difference / math.sqrt(abs(difference) + 2e4)


@njit
def at_rest(c, x, load):
    force = load + c.spring * x
    p_a = c.low + max((c.low * (c.area_b - c.area_a) + force) / c.area_a, 0.0)
    return p_a, (p_a * c.area_a - force) / c.area_b, x, 0.0, 0.0, x, 0.0


@njit
def advance(c, y, q_a, q_b, load, viscosity):
    """Return pressures, piston, bristle and load after a step; `q_a`, `q_b`: all that enters the chambers."""
    p_a, p_b, x, v, z, x_load, v_load = y
    volume_a, volume_b = c.dead + c.area_a * (c.stroke / 2 + x), c.dead + c.area_b * (c.stroke / 2 - x)
    p_a = max(p_a + DT * (q_a - c.area_a * v) / (volume_a * compressibility(p_a, c.air)), -0.95e5)
    p_b = max(p_b + DT * (q_b + c.area_b * v) / (volume_b * compressibility(p_b, c.air)), -0.95e5)
    sliding = c.coulomb * (1.0 + 0.5 * math.exp(-((v / 0.01) ** 2)))
    bristle = (z + DT * v) / (1.0 + DT * 2e7 * abs(v) / sliding)
    friction = 2e7 * bristle + 2e3 * (bristle - z) / DT + c.viscous * viscosity * v
    driving = p_a * c.area_a - p_b * c.area_b - friction
    outside = load + c.spring * x_load + c.wall * max(0.0, x_load - 0.09)
    if c.joint == 0.0:
        v += DT * (driving - outside) / c.mass
        return p_a, p_b, x + DT * v, v, bristle, x + DT * v, v
    rod = c.joint * (x - x_load) + 1e4 * (v - v_load)
    v += DT * (driving - rod) / c.mass
    v_load += DT * (rod - outside - 50.0 * v_load - 200.0 * math.tanh(v_load / 2e-3)) / c.load_mass
    return p_a, p_b, x + DT * v, v, bristle, x_load + DT * v_load, v_load


@njit
def check(line, p, pilot, piloted):
    """Return the flow from the line into a chamber through its check, which the other chamber may open."""
    if piloted and pilot > max(line + 4e5, p):
        return 2e-10 * (line - p)
    return 2e-10 * max(0.0, line - 0.3e5 - p)


@njit
def pump_driven(c, d, target, load, viscosity, leak):
    """Return p_A, p_B, x, speed of the pump and pressure of its line, at each step."""
    log, y, speed, angle, line = np.empty((5, target.size)), at_rest(c, target[0], load[0]), 0.0, 0.0, 5e5
    for i in range(target.size):
        p_a, p_b, x = y[:3]
        log[:, i] = (p_a, p_b, x, speed, line)
        speed += DT * (min(max(d.gain * (target[i] - x), -d.fastest), d.fastest) - speed) / 0.015
        angle += DT * speed
        ripple = 1.0 + 0.01 * math.sin(9.0 * angle)
        to_a = d.displacement * speed * ripple - (d.slip / viscosity[i] + leak[i]) * (p_a - p_b)
        in_a = check(line, p_a, p_b, d.piloted) - d.case / viscosity[i] * (p_a - line)
        in_b = check(line, p_b, p_a, d.piloted) - d.case / viscosity[i] * (p_b - line)
        y = advance(c, y, in_a + to_a, in_b - to_a, load[i], viscosity[i])
        line -= DT * 1.4 * (line + 1e5) * (in_a + in_b) / d.gas
    return log


@njit
def valve_driven(c, d, target, load, viscosity, leak):
    """Return p_A, p_B, x, command and flow in line A, at each step."""
    log, y, spool, rate, supply = np.empty((5, target.size)), at_rest(c, target[0], load[0]), 0.0, 0.0, d.supply
    for i in range(target.size):
        p_a, p_b, x = y[:3]
        command = min(max(d.gain * (target[i] - x), -1.0), 1.0)
        dither = d.dither * math.sin(2.0 * math.pi * 120.0 * i * DT)
        rate += DT * d.bandwidth * (d.bandwidth * (command + dither - spool) - 1.4 * rate)
        spool += DT * rate
        out, back = max(spool - d.overlap, 0.0) / (1.0 - d.overlap), max(-spool - d.overlap, 0.0) / (1.0 - d.overlap)
        q_a = max(orifice(d.edge * out, supply - p_a), 0.0) - orifice(d.edge * back, p_a - TANK)
        q_b = max(orifice(d.edge * back, supply - p_b), 0.0) - orifice(d.edge * out, p_b - TANK)
        if d.pump > 0.0:
            spilled = orifice(4e-7 * math.exp(-(((out + back) / 0.05) ** 2)), supply)
            spilled += 5e-10 * max(0.0, supply - d.supply)
            supply = max(supply + DT * 4e11 * (d.pump - max(q_a, 0.0) - max(q_b, 0.0) - spilled), 0.0)
        q_a += d.lap / viscosity[i] * (supply - 2.0 * p_a + TANK)
        q_b += d.lap / viscosity[i] * (supply - 2.0 * p_b + TANK)
        log[:, i] = (p_a, p_b, x, command, q_a)
        y = advance(c, y, q_a - leak[i] * (p_a - p_b), q_b + leak[i] * (p_a - p_b), load[i], viscosity[i])
    return log


def random_moves(rng, t, reach, dwell, speed):
    """Return a position that moves to random places at a speed and stays for a while at each."""
    times, places = [0.0], [0.0]
    while times[-1] < t[-1]:
        place = rng.uniform(-reach, reach)
        arrived = times[-1] + abs(place - places[-1]) / speed
        times += [arrived, arrived + rng.uniform(*dwell)]
        places += [place, place]
    return np.interp(t, times, places)


def strokes(rng, t):
    """Return the position of a press: down fast, slowly into the workpiece, held there, and up again."""
    times, places = [0.0], [-0.1]
    while times[-1] < t[-1]:
        deep = 0.105 + rng.uniform(-0.001, 0.001)
        places += [0.09, deep, deep, 0.09, -0.1, -0.1]
        times += list(times[-1] + np.cumsum([2.2, 1.0, rng.uniform(6.0, 9.0), 1.0, 2.2, rng.uniform(1.0, 3.0)]))
    return np.interp(t, times, places)


# A machine's function draws what is the machine's from `own` and what is the day's from `rng`; it returns p_A - p_B and
# of each column values, noise and step of the sensor.


def eha(own, rng, t, oil, leak, day):
    air, slip, scale = 0.006 * own.uniform(0.5, 2.0), 4e-13 * own.uniform(0.7, 1.4), own.normal(1.0, 0.003)
    zero_a, zero_b = own.normal(0.0, 0.4, 2) + rng.normal(0.0, 0.05, 2)
    target = 0.04 * np.sin(0.6 * math.pi * t) if day % 2 else random_moves(rng, t, 0.04, (0.2, 2.0), 0.08)
    load = 3000.0 * np.sin(0.1 * math.pi * t + rng.uniform(0.0, 6.0)) + rng.uniform(500.0, 2500.0)
    cylinder = Cylinder(1.4726e-3, 1.4726e-3, 0.2, 6e-5, air, 15.0, 500.0, 1500.0, 5e5, 3e5, 0.0, 5e6, 120.0)
    pump = Pump(8e-6 / (2 * math.pi), 6000.0, 314.0, slip, 1e-13, False, math.inf)
    p_a, p_b, x, speed, _ = pump_driven(cylinder, pump, target, load, np.exp(0.03 * (40.0 - oil)), leak)
    return p_a - p_b, {
        "setpoint_mm": (target * 1e3 + 12.7, 0.0, 0.001),
        "pressure_A_bar": (p_a / 1e5 + zero_a, 0.15, 0.061),
        "pressure_B_bar": (p_b / 1e5 + zero_b, 0.15, 0.061),
        "position_mm": (x * 1e3 * scale + 12.7, 0.003, 0.005),
        "pump_speed_rpm": (speed * 30 / math.pi, 0.5, 1.0),
        "oil_temp_C": (oil, 0.05, 0.1),
    }


def crane(own, rng, t, oil, leak, day):
    (zero_a, zero_b), scale = own.normal(0.0, 0.8, 2), own.normal(1.0, 0.005)
    target = random_moves(rng, t, 0.2, (8.0, 15.0) if day % 2 else (1.0, 4.0), 0.12)
    load = 22000.0 * rng.uniform(0.85, 1.15) + 3000.0 * np.sin(0.08 * math.pi * t)
    cylinder = Cylinder(5.0265e-3, 3.4361e-3, 0.6, 2e-4, 0.008, 1800.0, 900.0, 4000.0, 40e5, -15000.0, 0.0, 0.0, 1.0)
    valve = Valve(6.0, 2.7e-7, 0.06, 60.0, 2e-14, 0.0, 200e5, 40 * LITRE_PER_MINUTE)
    p_a, p_b, x, command, flow = valve_driven(cylinder, valve, target, load, np.exp(0.03 * (40.0 - oil)), leak)
    return p_a - p_b, {
        "p_Kolben [bar]": (p_a / 1e5 + zero_a, 0.25, 0.1),
        "p_Stange [bar]": (p_b / 1e5 + zero_b, 0.25, 0.1),
        "Hub [mm]": (x * 1e3 + 300.0, 0.05, 0.1),
        "Joystick [%]": (command * 100.0, 0.1, 0.4),
        "Q_Zylinder [L/min]": (flow / LITRE_PER_MINUTE * scale + 0.05, 0.1, 0.02),
        "Oeltemp [°C]": (oil, 0.1, 0.1),
    }


def press(own, rng, t, oil, leak, day):
    slip, (zero_a, zero_b) = 1e-12 * own.uniform(0.7, 1.4), own.normal(0.0, 0.5, 2)
    load = np.full(t.size, -1500.0 * rng.uniform(0.95, 1.05))
    cylinder = Cylinder(5.0265e-3, 3.063e-3, 0.25, 1.5e-4, 0.008, 150.0, 1200.0, 3000.0, 5e5, 0.0, 3.5e6, 2e8, 40.0)
    pump = Pump(16e-6 / (2 * math.pi), 900.0, 300.0, slip, 2e-13, True, 4e-3)
    p_a, p_b, x, speed, line = pump_driven(cylinder, pump, strokes(rng, t), load, np.exp(0.03 * (40.0 - oil)), leak)
    return p_a - p_b, {
        "Druck Boden [bar]": (p_a / 1e5 + zero_a, 0.2, 0.12),
        "Druck Ring [bar]": (p_b / 1e5 + zero_b, 0.2, 0.12),
        "Weg Stoessel [mm]": (x * 1e3 + 125.0, 0.01, 0.01),
        "Drehzahl Motor [1/min]": (speed * 30 / math.pi, 1.0, 1.0),
        "Moment [Nm]": (pump.displacement * (p_a - p_b), 0.3, 0.1),
        "Speicher [bar]": (line / 1e5, 0.05, 0.06),
        "Oel [°C]": (oil, 0.1, 0.1),
    }


def servo(own, rng, t, oil, leak, day):
    lap, (zero_a, zero_b), scale = 3e-14 * own.uniform(0.5, 2.0), own.normal(0.0, 0.5, 2), own.normal(1.0, 0.003)
    target, load = random_moves(rng, t, 0.04, (0.1, 0.8), 0.25), 5000.0 * np.sin(0.4 * math.pi * t) + 4000.0
    cylinder = Cylinder(2.0994e-3, 2.0994e-3, 0.2, 4e-5, 0.004, 80.0, 120.0, 600.0, 40e5, 0.0, 0.0, 0.0, 1.0)
    valve = Valve(12.0, 3.6e-7, 0.0, 500.0, lap, 0.02, 210e5, 0.0)
    p_a, p_b, x, command, flow = valve_driven(cylinder, valve, target, load, np.exp(0.03 * (40.0 - oil)), leak)
    return p_a - p_b, {
        "pA [bar]": (p_a / 1e5 + zero_a, 0.2, 0.02),
        "pB [bar]": (p_b / 1e5 + zero_b, 0.2, 0.02),
        "x [mm]": (x * 1e3, 0.003, 0.002),
        "I_valve [mA]": (command * 40.0, 0.05, 0.02),
        "flow [L/min]": (flow / LITRE_PER_MINUTE * scale + 0.02, 0.05, 0.01),
    }


class Machine(NamedTuple):
    """A machine: how it is logged, what is known of it, and its nominal leaks [L/min] at a pressure difference."""

    log: Callable
    rate: float
    seconds: float
    clock: str
    known: tuple[float, ...]  # areas [m^2], displacement [m^3/rev]
    flow_meter: str | None
    pressure: float
    alone: tuple[float, ...]
    baseline: tuple[float, ...]

    def recording(self, folder: str, seed: list[int], day: int, lpm: float, opens: float) -> tuple[ss.Recording, float]:
        """Return the log of a day as it is read, and the mean of |Q_leak| [L/min] while the leak is open."""
        t, every = np.arange(int(self.seconds / DT)) * DT, round(1.0 / (self.rate * DT))
        leak = np.where(t < opens, 0.0, lpm * LITRE_PER_MINUTE / self.pressure)
        own, rng = np.random.default_rng([*seed, 0]), np.random.default_rng([*seed, day])
        oil = rng.uniform(32.0, 48.0) + 6.0 * (1.0 - np.exp(-t / 150.0))
        difference, columns = self.log(own, rng, t, oil, leak, day)
        start = datetime(2026, 3, 1, 8) + timedelta(days=day)
        separator, decimal = (",", ".") if self.clock in {"time_s", "t [s]"} else (";", ",")
        if self.clock == "Datum;Uhrzeit":
            texts = [[f"{start + timedelta(seconds=at):%d.%m.%Y;%H:%M:%S,%f}"[:-3] for at in t[::every].tolist()]]
        else:
            texts = [np.char.mod("%.7g", t[::every] * (1e3 if "[ms]" in self.clock else 1.0))]
        for values, noise, step in columns.values():
            shown = np.round((values[::every] + rng.normal(0.0, noise, t[::every].size)) / step) * step
            texts.append(np.char.replace(np.char.mod("%.7g", shown), ".", decimal))
        path = Path(folder) / f"{self.log.__name__}_{start:%Y-%m-%d_%H%M}.csv"
        rows = [(self.clock, *columns), *zip(*texts, strict=True)]
        path.write_text("".join(f"{separator.join(row)}\n" for row in rows), encoding="cp1252")
        mapping = "auto" if self.flow_meter is None else {"*": "auto", "q_pump": self.flow_meter}
        flows = np.abs(leak * difference)[t >= opens]
        return ss.read(path, map=mapping), float(np.mean(flows)) / LITRE_PER_MINUTE

    def answers(self, seed: list[int]) -> Iterator[tuple[str, float, float, ss.Diagnosis]]:
        """Yield `alone` or `baseline`, nominal and true leak [L/min], and the diagnosis of a log."""
        known = dict(zip(("cylinder.A_A", "cylinder.A_B", "pump.q_b"), self.known, strict=False))
        rig, days = unstated_rig().with_overrides(known, source="stated"), count(1)
        with tempfile.TemporaryDirectory() as folder:
            healthy = [self.recording(folder, seed, next(days), 0.0, 0.0)[0] for _ in range(HEALTHY_DAYS)]
            for kind, opens, others in (("alone", 0.5 * self.seconds, ()), ("baseline", 0.0, healthy)):
                for lpm in np.repeat([0.0, *getattr(self, kind)], LOGS).tolist():
                    recording, truth = self.recording(folder, seed, next(days), lpm, opens)
                    yield kind, lpm, truth, ss.diagnose(recording, others, rig=rig)


SMALL, LARGE = (0.05, 0.2, 1.0), (0.2, 1.0, 3.0)
MACHINES = {
    "eha": Machine(eha, 500, 60, "time_s", (1473e-6, 1473e-6), None, 50e5, SMALL, (0.01, *SMALL)),
    "crane": Machine(crane, 100, 90, "Zeit [ms]", (5027e-6, 3436e-6), "Q_Zylinder", 60e5, LARGE, (0.05, *LARGE)),
    "press": Machine(press, 50, 90, "Datum;Uhrzeit", (5027e-6, 3063e-6, 16e-6), None, 80e5, SMALL, (0.01, *SMALL)),
    "servo": Machine(servo, 1000, 30, "t [s]", (2099e-6, 2099e-6), "flow", 40e5, SMALL[1:], SMALL),
}


def counted(answer: ss.Diagnosis, truth: float) -> list[str]:
    """Return what an answer counts as; a bound beside `cannot tell` is wrong where it is below the leak."""
    interval, bound = answer.leak_interval_lpm, answer.bound_lpm
    if answer.verdict == "leak":
        holds = interval is None or interval[0] <= truth <= interval[1]
        kinds = [] if interval is None else ["interval", "interval holds"][: 1 + holds]
        right = holds and truth > 0.0
    else:
        right = truth <= bound if bound is not None else truth == 0.0 or answer.verdict == "cannot tell"
        kinds = [] if bound is None or answer.verdict != "no leak" else ["bound", "bound holds"][: 1 + right]
    return [answer.verdict, *kinds, *([] if right else ["wrong"])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=4, help=f"machines of a name, each logged {LOGS} times at a leak")
    parser.add_argument("--machines", nargs="+", choices=MACHINES, default=list(MACHINES), metavar="NAME")
    asked = parser.parse_args()
    wrong = []
    print("machine  kind      leak | leak  no leak  cannot tell | intervals hold | bounds hold")
    for name in asked.machines:
        counts: dict[tuple[str, float], Counter[str]] = {}
        for number in range(asked.count):
            for kind, lpm, truth, answer in MACHINES[name].answers([asked.seed, list(MACHINES).index(name), number]):
                kinds = counted(answer, truth)
                counts.setdefault((kind, lpm), Counter()).update(kinds)
                if "wrong" in kinds:
                    figures = answer.leak_interval_lpm or [answer.bound_lpm or math.nan]
                    stated = f"{answer.verdict}, {' to '.join(f'{figure:.3g}' for figure in figures)}"
                    wrong.append(f"{name} {number}, {kind}, {answer.file}, leak {lpm}, true {truth:.3g}: {stated}")
        for (kind, lpm), n in counts.items():
            verdicts = f"{n['leak']:4} {n['no leak']:8} {n['cannot tell']:12}"
            intervals, bounds = (f"{n[f'{what} holds']:4} of {n[what]:3}" for what in ("interval", "bound"))
            print(f"{name:8} {kind:8} {lpm:5} | {verdicts} | {intervals:>14} | {bounds}", flush=True)
    print("\nwrong verdicts, intervals and bounds [L/min]:", *(wrong or ["none"]), sep="\n")


if __name__ == "__main__":
    main()
