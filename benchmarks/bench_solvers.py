"""Work and precision of the solvers against a C++ Runge-Kutta program and SUNDIALS CVODE, in turn and in one run.

    python benchmarks/bench_solvers.py [--rounds 5] [--duration 180] [--case NAME ...] [--json FILE] [--plot FILE]

Builds the programs of `benchmarks/peers` (g++, gcc; CVODE needs the SUNDIALS headers, Debian's libsundials-dev, and is
left out with a word where they are absent), checks that all of them give the same trajectory of the same rig, and
prints for each solver and step or tolerance the rms error in p_A against a converged run and the time of the
integration, all our own Python included: median and middle half (25 % to 75 %) over the rounds, and as a ratio to our
default (the step chosen by error, 100 Pa) in the same round; then the ratios that the project promises. Times are
processor seconds of one thread, so that other work on the machine disturbs them less. Compilation is not timed. A step
that `integrate` refuses unless told otherwise is marked "refused". `--plot` draws error against time (needs
matplotlib).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.parameters import Rig, load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run

PEERS = Path(__file__).parent / "peers"
RATE = 500.0
FREQUENCY = 4.0
#: The rig of `peers/rig.h`.
CHECK_RIG = {"omega_per_volt": 26.7, "p_charge": 0.25e6, "V_1": 50e-6, "V_2": 50e-6}
CONVERGED = {"rk4": 1e-5, "imex": 2.5e-5}
REFUSED = 2e-3
OURS = "ours, step chosen by error"
#: What one run may cost: at most this share of a peer's time.
PROMISED = {"C++ RK4, h = 0.0001 s": 0.25, "CVODE BDF, rtol = 1e-06": 0.2}
#: Programs that integrate one rig to convergence must agree to this rms [Pa] over the first seconds.
SAME = 2.0

#: Solvers of the plot by the beginning of their names, and their marks.
FAMILIES = {
    OURS: "k*",
    "ours, rk4, h": "C0o:",
    "ours, imex, h": "C1o:",
    "C++ RK4, h": "C2s:",
    "C++ IMEX, h": "C4D:",
    "CVODE BDF": "C3^:",
}

Rows = np.ndarray
Solve = Callable[[], tuple[float, Rows]]


@dataclass(frozen=True)
class Case:
    """A rig and a command: no throttles (`closed` None) or throttles closed by a share of the area; amplitude [V]."""

    name: str
    closed: float | None
    amplitude: float

    def rig(self) -> Rig:
        throttles = (
            {} if self.closed is None else {"orifices": "present", "closed_A": self.closed, "closed_B": self.closed}
        )
        return load_rig("thesis").with_overrides({**CHECK_RIG, **throttles})

    def words(self) -> list[str]:
        """The case as the peers' arguments."""
        return [str(int(self.closed is not None)), str(self.closed or 0.0), str(self.amplitude), str(FREQUENCY)]


CASES = (
    Case("no throttles, 3 sin 4t", None, 3.0),
    Case("25 % closed, 3 sin 4t", 0.25, 3.0),
    Case("50 % closed, 3 sin 4t", 0.50, 3.0),
    Case("75 % closed, 3 sin 4t", 0.75, 3.0),
    Case("50 % closed, 7 sin 4t", 0.50, 7.0),
)


def ours(case: Case, method: str, step: float | None, duration: float) -> Solve:
    """Our solver, at a step or (None) at the one it chooses: seconds and (n, 3) x [m], p_A, p_B [Pa]."""
    rig = case.rig()
    experiment = Experiment.of(
        rig=rig,
        command=f"{case.amplitude} sin({FREQUENCY}t)",
        duration=duration,
        method=method,
        allow_unresolved=step is not None and step >= REFUSED,
    )

    def solve() -> tuple[float, Rows]:
        start = time.process_time()
        run = integrate_run(experiment, (), step=step, duration=duration, rate=RATE)
        took = time.process_time() - start
        return took, np.column_stack([run["x"], run["p_A"], run["p_B"]])

    return solve


def theirs(program: Path, case: Case, setting: float, duration: float) -> Solve:
    """A peer program, which times its own integration; `setting` is its step [s] or relative tolerance."""

    def solve() -> tuple[float, Rows]:
        file = program.with_suffix(".rows")
        call = [str(program), *case.words(), str(duration), repr(setting), str(RATE), str(file)]
        finished = subprocess.run(call, check=True, capture_output=True, text=True)
        return float(finished.stdout.split()[0]), np.fromfile(file).reshape(-1, 3)

    return solve


