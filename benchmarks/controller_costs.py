"""What the estimator of a controller costs: code, state, and instructions of each call, counted by an emulator.

    python benchmarks/controller_costs.py [--processor m7] [--precision double] [--rate 100] [--rig thesis]

The exported C is compiled for a Cortex-M7 or M4F by ``arm-none-eabi-gcc`` (Debian's gcc-arm-none-eabi with
libnewlib-arm-none-eabi), and its calls are run by the emulator ``unicorn`` (pip). Which calls: this machine's own
compilation of the same C runs a stream; its state before a call is copied to the emulator, which runs the call and
counts instructions, library functions included. The calls are those of the first blocks, of the first fit, of blocks
after it, and of blocks when the detector of steps holds the most onsets. An instruction takes one cycle or a few;
divisions and square roots take 14 to 30. Prints the size of code with its constants, of the state, and the most
instructions of `leak_sample` and of `leak_step` by the part of the work.
"""

from __future__ import annotations

import argparse
import ctypes
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sealscope as ss
from sealscope.diagnosis.live.kernel import stream as kernel
from sealscope.emit.c_export import parts_a_sample, render_c
from sealscope.emit.run_program import CompiledStream
from sealscope.emit.single_precision import learn_basis
from sealscope.emit.stream_program import StreamProgram, stream_program

COMPILER = "arm-none-eabi-gcc"
#: Options of each processor.
PROCESSORS = {
    "m7": ("-mcpu=cortex-m7", "-mfpu=fpv5-d16"),
    "m4f": ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"),
}
PARTS = (
    *(
        "IDLE",
        "PRODUCTS",
        "REDUCE",
        "NORMAL",
        "REWEIGH",
        "BLOCK",
        "FIT_SIGN",
        "FIT_ADD",
        "FIT",
        "FIT_PRECISION",
        "FIT_APPEND",
    ),
    *("TAKE", "WEIGH", "DECIDE", "BOUND", "FINISH"),
)
#: Functions of `DRIVER` that the emulator runs.
ENTRIES = ("run_sample", "run_step", "run_results")
#: Where code, data, stack, and the address that a function returns to are in the emulator's memory.
CODE, DATA, STACK, END = 0x08000000, 0x20000000, 0x30000000, 0x40000000
#: Functions that the emulator enters, and memory for their arguments and the state.
DRIVER = """\
#include "leak.h"

leak_state state;
leak_real reading[4];

void run_sample(void) { leak_sample(&state, reading[0], reading[1], reading[2], reading[3]); }
void run_step(void) { (void)leak_step(&state); }
void run_results(void) { leak_results(&state); }
int main(void)
{
    leak_init(&state);
    return 0;
}
"""


class Image(NamedTuple):
    """A linked program: its segments (address, content), symbols (address, size), and bytes of code and constants."""

    segments: list[tuple[int, bytes]]
    symbols: dict[str, tuple[int, int]]
    code_bytes: int


def read_elf(path: Path) -> Image:
    """Read a linked program of 32 bits, little endian, in the format ELF."""
    data = path.read_bytes()
    (first_segment, first_section) = struct.unpack_from("<II", data, 28)
    segment_size, n_segments, section_size, n_sections = struct.unpack_from("<4H", data, 42)
    segments, code_bytes = [], 0
    for k in range(n_segments):
        kind, offset, _, address, size = struct.unpack_from("<5I", data, first_segment + k * segment_size)
        if kind == 1:  # to be loaded
            segments.append((address, data[offset : offset + size]))
    sections = [struct.unpack_from("<10I", data, first_section + k * section_size) for k in range(n_sections)]
    symbols = {}
    for _, kind, flags, _, offset, size, link, _, _, _ in sections:
        if kind in (1, 0x70000001) and flags & 2:  # of the program's text and constants, in memory
            code_bytes += size
        if kind == 2:  # symbols
            names = sections[link][4]
            for place in range(offset, offset + size, 16):
                name, value, extent = struct.unpack_from("<III", data, place)
                text = data[names + name : data.index(b"\0", names + name)].decode()
                symbols[text] = value, extent
    return Image(segments, symbols, code_bytes)


