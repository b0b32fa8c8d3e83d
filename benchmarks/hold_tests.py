"""Hold tests of cylinders drawn at random: do the intervals hold, are results right, and is cooling never a leak?

    python benchmarks/hold_tests.py [--tests 2000] [--seed 1] [--jobs 2]

Bores of 25 to 250 mm, loads on either side, laminar and turbulent leaks past piston, valve or rod seal that follow the
oil's viscosity, oil with air that is warm, steady, cooling or warming, with and without a thermometer, valves that
settle, seals that stick and slip, logs that begin with the lift or end with the release, and loggers of 0.1 to 1000 Hz
with encoder steps, correlated noise and drift. Some workshops state the oil's temperature, the sides with holding
valves or capped ports, or measure what passes a piston at its stop, by a flow meter or a vessel. The plant is
integrated here, second by second, and shares no code with the estimator. Truth of the creep is the mean of the leak's
flow over the area; where oil cools unlogged it is the mean speed of the piston over the hold, without what settles.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

import sealscope as ss

BAR, ML_MIN, MM_MIN = 1e5, 1e-6 / 60.0, 1e-3 / 60.0
MAX_SAMPLES = 120_000


def log_uniform(random, low, high):
    """Draw a number, uniform in its logarithm."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def draw_plant(random):
    """Draw cylinder, load, oil, leak and temperature of a hold."""
    bore = log_uniform(random, 0.025, 0.25)
    A = np.pi / 4.0 * bore**2
    B = A * (1.0 - random.uniform(0.4, 0.75) ** 2)
    stroke = log_uniform(random, 0.15, 1.5)
    x = random.uniform(0.15, 0.85) * stroke
    loaded = "B" if random.random() < 0.2 else "A"
    paths = ["piston", "valve"] if loaded == "A" else ["piston", "valve", "rod seal"]  # A has no rod
    thermal = random.choice(["steady", "logged", "unlogged"], p=[0.4, 0.3, 0.3])
    swing = 0.0 if thermal == "steady" else random.choice([-1.0, 1.0], p=[0.8, 0.2]) * log_uniform(random, 1.0, 20.0)
    return {
        "A": A, "B": B, "stroke": stroke, "x": x, "loaded": loaded, "thermal": thermal, "swing": swing,
        "tau": log_uniform(random, 600.0, 12000.0), "dead": random.uniform(0.05, 0.6),
        "p": log_uniform(random, 20, 250) * BAR, "K": random.uniform(1.0e9, 1.7e9), "air": random.uniform(0.0, 0.01),
        "exponent": random.choice([0.5, 0.75, 1.0]), "halving": 15.0,
        "path": str(random.choice(paths)), "far": random.choice(["tank", "locked"], p=[0.6, 0.4]),
        "creep": 0.0 if random.random() < 0.25 else log_uniform(random, 0.02, 10.0) * MM_MIN,
        "settle": 0.0 if random.random() < 0.5 else log_uniform(random, 0.01, 0.5) * 1e-3,
        "settle_time": log_uniform(random, 1.0, 30.0), "stop": random.random() < 0.2,
    }  # fmt: skip


def compressibility(plant, p):
    """Compute the compressibility of oil with free air at the absolute pressure `p`: 1/K and Boyle's law."""
    return 1.0 / plant["K"] + plant["air"] * 101325.0 / p**2


