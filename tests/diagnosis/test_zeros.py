"""A zero of a pressure sensor hides no leak, and none is invented where friction changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inference.block_stream import BlockStream
from sealscope.diagnosis.inference.blocks import ColumnRoles, offset_cost, offset_penalty
from sealscope.diagnosis.inference.equations.balances import equations
from sealscope.diagnosis.inference.sensor_errors import area_mismatch
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.parameters import load_rig
from sealscope.units import BAR

DRAWS = [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 5))]


def drawn_duty(random: np.random.Generator) -> dict[str, object]:
    command = f"{random.uniform(3.0, 7.0):.2g} sin({random.uniform(2.0, 4.0):.2g}t)"
    return {"command": command, "duration": 60.0, "seed": int(random.integers(1, 1000))}


@pytest.mark.parametrize("draw", DRAWS)
def test_friction_that_rises_is_no_leak_of_a_single_rod(draw: int) -> None:
    random = np.random.default_rng(300 + draw)
    onset = random.uniform(20.0, 40.0)
    recording = ss.simulate(rig="single-rod-eha", fault=f"friction +20 % from {onset:.1f} s", **drawn_duty(random))
    diagnosis = diagnose(recording, rig="single-rod-eha")
    assert diagnosis.verdict != "leak"
    assert "p_A - p_B reads" not in diagnosis.reason
    assert "displacement over area" not in diagnosis.reason


@pytest.mark.parametrize("draw", DRAWS)
def test_a_zero_changes_neither_verdict_nor_size(draw: int) -> None:
    random = np.random.default_rng(400 + draw)
    leak, onset = random.uniform(0.02, 0.06), random.uniform(20.0, 40.0)
    recording = ss.simulate(leak=f"{leak:.3g} L/min from {onset:.1f} s", **drawn_duty(random))
    name, bar = str(random.choice(["p_A", "p_B"])), float(random.choice([-6.0, -3.0, 3.0, 6.0]))
    shifted = replace(recording, channels={**recording.channels, name: recording[name] + bar * BAR})
    sizes = []
    for case in (recording, shifted):
        diagnosis = diagnose(case, rig="thesis")
        assert diagnosis.verdict == "leak"
        sizes.append(diagnosis.leak_lpm)
    assert sizes[1] == pytest.approx(sizes[0], rel=0.05)


def test_areas_speak_against_a_zero_that_exchanges_the_loaded_sides() -> None:
    """Without a load B carries both strokes of a single rod; with a wrong zero A seems to carry one, with B's area."""
    rig = load_rig("single-rod-eha")
    recording = ss.simulate(rig=rig, command="4 sin(3t)", duration=30.0, seed=2).only(("theta", "x", "p_A", "p_B"))
    (balance,) = equations(rig, frozenset(recording.channels))
    columns = (ColumnRoles(balance),)
    mismatch = {}
    for bar in (0.0, -3.6):
        stream = BlockStream((balance,), recording.rate, n_first=None, offset=bar * BAR)
        blocks = stream.push(dict(recording.channels), last=True)
        assert blocks is not None
        mismatch[bar] = area_mismatch(blocks, columns, balance, INFERENCE.size.area)
        # a ratio of the areas that nobody stated is no contradiction
        assert area_mismatch(blocks, columns, balance, 10.0) < 2.0
    assert mismatch[0.0] < 2.0
    assert mismatch[-3.6] > 30.0


def test_the_penalty_of_a_zero_is_its_cost_without_the_width_of_the_prior() -> None:
    usual, far = INFERENCE.zero.pressure, INFERENCE.zero.far
    for offset in np.random.default_rng(5).uniform(-3.0, 3.0, 20) * far:
        assert 0.0 <= offset_penalty(float(offset)) <= float(offset_cost(offset))
        if abs(offset) > 5.0 * usual:
            expected = float(offset_cost(offset)) - 2.0 * np.log(far / usual)
            assert offset_penalty(float(offset)) == pytest.approx(expected)
