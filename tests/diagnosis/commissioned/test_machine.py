"""A machine commissioned once judges as the healthy recordings themselves would."""

from __future__ import annotations

import os
import signal
import sys
import tracemalloc
from dataclasses import replace
from datetime import UTC, datetime
from itertools import count
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.machine import JudgedAlarm
from sealscope.diagnosis.commissioned.machine_file import parse_moment
from sealscope.diagnosis.commissioned.summary import MachineSummary, summarise_machine
from sealscope.diagnosis.detectors.registry import comparable_summaries, compare_healthy
from sealscope.diagnosis.healthy import SummarisedRecording
from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.storage.atomic import remove_temporaries

from ...refusals import refusal
from ...representatives import OTHERS
from ...wording import says


def figures(diagnosis: ss.Diagnosis) -> tuple:
    return diagnosis.verdict, diagnosis.score, diagnosis.leak_lpm, diagnosis.bound_lpm, diagnosis.cause


@pytest.mark.parametrize(
    ("leak", "channels", "seed"),
    [
        ("0.02 L/min", None, 10),
        pytest.param("0.05 L/min from 10 s", ("u", "p_A", "p_B"), 11, marks=pytest.mark.slow),
        *(pytest.param(leak, None, 12, marks=OTHERS) for leak in ("none", "0.002 L/min", "0.05 L/min from 10 s")),
        *(pytest.param(leak, ("u", "p_A", "p_B"), 13, marks=OTHERS) for leak in ("none", "0.002 L/min", "0.02 L/min")),
    ],
)
def test_the_file_judges_as_the_recordings_do(healthy, file, leak, channels, seed, request):
    """All methods, with every digit, whichever channels the judged recording has."""
    recording = ss.simulate(command="3 sin(4t)", duration="20 s", leak=leak, seed=seed)
    machine = ss.read_machine(file)
    if channels is not None:
        recording, healthy = recording.only(channels), [own.only(channels) for own in healthy]
        machine = ss.read_machine(request.getfixturevalue("by_pressures"))
    by_file, by_recordings = machine.diagnose(recording), ss.diagnose(recording, healthy, rig="thesis")
    assert figures(by_file) == figures(by_recordings)
    assert [figures_of(part) for part in by_file.parts] == [figures_of(part) for part in by_recordings.parts]


def figures_of(part) -> tuple:
    return part.detector, part.verdict, part.score, part.threshold


@pytest.mark.parametrize(
    ("channels", "needed"),
    [(("p_A", "p_B", "omega"), "needs the position x, or strokes"), (("p_A", "p_B"), "theta or omega")],
)
def test_a_summary_names_what_the_recordings_lack(channels, needed):
    """Not the speed, where it is recorded."""
    units = {name: CHANNEL_UNITS[name] for name in channels}
    recordings = [SummarisedRecording(f"{k}.csv", str(k), units, 50.0, 60.0, None, {}) for k in range(6)]
    assert needed in " ".join(MachineSummary({}, None).text(recordings, None).split())


def test_a_summary_states_a_problem_of_many_recordings_once():
    wrongs = [[f"1 gap, about {400 + k} samples lost", f"x: is stuck {k} times", "x: 3 missing"] for k in range(6)]
    recordings = [
        SummarisedRecording(f"{k}.csv", str(k), {"p_A": "Pa"}, 50.0, 60.0, None, {}, {"wrong": wrong})
        for k, wrong in enumerate(wrongs)
    ]
    problems = summarise_machine(recordings, None).problems
    assert problems == ["1 gap, about 405 samples lost (in 6 of 6)", "x: is stuck 5 times (in 6 of 6)"]


@pytest.mark.slow
def test_the_predicted_smallest_leak_is_what_is_found(machine):
    """Leaks of 1.3 times the size are found, of a third of it hardly ever."""
    smallest = machine.summary.smallest.lpm
    result = {
        share: [
            machine.diagnose(
                ss.simulate(command="3 sin(4t)", duration="20 s", leak=f"{share * smallest:.6g} L/min", seed=seed),
            ).verdict
            == "leak"
            for seed in range(50, 54)
        ]
        for share in (0.2, 1.4)
    }
    assert sum(result[1.4]) >= 3
    assert sum(result[0.2]) <= 1


