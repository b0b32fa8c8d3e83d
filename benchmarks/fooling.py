"""Recordings that fool: what the verdict says where machine, sensor, logger or label changed, and where nothing leaks.

    python benchmarks/fooling.py INTO.md [--machines N] [--first NUMBER] [--rows TEXT] [--records FOLDER]

Takes N healthy machines of the plan `bench-detectors` from number FIRST on, and as many with a leak of 0.0042 L/min
from half on; makes of every record those of `TRANSFORMATIONS`, and diagnoses each through three sets of channels: all,
the chamber pressures with the command, and the pressures alone. --records keeps the simulated records.

Rows of the group `garbage` leave no machine to judge: only `cannot tell` is right there. Of all others, a healthy
machine must not be called `leak` in more than 3 % of the records.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from verdicts import recording_of

import sealscope as ss
from sealscope.campaigns.cases.case import cases_of
from sealscope.campaigns.plans.reader import load_plan
from sealscope.recordings.channels import Array

VIEWS: dict[str, tuple[str, ...] | None] = {"all": None, "command": ("u", "p_A", "p_B"), "pressures": ("p_A", "p_B")}
Flags = NDArray[np.bool_]
CHAMBERS = ("p_A", "p_B")
PRESSURES = ("p_1", "p_2", *CHAMBERS)
PLAN, LEAK = "bench-detectors", 0.0042


@dataclass(frozen=True)
class Sample:
    """What a transformation may use: the record, a random generator, and the same duty on another machine."""

    record: ss.Recording
    random: np.random.Generator
    other: ss.Recording

    @property
    def late(self) -> Flags:
        """Return which rows (n,) lie in the second half of the record."""
        return self.after(0.5)

    def after(self, share: float, until: float = 1.0) -> Flags:
        """Return which rows (n,) lie after one share of the record and before another."""
        at = np.arange(len(self.record)) / len(self.record)
        return np.asarray((at >= share) & (at < until))

    def changed(self, change: Callable[[Array], Array], names: Iterable[str] = CHAMBERS) -> ss.Recording:
        """Return the record with some channels changed."""
        own = {name: change(self.record[name]) for name in names if name in self.record}
        return replace(self.record, channels={**self.record.channels, **own})

    def from_half(self, change: Callable[[Array], Array], names: Iterable[str] = CHAMBERS) -> ss.Recording:
        """Return the record with some channels changed in its second half."""
        late = self.late
        return self.changed(lambda values: np.where(late, change(values), values), names)

    def white(self, size: float) -> Array:
        """Return white noise (n,)."""
        return np.asarray(size * self.random.standard_normal(len(self.record)))

    def swing(self) -> float:
        """Return the rms of p_A - p_B about its mean."""
        return float(np.std(self.record["p_A"] - self.record["p_B"]))


Transformation = Callable[[Sample], ss.Recording]
TRANSFORMATIONS: dict[str, tuple[str, Transformation]] = {}


def row(name: str, group: str) -> Callable[[Transformation], Transformation]:
    """Enter a transformation under its name in one of the groups gap, sensor, logger, duty, machine, garbage."""

    def enter(transformation: Transformation) -> Transformation:
        TRANSFORMATIONS[name] = (group, transformation)
        return transformation

    return enter


def _low_pass(values: Array, width: int) -> Array:
    kernel = np.hanning(width + 2)[1:-1]
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), "valid")[: values.size]


def _hum(s: Sample, hertz: float, size: float) -> Array:
    return np.asarray(size * s.swing() * np.sin(2 * np.pi * hertz * s.record.t))


def _kept(record: ss.Recording, rows: np.ndarray) -> ss.Recording:
    return replace(record, t=record.t[rows], channels={name: values[rows] for name, values in record.channels.items()})


def _holed(s: Sample, rows: np.ndarray, names: Iterable[str] = CHAMBERS) -> ss.Recording:
    return s.changed(lambda values: np.where(rows, np.nan, values), names)


def _stretched(s: Sample, factor: float) -> ss.Recording:
    return replace(s.record, t=s.record.t * factor, rate=s.record.rate / factor)


row("nothing", "gap")(lambda s: s.record)
row("one sample missing at half", "gap")(lambda s: _holed(s, np.arange(len(s.record)) == len(s.record) // 2))
row("0.5 % of samples missing from half on", "gap")(
    lambda s: _holed(s, (s.random.random(len(s.record)) < 0.005) & (s.late))
)
row("1 s of all channels missing", "gap")(lambda s: _holed(s, s.after(0.4, 0.406), s.record.channels))
row("2 s of rows lost", "gap")(lambda s: _kept(s.record, ~s.after(0.6, 0.612)))
row("0.1 s in 4 missing from half on", "gap")(lambda s: _holed(s, (s.record.t % 4.0 < 0.1) & (s.late)))
row("last third missing", "gap")(lambda s: _holed(s, s.after(0.67), s.record.channels))
row("samples at random missing, 30 %", "gap")(lambda s: _holed(s, s.random.random(len(s.record)) < 0.3))

for _width in (3, 5, 9):
    row(f"smoother filter of {_width} samples from half on", "sensor")(
        lambda s, width=_width: s.from_half(lambda values: _low_pass(values, width))
    )
row("smoother filter of p_A alone from half on", "sensor")(
    lambda s: s.from_half(lambda values: _low_pass(values, 5), ("p_A",))
)
row("sharper filter from half on", "sensor")(
    lambda s: s.changed(lambda values: np.where(s.late, values, _low_pass(values, 5)))
)
for _hertz, _size in ((50.0, 0.01), (50.0, 0.03), (60.0, 0.01), (100.0, 0.01)):
    row(f"hum of {_hertz:g} Hz, {_size:.0%}, from half on", "sensor")(
        lambda s, hertz=_hertz, size=_size: s.from_half(lambda values: values + _hum(s, hertz, size))
    )
row("hum of 50 Hz, 1 %, throughout", "sensor")(lambda s: s.changed(lambda values: values + _hum(s, 50.0, 0.01)))
row("hum of 50 Hz, 1 %, until half", "sensor")(
    lambda s: s.changed(lambda values: np.where(s.late, values, values + _hum(s, 50.0, 0.01)))
)
row("hum on p_A alone from half on", "sensor")(
    lambda s: s.from_half(lambda values: values + _hum(s, 50.0, 0.01), ("p_A",))
)
row("noise doubled from half on", "sensor")(lambda s: s.from_half(lambda values: values + s.white(8e3)))
row("noise of p_A doubled from half on", "sensor")(
    lambda s: s.from_half(lambda values: values + s.white(8e3), ("p_A",))
)
row("spikes from half on", "sensor")(
    lambda s: s.from_half(lambda values: values + 2e5 * (s.random.random(values.size) < 1e-3))
)
row("quantised to 14 kPa from half on", "sensor")(lambda s: s.from_half(lambda values: np.round(values / 14e3) * 14e3))
row("offset of p_A from half on", "sensor")(lambda s: s.from_half(lambda values: values + 3e4, ("p_A",)))
row("offset of both from half on", "sensor")(lambda s: s.from_half(lambda values: values + 3e4))
row("gain of p_A 2 % up from half on", "sensor")(lambda s: s.from_half(lambda values: 1.02 * values, ("p_A",)))
row("gain of p_B 5 % down from half on", "sensor")(lambda s: s.from_half(lambda values: 0.95 * values, ("p_B",)))
row("drift of p_A by 50 kPa", "sensor")(
    lambda s: s.changed(lambda values: values + 5e4 * s.record.t / s.record.duration, ("p_A",))
)
row("p_A clipped at its 90 % quantile from half on", "sensor")(
    lambda s: s.from_half(lambda values: np.minimum(values, np.quantile(values, 0.9)), ("p_A",))
)
row("p_A lags by 4 ms from half on", "sensor")(lambda s: s.from_half(lambda values: np.roll(values, 2), ("p_A",)))
row("x scale 1 % up from half on", "sensor")(lambda s: s.from_half(lambda values: 1.01 * values, ("x",)))
row("x slips by 1 mm at half", "sensor")(lambda s: s.from_half(lambda values: values + 1e-3, ("x",)))
row("theta slips by 1 rad at half", "sensor")(lambda s: s.from_half(lambda values: values + 1.0, ("theta",)))
row("p_A stuck for 2 s", "sensor")(
    lambda s: s.changed(lambda v: np.where(s.after(0.6, 0.612), v[int(0.6 * v.size)], v), ("p_A",))
)

row("chambers swapped at half", "logger")(
    lambda s: replace(
        s.record,
        channels={
            **s.record.channels,
            "p_A": np.where(s.late, s.record["p_B"], s.record["p_A"]),
            "p_B": np.where(s.late, s.record["p_A"], s.record["p_B"]),
        },
    )
)
row("chambers swapped throughout", "logger")(
    lambda s: replace(s.record, channels={**s.record.channels, "p_A": s.record["p_B"], "p_B": s.record["p_A"]})
)
row("command negated", "logger")(lambda s: s.changed(np.negative, ("u",)))
row("u and x shifted by 20 ms", "logger")(lambda s: s.changed(lambda values: np.roll(values, 10), ("u", "x")))
row("jitter of the time stamps", "logger")(
    lambda s: replace(s.record, t=s.record.t + 2e-4 * s.random.standard_normal(len(s.record)))
)
row("samples repeated in pairs from half on", "logger")(lambda s: s.from_half(lambda v: np.repeat(v[::2], 2)[: v.size]))
row("two machines spliced", "logger")(
    lambda s: replace(
        s.record,
        channels={name: np.where(s.late, s.other[name], s.record[name]) for name in s.record.channels},
    )
)
row("every second sample", "logger")(
    lambda s: replace(_kept(s.record, np.arange(len(s.record)) % 2 == 0), rate=s.record.rate / 2)
)
row("time of day 1e9 s", "logger")(lambda s: replace(s.record, t=s.record.t + 1e9))
row("pressures in counts", "logger")(
    lambda s: replace(
        s.changed(lambda values: np.round(values / 250.0)), units={**s.record.units, "p_A": "count", "p_B": "count"}
    )
)

row("command stops at half", "duty")(
    lambda s: s.changed(lambda values: np.where(s.late, values[values.size // 2] + 0.0 * values, values), ("u",))
)
row("pressures halved from half on", "duty")(
    lambda s: s.from_half(lambda v: v.mean() + 0.5 * (v - v.mean()), PRESSURES)
)
row("all but half as fast from half on", "duty")(
    lambda s: replace(
        s.record,
        channels={
            name: np.where(s.late, np.interp(0.5 * (np.arange(v.size) + v.size // 2), np.arange(v.size), v), v)
            for name, v in s.record.channels.items()
        },
    )
)

row("white noise for pressures", "garbage")(lambda s: s.changed(lambda values: values.mean() + s.white(1e5)))
row("white noise for p_A", "garbage")(lambda s: s.changed(lambda values: values.mean() + s.white(1e5), ("p_A",)))
row("random walks for pressures", "garbage")(lambda s: s.changed(lambda v: v.mean() + np.cumsum(s.white(1e3))))
row("smoothed noise for pressures", "garbage")(
    lambda s: s.changed(lambda values: values.mean() + _low_pass(s.white(3e5), 9))
)
row("p_B a copy of p_A", "garbage")(lambda s: replace(s.record, channels={**s.record.channels, "p_B": s.record["p_A"]}))
row("p_B a noisy copy of p_A", "garbage")(
    lambda s: replace(s.record, channels={**s.record.channels, "p_B": s.record["p_A"] + s.white(4e3)})
)
row("pressures from half on noise", "garbage")(lambda s: s.from_half(lambda values: values.mean() + s.white(1e5)))
row("pressures in order of size", "garbage")(lambda s: s.changed(np.sort))
row("pressures shuffled", "garbage")(lambda s: s.changed(s.random.permutation))
row("pressures backwards", "logger")(lambda s: s.changed(lambda values: values[::-1]))
row("time in ms labelled s", "garbage")(lambda s: _stretched(s, 1e3))
row("bar labelled Pa", "garbage")(lambda s: s.changed(lambda values: values * 1e-5, PRESSURES))
row("Pa labelled bar", "garbage")(lambda s: s.changed(lambda values: values * 1e5, PRESSURES))
row("a square wave for p_A", "garbage")(
    lambda s: s.changed(lambda v: np.where(np.sin(s.record.t) > 0, 4e5, 2e5) + s.white(1e2), ("p_A",))
)


def machines(number: int, first: int, folder: Path | None) -> list[tuple[ss.Recording, ss.Recording]]:
    """Return a healthy and a leaking record for each machine, from the folder where they were kept."""
    cases = list(cases_of(load_plan(PLAN)))
    healthy = [case for case in cases if not case.leak_lpm and not case.fault][first : first + number]
    leaking = [case for case in cases if case.leak_lpm == LEAK and not case.fault][first : first + number]
    return [
        (recording_of(sound, folder), recording_of(worn, folder)) for sound, worn in zip(healthy, leaking, strict=True)
    ]


@dataclass(frozen=True)
class Counts:
    """Verdicts on one transformation through one set of channels, of the healthy and of the leaking machines."""

    healthy: Counter[str]
    leaking: Counter[str]
    causes: Counter[str]

    @staticmethod
    def text(verdicts: Counter[str]) -> str:
        """Return the counts of leak, no leak and cannot tell."""
        return "|".join(str(verdicts[verdict]) for verdict in ("leak", "no leak", "cannot tell"))


def judged(pairs: list[tuple[ss.Recording, ss.Recording]], name: str, view: str) -> Counts:
    """Return the verdicts on one transformation of all machines."""
    _, transformation = TRANSFORMATIONS[name]
    counts = Counts(Counter(), Counter(), Counter())
    for number, pair in enumerate(pairs):
        others = pairs[(number + 1) % len(pairs)]
        for record, other, verdicts in zip(pair, others, (counts.healthy, counts.leaking), strict=True):
            random = np.random.default_rng([number, *name.encode()])
            made = transformation(Sample(record, random, other))
            channels = VIEWS[view]
            kept = [own for own in made.channels if own != "q_leak" and (channels is None or own in channels)]
            diagnosis = ss.diagnose(made.only(kept))
            verdicts[diagnosis.verdict] += 1
            counts.causes[diagnosis.cause or "none"] += 1
    return counts


def table(pairs: list[tuple[ss.Recording, ss.Recording]], names: Iterable[str]) -> Iterator[str]:
    """Yield the lines of the table, as they are made."""
    yield f"Verdicts on {len(pairs)} healthy and {len(pairs)} leaking machines, as leak|no leak|cannot tell."
    yield ""
    yield "| group | transformation | " + " | ".join(f"{view}: healthy | leaking" for view in VIEWS) + " |"
    yield "| --- | --- |" + " --- | --- |" * len(VIEWS)
    for name in names:
        own = [judged(pairs, name, view) for view in VIEWS]
        cells = " | ".join(f"{Counts.text(counts.healthy)} | {Counts.text(counts.leaking)}" for counts in own)
        yield f"| {TRANSFORMATIONS[name][0]} | {name} | {cells} |"


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("into", type=Path)
    parser.add_argument("--machines", type=int, default=16, help="How many, at most 32.")
    parser.add_argument("--first", type=int, default=0, help="Number of the first.")
    parser.add_argument("--rows", default="", help="Transformations whose name, or group, holds this text.")
    parser.add_argument("--records", type=Path, help="Folder of the simulated records.")
    arguments = parser.parse_args()
    pairs = machines(arguments.machines, arguments.first, arguments.records)
    names = [name for name, (group, _) in TRANSFORMATIONS.items() if arguments.rows in f"{group}: {name}"]
    with arguments.into.open("w", encoding="utf-8") as file:
        for line in table(pairs, names):
            print(line, flush=True)
            print(line, file=file, flush=True)


if __name__ == "__main__":
    main()
