"""What Sealscope costs: each row by this version, beside a pinned one or a peer in turns, and how time and memory grow.

    python benchmarks/speed.py [--beside PYTHON] [--limit 300] [--quick] [--rounds 3] [--only TEXT ...] [--json FILE]
                               [--eha FILE ...]

`--beside`: the Python of an environment with another version; both versions run on the same files, one after the other
in each round, and the ratio of the medians of their processor times is printed. `--limit`: a run of the other version
ends after so many seconds of the processor; the row then states that it takes more. `--eha`: the logs of a real
actuator that `real_eha.py` takes, of which the first is judged beside the others but the last. `--quick`: sizes of
seconds, to see that all works. `--only`: the rows whose titles hold one of the texts, or `growth`, `service`, `cores`,
`libraries`, `solver`. `--json`: the figures for the page of speed, which the documentation writes from
`benchmarks/results/speed.json`; rows that are not chosen stay. All other recordings are simulated or computed by this
version. The asked figures are those of the project's requirements, at full size, on two virtual cores.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from datetime import date
from functools import cache, partial
from math import inf, isfinite
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, NamedTuple

import bench_solvers
import numpy as np
import real_eha
from bench_diagnosis import of_many

import sealscope as ss

#: Program of a row in a process of its own: it reads its files, works once before the clock starts, and prints seconds.
#: Results of recordings are kept on disk by their content: unless they were learnt before ("again", "next"), each run
#: has recordings of another content. Of "next" the last one was judged before, beside the same healthy ones.
_ROW = """
import json, os, sys, tempfile, time
from dataclasses import replace
import sealscope as ss
kind, names, channels, map, sizes = json.loads(sys.argv[1])
rig = ss.load_rig("single-rod-eha").with_overrides(sizes) if sizes else None
def read(is_new=True):
    recordings = [ss.read(name, map=map) for name in names]
    if is_new:
        run = str(time.time_ns())
        recordings = [replace(recording, provenance={**recording.provenance, "run": run}) for recording in recordings]
    return [recording.only(channels) for recording in recordings] if channels else recordings
def diagnose(recordings):
    return ss.diagnose(recordings[0], baseline=recordings[1:], rig=rig)
if kind == "commission":
    def copy():
        folder = tempfile.mkdtemp(dir=os.path.dirname(names[0]))
        files = [f"{folder}/{os.path.basename(name)}" for name in names]
        for recording, file in zip(read(), files):
            ss.write(recording, file)
        return files
    ss.commission(copy()[:1])
    names = copy()
    start = time.process_time()
    ss.commission(names)
elif kind == "again":
    diagnose(read(is_new=False))
    recordings = read(is_new=False)
    start = time.process_time()
    diagnose(recordings)
else:
    diagnose(read())
    recordings = read()
    if kind == "next":
        *recordings, other = recordings
        diagnose([other, *recordings[1:]])
    start = time.process_time()
    diagnose(recordings)
print(json.dumps(time.process_time() - start))
"""
#: Program that runs a command of `sealscope`, or after the word `-` another program, and then prints the largest shares
#: of the time by the part of the package that runs or calls, from a look every 5 ms; the processor's seconds of the
#: process; and its peak memory [kB], which Linux knows.
_COMMAND = """
import collections, json, runpy, sys, threading, time
counts, main = collections.Counter(), threading.main_thread().ident
def find_area(frame):
    area = None
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith("<frozen importlib"):
            return "imports"
        if area is None and "/sealscope/" in file:
            area = "/".join(file.rpartition("/sealscope/")[2].removesuffix(".py").split("/")[:2])
        frame = frame.f_back
    return area or "other"
def watch():
    while True:
        time.sleep(0.005)
        counts[find_area(sys._current_frames().get(main))] += 1
threading.Thread(target=watch, daemon=True).start()
first, sys.argv = sys.argv[1], ["sealscope", *sys.argv[1:]]
try:
    if first == "-":
        code, sys.argv = sys.argv[2], ["row", *sys.argv[3:]]
        exec(compile(code, "row", "exec"), {"__name__": "__main__"})
    else:
        runpy.run_module("sealscope", run_name="__main__")
