"""The user stops the command, or nobody reads its output any more."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from ..representatives import few


def interrupt(*_, **__):
    raise KeyboardInterrupt


def was_interrupted(done) -> bool:
    """Status 130 and one line; some versions of the library that reads the words first end the line with `^C` in it."""
    return (done.status, done.err.removeprefix("\n")) == (130, "sealscope: interrupted\n")


@pytest.mark.parametrize(
    "where", ["sealscope.simulation.integrate.integrate_run", "sealscope.simulation.simulate.record"]
)
@pytest.mark.parametrize("words", [("simulate", "-o", "run.nc", "--duration", "2"), ("demo", "-o", ".")])
def test_an_interrupt_while_simulating(where, words, call, untouched, monkeypatch):
    monkeypatch.setattr(where, interrupt)
    assert was_interrupted(call(*words))


@pytest.mark.parametrize("suffix", ["nc", "csv", "parquet"])
def test_an_interrupt_while_writing_leaves_the_old_file(suffix, call, recordings, tmp_path, untouched, monkeypatch):
    target = tmp_path / f"out.{suffix}"
    target.write_text("what was there before")
    untouched()
    monkeypatch.setattr("pathlib.Path.replace", interrupt)
    assert was_interrupted(call("convert", recordings / "healthy_1.nc", target))
    assert target.read_text() == "what was there before"


def test_a_real_interrupt_of_a_long_simulation(untouched, surroundings):
    """SIGINT from outside, while the solver works on an hour of the rig."""
    tell = (
        "import sealscope.simulation.integrate as module, sealscope.cli\n"
        "integrate = module.integrate_run\n"
        "def announced(*arguments, **options):\n"
        "    print('integrating', flush=True)\n"
        "    return integrate(*arguments, **options)\n"
        "module.integrate_run = announced\n"
        "sealscope.cli.main()\n"
    )
    words = ("simulate", "-o", "run.nc", "--duration", "3600", "--prove", "--leak", "0.01 L/min")
    child = subprocess.Popen(
        [sys.executable, "-c", tell, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=surroundings,
    )
    assert child.stdout.readline() == "integrating\n"
    time.sleep(0.2)
    child.send_signal(signal.SIGINT)
    _, err = child.communicate(timeout=60)
    assert (child.returncode, err.removeprefix("\n")) == (130, "sealscope: interrupted\n")


@pytest.mark.slow
def test_an_interrupt_within_a_finalizer_is_not_lost(untouched, surroundings):
    """Python prints and ignores what a finalizer raises: the run went on for its hour, and ended with status 0."""
    tell = (
        "import time, sealscope.simulation.integrate as module, sealscope.cli\n"
        "class Finalized:\n"
        "    def __del__(self):\n"
        "        print('finalizing', flush=True)\n"
        "        time.sleep(1)\n"
        "def integrate(*arguments, **options):\n"
        "    Finalized()\n"
        "    time.sleep(50)\n"
        "module.integrate_run = integrate\n"
        "sealscope.cli.main()\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", tell, "simulate", "-o", "run.nc"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=surroundings,
    )
    assert child.stdout.readline() == "finalizing\n"
    time.sleep(0.2)
    child.send_signal(signal.SIGINT)
    _, err = child.communicate(timeout=40)
    assert (child.returncode, err.removeprefix("\n")) == (130, "sealscope: interrupted\n")


SEALSCOPE = '"$PYTHON" -m sealscope'


@pytest.mark.parametrize(
    ("words", "reader"),
    few([("parameters", "true"), ("parameters --format csv", "head -1"), ("--version", "true")], 1),
)
def test_a_reader_that_goes_away_is_no_error(shell, words, reader):
    done = shell("bash", "-c", f"{SEALSCOPE} {words} | {reader}")
    assert (done.status, done.err) == (0, "")
    assert len(done.out.splitlines()) == (reader != "true")


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")  # noqa: PTH110
@pytest.mark.parametrize("words", few(["parameters --format csv", "--version"], 1))
def test_a_full_disk_behind_the_output_is_one_line(shell, words):
    done = shell("bash", "-c", f"{SEALSCOPE} {words} > /dev/full")
    assert "No space left on device" in done.refused(1)
