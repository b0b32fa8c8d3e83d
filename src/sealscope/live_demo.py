"""Three simulated actuators watched live, many times faster than real: one of them begins to leak."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from sealscope.monitor.service import Service, Source
from sealscope.monitor.settings import MonitorSettings
from sealscope.monitor.sources.source_block import BlockReceiver, SourceBlock
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate

#: Name -> command and leak of each actuator.
ACTUATORS: dict[str, tuple[str, str | None]] = {
    "press 1": ("3 sin(4t)", None),
    "press 2": ("2.5 sin(4t)", "0.0042 L/min from 120 s"),
    "clamp": ("3 sin(5t)", None),
}
#: Samples that a block holds [s], and how long the actuators are simulated [s].
BLOCK_S, DURATION_S = 1.0, 1200.0


def demo_settings(folder: Path, port: int) -> MonitorSettings:
    """Return the settings of the demo: what is learned is learned in 100 s."""
    return MonitorSettings.model_validate(
        {
            "database": str(folder / "monitor.db"),
            "page": {"port": port},
            "defaults": {"learn_hours": 100.0 / 3600.0, "warning_lpm": 0.001, "error_lpm": 0.01},
            "actuator": [{"name": name} for name in ACTUATORS],
        }
    )


def simulated_source(speed: float, say: Callable[[str], None], duration: float = DURATION_S) -> Source:
    """Return a source that simulates the actuators and plays them `speed` times faster than real time."""

    def play(receiver: BlockReceiver) -> None:
        recordings: dict[str, Recording] = {}
        for number, (name, (command, leak)) in enumerate(ACTUATORS.items()):
            say(f"simulates {name}")
            recordings[name] = simulate(command=command, leak=leak, duration=duration, seed=number)
        began = time.monotonic()
        for block in range(round(duration / BLOCK_S)):
            receiver.stopping.wait(max(0.0, began + (block + 1) * BLOCK_S / speed - time.monotonic()))
            if receiver.stopping.is_set():
                return
            for name, recording in recordings.items():
                count = round(BLOCK_S * recording.rate)
                samples = recording.samples(slice(block * count, (block + 1) * count))
                receiver.hand(SourceBlock(name, f"simulated {block}", samples))
        say("the simulated time is over; the page stays until Ctrl-C")

    return play


def live_demo(folder: Path, port: int, speed: float, say: Callable[[str], None]) -> Service:
    """Return the service of the demo, its database in `folder`."""
    return Service(demo_settings(folder, port), sources=[simulated_source(speed, say)])
