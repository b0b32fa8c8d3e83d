"""Time `diagnose` on 180 s of all channels at 500 Hz, and the import of what it needs in a fresh interpreter.

    python benchmarks/bench_diagnosis.py [--rounds 3] [--imports 3] [--files 4] [--only TEXT ...] [--json FILE]

Prints the median and the middle half (25 % to 75 %) of each [s], and the least processor time [s], which other work on
the machine changes little: figures of two versions are compared by it. Ends within two minutes on two cores that are
free. `--only`: the cases whose names hold one of these, and neither imports nor files. `first call` is the first
diagnosis of a fresh interpreter, imports apart. Recordings of a baseline are `known`: their own fits were made by an
earlier call. At last, `sealscope diagnose` on several files on one core and on all.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.live.watch import Watch
from sealscope.parameters import load_rig
from sealscope.recordings import Recording, write
from sealscope.simulation.simulate import simulate

#: The thesis's duties.
COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(t)")
_FRESH = """
import time
start = time.perf_counter()
{imported}
imported = time.perf_counter()
{then}
print(imported - start, time.perf_counter() - imported)
"""
_IMPORT = "from sealscope.diagnosis.diagnose import diagnose"
_FIRST_CALL = """
import numpy as np
from sealscope.recordings.recording import Recording
noise = np.random.default_rng(0).standard_normal((2, 90000))
prepared = Recording(np.arange(90000) / 500, dict(zip(("p_A", "p_B"), noise)), {"p_A": "Pa", "p_B": "Pa"}, 500.0)
imported = time.perf_counter()
diagnose(prepared)
"""


def seconds(call: Callable[[], object]) -> float:
    """Wall time of one call [s]."""
    return timed(call)[0]


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Wall time and processor time of one call [s]."""
    start, spent = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - start, time.process_time() - spent


def fresh(imported: str, then: str = "") -> tuple[float, float]:
    """Seconds of the import and of what follows, in an interpreter of its own."""
    code = _FRESH.format(imported=imported, then=then)
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    first, second = (float(word) for word in out.split())
    return first, second


def quartiles(values: list[float]) -> list[float]:
    return [float(q) for q in np.percentile(values, [50, 25, 75])]


def of_many(count: int, duration: float, cores: int) -> float:
    """Wall time [s] of `sealscope diagnose` on `count` files, on the first `cores` cores of this process."""
    with TemporaryDirectory() as folder:
        files = [str(Path(folder) / f"{seed}.nc") for seed in range(count)]
        for seed, file in enumerate(files):
            write(simulate(command=COMMANDS[seed % len(COMMANDS)], duration=duration, seed=seed), file)
        allowed = sorted(os.sched_getaffinity(0))[:cores]
        call = [sys.executable, "-m", "sealscope", "diagnose", "--format", "jsonl", *files]
        return seconds(
            lambda: subprocess.run(
                call,
                check=True,
                capture_output=True,
                env={**os.environ, "PYTHONDONTWRITEBYTECODE": ""},  # as an installed package, which has its bytecode
                preexec_fn=lambda: os.sched_setaffinity(0, allowed),
            )
        )


def streamed(recording: Recording) -> None:
    """The watch of a recording, in blocks of its own length."""
    watch = Watch(load_rig("thesis-closed-loop"), 1000.0, 1000.0)
    for start in range(0, int(recording.duration), 3):
        watch.update(recording.between(start, start + 3))


def diagnose_anew(recording: Recording, *baseline: Sequence[Recording], **options: float) -> None:
    """Diagnose a copy of a recording, of which nothing is known yet; what is known of the baseline stays so."""
    diagnose(replace(recording), *baseline, **options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--imports", type=int, default=3)
    parser.add_argument("--files", type=int, default=4, help="files that `sealscope diagnose` is given at once")
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="cases whose names hold one of these")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    if min(chosen.rounds, chosen.imports) < 1:
        parser.error("--rounds and --imports must be 1 or more")
    values = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
    healthy = [simulate(seed=seed, set=values) for seed in range(6)]
    leaky = simulate(seed=9, leak="0.0042 L/min from 90 s", set=values)
    cases: dict[str, Callable[[], object]] = {
        "within the recording, no leak": lambda: diagnose_anew(healthy[0]),
        "within the recording, leak": lambda: diagnose_anew(leaky),
        "within the recording, at 0.1 %": lambda: diagnose_anew(healthy[0], false_alarm_probability=1e-3),
        "against 1 recording, known": lambda: diagnose_anew(leaky, healthy[:1]),
        "against 6 recordings, known": lambda: diagnose_anew(leaky, healthy),
    }
    pressures = [recording.only(["u", "p_A", "p_B"]) for recording in (healthy[0], leaky)]
    cases |= {
        "the judge alone, no leak": lambda: diagnose_anew(healthy[0]),
        "the judge alone, leak": lambda: diagnose_anew(leaky),
        "pressures and command, no leak": lambda: diagnose_anew(pressures[0]),
        "pressures and command, leak": lambda: diagnose_anew(pressures[1]),
        "the judge alone, from pressures": lambda: diagnose_anew(pressures[0]),
    }
    for command in COMMANDS:
        record = simulate(command=command, seed=1, leak="0.0042 L/min from 90 s")
        cases[f"leak under {command}, no throttles"] = partial(diagnose_anew, record)
    loop = {"rig": "thesis-closed-loop", "duration": 120.0, "seed": 4}
    pushed = simulate(command="position 40 mm sin(1.57t)", controller="pi", load="1 kN sin(0.3t)", **loop)
    cases["the balance online, 120 s under a load"] = lambda: streamed(pushed)
    figures: dict[str, list[float]] = {}
    for name, call in cases.items():
        if chosen.only and not any(text in name for text in chosen.only):
            continue
        call()
        times = [timed(call) for _ in range(chosen.rounds)]
        figures[name] = [*quartiles([wall for wall, _ in times]), min(spent for _, spent in times)]
    if not chosen.only:
        fresh(_IMPORT, _FIRST_CALL)
        figures["import sealscope"] = quartiles([fresh("import sealscope")[0] for _ in range(chosen.imports)])
        both = [fresh(_IMPORT, _FIRST_CALL) for _ in range(chosen.imports)]
        figures["import of diagnose"] = quartiles([one[0] for one in both])
        figures["first call in a fresh interpreter"] = quartiles([one[1] for one in both])
    print("180 s at 500 Hz, all channels unless said; median (25 % .. 75 %), processor time [s]")
    for name, (middle, low, high, *spent) in figures.items():
        print(f"{name:<40}{middle:8.3f} ({low:.3f} .. {high:.3f}){''.join(f'{least:9.3f}' for least in spent)}")
    if not chosen.only:
        alone, beside = (of_many(chosen.files, 180.0, cores) for cores in (1, len(os.sched_getaffinity(0))))
        times_as_fast = alone / beside
        print(
            f"{chosen.files} files: {alone:.1f} s on one core, {beside:.1f} s on all: {times_as_fast:.2f} times as fast"
        )
    if chosen.json:
        unfinished = chosen.json.with_name(chosen.json.name + ".partial")
        unfinished.write_text(json.dumps(figures, indent=2) + "\n")
        unfinished.replace(chosen.json)


if __name__ == "__main__":
    main()