def simulate(plant, seconds):
    """Integrate a hold second by second: times, position, pressures of loaded and other side, temperature, flow."""
    steps = max(int(min(seconds, 3600.0)), 60)
    dt = seconds / steps
    t = np.arange(steps + 1) * dt
    T = plant["swing"] * -np.expm1(-t / plant["tau"])
    area, far_area = (plant["A"], plant["B"]) if plant["loaded"] == "A" else (plant["B"], plant["A"])
    reach = plant["x"] if plant["loaded"] == "A" else plant["stroke"] - plant["x"]
    V, far_V = area * (reach + plant["dead"]), far_area * (plant["stroke"] - reach + plant["dead"])
    p, far_p = plant["p"] + 101325.0, 101325.0 + (5e5 if plant["far"] == "tank" else 20e5) * 0.2
    c = plant["creep"] * area / (p - far_p) ** plant["exponent"]
    alpha = 6.7e-4
    # of dimensions alone: a flow with the power n of the pressure goes with the power 1 - 2 n of the viscosity
    fluidity = 2.0 ** ((2.0 * plant["exponent"] - 1.0) * T / plant["halving"])
    s, rows = 0.0, []
    for k in range(steps + 1):
        drop = p - far_p if plant["path"] == "piston" else p - 101325.0
        flow = c * fluidity[k] * np.sign(drop) * abs(drop) ** plant["exponent"]
        rows.append((s, p, far_p, flow))
        if k == steps:
            break
        dT = T[k + 1] - T[k]
        gained = flow * dt if plant["path"] == "piston" else 0.0
        if plant["stop"]:  # the piston rests on its stop, both chambers are closed
            p += (-flow * dt / V + alpha * dT) / compressibility(plant, p)
            if plant["far"] == "locked":
                far_p += (gained / far_V + alpha * dT) / compressibility(plant, far_p)
        elif plant["far"] == "tank":  # the load keeps the pressure
            s += flow * dt / area - alpha * dT * V / area
        else:  # both closed: the load's balance area dp = far_area dfar_p with the travel s
            a = area / (V * compressibility(plant, p))
            b = far_area / (far_V * compressibility(plant, far_p))
            push = (-flow * dt / V + alpha * dT) / compressibility(plant, p)
            far_push = (gained / far_V + alpha * dT) / compressibility(plant, far_p)
            ds = (far_area * far_push - area * push) / (area * a + far_area * b)
            p, far_p, s = p + push + a * ds, max(far_p + far_push - b * ds, 2e4), s + ds
        p, far_p = max(p, 1.1e5), max(far_p, 2e4)
    s, p, far_p, flow = np.array(rows).T
    if not plant["stop"]:
        s = s + plant["settle"] * -np.expm1(-t / plant["settle_time"])
    return t, s, p, far_p, T, flow


def draw_logger(random):
    """Draw a logger: rate, minutes, encoder step, noise."""
    seconds = log_uniform(random, 60.0, 3600.0)
    rate = log_uniform(random, max(0.1, 12.0 / seconds), 1000.0)
    return {
        "seconds": seconds, "rate": min(rate, MAX_SAMPLES / seconds),
        "step": random.choice([0.0, 1e-6, 1e-5, 1e-4]), "noise": log_uniform(random, 2e-6, 1e-4),
        "memory": 0.0 if random.random() < 0.5 else log_uniform(random, 0.05, 5.0),
        "drift": 0.0 if random.random() < 0.7 else log_uniform(random, 3e-6, 5e-5),
        "slip": 0.0 if random.random() < 0.75 else log_uniform(random, 1e-5, 2e-4),
        "p_noise": log_uniform(random, 0.02, 0.5) * BAR, "p_step": random.choice([0.0, 0.01, 0.1]) * BAR,
        "pressures": random.random() < 0.75,
        # a lift before the hold, and a release after it [s], of a log that was started early
        "lift": 0.0 if random.random() < 0.6 else random.uniform(5.0, 30.0),
        "release": 0.0 if random.random() < 0.7 else random.uniform(3.0, 10.0),
    }  # fmt: skip


def draw_statements(random, plant, has_thermometer):
    """Draw what the workshop states, all of it true: arguments of the hold test."""
    far = "B" if plant["loaded"] == "A" else "A"
    stated = {}
    if not has_thermometer and random.random() < 0.4:
        course = "falling" if plant["swing"] < 0.0 else "rising" if plant["swing"] > 0.0 else "steady"
        # what the swing is of the oil's whole excess over the workshop; the rest stays, or went before
        excess = min(-plant["swing"] / random.uniform(0.3, 1.0), 70.0) if plant["swing"] else random.uniform(0.0, 30.0)
        degrees = max(5.0 * round((random.uniform(15.0, 25.0) + excess) / 5.0), 0.0)
        stated["oil"] = f"{degrees:g} degC {course}" if random.random() < 0.7 else course
    if plant["path"] != "valve" and random.random() < 0.2:
        stated["capped"] = f"{plant['loaded']},{far}" if plant["far"] == "locked" else plant["loaded"]
    if random.random() < 0.3:
        sides = [side for side in (plant["loaded"], far) if random.random() < 0.5]
        if plant["path"] == "valve":
            sides = sorted({*sides, plant["loaded"]})
        stated["valve"] = ",".join(sides) or "none"
    return stated


