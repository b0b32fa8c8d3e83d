"""One pattern of names: `read_` and `write_` for files, `plot` for what is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss
from sealscope.parameters import rig_names

from .refusals import refusal


@pytest.fixture(scope="module")
def recording():
    return ss.simulate(duration="20 s", seed=1)


@pytest.mark.slow
def test_files_of_each_kind_are_read_and_written_alike(recording, tmp_path):
    ss.write(recording, tmp_path / "healthy.nc")
    machine = ss.commission([tmp_path / "healthy.nc"], name="press")
    assert ss.read_machine(ss.write_machine(machine, tmp_path / "press.toml")).name == "press"
    assert len(ss.read(tmp_path / "healthy.nc")) == len(recording)


@pytest.mark.slow
def test_a_report_needs_the_recording_alone(recording, tmp_path):
    page = ss.report(recording, tmp_path / "report.html")
    assert page == tmp_path / "report.html"
    diagnosed = ss.report(recording, tmp_path / "diagnosed.html", ss.diagnose(recording))
    assert diagnosed.read_bytes() == page.read_bytes()


def test_packaged_rigs_are_named():
    assert ss.rigs() == rig_names()
    assert all(ss.load_rig(name).name for name in ss.rigs())


def test_a_recording_draws_its_channels(recording):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    axes = recording.plot(["p_A", "p_B", "x"])
    assert [own.get_ylabel() for own in axes] == ["p_A, p_B [bar]", "x [mm]"]
    assert axes[1].get_xlabel() == "t [s]"
    np.testing.assert_allclose(axes[0].lines[0].get_ydata(), recording["p_A"] / 1e5)
    in_log = replace(recording, provenance={"log_units": {"p_A": "psi", "x": "m"}}).plot(["p_A", "x"])
    assert [own.get_ylabel() for own in in_log] == ["p_A [psi]", "x [m]"]
    counts = replace(recording.only(["p_A"]), units={"p_A": "count"})
    np.testing.assert_allclose(counts.plot()[0].lines[0].get_ydata(), counts["p_A"])
    with refusal("p_C"):
        recording.plot(["p_C"])
