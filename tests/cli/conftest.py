"""The command line called as a user calls it, and small files to call it with."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sealscope
from sealscope import cli

SOURCES = Path(sealscope.__file__).resolve().parents[1]
Listing = dict[str, tuple[int, int]]


@dataclass(frozen=True)
class Call:
    """What one call of the command left behind: exit status, standard output, standard error."""

    status: int
    out: str
    err: str

    @property
    def objects(self) -> list[dict[str, Any]]:
        """Standard output read as one JSON object a line; fails on anything else."""
        result = [json.loads(line) for line in self.out.splitlines()]
        assert all(isinstance(item, dict) for item in result)
        return result

    def refused(self, status: int = 2) -> str:
        """The one line of complaint of a call that must end with `status`, without its prefix."""
        assert self.status == status, self
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("sealscope: "), self.err
        assert "Traceback" not in self.err
        return lines[0].removeprefix("sealscope: ")

    def misused(self) -> str:
        """The complaint of a call whose options are wrong: usage lines and one line `Error: ...`, status 2."""
        assert self.status == 2, self
        lines = self.err.splitlines()
        assert lines[0].startswith("Usage: sealscope"), self.err
        assert sum(line.startswith("Error: ") for line in lines) == 1, self.err
        assert lines[-1].startswith("Error: "), self.err
        assert "Traceback" not in self.err
        assert self.out == ""
        return lines[-1].removeprefix("Error: ")


Run = Callable[..., Call]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Call the command within this process. An exception that is not an exit goes through, and fails the test."""

    def called(*words: object) -> Call:
        monkeypatch.setattr(sys, "argv", ["sealscope", *map(str, words)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capfd.readouterr()
        assert isinstance(ended.value.code, int)
        return Call(ended.value.code, out, err)

    return called


@pytest.fixture
def verbose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a call within this process be verbose: it adds a handler to the log, which later calls do not have."""
    log = logging.getLogger("sealscope")
    monkeypatch.setattr(log, "handlers", list(log.handlers))
    monkeypatch.setattr(log, "level", log.level)


@pytest.fixture(scope="session")
def surroundings() -> dict[str, str]:
    """This process's environment, with the package under test on the path of a child."""
    known = os.pathsep.join(part for part in (str(SOURCES), os.environ.get("PYTHONPATH", "")) if part)
    usual = {name: value for name, value in os.environ.items() if name not in ("PYTHONUNBUFFERED", "PYTHONIOENCODING")}
    return {**usual, "PYTHONPATH": known, "PYTHON": sys.executable}


@pytest.fixture(scope="session")
def shell(surroundings: dict[str, str]) -> Run:
    """Run a command in a process of its own with the package under test on its path; the first word is the program,
    `sealscope` for the command itself."""

    def ran(*words: object, **more: str) -> Call:
        program = [sys.executable, "-m", "sealscope"] if words[0] == "sealscope" else [str(words[0])]
        done = subprocess.run(
            [*program, *map(str, words[1:])],
            capture_output=True,
            check=False,
            env={**surroundings, **more},
            timeout=120,
        )
        return Call(done.returncode, done.stdout.decode(), done.stderr.decode())

    return ran


def listing(folder: Path) -> Listing:
    """Every file below a folder, hidden ones too, with its size and the time of its last change."""
    return {
        str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns) if path.is_file() else (0, 0)
        for path in folder.rglob("*")
    }


@pytest.fixture
def untouched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Work in `tmp_path`; the function given says when it is complete, and at the end it must still be as it was."""
    monkeypatch.chdir(tmp_path)
    known: list[Listing] = []

    def complete() -> None:
        known.append(listing(tmp_path))

    complete()
    yield complete
    assert listing(tmp_path) == known[-1]


#: The rig of the demo: both throttles half closed.
THROTTLED = {"line.orifices": "present", "line.closed_A": "50 %", "line.closed_B": "50 %"}


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with simulated recordings: `leak.nc` (a leak from second 20 of 40), `healthy_1.nc` to `healthy_3.nc`
    (20 s, no leak)."""
    folder = tmp_path_factory.mktemp("recordings")
    leaky = sealscope.simulate(duration=40.0, leak="0.0135 L/min from 20 s", set=THROTTLED, seed=8)
    sealscope.write(leaky, folder / "leak.nc")
    for seed in (1, 2, 3):
        healthy = sealscope.simulate(duration=20.0, set=THROTTLED, seed=seed)
        sealscope.write(healthy, folder / f"healthy_{seed}.nc")
    return folder


def _stroke(seed: int, direction: int, leaks: bool) -> str:
    """3 s of a stroke as a foreign logger writes it: raw 14-bit counts at 1000 Hz, no units, no seconds; a leak damps
    the ringing."""
    random = np.random.default_rng(seed)
    t = np.arange(3000) / 1000
    moved = 1500 * direction * np.tanh(3 * t)
    ringing = (60 if leaks else 150) * np.sin(2 * np.pi * 90 * t) * np.exp(-((t - 1.0) ** 2))
    sides = [8000 + sign * (moved + ringing) + random.normal(0, 12, t.size) for sign in (1, -1)]
    first, second = (np.round(side * (1 + 0.01 * random.normal())).astype(int) for side in sides)
    rows = [f"{k + 1}\t{11000 + k}\t0\t{first[k]}\t{second[k]}\tName_{k % 7}" for k in range(t.size)]
    return "\n".join(["Time\tAngle\tTemp_1\tPG_1\tPG_2\tF_Names", *rows, ""])


@pytest.fixture(scope="session")
def strokes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of foreign logs of strokes in alternating directions: `healthy_00.txt` to `healthy_19.txt`,
    `leak_00.txt` to `leak_03.txt`; even numbers go one way, odd ones the other."""
    folder = tmp_path_factory.mktemp("strokes")
    for kind, count, first in (("healthy", 20, 100), ("leak", 4, 200)):
        for k in range(count):
            text = _stroke(first + k, 1 if k % 2 == 0 else -1, kind == "leak")
            (folder / f"{kind}_{k:02d}.txt").write_text(text)
    return folder