except SystemExit as end:
    if end.code:
        raise
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
shares = {area: number / counts.total() for area, number in counts.most_common(4)}
print(f"\\n{json.dumps(shares)}\\n{time.process_time()} {peak.split()[1]}", file=sys.stderr)
"""


class Run(NamedTuple):
    """What a run of a row costs; all numbers are infinite if it did not end within the limit."""

    seconds: float  # of the processor
    memory: float  # peak [MiB]
    shares: dict[str, float]  # part of the package -> share of the time of the whole process, the largest ones


#: Measurement: a run by a Python, of at most so many seconds of the processor.
Row = Callable[[str, int | None], Run]


def spent(python: str, *words: str, limit: int | None = None, **variables: str) -> tuple[Run, str]:
    """Run `_COMMAND` with words by a Python, with further environment `variables`; return what it costs, its output.

    `limit`: most seconds of the processor; the output of a process that takes more is empty.
    """

    def limit_time() -> None:
        """Limit the processor's time of the process."""
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))

    # an installed package has its bytecode: modules are not compiled in each process
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "", **variables}
    call = [python, "-c", _COMMAND, *words]
    process = subprocess.run(call, capture_output=True, text=True, check=False, env=environment, preexec_fn=limit_time)
    if limit is not None and process.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return Run(inf, inf, {}), ""
    if process.returncode:
        raise SystemExit(f"{' '.join(words[:2])[:80]} ended with {process.returncode}: {process.stderr[-500:]}")
    *_, shares, last = process.stderr.splitlines()
    seconds, peak = last.split()
    return Run(float(seconds), float(peak) / 1024.0, json.loads(shares)), process.stdout


def of_library(
    kind: str,
    files: Sequence[Path],
    channels: Sequence[str] = (),
    column_map: dict[str, str] | None = None,
    sizes: dict[str, str] | None = None,
) -> Row:
    """Make a row that calls the library; its time is that of the call alone.

    `channels`: those that are kept, by default all; `column_map`, `sizes`: map of the columns, and sizes of an
    electro-hydrostatic actuator with a single rod, if they are stated.
    """
    job = json.dumps([kind, [str(file) for file in files], list(channels), column_map, sizes])

    def run(python: str, limit: int | None = None) -> Run:
        """Run the call in a process; its time is that of the call, its memory that of the process."""
        cost, output = spent(python, "-", _ROW, job, limit=limit)
        return cost._replace(seconds=float(output)) if output else cost

    return run


def of_command(*words: str) -> Row:
    """Make a row that runs a command of the program; its time is that of the whole process."""
    return lambda python, limit: spent(python, *words, limit=limit)[0]


def of_first_command(folder: Path, *words: str) -> Row:
    """Make a row that runs a command of the program as its first one: with an empty folder for compiled code."""

    def run(python: str, limit: int | None) -> Run:
        """Run the command with a new folder."""
        return spent(python, *words, limit=limit, SEALSCOPE_CACHE_DIR=mkdtemp(dir=folder))[0]

    return run


def measure_libraries(file: Path, pythons: Sequence[str], rounds: int) -> dict[str, str]:
    """Measure `sealscope diagnose` of a file as a process, over a process that imports its libraries alone."""
    libraries = "import numpy, scipy.linalg, scipy.special, scipy.ndimage, numba, typer, rich, pydantic, h5netcdf, pywt"
    ratios = []
    for python in pythons:
        of_command("diagnose", str(file))(python, None)
        pairs = [(spent(python, "diagnose", str(file))[0], spent(python, "-", libraries)[0]) for _ in range(rounds)]
        whole, bare = np.median([[run.seconds for run in pair] for pair in pairs], axis=0)
        ratios.append(f"{whole / bare:.2f} times the processor time of importing its libraries alone ({whole:.2f} s)")
    beside = f"; the other version {ratios[1]}" if len(ratios) > 1 else ""
    return {"`diagnose` of 60 s as a process": f"{ratios[0]}{beside}; asked 1.8"}


