"""What is unknown about a machine: odds of alternatives, and how far likelihoods of models are believed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sealscope.diagnosis.estimate.population import weigh_alternatives
from sealscope.diagnosis.inference.hypotheses import MachineOdds, RecordingOdds, compare_residuals, temper
from sealscope.diagnosis.priors.inference import INFERENCE


def test_the_healthy_sign_counts_no_more_than_a_sensor_that_was_rewired() -> None:
    rewired = INFERENCE.sense.rewired
    summaries = [RecordingOdds(sign_log_odds=np.array([12.0]))] * 9
    assert MachineOdds.from_healthy(summaries, 1).flow_sign == pytest.approx(np.log((1.0 - rewired) / rewired))
    assert MachineOdds.from_healthy([RecordingOdds()], 1).flow_sign == 0.0
    other_channels = RecordingOdds(sign_log_odds=np.array([-1.0, 2.0]))
    np.testing.assert_array_equal(MachineOdds.from_healthy([*summaries, other_channels], 2).flow_sign, [-1.0, 2.0])


def test_the_odds_of_the_valves_add_up_within_what_one_recording_may_tell() -> None:
    prior, limit, sure = INFERENCE.rest.shut_odds, INFERENCE.rest.single_odds_limit, INFERENCE.rest.sure_odds
    assert MachineOdds.from_healthy([RecordingOdds()], 1) == MachineOdds(flow_sign=np.zeros(1))
    doubtful = [RecordingOdds(shut_odds=0.5), RecordingOdds(shut_odds=-9.0), RecordingOdds()]
    assert MachineOdds.from_healthy(doubtful, 1).valves == pytest.approx(prior + 0.5 - limit)
    assert MachineOdds.from_healthy(doubtful, 1, scatter_log_odds=2.0).valves == pytest.approx(prior + 2.5 - limit)
    for above, below in (
        (RecordingOdds(shut_odds=sure + 0.1), RecordingOdds(shut_odds=sure - 0.1)),
        (RecordingOdds(held_odds=sure + 0.1), RecordingOdds(held_odds=sure - 0.1)),
    ):
        assert MachineOdds.from_healthy([above, RecordingOdds()], 1).is_valve_certain
        assert not MachineOdds.from_healthy([below], 1).is_valve_certain


def test_residuals_that_repeat_count_as_few() -> None:
    n = INFERENCE.tempering.readings
    assert compare_residuals(2.0, 2.0) == 0.0
    assert compare_residuals(1.0, math.e) == pytest.approx(0.5 * n) == -compare_residuals(math.e, 1.0)


def test_a_model_is_believed_no_further_than_it_is_exact() -> None:
    """Small ratios stay, and none exceeds half the inverse of the misfit; the order stays."""
    ratios = np.array([0.0, 1e-3, 1.0, 10.0, 1e9])
    tempered = np.array([temper(ratio, ratio, 0.01) for ratio in ratios])
    assert (np.diff(tempered) > 0.0).all() and tempered[-1] < 0.5 / 0.01
    assert tempered[:2] == pytest.approx(ratios[:2], rel=1e-4)
    np.testing.assert_array_equal(temper(ratios, 5.0, 0.0), ratios)


def test_alternatives_have_probabilities_whatever_they_have_in_common() -> None:
    log_weights = np.log([[0.1, 0.2], [0.3, 0.4]])
    for common in (0.0, 1e4, -1e4):
        np.testing.assert_allclose(weigh_alternatives(log_weights + common), [[0.1, 0.2], [0.3, 0.4]], rtol=1e-10)
    np.testing.assert_array_equal(weigh_alternatives(np.array([-np.inf, 5.0])), [0.0, 1.0])
