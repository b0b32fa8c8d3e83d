"""The rows of `benchmarks/fooling.py` on one machine, by the pressures alone: none is a leak, garbage is no verdict."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.recordings.recording import Recording

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def fooling(monkeypatch_module):  # type: ignore[no-untyped-def]
    monkeypatch_module.syspath_prepend(str(BENCHMARKS))
    return import_module("fooling")


@pytest.fixture(scope="module")
def monkeypatch_module():  # type: ignore[no-untyped-def]
    with pytest.MonkeyPatch.context() as patch:
        yield patch
    for name in ("fooling", "verdicts"):
        sys.modules.pop(name, None)


def judged(fooling, name: str, sound: Recording, other: Recording) -> tuple[str, str]:  # type: ignore[no-untyped-def]
    row = fooling.ROWS[name]
    made = row.change(fooling.Sample(sound, np.random.default_rng(0), other))
    diagnosis = diagnose(made.only(("p_A", "p_B")))
    return row.group, diagnosis.verdict


@pytest.mark.parametrize(
    "name",
    [
        "0.1 s in 4 missing from half on",
        "sharper filter from half on",
        "smoother filter of p_A alone from half on",
        "hum of 50 Hz, 3%, from half on",
        "chambers swapped at half",
        "smoothed noise for pressures",
        "a square wave for p_A",
    ],
)
def test_rows_that_fooled(name: str, fooling, sound: Recording, records) -> None:  # type: ignore[no-untyped-def]
    group, verdict = judged(fooling, name, sound, records(3, duration=120.0, throttled=True))
    assert verdict in (("cannot tell",) if group in ("garbage", "logger") else ("no leak", "cannot tell"))


@pytest.mark.slow
def test_no_row_is_a_leak_and_garbage_is_no_verdict(fooling, sound: Recording, records) -> None:  # type: ignore[no-untyped-def]
    other = records(3, duration=120.0, throttled=True)
    names = [name for name, row in fooling.ROWS.items() if row.group not in ("machine", "baseline")]
    verdicts = {name: judged(fooling, name, sound, other) for name in names}
    assert len(verdicts) >= 60
    assert {name for name, (_, verdict) in verdicts.items() if verdict == "leak"} == set()
    wrong = {name for name, (group, verdict) in verdicts.items() if group == "garbage" and verdict != "cannot tell"}
    assert wrong == set()


def test_verdicts_are_kept_and_an_interrupted_run_goes_on(
    fooling, sound: Recording, tmp_path: Path, monkeypatch
) -> None:  # type: ignore[no-untyped-def]
    """A line cut off by a kill is made again, those that are there are not; equal records are diagnosed once."""

    class Machine:
        record, other = sound.only(("p_A", "p_B", "x")), sound

    calls = []

    def counted(recording: Recording, baseline: object) -> object:
        calls.append(recording)
        return diagnose(recording, baseline)  # type: ignore[arg-type]

    monkeypatch.setattr(fooling.ss, "diagnose", counted)
    file, keys = (
        tmp_path / "verdicts.jsonl",
        [("nothing", "pressures", False, 0), ("x slips by 1 mm at half", "pressures", False, 0)],
    )
    both = {False: [Machine()], True: [Machine()]}
    assert not fooling.judge(file, both, 0, keys, -1.0)
    assert fooling.judge(file, both, 0, keys, 1.0)
    assert len(calls) == 1
    whole = file.read_text(encoding="utf-8")
    file.write_text(whole[:-20], encoding="utf-8")
    assert fooling.judge(file, both, 0, keys, 1.0)
    assert len(calls) == 1
    assert sorted(map(fooling.key_of, fooling.known_verdicts(file))) == sorted(keys)
    fooling.write_table(tmp_path / "table.csv", fooling.known_verdicts(file))
    rows = (tmp_path / "table.csv").read_text(encoding="utf-8").splitlines()
    assert rows[1].startswith("gap,nothing,pressures,0,1,0,0,0,0")
    assert len(rows) == 3
