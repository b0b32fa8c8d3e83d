"""Simulated actuators as sources of blocks of samples for the monitor, at a multiple of real time.

A simulation is reproducible, and the identity of a block contains everything that it depends on. A restarted monitor
therefore continues after the last block that it stored, and counts no block twice.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Callable
from threading import Lock

from sealscope.diagnosis.live.joining import CHANNELS
from sealscope.errors import InputError
from sealscope.monitor.database.store import MAX_IDENTITIES
from sealscope.monitor.service import Source
from sealscope.monitor.settings import ActuatorSettings, MonitorSettings, SimulateSettings
from sealscope.monitor.sources.source_block import BlockReceiver, SourceBlock
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

#: Length of a block [s].
BLOCK_S = 1.0
#: Settings of the demo: three actuators at `speed` times real time, of which one begins to leak after two simulated
#: minutes. `port`: port of the monitor's page.
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
#: Lets one simulation run at a time.
_simulation_lock = Lock()


def make_simulated_sources(settings: MonitorSettings, say: Callable[[str], None]) -> list[Source]:
    """Build a source of samples for each actuator whose settings contain `simulate`.

    `say`: called with a message when a simulation begins, and when all its samples are delivered.
    """
    return [
        _make_source(actuator.name, _make_experiment(actuator, actuator.simulate), actuator.simulate, say)
        for actuator in settings.actuator
        if actuator.simulate is not None
    ]


def _make_experiment(actuator: ActuatorSettings, settings: SimulateSettings) -> Experiment:
    """Build the experiment that simulates an actuator, with no more blocks than the monitor can tell apart."""
    try:
        experiment = Experiment.of(rig=actuator.rig, **settings.model_dump(exclude={"speed"}))
        if experiment.duration / BLOCK_S > MAX_IDENTITIES:
            raise InputError(f"duration must be at most {MAX_IDENTITIES * BLOCK_S:g} s, got {experiment.duration:g} s")
    except InputError as error:
        raise InputError(f"{actuator.name}: simulate: {error}") from None
    return experiment


def _make_source(name: str, experiment: Experiment, settings: SimulateSettings, say: Callable[[str], None]) -> Source:
    """Build a source that simulates the actuator `name` and submits its samples to the monitor in blocks of 1 s.

    The blocks arrive at `settings.speed` times real time. Those that the monitor has already stored are left out, and
    so is the rest after the last whole block.
    """

    def play(receiver: BlockReceiver) -> None:
        """Simulate the actuator, unless all blocks are stored, and submit each block when its time is over.

        Returns early if the receiver is stopping.
        """
        blocks = range(math.floor(experiment.duration / BLOCK_S))
        # number of the first block to submit: the store has all blocks before it, and none from it on
        first = bisect_left(blocks, True, key=lambda number: not receiver.store.is_known(name, block_identity(number)))
        if first < len(blocks):
            with _simulation_lock:
                if receiver.stopping.is_set():
                    return
                say(f"simulates {name}")
                run = simulate_experiment(experiment).recording
            recording = run.only([channel for channel in CHANNELS if channel in run])  # the monitor stores no others
            start_time = time.monotonic()
            for number in blocks[first:]:
                due = start_time + (number + 1 - first) * BLOCK_S / settings.speed
                if receiver.stopping.wait(max(0.0, due - time.monotonic())):
                    return
                # the ends follow the time: a block has one sample more or less if the rate is no whole number
                begin, end = (round(count * BLOCK_S * recording.rate) for count in (number, number + 1))
                samples = recording.samples(slice(begin, end))
                receiver.submit(SourceBlock(name, block_identity(number), samples))
        say(f"{name}: the simulated time is over")

    def block_identity(number: int) -> str:
        """Return the text by which the store recognises a block: the experiment's key and the block's number."""
        return f"simulated {experiment.key()} {number}"

    return play
