"""The kernels' own code for a GPU, run on the processor: `python gpu_code.py` compares batches and prints the worst.

The intermediate code that numba-cuda makes for the device is read again for this processor (its typed pointers made
plain, the thread's number a global), compiled, and called once for each thread; arrays stay in ordinary memory. So all
but the last step to the GPU's instructions and the GPU's own memory are what a GPU runs. Needs numba-cuda and libnvvm.
"""

from __future__ import annotations

import ctypes
import json
import re
from types import SimpleNamespace
from typing import Any

import gpu_runs
import llvmlite.binding as llvm
import numba
import numba.cuda.dispatcher
import numpy as np
from numba import cuda, types
from numba.cuda.cudadrv import nvvm

from sealscope.simulation.batch import gpu as batch_gpu
from sealscope.simulation.batch.batch import simulate_batch
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.experiment import Experiment

KERNELS = ("_advance_rk4", "_advance_imex", "_sense", "_move", "_clear")
SPECIAL = {"tid": "THREAD", "ctaid": "BLOCK", "ntid": "THREADS"}
#: The device's own library functions that the laws need, in LLVM's names.
LIBRARY = {"fabs": 1, "sqrt": 1, "copysign": 2, "pow": 2, "fmin": 2, "fmax": 2}
RENAMED = {"fmin": "minnum", "fmax": "maxnum"}
POINTER = re.compile(r'(?:\bi\d+|\bdouble|\bptr|%"[^"]+"|\{[^{}]*\}|\[[^\[\]]*\])\s?\*')

made_for_device: list[str] = []


def surroundings() -> str:
    """What a GPU and its library give: the thread's place, and elementary functions."""
    text = ""
    for name, place in SPECIAL.items():
        text += (
            f"@{place} = global i32 0\ndefine i32 @special.{name}() {{\n %a = load i32, ptr @{place}\n ret i32 %a\n}}\n"
        )
    for name, arity in LIBRARY.items():
        own = f"@llvm.{RENAMED.get(name, name)}.f64"
        named = ", ".join(f"double %x{k}" for k in range(arity))
        text += f"declare double {own}({', '.join(['double'] * arity)})\n"
        text += f"define double @__nv_{name}({named}) {{\n %r = call double {own}({named})\n ret double %r\n}}\n"
    return text


def for_this_processor(text: str) -> str:
    """The device's intermediate code as a processor's compiler takes it."""
    lines = []
    for line in text.splitlines():
        if line.startswith(("target", "!")):
            continue
        plain, before = re.sub(r", ![a-z]+ !\d+", "", line), ""
        while plain != before:
            before, plain = plain, POINTER.sub("ptr", plain)
        lines.append(plain)
    return re.sub(r"llvm\.nvvm\.read\.ptx\.sreg\.(\w+)\.x", r"special.\1", "\n".join(lines))


def flattened(kind: Any, value: Any) -> list[tuple[Any, Any]]:
    """An argument as the kernel takes it: arrays with their sizes and strides, tuples item by item."""
    if isinstance(kind, types.Array):
        long = ctypes.c_int64
        found = [(ctypes.c_void_p, None)] * 2 + [(long, value.size), (long, value.itemsize)]
        found.append((ctypes.c_void_p, value.ctypes.data))
        return found + [(long, number) for number in (*value.shape, *value.strides)]
    if isinstance(kind, types.BaseTuple):
        return [one for k, v in zip(kind, value, strict=True) for one in flattened(k, v)]
    if kind == types.boolean:
        return [(ctypes.c_int8, int(value))]
    return [(ctypes.c_double, value) if kind == types.float64 else (ctypes.c_int64, int(value))]


