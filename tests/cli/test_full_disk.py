"""A disk that is full, folders that cannot be written, a clock that is wrong: one line, or the same bytes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sealscope.campaigns.execution import store
from sealscope.campaigns.execution.run import run
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.reader import load_plan
from sealscope.campaigns.results import judge_simulated_campaign, write_result
from sealscope.errors import InputError
from sealscope.storage.rows import ROWS

from ..refusals import refusal

resource = pytest.importorskip("resource")

PLAN = """
[campaign]
name = "tiny"
duration = "6 s"
detectors = ["d3 of p_A changed", "sign rule: d3 of p_A fell"]
false_alarm = 0.2
seed = 3

[[records]]
use = "calibrate"
count = 5

[[records]]
leak = "0.015 L/min"
count = 3
"""


@contextmanager
def room(size: int) -> Iterator[None]:
    """Let no file of this process become longer than `size` bytes: a write beyond fails as it does on a full disk.

    Python would cut the compiled code of a module that it imports meanwhile, and later processes would load it.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        patch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # of processes that start meanwhile
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [pytest.param(2000, marks=pytest.mark.slow), 5000, 60_000])
@pytest.mark.parametrize("suffix", ["nc", "csv", "parquet"])
def test_a_recording_is_whole_or_absent(size: int, suffix: str, shell, call, recordings: Path, tmp_path: Path) -> None:
    """libhdf5 ends the process at such a write: the call in a process of its own is the one that tells."""
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    target = tmp_path / f"out.{suffix}"
    target.write_text("what was there before")
    words = ("convert", recordings / "healthy_1.nc", target)
    if suffix == "nc" and size == 5000:
        limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))"
        code = f"{limit}; import sys, sealscope.cli; sys.argv[0] = 'sealscope'; sealscope.cli.main()"
        done = shell(sys.executable, "-c", code, *words, PYTHONDONTWRITEBYTECODE="1")
    else:
        with room(size):
            done = call(*words)
    assert done.refused(2).startswith(f"cannot write {target}: ")
    assert [path.name for path in tmp_path.iterdir()] == [target.name]
    assert target.read_text() == "what was there before"


@pytest.mark.slow
def test_a_page_is_whole_or_absent(call, recordings: Path, tmp_path: Path) -> None:
    with room(60_000):
        done = call("report", recordings / "healthy_1.nc", "-o", tmp_path / "page.html")
    assert done.refused(1).startswith(f"cannot write {tmp_path / 'page.html'}: ")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def plan(tmp_path: Path) -> SimulatedPlan:
    (tmp_path / "plan.toml").write_text(PLAN)
    return load_plan(tmp_path / "plan.toml")  # type: ignore[return-value]


def result_of(plan: SimulatedPlan, folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in write_result(judge_simulated_campaign(plan, folder), folder)}


@pytest.mark.long
@pytest.mark.slow
def test_a_campaign_goes_on_when_there_is_room_again(plan: SimulatedPlan, tmp_path: Path) -> None:
    assert run(plan, tmp_path / "whole", jobs=1).complete
    expected, refusals = result_of(plan, tmp_path / "whole"), 0
    for size in range(0, 20_000, 400):
        try:
            with room(size):
                assert run(plan, tmp_path / "full", jobs=1).complete
            break
        except InputError as error:
            refusals += 1
            name = store.HEAD if size == 0 else ROWS
            assert str(error).startswith(f"cannot write {tmp_path / 'full' / name}: ")
            assert not list((tmp_path / "full").glob(".*.part"))
    assert refusals > 5
    assert result_of(plan, tmp_path / "full") == expected
    with room(300), refusal(".csv"):
        result_of(plan, tmp_path / "full")
    assert {name: (tmp_path / "full" / name).read_bytes() for name in expected} == expected


@pytest.mark.slow
@pytest.mark.long
def test_a_clock_that_runs_backwards_changes_no_byte(
    plan: SimulatedPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(plan, tmp_path / "whole", jobs=1).complete
    expected = result_of(plan, tmp_path / "whole")
    now = [2e9]

    def earlier() -> float:
        now[0] -= 3e7
        return now[0]

    monkeypatch.setattr(time, "time", earlier)
    assert run(plan, tmp_path / "back", jobs=1).complete
    assert result_of(plan, tmp_path / "back") == expected


@pytest.mark.slow
def test_a_home_and_a_cache_that_cannot_be_written(call, shell, recordings: Path) -> None:
    """The folders lie below a file, which root cannot write either."""
    nowhere = "/dev/null/home"
    away = {"HOME": nowhere, "XDG_CACHE_HOME": f"{nowhere}/cache", "XDG_CONFIG_HOME": nowhere, "MPLCONFIGDIR": nowhere}
    words = ("inspect", recordings / "healthy_1.nc")
    done = shell("sealscope", *words, **away)
    assert (done.status, done.err) == (0, "")
    assert done.out == call(*words).out