def cross_compile(texts: dict[str, str], processor: str, folder: Path, optimise: str = "-Os") -> Image:
    """Compile and link the export's C for a processor."""
    for name, text in {**texts, "driver.c": DRIVER}.items():
        (folder / name).write_text(text)
    target = [*PROCESSORS[processor], "-mthumb", "-mfloat-abi=hard"]
    flags = ["-std=c99", optimise, "-ffp-contract=off", "-ffunction-sections", "-fdata-sections", "-Wall", "-Werror"]
    link = ["-nostartfiles", "-Wl,--gc-sections", "-Wl,-e,main", f"-Wl,-Ttext={CODE:#x}", f"-Wl,-Tdata={DATA:#x}"]
    link += [f"-Wl,--undefined={name}" for name in ENTRIES]
    files = [str(folder / name) for name in ("leak.c", "driver.c")]
    program = folder / "leak.elf"
    words = [COMPILER, *target, *flags, *files, *link, "-o", str(program), "-lm", "--specs=nosys.specs"]
    subprocess.run(words, check=True, capture_output=True)
    return read_elf(program)


class Emulator:
    """A processor that runs functions of a program and counts their instructions."""

    def __init__(self, image: Image) -> None:
        import unicorn
        from unicorn import arm_const

        self._image, self._registers = image, arm_const
        # a model that knows the instructions of both processors, and whose floating-point unit can be switched on
        self._machine = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB)
        self._machine.ctl_set_cpu_model(arm_const.UC_CPU_ARM_MAX)
        self._machine.reg_write(arm_const.UC_ARM_REG_C1_C0_2, 0xF << 20)
        self._machine.reg_write(arm_const.UC_ARM_REG_FPEXC, 1 << 30)
        for begin, size in ((CODE, 1 << 20), (DATA, 1 << 20), (STACK - (1 << 16), 1 << 16), (END, 1 << 12)):
            self._machine.mem_map(begin, size)
        for address, content in image.segments:
            self._machine.mem_write(address, content)
        self._lengths: dict[tuple[int, int], int] = {}
        self._count = 0
        self._machine.hook_add(unicorn.UC_HOOK_BLOCK, self._count_block)

    def _count_block(self, _: Any, address: int, size: int, __: Any) -> None:
        """Count the instructions of a straight piece of code, of 2 or 4 bytes each."""
        key = address, size
        if key not in self._lengths:
            code, place, count = bytes(self._machine.mem_read(address, size)), 0, 0
            while place < size:
                place += 4 if code[place + 1] >> 3 in (0b11101, 0b11110, 0b11111) else 2
                count += 1
            self._lengths[key] = count
        self._count += self._lengths[key]

    def write(self, symbol: str, content: bytes) -> None:
        """Write to the memory of a variable."""
        address, size = self._image.symbols[symbol]
        assert len(content) == size, (symbol, len(content), size)
        self._machine.mem_write(address, content)

    def read(self, symbol: str) -> bytes:
        """Read the memory of a variable."""
        return bytes(self._machine.mem_read(*self._image.symbols[symbol]))

    def run(self, symbol: str) -> int:
        """Run a function; return its instructions."""
        self._count = 0
        self._machine.reg_write(self._registers.UC_ARM_REG_SP, STACK)
        self._machine.reg_write(self._registers.UC_ARM_REG_LR, END | 1)
        self._machine.emu_start(self._image.symbols[symbol][0] | 1, END)
        return self._count


class Costs(NamedTuple):
    """Bytes of code with constants and of the state; most instructions of a sample and of each part of the work.

    `block`: of all parts at the end of a block; `onsets`: most onsets that the detector of steps held.
    """

    code_bytes: int
    state_bytes: int
    sample: int
    parts: dict[str, int]
    block: int
    results: int
    onsets: int

    @property
    def step(self) -> int:
        """Most instructions of a call of `leak_step`."""
        return max(self.parts.values())


def stream_samples(rate: float, seconds: float, seed: int) -> np.ndarray:
    """Record a moving actuator without a leak, as samples (n, 4) at a rate [Hz]."""
    recording = ss.simulate(command="3 sin(4t)", duration=f"{seconds} s", rate=f"{rate:g} Hz", seed=seed)
    return np.stack([recording[name] for name in ("p_A", "p_B", "theta", "x")], axis=1)


