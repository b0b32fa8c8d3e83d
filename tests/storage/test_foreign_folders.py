"""A folder of results from outside: whatever is a link in it, nothing outside is written, emptied or removed."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from sealscope.campaigns.execution import store
from sealscope.campaigns.execution.run import run
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.reader import load_plan
from sealscope.errors import UnreadableFile
from sealscope.storage.atomic import atomic_write, remove_temporaries
from sealscope.storage.opening import open_inner, open_regular
from sealscope.storage.rows import LOCK, ROWS
from sealscope.thesis.engine.build import reproduce

from ..refusals import refusal

PLAN = """
[campaign]
name = "linked"
duration = "6 s"
detectors = ["sign rule: d3 of p_A fell"]
keep_recordings = true

[[records]]
count = 1
"""


@pytest.fixture
def outside(tmp_path: Path) -> Iterator[Path]:
    """A folder with a file, outside the folder of results; both must stay as they are."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "diary.txt").write_text("what was there before\n")
    yield folder
    assert [path.name for path in folder.iterdir()] == ["diary.txt"]
    assert (folder / "diary.txt").read_text() == "what was there before\n"


@pytest.fixture
def plan(tmp_path: Path) -> SimulatedPlan:
    (tmp_path / "plan.toml").write_text(PLAN)
    return load_plan(tmp_path / "plan.toml")  # type: ignore[return-value]


@pytest.mark.parametrize("name", [LOCK, ROWS, store.HEAD])
@pytest.mark.parametrize("kind", ["link", "link to nothing", "hard link"])
def test_a_campaign_follows_no_link(name: str, kind: str, plan: SimulatedPlan, outside: Path, tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    folder.mkdir()
    if kind == "hard link":
        os.link(outside / "diary.txt", folder / name)
    else:
        (folder / name).symlink_to(outside / ("diary.txt" if kind == "link" else "new.txt"))
    with refusal(name):
        run(plan, folder, jobs=1)


def test_a_campaign_writes_no_recording_through_a_linked_folder(
    plan: SimulatedPlan, outside: Path, tmp_path: Path
) -> None:
    (tmp_path / "campaign").mkdir()
    (tmp_path / "campaign" / "recordings").symlink_to(outside)
    with refusal("link", "recordings"):
        run(plan, tmp_path / "campaign", jobs=1)


@pytest.mark.parametrize("name", ["rows.jsonl", "campaign.json", ".lock"])
def test_a_pipe_in_a_folder_is_not_waited_for(name: str, plan: SimulatedPlan, tmp_path: Path) -> None:
    (tmp_path / "campaign").mkdir()
    os.mkfifo(tmp_path / "campaign" / name)
    with refusal("pipe"):
        run(plan, tmp_path / "campaign", jobs=1)


@pytest.mark.parametrize("name", ["kept", "kept/runs", "kept/.lock", "kept/rows.jsonl"])
def test_a_reproduction_follows_no_link(name: str, outside: Path, tmp_path: Path) -> None:
    path = tmp_path / "thesis" / name
    path.parent.mkdir(parents=True)
    path.symlink_to(outside / "diary.txt" if name.endswith((".lock", ".jsonl")) else outside)
    with refusal("link"):
        reproduce(["table-5.1"], tmp_path / "thesis", jobs=1)


@pytest.mark.parametrize("name", ["figures", "tables"])
def test_products_go_into_no_linked_folder(name: str, outside: Path, tmp_path: Path) -> None:
    from sealscope.thesis.pages.files import publish

    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / name).symlink_to(outside)
    with refusal("link"):
        publish(None, (), tmp_path / "thesis")  # type: ignore[arg-type]  # the folders are first


@pytest.mark.parametrize("name", ["out.nc", "out.csv", "page.html"])
def test_a_file_to_write_takes_the_place_of_a_link(name: str, outside: Path, tmp_path: Path) -> None:
    """simulate, convert and report write their one file with `atomic_write`."""
    (tmp_path / name).symlink_to(outside / "diary.txt")
    with atomic_write(tmp_path / name) as temporary:
        temporary.write_text("new")
    assert not (tmp_path / name).is_symlink()
    assert (tmp_path / name).read_text() == "new"


