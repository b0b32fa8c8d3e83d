"""The rows of `benchmarks/fooling.py` on one machine: none is a leak, garbage no verdict, no combination an error."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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


@pytest.fixture(scope="module")
def short(healthy: Recording, records) -> tuple[Recording, Recording]:  # type: ignore[no-untyped-def]
    """Return 60 s of two healthy machines."""
    return healthy.between(0.0, 60.0), records(3, duration=120.0, throttled=True).between(0.0, 60.0)


def judged(fooling, name: str, healthy: Recording, other: Recording) -> tuple[str, str]:  # type: ignore[no-untyped-def]
    row = fooling.ROWS[name]
    made = row.change(fooling.Sample(healthy, np.random.default_rng(0), other))
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
    ],
)
def test_rows_that_fooled(name: str, fooling, healthy: Recording, records) -> None:  # type: ignore[no-untyped-def]
    _, verdict = judged(fooling, name, healthy, records(3, duration=120.0, throttled=True))
    assert verdict in ("no leak", "cannot tell")


@pytest.mark.slow
@pytest.mark.long
def test_no_row_is_a_leak_and_garbage_is_no_verdict(fooling, healthy: Recording, records) -> None:  # type: ignore[no-untyped-def]
    other = records(3, duration=120.0, throttled=True)
    names = [name for name, row in fooling.ROWS.items() if row.group not in ("machine", "baseline")]
    verdicts = {name: judged(fooling, name, healthy, other) for name in names}
    assert len(verdicts) >= 60
    assert {name for name, (_, verdict) in verdicts.items() if verdict == "leak"} == set()


def test_verdicts_are_kept_and_an_interrupted_run_goes_on(
    fooling, healthy: Recording, tmp_path: Path, monkeypatch
) -> None:  # type: ignore[no-untyped-def]
    """A line cut off by a kill is made again, those that are there are not; equal records are diagnosed once."""

    class Machine:
        record, other = healthy.only(("p_A", "p_B", "x")), healthy

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
    assert rows[1].startswith("developed on,gap,nothing,pressures,0,1,0,0,0,0")
    assert len(rows) == 3


def degenerate(recording: Recording, name: str, values: np.ndarray) -> Recording:
    return replace(recording, channels={**recording.channels, name: values})


#: Well-formed recordings of no machine, or of one through wrong labels, beside the rows.
DEGENERATE = {
    "p_B copied from p_A": lambda r: degenerate(r, "p_B", r["p_A"].copy()),
    "p_B minus p_A": lambda r: degenerate(r, "p_B", -r["p_A"]),
    "p_A constant": lambda r: degenerate(r, "p_A", np.full(len(r), 3e5)),
    "p_A constant from half on": lambda r: degenerate(r, "p_A", np.where(r.t < r.t[len(r) // 2], r["p_A"], 3e5)),
    "u constant": lambda r: degenerate(r, "u", np.zeros(len(r))),
    "x constant": lambda r: degenerate(r, "x", np.zeros(len(r))),
    "p_A in 1e-5 of its unit": lambda r: degenerate(r, "p_A", 1e-5 * r["p_A"]),
    "p_B in 1e5 of its unit": lambda r: degenerate(r, "p_B", 1e5 * r["p_B"]),
    "u in 1e5 of its unit": lambda r: degenerate(r, "u", 1e5 * r["u"]),
    "x in 1e-5 of its unit": lambda r: degenerate(r, "x", 1e-5 * r["x"]),
    "p_A and u swapped": lambda r: replace(r, channels={**r.channels, "u": 1e-5 * r["p_A"], "p_A": 1e5 * r["u"]}),
    "one sample in 1000": lambda r: degenerate(r, "p_A", np.repeat(r["p_A"][::1000], 1000)[: len(r)]),
    "of 1 and 0": lambda r: degenerate(r, "p_B", (r["p_B"] > r["p_B"].mean()).astype(float)),
}
#: Of these nothing of a machine is left, whatever was done before.
NO_MACHINE = ("p_B copied from p_A", "p_A constant", "p_B in 1e5 of its unit", "of 1 and 0", "one sample in 1000")
BASELINES = ("none", "itself", "another machine", "itself, changed")


def check_combination(fooling, draw, healthy: Recording, other: Recording, views: list[tuple[str, ...]], capfd) -> None:  # type: ignore[no-untyped-def]
    """Diagnose rows on top of one another: a verdict without error, warning or text; none where no machine is left."""
    rows = {name: row.change for name, row in fooling.ROWS.items() if row.group not in ("machine", "baseline")}
    names = draw(st.lists(st.sampled_from([*rows, *DEGENERATE]), min_size=1, max_size=3), label="changes")
    view = draw(st.sampled_from(views), label="channels")
    against = draw(st.sampled_from(BASELINES), label="baseline")
    random = np.random.default_rng(draw(st.integers(0, 99), label="seed"))
    begin, made = healthy.only(view), healthy.only({*view, "u", "x", "p_A", "p_B"})
    for name in names:
        if name in DEGENERATE:
            made = DEGENERATE[name](made)
        elif made.rate > 100.0:
            made = rows[name](fooling.Sample(made, random, other.only(made.channels)))
    made = made.only(view)
    baseline = {"none": (), "itself": (made,), "another machine": (other.only(view),), "itself, changed": (begin,)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        diagnosis = diagnose(made, baseline[against])
    assert diagnosis.verdict in ("leak", "no leak", "cannot tell")
    assert not any("is left out: " in method.reason for method in diagnosis.methods)
    assert tuple(capfd.readouterr()) == ("", "")
    last = fooling.ROWS.get(names[-1])
    if names[-1] in NO_MACHINE or (last is not None and last.group == "garbage"):
        assert diagnosis.verdict == "cannot tell", diagnosis.reason


FIXTURES_STAY = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]


@settings(max_examples=16, deadline=None, suppress_health_check=FIXTURES_STAY, derandomize=True, database=None)
@given(data=st.data())
@pytest.mark.slow
def test_combined_changes_of_the_pressures(data, fooling, short, capfd) -> None:  # type: ignore[no-untyped-def]
    check_combination(fooling, data.draw, *short, [("p_A", "p_B")], capfd)


@pytest.mark.slow
@settings(max_examples=30, deadline=None, suppress_health_check=FIXTURES_STAY, derandomize=True, database=None)
@given(data=st.data())
def test_combined_changes_of_all_channels(data, fooling, short, capfd) -> None:  # type: ignore[no-untyped-def]
    views = [("p_A", "p_B"), ("u", "p_A", "p_B"), ("u", "x", "theta", "omega", "p_A", "p_B"), ("x", "p_A")]
    check_combination(fooling, data.draw, *short, views, capfd)