def iter_samples(samples: np.ndarray) -> Iterator[np.ndarray]:
    """Yield samples of some minutes again and again, with new noise."""
    random = np.random.default_rng(1)
    spread = 1e-4 * samples.std(axis=0)
    while True:
        yield from samples + spread * random.standard_normal(samples.shape)


def single_unit(unit: StreamProgram) -> StreamProgram:
    """Build the program in single precision, with the basis that a recording of 100 s shows."""
    texts = render_c(unit, prefix="leak", title="a machine", origin="a benchmark", alarm_rate=1.0)
    stream = CompiledStream(unit, texts, "leak")
    for _ in stream.feed(stream_samples(unit.settings.rate, 100.0, 2), parts_a_sample(unit.settings)):
        pass
    return stream_program(unit.settings._replace(basis=learn_basis(stream)))


def count_costs(
    unit: StreamProgram,
    processor: str = "m7",
    full_blocks: int = 4200,
    optimise: str = "-Os",
) -> Costs:
    """Count what a stream's program costs; `full_blocks`: blocks until the detector of steps holds the most onsets."""
    words = {"prefix": "leak", "title": "a machine", "origin": "a benchmark", "alarm_rate": 1.0}
    texts = render_c(unit, **words)
    with tempfile.TemporaryDirectory() as folder:
        image = cross_compile(texts, processor, Path(folder), optimise)
    native, emulator = CompiledStream(unit, texts, "leak"), Emulator(image)
    rate, n_parts = unit.settings.rate, parts_a_sample(unit.settings)
    sample, parts, most, block, onsets = 0, dict.fromkeys(PARTS, 0), 0, 0, 0
    n_first = kernel.LEARNED + 6
    for reading in iter_samples(stream_samples(rate, 100.0, 1)):
        n_ended = int(native.state.n_ended)
        is_counted = n_ended <= n_first or n_ended >= full_blocks
        if is_counted and int(native.state.phase) == kernel.IDLE:
            emulator.write(
                "reading", reading.astype(np.float64 if unit.precision == "double" else np.float32).tobytes()
            )
            emulator.write("state", bytes(native.state))
            sample = max(sample, emulator.run("run_sample"))
        onsets = max(onsets, int(native.state.steps_n_onsets))
        native._call("sample", *map(ctypes.c_double if unit.precision == "double" else ctypes.c_float, reading))
        for _ in range(n_parts if n_ended < full_blocks - 1 else 1 << 20):
            phase = int(native.state.phase)
            if phase == kernel.IDLE:
                most, block = max(most, block), 0
                break
            if is_counted:
                emulator.write("state", bytes(native.state))
                instructions = emulator.run("run_step")
                parts[PARTS[phase]] = max(parts[PARTS[phase]], instructions)
                block += instructions
            native._call("step")
        if n_ended >= full_blocks + 2:
            break
    emulator.write("state", bytes(native.state))
    results = emulator.run("run_results")
    return Costs(image.code_bytes, image.symbols["state"][1], sample, parts, most, results, onsets)


def main() -> None:
    """Print the costs."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--processor", choices=PROCESSORS, default="m7")
    parser.add_argument("--precision", choices=("double", "single"), default="double")
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--rig", default="thesis")
    parser.add_argument("--optimise", default="-Os")
    parser.add_argument("--blocks", type=int, default=4200)
    arguments = parser.parse_args()
    if not shutil.which(COMPILER):
        raise SystemExit(f"{COMPILER} must be installed: apt install gcc-arm-none-eabi libnewlib-arm-none-eabi")
    settings = kernel.StreamSettings.from_rig(ss.load_rig(arguments.rig), arguments.rate)
    unit = stream_program(settings)
    unit = single_unit(unit) if arguments.precision == "single" else unit
    costs = count_costs(unit, arguments.processor, arguments.blocks, arguments.optimise)
    print(f"{arguments.rig}, {arguments.rate:g} Hz, {arguments.processor}, {arguments.precision}, {arguments.optimise}")
    print(f"code {costs.code_bytes / 1000:.1f} kB, state {costs.state_bytes / 1000:.1f} kB")
    print(f"leak_sample {costs.sample} instructions, leak_results {costs.results}")
    print(f"leak_step at most {costs.step}; all of a block at most {costs.block}; {costs.onsets} onsets")
    for name, count in costs.parts.items():
        print(f"  {name:14} {count:8}")


if __name__ == "__main__":
    main()
