"""`sealscope commission`, and a folder judged by `--machine`."""

from __future__ import annotations

import os
from shutil import copytree

import numpy as np
import pytest

import sealscope as ss


def record_press(seed, **options):
    """15 s of a machine whose logger has no command: nothing is fitted to what the pressures make of one."""
    recording = ss.simulate(command="3 sin(4t)", duration="15 s", seed=seed, **options)
    return recording.only(name for name in recording.channels if name != "u")


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("healthy")
    for seed in range(1, 4):
        ss.write(record_press(seed), folder / f"run{seed}.nc")
    return folder


@pytest.fixture(scope="module")
def commissioned(healthy, tmp_path_factory):
    """The folder of a machine's file, `m.toml`, and of what it was taught."""
    file = tmp_path_factory.mktemp("commissioned") / "m.toml"
    return ss.write_machine(ss.commission(healthy, rig="thesis", limit="3 mL/min"), file).parent


@pytest.fixture
def file(commissioned, tmp_path):
    """A copy of the machine's file."""
    copytree(commissioned, tmp_path, dirs_exist_ok=True)
    return tmp_path / "m.toml"


def test_a_folder_is_judged_a_line_a_recording(call, healthy, tmp_path):
    file, suspect = tmp_path / "actuator7.toml", tmp_path / "suspect"
    suspect.mkdir()
    done = call("commission", healthy, "-o", file, "--rig", "thesis", "--limit", "3 mL/min")
    assert (done.status, done.err) == (0, "")
    assert "smallest leak" in done.out
    assert max(map(len, done.out.splitlines()[1:])) <= 80
    ss.write(record_press(8), suspect / "good.nc")
    ss.write(record_press(9, leak="0.05 L/min"), suspect / "bad.nc")
    (suspect / "page.html").write_text("Sealscope's own")
    done = call("diagnose", suspect, "--machine", file, "--fail-on", "leak")
    assert done.status == 3
    lines = [line for line in done.out.splitlines() if not line.startswith(" ")]
    assert [line.split()[0] for line in lines] == ["bad.nc", "good.nc"]
    assert " leak " in lines[0]
    assert "L/min (" in lines[0]
    assert "none above" in lines[1]
    assert max(map(len, done.out.splitlines())) <= 90


@pytest.mark.slow
def test_a_folder_gets_a_page_of_its_machine(call, file, tmp_path):
    page, suspect = tmp_path / "page.html", tmp_path / "suspect"
    suspect.mkdir()
    ss.write(record_press(8), suspect / "run_2026-03-01.nc")
    leaking = record_press(9, leak="0.05 L/min")
    ss.write(leaking, suspect / "a_2026-04-01.nc")
    (suspect / "bad.csv").write_text("no recording")
    done = call("report", suspect, "--machine", file, "-o", page)
    assert done.status == 1
    assert "bad.csv" in done.err
    text = page.read_text()
    assert "a_2026-04-01.nc, 2026-04-01" in text  # the newest by its date, not by its name
    assert "1 file that could not be read" in text
    assert text.index("none above") > text.index("Leak: oil bypasses the piston")
    assert "--join cannot be combined" in call("report", suspect, "--join", "--machine", file, "-o", page).refused()


def test_a_recording_is_added_and_the_old_file_kept(call, file, tmp_path):
    new, before = tmp_path / "new.nc", file.read_bytes()
    ss.write(record_press(5), new)
    assert "4 healthy" in call("commission", new, "-o", file, "--add").out
    assert (tmp_path / "m.toml.bak").read_bytes() == before
    assert "must be new" in call("commission", new, "-o", file, "--add").refused()
    assert "which exists" in call("commission", new, "-o", file).refused()


def test_what_is_added_after_a_repair_must_have_a_date(call, file, tmp_path):
    """Recordings before it are forgotten, and so are those of which nobody knows."""
    dated, undated = tmp_path / "run_2026-05-01.nc", tmp_path / "new.nc"
    ss.write(record_press(5), dated)
    ss.write(record_press(6), undated)
    refused = call("commission", dated, undated, "-o", file, "--add", "--since", "2026-04-01").refused()
    assert "must have a date, got none of new.nc" in refused
    assert "1 healthy" in call("commission", dated, "-o", file, "--add", "--since", "2026-04-01").out


def test_what_the_machine_states_is_not_stated_twice(call, healthy, file):
    refused = call("diagnose", healthy / "run1.nc", "--machine", file, "--rig", "thesis").refused()
    assert "--rig cannot be combined with --machine" in refused
    refused = call("diagnose", healthy / "run1.nc", "--machine", file, "--rate", "0").refused()
    assert "--rate cannot be combined with --machine" in refused


def write_log(path, recording, temperature):
    """Write a CSV with the headings of a logger, the last one `temperature` (°C) unless it is empty."""
    headings = ["t [s]", "Druck A [bar]", "Druck B [bar]", "Weg [mm]", "Drehzahl [1/min]"]
    scales = {"p_A": 1e-5, "p_B": 1e-5, "x": 1e3, "omega": 30.0 / np.pi}
    columns = [recording.t, *(scale * recording[name] for name, scale in scales.items())]
    if temperature:
        headings.append(temperature)
        columns.append(np.full(len(recording), 41.0))
    np.savetxt(
        path, np.column_stack(columns)[::5], "%.7g", ",", header=",".join(headings), comments="", encoding="utf-8"
    )


