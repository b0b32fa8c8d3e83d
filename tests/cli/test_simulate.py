"""`sealscope simulate`: what is asked for is what is recorded, and the truth goes to a file of its own."""

from __future__ import annotations

import json

import numpy as np
import pytest

import sealscope


def test_a_setting_reaches_the_recording(call, tmp_path):
    for name, words in (("plain.nc", ()), ("set.nc", ("--set", "p_charge=5[bar]", "--set", "sample_rate=250"))):
        done = call("simulate", "-o", tmp_path / name, "--duration", "4", *words)
        assert (done.status, done.err) == (0, "")
    plain, changed = (sealscope.read(tmp_path / name) for name in ("plain.nc", "set.nc"))
    assert (plain.rate, len(plain)) == (500, 2000)
    assert (changed.rate, len(changed)) == (250, 1000)
    assert changed["p_A"].mean() - plain["p_A"].mean() == pytest.approx(2e5, rel=0.05)
    asked = changed.provenance["experiment"]["overrides"]
    assert set(asked) == {"fluid.p_charge", "daq.sample_rate"}
    assert float(asked["fluid.p_charge"].split()[0]) == 5e5


def test_python_and_the_command_give_the_same_bytes(call, tmp_path):
    done = call(
        "simulate", "-o", tmp_path / "one.nc", "--duration", "4[s]", "--command", "2 sin(3t)", "--seed", 11, "--leak",
        "0.01 L/min from 2 s", "--start-position", "50[mm]", "--set", "V_1=60[cm^3]",
    )  # fmt: skip
    assert done.status == 0
    made = sealscope.simulate(
        command="2 sin(3t)", duration=4.0, seed=11, leak="0.01 L/min from 2 s", x_0=0.05, set={"V_1": "60[cm^3]"}
    )
    read = sealscope.read(tmp_path / "one.nc")
    assert read["x"][0] == pytest.approx(0.05, abs=1e-3)
    for name in made.channels:
        assert np.array_equal(read[name], made[name]), name


def test_two_leaks_and_the_truth_about_them(call, tmp_path):
    done = call(
        "simulate", "-o", tmp_path / "run.csv", "--duration", 12, "--leak", "0.01 L/min from 8 s", "--leak",
        "0.02 L/min orifice growing from 4 s to 6 s", "--truth", tmp_path / "truth.json",
    )  # fmt: skip
    assert (done.status, done.err) == (0, "")
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["onset_s"] == 4.0
    assert [item["law"] for item in truth["leaks"]] == ["laminar", "orifice"]
    assert [item["opening"] for item in truth["leaks"]] == ["from 8 s", "growing from 4 s to 6 s"]
    assert all(item["coefficient"] > 0 for item in truth["leaks"])
    assert truth["mean_leak_lpm"] == pytest.approx(0.03, rel=3e-3)
    assert f"mean leak while open: {truth['mean_leak_lpm']:.5g} L/min" in done.out
    assert done.out.count("leak: ") == 2
    assert "onset" not in (tmp_path / "run.csv").read_text().splitlines()[0].lower()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.csv", "truth.json"]


def test_a_run_without_a_leak_says_so_in_its_truth(call, tmp_path):
    done = call(
        "simulate", "-o", tmp_path / "run.nc", "--duration", 2, "--leak", "none", "--truth", tmp_path / "t.json"
    )
    assert done.status == 0
    assert json.loads((tmp_path / "t.json").read_text()) == {"onset_s": None, "mean_leak_lpm": 0.0, "leaks": []}
    assert "leak:" not in done.out
    assert "mean leak" not in done.out


def test_the_seed_alone_tells_the_noise(call, tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert call("simulate", "-o", tmp_path / f"{name}.nc", "--duration", 2, "--seed", seed).status == 0
    item, same, other = ((tmp_path / f"{name}.nc").read_bytes() for name in "abc")
    assert item == same
    assert item != other


def test_a_command_from_a_file(call, tmp_path):
    (tmp_path / "command.csv").write_text("t [s],u [V]\n0,0\n1,2\n3,-2\n4,0\n")
    done = call("simulate", "-o", tmp_path / "run.nc", "--duration", 4, "--command", f"file {tmp_path / 'command.csv'}")
    assert (done.status, done.err) == (0, "")
    run = sealscope.read(tmp_path / "run.nc")
    assert run["u"][500] == pytest.approx(2.0, abs=0.01)
    assert run["u"][1500] == pytest.approx(-2.0, abs=0.01)


def test_a_stated_error_reaches_the_solver(call, tmp_path):
    for name, words in (("plain.nc", ()), ("fine.nc", ("--error", "0.002[kPa]"))):
        assert call("simulate", "-o", tmp_path / name, "--duration", "4", *words).status == 0
    plain, fine = (sealscope.read(tmp_path / name).provenance["solver"] for name in ("plain.nc", "fine.nc"))
    assert (plain["error_pa"], fine["error_pa"]) == (100.0, 2.0)
    assert fine["step_s"] < plain["step_s"]
    both = call("simulate", "-o", tmp_path / "none.nc", "--error", "20[Pa]", "--step", "1e-3")
    assert (both.status, len(both.err.splitlines())) == (2, 1)
    assert "a stated step or a stated error, not both" in both.err
    assert "error must have a unit of pressure" in call("simulate", "-o", tmp_path / "none.nc", "--error", "1[V]").err
    assert not (tmp_path / "none.nc").exists()


def test_prove_prints_what_halving_the_step_moves(call, tmp_path):
    done = call("simulate", "-o", tmp_path / "run.nc", "--duration", 6, "--prove")
    assert (done.status, done.err) == (0, "")
    lines = done.out.partition(str(tmp_path))[0].splitlines()
    assert lines[0].startswith("halving the step (rk4, 0.0005 s to 0.00025 s) moves")
    table = {line[2:20].strip(): line[20:].split() for line in lines[1:] if line.startswith("  ")}
    details = {f"RMS of d{level} of {chamber}" for level in (1, 2, 3, 4) for chamber in ("p_A", "p_B")}
    assert set(table) == {"omega", "theta", "x", "v", "p_1", "p_2", "p_A", "p_B"} | details
    for name in ("p_A", "p_B", *details):
        moved, unit, *most = table[name]
        assert unit == "Pa"
        assert most[:2] == ["(at", "most"]
        assert 0 < float(moved) <= float(most[2].rstrip(")"))


def test_a_rig_of_one_s_own(call, tmp_path):
    (tmp_path / "own.toml").write_text(
        '[rig]\nname = "own"\nextends = "thesis"\n'
        '[fluid]\np_charge = { value = 6, unit = "bar", source = "gauge on the tank" }\n'
    )
    done = call("simulate", "-o", tmp_path / "run.nc", "--duration", 2, "--rig", tmp_path / "own.toml")
    assert (done.status, done.err) == (0, "")
    run = sealscope.read(tmp_path / "run.nc")
    assert run.provenance["experiment"]["rig"] == "own"
    assert (run["p_A"] + run["p_B"]).mean() / 2 == pytest.approx(6e5, rel=0.02)
