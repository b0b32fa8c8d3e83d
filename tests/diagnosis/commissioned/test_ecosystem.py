"""Diagnoses and machines as the ecosystem has them: tables, drawings, an estimator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.estimator import LeakDetector
from sealscope.errors import InputError


@pytest.fixture(scope="module")
def leaking(tmp_path_factory):
    path = tmp_path_factory.mktemp("leaking") / "leaking.nc"
    ss.write(ss.simulate(command="3 sin(4t)", duration="20 s", leak="0.05 L/min from 10 s", seed=8), path)
    return path


def test_the_estimator_learns_and_predicts(folder, leaking):
    detector = LeakDetector(rig="thesis").fit(sorted(folder.iterdir()))
    new = leaking.with_name("new.nc")
    ss.write(ss.simulate(command="3 sin(4t)", duration="20 s", seed=44), new)
    assert detector.predict([new, leaking]).tolist() == [1, -1]
    above, below = detector.decision_function([new, leaking])
    assert above > 0 > below
    assert (
        LeakDetector(**detector.get_params()).set_params(false_alarm_probability=0.05).get_params()["rig"] == "thesis"
    )
    unfitted = LeakDetector()
    with pytest.raises(InputError, match="must be fitted"):
        unfitted.predict([new])


def test_the_estimator_is_cloned(folder):
    base = pytest.importorskip("sklearn.base", reason="scikit-learn is not installed")
    copy = base.clone(LeakDetector(rig="thesis", false_alarm_probability=0.02))
    assert copy.get_params()["false_alarm_probability"] == 0.02


def test_a_diagnosis_is_a_row_of_a_table(machine, leaking):
    """Columns are the same with and without a leak, and whatever channels were not used."""
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    leak = machine.diagnose(leaking)
    healthy = replace(leak, verdict="no leak", onset_interval_s=None, leak_interval_lpm=None, unused=("p_x", "p_y"))
    frames = [diagnosis.to_frame() for diagnosis in (leak, healthy)]
    assert list(frames[0]) == list(frames[1])
    row = pandas.concat(frames).iloc[0]
    assert row["verdict"] == "leak"
    assert row["leak_interval_lpm_low"] < row["leak_lpm"] < row["leak_interval_lpm_high"]


def test_a_diagnosis_is_drawn_with_the_repair_limit(machine, leaking):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    diagnosis = machine.diagnose(leaking)
    axes = diagnosis.plot()
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels[-1].startswith("repair limit (8 mm/min")
    leak = axes.get_lines()[0]
    np.testing.assert_array_equal(leak.get_ydata(), diagnosis.course.lpm)