def test_what_is_learnt_is_the_machine(machine):
    summary = machine.summary
    assert summary.noise["p_A"] == pytest.approx(1.25 * 6894.76, rel=0.2)
    assert summary.problems == []
    assert str(machine).count("\n") < 18  # the limit that it proposes takes three lines


@pytest.mark.slow
def test_a_recording_that_is_not_like_the_others_is_named(folder, tmp_path):
    leaking = tmp_path / "bad.nc"
    ss.write(ss.simulate(command="3 sin(4t)", duration="20 s", leak="0.1 L/min", seed=9), leaking)
    machine = ss.commission([*sorted(folder.iterdir()), leaking], rig="thesis")
    assert any(problem.startswith("bad.nc: leak by the others") for problem in machine.summary.problems)


@pytest.mark.slow
def test_a_zero_below_vacuum_and_glitches_are_named(folder, tmp_path):
    recording = ss.read(folder / "run1.nc")
    omega = recording["omega"].copy()
    omega[::100] += 3e4  # more than single spikes, which are left out
    wrong = ss.Recording(
        recording.t,
        {**recording.channels, "p_B": recording["p_B"] - 8e5, "omega": omega},
        dict(recording.units),
        recording.rate,
    )
    ss.write(wrong, tmp_path / "wrong.nc")
    problems = " ".join(ss.commission(tmp_path / "wrong.nc", rig="thesis").summary.problems)
    assert "p_B reads below vacuum" in problems
    assert "omega has glitches" in problems


@pytest.mark.slow
def test_the_summary_has_the_units_of_the_log(folder, tmp_path):
    """Pressures in psi, rounded and repeated; a speed without a sign is named once, and no fault of a recording."""
    for path in sorted(folder.iterdir())[:2]:
        recording = ss.read(path)
        psi = [np.repeat(np.round(recording[name][::5] / 6894.757, 1), 5) for name in ("p_A", "p_B")]
        rows = [recording.t, *psi, recording["x"] / 0.0254, np.abs(recording["omega"]) * 30.0 / np.pi]
        header = "t_s,pA_psi,pB_psi,x_in,n_rpm"
        np.savetxt(
            tmp_path / f"{path.stem}.csv", np.transpose(rows), delimiter=",", header=header, comments="", fmt="%.7g"
        )
    machine = ss.commission(tmp_path, map="auto", rig="thesis")
    text = str(ss.read_machine(ss.write_machine(machine, tmp_path / "press.toml")))
    rows = {line[:16].strip(): line[16:] for line in text.splitlines()}
    assert {*rows["channels"].split(", ")} == {"p_A [psi]", "p_B [psi]", "x [in]", "omega [rpm]"}
    assert "psi between the chambers" in rows["duty"]
    noise = {word.split()[0]: float(word.split()[1]) for word in rows["noise"].split(", ")}
    assert noise["p_A"] >= 0.028  # not below the rounding
    assert any("has no sign" in problem for problem in machine.summary.problems)


@pytest.mark.slow
def test_a_recording_is_added_once_and_never_a_leaking_one(machine, folder):
    new = ss.simulate(command="3 sin(4t)", duration="20 s", seed=30)
    assert len(machine.with_healthy(new).healthy) == 4
    with refusal("new"):
        machine.with_healthy(ss.read(folder / "run1.nc"))
    with refusal("leak"):
        machine.with_healthy(ss.simulate(command="3 sin(4t)", duration="20 s", leak="0.1 L/min", seed=31))


@pytest.mark.slow
def test_the_date_in_a_file_s_name_is_that_of_its_summary(machine):
    new = replace(ss.simulate(command="3 sin(4t)", duration="20 s", seed=32), provenance={})
    taught = machine.with_healthy(new, file="press_20240531.csv")
    assert [own.file for own in taught.since(1.7171e9).healthy] == ["press_20240531.csv"]


