"""Run a program, compiled from its C text, on samples in this process: to learn, and to write test vectors."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.diagnosis.live.kernel.stream import RESULTS
from sealscope.emit.compiler import find_compiler
from sealscope.emit.stream_program import StreamProgram
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

#: Flags by which results equal those of numba's code to the bit: no fused multiplication and addition.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
_COMPILE_TIMEOUT = 120.0
_KINDS: Mapping[str, Any] = {"whole": ctypes.c_int32, "truth": ctypes.c_bool}


class CompiledStream:
    """A stream's program as compiled C with a state of its own.

    Parameters
    ----------
    unit : StreamProgram
        The program.
    texts : mapping of str to str
        Its files by name, as `c_export.render_c` writes them.
    prefix : str
        Beginning of the names in C.
    """

    def __init__(self, unit: StreamProgram, texts: Mapping[str, str], prefix: str) -> None:
        self.unit, self._prefix = unit, prefix
        self._real = ctypes.c_double if unit.precision == "double" else ctypes.c_float
        kinds = {"real": self._real, **_KINDS}
        fields = [(f.name, kinds[f.kind] * f.size if f.size else kinds[f.kind]) for f in unit.program.fields]
        self.state = type("State", (ctypes.Structure,), {"_fields_": fields})()
        with tempfile.TemporaryDirectory(prefix="sealscope-c-") as folder:
            self._library = self._compile(Path(folder), texts)
        self.initialise()

    def _compile(self, folder: Path, texts: Mapping[str, str]) -> ctypes.CDLL:
        """Compile the files to a shared library, and load it; raise InputError if the compiler fails."""
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        library, command = folder / "program.so", find_compiler().command
        words = [*command, *FLAGS, "-shared", "-fPIC", str(folder / f"{self._prefix}.c"), "-o", str(library), "-lm"]
        rule = f"the C compiler ({' '.join(command)}) must compile the program"
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=_COMPILE_TIMEOUT, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"{rule}, got {error}") from None
        if done.returncode:
            raise InputError(f"{rule}, got {' '.join(done.stderr[-500:].split())}")
        return ctypes.CDLL(str(library))

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call a function of the program with the state."""
        function = getattr(self._library, f"{self._prefix}_{name}")
        function.restype = ctypes.c_bool if name in ("step", "restore") else None
        return function(ctypes.byref(self.state), *arguments)

    def initialise(self) -> None:
        """Begin anew, without what was learned from samples."""
        self._call("init")

    def resume(self) -> None:
        """Begin with samples anew, with what was learned: save and restore."""
        saved = self.saved()
        self._call("restore", (ctypes.c_double * len(saved))(*saved))

    def acknowledge(self) -> None:
        """Withdraw an alarm."""
        self._call("acknowledge")

    def saved(self) -> list[float]:
        """Return the numbers that outlast a power cut."""
        numbers = (ctypes.c_double * (self.unit.n_learned + 2))()
        self._call("save", numbers)
        return list(numbers)

    def results(self) -> Array:
        """Return the results in the order of `RESULTS`."""
        self._call("results")
        return np.array(self.state.results[: len(RESULTS)])

    def feed(self, samples: Array, parts_a_sample: int) -> Iterator[Array]:
        """Add samples (n, 4), and yield the results after each block."""
        blocks = int(self.state.n_ended)
        for reading in samples:
            self._call("sample", *map(self._real, reading))
            works = True
            for _ in range(parts_a_sample):
                works = bool(self._call("step"))
            if not works and self.state.n_ended != blocks:
                blocks = int(self.state.n_ended)
                yield self.results()