def measure_solver(rounds: int) -> dict[str, str]:
    """Measure 20 s of the rig without orifices, the step chosen by error, beside C++ RK4 at 1e-4 s in turns."""
    title, case = "20 s of the rig without orifices, step by error", bench_solvers.CASES[0]
    with TemporaryDirectory() as folder:
        peers = bench_solvers.build(Path(folder))
        if "C++ RK4" not in peers:
            return {title: "not measured: no C++ compiler"}
        solve = bench_solvers.ours(case, "auto", None, 20.0)
        solve_by_peer = bench_solvers.theirs(peers["C++ RK4"], case, 1e-4, 20.0)
        converged = bench_solvers.ours(case, "rk4", 1e-5, 20.0)()[1]
        error, peer_error = (bench_solvers.rms(run()[1][:, 1] - converged[:, 1]) for run in (solve, solve_by_peer))
        times = np.array([(solve()[0], solve_by_peer()[0]) for _ in range(rounds)])
    ratio, low, high = bench_solvers.quartiles(times[:, 0] / times[:, 1])
    text = f"{ratio:.2f} ({low:.2f} to {high:.2f}) of the time of C++ RK4 at 1e-4 s, asked 0.35"
    return {title: f"{text}; rms error of p_A {error:.2g} Pa beside {peer_error:.2g} Pa"}


def record(folder: Path, count: int, seconds: float) -> list[Path]:
    """Write healthy recordings, the first one with a leak from half on."""
    files = []
    for seed in range(count):
        leak = {"leak": f"0.02 L/min from {0.5 * seconds:g} s"} if not seed else {}
        recording = ss.simulate(command="3 sin(4t)", duration=f"{seconds:g} s", seed=seed, **leak)
        files.append(folder / f"rig-{seconds:g}-{seed}.nc")
        ss.write(recording, files[-1])
    return files


