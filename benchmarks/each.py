"""Run every benchmark at a size of seconds, so that none is broken unseen.

    python benchmarks/each.py [--only NAME ...] [--limit 900] [--cut 30]

A benchmark is a file of this folder that runs as a program; one without a row of `SIZES` is an error. Each runs in a
process of its own, on one thread, in a copy of the repository, so that the figures of `results` stay as they are. Those
that only end after minutes (`LONG`) are cut, with a word, after so many seconds, if nothing has failed until then.
Those that need measured data or a library that are absent are left out, with a word. Prints the processor's seconds of
each, and the end of what it wrote if it fails or takes longer than the limit [s].
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

HERE = Path(__file__).parent
SHARED = HERE.parents[1] / "shared"
REAL = SHARED / "data" / "real"
#: Benchmark -> words of a call that takes seconds. `{into}` is an empty folder; paths of measured data must exist.
SIZES: dict[str, list[str]] = {
    "bench_diagnosis": ["--rounds", "1", "--imports", "1", "--files", "2", "--only", "all channels"],
    "bench_fmu": ["--rounds", "1", "--seconds", "2"],
    "bench_monitor": ["--seconds", "330", "--actuators", "2"],
    "bench_solvers": ["--rounds", "1", "--duration", "20", "--case", "no throttles, 3 sin 4t"],
    "bench_subprocesses": ["--rounds", "1"],
    "bench_variants": ["--rounds", "1", "--duration", "5", "--variant", "thesis"],
    "bench_workbench": ["--files", "4", "--rows", "20000"],
    "causes": ["--count", "1", "--views", "all"],
    "controller_costs": ["--blocks", "100"],
    "fooling": ["{into}/verdicts.jsonl", "--machines", "1", "--minutes", "0.2"],
    "foreign_machines": ["--count", "1", "--machines", "press"],
    "hold_tests": ["--tests", "20", "--jobs", "1"],
    "inference_figures": [],
    "large_files": ["--minutes", "0.5"],
    "leak_sizes": ["--lpm", "0", "--duration", "20"],
    "machine_folders": [str(SHARED / "machines" / "drawn"), "--jobs", "1"],
    "machine_streams": [str(SHARED / "machines" / "drawn"), "--sessions", "1"],
    "monitor_hostility": ["--minutes", "0.2", "--actuators", "2"],
    "monitor_kills": ["--kills", "1", "--each", "1", "--database", "sqlite"],
    "monitor_months": ["--actuators", "1", "--days", "1", "--minutes-a-day", "5"],
    "monitor_week": ["--days", "0.01"],
    "outside_leaks": [],
    "pauses": ["--machines", "1"],
    "plan_verdicts": ["--records", "2"],
    "press_logs": ["--machines", "1"],
    "pressures": ["--machines", "1", "--leaks", "0"],
    "readers": ["--rounds", "1"],
    "real_cranes": [str(REAL / "cranes")],
    "real_eha": [str(REAL / "eha" / "run1.csv"), str(REAL / "eha" / "run2.csv")],
    "run": ["--quick", "--into", "{into}"],
    "sensor_errors": ["--count", "1", "--rigs", "thesis"],
    "single_rods": ["--machines", "1"],
    "smallest_leaks": ["--seeds", "1", "--duration", "20"],
    "soft_sensor": ["--machines", "1"],
    "speed": ["--quick"],
    "strokes": [str(REAL / "vtnsi_actuator"), "--session", "act_4_seal_defect"],
    "verdicts": ["{into}/verdicts.jsonl"],
    "wear": ["run", "{into}", "--machines", "1", "--pressures-of", "0", "--seconds", "10"],
}
#: Benchmarks that judge so many recordings that even their smallest size takes minutes.
LONG = frozenset(
    (
        *("causes", "foreign_machines", "fooling", "inference_figures", "leak_sizes", "monitor_hostility"),
        *("monitor_kills", "monitor_months", "monitor_week", "outside_leaks", "pauses", "plan_verdicts", "press_logs"),
        *("pressures", "readers", "sensor_errors", "single_rods", "smallest_leaks", "soft_sensor", "strokes"),
        *("verdicts", "wear"),
    )
)
#: Benchmark -> the library without which it is left out.
LIBRARIES = {"bench_fmu": "fmpy", "controller_costs": "unicorn", "large_files": "psutil"}


def list_benchmarks() -> list[str]:
    """List the names of the programs in this folder, without this one."""
    files = sorted(HERE.glob("*.py"))
    return [
        file.stem
        for file in files
        if '__name__ == "__main__"' in file.read_text(encoding="utf-8") and file.name != Path(__file__).name
    ]


def run_benchmark(name: str, limit: float, cut: float) -> str:
    """Run a benchmark at its small size; return what went wrong, or "" if nothing did."""
    absent = [word for word in SIZES[name] if word.startswith(str(SHARED)) and not Path(word).exists()]
    absent += [library for library in [LIBRARIES.get(name)] if library and not find_spec(library)]
    if absent:
        print(f"{name}: left out, as {absent[0]} is absent", flush=True)
        return ""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with TemporaryDirectory() as folder:
        copy, into = Path(folder, "repository"), Path(folder, "into")
        into.mkdir()
        shutil.copytree(HERE.parent, copy, ignore=shutil.ignore_patterns(".*", "build", "site", "__pycache__"))
        call = [sys.executable, str(copy / HERE.name / f"{name}.py"), *(word.format(into=into) for word in SIZES[name])]
        environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        with subprocess.Popen(call, cwd=into, env=environment, start_new_session=True, **pipes) as process:
            try:
                output, _ = process.communicate(timeout=cut if name in LONG else limit)
                fault = process.returncode and f"ended with {process.returncode}: {output[-1500:]}"
                note = ""
            except subprocess.TimeoutExpired:
                fault, note = ("", f", cut after {cut:g} s") if name in LONG else (f"took longer than {limit:g} s", "")
            with suppress(ProcessLookupError):  # its own processes, too
                os.killpg(process.pid, signal.SIGKILL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{name}: {after.ru_utime - before.ru_utime:.1f} s{note if not fault else ' ' + fault}", flush=True)
    return str(fault or "")


def main() -> None:
    """Run the benchmarks in turn; end with an error if any failed or has no size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--limit", type=float, default=900.0, help="longest time of a benchmark [s]")
    parser.add_argument("--cut", type=float, default=30.0, help="time of a benchmark that only ends after minutes [s]")
    chosen = parser.parse_args()
    names = list_benchmarks()
    if unlike := sorted(set(names) ^ SIZES.keys()):
        raise SystemExit(f"each benchmark must have one row of SIZES, and each row a benchmark: {', '.join(unlike)}")
    faults = [name for name in chosen.only or names if run_benchmark(name, chosen.limit, chosen.cut)]
    if faults:
        raise SystemExit(f"these ended in an error: {', '.join(faults)}")


if __name__ == "__main__":
    main()
