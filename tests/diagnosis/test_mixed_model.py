"""Mixed model of leak-free recordings: against a textbook, Student's law and simulated sessions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri, stdtrit

from sealscope.diagnosis.baseline.mixed_model import BaselineModel, Prior, Spread
from sealscope.diagnosis.baseline.sessions import Times, start_seconds
from sealscope.diagnosis.baseline.sessions import sessions_of as sessions_of_times
from sealscope.diagnosis.rms_change.by_recordings import PRIOR
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording

#: Rocket propellant data: age [weeks] and shear strength [psi]; Montgomery, Peck & Vining, Introduction to Linear
#: Regression Analysis, Table 2.1.
AGE = np.array(
    [15.5, 23.75, 8, 17, 5.5, 19, 24, 2.5, 7.5, 11, 13, 3.75, 25, 9.75, 22, 18, 6, 12.5, 2, 21.5]
)  # fmt: skip
STRENGTH = np.array(
    [2158.70, 1678.15, 2316.00, 2061.30, 2207.50, 1708.30, 1784.70, 2575.00, 2357.90, 2256.70,
     2165.20, 2399.55, 1779.80, 2336.75, 1765.30, 2053.50, 2414.40, 2200.50, 2654.20, 1753.70]
)  # fmt: skip


def sessions_of(recording, baseline, *, single_strokes):
    return sessions_of_times(start_seconds(recording), Times.of(baseline), single_strokes=single_strokes)


def flat(scale: float) -> Prior:
    law = Spread(scale, 0.0)
    return Prior(law, law, 3600.0, law, law)


def z_of(probability: float) -> float:
    return float(-ndtri(probability / 2.0))


def test_prediction_interval_of_the_rocket_propellant() -> None:
    """The book's Example 2.7: at 10 weeks 2256.32 psi, 95 % of new observations within 2048.32 to 2464.32."""
    model = BaselineModel(STRENGTH[:, None], AGE, flat(20.0))
    found = model.predict(10.0)
    half = found.half_width(z_of(0.05))[0]
    assert found.mean[0] == pytest.approx(2256.32, abs=0.05)
    assert found.mean[0] - half == pytest.approx(2048.32, abs=0.3)
    assert found.mean[0] + half == pytest.approx(2464.32, abs=0.3)
    assert np.sqrt(np.sum((STRENGTH - model.fitted[:, 0]) ** 2) / 18) == pytest.approx(96.1, abs=0.1)
    assert found.z(np.array([2256.32 + half]))[0] == pytest.approx(z_of(0.05), abs=0.01)


@pytest.mark.parametrize(("n", "freedom"), [(2, 2.0), (4, 2.0), (4, 0.0), (9, 5.0)])
def test_exchangeable_recordings_follow_student(n: int, freedom: float) -> None:
    """t with freedom + n - 1 degrees of freedom, scale^2 = (1 + 1/n)(freedom scale^2 + sum of squares)/them."""
    y = np.random.default_rng(n).normal(0.0, 0.03, (n, 1))
    law = Spread(0.02, freedom)
    found = BaselineModel(y, np.arange(n) * 0.0, replace(flat(0.02), scatter=law)).predict(0.0)
    nu = freedom + n - 1
    scale = np.sqrt((1 + 1 / n) * (freedom * 0.02**2 + np.sum((y - y.mean()) ** 2)) / nu)
    for p in (0.3, 0.01, 0.01 / 6):
        assert found.half_width(z_of(p))[0] == pytest.approx(-stdtrit(nu, p / 2) * scale, rel=0.03)


def test_one_recording_rests_on_the_prior() -> None:
    found = BaselineModel(np.array([[2.0, 3.0]]), np.zeros(1), PRIOR, sessions=np.zeros(1, int), times=np.zeros(1))
    again = found.predict(0.0, 0.0, 0)
    other = found.predict(0.0, 1e6, None)
    np.testing.assert_allclose(again.mean, [2.0, 3.0], atol=1e-9)
    assert np.all(again.half_width(2.0) < 0.15)
    assert np.all(other.half_width(2.0) > 0.8)


@pytest.mark.parametrize("known", [pytest.param(3, marks=pytest.mark.slow), 6, 40])
def test_later_recordings_of_a_session_that_drifts_hold_the_probability(known: int) -> None:
    """Sessions drawn from the model's own law: 1 % of later recordings lie beyond, at any distance in time."""
    random = np.random.default_rng(known)
    t = np.arange(60) * 30.0
    a = np.sqrt(3.0) * np.abs(t[:, None] - t) / PRIOR.drift_time
    root = np.linalg.cholesky(0.11**2 * (1 + a) * np.exp(-a) + 1e-12 * np.eye(60))
    y = root @ random.standard_normal((60, 500)) + 0.012 * random.standard_normal((60, 500))
    model = BaselineModel(y[:known], np.zeros(known), PRIOR, times=t[:known], sessions=np.zeros(known, int))
    for later in (known, 59):
        z = model.predict(0.0, t[later], 0).z(y[later])
        assert np.mean(z > z_of(0.01)) < 0.025
        assert 0.08 < np.mean(z > z_of(0.2)) < 0.27  # three recordings rest on the prior, whose tails are wide
    widths = [float(np.median(model.predict(0.0, t[known - 1] + gap, 0).half_width(3.0))) for gap in (0, 300, 1800)]
    assert widths[0] < widths[1] < widths[2]


