"""Work in a process of its own: crashes and loops end there, and the next request is served."""

from __future__ import annotations

import math
import operator
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import Recording, read, write
from sealscope.recordings.subprocesses import CrashedSubprocessError, run_in_subprocess

from ..refusals import refusal
from ..waiting import until


def test_results_and_errors_come_back() -> None:
    assert run_in_subprocess(operator.add, 2, 3, limit=10.0) == 5
    with pytest.raises(RuntimeError, match=r"math domain error|nonnegative"):
        run_in_subprocess(math.sqrt, -1.0, limit=10.0)
    with refusal(error=UnreadableFile):
        run_in_subprocess(read, "nowhere.csv", limit=10.0)


def test_a_crash_and_a_loop_end_there(capfd: pytest.CaptureFixture[str]) -> None:
    with refusal(error=CrashedSubprocessError):
        run_in_subprocess(os.abort, limit=10.0)
    run_in_subprocess(operator.add, 1, 1, limit=10.0)  # the start is over
    with refusal("0.3 s", error=CrashedSubprocessError):
        run_in_subprocess(time.sleep, 60.0, limit=0.3)
    assert run_in_subprocess(operator.mul, 2, 3, limit=10.0) == 6
    assert run_in_subprocess(print, "noise", limit=10.0) is None
    output = capfd.readouterr()
    assert output.out == output.err == ""


def test_a_file_whose_library_crashes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sealscope.recordings.files._read_by_format", os.abort)
    path = tmp_path / "log.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    monkeypatch.setattr(
        "sealscope.recordings.files.run_on_file",
        lambda work, *_, limit, **more: run_in_subprocess(work, limit=limit),
    )
    with refusal("log", error=UnreadableFile):
        read(path)


def test_hdf5_with_our_own_mark_is_read_apart_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, kinds = tmp_path / "run.nc", []

    def observed(work: object, file: Path, kind: str, *arguments: object, **limits: Any) -> object:
        kinds.append(kind)
        return run_in_subprocess(work, file, kind, *arguments, **limits)  # type: ignore[arg-type]

    t = np.arange(100) / 100.0
    write(Recording(t, {"p_A": np.sin(t)}, {"p_A": "Pa"}, 100.0), path)
    monkeypatch.setattr("sealscope.recordings.files.run_on_file", observed)
    assert (read(path)["p_A"] == np.sin(t)).all()
    assert kinds == ["netcdf"]  # anybody can write the mark


def test_memory_is_limited_for_each_request() -> None:
    pytest.importorskip("resource")
    with pytest.raises(MemoryError):
        run_in_subprocess(bytearray, 2**30, limit=10.0, memory=2**29)
    assert len(run_in_subprocess(bytearray, 2**28, limit=10.0, memory=2**30)) == 2**28


@pytest.mark.slow
def test_files_are_limited_and_removed_with_the_process(tmp_path: Path) -> None:
    """What a reader keeps in its temporary folder does not outlive it, however it ends."""
    pytest.importorskip("resource")
    with pytest.raises(RuntimeError, match="File too large"):
        run_in_subprocess(Path.write_bytes, tmp_path / "large", bytes(2**20), limit=10.0, disk=2**19)
    folder = Path(run_in_subprocess(tempfile.mkdtemp, limit=10.0))
    assert folder.is_dir()
    with refusal(error=CrashedSubprocessError):
        run_in_subprocess(os.abort, limit=10.0)
    assert not folder.exists()


def test_a_long_work_holds_no_other_thread_up() -> None:
    with ThreadPoolExecutor() as threads:
        long = threads.submit(run_in_subprocess, time.sleep, 1.0, limit=10.0)
        while threads.submit(run_in_subprocess, operator.add, 1, 1, limit=10.0).result() == 2 and not long.running():
            assert not long.done()  # else it has ended before it was seen to run
        assert run_in_subprocess(operator.add, 2, 3, limit=10.0) == 5
        assert not long.done()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="asks Linux for the state of a process")
def test_work_whose_program_was_killed_ends_at_its_limit(tmp_path: Path) -> None:
    """It does not see the end of its standard input while it works."""
    text = "import os, time\nfrom sealscope.recordings.subprocesses import run_in_subprocess\n"
    text += (
        "print(run_in_subprocess(os.getpid, limit=9.0), flush=True)\nrun_in_subprocess(time.sleep, 60.0, limit=0.5)\n"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True, env=environment) as program:
        assert program.stdout is not None
        status = Path(f"/proc/{int(program.stdout.readline())}/status")
        time.sleep(0.2)
        program.kill()
    until(lambda: not status.exists() or "State:\tZ" in status.read_text())
