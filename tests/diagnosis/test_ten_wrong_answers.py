"""Ten answers that were wrong, or a dead end, for a log as test benches write them: each is a case here, end to end.

A machine of the volume balance leaks from 30 s on. Its log in each dialect must give the same leak and onset as its own
channels. The parts are tested where they live: dialects in `tests/recordings`, the size of the machine in
`test_assumed_machine.py`, a leak from the first sample in `test_total_leakage.py`.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.evidence import LEAKS
from sealscope.recordings import Recording, read
from sealscope.reporting.messages import diagnosis_text, short_text

from ..representatives import SLOW, few
from ..wording import says
from .balance_machine import AREA, machine, step

CHANNELS = {"theta": ("rad", 1.0), "x": ("mm", 1e3), "p_A": ("bar", 1e-5), "p_B": ("bar", 1e-5)}
ONSET = 30.0


@pytest.fixture(scope="module")
def own() -> Recording:
    """A leak from the middle on, of a machine that nobody has stated."""
    return machine(1, G=step(0.0, 6.0e-13, at=ONSET), duration=60.0).only(CHANNELS)


def columns(recording: Recording) -> dict[str, np.ndarray]:
    return {name: factor * recording[name] for name, (_, factor) in CHANNELS.items()}


def text(recording: Recording, times: list[str], head: str = "t [s]", join: str = ",") -> str:
    heads = [head, *(f"{name} [{unit}]" for name, (unit, _) in CHANNELS.items())]
    rows = zip(times, *columns(recording).values(), strict=True)
    lines = [join.join([time, *(f"{value:.7g}" for value in values)]) for time, *values in rows]
    return "\n".join([join.join(heads), *lines]) + "\n"


def lvm(recording: Recording, folder: Path) -> Path:
    n, rate = len(recording), recording.rate
    lines = ["LabVIEW Measurement", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t.", "X_Columns\tOne"]
    lines += ["Time_Pref\tRelative", "Date\t2024/05/31", "Time\t12:00:00.25", "***End_of_Header***\t", "\t"]
    lines += [f"Channels\t{len(CHANNELS)}", "\t".join(["Samples", *[str(n)] * len(CHANNELS)])]
    lines += ["\t".join(["Y_Unit_Label", *(unit for unit, _ in CHANNELS.values())])]
    lines += ["\t".join(["X_Dimension", *["Time"] * len(CHANNELS)]), "\t".join(["X0", *["0.0"] * len(CHANNELS)])]
    lines += ["\t".join(["Delta_X", *[str(1 / rate)] * len(CHANNELS)]), "***End_of_Header***\t"]
    lines.append("\t".join(["X_Value", *CHANNELS, "Comment"]))
    rows = zip(recording.t, *columns(recording).values(), strict=True)
    lines += ["\t".join(f"{value:.7g}" for value in row) for row in rows]
    path = folder / "log.lvm"
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def matlab(recording: Recording, folder: Path, version: str) -> Path:
    held = {"t": recording.t[None, :], **{name: recording[name][None, :] for name in CHANNELS}}
    path = folder / "log.mat"
    if version == "5":
        from scipy.io import savemat

        savemat(path, held)
    else:
        matio = pytest.importorskip("matio")
        matio.save_to_mat(path, held, version="v7.3")
    return path


def csv(folder: Path, content: str) -> Path:
    path = folder / "log.csv"
    path.write_text(content)
    return path


def two_columns_over_midnight(recording: Recording, folder: Path) -> Path:
    start = dt.datetime(2024, 5, 31, 23, 59, 10)
    moments = [start + dt.timedelta(seconds=float(t)) for t in recording.t]
    return csv(folder, text(recording, [f"{m:%d.%m.%Y},{m:%H:%M:%S.%f}" for m in moments], "Datum,Zeit"))


def american(recording: Recording, folder: Path) -> Path:
    start = dt.datetime(2024, 5, 31, 23, 59, 10)
    moments = [start + dt.timedelta(seconds=float(t)) for t in recording.t]
    stamps = [f"{m.month}/{m.day}/{m.year} {m:%I:%M:%S}.{m.microsecond // 1000:03d} {m:%p}" for m in moments]
    return csv(folder, text(recording, stamps, "Time"))


def whole_seconds(recording: Recording, folder: Path) -> Path:
    start = dt.datetime(2024, 5, 31, 12, 0, 0)
    return csv(
        folder,
        text(recording, [f"{start + dt.timedelta(seconds=int(t)):%Y-%m-%d %H:%M:%S}" for t in recording.t], "Time"),
    )


def overload(recording: Recording, folder: Path) -> Path:
    lines = text(recording, [f"{t:.3f}" for t in recording.t]).splitlines()
    lines[9000] = lines[9000].rpartition(",")[0] + ",OVERLOAD"
    return csv(folder, "\n".join(lines) + "\n")


DIALECTS: dict[str, Callable[[Recording, Path], Path]] = {
    "1: a LabVIEW .lvm could not be read": lvm,
    "2: MATLAB v5 said to save as v7.3": lambda recording, folder: matlab(recording, folder, "5"),
    "2: MATLAB v7.3 held no columns": lambda recording, folder: matlab(recording, folder, "v7.3"),
    "3: midnight in two columns dropped half of the file, and there was no leak": two_columns_over_midnight,
    "4: American dates with AM and PM": american,
    "5: whole seconds at 200 Hz": whole_seconds,
    "6: a cell OVERLOAD refused the file": overload,
}


@pytest.mark.parametrize("case", few(DIALECTS, 2, SLOW))
def test_a_log_of_a_test_bench(case: str, own: Recording, tmp_path: Path) -> None:
    recording = read(DIALECTS[case](own, tmp_path))
    assert recording.rate == pytest.approx(own.rate, rel=1e-3)
    assert len(recording) == pytest.approx(len(own), abs=0.02 * len(own))
    result = diagnose(recording)
    assert (result.verdict, result.detector) == ("leak", "volume balance"), result.reason
    assert result.onset_s is not None
    assert result.onset_s - float(recording.t[0]) == pytest.approx(ONSET, abs=1.5)
    assert result.cause in LEAKS


def test_7_a_cylinder_five_times_as_large_got_the_flow_of_a_small_one(own: Recording) -> None:
    """Its recording is this one: 0.0043 L/min was stated where 0.021 L/min leaked."""
    result = diagnose(own)
    assert result.leak_lpm is None
    assert result.severity is not None and result.severity.pump_share is not None
    assert says(short_text(result), "how_much.machine_or_area")


def test_8_a_leak_from_the_start_was_kept_as_the_baseline() -> None:
    result = diagnose(machine(1, G=1.0e-12).only(CHANNELS))
    assert result.verdict == "no leak"
    text = " ".join(diagnosis_text(result).split())
    assert "pump and piston together" in text
    assert "keep this recording as a baseline" not in text.lower()
    stated = diagnose(machine(1, G=1.0e-12).only(CHANNELS), rig="thesis")
    assert (stated.verdict, stated.onset_s) == ("leak", None)
    assert says(stated.reason, "alarm.level_flow")


@pytest.mark.slow
def test_9_no_leak_stood_beside_a_score_far_over_its_threshold() -> None:
    """Side A loses what its pressure drives out; half of that is a motion that no pressure difference explains."""
    healthy = machine(8)
    lost = np.cumsum(np.where(healthy.t < 60.0, 0.0, 4.0e-13 * healthy["p_A"])) / healthy.rate
    x = healthy["x"] - 0.5 * lost / AREA
    result = diagnose(Recording(healthy.t, {**healthy.channels, "x": x}, healthy.units, healthy.rate))
    assert result.verdict != "leak"
    assert (result.cause, result.alarmed) == ("external leak", True)
    for line in (result.summary, short_text(result).splitlines()[0], diagnosis_text(result).splitlines()[0]):
        assert "external leak" in line
    assert "external leak" in result.as_dict()["summary"]
    for line in diagnosis_text(result).splitlines():
        assert not ("no leak" in line and "over the threshold" in line)