def build(folder: Path) -> dict[str, Path]:
    """The peers that this machine can build."""
    libraries = ("cvode", "nvecserial", "sunmatrixdense", "sunlinsoldense")
    recipes = {
        "C++ RK4": ("rk4", ["g++", "-O3", "-march=native", "-std=c++17", str(PEERS / "rk4.cpp")], ["-lm"]),
        "C++ IMEX": ("imex", ["g++", "-O3", "-march=native", "-std=c++17", str(PEERS / "imex.cpp")], ["-lm"]),
        "CVODE BDF": (
            "cvode",
            ["gcc", "-O3", "-march=native", str(PEERS / "cvode.c")],
            [f"-lsundials_{library}" for library in libraries] + ["-lm"],
        ),
    }
    built = {}
    for name, (program, compiler, last) in recipes.items():
        if shutil.which(compiler[0]) is None:
            print(f"{name} left out: no {compiler[0]}", file=sys.stderr)
            continue
        made = subprocess.run(
            [*compiler, "-o", str(folder / program), *last], capture_output=True, text=True, check=False
        )
        if made.returncode == 0:
            built[name] = folder / program
        else:
            print(f"{name} left out: {(made.stderr.splitlines() or ['it cannot be built'])[0]}", file=sys.stderr)
    return built


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def same_trajectory(case: Case, peers: dict[str, Path]) -> dict[str, float]:
    """Rms difference in p_A [Pa] of each peer from ours over 5 s, all converged; exits where it is above `SAME`."""
    method = "rk4" if case.closed is None else "imex"
    converged = ours(case, method, CONVERGED[method], 5.0)()[1]
    results = {}
    for name, program in peers.items():
        if name == "C++ IMEX" and case.closed is None:
            continue
        tight = 1e-10 if name == "CVODE BDF" else {"C++ IMEX": 2.5e-5}.get(name, 1e-5 if case.closed is None else 1e-6)
        results[name] = rms(theirs(program, case, tight, 5.0)()[1][:, 1] - converged[:, 1])
        if not results[name] <= SAME:
            raise SystemExit(
                f"{case.name}: {name} and ours must agree within {SAME} Pa rms in p_A, got {results[name]:.3g} Pa"
            )
    return results


def contenders(case: Case, peers: dict[str, Path], duration: float) -> dict[str, Solve]:
    """Every solver and setting that is timed for the case; the first is our default."""
    method = "rk4" if case.closed is None else "imex"
    results = {OURS: ours(case, "auto", None, duration)}
    for h in (1e-3, 5e-4, 2e-4, 1e-4) if method == "rk4" else (1e-3, 5e-4, 2e-4):
        results[f"ours, {method}, h = {h:g} s"] = ours(case, method, h, duration)
    results[f"ours, {method}, h = {REFUSED:g} s, refused"] = ours(case, method, REFUSED, duration)
    if "C++ RK4" in peers:
        for h in (1e-3, 5e-4, 1e-4) if case.closed is None else (1e-4, 2e-5, 1e-5, 5e-6):
            results[f"C++ RK4, h = {h:g} s"] = theirs(peers["C++ RK4"], case, h, duration)
    if "C++ IMEX" in peers and case.closed is not None:
        results["C++ IMEX, h = 0.001 s"] = theirs(peers["C++ IMEX"], case, 1e-3, duration)
    if "CVODE BDF" in peers:
        for rtol in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
            results[f"CVODE BDF, rtol = {rtol:g}"] = theirs(peers["CVODE BDF"], case, rtol, duration)
    return results


def quartiles(values: np.ndarray) -> list[float]:
    return [float(q) for q in np.percentile(values, [50, 25, 75])]