def measure_leak(random, plant, recording, flow, t_plant):
    """Measure what passes a piston at its stop to the open far side, by a vessel or a flow meter.

    Returns the recording, with the meter, and the collected volume as text; both are as they were in other tests.
    """
    measurable = plant["stop"] and plant["path"] == "piston" and plant["far"] == "tank" and plant["thermal"] == "steady"
    kind = random.choice(["none", "vessel", "meter"])
    if not measurable or kind == "none":
        return recording, None
    if kind == "vessel":  # a measuring cylinder, read to a drop; the truth is that of the whole hold
        volume = float(np.trapezoid(flow, t_plant)) * (1.0 + 0.015 * random.standard_normal())
        volume = max(volume + 0.05e-6 * random.standard_normal(), 0.0)
        return recording, f"{1e6 * volume:.2f} mL in {t_plant[-1] / 60.0:.3f} min"
    gain = 1.0 + 0.01 * random.standard_normal()
    readings = gain * np.interp(recording.t, t_plant, flow)
    readings = readings * (1.0 + 0.05 * random.standard_normal(readings.size))
    channels = {**recording.channels, "q_leak": readings}
    units = {**recording.units, "q_leak": "m^3/s"}
    return ss.Recording(recording.t, channels, units, rate=recording.rate), None


def colour(random, n, step, memory):
    """Draw noise of variance 1 with a correlation time `memory` [s], sampled every `step` [s]."""
    white = random.standard_normal(n)
    if memory <= 0.0:
        return white
    from scipy.signal import lfilter

    a = np.exp(-step / memory)
    return lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], white, zi=[a * random.standard_normal()])[0]


def add_motions(random, recording, plant, logger):
    """Add a lift before a recorded hold and a release after it, both with the pump's and the motion's pressures."""
    n_before, n_after = (int(logger[name] * logger["rate"]) for name in ("lift", "release"))
    n = len(recording)
    t = np.arange(-n_before, n + n_after) / logger["rate"]
    distance = np.maximum(-t, 0.0) + np.maximum(t - t[n_before + n - 1], 0.0)  # [s] from the hold
    speed = random.uniform(0.01, 0.1) * (-1.0 if plant["loaded"] == "A" else 1.0)
    values = {}
    for name, hold in recording.channels.items():
        values[name] = np.concatenate([np.full(n_before, hold[0]), hold, np.full(n_after, hold[-1])])
        if name == "x" and not plant["stop"]:
            values[name] = values[name] + speed * distance
        elif name.startswith("p_"):
            pump = (random.uniform(20.0, 60.0) * BAR) * (distance > 0.0)
            values[name] = values[name] + pump * (1.0 + 0.1 * random.standard_normal(t.size))
    return ss.Recording(t - t[0], values, dict(recording.units), rate=logger["rate"]), -float(t[0])


