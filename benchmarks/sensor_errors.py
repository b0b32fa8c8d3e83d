"""A sensor that is off throughout, and a machine's file that is used wrongly: verdicts, sizes and what is named.

    python benchmarks/sensor_errors.py [--leak 0.05] [--seed 5]
    python benchmarks/sensor_errors.py --commissioned 8

The thesis's rig and a single rod, three duties each, 120 s, a leak from half on; the rig is known, no baseline. Errors:
the zero of either chamber pressure by -6 to +6 bar, its gain by 3 %, a position that is recorded two samples late. Of
each error: of so many records the verdict is the same, the interval holds the mean flow, and the error is named.

`--commissioned N`: a machine is commissioned on five healthy recordings of 20 s of one day, and judges N recordings of
another day: of another actuator, of a logger whose scale, offset or unit has changed, of warmer and colder oil, and of
other duties. In all rows but the second nothing leaks: each `leak` is false.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from tally import Tally, print_heads, print_row

import sealscope as ss
from sealscope.diagnosis.commissioned.machine import summarise_healthy
from sealscope.parameters import load_rig

DUTIES = {
    "thesis": ({"command": "3 sin(4t)"}, {"command": "5 sin(2t)"}, {"command": "3 sin(4t)", "load": "100 N"}),
    "single-rod-eha": (
        {"command": "3 sin(4t)"},
        {"command": "position 50 mm sin(2t)", "load": "2 kN"},
        {"command": "3 sin(4t)", "load": "100 N"},
    ),
}
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


def errors(recording: ss.Recording) -> Iterator[tuple[str, str, ss.Recording]]:
    """Yield errors: the row, the words by which a verdict names it, and the recording."""
    for name in ("p_A", "p_B"):
        for bar in ZEROS:
            shifted = changed(recording, name, lambda p, bar=bar: p + 1e5 * bar)  # type: ignore[misc]
            yield f"zero of {name}, {bar:+g} bar", "p_A - p_B reads", shifted
        yield f"gain of {name}, 3 %", "gain", changed(recording, name, lambda p: 1.03 * p)
    yield (
        "x two samples late",
        "x is recorded",
        changed(recording, "x", lambda x: np.concatenate([x[:1], x[:1], x[:-2]])),
    )


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
    parser.add_argument("--leak", type=float, default=0.05, help="L/min")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--commissioned", type=int, metavar="N", help="recordings of each wrong use")
    given = parser.parse_args()
    if given.commissioned:
        judge_wrong_use(given.commissioned)
        return
    rows: dict[str, list[tuple[bool, bool, bool]]] = {}
    for rig, duties in DUTIES.items():
        for duty in duties:
            recording = ss.simulate(
                rig=rig, leak=f"{given.leak} L/min from 60 s", duration=120.0, seed=given.seed, **duty
            )
            for row, words, off in errors(recording):
                diagnosis = ss.diagnose(off, rig=rig)
                low, high = diagnosis.leak_interval_lpm or (np.inf, -np.inf)
                held = low <= given.leak <= high
                rows.setdefault(row, []).append((diagnosis.verdict == "leak", held, words in diagnosis.reason))
                if not held:
                    print(
                        f"{rig}, {duty}, {row}: {diagnosis.verdict}, {diagnosis.cause}, {diagnosis.leak_lpm}",
                        flush=True,
                    )
    print("| error | `leak` | interval holds | named |\n| --- | --- | --- | --- |")
    for row, results in rows.items():
        print(f"| {row} | " + " | ".join(f"{sum(of)} of {len(of)}" for of in zip(*results, strict=True)) + " |")


if __name__ == "__main__":
    main()