def test_what_was_left_out_is_known_whenever_the_file_is_written(folder, tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "good.nc").write_bytes((folder / "run1.nc").read_bytes())
    (tmp_path / "runs" / "torn.csv").write_text("no recording")
    machine = ss.commission(tmp_path / "runs", rig="thesis")
    assert "torn.csv" in machine.left_out[0]
    path = ss.write_machine(machine, tmp_path / "machine.toml")
    again = ss.read_machine(path)
    assert (again.left_out, again.summary.problems) == (machine.left_out, machine.summary.problems)
    ss.write_machine(again, path)
    assert ss.read_machine(path).summary.problems == machine.summary.problems


@pytest.mark.parametrize(
    "starts",
    [
        ((-10.0, False), (3590.0, False), (3601.0, True)),
        pytest.param(((-60.0, True), (60.0, False)), marks=OTHERS),
    ],
)
def test_a_recording_in_which_a_found_leak_begins_or_is_repaired_is_not_taught(machine, starts):
    new = ss.simulate(command="3 sin(4t)", duration="20 s", seed=33).only(("x", "theta", "p_A", "p_B"))
    onset = 1.7171e9
    repaired = JudgedAlarm("a-1", "repaired", onset + 3600.0, onset)
    alarms = (JudgedAlarm("a-1", "valid", onset + 60.0, onset), repaired)
    known = replace(machine, alarms=alarms, healthy=machine.healthy[:2])
    for start, taught in starts:
        moment = datetime.fromtimestamp(onset + start, UTC).replace(tzinfo=None)
        recording = replace(new, provenance={"start": moment.isoformat()})
        if taught:
            assert len(known.with_healthy(recording).healthy) == 3
        else:
            with refusal("leak"):
                known.with_healthy(recording)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="names of files are bytes as POSIX has them")
def test_a_file_whose_name_is_no_text_is_kept_by_its_escaped_name(folder, tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "a\udcff.nc").write_bytes((folder / "run1.nc").read_bytes())
    path = ss.write_machine(ss.commission(tmp_path / "runs", rig="thesis"), tmp_path / "machine.toml")
    assert [own.file for own in ss.read_machine(path).healthy] == ["a\\udcff.nc"]


def test_a_temperature_that_is_not_read_is_named_when_a_machine_is_commissioned(healthy, tmp_path):
    recording = healthy[0]
    columns = [recording.t, *(recording[name] for name in ("p_A", "p_B", "x", "omega")), np.full(len(recording), 41.5)]
    head = "t [s],p_A [Pa],p_B [Pa],x [m],omega [rad/s],TT101 [degC]"
    np.savetxt(tmp_path / "run.csv", np.column_stack(columns), delimiter=",", header=head, comments="")
    by_names = {name: name for name in ("p_A", "p_B", "x", "omega")}
    unread = ss.commission(tmp_path, map=by_names)
    assert any("TT101" in problem for problem in unread.summary.problems)
    read = ss.commission(tmp_path, map={"*": "auto"})
    assert not any("TT101" in problem for problem in read.summary.problems)
    assert read.healthy[0].about["oil_degC"] == 41.5


def test_a_map_that_no_recording_fits_is_refused(healthy, tmp_path):
    """Its pressures would be read without it, and whatever else it names would be lost."""
    columns = [healthy[0].t, *(healthy[0][name] for name in ("p_A", "p_B", "x"))]
    head = "t [s],p_A [Pa],p_B [Pa],Weg [m]"
    np.savetxt(tmp_path / "day.csv", np.column_stack(columns), delimiter=",", header=head, comments="")
    for wrong, word in (("Weg*p_A", "unit of length"), ("Lage", "Lage")):
        with refusal(word):
            ss.commission(tmp_path, map={"p_A": "p_A", "p_B": "p_B", "x": wrong})
    assert "x" in ss.commission(tmp_path, map={"p_A": "p_A", "p_B": "p_B", "x": "Weg"}).healthy[0].units


