"""The GPU's path of batches, as far as a machine without a GPU can tell: in numba's simulator, as machine code for one,
and by its rules. On a machine with one: the same batches on both."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sealscope.compiled import kernel, law
from sealscope.errors import InputError, SimulationFailed
from sealscope.physics.lanes import lowered, store
from sealscope.physics.rig import CHOICES, NUMBERS, rig_numbers
from sealscope.physics.vector.fixed import FIXED, left_to_table, pair, settled, taken
from sealscope.simulation.batch.batch import runner_of, simulate_batch
from sealscope.simulation.experiment import Experiment

from . import gpu_runs

HERE = Path(__file__).parent
NO_EXTRA = importlib.util.find_spec("numba_cuda") is None


def run_program(*words: str, **environment: str) -> str:
    """Output of a Python program in a process of its own."""
    done = subprocess.run(
        [sys.executable, *words], env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def assert_same(found, expected, tolerance):
    np.testing.assert_allclose(found.rms, expected.rms, rtol=tolerance)
    np.testing.assert_allclose(found.mean_leak_lpm, expected.mean_leak_lpm, rtol=tolerance)
    np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=tolerance)


@pytest.mark.slow
@pytest.mark.long
def test_the_simulated_gpu_finds_what_the_processor_finds(tmp_path):
    """Kernels, layout, chunks, noise, filters and sizing; each thread in plain Python, with the laws' own source."""
    if importlib.util.find_spec("numba.cuda.simulator") is None:
        pytest.skip("numba has no CUDA simulator here")
    file = tmp_path / "found.npz"
    run_program(str(HERE / "gpu_runs.py"), "gpu", str(file), NUMBA_ENABLE_CUDASIM="1", NUMBA_DISABLE_JIT="1")
    found = np.load(file)
    for name, batch in gpu_runs.batches("cpu"):
        np.testing.assert_allclose(found[f"{name} rms"], batch.rms, rtol=1e-11)
        np.testing.assert_allclose(found[f"{name} flow"], batch.mean_leak_lpm, rtol=1e-11)
        np.testing.assert_allclose(found[f"{name} size"], batch.coefficients, rtol=1e-11)
    assert np.ptp(found["free rms"][:, 0, 1, 2]) > 10.0  # the runs do differ, and have details
    assert found["sized flow"][0] == pytest.approx(0.05, rel=2e-3)


COMPILE = """
import sys
from types import SimpleNamespace
import numba
import numba.cuda.dispatcher
from numba import cuda, types

# a device function asks the GPU for its kind even where code is made for a stated one
numba.cuda.dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=(9, 0))
from sealscope.physics.vector.fixed import left_to_table
from sealscope.physics.rig import rig_numbers
from sealscope.simulation.batch import gpu as batch_gpu
from sealscope.simulation.experiment import Experiment


def rows(axes, kind=types.float64):
    return types.Array(kind, axes, "C")

def advance(values, own, rig="thesis"):
    numbers = numba.typeof(left_to_table(rig_numbers(Experiment.of(rig=rig, set=values).rig), own, choices=True))
    return (rows(3), types.float64, types.int64, rows(1), rows(2), rows(3), rows(3), rows(4), rows(1, types.int64),
            numbers, types.int64, rows(4), types.int64, rows(3))

taps = types.UniTuple(types.float64, 16)
ints = types.int64, types.int64
sense = (rows(4), *ints, rows(1), rows(4), *ints, rows(4), rows(2), rows(3), rows(4), taps, taps,
         rows(1, types.int64), rows(5))
wanted = {
    "rk4": (batch_gpu._advance_rk4, advance({}, ["F_v", "K_oil"])),
    "imex": (batch_gpu._advance_imex, advance({"line.orifices": "present"}, ["F_v", "K_oil"])),
    "air": (batch_gpu._advance_imex, advance({"line.orifices": "present", "fluid.air": 0.01}, [])),
    "valve": (batch_gpu._advance_rk4, advance({}, ["F_v", "o_PA", "p_set"], "servo-valve")),
    "sense": (batch_gpu._sense, sense),
}
for name, (kernel, kinds) in wanted.items():
    code, _ = cuda.compile_ptx(kernel.py_func, kinds, cc=(9, 0), device=False)
    with open(f"{sys.argv[1]}/{name}.ptx", "w") as file:
        file.write(code)
"""


