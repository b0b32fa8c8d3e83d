"""Logs of a small machine, and a workbench that has opened them."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

import sealscope as ss
from sealscope.app.session import SessionFolder
from sealscope.app.site import LaunchGuard, make_site
from sealscope.app.tables import TableCache
from sealscope.app.workbench import Workbench

ORIGIN = "http://127.0.0.1"
CHANGE = {"Origin": ORIGIN, "X-Sealscope": "app", "Sec-Fetch-Site": "same-origin"}
HEADING = "Zeit [s];Druck Kolbenseite [bar];Druck Stangenseite [bar];Weg [mm];Drehzahl [1/min]"


def write_log(path: Path, seed: int, leak: str | None = None, seconds: float = 40.0, heading: str = HEADING) -> None:
    """Write a log as a German logger does: semicolons, decimal commas, a date above the heading."""
    run = ss.simulate(duration=f"{seconds:g} s", seed=seed, leak=leak)
    columns = (run.t, run["p_A"] / 1e5, run["p_B"] / 1e5, run["x"] * 1e3, run["omega"] * 30 / np.pi)
    samples = zip(*(column[::2] for column in columns), strict=True)
    rows = [";".join(f"{value:.4f}".replace(".", ",") for value in row) for row in samples]
    head = ["Rig;7", f"Start;2026-03-{seed:02d}T07:30:00", heading]
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


@pytest.fixture(scope="session")
def logs(tmp_path_factory) -> Path:
    """A folder of five healthy days and one with a leak."""
    folder = tmp_path_factory.mktemp("logs")
    for day in range(1, 6):
        write_log(folder / f"day {day}.csv", day)
    write_log(folder / "suspect.csv", 6, "0.05 L/min")
    return folder


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """The workbench of a new session; `bench.folder.folder` is its folder."""
    for module in ("tables", "logs"):  # not the folder of compiled code, which would be made anew
        monkeypatch.setattr(f"sealscope.app.{module}.cache_folder", lambda: tmp_path / "cache" / "app")
    made = Workbench(SessionFolder(tmp_path / "session"), TableCache(tmp_path / "cache" / "app"))
    yield made
    made.close()


@pytest.fixture
def guard() -> LaunchGuard:
    return LaunchGuard()


@pytest.fixture
def client(bench, guard) -> TestClient:
    """A browser that has had the launch token."""
    visitor = TestClient(make_site(bench, guard), base_url=ORIGIN, follow_redirects=False)
    assert visitor.get("/start", params={"token": guard.token}).status_code == 303
    return visitor


def tell(client: TestClient, what: str, **values):
    """Ask for a change, and return the answer's values; the status must be 200."""
    answer = client.post(f"/api/{what}", json=values, headers=CHANGE)
    assert answer.status_code == 200, answer.text
    return answer.json()


def settle(bench: Workbench, seconds: float = 120.0) -> dict:
    """Wait until no job is left, and return the state."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        state = bench.state()
        if not any(job["state"] in ("running", "waiting") for job in state["jobs"]):
            return state
        time.sleep(0.02)
    raise AssertionError("the jobs do not end")
