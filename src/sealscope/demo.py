"""Demonstrate the main task: commission a machine, then diagnose a healthy and a leaking recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from sealscope.diagnosis.commissioned.machine import CommissionedMachine, commission
from sealscope.diagnosis.commissioned.machine_file import write_machine
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.recordings import read, write
from sealscope.reporting.page import report
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import Progress
from sealscope.simulation.simulate import Truth, simulate_experiment
from sealscope.storage.folders import make_folder

#: The command of the demo, on the thesis's rig.
COMMAND = "3 sin(4t)"
#: Number of healthy recordings for the commissioning, and length of each healthy recording [s].
N_HEALTHY, SECONDS = 5, 20.0
#: The leak to be found: the smallest of the thesis, which begins in the middle of the leaking recording.
LEAK = "0.0042 L/min from 30 s"


@dataclass(frozen=True)
class Demo:
    """Results of the demo: the commissioned machine, two diagnoses, the simulated leak, and the files written.

    `healthy`, `diagnosis`: diagnoses of a healthy and of the leaking recording; `recording`, `page`: files of the
    leaking recording and of the report on it.
    """

    machine: CommissionedMachine
    healthy: Diagnosis
    diagnosis: Diagnosis
    truth: Truth
    machine_file: Path
    recording: Path
    page: Path


def run_demo(folder: Path, seed: int = 1, progress: Progress | None = None) -> Demo:
    """Simulate recordings, commission a machine on healthy ones, and diagnose a healthy and a leaking one.

    All files are written into `folder`. `progress` is called with the name of a task and its completed fraction.
    """
    report_progress = progress or (lambda task, share: None)
    names = [*(f"healthy/run{k + 1}.nc" for k in range(N_HEALTHY)), "healthy.nc"]
    recordings = {}  # name of the file -> recording
    for k, name in enumerate(names):
        run_seed = len(names) * seed + k  # differs for each healthy recording and `seed`
        healthy_experiment = Experiment.of(command=COMMAND, duration=SECONDS, seed=run_seed)
        recordings[name] = simulate_experiment(healthy_experiment).recording
        report_progress("simulating healthy recordings", (k + 1) / len(names))
    leak_seed = seed or len(names)  # the healthy recordings of `seed` 0 have 0 to len(names) - 1
    experiment = Experiment.of(command=COMMAND, leak=LEAK, duration=60.0, seed=leak_seed)
    result = simulate_experiment(experiment, progress)
    file, page = folder / "recording.nc", folder / "report.html"
    recordings[file.name] = result.recording
    make_folder(folder / "healthy")
    for name, recording in recordings.items():
        write(recording, folder / name)
    report_progress("commissioning", 0.0)
    machine = commission(folder / "healthy", rig=experiment.rig, name="demo")
    machine_file = write_machine(machine, folder / "machine.toml")
    report_progress("diagnosing", 0.0)
    healthy = _diagnose_file(machine, folder, "healthy.nc")
    diagnosis = _diagnose_file(machine, folder, file.name)
    report_progress("writing the page", 0.5)
    report(
        read(file),
        page,
        diagnosis,
        rig=experiment.rig,
        truth_onset_s=result.truth.onset_s,
        truth_leak_lpm=result.truth.mean_leak_lpm,
        title=f"Sealscope demo: a leak of {LEAK}",
    )
    report_progress("writing the page", 1.0)
    return Demo(machine, healthy, diagnosis, result.truth, machine_file, file, page)


def _diagnose_file(machine: CommissionedMachine, folder: Path, name: str) -> Diagnosis:
    """Diagnose the recording in the file `name` of `folder`; the diagnosis states `name` as its file."""
    return replace(machine.diagnose(machine.read(folder / name)), file=name)
