"""Two processes that change a machine's file at once lose nothing of each other's."""

from __future__ import annotations

import multiprocessing
import os
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.machine import JudgedAlarm
from sealscope.diagnosis.commissioned.machine_file import update_machine
from sealscope.monitor.alarms import Alarm
from sealscope.monitor.database.machine_files import record_mark

from ...refusals import refusal


def run(seed: int) -> ss.Recording:
    recording = ss.simulate(command="3 sin(4t)", duration="6 s", rate="100 Hz", seed=seed)
    return replace(recording, provenance={})


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The two files of a machine, by name."""
    folder = tmp_path_factory.mktemp("healthy")
    for seed in (1, 2):
        ss.write(run(seed), folder / f"run{seed}.nc")
    file = ss.write_machine(ss.commission(folder), folder / "press.toml")
    return {each.name: each.read_bytes() for each in (file, file.with_suffix(".healthy"))}


def place(pair: dict[str, bytes], folder: Path) -> Path:
    for name, data in pair.items():
        (folder / name).write_bytes(data)
    return folder / "press.toml"


def add(path: Path, seed: int) -> None:
    recording = run(seed)
    update_machine(path, lambda machine: machine.with_healthy(recording, file=f"run{seed}.nc"))


def mark(path: Path, number: int) -> None:
    span, words = (1.68e9, 1.695e9), ("piston leak", "the balance", "the seal")
    alarm = Alarm(f"press-{number}", "press", "error", "new", 1.7e9, 1.7e9, 1.69e9, span, 0.01, None, *words, 1)
    done = record_mark(str(path), alarm, "valid", [])
    assert done == "press.toml: mark stored", done


def work(pipe: Connection, path: Path) -> None:
    """Carry out what comes, and answer with the error, if any."""
    for task, argument in iter(pipe.recv, None):
        try:
            {"add": add, "mark": mark}[task](path, argument)
            pipe.send("")
        except Exception as error:
            pipe.send(repr(error))


def attack(pair: dict[str, bytes], folder: Path, rounds: int) -> None:
    """Each round: two recordings are added and an alarm is marked, by three processes at once."""
    context, path = multiprocessing.get_context("fork"), folder / "press.toml"
    pipes = []
    for _ in range(3):
        here, there = context.Pipe()
        process = context.Process(target=work, args=(there, path), daemon=True)
        process.start()
        pipes.append((here, process))
    for number in range(rounds):
        place(pair, folder)
        tasks = [("add", 10), ("add", 11), ("mark", number)]
        for (pipe, _), task in zip(pipes, tasks, strict=True):
            pipe.send(task)
        assert [pipe.recv() for pipe, _ in pipes] == ["", "", ""]
        machine = ss.read_machine(path)
        assert {learnt.file for learnt in machine.healthy} == {"run1.nc", "run2.nc", "run10.nc", "run11.nc"}
        assert [alarm.alarm for alarm in machine.alarms] == [f"press-{number}"]
    for pipe, process in pipes:
        pipe.send(None)
        process.join()


needs_fork = pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="forks as POSIX does")


@needs_fork
@pytest.mark.parametrize(
    "rounds", [pytest.param(1, marks=pytest.mark.slow), pytest.param(500, marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_two_added_recordings_and_a_mark_at_once_are_all_there(pair, tmp_path, rounds):
    attack(pair, tmp_path, rounds)


def test_what_another_wrote_since_is_not_undone(pair, tmp_path):
    path = place(pair, tmp_path)
    machine = ss.read_machine(path)
    mark(path, 1)
    before = path.read_bytes()
    with refusal("press-1"):
        ss.write_machine(replace(machine, limit="5 mL/min"), path)
    assert path.read_bytes() == before


def test_a_recording_that_was_taken_out_since_does_not_come_back(pair, tmp_path):
    path = place(pair, tmp_path)
    machine = ss.read_machine(path)
    update_machine(path, lambda known: replace(known, healthy=known.healthy[1:]))
    with refusal("run1.nc"):
        ss.write_machine(machine, path)


def test_an_edited_text_is_not_undone(pair, tmp_path):
    path = place(pair, tmp_path)
    machine = ss.read_machine(path)
    path.write_text(path.read_text().replace('name = "machine"', 'name = "press 7"'))
    with refusal("statement"):
        ss.write_machine(machine, path)


def test_a_machine_may_be_written_again_and_again(pair, tmp_path):
    """Its own changes are no other's; a machine that was never read replaces what is there."""
    path = place(pair, tmp_path)
    machine = ss.read_machine(path)
    alarms = [JudgedAlarm(f"press-{k}", "valid", 1.7e9, 1.69e9) for k in range(3)]
    for count in range(1, 4):
        ss.write_machine(replace(machine, alarms=tuple(alarms[:count])), path)
    assert len(ss.read_machine(path).alarms) == 3
    ss.write_machine(replace(machine, origin=None), path)
    assert ss.read_machine(path).alarms == ()


def test_a_writer_that_does_not_end_is_waited_for_a_while(pair, tmp_path, monkeypatch):
    from sealscope.diagnosis.commissioned import machine_file
    from sealscope.storage.folders import lock_file

    path = place(pair, tmp_path)
    monkeypatch.setattr(machine_file, "_LONGEST_WAIT", 0.05)
    with lock_file(tmp_path / ".press.toml.lock", "busy"), refusal("process"):
        ss.write_machine(ss.read_machine(path), path)


def test_a_change_that_fails_leaves_the_file(pair, tmp_path):
    path = place(pair, tmp_path)
    with refusal("new"):
        update_machine(path, lambda machine: machine.with_healthy(run(1), file="run1.nc"))
    assert path.read_bytes() == pair["press.toml"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root may give files away")
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4, 5))])
def test_files_of_a_machine_keep_owner_and_mode_whoever_changes_them(seed: int, pair):
    """Root adds a recording or a mark to a machine of another user, who can go on reading, writing and locking it."""
    random = np.random.default_rng(seed)
    user, group = (int(number) for number in random.integers(10_000, 60_000, 2))
    mode = int(random.choice([0o600, 0o640, 0o660, 0o644]))
    with TemporaryDirectory() as name:  # not `tmp_path`, which is root's alone
        folder = Path(name)
        path = place(pair, folder)
        for file in (folder, *folder.iterdir()):
            os.chown(file, user, group)
            file.chmod(0o755 if file == folder else mode)
        if random.random() < 0.5:  # files that an earlier version left to root, open to all
            for file in (path.with_suffix(".toml.bak"), folder / ".press.toml.lock"):
                file.write_bytes(b"")
        before = os.umask(int(random.choice([0o022, 0o077])))
        try:
            add(path, 3) if random.random() < 0.5 else mark(path, 1)
        finally:
            os.umask(before)
        files = sorted(folder.iterdir())
        assert {file.suffix for file in files} == {".toml", ".healthy", ".bak", ".lock"}
        for file in files:
            status = file.stat()
            assert (status.st_uid, status.st_gid, status.st_mode & 0o777) == (user, group, mode), file.name
        if not all(parent.stat().st_mode & 0o001 for parent in Path(ss.__file__).resolve().parents):
            pytest.skip("owner and mode stay; whether another user goes on needs a package that others can read")
        child = os.fork()
        if child == 0:
            exit_status = 1
            try:
                os.setgid(group)
                os.setuid(user)
                mark(path, 2)
                exit_status = 0
            finally:
                os._exit(exit_status)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert "press-2" in path.read_text()
