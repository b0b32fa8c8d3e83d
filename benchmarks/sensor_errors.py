"""A sensor that is off throughout, or changes, and a machine's file that is used wrongly: verdicts and what is named.

    python benchmarks/sensor_errors.py [--count 6] [--seed 5] [--rigs thesis single-rod-eha]
    python benchmarks/sensor_errors.py --commissioned 8

The thesis's rig and a single rod. Each of `--count` recordings a rig has a duty, load, duration (60 to 150 s), leak and
onset of its own, drawn by `--seed`; the rig is known, and of every second recording three healthy ones. Errors of a
leaking recording: the zero of either chamber pressure by -6 to +6 bar, its gain by 3 %, a position that is recorded two
samples late, a delay of a channel that changes by 5 to 40 ms at a time of its own. Of each error: of so many records
the verdict is `leak`, the interval holds the mean flow, and the error is named. Then the same of healthy recordings
whose friction rises by 20 %, whose channel's delay changes, or which have a zero: each `leak` is false.

`--commissioned N`: a machine is commissioned on five healthy recordings of 20 s of one day, and judges N recordings of
another day: of another actuator, of a logger whose scale, offset or unit has changed, of warmer and colder oil, and of
other duties. In all rows but the second nothing leaks: each `leak` is false.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from tally import Tally, print_heads, print_row

import sealscope as ss
from sealscope.diagnosis.commissioned.machine import summarise_healthy
from sealscope.parameters import load_rig

#: Rig -> smallest and largest leak [L/min], and load [N].
DRAWN = {"thesis": ((0.01, 0.06), 100.0), "single-rod-eha": ((0.05, 0.3), 4000.0)}
HEALTHY_COUNT = 3
ZEROS = (-6.0, -3.0, -1.0, 1.0, 2.0, 3.0, 6.0)
DUTY, SECONDS = "3 sin(4t)", 20.0
#: The pump of the healthy machine leaks as a new one may.
HEALTHY = {"pump.G_pump": "4e-13 m^3/(s Pa)"}
#: Name -> keywords of `simulate`, and channel -> factor and offset of what the logger makes of it.
CASES: dict[str, tuple[dict, dict[str, tuple[float, float]]]] = {
    "the same machine": ({}, {}),
    "the same machine, 0.02 L/min past its piston": ({"leak": "0.02 L/min"}, {}),
    "another actuator: area +10 %": ({"set": {"cylinder.A_A": "696 mm^2", "cylinder.A_B": "696 mm^2"}}, {}),
    "another actuator: displacement -15 %": ({"set": {"pump.q_b": "4.2 cm^3/rev"}}, {}),
    "logger: gain of p_A +3 %": ({}, {"p_A": (1.03, 0.0)}),
    "logger: gain of x +5 %": ({}, {"x": (1.05, 0.0)}),
    "logger: p_B by +2 bar": ({}, {"p_B": (1.0, 2e5)}),
    "logger: pressures in bar read as psi": ({}, {"p_A": (0.06895, 0.0), "p_B": (0.06895, 0.0)}),
    "logger: speed reversed": ({}, {"omega": (-1.0, 0.0), "theta": (-1.0, 0.0)}),
    "oil: 15 K warmer, leakage of the pump twice": ({"set": {"pump.G_pump": "8e-13 m^3/(s Pa)"}}, {}),
    "oil: 30 K warmer, four times": ({"set": {"pump.G_pump": "16e-13 m^3/(s Pa)"}}, {}),
    "oil: 15 K colder, leakage of the pump half": ({"set": {"pump.G_pump": "2e-13 m^3/(s Pa)"}}, {}),
    "oil: bulk modulus -30 %": ({"set": {"fluid.K_oil": "4.8e8 Pa"}}, {}),
    "duty: 5 sin(2t)": ({"command": "5 sin(2t)"}, {}),
    "duty: 2 sin(8t)": ({"command": "2 sin(8t)"}, {}),
    "duty: load of 0.2 kN": ({"load": "0.2 kN"}, {}),
}


def changed(recording: ss.Recording, name: str, change: Callable[[np.ndarray], np.ndarray]) -> ss.Recording:
    """Return a recording with another reading of a channel."""
    return replace(recording, channels={**recording.channels, name: change(recording[name])})


class DrawnCase(NamedTuple):
    """Words of `simulate` for a recording, the time from which it changes [s], and its leak [L/min]."""

    words: dict[str, object]
    onset: float
    leak: float


def draw_case(rig: str, random: np.random.Generator) -> DrawnCase:
    """Draw duty, load, duration, onset and leak of a recording."""
    (smallest, largest), max_load = DRAWN[rig]
    command = f"{random.uniform(2.5, 7.0):.2g} sin({random.uniform(1.5, 5.0):.2g}t)"
    duration = float(random.integers(60, 151))
    onset = round(float(random.uniform(0.3, 0.7)) * duration, 1)
    words = {"rig": rig, "command": command, "duration": duration, "seed": int(random.integers(1, 10_000))}
    if random.random() < 0.5:
        words["load"] = f"{random.uniform(0.2, 1.0) * max_load:.3g} N"
    return DrawnCase(words, onset, float(random.uniform(smallest, largest)))


def delay_changes(recording: ss.Recording, random: np.random.Generator) -> Iterator[tuple[str, str, ss.Recording]]:
    """Yield recordings of which a channel's delay changes by 5 to 40 ms, with the row and the words that name it."""
    for name in ("x", "theta", "p_A", "p_B"):
        seconds = float(random.choice([-1.0, 1.0]) * random.uniform(0.005, 0.04))
        since = float(random.uniform(0.3, 0.7) * recording.t[-1])
        t, values = recording.t, recording[name]
        late = np.interp(t - np.where(t >= since, seconds, 0.0), t, values)
        yield f"delay of {name} changes", "arrives", changed(recording, name, lambda _, late=late: late)  # type: ignore[misc]