def record(random, plant, logger):
    """Record a simulated hold as the logger does; return it with the leak's flow and the travel over time."""
    t_plant, s, p, far_p, T, flow = simulate(plant, logger["seconds"])
    t = np.arange(int(logger["seconds"] * logger["rate"])) / logger["rate"]
    travel = np.interp(t, t_plant, s)
    if logger["slip"]:  # the seal sticks until the travel is a slip ahead, each of its own size
        sizes = logger["slip"] * random.uniform(0.5, 1.5, int(np.ptp(travel) / logger["slip"] * 3) + 2)
        edges = np.concatenate([[0.0], np.cumsum(sizes)]) - random.uniform() * sizes[0]
        sign = 1.0 if travel[-1] >= travel[0] else -1.0
        progress = np.maximum.accumulate(sign * (travel - travel[0]))
        travel = travel[0] + sign * edges[np.searchsorted(edges, progress, side="right") - 1]
    noise = logger["noise"] * colour(random, t.size, 1.0 / logger["rate"], logger["memory"])
    drift = logger["drift"] * np.cumsum(random.standard_normal(t.size)) / np.sqrt(t.size)
    x = plant["x"] + (-1.0 if plant["loaded"] == "A" else 1.0) * travel + noise + drift
    far = "B" if plant["loaded"] == "A" else "A"
    values = {"x": np.round(x / logger["step"]) * logger["step"] if logger["step"] else x}
    if logger["pressures"] or plant["stop"] or plant["far"] == "locked":
        for name, course in ((f"p_{plant['loaded']}", p), (f"p_{far}", far_p)):
            gauge = np.interp(t, t_plant, course) - 101325.0 + logger["p_noise"] * random.standard_normal(t.size)
            values[name] = np.round(gauge / logger["p_step"]) * logger["p_step"] if logger["p_step"] else gauge
        if plant["stop"] and random.random() < 0.5:
            del values["x"]
    if plant["thermal"] != "unlogged" and random.random() < (1.0 if plant["thermal"] == "logged" else 0.7):
        values["T_oil"] = np.round(10.0 * (320.0 + np.interp(t, t_plant, T))) / 10.0
    units = {name: "m" if name == "x" else "K" if name == "T_oil" else "Pa" for name in values}
    sunk = s - (0.0 if plant["stop"] else plant["settle"]) * -np.expm1(-t_plant / plant["settle_time"])
    return ss.Recording(t, values, units, rate=logger["rate"]), (t_plant, flow, sunk, p)


def truths(course, start, end):
    """Compute mean flow and mean speed, without what settles, between two times of a simulated `course`."""
    t, flow, sunk, _ = course
    volume = np.concatenate([[0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]) * np.diff(t))])
    return [float(np.diff(np.interp([start, end], t, values))[0]) / (end - start) for values in (volume, sunk)]


def bound_deviation(plant, logger, channels, has_volume, course, stated):
    """Compute the Cramer-Rao bound of the leak's flow [m^3/s]: noise and law known, all else with its prior.

    Unknown are size and time of what settles and of cooling that is not logged (of the smaller of the assumed sizes, or
    as stated), the column of a logged temperature, and its steps of 0.1 K, and the oil that the pressure compresses.
    """
    t_plant, flow, _, p = course
    seconds, area = float(t_plant[-1]), plant[plant["loaded"]]
    reach = plant["x"] if plant["loaded"] == "A" else plant["stroke"] - plant["x"]
    column, mean_flow = reach + plant["dead"], float(np.mean(flow))
    if "collected" in stated or "q_leak" in channels:
        return float(np.hypot((0.02 if "collected" in stated else 0.01) * mean_flow, 5e-8 / seconds))
    m = 200
    t = np.linspace(0.0, seconds, m)

    def courses(size, swing, time):
        """Compute an exponential of a size, and its derivative by the logarithm of its time."""
        return [size * -np.expm1(-t / time), swing * -t / time * np.exp(-t / time)]

    # oil temperature: its prior of 4 K, or the logged course times a column of 40 % uncertainty
    size = 0.3 if stated.get("oil", "").endswith("steady") else 4.0
    cooling = [7e-4 * column * values for values in courses(size, plant["swing"], plant["tau"])]
    known = "T_oil" in channels
    if known:
        cooling = [7e-4 * column * 0.41 * values for values in courses(plant["swing"], 0.0, plant["tau"])]
        cooling.append(7e-4 * column * 0.015 * t / seconds)
    if plant["stop"] or "x" not in channels:  # volume times compressibility is known to so much
        scale = np.hypot(0.05 if has_volume else 0.4 if "x" in channels else 0.7, 0.3)
        return float(np.hypot(scale * mean_flow, np.linalg.norm([values[-1] for values in cooling]) * area / seconds))
    n = seconds * logger["rate"]
    memory = 1.0 + 2.0 * logger["memory"] * logger["rate"]
    white = (
        logger["noise"] ** 2 * min(memory * m / n, m / 2.0) + (logger["slip"] ** 2 + logger["step"] ** 2 * m / n) / 12.0
    )
    covariance = white * np.eye(m) + logger["drift"] ** 2 * np.minimum(t[:, None], t[None, :]) / seconds
    strain = np.concatenate([[0.0], np.cumsum(compressibility(plant, p[1:]) * np.diff(p))])
    compressed = 0.5 * column * np.interp(t, t_plant, strain)  # known to so much, as the test assumes
    columns = np.column_stack(
        [t, np.ones(m), compressed, *cooling, *courses(1e-3, plant["settle"], plant["settle_time"])]
    )
    information = columns.T @ np.linalg.solve(covariance, columns) + np.diag(
        [0.0, 0.0] + [1.0] * (columns.shape[1] - 2)
    )
    return float(area * np.sqrt(np.linalg.inv(information)[0, 0]))


