"""A folder from outside holds a module of each name that a program of ours imports: none of them runs."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.campaigns.execution.workers import iter_results
from sealscope.recordings.subprocesses import run_in_subprocess

from .conftest import SOURCES
from .test_full_disk import PLAN

#: What a child lists: every module that it has imported.
LOADED = "sorted(__import__('sys').modules)"
Ran = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """An empty folder to work in."""
    folder = tmp_path / "copied"
    folder.mkdir()
    return folder


@pytest.fixture
def run(tmp_path: Path, planted: Path) -> Ran:
    """Plant modules of the names, run a program's text as an installed command is run, and hold that none ran."""
    program = tmp_path / "bin" / "program"
    program.parent.mkdir()

    def ran(names: list[str], text: str, *words: str) -> subprocess.CompletedProcess[str]:
        program.write_text(text)
        for name in {name.partition(".")[0] for name in (*names, *sys.stdlib_module_names)} | {"sitecustomize"}:
            mark = f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r} + ' ')\n"
            (planted / f"{name}.py").write_text(mark)
        environment = {**os.environ, "PYTHONPATH": str(SOURCES)}
        done = subprocess.run(
            [sys.executable, str(program), *words],
            cwd=planted, env=environment, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert not (tmp_path / "ran").exists(), (tmp_path / "ran").read_text()
        return done

    return ran


COMMAND = (
    "import sys\nfrom sealscope.cli import main\nsys.argv[0] = 'sealscope'\nif __name__ == '__main__':\n    main()\n"
)


def files(folder: Path) -> list[str]:
    """Write a recording in formats that are read apart, and return their names."""
    t = np.arange(900) / 500
    recording = ss.Recording(t, {"p_A": 3e5 + np.sin(t), "p_B": 3e5 - np.sin(t)}, {"p_A": "Pa", "p_B": "Pa"}, 500.0)
    ss.write(recording, folder / "a.nc")
    ss.write(recording, folder / "a.csv")
    (folder / "a.csv.gz").write_bytes(gzip.compress((folder / "a.csv").read_bytes()))
    (folder / "a.csv").unlink()
    pytest.importorskip("pyarrow")
    ss.write(recording, folder / "a.parquet")
    from scipy.io import savemat

    pytest.importorskip("matio")
    savemat(folder / "a.mat", {"t": t, "p_A_Pa": recording["p_A"], "p_B_Pa": recording["p_B"]})
    openpyxl = pytest.importorskip("openpyxl")
    pytest.importorskip("python_calamine")
    book = openpyxl.Workbook()
    book.active.append(["t [s]", "p_A [Pa]"])
    for row in zip(t.tolist(), recording["p_A"].tolist(), strict=True):
        book.active.append(row)
    book.save(folder / "a.xlsx")
    return ["a.nc", "a.csv.gz", "a.parquet", "a.mat", "a.xlsx"]


def test_none_runs_where_files_are_read_apart(planted: Path, run: Ran) -> None:
    names = files(planted)
    for name in names:
        ss.read(planted / name, map="auto")
    loaded = run_in_subprocess(eval, LOADED, limit=10.0)
    assert {"numpy", "h5py", "pyarrow", "python_calamine", "matio", "pickle"} <= set(loaded)
    done = run(loaded, COMMAND, "inspect", *names, "--map", "auto")
    assert done.stderr == ""
    assert all(name in done.stdout for name in names)


@pytest.mark.slow
def test_no_library_runs_where_python_itself_begins_in_the_folder(planted: Path, tmp_path: Path) -> None:
    """`python -m` puts the working folder first, until the program has begun."""
    t = np.arange(900) / 500
    ss.write(ss.Recording(t, {"p_A": 3e5 + np.sin(t)}, {"p_A": "Pa"}, 500.0), planted / "a.nc")
    for name in {name.partition(".")[0] for name in sys.modules} - sys.stdlib_module_names - {"sealscope"}:
        (planted / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r} + ' ')\n")
    words = [sys.executable, "-m", "sealscope", "inspect", "a.nc"]
    environment = {**os.environ, "PYTHONPATH": str(SOURCES)}
    done = subprocess.run(words, cwd=planted, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.startswith("a.nc: 900 samples"), done.stderr
    assert not (tmp_path / "ran").exists(), (tmp_path / "ran").read_text()


@pytest.mark.slow
def test_none_runs_in_worker_processes(run: Ran) -> None:
    ((_, loaded),) = iter_results(eval, [LOADED], 2)
    assert loaded is not None
    assert "multiprocessing.spawn" in loaded
    text = "from sealscope.campaigns.execution.workers import iter_results\n"
    text += "if __name__ == '__main__':\n    print(sorted(iter_results(abs, [-1, 2], 2)))\n"
    done = run(loaded, text)
    assert done.stdout == "[(-1, 1), (2, 2)]\n", done.stderr


@pytest.mark.slow
def test_none_runs_in_the_compiler_of_units(run: Ran) -> None:
    pytest.importorskip("ziglang")
    text = "import subprocess\nfrom sealscope.emit.compiler import find_compiler\n"
    text += "command = [*find_compiler().command, '--version']\n"
    text += "print(subprocess.run(command, capture_output=True, check=True).stdout.decode())"
    assert "clang" in run(["ziglang"], text).stdout


@pytest.mark.slow
def test_none_runs_in_a_campaign(planted: Path, run: Ran) -> None:
    (planted / "plan.toml").write_text(PLAN)
    done = run(list(sys.modules), COMMAND, "campaign", "run", "plan.toml", "--jobs", "2")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_settings_of_compiled_code_are_not_taken_from_the_working_folder(planted: Path, run: Ran) -> None:
    """numba reads them there: `cuda_driver` names a library that it loads."""
    (planted / ".numba_config.yaml").write_text("disable_jit: 1\ncuda_driver: ./evil.so\n")
    text = "import sealscope.compiled, numba\nprint(numba.config.DISABLE_JIT, repr(numba.config.CUDA_DRIVER))"
    assert run([], text).stdout == "0 ''\n"


def test_a_plan_runs_no_program_beside_it(call, planted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(planted)
    (planted / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    target = '[factors]\ncommand = ["position 20 mm sin(2t)"]\ncontroller = ["evil.py:x"]\n[[records]]'
    (planted / "plan.toml").write_text(PLAN.replace("[[records]]", target, 1))
    assert call("campaign", "status", "plan.toml").out.startswith("records: 0 of 8 done")
    assert "must have rows" in call("campaign", "report", "plan.toml").refused()
    assert "--trust" in call("campaign", "run", "plan.toml").refused()
    assert not (tmp_path / "ran").exists()
    call("campaign", "run", "plan.toml", "--trust")
    assert (tmp_path / "ran").exists()
