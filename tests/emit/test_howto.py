"""The how-to for controllers, followed to the letter in an empty folder; and the program that reads samples."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sealscope.emit.c_export import render_c, render_vectors, result_headings, sample_headings
from sealscope.emit.run_program import CompiledStream
from sealscope.emit.stream_program import RESULT_UNITS

from ..diagnosis.balance_machine import machine
from .test_stream import WORDS, has_compiler, samples_of, unit_at

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "controller.md"
has_tools = has_compiler() and all(map(shutil.which, ("make", "cc", "diff")))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not has_tools, reason="needs make, diff and a C compiler named cc"),
]


def run(command, folder, check=True):
    """Run a line of the page, in which sealscope is the one that is tested."""
    words = f"{shlex.quote(sys.executable)} -P -m sealscope "
    line = re.sub(r"^sealscope ", words, command)
    return subprocess.run(line, shell=True, cwd=folder, capture_output=True, text=True, check=check, timeout=300)


def test_the_page_leads_from_logs_to_an_alarm(tmp_path):
    page = PAGE.read_text("utf-8")
    commands = [line.partition("  #")[0].strip() for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL)[:2]
                for line in block.splitlines()]  # fmt: skip
    simulate = re.search(r"`(sealscope simulate --rate .*? -o )healthy_1.csv`", page, re.DOTALL)[1].replace("\n", " ")
    leak = re.search(r"`(--leak '.*?')`", page)[1]
    for seed, name, words in ((1, "healthy_1", ""), (2, "healthy_2", ""), (3, "today", leak)):
        run(f"{simulate.replace('--seed 1', f'--seed {seed}')} {name}.csv {words}", tmp_path)
    said = {command: run(command, tmp_path) for command in commands}
    (check,) = [done.stdout for command, done in said.items() if command.startswith("make")]
    assert "same results" in check
    (alarm,) = [done.stderr for command, done in said.items() if "watch" in command]
    onset, leak, low, high = re.search(
        r"alarm at (\d+) s.*\n.*leak of (\S+) L/min .*: (\S+) to (\S+)\)", alarm
    ).groups()
    assert 120 < int(onset) < 150
    assert float(low) < 0.006 < float(high) and abs(float(leak) / 0.006 - 1.0) < 0.2
    assert {path.suffix for path in (tmp_path / "leak-st").iterdir()} == {".st", ".scl", ".xml", ".md"}
    healthy = run("leak/watch < healthy_2.csv", tmp_path)
    assert "no alarm: a leak of" in healthy.stderr


def test_the_program_finds_columns_by_their_headings(tmp_path):
    unit = unit_at(20.0)
    texts = render_c(unit, **WORDS)
    samples = samples_of(machine(4, duration=75.0, rate=20.0))
    texts |= render_vectors(CompiledStream(unit, texts, "leak"), samples)
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    assert "same results" in run("make check", tmp_path).stdout
    expected = texts["expected.csv"]
    assert expected.count("\n") > 20 and expected.startswith(",".join(result_headings()))
    assert len(result_headings()) == len(RESULT_UNITS)
    names = sample_headings(unit.settings)
    order = [2, 0, 3, 1]
    rows = [",".join(["0.5", *(repr(float(reading[k])) for k in order)]) for reading in samples]
    headings = ",".join(["t [s]", *(names[k] for k in order)])
    (tmp_path / "log.csv").write_text("\n".join(["# " + "x" * 20000, headings, *rows, ""]))
    assert run("./watch < log.csv", tmp_path).stdout == expected
    (tmp_path / "plain.csv").write_text(texts["vectors.csv"].partition("\n")[2])  # no headings: in this order
    assert run("./watch < plain.csv", tmp_path).stdout == expected
    (tmp_path / "bar.csv").write_text(headings.replace("p_B [Pa]", "p_B [bar]") + "\n1,2,3,4,5\n")
    refused = run("./watch < bar.csv", tmp_path, check=False)
    assert refused.returncode == 1 and "p_B [Pa]" in refused.stderr and "p_B [bar]" in refused.stderr
    assert "sealscope convert" in refused.stderr