def press(folder: Path, count: int, minutes: float, rate: float) -> list[Path]:
    """Write logs of a press that holds its load between strokes: samples of the balance with noise, no simulation."""
    files = []
    for seed in range(count):
        random, n = np.random.default_rng(seed), round(60.0 * minutes * rate)
        t = np.arange(n) / rate
        phase = t % 20.0
        omega = np.where(phase < 8.0, 150.0, np.where((phase >= 10.0) & (phase < 18.0), -150.0, 0.0))
        load = 4e6 + 5e5 * np.sin(t / 100.0)
        x = np.cumsum((1.6e-5 / (2.0 * np.pi) * omega - 2e-13 * load) / 9e-3) / rate
        p_B = 5e5 + 2e4 * random.standard_normal(n)
        p_A = p_B + load + 3e5 * np.sign(omega) + 2e4 * random.standard_normal(n)
        channels = {"p_A": p_A, "p_B": p_B, "x": x + 2e-5 * random.standard_normal(n)}
        channels |= {"omega": omega + 0.5 * random.standard_normal(n), "T_oil": 313.0 + 0.1 * random.standard_normal(n)}
        units = {"p_A": "Pa", "p_B": "Pa", "x": "m", "omega": "rad/s", "T_oil": "K"}
        files.append(folder / f"press-{minutes:g}-{rate:g}-{seed}.nc")
        ss.write(ss.Recording(t, channels, units, rate), files[-1])
    return files


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beside", metavar="PYTHON", help="Python of an environment with another version")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="rows whose names hold one of these")
    parser.add_argument("--json", type=Path, help="file of the figures")
    parser.add_argument("--limit", type=int, default=300, help="processor's seconds of a run of the other version")
    parser.add_argument("--eha", nargs="+", type=Path, default=[], metavar="FILE", help="logs of a real actuator")
    chosen = parser.parse_args()
    share = 0.1 if chosen.quick else 1.0
    rounds = 1 if chosen.quick else chosen.rounds
    pythons = [sys.executable, *([chosen.beside] if chosen.beside else [])]
    figures: dict[str, dict[str, Any]] = {}
    others: dict[str, str] = {}
    with TemporaryDirectory() as name:
        folder = Path(name)
        length, n_beside = (60.0, 2) if chosen.quick else (180.0, 5)
        minutes, three = cache(partial(record, folder, 2 + n_beside, 60.0)), cache(partial(record, folder, 1, length))
        hour, days = (
            cache(partial(press, folder, 1, 60.0 * share, 1000.0)),
            cache(partial(press, folder, 3, 90.0 * share, 10.0)),
        )

        @cache
        def table() -> str:
            """Write the hour as a text."""
            ss.write(ss.read(hour()[0]), folder / "hour.csv")
            return str(folder / "hour.csv")

        page = ("demo", "-o", str(folder / "demo.html"))
        # title -> seconds and MiB that are asked for, and how the row is made; its files are written when it is run
        rows: dict[str, tuple[float | None, float | None, Callable[[], Row]]] = {
            f"{length:g} s at 500 Hz, all channels": (0.35, None, lambda: of_library("first", three())),
            f"{length:g} s at 500 Hz, pressures and command": (
                *(0.65, None),
                lambda: of_library("first", three(), channels=("u", "p_A", "p_B")),
            ),
            f"60 s beside {n_beside}, first": (0.4, None, lambda: of_library("first", minutes()[: 1 + n_beside])),
            f"60 s beside {n_beside}, next": (0.15, None, lambda: of_library("next", minutes())),
            f"60 s beside {n_beside}, learnt by another process": (
                *(0.15, None),
                lambda: of_library("again", minutes()[: 1 + n_beside]),
            ),
            **actuator(chosen.eha),
            f"commissioning, {3 * 1.5 * share:g} h at 10 Hz": (9.0, None, lambda: of_library("commission", days())),
            f"commissioning, {share:g} h at 1 kHz": (10.0, None, lambda: of_library("commission", hour())),
            f"`diagnose` of {share:g} h at 1 kHz, a text of 6 columns": (
                *(15.0, 600.0),
                lambda: of_command("diagnose", table()),
            ),
            f"`inspect` of {share:g} h at 1 kHz, a text of 6 columns": (
                *(4.0, 300.0),
                lambda: of_command("inspect", table()),
            ),
            "`demo`, again": (4.0, None, lambda: of_command(*page)),
            "`demo`, first time": (10.0, None, lambda: of_first_command(folder, *page)),
        }
        print(
            "| work | seconds of processor | asked | over the other version | peak MiB | most of the process's time |\n"
            "| --- | --- | --- | --- | --- | --- |",
            flush=True,
        )
        for title, (asked, asked_memory, make_row) in rows.items():
            if chosen.only and not any(text in title for text in chosen.only):
                continue
            row = make_row()
            limits = (None, chosen.limit)  # of this version, and of the other one
            runs = [[row(*pair) for pair in zip(pythons, limits, strict=False)] for _ in range(rounds)]  # in turns
            medians = np.median(np.array([[run[:2] for run in pair] for pair in runs]), axis=0)
            figures[title] = {"seconds": medians[0][0], "MiB": medians[0][1], "shares": runs[0][0].shares}
            if not chosen.quick:  # what is asked is asked of the full size
                figures[title] |= {"asked": asked} | ({"asked MiB": asked_memory} if asked_memory else {})
            ratio = ""
            if chosen.beside and isfinite(medians[1][0]):
                figures[title]["ratio"] = medians[0][0] / medians[1][0]
                ratio = f"{figures[title]['ratio']:.2f}"
            elif chosen.beside:
                figures[title]["limit"] = chosen.limit
                ratio = f"the other version > {chosen.limit} s"
            goal = figures[title].get("asked", "")
            shares = ", ".join(f"{area} {100.0 * share:.0f} %" for area, share in runs[0][0].shares.items())
            print(f"| {title} | {medians[0][0]:.3g} | {goal} | {ratio} | {medians[0][1]:.0f} | {shares} |", flush=True)
        exponents = growth(folder, share) if not chosen.only or "growth" in chosen.only else {}
        if not chosen.only or "libraries" in chosen.only:
            others |= measure_libraries(minutes()[0], pythons, rounds)
        if not chosen.only or "solver" in chosen.only:
            others |= measure_solver(3 if chosen.quick else 25)
        if not chosen.only or "service" in chosen.only:
            others |= measure_service(*((330.0, 2) if chosen.quick else (600.0, 20)))
        if not chosen.only or "cores" in chosen.only:
            one, two = np.median([[of_many(4, length, cores) for cores in (1, 2)] for _ in range(rounds)], axis=0)
            others["four files on two cores"] = f"{one / two:.2f} times as fast as on one ({one:.1f} s), asked 1.8"
        for title, text in others.items():
            print(f"{title}: {text}", flush=True)
    if chosen.json:
        machine = f"{os.cpu_count()} cores, {platform.machine()}"
        measured = {
            "measured": f"{date.today()}",
            "machine": machine,
            "rows": figures,
            "growth": exponents,
            "others": others,
        }
        if chosen.only and chosen.json.exists():  # the rows that were not chosen stay
            earlier = json.loads(chosen.json.read_text(encoding="utf-8"))
            measured |= {"rows": earlier["rows"] | figures, "growth": earlier["growth"] | exponents}
            measured["others"] = earlier.get("others", {}) | others
        chosen.json.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")


