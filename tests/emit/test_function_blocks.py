"""The function blocks beside the estimator: what they compute, and that Structured Text computes the same."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.emit import function_blocks as blocks
from sealscope.emit.st_export import Piece, auxiliary_programs, templates
from sealscope.emit.structured_text import StText

from .st_evaluator import Program

RATE, AREA = 10.0, 2e-3


def program_of(name):
    """The Structured Text of one of the blocks."""
    part = StText(auxiliary_programs()[name], f"LEAK_{name}")
    texts = [part.render_state(), *(text for _, text in part.render_blocks())]
    values = {"text": part, "prefix": "LEAK", "n_recorded": blocks.N_RECORDED}
    texts.append(templates().get_template(f"{name.lower()}.st.j2").render(values))
    for text in texts:
        assert Piece("", text).kind
    return Program("\n".join(texts))


def hold(random, creep_mm_per_min, seconds, noise=2e-6, encoder=0.0):
    """Positions [m] of a load that sinks, with noise and steps of an encoder."""
    t = np.arange(round(seconds * RATE)) / RATE
    x = 0.1 + creep_mm_per_min / 6e4 * t + noise * random.standard_normal(len(t))
    return np.round(x / encoder) * encoder if encoder else x


def run_hold(x, limit_mm_per_min=0.0):
    """The state of a hold test by the kernel."""
    state = np.zeros(1, blocks.HOLD_LAYOUT).view(np.recarray)[0]
    blocks.start_hold(state)
    for value in x:
        blocks.add_hold_sample(state, float(value), RATE, AREA, limit_mm_per_min / 6e4)
    return state


def test_creep_of_a_held_load_lies_within_its_interval():
    random = np.random.default_rng(1)
    held = []
    for _ in range(24):
        creep, encoder = random.uniform(-3.0, 3.0), random.choice([0.0, 1e-5, 1e-4])
        state = run_hold(hold(random, creep, random.uniform(60.0, 200.0), 10.0 ** random.uniform(-6, -4.5), encoder))
        held.append(state.creep_low * 6e4 - 1e-3 <= creep <= state.creep_high * 6e4 + 1e-3)
        assert state.leak == pytest.approx(AREA * state.creep)
    assert np.mean(held) > 0.9


@pytest.mark.parametrize(("creep", "result"), [(0.5, blocks.PASS), (1.5, blocks.FAIL), (1.0, blocks.UNDECIDED)])
def test_a_limit_is_passed_or_failed_only_by_the_whole_interval(creep, result):
    state = run_hold(hold(np.random.default_rng(2), creep, 240.0, 1e-5), limit_mm_per_min=1.0)
    assert state.result == result
    assert (state.seconds_needed > 0.0) == (result == blocks.UNDECIDED)


def test_the_hold_test_in_structured_text_equals_the_kernel():
    program, random = program_of("HOLD"), np.random.default_rng(3)
    x = hold(random, 1.2, 100.0, 1e-5)
    x[40:45] = np.nan
    block = program.make("FB_HoldTest")
    for value in x.tolist():
        block(active=True, valid=bool(np.isfinite(value)), x=value, rate=RATE, area=AREA, limit_mm_per_min=2.0)
    state = run_hold(x, 2.0)
    assert block.creep_mm_per_min == pytest.approx(6e4 * state.creep, rel=1e-12)
    assert (block.creep_low, block.creep_high) == pytest.approx(
        (6e4 * state.creep_low, 6e4 * state.creep_high), rel=1e-9
    )
    assert block.leak_lpm == pytest.approx(6e4 * state.leak, rel=1e-12)
    assert block.result == state.result == blocks.PASS


def test_the_alarm_waits_holds_and_is_acknowledged():
    block = program_of("ALARM").make("FB_LeakAlarm")
    state = np.zeros(1, blocks.ALARM_LAYOUT).view(np.recarray)[0]
    blocks.start_alarm(state)
    random, seen = np.random.default_rng(4), []
    level = np.concatenate([np.full(40, 0.2), np.full(40, 1.3), np.full(40, 2.4), np.full(60, 1.9), np.full(40, 0.3)])
    for k, leak in enumerate(level + 0.02 * random.standard_normal(len(level))):
        valid, acknowledge = k % 37 != 5, k in (100, 200)
        limits = {"hysteresis": 0.1, "delay": 5}
        block(leak=float(leak), valid=valid, acknowledge=acknowledge, warning_limit=1.0, alarm_limit=2.0, **limits)
        blocks.add_alarm_sample(state, float(leak), valid, acknowledge, 1.0, 2.0, **limits)
        assert (block.warning, block.alarm, block.latched) == (state.level >= 1, state.level == 2, state.latched == 1)
        assert block.status == state.status
        seen.append((int(state.level), int(state.latched)))
    assert seen[39] == (0, 0) and seen[79] == (1, 0)
    assert seen[119] == (2, 1)  # acknowledged too early: the leak is still above its limit
    assert seen[160] == (2, 1)  # within the hysteresis
    assert seen[199] == (0, 1) and seen[200] == (0, 0)


def test_the_recorder_keeps_the_samples_around_a_trigger():
    block = program_of("RECORDER").make("FB_Recorder")
    n_before, n = 2500, 2500 + blocks.N_AFTER + 50
    for k in range(n):
        block(enable=True, p_a=float(k), p_b=0.0, flow=0.0, x=0.0, trigger=k == n_before, release=False)
    assert block.frozen and block.stored == blocks.N_RECORDED
    ring = block.state.samples[: blocks.N_RECORDED]
    ordered = ring[block.oldest :] + ring[: block.oldest]
    last = n_before + blocks.N_AFTER - 1
    assert ordered == [float(k) for k in range(last - blocks.N_RECORDED + 1, last + 1)]
    block(enable=True, p_a=1.0, p_b=0.0, flow=0.0, x=0.0, trigger=False, release=True)
    assert not block.frozen and block.stored == 1
