"""Machines in folders, each commissioned on its healthy recordings, and all its recordings judged by that file.

    python benchmarks/machine_folders.py FOLDER... [--jobs 2] [--into FOLDER]

Each FOLDER holds folders of machines, such as a generator of machines writes them:

    press01/healthy/*, press01/suspect/*    logs; the machine is commissioned on all in healthy/
    press01/truth.json                      {"options": [words of `commission` that state what the owner knows],
                                             "files": {"suspect/NAME": {"fault", "leak_lpm", "share", "onset_s"}}}

A `fault` is "none", "leak" (across the piston, of `leak_lpm`, `share` of the pump's flow, from `onset_s` or, if that is
null, from the start), or another event, which is right if the summary or the cause names it (`NAMED`). Commands are
called as a user calls them. Verdicts are kept in `--into`; a second call judges only machines that are missing there.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rich.progress import track

#: Word by which a summary or a cause names a fault.
NAMED = {
    **{"pump_wear": "pump", "rod_seal_A": "external", "rod_seal_B": "external", "air": "air", "friction": "friction"},
    **{"zero_drift": "sensor", "encoder_scale": "sensor", "logger_filter": "sensor"},
}
#: Least shares of the pump's flow of the rows of leaks.
SHARES = {"of more than 3 %": 0.03, "of 1 to 3 %": 0.01, "below 1 %": 0.0}
#: Rows of the table, in its order.
ROWS = (
    *("recordings without a verdict", "healthy: called `leak`", "healthy: `cannot tell`"),
    *("healthy: a fault is named that is none", *(f"leaks {name}: found" for name in SHARES)),
    *("sizes stated: intervals that hold", "onsets stated: intervals that hold", "leaks from the start: dated so"),
    *("bounds of `no leak`: broken", "other faults: named", "other faults: called `leak`"),
)


def call(*words: object) -> str:
    """Call the command line, and return what it prints; errors go on to the terminal."""
    command = [sys.executable, "-m", "sealscope", *map(str, words)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False).stdout


def judge(machine: Path, into: Path) -> None:
    """Commission a machine, judge its recordings, and write the verdicts into a file, a line each."""
    if into.exists():
        return
    options = json.loads((machine / "truth.json").read_text())["options"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "machine.toml")
        call("commission", machine / "healthy", "-o", file, *options)
        names = ("healthy", "suspect")
        parts = [call("diagnose", machine / name, "--machine", file, "--format", "jsonl") for name in names]
    if all(parts):  # else the errors are printed, and a later call tries again
        part = into.with_suffix(".part")
        part.write_text("".join(parts))
        part.replace(into)


def outcomes(machine: Path, verdicts: Path) -> Iterator[tuple[str, bool]]:
    """Yield rows of the table with True or False for each recording that counts in them."""
    lines = verdicts.read_text().splitlines() if verdicts.exists() else []
    stated = {"/".join(Path(v["file"]).parts[-2:]): v for v in map(json.loads, lines)}
    for name, truth in json.loads((machine / "truth.json").read_text())["files"].items():
        verdict: dict[str, Any] | None = stated.get(name)
        if verdict is None:
            yield "recordings without a verdict", True
            continue
        yield "recordings without a verdict", False
        is_leak, fault = verdict["verdict"] == "leak", truth["fault"]
        size = truth.get("leak_lpm", 0.0)
        if not is_leak and verdict["bound_lpm"] is not None:
            yield "bounds of `no leak`: broken", verdict["bound_lpm"] < size
        if fault == "none":
            summary = verdict.get("summary") or verdict["verdict"]
            yield "healthy: called `leak`", is_leak
            yield "healthy: `cannot tell`", verdict["verdict"] == "cannot tell"
            yield "healthy: a fault is named that is none", not is_leak and summary not in ("no leak", "cannot tell")
        elif fault == "leak":
            yield row_of_leak(truth["share"]), is_leak
            if not is_leak:
                continue
            if (interval := verdict["leak_interval_lpm"]) is not None:
                yield "sizes stated: intervals that hold", holds(interval, size)
            if truth["onset_s"] is None:
                yield "leaks from the start: dated so", verdict["onset_s"] is None
            elif (interval := verdict["onset_interval_s"]) is not None:
                yield "onsets stated: intervals that hold", holds(interval, truth["onset_s"])
        else:
            said = f"{verdict.get('summary') or ''} {verdict.get('cause') or ''}".lower()
            yield "other faults: named", NAMED.get(fault, fault) in said
            yield "other faults: called `leak`", is_leak


def row_of_leak(share: float) -> str:
    """Return the row of the table for a leak of a share of the pump's flow."""
    return f"leaks {next(name for name, least in SHARES.items() if share >= least)}: found"


def holds(interval: Sequence[float | None], value: float) -> bool:
    """Return whether a value lies within an interval, of which a limit may be unknown."""
    low, high = interval
    return low is not None and high is not None and low <= value <= high


def main() -> None:
    """Judge the machines, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--jobs", type=int, default=2, help="machines that are judged at the same time")
    parser.add_argument("--into", type=Path, help="folder of the verdicts, by default one that is thrown away")
    chosen = parser.parse_args()
    machines = sorted(path.parent for folder in chosen.folder for path in folder.glob("*/truth.json"))
    if not machines:
        parser.error(
            f"{', '.join(map(str, chosen.folder))} must hold folders of machines with a truth.json, found none"
        )
    with tempfile.TemporaryDirectory() as thrown_away, ThreadPoolExecutor(chosen.jobs) as pool:
        into = chosen.into or Path(thrown_away)
        into.mkdir(parents=True, exist_ok=True)
        files = [into / f"{machine.parent.name}-{machine.name}.jsonl" for machine in machines]
        list(track(pool.map(judge, machines, files), "machines", total=len(machines)))
        rows = [outcome for machine, file in zip(machines, files, strict=True) for outcome in outcomes(machine, file)]
    counts, all_counts = Counter(name for name, is_so in rows if is_so), Counter(name for name, _ in rows)
    print("| of | |\n| --- | --- |")
    for name in ROWS:
        print(f"| {name} | {counts[name]} of {all_counts[name]} |")


if __name__ == "__main__":
    main()
