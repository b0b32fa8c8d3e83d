"""What a machine's file states to a stream that watches the machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.watched import WatchedMachine, load_watched
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig

#: Leakage of the pump of the recorded machine [m^3/(s Pa)].
PUMP = 2e-13


def record(seed: int, duration: str = "40 s") -> ss.Recording:
    """Record a machine of which nobody knows a rig."""
    rig = ss.load_rig("thesis").with_overrides({"pump.G_pump": PUMP})
    recording = ss.simulate(rig=rig, command="3 sin(4t)", duration=duration, seed=seed)
    return replace(recording, provenance={"start": f"2024-05-0{seed}T08:00"})


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> WatchedMachine:
    folder = tmp_path_factory.mktemp("machine")
    for seed in (1, 2, 3):
        ss.write(record(seed), folder / f"run{seed}.nc")
    return load_watched(str(ss.write_machine(ss.commission(folder), folder / "machine.toml")))


def test_the_healthy_level_needs_no_stated_size(watched: WatchedMachine) -> None:
    """The stream computes its flows with the same assumed sizes, so that the two can be compared."""
    assert watched.healthy.level == pytest.approx(PUMP, rel=0.5)
    assert watched.healthy.deviation > 0.0


def test_a_healthy_machine_without_stated_sizes_raises_no_alarm(watched: WatchedMachine) -> None:
    stream = ss.watch(watched.rig, learn_hours=1.0, healthy=watched.healthy)
    stream.update(record(4, "120 s"))
    assert stream.leak is None


def test_a_flow_meter_measures_no_displacement(tmp_path: Path) -> None:
    rig = ss.load_rig("thesis")
    stated = unstated_rig().with_areas(rig.cylinder.A_A, rig.cylinder.A_B, source="nameplate")
    for seed in (1, 2):
        recording = record(seed)
        flow = recording["omega"] * rig.pump.q_b / 6.283185307179586
        channels = {name: recording[name] for name in ("p_A", "p_B", "x")} | {"q_pump": flow}
        units = {name: recording.units[name] for name in ("p_A", "p_B", "x")} | {"q_pump": "m^3/s"}
        ss.write(replace(recording, channels=channels, units=units), tmp_path / f"run{seed}.nc")
    machine = ss.commission(tmp_path, rig=stated)
    watched = load_watched(str(ss.write_machine(machine, tmp_path / "machine.toml")))
    assert not watched.rig.states("pump.q_b")