@pytest.mark.slow
def test_another_specimen_is_not_beyond_one_session() -> None:
    """Sessions that differ by 35 % as specimens do: none of 400 is beyond one session, 1 % beyond five of them."""
    random = np.random.default_rng(5)
    effect = 0.35 * random.standard_normal((6, 400))
    sessions = np.repeat(np.arange(5), 6)
    y = effect[sessions] + 0.015 * random.standard_normal((30, 400))
    t = np.arange(30) * 12.0 + sessions * 86400.0
    new = effect[5] + 0.015 * random.standard_normal(400)
    one = BaselineModel(y[:6], np.zeros(6), PRIOR, times=t[:6], sessions=sessions[:6])
    assert np.mean(one.predict(0.0).z(new) > z_of(0.01 / 6)) < 0.005
    assert np.mean(one.predict(0.0, t[5], 0).z(new) > z_of(0.01 / 6)) > 0.6
    five = BaselineModel(y, np.zeros(30), PRIOR, times=t, sessions=sessions)
    assert np.mean(five.predict(0.0).z(new) > z_of(0.01)) < 0.03
    assert np.all(np.median(five.predict(0.0).half_width(3.0)) > 0.8)


def test_z_grows_with_the_distance_without_end() -> None:
    found = BaselineModel(np.array([[0.0], [0.01], [0.02]]), np.zeros(3), PRIOR).predict(0.0)
    z = [float(found.z(np.array([0.01 + d]))[0]) for d in (0.0, 0.1, 1.0, 10.0, 1e6)]
    assert z == sorted(z)
    assert np.isfinite(z[-1])
    assert z[-1] > z[-2]


def test_a_value_that_is_no_number_is_refused() -> None:
    with pytest.raises(InputError, match="finite"):
        BaselineModel(np.array([[np.nan]]), np.zeros(1), PRIOR)


def named(name: str, t0: float = 0.0, start: str | None = None) -> Recording:
    provenance = {"file": name} if start is None else {"file": name, "start": start}
    return Recording(t0 + np.arange(10) / 10.0, {"p_A": np.zeros(10)}, {"p_A": "Pa"}, 10.0, provenance)


@pytest.mark.parametrize(
    ("name", "start", "stamp"),
    [
        ("Base_000_2_410_9-11-2019-8-30-23_AM.txt", None, "2019-09-11T08:30:23"),
        ("Leak_000_0_303_9-10-2019-4-37-01_PM.txt", None, "2019-09-10T16:37:01"),
        ("x_9-10-2019-12-00-01_AM.txt", None, "2019-09-10T00:00:01"),
        ("rig-2026-07-01T14-05-09.csv", None, "2026-07-01T14:05:09"),
        ("20260701_140509.csv", None, "2026-07-01T14:05:09"),
        ("20260701-1405 run.csv", None, "2026-07-01T14:05:00"),
        ("20260701_140509.csv", "2026-07-02T00:00:00.5", "2026-07-02T00:00:00.500"),
        ("rig-2026-07-01.csv", None, None),
        ("20261301_140509.csv", None, None),
        ("strokes_2019.csv", None, None),
        ("plain.csv", "5 s", None),
    ],
)
def test_start_of_a_recording(name: str, start: str | None, stamp: str | None) -> None:
    found = start_seconds(named(name, start=start))
    if stamp is None:
        assert found is None
    else:
        assert found == np.datetime64(stamp, "ms").astype(np.int64) / 1e3
        assert start_seconds(named(name, 2.0, start)) == found + 2.0


def test_sessions_end_with_a_pause() -> None:
    day = [named(f"2026-07-01T10-{minute:02d}-00.csv") for minute in (0, 1, 2)]
    noon = [named(f"2026-07-01T12-{minute:02d}-00.csv") for minute in (0, 1)]
    found = sessions_of(named("2026-07-01T10-30-00.csv"), [*day, *noon], single_strokes=True)
    assert found.labels is not None
    assert list(found.labels) == [0, 0, 0, 1, 1]
    assert (found.label, found.time) == (0, 1800.0)
    assert sessions_of(named("2026-07-02T10-01-00.csv"), day, single_strokes=True).label is None
    assert sessions_of(named("plain.csv"), day, single_strokes=True).time is None
    unknown = sessions_of(named("plain.csv"), [named("a.csv"), named("b.csv")], single_strokes=True)
    assert unknown.times is not None
    np.testing.assert_allclose(unknown.times, [0.0, 1.0])
    assert not unknown.exchangeable
    assert sessions_of(named("plain.csv"), [named("a.csv"), *day], single_strokes=False).exchangeable
    days = [named(f"2026-07-0{day}T10-00-00.csv") for day in (1, 2, 3)]
    assert sessions_of(named("2026-07-05T10-00-00.csv"), days, single_strokes=True).exchangeable
    assert not sessions_of(named("2026-07-05T10-00-00.csv"), days[:2], single_strokes=True).exchangeable
