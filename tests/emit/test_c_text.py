"""The C of controllers under compilers that refuse warnings, sanitizers, MISRA's rules, and hostile samples."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.live.coefficients import OUTDATED_BLOCKS
from sealscope.diagnosis.live.kernel.stream import RESULTS, StreamSettings
from sealscope.diagnosis.live.live_balance import BLOCK_SECONDS, LEARNED
from sealscope.emit.c_export import parts_a_sample, render_c
from sealscope.emit.run_program import CompiledStream
from sealscope.emit.single_precision import learn_basis
from sealscope.emit.stream_program import stream_program

from ..diagnosis.balance_machine import machine
from .test_stream import WORDS, has_compiler, samples_of

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-Wshadow", "-Wdouble-promotion")
#: Rules of MISRA C:2012 that the text does not keep, and why.
DEVIATIONS = {
    "2.5": "the header names results that an application may not use",
    "8.7": "functions of the header have external linkage, though only applications call some of them",
    "8.9": "tables stand at file scope, so that they are in read-only memory",
    "10.6": "a truth value chooses between small whole numbers",
    "10.8": "sums of whole numbers are converted to real ones as Python does",
    "12.1": "brackets stand around each operation but within a conditional expression",
    "14.1": "a loop shifts a real argument by whole steps, at most 16 times",
    "15.5": "kernels return early, as the Python that they are written from",
    "21.15": "the checksum is over the bytes of numbers",
}
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not has_compiler(), reason="needs a C compiler")]


@cache
def programs():
    """Programs in double and single precision with learned numbers, as files by name; healthy samples."""
    unit = stream_program(StreamSettings.from_rig(ss.load_rig("thesis"), 100.0))
    samples = samples_of(machine(2, duration=120.0, rate=100.0))
    texts = {}
    for precision in ("double", "single"):
        stream = CompiledStream(unit, render_c(unit, **WORDS), "leak")
        list(stream.feed(samples, parts_a_sample(unit.settings)))
        texts[precision] = unit, render_c(unit, **WORDS, learned=stream.saved())
        unit = stream_program(unit.settings._replace(basis=learn_basis(stream))) if precision == "double" else unit
    return texts, samples


def write(folder, precision):
    unit, texts = programs()[0][precision]
    for name, text in texts.items():
        (folder / name).write_text(text)
    return unit


def compilers():
    found = [[name] for name in ("gcc", "clang") if shutil.which(name)]
    return [*found, *([[sys.executable, "-P", "-m", "ziglang", "cc"]] if find_spec("ziglang") else [])]


@pytest.mark.parametrize("precision", ["double", "single"])
def test_compilers_have_no_warning(precision, tmp_path):
    write(tmp_path, precision)
    for compiler in compilers():
        for level in ("-O0", "-O2"):
            words = [*compiler, *STRICT, level, "leak.c", "main.c", "-o", "watch", "-lm"]
            done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.skipif(not shutil.which("cppcheck"), reason="cppcheck has the rules: apt install cppcheck")
@pytest.mark.parametrize("precision", ["double", "single"])
def test_rules_of_misra_hold_but_for_a_few(precision, tmp_path):
    write(tmp_path, precision)
    words = ["cppcheck", "--std=c99", "--addon=misra", "--enable=warning,performance,portability", "leak.c"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    broken = set(re.findall(r"misra-c2012-([\d.]+)", done.stderr))
    assert broken <= set(DEVIATIONS), done.stderr[-2000:]
    assert not [line for line in done.stderr.splitlines() if re.search(r": (error|warning):", line)]


def hostile_results(folder, precision, n, samples, restores=True):
    """Results after n hostile samples, with or without a restore, under the sanitizer of undefined behaviour."""
    unit = write(folder, precision)
    source = Path(__file__).with_name("hostile_samples.c")
    parts, rate = parts_a_sample(unit.settings), unit.settings.rate
    defines = [f"-DPARTS={parts}", f"-DRATE={rate!r}", f"-I{folder}"]
    sanitizers = ["-fsanitize=undefined,address,float-cast-overflow", "-fno-sanitize-recover=all"]
    words = ["gcc", "-std=c99", "-O1", "-ffp-contract=off", *sanitizers, *defines, str(source), "leak.c", "-lm"]
    subprocess.run([*words, "-o", "hostile"], cwd=folder, check=True)
    text = "".join(",".join(map(repr, reading)) + "\n" for reading in samples.tolist())
    words = [str(folder / "hostile"), str(n), str(int(restores))]
    done = subprocess.run(words, input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return np.array([[float(value) for value in line.split(",")] for line in done.stdout.splitlines()])


@pytest.mark.skipif(not shutil.which("gcc"), reason="gcc has the sanitizers")
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("n", [300_000, pytest.param(10_000_000, marks=pytest.mark.long)])
def test_hostile_samples_lead_nowhere_and_what_was_learned_is_restored(precision, n, tmp_path):
    samples = programs()[1][:6000]
    results = hostile_results(tmp_path, precision, n, samples)
    assert len(results) > 15 and np.isfinite(results).all()
    assert np.array_equal(results, hostile_results(tmp_path, precision, 0, samples))
    q, low, high = (RESULTS.index(name) for name in ("q", "q_low", "q_high"))
    assert 0.0 < results[-1, low] < results[-1, q] < results[-1, high] and not results[:, RESULTS.index("alarm")].any()


@pytest.mark.skipif(not shutil.which("gcc"), reason="gcc has the sanitizers")
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("n", [30_000, 1_000_000])
def test_the_state_recovers_by_itself_from_hostile_samples(precision, n, tmp_path):
    """Within `OUTDATED_BLOCKS`, and the first fit after them, its interval holds what it stated before."""
    samples = programs()[1]
    expected = hostile_results(tmp_path, precision, 0, samples)[-1]
    n_blocks = OUTDATED_BLOCKS + 3 * LEARNED
    repeated = np.tile(samples, (math.ceil(n_blocks * BLOCK_SECONDS * 100.0 / len(samples)), 1))
    results = hostile_results(tmp_path, precision, n, repeated, restores=False)[-1]
    q, low, high = (RESULTS.index(name) for name in ("q", "q_low", "q_high"))
    assert results[RESULTS.index("reason")] == 0.0
    assert results[low] < expected[q] < results[high] < 5.0 * expected[q]
