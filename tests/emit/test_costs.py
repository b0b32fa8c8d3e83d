"""Code, state and instructions of a controller's program: `benchmarks/controller_costs.py` on fewer blocks."""

from __future__ import annotations

import shutil
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

import sealscope as ss
from sealscope.diagnosis.live.kernel.stream import StreamSettings
from sealscope.emit.stream_program import stream_program


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["m7", "m4f"])
def test_no_call_takes_a_controller_long(processor):
    """A Cortex-M7 in double precision, and an M4F in single precision."""
    pytest.importorskip("unicorn", reason="unicorn emulates the processor: pip install unicorn")
    spec = spec_from_file_location(
        "controller_costs", Path(__file__).resolve().parents[2] / "benchmarks" / "controller_costs.py"
    )
    benchmark = module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    if not shutil.which(benchmark.COMPILER):
        pytest.skip(f"needs {benchmark.COMPILER} with newlib, of Debian's gcc-arm-none-eabi")
    unit = stream_program(StreamSettings.from_rig(ss.load_rig("thesis"), 25.0))
    if processor == "m4f":
        unit = benchmark.single_unit(unit)
    costs = benchmark.count_costs(unit, processor, full_blocks=150)
    assert costs.code_bytes <= 24000 and costs.state_bytes <= (48000 if processor == "m4f" else 64000)
    assert 0 < costs.sample <= 4000 and 0 < costs.step <= 50000
    assert all(count for part, count in costs.parts.items() if part != "IDLE"), costs.parts