@pytest.mark.slow
def test_files_of_one_name_in_several_folders_are_told_apart(healthy, tmp_path):
    for day, recording in enumerate((*healthy, ss.simulate(command="3 sin(4t)", duration="20 s", seed=4)), start=1):
        place = tmp_path / f"day{day}"
        place.mkdir()
        ss.write(recording, place / "run.nc")
    machine = ss.commission(sorted(tmp_path.rglob("run.nc")))
    assert sorted(entry.file for entry in machine.healthy) == [f"day{day}/run.nc" for day in range(1, 5)]
    assert not machine.left_out


def test_a_machine_without_recordings_says_so():
    assert "0 healthy" in str(ss.CommissionedMachine("a", ()))


def test_the_map_of_raw_counts_goes_with_the_machine(folder, tmp_path):
    """A log of another program, in counts of its converter, is read by the machine's file alone."""
    recording = ss.read(folder / "run1.nc")
    rows = np.column_stack([recording.t, recording["p_A"] / 1e5 / 0.0625 + 10, recording["p_B"] / 1e5, recording["u"]])
    log = tmp_path / "log.csv"
    np.savetxt(log, rows, delimiter=",", header="time,ch2,p_rod_bar,volts", comments="", fmt="%.12g")
    columns = {"t": "time s", "p_A": "ch2*0.0625-0.625 bar", "p_B": "p_rod_bar", "u": "volts V"}
    machine = ss.commission(log, rig="thesis", map=columns)
    ss.write_machine(machine, tmp_path / "counts.toml")
    again = ss.read_machine(tmp_path / "counts.toml").read(log)
    np.testing.assert_allclose(again["p_A"], recording["p_A"], rtol=1e-9, atol=1.0)


def write_and_die(machine: ss.CommissionedMachine, path: Path, step: int) -> None:
    """Write a machine's file, and be killed at its `step`-th access to a file of that folder."""
    steps = count()

    def die_in_time(event: str, args: tuple[object, ...]) -> None:
        is_access = event in ("open", "os.rename", "os.remove", "os.link", "os.chmod")
        if is_access and str(path.parent) in str(args) and next(steps) == step:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(die_in_time)
    ss.write_machine(machine, path)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills as POSIX does")
def test_a_file_is_whole_at_whichever_access_its_writer_is_killed(machine, tmp_path):
    """After each kill the file and the one that it replaced are of one of the two machines."""
    path = tmp_path / "actuator7.toml"
    machines = [replace(machine, name=f"with {n}", healthy=machine.healthy[:n]) for n in (1, 2)]
    for written in machines:
        ss.write_machine(written, path)
    known = {(written.name, len(written.healthy)) for written in machines}
    whole: set[tuple[bytes, bytes]] = set()  # contents that were read
    begun = 0  # kills that left a file that was begun
    for step in count():
        writer = get_context("fork").Process(target=write_and_die, args=(machines[step % 2], path, step))
        writer.start()
        writer.join()
        begun += any(tmp_path.glob(".*.part"))
        remove_temporaries(tmp_path)
        for file in (path, path.with_suffix(".toml.bak")):
            contents = file.read_bytes(), path.with_suffix(".healthy").read_bytes()
            if contents not in whole:
                read = ss.read_machine(file)
                assert (read.name, len(read.healthy)) in known
                whole.add(contents)
        if writer.exitcode == 0:
            break
    assert step > 5 and begun
    assert sorted(each.name for each in tmp_path.glob("[!.]*")) == [
        "actuator7.healthy",
        "actuator7.toml",
        "actuator7.toml.bak",
    ]


HOSTILE = {
    "format = 3": ("format = 2", "machine.format"),
    'name = "actuator7"': ("name = 7", "machine.name"),
    'summary = "': ('summary = "g', "healthy[1].summary"),
    'file = "run1.nc"': ("file = 3", "healthy[1].file"),
    "\n[[healthy]]\n": ("\n[[healthy]\n", "must be TOML"),
}


@pytest.mark.parametrize("part", HOSTILE)
def test_a_hostile_file_is_refused_in_one_line(file, tmp_path, part):
    wrong, rule = HOSTILE[part]
    text = file.read_text()
    assert part in text
    path = tmp_path / "hostile.toml"
    path.write_text(text.replace(part, wrong, 1))
    with pytest.raises(InputError) as caught:
        ss.read_machine(path)
    assert rule in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "hostile.toml" in str(caught.value)