def actuator(files: Sequence[Path]) -> dict[str, tuple[float | None, float | None, Callable[[], Row]]]:
    """Make the rows of a real actuator from its logs; none without them."""
    names = ("cylinder.A_A", "cylinder.A_B", "pump.q_b")
    sizes = dict(zip(names, (*real_eha.AREAS, real_eha.DISPLACEMENT), strict=True))
    of_logs = partial(of_library, column_map=real_eha.MAP, sizes=sizes)
    kinds = {"first": (2.0, files[:-1]), "next": (0.3, files)}
    title = f"real EHA, 25 s at 1 kHz beside {len(files) - 2}"
    rows = {f"{title}, {kind}": (asked, None, partial(of_logs, kind, logs)) for kind, (asked, logs) in kinds.items()}
    return rows if files else {}


def measure_service(seconds: float, actuators: int) -> dict[str, str]:
    """Run `bench_monitor.py` on so many seconds of so many actuators, and return its lines about the service."""
    call = [sys.executable, str(Path(__file__).with_name("bench_monitor.py")), "--seconds", f"{seconds:g}"]
    call += ["--actuators", f"{actuators}"]
    output = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    lines = (line.partition(": ") for line in output.splitlines() if line.startswith("service"))
    return {title: text for title, _, text in lines}


def growth(folder: Path, share: float) -> dict[str, float]:
    """Measure the exponents by which the time of a verdict, and of a commissioning, and the peak memory grow.

    They grow with the samples of a recording, with its channels, and with the number of healthy recordings. Three
    channels are the least with a volume balance, four recordings the least that are checked against each other.
    """
    names = ["p_A", "p_B", "x", "omega", "T_oil"]
    minutes, counts, widths = (15.0 * share, 30.0 * share, 60.0 * share), (2, 4, 8), (3, 4, 5)
    files, long = press(folder, 9, 10.0 * share, 50.0), press(folder, 1, 20.0 * share, 200.0)
    rows = {
        "samples": (minutes, [of_library("first", press(folder, 1, length, 200.0)) for length in minutes]),
        "healthy recordings": (counts, [of_library("first", files[: 1 + count]) for count in counts]),
        "channels": (widths, [of_library("first", long, channels=names[:count]) for count in widths]),
        "samples of a commissioning": (
            minutes,
            [of_library("commission", press(folder, 3, length, 10.0)) for length in minutes],
        ),
        "recordings of a commissioning": (
            (4, 8, 16),
            [of_library("commission", press(folder, count, 15.0 * share, 10.0)) for count in (4, 8, 16)],
        ),
    }
    exponents = {}
    for title, (sizes, calls) in rows.items():
        runs = [call(sys.executable, None) for call in calls]
        costs = {title: [run.seconds for run in runs], f"{title} (memory)": [run.memory for run in runs]}
        for name, values in costs.items():
            exponents[name] = float(np.polyfit(np.log(sizes), np.log(np.maximum(values, 1e-9)), 1)[0])
        time, memory = exponents[title], exponents[f"{title} (memory)"]
        print(f"with the {title} the time grows as their power {time:.2f}, the memory as {memory:.2f}", flush=True)
    return exponents


if __name__ == "__main__":
    main()
