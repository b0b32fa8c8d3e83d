"""Ninety simulated days of a machine with everything that happens to one, and real strokes, as `sealscope trend` sees
them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.trend.machine_trend import Trend
from sealscope.diagnosis.trend.machine_trend import trend as trend_of
from sealscope.diagnosis.trend.reading import LeakReading, estimate_reading
from sealscope.recordings.recording import Recording
from sealscope.reporting.trend.page import render_trend_page
from sealscope.simulation.leaks import Leak
from sealscope.units import DAYS_PER_MONTH

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "vtnsi_actuator"
#: Wear from this day on, and the days on which the seal is changed, the duty, and the encoder of the position.
WORN, REPAIRED, OTHER_DUTY, USUAL_DUTY, EXCHANGED = 25, 60, 70, 76, 82
#: Conductance of the worn seal a day: 0.003 L/min a month at 0.1 MPa.
WEAR = 0.003 / 60e3 / 0.1e6 / DAYS_PER_MONTH


def kelvin_of(day: int) -> float:
    """The oil warms from 30 to 45 deg C over the 90 days, and scatters by 3 K."""
    return 15.0 * day / 89.0 + 3.0 * float(np.random.default_rng([day, 1]).standard_normal())


def simulated(day: int) -> Recording:
    """The recording of a day, 30 s; pump and seal leak by 1/viscosity, 4.5 % more a kelvin."""
    kelvin, random = kelvin_of(day), np.random.default_rng(day)
    worn = max(day - WORN, 0) * WEAR * math.exp(0.045 * kelvin) if day < REPAIRED else 0.0
    recording = ss.simulate(
        command="4 sin(4t)" if OTHER_DUTY <= day < USUAL_DUTY else "3 sin(4t)",
        duration="30 s",
        rate=100.0,
        seed=day,
        leak=Leak(coefficient=worn) if worn else None,
        set={
            "pump.G_pump": 2.4e-13 * math.exp(0.045 * kelvin + 0.03 * float(random.standard_normal())),
            "sensors.x.scale_error": 0.03 if day >= EXCHANGED else 0.0,
        },
    )
    month, own = divmod(day, 30)
    about = {"Oil temperature": f"{30.0 + kelvin:.1f} degC"}
    return replace(recording, provenance={"start": f"2024-{month + 4:02d}-{own + 1:02d}T07:30", "about": about})


@pytest.fixture(scope="module")
def readings() -> list[LeakReading]:
    return [estimate_reading(simulated(day), "thesis", f"day_{day}.csv") for day in range(90)]


def day_of(trend: Trend, episode: int) -> float:
    number = trend.episodes[episode].alarm
    assert number is not None
    return trend.points[trend.rows[number]].day


@pytest.mark.slow
def test_ninety_days(readings: list[LeakReading]) -> None:
    until = trend_of(readings[:REPAIRED], healthy=5)
    assert until.verdict == "leak" and until.unit == "L/min" and until.wear is not None
    assert WORN < day_of(until, 0) < WORN + 20
    assert until.wear.onset is not None and until.wear.onset.low <= WORN + 1 <= until.wear.onset.high + 2
    assert until.pressure is not None
    grown = (
        WEAR * DAYS_PER_MONTH * 60e3 * until.pressure * math.exp(0.045 * kelvin_of(0))
    )  # at the first day's temperature
    assert until.wear.growth.low < grown < until.wear.growth.high
    whole = trend_of(readings, healthy=5)
    assert [point.file for point in whole.repairs] == [f"day_{REPAIRED}.csv"]
    assert whole.verdict == "no leak" and day_of(whole, 0) == day_of(until, 0)
    texts = " ".join(finding.text for finding in whole.findings)
    assert f"{90 - EXCHANGED} of 90 compared among themselves only: position or angle is scaled" in texts
    assert len(whole.rows) == 90 and all(point.temperature is not None for point in whole.points)


@pytest.mark.slow
def test_without_the_temperature_the_summer_looks_like_wear(readings: list[LeakReading]) -> None:
    """Said here, as it is so: what the oil's temperature makes cannot be told from wear where no file states it."""
    healthy = [
        replace(own, temperature=None, start=k * 86400.0)
        for k, own in enumerate([*readings[:WORN], *readings[REPAIRED:OTHER_DUTY]])
    ]
    known = [
        replace(own, start=k * 86400.0) for k, own in enumerate([*readings[:WORN], *readings[REPAIRED:OTHER_DUTY]])
    ]
    assert trend_of(known, healthy=5).verdict == "no leak"
    assert trend_of(healthy, healthy=5).verdict == "leak"


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the real strokes are not beside this checkout")
@pytest.mark.parametrize("session", [pytest.param("act_1_healthy", marks=pytest.mark.long), "act_4_seal_defect"])
def test_real_strokes_of_a_specimen_raise_no_alarm(session: str) -> None:
    """Thirty strokes in seven minutes: counts and no command, so the ringing alone, which never says `leak`."""
    files = sorted((REAL / session).glob("*.txt"))
    strokes = [ss.read(file, rate=1000.0, map={"p_A": "PG_1", "p_B": "PG_2"}) for file in files]
    readings = [estimate_reading(own, file=file.name) for own, file in zip(strokes, files, strict=True)]
    trend = trend_of(readings, healthy=5)
    assert trend.basis == "ringing" and trend.verdict == "cannot tell" and trend.alarm is None
    assert len(trend.rows) >= 28 and trend.unit == "%"
    assert "The damping of the pressures" in render_trend_page(trend) or "ringing" in render_trend_page(trend)
