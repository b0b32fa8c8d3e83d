"""Recordings that fool: what the verdict says where machine, sensor, logger or label changed, and where nothing leaks.

    python benchmarks/fooling.py VERDICTS.jsonl [--machines N] [--first NUMBER] [--rows TEXT] [--views NAME...]
        [--records FOLDER] [--minutes M] [--table INTO.csv]

Takes N healthy machines of the plan `bench-detectors` from number FIRST on, and as many with a leak of 0.0042 L/min
from half on; makes of every record those of `ROWS`, and diagnoses each through three sets of channels: all, the chamber
pressures with the command, and the pressures alone. A verdict is a line of VERDICTS.jsonl; those that it holds are not
made again, so that an interrupted run goes on where it was (a run after a change of the source needs another file).
--records keeps the simulated records, --minutes ends a run in time, --table writes the counts.

Rows were mended on machines 0 to 15 and are judged on machines 16 to 31; any four in a row differ in command and
throttles. Rows of the group `garbage` leave no machine to judge: only `cannot tell` is right there. Of all others, a
healthy machine must not be called `leak` in more than 3 % of the records.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from verdicts import recording_of

import sealscope as ss
from sealscope.campaigns.cases.case import CampaignCase, list_cases
from sealscope.campaigns.plans.reader import load_plan
from sealscope.recordings.channels import Array

VIEWS: dict[str, tuple[str, ...] | None] = {"all": None, "command": ("u", "p_A", "p_B"), "pressures": ("p_A", "p_B")}
Flags = NDArray[np.bool_]
CHAMBERS = ("p_A", "p_B")
PRESSURES = ("p_1", "p_2", *CHAMBERS)
PLAN, LEAK = "bench-detectors", 0.0042


#: Machines on which rows were mended; those from there on judge.
DEVELOPMENT = range(16)
#: Cells of the plan (command and throttles): machine k and machine k + 16 run the same duty.
_CELLS = 16


@dataclass(frozen=True)
class Machine:
    """A machine of the plan: its `case`, the `spare` one of the same duty, the folder in which records are kept."""

    case: CampaignCase
    spare: CampaignCase
    folder: Path | None = None

    @cached_property
    def record(self) -> ss.Recording:
        """Return its record."""
        return recording_of(self.case, self.folder)

    @cached_property
    def other(self) -> ss.Recording:
        """Return the record of another machine at the same duty."""
        return recording_of(self.spare, self.folder)

    def repeated(self, fault: str = "", leak: bool = True) -> ss.Recording:
        """Return another record of this machine: with a fault from half on, or without its leak."""
        own = replace(self.case, fault=fault, leak_lpm=self.case.leak_lpm if leak else 0.0)
        name = f"{self.case.id}-{fault or 'healthy'}".replace(" ", "-").replace("%", "percent")
        return recording_of(replace(own, id=name, noise_seed=self.case.noise_seed ^ 1), self.folder)


@dataclass(frozen=True)
class Sample:
    """What a transformation may use: the record, a random generator, and where it comes from.

    `other`: the record of another machine at the same duty; `machine`: what else the same machine recorded.
    """

    record: ss.Recording
    random: np.random.Generator
    other: ss.Recording
    machine: Machine | None = None

    def faulty(self, fault: str) -> ss.Recording:
        """Return the record of this machine with a fault from half on."""
        assert self.machine is not None
        return self.machine.repeated(fault)

    def healthy(self) -> ss.Recording:
        """Return another record of this machine, without a leak."""
        assert self.machine is not None
        return self.machine.repeated(leak=False)

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


@dataclass(frozen=True)
class Row:
    """A row of the table: its group (gap, sensor, logger, duty, machine, baseline, garbage), and what is diagnosed."""

    group: str
    change: Transformation
    baseline: Transformation | None = None


ROWS: dict[str, Row] = {}


def row(name: str, group: str, baseline: Transformation | None = None) -> Callable[[Transformation], Transformation]:
    """Enter a transformation under its name."""

    def enter(transformation: Transformation) -> Transformation:
        ROWS[name] = Row(group, transformation, baseline)
        return transformation

    return enter


def _low_pass(values: Array, width: int) -> Array:
    kernel = np.hanning(width + 2)[1:-1]
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), "valid")[: values.size]


def _smooth_sensor(record: ss.Recording) -> ss.Recording:
    own = {name: _low_pass(record[name], 5) for name in CHAMBERS}
    return replace(record, channels={**record.channels, **own})


def _humming(record: ss.Recording) -> ss.Recording:
    line = 0.01 * float(np.std(record["p_A"] - record["p_B"])) * np.sin(2 * np.pi * 50.0 * record.t)
    return replace(record, channels={**record.channels, **{name: record[name] + line for name in CHAMBERS}})


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
    lambda s: s.changed(lambda v: np.where(np.sin(0.7 * s.record.t) > 0, 4e5, 2e5) + s.white(1e2), ("p_A",))
)

for _fault in ("air 1 %", "air 2 %", "friction +20 %", "rod seal A 0.01 L/min", "sensor p_A offset 5 psi"):
    row(f"{_fault} from half on", "machine")(lambda s, fault=_fault: s.faulty(fault))

row("against its own baseline", "baseline", lambda s: s.healthy())(lambda s: s.record)
row("against a copy of itself", "baseline", lambda s: s.record)(lambda s: s.record)
row("against another machine's baseline", "baseline", lambda s: s.other)(lambda s: s.record)
row("against a baseline with a smoother filter", "baseline", lambda s: _smooth_sensor(s.healthy()))(lambda s: s.record)
row("against a baseline with hum", "baseline", lambda s: _humming(s.healthy()))(lambda s: s.record)
row("against a baseline of noise", "baseline", lambda s: s.changed(lambda v: v.mean() + s.white(1e5)))(
    lambda s: s.record
)


def machines(number: int, first: int, leaking: bool, folder: Path | None) -> list[Machine]:
    """Return machines of the plan, healthy or leaking; four in a row differ in command and throttles."""
    cases = [
        case for case in list_cases(load_plan(PLAN)) if case.leak_lpm == (LEAK if leaking else 0.0) and not case.fault
    ]

    def place(k: int) -> int:
        return k // _CELLS * _CELLS + 5 * k % _CELLS

    most = 2 * _CELLS
    return [Machine(cases[place(k)], cases[place(k) + most], folder) for k in range(first, min(first + number, most))]


def made_of(name: str, machine: Machine, number: int, view: str) -> tuple[ss.Recording, list[ss.Recording]]:
    """Return the record that a row makes, and its baseline, through a set of channels."""
    random = np.random.default_rng([number, *name.encode()])
    sample, channels = Sample(machine.record, random, machine.other, machine), VIEWS[view]

    def through_view(made: ss.Recording) -> ss.Recording:
        return made.only([own for own in made.channels if own != "q_leak" and (channels is None or own in channels)])

    change, baseline = ROWS[name].change, ROWS[name].baseline
    return through_view(change(sample)), [] if baseline is None else [through_view(baseline(sample))]


def digest(recordings: Iterable[ss.Recording]) -> str:
    """Return a hash of all that a diagnosis sees."""
    whole = sha256()
    for recording in recordings:
        whole.update(repr((recording.rate, sorted(recording.units.items()))).encode())
        for name in ("", *sorted(recording.channels)):
            whole.update(name.encode() + (recording[name] if name else recording.t).tobytes())
    return whole.hexdigest()[:16]


Key = tuple[str, str, bool, int]


def known_verdicts(file: Path) -> list[dict[str, object]]:
    """Return the lines of a file of verdicts; a line that was cut off is left out."""
    lines = []
    for line in file.read_text(encoding="utf-8").split("\n")[:-1] if file.is_file() else []:
        try:
            lines.append(json.loads(line))
        except ValueError:
            continue
    return lines


def key_of(line: dict[str, object]) -> Key:
    """Return what a line is the verdict on."""
    return str(line["row"]), str(line["view"]), bool(line["leaking"]), int(str(line["machine"]))


def judge(file: Path, machines_of: dict[bool, list[Machine]], first: int, keys: Sequence[Key], minutes: float) -> bool:
    """Add the verdicts that the file lacks; return whether none is missing now."""
    lines = known_verdicts(file)
    have, by_digest = {key_of(line) for line in lines}, {line["digest"]: line for line in lines}
    missing = [key for key in keys if key not in have]
    end = time.monotonic() + 60.0 * minutes
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    with file.open("a", encoding="utf-8") as out:
        if text and not text.endswith("\n"):
            out.write("\n")
        for done, (name, view, leaking, number) in enumerate(missing):
            if time.monotonic() > end:
                print(f"{len(keys) - len(missing) + done} of {len(keys)} verdicts; call again for the rest")
                return False
            if done % 50 == 0:
                print(f"{len(keys) - len(missing) + done} of {len(keys)} verdicts", flush=True)
            record, baseline = made_of(name, machines_of[leaking][number - first], number, view)
            own = digest([record, *baseline])
            if (line := by_digest.get(own)) is None:
                diagnosis = ss.diagnose(record, baseline)
                line = {"verdict": diagnosis.verdict, "cause": diagnosis.cause, "digest": own}
                line |= {"by": diagnosis.detector, "reason": diagnosis.reason}
                by_digest[own] = line
            line = line | {"row": name, "view": view, "leaking": leaking, "machine": number}
            print(json.dumps(line), file=out, flush=True)
    return True


def write_table(file: Path, lines: Iterable[dict[str, object]]) -> None:
    """Write how often each row was called what, through each set of channels, as CSV: judging machines, then others."""
    counts: dict[tuple[str, str, str, bool], Counter[str]] = {}
    for line in lines:
        name, view, leaking, number = key_of(line)
        own = counts.setdefault(
            (name, view, "developed on" if number in DEVELOPMENT else "judged on", leaking), Counter()
        )
        own[str(line["verdict"])] += 1
        own[f"cause: {line['cause']}"] += 1
    verdicts = ("leak", "no leak", "cannot tell")
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        sides = [f"{side}: {verdict}" for side in ("healthy", "leaking") for verdict in verdicts]
        writer.writerow(["machines", "group", "row", "channels", *sides, "causes named, healthy"])
        for part, (name, row_), view in product(("judged on", "developed on"), ROWS.items(), VIEWS):
            leak_free, worn = (counts.get((name, view, part, leaking), Counter[str]()) for leaking in (False, True))
            if leak_free or worn:
                named = [(key.removeprefix("cause: "), count) for key, count in sorted(leak_free.items())]
                causes = [f"{cause} {count}" for cause, count in named if cause not in (*verdicts, "None")]
                cells = [side[verdict] for side in (leak_free, worn) for verdict in verdicts]
                writer.writerow([part, row_.group, name, view, *cells, "; ".join(causes)])


def main() -> None:
    """Judge, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verdicts", type=Path)
    parser.add_argument("--machines", type=int, default=16, help="How many of each kind.")
    parser.add_argument("--first", type=int, default=16, help="Number of the first, 0 to 31.")
    parser.add_argument("--rows", default="", help="Rows whose name, or group, holds this text.")
    parser.add_argument("--views", nargs="+", choices=list(VIEWS), default=list(VIEWS), help="Sets of channels.")
    parser.add_argument("--records", type=Path, help="Folder of the simulated records.")
    parser.add_argument("--minutes", type=float, default=np.inf, help="Stop after this time.")
    parser.add_argument("--table", type=Path, help="Write the counts of all verdicts in the file here.")
    arguments = parser.parse_args()
    names = [name for name, own in ROWS.items() if arguments.rows in f"{own.group}: {name}"]
    both = {
        leaking: machines(arguments.machines, arguments.first, leaking, arguments.records) for leaking in (False, True)
    }
    numbers = range(arguments.first, arguments.first + len(both[False]))
    keys = [
        (name, view, leaking, number)
        for leaking in both
        for view in reversed(arguments.views)
        for number in numbers
        for name in names
    ]
    judge(arguments.verdicts, both, arguments.first, keys, arguments.minutes)
    if arguments.table:
        write_table(arguments.table, [line for line in known_verdicts(arguments.verdicts) if key_of(line) in set(keys)])


if __name__ == "__main__":
    main()
