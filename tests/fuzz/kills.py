"""Kill the program at random instants, and compare what the same call then ends with to an undisturbed run.

``python -m tests.fuzz.kills --kills 100 [--seed 13] [CALL...]`` prints a line for each call.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import sealscope

PLAN = """
[campaign]
name = "tiny"
duration = "6 s"
onset = "3 s"
false_alarm = 0.2
seed = 3
detectors = ["d3 of p_A changed", "sign rule: d3 of p_A fell"]

[[records]]
use = "calibrate"
count = 12

[[records]]
count = 6

[[records]]
leak = "0.015 L/min"
count = 6
"""
#: Call -> its words; each is made in a folder that holds `plan.toml` and `run.nc`, and writes below `out`.
CALLS = {
    "campaign": ("campaign", "run", "plan.toml", "-o", "out", "-j", "2"),
    "reproduce": ("reproduce", "fig-3.2", "fig-4.3", "fig-4.5", "fig-4.7", "--quick", "-o", "out", "-j", "2"),
    "report": ("report", "run.nc", "-o", "out/page.html"),
}
#: Files that say how a result came about, and are no part of it.
_OF_THE_WAY = ("rows.jsonl", ".lock", "lock")


@dataclass
class Kills:
    """How many times the program was killed, how often it ended, and which of its results differed."""

    kills: int = 0
    ends: int = 0
    files: int = 0
    differences: list[str] = field(default_factory=list)


def results(folder: Path) -> dict[str, bytes]:
    """Return name -> bytes of the files of a result, without what calls keep for the next."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in _OF_THE_WAY and "kept" not in path.parts
    }


def _start(call: str, folder: Path) -> subprocess.Popen[bytes]:
    known = str(Path(sealscope.__file__).resolve().parents[1])
    (folder / "out").mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-m", "sealscope", *CALLS[call]],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": known},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def prepare(folder: Path) -> None:
    """Write what the calls read into a folder."""
    folder.mkdir()
    (folder / "plan.toml").write_text(PLAN)
    sealscope.write(sealscope.simulate(duration=20.0, seed=4), folder / "run.nc")


def attack(call: str, folder: Path, kills: int, seed: int) -> Kills:
    """Kill a call so many times, at instants up to the length of an undisturbed run; where it ends, begin anew."""
    draw, count = random.Random(f"{call} {seed}"), Kills()
    prepare(folder / "whole")
    length = 0.0
    for _ in range(2):  # the first call may have to compile
        begin = time.monotonic()
        process = _start(call, folder / "whole")
        message = process.communicate()[1]
        assert process.returncode == 0, message.decode()
        length = time.monotonic() - begin
        expected = results(folder / "whole" / "out")
    count.files = len(expected)
    round_ = 0
    while count.kills < kills:
        place = folder / f"round {round_}"
        round_ += 1
        prepare(place)
        ended = False
        while not ended:
            process = _start(call, place)
            try:
                # the last call of all is left to end
                wait = None if count.kills >= kills else length * draw.uniform(0.2, 1.1)
                message = process.communicate(timeout=wait)[1]
                ended = True
                count.ends += 1
                if process.returncode != 0:
                    count.differences.append(f"status {process.returncode}: {message.decode()[-300:]}")
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.communicate()
                count.kills += 1
                damaged = [name for name, data in results(place / "out").items() if data != expected.get(name)]
                if call == "report" and any(not name.endswith(".part") for name in damaged):
                    count.differences.append(f"half-written after a kill: {damaged}")
        result = results(place / "out")
        if result != expected:
            names = sorted(name for name in result.keys() | expected if result.get(name) != expected.get(name))
            count.differences.append(f"{place.name}: {', '.join(names)}")
    return count


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("calls", nargs="*", choices=[*CALLS, []], help="by default all")
    words.add_argument("--kills", type=int, default=100, help="of all calls together")
    words.add_argument("--seed", type=int, default=13)
    given = words.parse_args()
    calls = given.calls or list(CALLS)
    failed = False
    for number, call in enumerate(calls):
        share = given.kills // len(calls) + (number < given.kills % len(calls))
        with tempfile.TemporaryDirectory() as name:
            count = attack(call, Path(name), share, given.seed)
        failed |= bool(count.differences)
        print(
            f"{call:<10} {count.kills} kills, {count.ends} runs to the end, {count.files} files each, "
            f"{len(count.differences)} differences",
            flush=True,
        )
        for line in count.differences:
            print(f"    {line}")
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
