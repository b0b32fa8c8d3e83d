"""The simulated rig as a source: its blocks are the same after a kill; and the demo, whose leaking actuator alarms."""

from __future__ import annotations

import io
import json
import os
import signal
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sealscope.live_simulation import DEMO, make_simulated_sources
from sealscope.monitor.database import tables
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings, read_settings
from sealscope.simulation.simulate import simulate

from ..refusals import refusal
from .plant import rows_of, until

LEAKING = {"command": "3 sin(4t)", "leak": "0.05 L/min from 1 s", "duration": "4.5 s", "seed": 3, "speed": 1e6}


def settings_of(folder: Path, **words: object) -> MonitorSettings:
    actuator = {"name": "press 1", "simulate": {**LEAKING, **words}}
    return MonitorSettings.model_validate(
        {"database": str(folder / "monitor.db"), "defaults": {"learn_hours": 0.01}, "actuator": [actuator]}
    )


def test_a_run_goes_on_after_the_last_block_that_is_known(tmp_path):
    """Of 4.5 s there are four blocks; where two are stored the other two come, with the same names and samples."""
    handed, known, said = [], set(), []
    store = SimpleNamespace(is_known=lambda name, identity: identity in known)
    receiver = SimpleNamespace(stopping=threading.Event(), store=store, submit=handed.append)
    (source,) = make_simulated_sources(settings_of(tmp_path), said.append)
    source(receiver)
    whole = simulate(command="3 sin(4t)", leak="0.05 L/min from 1 s", duration=4.5, seed=3)
    for number, block in enumerate(handed):
        assert block.actuator == "press 1"
        assert np.array_equal(block.samples["p_A"], whole["p_A"][500 * number : 500 * (number + 1)])
    assert len({block.identity for block in handed}) == 4
    assert said == ["simulates press 1", "press 1: the simulated time is over"]
    known.update(block.identity for block in handed[:2])
    (source,) = make_simulated_sources(settings_of(tmp_path), said.append)
    source(receiver)
    assert [block.identity for block in handed[4:]] == [block.identity for block in handed[2:4]]
    (other,) = make_simulated_sources(settings_of(tmp_path, seed=4, duration="1 s"), said.append)
    other(receiver)
    assert handed[-1].identity not in known | {block.identity for block in handed[:-1]}


def test_blocks_keep_to_their_seconds_at_a_rate_that_is_no_whole_number(tmp_path):
    """Together they are the samples of all whole seconds, once each."""
    rate, handed = 50.4, []
    store = SimpleNamespace(is_known=lambda name, identity: False)
    (source,) = make_simulated_sources(settings_of(tmp_path, rate=str(rate), duration="12 s"), lambda text: None)
    source(SimpleNamespace(stopping=threading.Event(), store=store, submit=handed.append))
    assert len(handed) == 12
    for number, block in enumerate(handed):
        assert np.all(np.abs(block.samples.t - (number + 0.5)) <= 0.5 + 0.5 / rate + 1e-9)
    times = np.concatenate([block.samples.t for block in handed])
    assert np.allclose(times, np.arange(round(12 * rate)) / rate)


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ({"command": "3 sinus"}, "press 1, 3 sinus"),
        ({"leak": ["0.1 L/min", "9 bar"]}, "press 1, 9 bar"),
        ({"duration": "60 h"}, "press 1, duration, 100000 s"),
    ],
)
def test_words_that_make_no_experiment_are_one_clear_line(tmp_path, words, names):
    with refusal(*names.split(", ")):
        make_simulated_sources(settings_of(tmp_path, **words, rate="50"), print)


@pytest.mark.slow
def test_a_kill_changes_no_row(tmp_path):
    def run(settings: MonitorSettings) -> Service:
        service = Service(settings, stdout=io.StringIO(), sources=make_simulated_sources(settings, lambda text: None))
        service.run()
        return service

    (tmp_path / "whole").mkdir()
    whole = settings_of(tmp_path / "whole", duration="75 s")
    run(whole)
    settings = settings_of(tmp_path, duration="75 s", speed=40.0)
    store = MonitorStore(settings.database)
    child = os.fork()
    if child == 0:
        try:
            run(settings)
        finally:
            os._exit(0)
    until(lambda: store.last_number(tables.blocks, "press 1") >= 20)
    os.kill(child, signal.SIGKILL)
    assert os.WIFSIGNALED(os.waitpid(child, 0)[1])
    assert store.last_number(tables.blocks, "press 1") < 75
    service = run(settings)
    assert rows_of(settings.database) == rows_of(whole.database)
    assert service.actuators.counters == {}


@pytest.mark.slow
def test_the_leaking_actuator_of_the_demo_alone_raises_an_alarm(tmp_path):
    file = tmp_path / "demo.toml"
    file.write_text(DEMO.format(port=0, speed=1000.0).replace("speed =", 'duration = "160 s", speed ='))
    out = io.StringIO()
    settings = read_settings(file).model_copy(update={"page": None})
    Service(settings, stdout=out, sources=make_simulated_sources(settings, lambda text: None)).run()
    (event,) = [json.loads(line) for line in out.getvalue().splitlines()]
    alarm = event["alarm"]
    assert (event["event"], alarm["actuator"], alarm["level"]) == ("raised", "press 2", "warning")
    low, high = alarm["leak_interval_lpm"]
    assert low < 0.0042 < high
    assert alarm["raised_s"] < 140.0