def run_test(seed, first):
    """Simulate, record and judge one hold; return what is tallied."""
    random = np.random.default_rng([first, seed])
    plant, logger = draw_plant(random), draw_logger(random)
    plant["halving"] = np.random.default_rng([first, seed, 1]).uniform(11.0, 22.0)  # [K]; oils of ISO VG 32 to 68
    while plant["stop"] and simulate(plant, logger["seconds"])[2][-1] < 0.3 * plant["p"]:
        plant["creep"], plant["swing"] = 0.3 * plant["creep"], 0.5 * plant["swing"]  # else the chamber empties
    recording, course = record(random, plant, logger)
    recording, collected = measure_leak(random, plant, recording, course[1], course[0])
    stated = draw_statements(random, plant, "T_oil" in recording.channels)
    if collected is not None:
        stated["collected"] = collected
    recording, begin_s = add_motions(random, recording, plant, logger)
    flow, speed = truths(course, 0.0, course[0][-1])
    area = plant[plant["loaded"]]
    limit = (flow if flow > 0.0 else log_uniform(random, 0.05, 2.0) * MM_MIN * area) * log_uniform(random, 0.25, 4.0)
    areas = (f"{plant['A']} m^2", f"{plant['B']} m^2")
    volumes = None
    if plant["stop"] and random.random() < 0.5:
        lengths = plant["x"] + plant["dead"], plant["stroke"] - plant["x"] + plant["dead"]
        volumes = tuple(f"{plant[side] * length} m^3" for side, length in zip("AB", lengths, strict=True))
    # a workshop knows which way the load pushes, which a position alone does not tell
    loaded = None if any(name.startswith("p_") for name in recording.channels) else plant["loaded"]
    begin = time.process_time()
    try:
        results = ss.hold_test(
            recording, area=areas, volume=volumes, limit=f"{limit / ML_MIN} mL/min", loaded=loaded, **stated
        )
        result = max(results, key=lambda hold: hold.end_s - hold.start_s)
    except Exception as error:
        error = f"{type(error).__name__}: {error}"
        return {"seed": seed, "error": error, "plant": plant, "logger": logger, "stated": stated}
    seconds = time.process_time() - begin
    if collected is not None:
        start, end = 0.0, logger["seconds"]
    else:
        start, end = (min(max(moment - begin_s, 0.0), logger["seconds"]) for moment in (result.start_s, result.end_s))
    flow, speed = truths(course, start, end)
    unlogged = plant["thermal"] == "unlogged" and not stated.get("oil")
    true_creep = (speed if unlogged else flow / area if not plant["stop"] else 0.0) / MM_MIN
    if plant["far"] == "locked" and not plant["stop"]:
        true_creep = None if unlogged else speed / MM_MIN if plant["thermal"] == "steady" else None
    return {
        "seed": seed, "plant": plant, "logger": logger, "stated": stated, "seconds": seconds, "result": result.result,
        "causes": result.causes, "flow": 6e4 * flow, "limit": 6e4 * limit, "creep": true_creep,
        "creep_interval": result.creep_interval_mm_per_min, "leak_interval": result.leak_interval_lpm,
        "log": sorted(recording.channels), "n": len(recording),
        "bound": 6e4 * 1.96 * bound_deviation(plant, logger, recording.channels, volumes is not None, course, stated),
    }  # fmt: skip