def measure(case: Case, peers: dict[str, Path], duration: float, rounds: int) -> dict[str, Any]:
    """Errors and times of every contender on one case."""
    method = "rk4" if case.closed is None else "imex"
    agreement = same_trajectory(case, peers)
    reference = ours(case, method, CONVERGED[method], duration)()[1]
    solvers = contenders(case, peers, duration)
    errors = {}
    for name, solve in solvers.items():  # the unmeasured round
        rows = solve()[1]
        errors[name] = {"p_A_rms": rms(rows[:, 1] - reference[:, 1]), "x_rms": rms(rows[:, 0] - reference[:, 0])}
    times = np.array([[solve()[0] for solve in solvers.values()] for _ in range(rounds)])
    return {
        "agreement_p_A_rms": agreement,
        "promised": promised(case, dict(zip(solvers, times.T, strict=True))),
        "solvers": {
            name: {**errors[name], "seconds": quartiles(times[:, k]), "ratio": quartiles(times[:, k] / times[:, 0])}
            for k, name in enumerate(solvers)
        },
    }


def promised(case: Case, times: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """Our time over that of the peer that the case is measured against: median, quartiles and promise."""
    name = next(iter(PROMISED)) if case.closed is None else list(PROMISED)[1]
    if name not in times:
        return {}
    return {name: [*quartiles(times[OURS] / times[name]), PROMISED[name]]}


def show(case: Case, figures: dict[str, Any]) -> None:
    agreed = ", ".join(f"{name} {value:.2g} Pa" for name, value in figures["agreement_p_A_rms"].items())
    print(f"\n{case.name}   (converged, rms difference in p_A over 5 s: {agreed or 'no peer built'})")
    print(f"{'solver':<36}{'p_A rms error [Pa]':>20}{'x rms error [m]':>18}{'seconds':>26}{'times ours':>26}")
    for name, one in figures["solvers"].items():
        spread = [f"{m:.3f} ({a:.3f} .. {b:.3f})" for m, a, b in (one["seconds"], one["ratio"])]
        print(f"{name:<36}{one['p_A_rms']:>20.3g}{one['x_rms']:>18.2g}{spread[0]:>26}{spread[1]:>26}", flush=True)
    for name, (m, a, b, most) in figures["promised"].items():
        print(f"ours / {name}: {m:.3f} ({a:.3f} .. {b:.3f}), promised at most {most:g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--duration", type=float, default=180.0, help="simulated seconds")
    parser.add_argument("--case", action="append", choices=[case.name for case in CASES], help="only this case")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument("--plot", type=Path, help="draw error against time into this file (.svg, .png)")
    chosen = parser.parse_args()
    figures = {}
    print(f"{chosen.duration:g} s simulated, outputs at {RATE:g} Hz, {chosen.rounds} rounds; median (25 % .. 75 %)")
    with tempfile.TemporaryDirectory() as folder:
        peers = build(Path(folder))
        for case in CASES:
            if chosen.case is None or case.name in chosen.case:
                figures[case.name] = measure(case, peers, chosen.duration, chosen.rounds)
                show(case, figures[case.name])
    if chosen.json:
        write(chosen.json, figures)
    if chosen.plot:
        draw(figures, chosen.plot)


def write(path: Path, figures: dict[str, Any]) -> None:
    """Write figures as JSON with the day and the kind of machine, whole or not at all."""
    cores = f"{os.cpu_count()} cores, {platform.machine()}"
    figures = {"measured": time.strftime("%Y-%m-%d"), "machine": cores, "figures": figures}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(figures, indent=2) + "\n")
    partial.replace(path)


def draw(figures: dict[str, Any], path: Path) -> None:
    """The work-precision plot: rms error in p_A against processor seconds, a panel for each case."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    chosen, axes = plt.subplots(1, len(figures), figsize=(4.2 * len(figures), 4.0), sharey=True, squeeze=False)
    for ax, (case, results) in zip(axes[0], figures.items(), strict=True):
        for family, style in FAMILIES.items():
            points = [
                (one["seconds"][0], one["p_A_rms"])
                for name, one in results["solvers"].items()
                if name.startswith(family)
            ]
            if points:
                seconds, error = np.array(sorted(points)).T
                ax.loglog(seconds, error, style, markersize=14 if "*" in style else 6, label=family.rstrip(", h="))
        ax.legend(fontsize=8)
        ax.axhline(100.0, color="0.6", linewidth=0.8)
        ax.set_title(case, fontsize=10)
        ax.set_xlabel("processor time [s]")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("rms error in p_A [Pa]")
    chosen.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    chosen.savefig(path)


if __name__ == "__main__":
    main()
