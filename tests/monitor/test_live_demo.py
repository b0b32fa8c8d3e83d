"""The demo: three simulated actuators, of which the leaking one alone raises an alarm; the commands around it."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest

from sealscope.live_demo import demo_settings, simulated_source
from sealscope.monitor.service import Service


@pytest.mark.slow
def test_the_leaking_actuator_alone_raises_an_alarm(tmp_path: Path):
    out, said = io.StringIO(), []
    settings = demo_settings(tmp_path, 0).model_copy(update={"page": None})
    service = Service(settings, stdout=out, sources=[simulated_source(1000.0, said.append, duration=160.0)])
    service.run()
    (event,) = [json.loads(line) for line in out.getvalue().splitlines()]
    alarm = event["alarm"]
    assert (event["event"], alarm["actuator"], alarm["level"]) == ("raised", "press 2", "warning")
    low, high = alarm["leak_interval_lpm"]
    assert low < 0.0042 < high
    assert alarm["raised_s"] < 140.0
    assert said[-1].startswith("the simulated time is over")