def tally(tests):
    """Print what is asked of the tests, in total and by kind."""
    errors = [test for test in tests if "error" in test]
    print(f"{len(tests)} tests, {len(errors)} without a result: {Counter(test['error'][:70] for test in errors)}")
    tests = [test for test in tests if "error" not in test]
    kinds = {
        "all": lambda test: True,
        "steady": lambda test: test["plant"]["thermal"] == "steady",
        "logged": lambda test: test["plant"]["thermal"] == "logged",
        "unlogged": lambda test: test["plant"]["thermal"] == "unlogged",
        "thermometer": lambda test: "T_oil" in test["log"],
        "at a stop": lambda test: test["plant"]["stop"],
        "step 0.1 mm": lambda test: test["logger"]["step"] == 1e-4,
        "stick-slip": lambda test: test["logger"]["slip"] > 0.0,
        "drift": lambda test: test["logger"]["drift"] > 0.0,
        "correlated": lambda test: test["logger"]["memory"] > 0.0,
        "white": lambda test: not any(test["logger"][name] for name in ("slip", "drift", "memory", "step")),
        "still": lambda test: test["plant"]["creep"] == 0.0,
        "sinking": lambda test: test["plant"]["creep"] > 0.0,
        "far locked": lambda test: test["plant"]["far"] == "locked",
        "lift, release": lambda test: test["logger"]["lift"] > 0.0 or test["logger"]["release"] > 0.0,
        "far tank": lambda test: test["plant"]["far"] == "tank",
    }
    print(f"{'kind':12} {'n':>5}    creep     leak    wrong  undecided  beyond 20 %  by bound")
    for name, belongs in kinds.items():
        group = [test for test in tests if belongs(test)]
        if not group:
            continue
        hits = defaultdict(list)
        for test in group:
            for key, truth in (("creep", test["creep"]), ("leak", test["flow"])):
                ends = test[f"{key}_interval"]
                if ends is not None and truth is not None:
                    hits[key].append(ends[0] <= truth <= ends[1])
            passes = test["flow"] <= test["limit"]
            hits["wrong"].append(test["result"] == ("fail" if passes else "pass"))
            hits["undecided"].append(test["result"] == "undecided")
            if abs(test["flow"] / test["limit"] - 1.0) > 0.2:
                hits["beyond"].append(test["result"] == "undecided")
                hits["bound"].append(abs(test["flow"] - test["limit"]) < test["bound"])
        keys = ("creep", "leak", "wrong", "undecided", "beyond", "bound")
        shares = [100.0 * np.mean(hits[key]) if hits[key] else np.nan for key in keys]
        print(f"{name:12} {len(group):5} " + " ".join(f"{share:8.1f}" for share in shares[:4]), end="")
        print(f"  {shares[4]:11.1f} {shares[5]:9.1f}")
    cooled = [test for test in tests if test["plant"]["creep"] == 0.0 and test["plant"]["thermal"] == "unlogged"]
    named = [test for test in cooled if set(test["causes"]) - {"cooling"}]
    failed = [test for test in cooled if test["result"] == "fail"]
    print(f"cooling alone, no thermometer: {len(cooled)}, named a leak {len(named)}, fail {len(failed)}")
    print("path, told as:")
    told = Counter()
    for test in tests:
        if test["causes"] and test["causes"] != ("cooling",):
            words = (
                "piston" if test["causes"] == ("piston",) else "both" if "piston" in test["causes"] else "not piston"
            )
            truth = test["plant"]["path"] if test["plant"]["creep"] else "nothing"
            told[test["plant"]["far"], truth, words] += 1
    for key, count in sorted(told.items()):
        print("  ", *key, count)
    seconds = [test["seconds"] for test in tests[1:]]  # the first loads the code
    print(f"processor time a test: mean {np.mean(seconds):.3f} s, 99 % below {np.percentile(seconds, 99):.3f} s")


def main():
    """Run the tests and print the tally."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tests", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.jobs) as pool:
        tests = list(pool.map(partial(run_test, first=arguments.seed), range(arguments.tests), chunksize=10))
    tally(tests)
    return tests


if __name__ == "__main__":
    main()