@pytest.fixture(scope="module")
def compiler():
    """Skips where kernels cannot be compiled."""
    if NO_EXTRA:
        pytest.skip("numba-cuda is not installed (pip install 'sealscope[gpu]')")
    if not run_program("-c", "from numba.cuda.cudadrv import nvvm; print(nvvm.is_available() or '')").strip():
        pytest.skip("no libnvvm is found: kernels cannot be compiled here")


@pytest.mark.slow
def test_the_device_s_own_code_run_on_the_processor_finds_what_the_processor_finds(compiler):
    """Warps of 32, several blocks and pieces, fixed numbers, the check of both, drifting instruments, air."""
    found = json.loads(run_program(str(HERE / "gpu_code.py")).splitlines()[-1])
    assert {"free", "sized", "70 free", "40 throttled", "air", "drifting", "in pieces"} <= set(found)
    assert max(found.values()) < 1e-11, found


@pytest.fixture(scope="module")
def machine_code(compiler, tmp_path_factory):
    """The kernels' code for compute capability 9.0, by name, and the folder where it lies."""
    folder = tmp_path_factory.mktemp("ptx")
    run_program("-c", COMPILE, str(folder))
    return {file.stem: file.read_text() for file in folder.glob("*.ptx")}, folder


def test_the_kernels_compile_for_a_gpu_that_is_not_there(machine_code):
    code, _ = machine_code
    assert set(code) == {"rk4", "imex", "air", "valve", "sense"}
    for text in code.values():
        assert ".target sm_90" in text
        arithmetic = re.findall(r"\b(?:add|sub|mul|fma\.rn|div\.rn|sqrt\.rn)\.f(32|64)", text)
        assert len(arithmetic) > 100
        assert "32" not in arithmetic  # doubles throughout
    # a step of the Runge-Kutta method divides in an orifice's flow alone (four stages and the account): all else is
    # divided by numbers that stand still, outside the loop
    assert code["rk4"].count("div.rn.f64") < 5 + 5
    assert len(re.findall(r"@%p\d+ bra", code["rk4"])) < 60  # the rig's choices are made before the code is


def test_the_kernels_fit_into_registers(machine_code):
    assembler = shutil.which("ptxas")
    if assembler is None:
        pytest.skip("no ptxas here to count registers")
    code, folder = machine_code
    spilt = {}
    for name in code:
        call = [assembler, "-arch=sm_90", "-v", str(folder / f"{name}.ptx"), "-o", str(folder / f"{name}.cubin")]
        told = subprocess.run(call, capture_output=True, text=True, check=True).stderr
        spilt[name] = sum(int(count) for count in re.findall(r"(\d+) bytes spill", told))
    assert spilt["rk4"] == spilt["sense"] == 0
    assert max(spilt.values()) < 1000


@pytest.mark.skipif(NO_EXTRA, reason="numba-cuda is not installed (pip install 'sealscope[gpu]')")
def test_a_gpu_finds_what_the_processor_finds():
    from numba import cuda

    if not cuda.is_available():
        pytest.skip("no GPU here: the kernels cannot run")
    for (name, found), (_, expected) in zip(gpu_runs.batches("gpu"), gpu_runs.batches("cpu"), strict=True):
        assert_same(found, expected, 1e-6), name
    one = Experiment.of(command="3 sin(4t)", duration=20.0, seed=7)
    many = [Experiment.of(command=f"{2 + k % 7 / 7} sin(4t)", duration=20.0, seed=k, step=1e-3) for k in range(100)]
    assert_same(simulate_batch([one, *many], device="gpu"), simulate_batch([one, *many]), 1e-6)


