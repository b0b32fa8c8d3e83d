"""The main job shown once, whole: a leak appears in a simulated actuator, is recorded, is found, and is reported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.recordings import read, write
from sealscope.reporting import write_page
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import Progress, Truth, simulate_with_truth
from sealscope.storage.folders import make_folder

#: The demo's experiment: the thesis's rig with both throttles half closed (its Table 4.3 d), its smallest leak from
#: half time on.
EXPERIMENT = {
    "command": "3 sin(4t)",
    "leak": "0.0042 L/min from 90 s",
    "duration": 180.0,
    "set": {"line.orifices": "present", "line.closed_A": "50[%]", "line.closed_B": "50[%]"},
}


@dataclass(frozen=True)
class Demo:
    """What the demo made: the diagnosis, the truth it never saw, and the files."""

    diagnosis: Diagnosis
    truth: Truth
    recording: Path
    page: Path


def run_demo(folder: Path, seed: int = 1, progress: Progress | None = None) -> Demo:
    """Simulate, write the recording, read it back, diagnose it and write the page, all into `folder`."""
    experiment = Experiment.of(**EXPERIMENT, seed=seed)  # type: ignore[arg-type]
    result = simulate_with_truth(experiment, progress)
    make_folder(folder)
    file, page = folder / "recording.nc", folder / "report.html"
    write(result.recording, file)
    recording = read(file)
    if progress is not None:
        progress("diagnosing", 0.0)
    diagnosis = diagnose(recording, file=file.name)
    if progress is not None:
        progress("writing the page", 0.5)
    write_page(
        page,
        recording,
        diagnosis,
        rig=experiment.rig,
        truth_onset_s=result.truth.onset_s,
        truth_leak_lpm=result.truth.mean_leak_lpm,
        title="Sealscope demo: a leak of 0.0042 L/min from 90 s",
    )
    if progress is not None:
        progress("writing the page", 1.0)
    return Demo(diagnosis, result.truth, file, page)