def test_a_long_name_of_wide_letters_can_be_written(tmp_path: Path) -> None:
    """A file system limits names in bytes: the temporary file's name is cut in bytes, too."""
    name = "\N{CJK UNIFIED IDEOGRAPH-20000}" * 62 + ".csv"  # 252 bytes
    with atomic_write(tmp_path / name) as temporary:
        temporary.write_text("new")
        assert len(temporary.name.encode()) <= 255
        remove_temporaries(tmp_path, name)  # of this process, which is alive
        assert temporary.exists()
    assert (tmp_path / name).read_text() == "new"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, None])
def test_a_file_that_is_replaced_keeps_its_mode(mode: int | None, tmp_path: Path) -> None:
    """And is private while it is written."""
    path = tmp_path / "out.csv"
    if mode is not None:
        path.touch()
        path.chmod(mode)
    before = os.umask(0o027)
    try:
        with atomic_write(path) as temporary:
            temporary.write_text("new")
            assert temporary.stat().st_mode & 0o777 == 0o600
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == (0o640 if mode is None else mode)


def test_what_is_written_is_on_the_disk_before_its_name_and_the_name_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loss of power cannot be played: what is asked of the system, in its order, says what it could leave."""
    calls: list[tuple[str, str]] = []
    sync, rename = os.fsync, Path.replace

    def synced(number: int) -> None:
        name = Path(f"/proc/self/fd/{number}").readlink().name
        calls.append(("sync", name if name == tmp_path.name else (tmp_path / name).read_text()))
        sync(number)

    def renamed(source: Path, target: Path) -> Path:
        calls.append(("rename", target.name))
        return rename(source, target)

    if not Path("/proc/self/fd").exists():
        pytest.skip("asks Linux for the name of an open file")
    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    with atomic_write(tmp_path / "out.csv") as temporary:
        temporary.write_text("new")
    assert calls == [("sync", "new"), ("rename", "out.csv"), ("sync", tmp_path.name)]


@pytest.mark.parametrize("kind", ["simulated", "recordings"])
@pytest.mark.parametrize("name", ["../up", "a/b", ".hidden", "a" * 81])
def test_a_plan_names_no_folder_elsewhere(kind: str, name: str, tmp_path: Path) -> None:
    more = {
        "simulated": 'duration = "6 s"\ndetectors = ["rms change"]\n[[records]]\ncount = 1',
        "recordings": 'detectors = ["rms change"]\n[recordings]\n[[recordings.sets]]\nfiles = "*.csv"',
    }[kind]
    (tmp_path / "plan.toml").write_text(f'[campaign]\nname = "{name}"\n{more}\n')
    with refusal("name", "80"):
        load_plan(tmp_path / "plan.toml")


def test_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "a pipe"), (tmp_path / "link", "a pipe"), (tmp_path, "a folder")):
        with refusal("plan", kind):
            open_regular(path, "a plan")
    with refusal("device"):
        open_regular("/dev/zero", "a plan")
    with refusal("link"):
        open_inner(tmp_path / "link", "a plan")


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    """As /dev/null would be, by a process that may."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "a pipe"), (tmp_path / "link", "a pipe"), (tmp_path, "a folder")):
        with refusal(kind, path), atomic_write(path):
            pass
    assert (tmp_path / "pipe").is_fifo()
    assert (tmp_path / "link").is_symlink()


def test_readers_do_not_wait_for_a_pipe(tmp_path: Path) -> None:
    from sealscope.parameters import load_rig
    from sealscope.recordings import read

    for name, reader in (("log.csv", read), ("rig.toml", load_rig), ("p.toml", load_plan)):
        os.mkfifo(tmp_path / name)
        with refusal("pipe") as caught:
            reader(tmp_path / name)  # type: ignore[operator]
        assert isinstance(caught.value, UnreadableFile) == (reader is read)


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "out.nc") as temporary:
        alive = temporary.name
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    gone = re.sub(r"-\d+\.", "-999999999.", alive)
    strange = re.sub(r"[0-9a-f]{6}-", "000000-", gone)
    (tmp_path / "inner").mkdir()
    others = [".vimrc.part", "film.part", gone.replace("out.nc", "other.nc"), alive, strange]
    for name in (gone, *others, f"inner/{gone}"):
        (tmp_path / name).touch()
    old = tmp_path / strange.replace("out", "old")
    old.touch()
    os.utime(old, (0, 0))
    remove_temporaries(tmp_path, "out.nc")
    assert {path.name for path in tmp_path.iterdir()} == {*others, "inner", old.name}
    remove_temporaries(tmp_path)
    assert {path.name for path in tmp_path.rglob("*")} == {".vimrc.part", "film.part", alive, strange, "inner"}