def test_a_machine_s_file_is_a_rig_s(file, machine):
    rig = ss.load_rig(file)
    assert rig == machine.rig
    assert ss.read_machine(file).rig == machine.rig


@pytest.fixture(scope="module")
def usual(machine):
    """The diagnosis of another healthy recording under the usual duty."""
    return machine.diagnose(ss.simulate(command="3 sin(4t)", duration="20 s", seed=70))


def test_a_duty_that_no_healthy_recording_had_is_named(machine, usual):
    """Its interval is wider, and the reason says of what."""
    faster = machine.diagnose(ss.simulate(command="5 sin(4t)", duration="20 s", seed=70))
    assert not says(usual.reason, "remark.speed beyond")
    assert says(faster.reason, "remark.speed beyond", ratio=1.7)
    assert faster.bound_lpm > 2.0 * usual.bound_lpm


def test_another_actuator_is_named_and_is_no_leak(machine, usual):
    """A piston 15 % larger: not the machine of the file; the same machine is not suspected."""
    larger = {"cylinder.A_A": "728 mm^2", "cylinder.A_B": "728 mm^2"}
    another = machine.diagnose(ss.simulate(command="3 sin(4t)", duration="20 s", set=larger, seed=70))
    assert (usual.verdict, usual.cause) == ("no leak", None)
    assert another.verdict != "leak" and another.cause == "sensor fault"
    assert "scale of its position or speed changed (motion" in another.reason


@pytest.mark.long
@pytest.mark.slow
def test_what_would_not_be_read_again_is_not_written(machine, tmp_path):
    """Marks grow a text up to the limit that all its readers have, within ten times its size in memory."""
    path = ss.write_machine(machine, tmp_path / "press.toml")
    long = JudgedAlarm("press-0", "repaired", 1.7e9, 1.7e9, reason="x" * 9000)
    with refusal("1000000 bytes"):
        ss.write_machine(replace(machine, alarms=(long,) * 111), path)
    assert ss.read_machine(path).alarms == ()
    ss.write_machine(replace(machine, alarms=(long,) * 105), path)
    assert len(ss.read_machine(path).alarms) == 105
    marks = tuple(JudgedAlarm(f"press-{k}", "repaired", 1.7e9 + k, 1.7e9 + k) for k in range(1500))
    ss.write_machine(replace(machine, alarms=marks), path)
    assert len(ss.read_machine(path).alarms) == 1500 and ss.load_rig(path) == machine.rig  # caches are filled
    tracemalloc.start()
    try:
        assert len(ss.read_machine(path).alarms) == 1500
        assert ss.load_rig(path) == machine.rig
        assert tracemalloc.get_traced_memory()[1] < 10 * path.stat().st_size
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("text", ["2026-03-01T06:30:00", "2026-03-01 07:30+01:00", "2026-03-01T06:30:00Z"])
def test_a_time_without_a_zone_is_utc(text: str) -> None:
    # as on a computer of any time zone: local time would differ between the engineer's desk and the machine
    assert parse_moment(text) == datetime(2026, 3, 1, 6, 30, tzinfo=UTC).timestamp()


def test_recordings_whose_rates_differ_by_rounding_are_compared_with_each_other(file):
    """The least error of a clock made of a machine's null one without comparisons."""
    healthy = list(ss.read_machine(file).healthy)
    assert len(list(compare_healthy(comparable_summaries(healthy)))) == len(healthy)
    for factor, compared in ((1.0 + 1e-12, len(healthy)), (1.0 - 5e-4, len(healthy)), (1.01, 0)):
        ringing = healthy[1].summaries["rms change"]
        summaries = {**healthy[1].summaries, "rms change": {**ringing, "rate": factor * ringing["rate"]}}
        others = [healthy[0], replace(healthy[1], summaries=summaries), *healthy[2:]]
        assert len(list(compare_healthy(comparable_summaries(others)))) == compared
