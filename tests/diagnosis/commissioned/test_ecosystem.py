"""Diagnoses and machines as the ecosystem has them: tables, drawings, an estimator."""

from __future__ import annotations

import pickle
import traceback
from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss


def record(path, seed, leak=None):
    """20 s of a machine whose logger has no command: nothing is fitted to what the pressures make of one."""
    recording = ss.simulate(command="3 sin(4t)", duration="20 s", leak=leak, seed=seed)
    ss.write(recording.only(name for name in recording.channels if name != "u"), path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two healthy recordings."""
    path = tmp_path_factory.mktemp("healthy")
    for seed in (1, 2):
        record(path / f"run{seed}.nc", seed)
    return path


@pytest.fixture(scope="module")
def leaking(tmp_path_factory):
    return record(tmp_path_factory.mktemp("leaking") / "leaking.nc", 8, "0.05 L/min from 10 s")


def test_the_estimator_learns_and_predicts(folder, leaking):
    new = record(leaking.with_name("unseen.nc"), 45)
    assert ss.LeakDetector(rig="thesis").fit(sorted(folder.iterdir())).predict([leaking, new]).tolist() == [-1, 1]


@pytest.mark.slow
def test_what_the_estimator_learns_is_what_it_was_given(folder, leaking):
    """Order, subsets, copies and a pickle change nothing; a second fit forgets the first."""
    from sklearn.base import clone

    healthy, new = sorted(folder.iterdir()), record(leaking.with_name("new.nc"), 44)
    detector = ss.LeakDetector(rig="thesis")
    assert detector.fit([new]) is detector
    margins = detector.fit(healthy).decision_function([new, leaking])
    assert margins[0] > 0 > margins[1]
    assert np.greater(*detector.score_samples([new, leaking]))
    assert detector.predict([leaking, new]).tolist() == [-1, 1]
    twin = pickle.loads(pickle.dumps(detector))
    np.testing.assert_array_equal(twin.decision_function([leaking]), margins[1:])
    assert clone(detector).set_params(rate=500.0).get_params()["rig"] == "thesis"


#: Checks of scikit-learn that need no matrix.
APPLICABLE = {
    "check_estimator_cloneable",
    "check_estimator_tags_renamed",
    "check_valid_tag_types",
    "check_estimator_repr",
    "check_no_attributes_set_in_init",
    "check_estimators_unfitted",
    "check_do_not_raise_errors_in_init_or_set_params",
    "check_mixin_order",
    "check_parameters_default_constructible",
    "check_get_params_invariance",
    "check_set_params",
}


def test_the_estimator_passes_the_checks_of_scikit_learn_that_apply():
    """The others feed a matrix of numbers in place of files, and are refused by one line."""
    from sklearn.utils.estimator_checks import check_estimator

    class OfMatrices(ss.LeakDetector):
        def __sklearn_tags__(self):
            tags = super().__sklearn_tags__()
            tags.input_tags.two_d_array, tags.input_tags.one_d_array = True, False
            return tags

    results = check_estimator(OfMatrices(), on_fail=None, on_skip=None)
    assert {own["check_name"] for own in results if own["status"] == "passed"} >= APPLICABLE
    for own in results:
        if own["status"] == "failed":
            text = "".join(traceback.format_exception(own["exception"]))
            assert "recordings must be a folder's path or paths of files" in text or "sparse data" in text


@pytest.fixture(scope="module")
def leak(folder, leaking):
    return ss.commission(folder, rig="thesis", name="actuator7").diagnose(leaking)


def test_a_diagnosis_is_a_row_of_a_table(leak):
    """Columns are the same with and without a leak, and whatever channels were not used."""
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    healthy = replace(leak, verdict="no leak", onset_interval_s=None, leak_interval_lpm=None, unused=("p_x", "p_y"))
    frames = [diagnosis.to_frame() for diagnosis in (leak, healthy)]
    assert list(frames[0]) == list(frames[1])
    row = pandas.concat(frames).iloc[0]
    assert row["verdict"] == "leak"
    assert row["leak_interval_lpm_low"] < row["leak_lpm"] < row["leak_interval_lpm_high"]


@pytest.mark.slow
def test_a_diagnosis_is_drawn_with_the_repair_limit(leak):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    axes = leak.plot()
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels[-1].startswith("repair limit (8 mm/min")
    np.testing.assert_array_equal(axes.get_lines()[0].get_ydata(), leak.course.lpm)
