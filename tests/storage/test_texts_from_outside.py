"""Texts from outside, of files and options: what is wrong with one is a line of bounded length, and soon said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sealscope.campaigns.execution import store
from sealscope.campaigns.plans.reader import load_plan
from sealscope.errors import InputError, MissingExtra, SealscopeError, SimulationFailed, UnreadableFile
from sealscope.parameters import load_rig, parse_overrides
from sealscope.recordings import split_map_option
from sealscope.simulation.commands import Chirp, check_command, parse_command
from sealscope.simulation.faults import Fault, parse_fault
from sealscope.simulation.leaks import parse_leak
from sealscope.storage.opening import is_file_path
from sealscope.storage.rows import ROWS
from sealscope.units import parse_quantity

from ..recordings.refusals import count_calls
from ..refusals import refusal

PLAN = '[campaign]\nname = "a"\nduration = "6 s"\ndetectors = ["rms change"]\n[[records]]\ncount = 1\n'


@pytest.mark.parametrize("kind", [SealscopeError, InputError, UnreadableFile, SimulationFailed, MissingExtra])
def test_a_message_is_one_line_of_bounded_length(kind: type[SealscopeError]) -> None:
    assert str(kind("p (port\r\nA) must be\u2028a column")) == "p (port A) must be a column"
    long = str(kind(f"x must be a number, got {'9' * 10**6} (log.csv)"))
    assert len(long) < 5000
    assert long.startswith("x must be a number, got 999")
    assert long.endswith("9 (log.csv)")
    assert str(kind()) == ""


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (f"seed = {'1' * 4400}", "TOML"),
        (f"seed = {2**53 + 1}", "2^53"),
        (f"duration = 1{'0' * 400}", "2^53"),
        ("channels = [['p_A']]", "channels[1], 'p_A'"),
        (f'rig = "{"thesis" * 900}"', "rig"),
        ("false_alarm = 1e-320", "false_alarm, greater than or equal, 1e-320"),
    ],
)
def test_settings_of_a_plan(entry: str, words: str, tmp_path: Path) -> None:
    path, key = tmp_path / "plan.toml", entry.partition(" ")[0]
    lines = [line for line in PLAN.splitlines() if not line.startswith(f"{key} =")]
    calibrated = '[[records]]\nuse = "calibrate"\ncount = 9\n' if key == "false_alarm" else ""
    detectors = "d3 of p_A fell" if calibrated else "rms change"
    text = "\n".join([lines[0], entry, *lines[1:], calibrated]).replace("rms change", detectors)
    path.write_text(text)
    with refusal(*words.split(", ")):
        load_plan(path)


@pytest.mark.parametrize("files", ["**x/*.csv", "**/**/*.csv", "a\\u0000b"])
def test_patterns_of_a_plan(files: str, tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text(
        f'[campaign]\nname = "a"\ndetectors = ["rms change"]\n[recordings]\n[[recordings.sets]]\nfiles = "{files}"\n'
    )
    with refusal("files"):
        load_plan(tmp_path / "plan.toml")


@pytest.mark.parametrize("name", ["thesis" * 1000, "a\0b", "\udcff"])
def test_what_no_path_can_be_is_no_file(name: str) -> None:
    assert not is_file_path(name)
    with refusal("rig"):
        load_rig(name)


def test_a_row_without_its_time_is_no_row(tmp_path: Path) -> None:
    row = '{"id": "a", "use": "judge", "leak_lpm": 0, "fault": "", "levels": {}, "replicate": 0, "error": "e", '
    (tmp_path / ROWS).write_text(row + '"scores": {}, "seconds": null}\n')
    with refusal("row", error=UnreadableFile):
        store.read_rows(tmp_path)


@pytest.mark.parametrize("blank", [" ", "\t", "  ", "\u00a0"])
def test_any_blank_after_a_sign(blank: str) -> None:
    assert parse_fault(f"friction +{blank}20 % from{blank}9 s") == parse_fault("friction +20 % from 9 s")
    assert parse_leak(f"0.01{blank}L/min from 9{blank}s") == parse_leak("0.01 L/min from 9 s")
    assert str(parse_command(f"3 sin(4t +{blank}1)")) == "3 sin(4t + 1)"
    assert parse_fault(f"friction +{blank}20 %") == Fault("friction", 1.2)


LONG = 200_000


@pytest.mark.parametrize(
    "key", ["a." * LONG + "a = 1", "[" + "a." * LONG + "a]", "x = { " + '"a" . ' * LONG + "a = 1 }"]
)
def test_a_key_of_many_dots_is_refused_with_little_work(key: str, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(key)

    def load() -> None:
        with pytest.raises(InputError, match=r"(a dotted key must have at most 30 dots|must be at most 1000000 bytes)"):
            load_rig(tmp_path / "rig.toml")

    assert count_calls(load) < len(key)


@pytest.mark.parametrize(
    "read",
    [
        lambda: parse_leak("1" * LONG),
        lambda: parse_leak("0.01 " + "L" * LONG),
        lambda: parse_fault("rod seal A " + "1" * LONG),
        lambda: parse_command("3 sin(" + "4" * LONG),
        lambda: parse_overrides(["V" * LONG + "=1"]),
        lambda: load_rig("thesis").with_overrides({"V" * LONG: 1.0}),
        lambda: split_map_option("p_A" * LONG + "=x"),
        lambda: parse_quantity("1" * LONG + "x", "s"),
        lambda: load_rig("thesis" * LONG),
    ],
)
def test_long_options_are_refused_with_little_work(read: Callable[[], object]) -> None:
    def refuse() -> None:
        try:
            read()
        except InputError as error:
            assert len(str(error)) < 5000

    assert count_calls(refuse) < LONG


def test_a_long_command_is_checked_in_little_memory() -> None:
    import tracemalloc

    t = np.arange(8_000_000) / 1000.0
    tracemalloc.start()
    try:
        check_command(Chirp(3.0, 0.1, 5.0, 60.0), t, 10.0)
        with refusal("11 V", "5000 s"):
            check_command(parse_command("step 11 at 5000 s"), t, 10.0)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