def errors(recording: ss.Recording, random: np.random.Generator) -> Iterator[tuple[str, str, ss.Recording]]:
    """Yield errors: the row, the words by which a verdict names it, and the recording."""
    yield "none", "", recording
    for name in ("p_A", "p_B"):
        for bar in ZEROS:
            shifted = changed(recording, name, lambda p, bar=bar: p + 1e5 * bar)  # type: ignore[misc]
            yield f"zero of {name}, {bar:+g} bar", "p_A - p_B reads", shifted
        yield f"gain of {name}, 3 %", "gain", changed(recording, name, lambda p: 1.03 * p)
    late = changed(recording, "x", lambda x: np.concatenate([x[:1], x[:1], x[:-2]]))
    yield "x two samples late", "x is recorded", late
    yield from delay_changes(recording, random)


def harmless_changes(case: DrawnCase, random: np.random.Generator) -> Iterator[tuple[str, str, ss.Recording]]:
    """Yield healthy recordings of a case in which something else than a leak changes, as `errors` does."""
    rubbing = ss.simulate(**case.words, fault=f"friction +20 % from {case.onset} s")  # type: ignore[arg-type]
    yield "friction +20 %", "friction", rubbing
    for bar in (-3.0, 1.0):
        shifted = changed(rubbing, "p_A", lambda p, bar=bar: p + 1e5 * bar)  # type: ignore[misc]
        yield f"friction +20 %, zero of p_A, {bar:+g} bar", "friction", shifted
    yield from delay_changes(ss.simulate(**case.words), random)  # type: ignore[arg-type]


def date(recording: ss.Recording, day: str) -> ss.Recording:
    """Return the recording of a day."""
    return replace(recording, provenance={**recording.provenance, "start": f"{day}T08:00:00"})


def judge_wrong_use(count: int) -> None:
    """Print what a commissioned machine says of recordings that are not its own, or not as its logger wrote them."""
    runs = [ss.simulate(command=DUTY, duration=SECONDS, set=HEALTHY, seed=seed) for seed in range(1, 6)]
    rig = load_rig("thesis")
    healthy = tuple(summarise_healthy(date(run, "2026-03-01"), rig, f"run{k + 1}") for k, run in enumerate(runs))
    machine = ss.CommissionedMachine("actuator 7", healthy, rig)
    print_heads("used with", "named as another machine")
    for name, (keywords, readings) in CASES.items():
        words = {"command": DUTY, **keywords, "set": {**HEALTHY, **keywords.get("set", {})}}
        tally, named = Tally(), 0
        for seed in range(100, 100 + count):
            recording = ss.simulate(**words, duration=SECONDS, seed=seed)
            for channel, (factor, offset) in readings.items():
                recording = changed(recording, channel, lambda x, by=(factor, offset): by[0] * x + by[1])  # type: ignore[misc]
            verdict = machine.diagnose(date(recording, "2026-03-02"))
            tally.add(verdict)
            named += "another machine" in verdict.reason
        print_row(name, named, *tally.cells())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=6, help="recordings of each rig")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--rigs", nargs="+", choices=DRAWN, default=list(DRAWN))
    parser.add_argument("--commissioned", type=int, metavar="N", help="recordings of each wrong use")
    given = parser.parse_args()
    if given.commissioned:
        judge_wrong_use(given.commissioned)
        return
    random = np.random.default_rng(given.seed)
    rows: dict[tuple[str, str], list[tuple[bool, bool, bool]]] = {}
    for rig in given.rigs:
        for k in range(given.count):
            case = draw_case(rig, random)
            baseline = []
            if k % 2:
                seeds = random.integers(1, 10_000, HEALTHY_COUNT)
                baseline = [ss.simulate(**{**case.words, "seed": int(seed)}) for seed in seeds]  # type: ignore[arg-type]
            leaking = ss.simulate(**case.words, leak=f"{case.leak:.4g} L/min from {case.onset} s")  # type: ignore[arg-type]
            judged = [("leaking", *row) for row in errors(leaking, random)]
            judged += [("healthy", *row) for row in harmless_changes(case, random)]
            for machine, row, words, recording in judged:
                diagnosis = ss.diagnose(recording, rig=rig, baseline=baseline)
                low, high = diagnosis.leak_interval_lpm or (np.inf, -np.inf)
                is_held = low <= case.leak <= high
                is_leak = diagnosis.verdict == "leak"
                rows.setdefault((machine, row), []).append((is_leak, is_held, words in diagnosis.reason))
                if is_leak != (machine == "leaking") or is_leak != is_held:
                    sizes = diagnosis.leak_lpm, diagnosis.leak_interval_lpm, diagnosis.bound_lpm
                    print(case, row, len(baseline), diagnosis.verdict, diagnosis.cause, sizes, flush=True)
    print("| machine | error | `leak` | interval holds | named |\n| --- | --- | --- | --- | --- |")
    for (machine, row), results in rows.items():
        print(
            f"| {machine} | {row} | "
            + " | ".join(f"{sum(column)} of {len(column)}" for column in zip(*results, strict=True))
            + " |"
        )


if __name__ == "__main__":
    main()
