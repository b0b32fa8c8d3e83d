"""One description of the stream: a term that is added to the table of terms reaches Python, C, ST and the unit."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.inference.equations import balances
from sealscope.diagnosis.inference.equations.terms import expressed_term
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.kernel.stream import RESULTS, WINDOW
from sealscope.diagnosis.live.live_balance import LiveBalance, NotJudged
from sealscope.emit.c_export import parts_a_sample
from sealscope.fmu.sensor import sensor_sources

from ..diagnosis.balance_machine import machine
from .test_stream import RIG, c_stream, has_compiler, run_st, samples_of, unit_at

NAMES = ("p_A", "p_B", "theta", "x")
EXPRESSION = "mean(x) * mean(x) * change(p_A)"
pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C compiler")


def python_conductance(recording):
    live = LiveBalance(RIG, NAMES)
    channels = {name: recording[name] for name in NAMES}
    shown = live.take(SampleRun(recording.t, channels, recording.rate, follows=False))
    return [block.total for part in shown if not isinstance(part, NotJudged) for block in part]


@pytest.mark.slow
def test_a_new_term_reaches_python_c_st_and_the_unit(monkeypatch):
    rate = 16.0
    recording = machine(4, duration=66.0, rate=rate)
    samples, before = samples_of(recording), unit_at(rate)
    results = list(c_stream(before).feed(samples, parts_a_sample(before.settings)))
    python_before = python_conductance(recording)

    term = expressed_term(
        "compliance A over the stroke, squared", "m/Pa", EXPRESSION, "air in the oil",
        drift="compliance", needs=("p_A", "x"),
    )  # fmt: skip
    monkeypatch.setattr(balances, "_CYLINDER", (term, *balances._CYLINDER))
    unit = unit_at(rate)
    assert set(unit.settings.expressions) - set(before.settings.expressions) == {EXPRESSION}
    changed = np.array(list(c_stream(unit).feed(samples, parts_a_sample(unit.settings))))
    conductance = RESULTS.index("conductance")
    assert changed[-1, conductance] != results[-1][conductance] and changed[-1, conductance] > 0.0
    # Python, over files: the same conductances, from the same expression
    python = python_conductance(recording)
    assert python != python_before
    n = int(changed[-1, RESULTS.index("blocks")])
    assert np.mean(python[:n][-WINDOW:]) == pytest.approx(changed[-1, conductance], rel=1e-12)
    in_st, _ = run_st(unit, samples)
    assert in_st == pytest.approx(changed[-len(in_st) :], rel=1e-9, abs=1e-25)
    increments, added = len(before.settings.expressions), len(unit.settings.expressions)
    source = sensor_sources(unit, "a machine")["leak.h"]
    assert f"leak_real increments[{added}];" in source and f"increments[{increments}];" not in source