class OnProcessor:
    """A kernel whose threads run one after the other on the processor."""

    def __init__(self, kernel: Any) -> None:
        self.function, self.compiled = kernel.py_func, {}

    def _compile(self, kinds: tuple[Any, ...]) -> Any:
        made_for_device.clear()
        cuda.compile_ptx(self.function, kinds, cc=(9, 0), device=False)
        whole = llvm.parse_assembly(surroundings())
        for text in made_for_device:
            whole.link_in(llvm.parse_assembly(for_this_processor(text)))
        machine = llvm.Target.from_default_triple().create_target_machine(opt=2)
        whole.triple, whole.data_layout = llvm.get_default_triple(), str(machine.target_data)
        entry = next(
            one.name for one in whole.functions
            if self.function.__name__ in one.name and str(one).lstrip().startswith("define void")
        )  # fmt: skip
        engine = llvm.create_mcjit_compiler(whole, machine)
        engine.finalize_object()
        places = [ctypes.c_int32.from_address(engine.get_global_value_address(name)) for name in SPECIAL.values()]
        return engine, engine.get_function_address(entry), places

    def __getitem__(self, grid: tuple[int, int]) -> Any:
        def call(*values: Any) -> None:
            kinds = tuple(
                types.Array(numba.from_dtype(one.dtype), one.ndim, "C") if isinstance(one, np.ndarray)
                else types.int64 if isinstance(one, int) else numba.typeof(one)
                for one in values
            )  # fmt: skip
            assert all(one.flags.c_contiguous for one in values if isinstance(one, np.ndarray))
            if kinds not in self.compiled:
                self.compiled[kinds] = self._compile(kinds)
            _, address, (thread, block, threads) = self.compiled[kinds]
            flat = [one for kind, value in zip(kinds, values, strict=True) for one in flattened(kind, value)]
            run = ctypes.CFUNCTYPE(None, *[kind for kind, _ in flat])(address)
            threads.value = grid[1]
            for block.value in range(grid[0]):
                for thread.value in range(grid[1]):
                    run(*[value for _, value in flat])

        return call


class Rows(np.ndarray):
    """An array that is on the device."""

    def copy_to_host(self) -> np.ndarray:
        return np.array(self)


def stand_in(free_bytes: float) -> None:
    """Let the processor stand in for a GPU with so much memory."""
    cuda.is_available = lambda: True
    cuda.to_device = lambda rows: np.array(rows, order="C").view(Rows)
    cuda.device_array = lambda shape: np.full(shape, np.nan).view(Rows)
    cuda.current_context = lambda: SimpleNamespace(get_memory_info=lambda: (free_bytes, free_bytes))


def take_over() -> None:
    """Compile for compute capability 9.0 whatever is here, keep the intermediate code, and run it here."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    numba.cuda.dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=(9, 0))
    compile_further = nvvm.compile_ir

    def kept(parts: Any, **options: Any) -> Any:
        made_for_device[:] = [parts] if isinstance(parts, str) else list(parts)
        return compile_further(parts, **options)

    nvvm.compile_ir = kept
    for name in KERNELS:
        setattr(batch_gpu, name, OnProcessor(getattr(batch_gpu, name)))


def many(throttles: str, count: int) -> list[Experiment]:
    """More runs than a warp has threads, of five rigs."""
    first = Experiment.of(set={"line.orifices": throttles})
    rigs = [first.rig.with_overrides({"friction.F_v": 300.0 + k}) for k in range(5)]
    words = [f"{2 + 0.01 * k} sin(4t)" for k in range(count)]
    return [
        Experiment.of(rig=rigs[k % 5], command=words[k], leak="C = 2e-11 from 3 s", duration=6.0, seed=k)
        for k in range(count)
    ]


def drifting() -> list[Experiment]:
    """Two machines of the bench, whose parts and instruments drift."""
    return [draw("bench", seed, duration=6.0).experiment(duration=6.0) for seed in (3, 4)]


def worst(one: Any, other: Any) -> float:
    """Largest relative difference of RMS (their absence alike), flows and sizes."""
    assert np.array_equal(np.isnan(one.rms), np.isnan(other.rms))
    pairs = ((one.rms, other.rms), (one.mean_leak_lpm, other.mean_leak_lpm), (one.coefficients, other.coefficients))
    with np.errstate(invalid="ignore", divide="ignore"):
        off = [np.where(a == b, 0.0, np.abs(a / b - 1.0)) for a, b in pairs]
    return max(float(np.nanmax(np.append(values, 0.0))) for values in off)


def main() -> None:
    take_over()
    stand_in(1e9)
    found = {}
    expected = dict(gpu_runs.batches("cpu"))
    for name, batch in gpu_runs.batches("gpu"):
        found[name] = worst(batch, expected[name])
    air = {"line.orifices": "present", "fluid.air": 0.005, "fluid.p_charge": "1 [MPa]"}
    others = {
        "70 free": many("absent", 70),
        "40 throttled": many("present", 40),
        "air": [Experiment.of(set=air, duration=2.0, seed=k) for k in range(2)],
        "drifting": drifting(),
    }
    for name, runs in others.items():
        found[name] = worst(simulate_batch(runs, device="gpu"), simulate_batch(runs))
    stand_in(4e6)  # a GPU that holds one group at a time
    found["in pieces"] = worst(simulate_batch(others["70 free"], device="gpu"), simulate_batch(others["70 free"]))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
