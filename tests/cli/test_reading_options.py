"""Where recordings come from: standard input, columns by the map beside a machine's rig; parameters in 80 columns."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest

import sealscope
from sealscope.parameters import load_rig
from sealscope.parameters.rig import save_channel_map

from ..refusals import refusal

N = 2000
T = np.arange(N) / 500.0
LOG = "Zeit,Druck1,Druck2\n" + "".join(f"{t:.3f},{20 + np.sin(9 * t):.5f},{18 - np.sin(9 * t):.5f}\n" for t in T)
MAP = ("--map", "t=Zeit[s]", "--map", "p_A=Druck1[bar]", "--map", "p_B=Druck2[bar]")
RIG = '# my machine\n[rig]\nextends = "thesis"\nname = "press 4"\n'


@pytest.fixture
def piped(monkeypatch):
    def give(data: bytes) -> None:
        stdin = io.TextIOWrapper(io.BytesIO(data))
        monkeypatch.setattr(sys, "stdin", stdin)

    return give


def test_standard_input_is_read_by_its_content(call, piped, recordings):
    file = recordings / "healthy_1.nc"
    piped(file.read_bytes())
    (result,) = call("diagnose", "-", "--format", "jsonl").objects
    (known,) = call("diagnose", file, "--format", "jsonl").objects
    assert result.pop("file") == "-"
    assert result.items() <= known.items()
    piped(LOG.encode())
    assert call("inspect", "-", *MAP).out.startswith("-: text, comma separated")
    piped(LOG.encode())
    assert call("convert", "-", recordings / "copy.csv", *MAP).status == 0


def test_standard_input_is_read_with_the_map_of_a_machine(call, piped, tmp_path):
    """The file of a commissioned machine states the columns, of a log on standard input, too."""
    (tmp_path / "day.csv").write_text(LOG)
    assert call("commission", tmp_path / "day.csv", "-o", tmp_path / "press.toml", *MAP).status == 0
    piped(LOG.encode())
    (result,) = call("diagnose", "-", "--machine", tmp_path / "press.toml", "--format", "jsonl").objects
    assert result["file"] == "-"


def test_standard_input_that_is_none(call, piped, tmp_path):
    piped(b"nonsense")
    assert "standard input" in call("diagnose", "-").refused(1)
    assert "standard input (-) must be given once, got it 2 times" in call("diagnose", "-", "-").refused(2)
    assert "given once" in call("diagnose", "-", "--baseline", "-", "x.csv").refused(2)


def test_a_map_is_kept_beside_the_rig_and_used_again(call, tmp_path):
    log, rig = tmp_path / "log.csv", tmp_path / "press.toml"
    log.write_text(LOG)
    rig.write_text(RIG)
    assert "be given a map" in call("diagnose", log, "--rig", rig).refused(1)
    assert f"map saved in {rig}" in call("inspect", log, "--rig", rig, *MAP, "--save-map").out
    assert rig.read_text().startswith(RIG)
    assert load_rig(rig).channel_map == {"t": "Zeit[s]", "p_A": "Druck1[bar]", "p_B": "Druck2[bar]"}
    (by_rig,) = call("diagnose", log, "--rig", rig, "--format", "jsonl").objects
    (by_map,) = call("diagnose", log, "--rig", rig, *MAP, "--format", "jsonl").objects
    assert by_rig == by_map
    assert by_rig["rig"]["name"] == "press 4"
    own = tmp_path / "own.csv"  # a recording with channels of its own names needs no map
    assert call("convert", log, own, *MAP).status == 0
    assert call("diagnose", own, "--rig", rig).status == 0
    assert call("diagnose", own, "--rig", rig, "--area", "9 cm^2").status == 0


def test_the_map_that_names_tell_is_kept(call, tmp_path):
    log, rig = tmp_path / "log.csv", tmp_path / "press.toml"
    log.write_text("Zeit [s],PA_bar,Druck B [bar],Weg\ns,,,mm\n" + LOG.split("\n", 1)[1].replace("\n", ",0\n"))
    rig.write_text(RIG)
    assert f"map saved in {rig}" in call("inspect", log, "--rig", rig, "--map", "auto", "--save-map").out
    assert load_rig(rig).channel_map["p_A"] == "PA_bar[bar]"
    assert load_rig(rig).channel_map["p_B"] == "Druck B [bar]"
    words = ("diagnose", log, "--format", "jsonl", "--rig")
    (kept,) = call(*words, rig).objects
    (auto,) = call(*words, rig, "--map", "auto").objects
    assert kept == auto
    later, joined = tmp_path / "a_later.csv", tmp_path / "joined.toml"  # parts may be named in any order
    heading, units, *rows = log.read_text().splitlines()
    times = (f"{float(row.partition(',')[0]) + 4.0:.3f},{row.partition(',')[2]}" for row in rows)
    later.write_text("\n".join([heading, units, *times, ""]))
    for parts in ((log, later), (later, log)):
        joined.write_text(RIG)
        assert "map saved" in call("inspect", "--join", *parts, "--rig", joined, "--map", "auto", "--save-map").out
        assert load_rig(joined).channel_map == load_rig(rig).channel_map
    own = tmp_path / "own.csv"
    assert call("convert", log, own, "--map", "auto").status == 0
    assert "must have a map to save" in call("inspect", own, "--rig", rig, "--map", "auto", "--save-map").refused(2)


def test_another_map_takes_the_place_of_the_first(tmp_path):
    rig = tmp_path / "press.toml"
    rig.write_text(RIG + '\n[map]\np_A = "old"\n\n[pump]\nq_b = { value = 5, unit = "cm^3/rev", source = "plate" }\n')
    save_channel_map(rig, {"p_B": 'a "new" one[bar]'})
    loaded = load_rig(rig)
    assert loaded.channel_map == {"p_B": 'a "new" one[bar]'}
    assert loaded["pump.q_b"] == 5e-6
    assert loaded.with_overrides({"V_1": 5e-5}).as_assumed("nobody said").channel_map == loaded.channel_map
    below = tmp_path / "below.toml"
    below.write_text('[rig]\nextends = "press.toml"\n')
    assert load_rig(below).channel_map == loaded.channel_map


@pytest.mark.parametrize("table", ["map = 3", '[map]\np_A = ""', "[map]\np_A = 4", '[map]\np_A = { a = "b" }'])
def test_a_map_that_is_none(table, tmp_path):
    rig = tmp_path / "press.toml"
    rig.write_text(f"{table}\n{RIG}")
    with refusal("map", "press"):
        load_rig(rig)


def test_where_no_map_can_be_kept(call, tmp_path):
    log, rig = tmp_path / "log.csv", tmp_path / "press.toml"
    log.write_text(LOG)
    rig.write_text(RIG)
    for words in ((*MAP,), ("--rig", rig), ("--map", "auto")):
        assert "--save-map needs --rig" in call("inspect", log, *words, "--save-map").refused(2)
    assert "packaged rig thesis" in call("inspect", log, *MAP, "--rig", "thesis", "--save-map").refused(2)
    assert call("inspect", log, "--map", "p_A=Nichts", "--rig", rig, "--save-map").status == 1
    assert rig.read_text() == RIG
    rig.write_text(RIG + '[map]\np_X = "Druck1"\n')
    assert "p_X" in call("diagnose", log, "--rig", rig).refused(2)


def test_area_displacement_and_limit_are_options(call, recordings):
    words = ("diagnose", recordings / "leak.nc", "--format", "jsonl")
    (result,) = call(*words, "--area", "10 cm^2", "--area", "12 cm^2", "--displacement", "8 cm^3/rev", "--limit",
                    "1 mL/min").objects  # fmt: skip
    assert result["rig"]["area_m2"] == pytest.approx(11e-4)
    assert result["rig"]["displacement_m3_per_rev"] == pytest.approx(8e-6)
    assert result["limit"]["mL_per_min"] == pytest.approx(1.0)
    assert "area" in call(*words, "--area", "10 bar").refused(2)
    assert "given once, or twice" in call(*words, *("--area", "1 cm^2") * 3).refused(2)
    assert "displacement" in call(*words, "--displacement", "3 m").refused(2)
    assert "limit must be a flow or a speed" in call(*words, "--limit", "3").refused(2)


def test_parameters_fit_80_columns(call, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = call("parameters").out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "motor.R_c                  0.73 ohm  winding resistance" in lines
    assert "    Table 4.1; Table 2.1 (winding resistance at ambient)" in lines


def test_a_log_whose_pressures_bear_other_names_says_which_map_would_read_them(call, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("t [s],u [V],Druck A [bar],Druck B [bar]\n" + "".join(f"{t:.3f},1,20,18\n" for t in T[:400]))
    (line,) = call("diagnose", log, "--format", "jsonl").objects
    assert "map auto would also read p_A=Druck A [bar], p_B=Druck B [bar]" in line["reason"]
    (line,) = call("diagnose", log, "--map", "auto", "--format", "jsonl").objects
    assert "map auto" not in line["reason"]


def test_a_long_log_is_cut_into_parts_which_the_trend_follows(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = sealscope.simulate(command="3 sin(4t)", duration="30 s", leak="0.0042 L/min from 15 s", seed=1)
    sealscope.write(run, "long.csv")
    done = call("convert", "long.csv", "parts", "--every", "10 s")
    assert done.status == 0
    assert done.out.splitlines()[-1] == "parts: 3 parts, 15000 samples"
    names = sorted(path.name for path in (tmp_path / "parts").iterdir())
    assert names == [f"long_{k:04d}.nc" for k in (1, 2, 3)]
    second = sealscope.read("parts/long_0002.nc")
    assert second.t[0] == 10.0
    assert (second["p_A"] == run["p_A"][5000:10000]).all()
    done = call("convert", "long.csv", "parts", "--every", "10 s")
    assert done.status == 2
    assert "TARGET must be a new or empty folder" in done.err
    assert call("trend", "parts", "--every", "20 s", "-o", "trend.html").status == 0
