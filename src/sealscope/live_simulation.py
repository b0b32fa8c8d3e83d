"""The simulated rig as a source of a monitor: in the place of an actuator's samples, at a multiple of real time.

A run is the same to the last bit whenever it is simulated, and its blocks are named by all that it depends on. So a
monitor that begins again goes on after the last block that it stored, and no block is counted twice.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Callable
from threading import Lock

from sealscope.diagnosis.live.joining import CHANNELS
from sealscope.errors import InputError
from sealscope.monitor.database.store import KEPT_IDENTITIES
from sealscope.monitor.service import Source
from sealscope.monitor.settings import ActuatorSettings, MonitorSettings, SimulateSettings
from sealscope.monitor.sources.source_block import BlockReceiver, SourceBlock
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

#: Samples that a block holds [s].
BLOCK_S = 1.0
#: Settings of the demo: three actuators at 20 times real time, of which one begins to leak after two minutes.
DEMO = """\
# Settings of `sealscope monitor demo`: what is learned is learned in 100 s.
database = "monitor.db"

[defaults]
learn_hours = 0.0278
warning_lpm = 0.001
error_lpm = 0.01

[page]
port = {port}

[[actuator]]
name = "press 1"
simulate = {{ command = "3 sin(4t)", seed = 0, speed = {speed:g} }}

[[actuator]]
name = "press 2"
simulate = {{ command = "2.5 sin(4t)", leak = "0.0042 L/min from 120 s", seed = 1, speed = {speed:g} }}

[[actuator]]
name = "clamp"
simulate = {{ command = "3 sin(5t)", seed = 2, speed = {speed:g} }}
"""
_one_at_a_time = Lock()


def simulated_sources(settings: MonitorSettings, say: Callable[[str], None]) -> list[Source]:
    """Build a source for each actuator that has `simulate`; raise InputError where its words make no experiment.

    `say` is told when a simulation begins, and when its time is over.
    """
    return [
        _source(actuator.name, _experiment(actuator, actuator.simulate), actuator.simulate, say)
        for actuator in settings.actuator
        if actuator.simulate is not None
    ]


def _experiment(actuator: ActuatorSettings, words: SimulateSettings) -> Experiment:
    try:
        experiment = Experiment.of(rig=actuator.rig, **words.model_dump(exclude={"speed"}))
        if experiment.duration / BLOCK_S > KEPT_IDENTITIES:
            raise InputError(f"duration must be at most {KEPT_IDENTITIES * BLOCK_S:g} s, got {experiment.duration:g} s")
    except InputError as error:
        raise InputError(f"{actuator.name}: simulate: {error}") from None
    return experiment


def _source(name: str, experiment: Experiment, words: SimulateSettings, say: Callable[[str], None]) -> Source:
    def play(receiver: BlockReceiver) -> None:
        blocks = range(math.floor(experiment.duration / BLOCK_S))
        first = bisect_left(blocks, True, key=lambda number: not receiver.store.is_known(name, _identity(number)))
        if first < len(blocks):
            with _one_at_a_time:
                if receiver.stopping.is_set():
                    return
                say(f"simulates {name}")
                run = simulate_experiment(experiment).recording
            recording = run.only([channel for channel in CHANNELS if channel in run])
            count = round(BLOCK_S * recording.rate)
            began = time.monotonic()
            for number in blocks[first:]:
                due = began + (number + 1 - first) * BLOCK_S / words.speed
                if receiver.stopping.wait(max(0.0, due - time.monotonic())):
                    return
                samples = recording.samples(slice(number * count, (number + 1) * count))
                receiver.hand(SourceBlock(name, _identity(number), samples))
        say(f"{name}: the simulated time is over")

    def _identity(number: int) -> str:
        return f"simulated {experiment.key()} {number}"

    return play