def test_a_channel_that_healthy_days_had_and_a_file_lacks_is_found_doubted_and_mapped(call, tmp_path):
    """An entry of [map] that a file lacks leaves `auto` to the others; --map beside --machine adds the column."""
    folder, file, new = tmp_path / "days", tmp_path / "m.toml", tmp_path / "new.csv"
    folder.mkdir()
    for seed in (1, 2):
        write_log(folder / f"day{seed}.csv", record_press(seed), "TT7 [°C]")
    call("commission", folder, "-o", file, "--map", "auto", "--map", "T_oil=TT7 [°C]", "--rig", "thesis")
    line, judge = "T_oil=Wannen [°C]", ("diagnose", new, "--machine", file)
    for heading, options in (("Wannen [°C]", ()), ("Wannen [°C]", ("--map", line)), ("Toil", ())):
        write_log(new, record_press(7), heading)
        (verdict,) = call(*judge, *options, "--format", "jsonl").objects
        missing = [finding for finding in verdict["quality"] if finding["code"] == "missing_channel"]
        assert verdict["verdict"] == "no leak"
        assert "x" not in verdict["unused"]
        if heading == "Toil" or options:
            assert not missing
            continue
        assert [(finding["severity"], finding["channel"]) for finding in missing] == [("warning", "T_oil")]
        assert f"--map '{line}'" in missing[0]["text"]
        assert "T_oil, recorded on healthy days, is missing" in verdict["reason"]
        assert "no leak was found above the bound" in verdict["next_check"]
        assert missing[0]["text"] in " ".join(call(*judge).out.split())
    assert "Wanne7, mapped to T_oil, must be a column" in call(*judge, "--map", "T_oil=Wanne7").refused(1)


def test_one_of_several_actuators_of_a_log_is_commissioned_judged_and_converted(call, tmp_path):
    """The machine's file keeps the group, which --group replaces in one call."""
    recording, file, log = record_press(1), tmp_path / "m.toml", tmp_path / "log.csv"
    headings, columns = ["t [s]"], [recording.t]
    for part in ("Ausleger", "Stiel"):
        headings += [f"{part} Druck Kolben [bar]", f"{part} Druck Stange [bar]", f"{part} Weg [mm]"]
        columns += [recording["p_A"] / 1e5, recording["p_B"] / 1e5, recording["x"] * 1e3]
    headings, columns = [*headings, "Drehzahl [1/min]"], [*columns, recording["omega"] * 30.0 / np.pi]
    np.savetxt(
        log, np.column_stack(columns)[::5], "%.7g", ",", header=",".join(headings), comments="", encoding="utf-8"
    )
    for words in (
        ("inspect", log),
        ("diagnose", log, "--map", "auto"),
        ("convert", log, tmp_path / "a.nc", "--map", "auto"),
    ):
        complaint = call(*words).err
        assert "got those of 2 (ausleger: " in complaint
        assert "--group 'ausleger'" in complaint
    assert "columns of stiel read" in " ".join(call("inspect", log, "--group", "Stiel").out.split())
    call("convert", log, tmp_path / "b.nc", "--group", "Stiel")
    assert ss.read(tmp_path / "b.nc").channels.keys() == {"p_A", "p_B", "x", "omega"}
    assert ss.read(log, group="Stiel").history == ss.read(log, map={"group": "Stiel"}).history
    call("commission", log, "-o", file, "--group", "Stiel")
    assert ss.read_machine(file).channel_map == {"group": "Stiel"}
    assert "Stiel" in ss.read_machine(file).read(log).provenance["columns"]["p_A"]
    other = ss.read_machine(file).read(log, map={"group": "Ausleger"})
    assert "Ausleger" in other.provenance["columns"]["p_A"]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="links as POSIX has them")
def test_a_link_is_written_through(call, commissioned, tmp_path):
    """Whatever reads the file that the link leads to reads what was added."""
    there, new = copytree(commissioned, tmp_path / "there"), tmp_path / "new.nc"
    file, link = there / "m.toml", tmp_path / "link.toml"
    link.symlink_to(file)
    ss.write(record_press(5), new)
    assert "4 healthy" in call("commission", new, "-o", link, "--add").out
    assert link.is_symlink()
    assert len(ss.read_machine(file).healthy) == len(ss.read_machine(link).healthy) == 4
    assert sorted(each.name for each in tmp_path.iterdir()) == ["link.toml", "new.nc", "there"]
    assert call("diagnose", new, "--machine", link).status == 0
    link.unlink()
    link.symlink_to(link)
    assert "must be readable, got" in call("commission", new, "-o", link, "--add").refused()


def test_damaged_summaries_are_one_line_of_every_command(call, healthy, file, tmp_path):
    """And no verdict: what is not compared with them is not `no leak`."""
    summaries = tmp_path / "m.healthy"
    summaries.write_bytes(summaries.read_bytes().replace(b'"rate":500.0', b'"rate":5000.0', 1))
    run = healthy / "run1.nc"
    for words in (
        ("diagnose", run, "--machine", file),
        ("commission", run, "-o", file, "--add"),
        ("trend", healthy, "--machine", file),
        ("report", healthy, "--machine", file, "-o", tmp_path / "page.html"),
        ("plan", "--machine", file, "--find", "0.01 L/min"),
    ):
        refused = call(*words).refused()
        assert "the summary of run1.nc must have the SHA-256" in refused
        assert "commission it anew" in refused
