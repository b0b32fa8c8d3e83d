"""A rig's unit (FMU 2.0) against `simulate`: how far apart they are, and how fast each is, side by side.

    python benchmarks/bench_fmu.py [--rounds 9] [--seconds 60]

Both run the same laws with the same steps under the same command, linear over each communication step of 1 ms. The time
of the unit is that of its library, called by this program once for the whole run (`alone`, a constant command) and once
a communication step through FMPy (`by FMPy`); that of `simulate` is of its solver (`trajectory`). Prints medians and
ratios; needs the extra `fmu`.
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
import time
from pathlib import Path

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave

import sealscope as ss
from sealscope.simulation.commands import sampled_signal
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run

SPAN = 1e-3
CHANNELS = ("p_A", "p_B", "x")
RIGS = {"thesis": (2.5e-4, {}), "thesis, throttles": (2.5e-4, {"line.orifices": "present", "line.closed_A": 0.5})}
RIGS["single-rod-eha"] = (1.25e-4, {})


def started(path: Path) -> tuple[FMU2Slave, dict[str, int]]:
    """Return a unit that can step, and the references of its variables."""
    description = fmpy.read_model_description(str(path))
    unit = FMU2Slave(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(path)),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="unit",
    )
    unit.instantiate()
    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    return unit, {v.name: v.valueReference for v in description.modelVariables}


def stepped(path: Path, t: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float]:
    """Return rows of `CHANNELS` and the time it took [s]; the command is linear between the communication points."""
    unit, references = started(path)
    command, order = (ctypes.c_uint * 1)(references["u"]), (ctypes.c_int * 1)(1)
    wanted, rows = [references[name] for name in CHANNELS], np.empty((t.size - 1, len(CHANNELS)))
    begin = time.perf_counter()
    for k in range(t.size - 1):
        unit.setReal([references["u"]], [u[k]])
        slope = (ctypes.c_double * 1)((u[k + 1] - u[k]) / SPAN)
        unit.fmi2SetRealInputDerivatives(unit.component, command, 1, order, slope)
        rows[k] = unit.getReal(wanted)
        unit.doStep(t[k], SPAN)
    return rows, time.perf_counter() - begin


def main() -> None:
    """Print differences and times for each rig."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=60.0)
    chosen = parser.parse_args()
    t = np.arange(round(chosen.seconds / SPAN) + 1) * SPAN
    u = 3.0 * np.sin(2.0 * t)
    print(f"{chosen.seconds:g} s; medians of {chosen.rounds} rounds")
    print("rig                 largest difference       simulate   unit alone  ratio  by FMPy")
    for title, (step, overrides) in RIGS.items():
        rig = ss.load_rig(title.partition(",")[0]).with_overrides(overrides)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "unit.fmu"
            ss.write_fmu(path, rig=rig, step=step)
            command = sampled_signal(np.r_[t, t[-1] + 1.0], np.r_[u, u[-1]])
            same = Experiment.of(rig=rig, command=command, duration=chosen.seconds, rate=1 / SPAN, step=step)
            run = integrate_run(same, ())
            every = round(SPAN * (run.t.size - 1) / run.t[-1])
            theirs = np.stack([run[name][::every][: t.size - 1] for name in CHANNELS], axis=1)
            rows, by_master = stepped(path, t, u)
            worst = np.abs(rows - theirs).max(axis=0)
            held = Experiment.of(rig=rig, command="step 0.05 at 0 s", duration=chosen.seconds, step=step)
            ours, alone = [], []
            for _ in range(chosen.rounds):
                begin = time.perf_counter()
                integrate_run(held, ())
                ours.append(time.perf_counter() - begin)
                unit, references = started(path)
                unit.setReal([references["u"]], [0.05])
                begin = time.perf_counter()
                unit.doStep(0.0, chosen.seconds)
                alone.append(time.perf_counter() - begin)
        first, second = float(np.median(ours)), float(np.median(alone))
        print(
            f"{title:18}  {worst[:2].max():.1e} Pa, {worst[2]:.1e} m  {first:7.3f} s  {second:8.3f} s  "
            f"{first / second:5.2f}  {by_master:6.2f} s"
        )


if __name__ == "__main__":
    main()
