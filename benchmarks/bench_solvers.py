"""Work and precision of the solvers against a C++ Runge-Kutta program and SUNDIALS CVODE, in turn and in one run.

    python benchmarks/bench_solvers.py [--rounds 5] [--duration 180] [--case NAME ...] [--json FILE]

Builds the programs of `benchmarks/peers` (g++, gcc; CVODE needs the SUNDIALS headers, Debian's libsundials-dev, and is
left out with a word where they are absent), checks that all of them give the same trajectory of the same rig, and
prints for each solver and step or tolerance the rms error in p_A against a converged run and the time of the
integration: median and middle half (25 % to 75 %) over the rounds, and as a ratio to our default in the same round.
Compilation is not timed. A step that `integrate` refuses unless told otherwise is marked "refused".
"""

from __future__ import annotations

import argparse
import json
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
from sealscope.simulation.integrate import DEFAULT_STEP, integrate

PEERS = Path(__file__).parent / "peers"
RATE = 500.0
FREQUENCY = 4.0
#: The rig of `peers/rig.h`.
CHECK_RIG = {"omega_per_volt": 26.7, "p_charge": 0.25e6, "V_1": 50e-6, "V_2": 50e-6}
CONVERGED = {"rk4": 1e-5, "imex": 2.5e-5}
REFUSED = 2e-3
#: Programs that integrate one rig to convergence must agree to this rms [Pa] over the first seconds.
SAME = 2.0

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
        return load_rig("thesis").with_values({**CHECK_RIG, **throttles})

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


def ours(case: Case, method: str, step: float, duration: float) -> Solve:
    """Our solver: seconds and (n, 3) x [m], p_A, p_B [Pa]."""
    rig = case.rig()

    def inputs(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return case.amplitude * np.sin(FREQUENCY * t), np.zeros_like(t), np.zeros_like(t)

    def solve() -> tuple[float, Rows]:
        start = time.perf_counter()
        run = integrate(rig, inputs, duration, RATE, method=method, step=step, allow_unresolved=step >= REFUSED)  # type: ignore[arg-type]
        took = time.perf_counter() - start
        return took, np.column_stack([run["x"], run["p_A"], run["p_B"]])

    return solve


def theirs(program: Path, case: Case, setting: float, duration: float) -> Solve:
    """A peer program, which times its own integration; `setting` is its step [s] or relative tolerance."""

    def solve() -> tuple[float, Rows]:
        file = program.with_suffix(".rows")
        call = [str(program), *case.words(), str(duration), repr(setting), str(RATE), str(file)]
        told = subprocess.run(call, check=True, capture_output=True, text=True)
        return float(told.stdout.split()[0]), np.fromfile(file).reshape(-1, 3)

    return solve


def build(folder: Path) -> dict[str, Path]:
    """The peers that this machine can build."""
    libraries = ("cvode", "nvecserial", "sunmatrixdense", "sunlinsoldense")
    recipes = {
        "C++ RK4": ("rk4", ["g++", "-O3", "-march=native", "-std=c++17", str(PEERS / "rk4.cpp")], ["-lm"]),
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
    found = {}
    for name, program in peers.items():
        tight = 1e-10 if name == "CVODE BDF" else (1e-5 if case.closed is None else 1e-6)
        found[name] = rms(theirs(program, case, tight, 5.0)()[1][:, 1] - converged[:, 1])
        if not found[name] <= SAME:
            raise SystemExit(
                f"{case.name}: {name} and ours must agree within {SAME} Pa rms in p_A, got {found[name]:.3g} Pa"
            )
    return found


def contenders(case: Case, peers: dict[str, Path], duration: float) -> dict[str, Solve]:
    """Every solver and setting that is timed for the case; the first is our default."""
    method = "rk4" if case.closed is None else "imex"
    found = {f"ours, {method}, h = {DEFAULT_STEP[method]:g} s": ours(case, method, DEFAULT_STEP[method], duration)}
    for h in (1e-3, 2e-4, 1e-4) if method == "rk4" else (5e-4, 2e-4):
        found[f"ours, {method}, h = {h:g} s"] = ours(case, method, h, duration)
    found[f"ours, {method}, h = {REFUSED:g} s, refused"] = ours(case, method, REFUSED, duration)
    if "C++ RK4" in peers:
        for h in (1e-3, 5e-4, 1e-4) if case.closed is None else (1e-4, 2e-5, 1e-5, 5e-6):
            found[f"C++ RK4, h = {h:g} s"] = theirs(peers["C++ RK4"], case, h, duration)
    if "CVODE BDF" in peers:
        for rtol in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
            found[f"CVODE BDF, rtol = {rtol:g}"] = theirs(peers["CVODE BDF"], case, rtol, duration)
    return found


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
        "solvers": {
            name: {**errors[name], "seconds": quartiles(times[:, k]), "ratio": quartiles(times[:, k] / times[:, 0])}
            for k, name in enumerate(solvers)
        },
    }


def show(case: Case, figures: dict[str, Any]) -> None:
    agreed = ", ".join(f"{name} {value:.2g} Pa" for name, value in figures["agreement_p_A_rms"].items())
    print(f"\n{case.name}   (converged, rms difference in p_A over 5 s: {agreed or 'no peer built'})")
    print(f"{'solver':<36}{'p_A rms error [Pa]':>20}{'x rms error [m]':>18}{'seconds':>26}{'times ours':>26}")
    for name, one in figures["solvers"].items():
        spread = [f"{m:.3f} ({a:.3f} .. {b:.3f})" for m, a, b in (one["seconds"], one["ratio"])]
        print(f"{name:<36}{one['p_A_rms']:>20.3g}{one['x_rms']:>18.2g}{spread[0]:>26}{spread[1]:>26}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--duration", type=float, default=180.0, help="simulated seconds")
    parser.add_argument("--case", action="append", choices=[case.name for case in CASES], help="only this case")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
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
        partial = chosen.json.with_name(chosen.json.name + ".partial")
        partial.write_text(json.dumps(figures, indent=2) + "\n")
        partial.replace(chosen.json)


if __name__ == "__main__":
    main()
