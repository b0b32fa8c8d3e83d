"""A recording and a diagnosis to report."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sealscope.campaigns.cases.row import CaseRow, Statement
from sealscope.campaigns.judging.judge import judge
from sealscope.campaigns.plans.reader import load_plan
from sealscope.campaigns.results import CampaignResult, prior_knowledge
from sealscope.diagnosis.trend.machine_trend import Trend
from sealscope.diagnosis.trend.machine_trend import trend as trend_of
from sealscope.diagnosis.trend.reading import LeakReading
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording


def _recording(seconds: float = 40.0, rate: float = 500.0, seed: int = 7) -> Recording:
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    swing = np.sin(4 * t)
    ringing = np.where(t < seconds / 2, 9e3, 6e3) * np.sin(2 * np.pi * 70 * t)
    noise = rng.normal(0, 2e3, (4, t.size))
    channels = {
        "u": 3 * swing,
        "x": 0.05 * swing,
        "omega": 31 * swing,
        "p_1": 3.1e5 + 6e4 * swing + noise[0],
        "p_2": 3.1e5 - 6e4 * swing + noise[1],
        "p_A": 3e5 + 6e4 * swing + ringing + noise[2],
        "p_B": 3e5 - 6e4 * swing - ringing + noise[3],
        "q_leak": np.where(t < seconds / 2, 0.0, 7e-8),
    }
    units = {"u": "V", "x": "m", "omega": "rad/s", "q_leak": "m^3/s"} | dict.fromkeys(
        ("p_1", "p_2", "p_A", "p_B"), "Pa"
    )
    return Recording(t, channels, units, rate, {"rig": {"name": "bench 4"}, "day": 3}, ("converted with 14 bits",))


def _diagnosis(**changed: Any) -> Diagnosis:
    finding = Finding("clipped", "warning", "p_1", 12, 3.25, "12 samples stand at the rail")
    method = Evidence("leak", "the RMS of d3 of p_A fell by 31 %", 5.4375, 3.21875, detector="details")
    values: dict[str, Any] = {
        "file": "bench/log_17.csv",
        "verdict": "leak",
        "reason": "d3 fell in both chambers",
        "onset_s": 20.375,
        "onset_interval_s": (18.5, 21.75),
        "leak_lpm": 0.00421,
        "leak_interval_lpm": (0.0031, 0.0057),
        "false_alarm_probability": 0.001,
        "score": 5.4375,
        "threshold": 3.21875,
        "quality": (finding,),
        "parts": (method,),
    }
    return Diagnosis(**(values | changed))


@pytest.fixture(scope="session")
def make_recording():
    return _recording


@pytest.fixture(scope="session")
def recording():
    return _recording()


@pytest.fixture(scope="session")
def make_diagnosis():
    return _diagnosis


@pytest.fixture(scope="session")
def no_verdict():
    """A diagnosis in which all that may be None is None."""
    return _diagnosis(
        verdict="cannot tell",
        reason="the recording is too short",
        onset_s=None,
        onset_interval_s=None,
        leak_lpm=None,
        leak_interval_lpm=None,
        score=None,
        threshold=None,
        quality=(Finding("short", "fatal", None, 0, None, "30 samples"),),
        parts=(Evidence("cannot tell", "", detector="details"),),
    )


_PLAN = """
[campaign]
name = "single"
title = "A single size"
duration = "40 s"
onset = "20 s"
rate = "500 Hz"
false_alarm = 0.1
detectors = ["volume balance"]

[[records]]
count = 10

[[records]]
leak = "0.0042 L/min"
count = 10

[[records]]
fault = "pump leak x3"
count = 6
"""


@pytest.fixture(scope="session")
def campaign_result(tmp_path_factory):
    """The result of a campaign: 10 leak-free records, 10 with a leak of a single size, 6 with a pump leak.

    The volume balance raises an alarm in 1, 10 and 5 of them, and calls every leak but the first `piston or pump leak`.
    """
    path = tmp_path_factory.mktemp("plan") / "single.toml"
    path.write_text(_PLAN, encoding="utf-8")
    plan = load_plan(path)

    def row(number: int, score: float, leak: float = 0.0, fault: str = "", cause: str | None = None) -> CaseRow:
        verdict = "leak" if score > 3.0 else "no leak"
        said = Statement(verdict, score, 3.0, cause=cause if verdict == "leak" else None)
        return CaseRow(
            id=f"{number:016x}",
            use="judge",
            leak_lpm=leak,
            fault=fault,
            levels={},
            replicate=number,
            flow_lpm=leak,
            scores={"volume balance": (score, None)},
            statements={"volume balance": said},
        )

    either = "piston or pump leak"
    rows = [row(k, 4.0 if k == 0 else 1.0, cause="piston leak") for k in range(10)]
    rows += [row(100 + k, 9.0, leak=0.0042, cause=either) for k in range(10)]
    rows += [row(200 + k, 1.0 if k == 5 else 8.0, fault="pump leak x3", cause=either if k else "piston leak")
             for k in range(6)]  # fmt: skip
    judgement = judge(rows, plan.detectors, onset_s=plan.onset_s, hours=plan.duration_s / 3600)
    return CampaignResult(plan, tuple(rows), 0, judgement, known=prior_knowledge(plan))


@pytest.fixture(scope="session")
def trend() -> Trend:
    """40 days: wear from day 10 on, a repair on day 30; days 20 to 22 by another sensor; day 5 states nothing."""
    random = np.random.default_rng(2)
    days = []
    for k in range(40):
        level = 6.7e-13 * (1.0 + 0.05 * random.standard_normal() + (0.08 * (k - 10) if 10 < k < 30 else 0.0))
        days.append(
            LeakReading(
                file=f"<day> {k}.csv",
                start=1.7e9 + 86400.0 * k,
                duration=60.0,
                basis=None if k == 5 else "volume balance",
                level=level,
                error=1.3e-14,
                states_flow=True,
                pump=8e-6,
                area=633e-6,
                pressure=1.1e5,
                temperature=None,
                scale=1.03 if 20 <= k <= 22 else 1.0,
                machine=None,
                digest=str(k),
                problem="needs theta" if k == 5 else "",
            )
        )
    return trend_of(days, healthy=5, limit="15 mL/min")
