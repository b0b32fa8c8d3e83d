"""The viscous pressure drop of the motion: its size and error, and the oil that it shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.commissioned.healthy_file import check_summary
from sealscope.diagnosis.inference.changes.motion_fit import fit_difference
from sealscope.diagnosis.inference.comparison import RecordingSums, Resistance, oil_hypotheses
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate

RATE, SECONDS = 100.0, 60.0
T = np.arange(round(RATE * SECONDS)) / RATE
#: Viscous pressure drop over the speed [Pa s/m].
DROP = 2e6


def record(drop: float = DROP, seed: int = 0, noise: float = 2e4, turned: bool = False) -> Recording:
    """Record strokes of several speeds against dry friction, a spring and a viscous drop; noise lasts 0.5 s."""
    rng = np.random.default_rng(seed)
    x = 0.1 * np.sin(2.0 * np.pi * 0.2 * T) + 0.03 * np.sin(2.0 * np.pi * 0.53 * T)
    v = np.gradient(x, T)
    slow_noise = np.repeat(rng.standard_normal((2, len(T) // 50)), 50, axis=1) * noise
    difference = 1e5 * np.sign(v) + drop * v + 2e6 * x
    p_A, p_B = 40e5 + 0.6 * difference + slow_noise[0], 20e5 - 0.4 * difference + slow_noise[1]
    if turned:
        x, p_A, p_B = -x, p_B, p_A
    return Recording(T, {"p_A": p_A, "p_B": p_B, "x": x}, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, RATE)


def log_drop(recording: Recording) -> tuple[float, float]:
    """Return the logarithm of the drop and its standard error."""
    fit = fit_difference(recording)
    assert fit is not None
    drop = float(np.sign(fit.friction)) * fit.drop
    return float(np.log(drop)), fit.drop_error / drop


def test_the_ratio_of_two_drops_is_theirs() -> None:
    """The unit of the speed is the recording's own: ratios count."""
    (thick, thick_error), (thin, thin_error) = log_drop(record(2.0 * DROP)), log_drop(record(DROP, seed=1))
    assert thick - thin == pytest.approx(np.log(2.0), abs=3.0 * np.hypot(thick_error, thin_error))
    assert thick_error < thin_error < 0.1


@pytest.mark.slow
def test_its_standard_error_is_the_scatter_of_records() -> None:
    estimates = np.array([log_drop(record(seed=seed)) for seed in range(30)])
    assert 0.6 < estimates[:, 0].std() / np.median(estimates[:, 1]) < 1.6


def test_the_sign_of_the_motion_does_not_matter() -> None:
    plain, turned = (log_drop(record(turned=turned)) for turned in (False, True))
    assert turned == pytest.approx(plain, abs=1e-6)


def test_without_motion_or_pressures_there_is_none() -> None:
    whole = record()
    still = Recording(T, {**whole.channels, "x": np.zeros(len(T))}, whole.units, RATE)
    assert fit_difference(still) is None
    assert fit_difference(whole.only(("p_A", "x"))) is None


def predicted_oil(*days: tuple[float, float]) -> np.ndarray:
    """Predict the oil's effect on the leakage of days with a `friction` [Pa] and a drop at top speed [Pa] each."""
    fits = [
        Resistance(friction=friction, friction_error=1e3, drop=drop / 0.1, drop_error=2e4, top_speed=0.1)
        for friction, drop in days
    ]
    sums = [RecordingSums(np.zeros((1, 2, 2)), 3e-4, 5e6, 1.7e9, resistance=np.array(fit)) for fit in fits]
    return oil_hypotheses(sums)[0].thinning


def test_thinner_oil_leaks_more() -> None:
    """With the prior exponent, and a friction that stays."""
    thinning = predicted_oil((1e5, 2e5), (1e5, 2e5), (1e5, 1e5))
    assert thinning[-1] == pytest.approx(INFERENCE.oil.per_drop * np.log(2.0), rel=0.05)


def test_a_judged_drop_may_have_another_cause_than_the_oil() -> None:
    """Each hypothesis has a twin in which the judged drop tells nothing, the others do.

    What swells a seal changes its friction, too: a judged friction that is as usual makes the twins less probable than
    their prior, one that doubled makes them more probable.
    """
    fit = np.array(Resistance(friction=1e5, friction_error=1e3, drop=2e6, drop_error=2e4, top_speed=0.1))
    sums = RecordingSums(np.zeros((1, 2, 2)), 3e-4, 5e6, 1.7e9, resistance=fit)
    prior = INFERENCE.oil.drop_misleads / (1.0 - INFERENCE.oil.drop_misleads)
    odds = []
    for friction in (1.0, 2.0):
        swollen = replace(sums, resistance=fit * [friction, 1.0, 2.0, 1.0, 1.0])
        oils = oil_hypotheses([sums, sums, swollen])
        mute = [oil for oil in oils if oil.thinning[-1] == 0.0 and oil.slope_deviation > 0.0]
        told = [oil for oil in oils if oil.thinning[-1] < 0.0]
        odds.append(sum(np.exp(oil.log_probability) for oil in mute) / sum(np.exp(oil.log_probability) for oil in told))
        assert all(oil.variances[-1] > 10.0 * oil.variances[0] for oil in mute)
    usual, doubled = odds
    assert usual < 0.3 * prior < prior < doubled < 3.0 * prior


def test_what_friction_gains_the_drop_loses() -> None:
    """The resistance at top speed stays, and so does the oil."""
    assert np.abs(predicted_oil((1.0e5, 2.0e5), (1.1e5, 1.9e5), (0.9e5, 2.1e5), (1.15e5, 1.85e5))).max() < 0.02


def test_worn_seals_are_no_colder_oil() -> None:
    same, worn = predicted_oil((1e5, 2e5), (1e5, 2e5), (1e5, 2e5)), predicted_oil((1e5, 2e5), (1e5, 2e5), (3e5, 2e5))
    assert worn == pytest.approx(same, abs=0.02)


def test_a_drop_that_does_not_show_tells_no_oil() -> None:
    assert abs(predicted_oil((1e5, 2e5), (1e5, 2e5), (1e5, -1e3))[-1]) < INFERENCE.oil.per_drop * np.log(200.0)
    unknown = RecordingSums(np.zeros((1, 2, 2)), 3e-4, 5e6, 1.7e9)
    assert not oil_hypotheses([unknown, unknown, unknown])[0].thinning.any()


@pytest.mark.parametrize("spoilt", [{"drop_error": 0.0}, {"friction_error": -1.0}, {"top_speed": 1e-300}])
def test_a_resistance_that_would_be_divided_by_zero_is_refused(spoilt: dict[str, float]) -> None:
    learnt = VolumeBalance(load_rig("thesis")).learn(simulate(duration="20 s", seed=1))
    assert learnt is not None and learnt.resistance is not None
    check_summary("volume balance", learnt.table())
    fit = Resistance(*learnt.resistance)._replace(**spoilt)
    with pytest.raises(ArithmeticError, match="resistance"):
        check_summary("volume balance", {**learnt.table(), "resistance": np.array(fit)})