def test_what_is_missing_for_a_gpu_is_said(monkeypatch):
    with pytest.raises(InputError, match="device must be one of cpu, gpu, got 'tpu'"):
        simulate_batch([Experiment.of(duration=2.0)], device="tpu")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"needs numba-cuda, which is not installed: pip install 'sealscope\[gpu\]'"):
        runner_of("gpu")


def test_a_gpu_that_is_not_there_is_refused(monkeypatch):
    batch_gpu = pytest.importorskip("sealscope.simulation.batch.gpu", reason="numba has no CUDA target here")
    monkeypatch.setattr(batch_gpu.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="needs an NVIDIA GPU and its driver, and none is found; use device cpu"):
        batch_gpu.require_device()


def test_a_gpu_that_disagrees_is_refused():
    batch_gpu = pytest.importorskip("sealscope.simulation.batch.gpu", reason="numba has no CUDA target here")
    refuse = batch_gpu.refuse_disagreement
    expected = np.random.default_rng(1).uniform(1.0, 2.0, (4, 2, 1, 5))
    places = [3, 5, 8, 13]
    refuse(expected * (1.0 + 1e-9), expected, places)
    refuse(np.full_like(expected, np.nan), np.full_like(expected, np.nan), places)
    one_count = expected.copy()
    one_count[2, 1] *= 1.001  # a reading on the edge of a count
    refuse(one_count, expected, places)
    for factor, part in ((1.0 + 1e-5, np.s_[:]), (1.05, np.s_[2, 0, 0, 3]), (np.nan, np.s_[2, 0, 0, 3])):
        other = expected.copy()
        other[part] *= factor
        with pytest.raises(SimulationFailed, match="must find what the processor finds"):
            refuse(other, expected, places)
    with pytest.raises(SimulationFailed, match="of run 8 an RMS is"):
        refuse(other, expected, places)


def hold(x):
    """A fixed number of a double, for compiled code on a processor too."""
    return x


lowered(hold, 1, lambda *_: FIXED, lambda context, builder, kinds, values: pair(context, builder, values[0]))


@law
def every_use(x, p):
    """What the laws do with a rig's numbers."""
    least = min(max(x, -p), p) + max(p, 0.5 * p) + abs(p) + (-p)
    if x > p and not (p <= 0.0) and p >= 0.1 and p < 100.0:
        least = least + math.copysign(p, x)
    return least + x / p + p / x + 1 / p + (p - x) * p + 2 * p + p * p / (p + 1.0)


@kernel
def of_number(x, p):
    return every_use(x, p)


@kernel
def of_fixed(x, p):
    return every_use(x, hold(p))


def test_a_fixed_number_is_used_as_a_number():
    for x, p in np.random.default_rng(5).uniform(0.2, 3.0, (50, 2)):
        assert of_fixed(x, p) == pytest.approx(of_number(x, p), rel=1e-13)


@kernel
def numbers_of(table, own, none, chosen, out):
    store(out, 0, taken(none, table, 1) + taken(own, table, 0))
    return settled(none), settled(chosen), settled(own > 1.0)


def test_a_number_comes_from_the_table_where_it_is_left_out():
    table, out = np.arange(16.0).reshape(2, 8), np.zeros((1, 8))
    assert numbers_of(table, 2.5, (), (True,), out) == (False, True, True)
    np.testing.assert_array_equal(out[0], table[1] + 2.5)
    assert taken((), table, 1) == 8.0  # plain Python: the first thread's


def test_numbers_are_left_to_the_table_and_choices_settled(check_rig):
    numbers = rig_numbers(check_rig(True))
    left = left_to_table(numbers, NUMBERS)
    assert {name for name in left._fields if getattr(left, name) == ()} >= set(NUMBERS)
    assert all(getattr(left, name) == getattr(numbers, name) for name in CHOICES)
    known = left_to_table(numbers, ["F_v"], choices=True)
    assert (known.F_v, known.throttled, known.position_dependent) == ((), (True,), ())
    assert known.K_oil == numbers.K_oil
