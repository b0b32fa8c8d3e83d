"""A detector of one's own: found by entry point, judged by the same contract, and harmless where it is broken."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sealscope.diagnosis.detectors import registry
from sealscope.diagnosis.detectors.isolation import call_plug_in
from sealscope.diagnosis.detectors.registry import DETECTORS, detectors
from sealscope.diagnosis.diagnose import Examination, diagnose
from sealscope.recordings import write
from sealscope.recordings.recording import Recording

from ..representatives import SLOW, few

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "ringing-energy"
GOOD = """
from sealscope.diagnosis.inference.observable import Observed
class Good:
    name = "good"
    def __init__(self, rig): self.rig = rig.name
    def usable(self, recording): return None
    def observe(self, recording, baseline=()): return Observed("good", lack=f"assumed {self.rig}")
"""
#: A detector that reports one change alone.
ONE_CHANGE = """
from sealscope.diagnosis.detectors.registry import make_observable
class Good:
    name = "good"
    def __init__(self, rig): pass
    def usable(self, recording): return None
    def observe(self, recording, baseline=()): return make_observable("stroke time", CHANCE, onset=(9.0, 8.0, 10.0))
"""
Install = Callable[..., None]


@pytest.fixture(scope="module")
def short(healthy: Recording) -> Recording:
    return healthy.between(0.0, 30.0)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a distribution of that name with its source and entry points, as pip would leave it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("sealscope.diagnosis.detectors.registry.DETECTORS", {"rms change": DETECTORS["rms change"]})

    def made(distribution: str, source: str, points: dict[str, str]) -> None:
        (tmp_path / f"{distribution}.py").write_text(source, encoding="utf-8")
        info = tmp_path / f"{distribution}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n", encoding="utf-8")
        lines = [f"[{registry.GROUP}]", *(f"{name} = {value}" for name, value in points.items())]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        forget()

    def forget() -> None:
        registry.plug_ins.cache_clear()
        registry._log_once.cache_clear()

    before = set(sys.modules)
    yield made
    forget()
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) and str(tmp_path) in str(sys.modules[name].__file__):
            del sys.modules[name]


def reported(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.name.startswith("sealscope")]


def test_the_documented_example_is_found_and_heard(install: Install, leaky: Recording) -> None:
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))
    points = project["project"]["entry-points"][registry.GROUP]
    assert points == {"ringing energy": "ringing_energy:RingingEnergy"}
    install("ringing_energy", (EXAMPLE / "ringing_energy.py").read_text(encoding="utf-8"), points)
    assert list(detectors()) == ["rms change", "ringing energy"]
    result = {one.detector: one for one in diagnose(leaky).methods}
    own = result["ringing energy"]
    assert own.verdict == "leak"
    assert own.score is not None
    assert own.threshold is not None
    assert own.score > own.threshold


@pytest.mark.parametrize(
    ("chance", "verdict"), [(1e-9, "leak"), (0.3, "cannot tell"), (0.0, "leak"), (1.0, "cannot tell")]
)
def test_one_change_with_its_chance_is_a_report(
    install: Install, short: Recording, chance: float, verdict: str
) -> None:
    install("fine", ONE_CHANGE.replace("CHANCE", repr(chance)), {"good": "fine:Good"})
    evidence = Examination(short, false_alarm_probability=0.01).evidence("good")
    assert evidence.verdict == verdict
    assert (evidence.score > evidence.threshold) == (verdict == "leak")
    assert evidence.onset_s == (9.0 if verdict == "leak" else None)


def test_one_that_sees_nothing_takes_no_verdict_away(install: Install, short: Recording) -> None:
    """It states no bound; the change of RMS judges as without it."""
    alone = diagnose(short)
    install("fine", ONE_CHANGE.replace("CHANCE", "0.5"), {"good": "fine:Good"})
    beside = diagnose(short)
    assert alone.verdict == "no leak"
    assert (beside.verdict, beside.detector, beside.reason) == (alone.verdict, alone.detector, alone.reason)
    assert "good sees no change" in next(part.reason for part in beside.parts if part.detector == "good")


def test_it_is_made_for_the_rig_that_is_assumed(install: Install, short: Recording) -> None:
    from sealscope.parameters import load_rig

    install("fine", GOOD, {"good": "fine:Good"})
    for name in ("thesis", "thesis-calibrated"):
        rig = load_rig(name)
        methods = {one.detector: one for one in diagnose(short, rig=rig).methods}
        assert methods["good"].reason == f"assumed {rig.name}"


BROKEN = {
    "no such module": ("", {"bad": "nowhere_at_all:Bad"}, "ModuleNotFoundError"),
    "no such class": ("x = 1", {"bad": "broken:Bad"}, "AttributeError"),
    "source with an error": ("def f(:", {"bad": "broken:f"}, "SyntaxError"),
    "no callable": ("Bad = 3", {"bad": "broken:Bad"}, "must be callable with a rig"),
    "a built-in's name": (GOOD, {"rms change": "broken:Good"}, "taken by Sealscope"),
    "a reserved word": (GOOD, {"diagnose": "broken:Good"}, "taken by Sealscope"),
    "cannot be made": ("def Bad(rig): raise OSError('no licence')", {"bad": "broken:Bad"}, "no licence"),
    "another name": (GOOD, {"bad": "broken:Good"}, "must be that of its entry point, 'bad', got 'good'"),
    "observes badly": (
        GOOD.replace("return Observed(", 'raise ZeroDivisionError("so\\nit is"); return Observed('),
        {"good": "broken:Good"},
        "so it is",
    ),
    "no report": (
        re.sub(r"return Observed\(.*", 'return "no leak"', GOOD),
        {"good": "broken:Good"},
        "must return an Observed, got str",
    ),
    "a chance that is none": (ONE_CHANGE.replace("CHANCE", "1.5"), {"good": "broken:Good"}, "0 to 1, got 1.5"),
    "a chance without a value": (ONE_CHANGE.replace("CHANCE", "float('nan')"), {"good": "broken:Good"}, "got nan"),
    "a lack of two lines": (
        GOOD.replace('f"assumed {self.rig}"', '"no\\nno"'),
        {"good": "broken:Good"},
        "must be one line",
    ),
    "usable that fails": (GOOD.replace("return None", "return 1 / 0"), {"good": "broken:Good"}, "ZeroDivisionError"),
}


@pytest.mark.parametrize("case", few(BROKEN, 8, SLOW))
def test_a_broken_one_costs_one_line_that_names_the_distribution(
    case: str, install: Install, short: Recording, caplog: pytest.LogCaptureFixture
) -> None:
    source, points, words = BROKEN[case]
    expected = diagnose(short)
    install("broken", source, points)
    with caplog.at_level(logging.WARNING, "sealscope"):
        result = [diagnose(short), diagnose(short)]
    (line,) = reported(caplog)  # once, however often it fails
    assert "\n" not in line
    assert "of broken is left out" in line
    assert words in line
    for one in result:
        assert (one.verdict, one.score, one.reason) == (expected.verdict, expected.score, expected.reason)


def test_two_of_one_name(install: Install, caplog: pytest.LogCaptureFixture) -> None:
    install("first", GOOD, {"good": "first:Good"})
    install("second", GOOD, {"good": "second:Good"})
    with caplog.at_level(logging.WARNING, "sealscope"):
        assert list(detectors()) == ["rms change", "good"]
    (line,) = reported(caplog)
    assert line == "detector 'good' of second is left out: ValueError: its name is that of a detector of first"


def test_another_source_is_another_fingerprint(install: Install) -> None:
    install("first", GOOD, {"good": "first:Good"})
    install("second", GOOD + "\n# changed\n", {"fine": "second:Good"})
    prints = [one.fingerprint for one in registry.plug_ins(frozenset()).values()]
    assert len(set(prints)) == 2
    assert "unknown" not in prints


def test_the_guide_shows_the_example_as_it_stands() -> None:
    guide = (EXAMPLE.parents[1] / "detectors.md").read_text(encoding="utf-8")
    project = (EXAMPLE / "pyproject.toml").read_text(encoding="utf-8")
    assert all(line in project for line in guide.split("```toml\n")[1].split("```")[0].splitlines())


#: What a hostile or careless plug-in may do in any of its functions, and the words of the line that it costs.
MISCHIEF = {
    "exit": ("import sys; sys.exit(3)", "must not end the process, got sys.exit(3)"),
    "exit by error": ("raise SystemExit('bye\\nbye')", "got sys.exit(bye bye)"),
    "quit": ("quit()", "must not end the process"),
    "interrupt": ("raise KeyboardInterrupt", "must raise an Exception, got KeyboardInterrupt"),
    "generator exit": ("raise GeneratorExit", "must raise an Exception, got GeneratorExit"),
    "sleep": ("import time; time.sleep(3600)", "must end within"),
    "loop": ("while True: pass", "must end within"),
    "loop that catches": ('exec("while True:\\n try: pass\\n except Exception: pass")', "must end within"),
    "wait": ("import threading; threading.Event().wait()", "must end within"),
    "long text": ("raise ValueError('x' * 10**6)", "ValueError: xxx"),
    "no text": ("raise type('E', (Exception,), {'__str__': lambda self: 1 / 0})()", "has no text"),
}
PLACES = {
    "import": lambda act: f"def mischief():\n            {act}\nmischief()\n{GOOD}",
    "make": lambda act: GOOD.replace("self.rig = rig.name", f"\n            {act}"),
    "usable": lambda act: GOOD.replace("return None", f"\n            {act}"),
    "observe": lambda act: GOOD.replace('return Observed("good", lack=f"assumed {self.rig}")', f"\n            {act}"),
}
#: Each act with each place, those of all acts and all places first.
CASES = [f"{[*PLACES][(k + shift) % 4]} {act}" for shift in range(4) for k, act in enumerate(MISCHIEF)]


@pytest.mark.parametrize("case", few(dict.fromkeys(CASES), len(MISCHIEF), SLOW))
def test_whatever_a_plug_in_does_the_call_goes_on(
    case: str, install: Install, short: Recording, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It exits, hangs or raises anything, anywhere: one line names it, and the verdict is that without it."""
    place, _, act = case.partition(" ")
    code, words = MISCHIEF[act]
    monkeypatch.setattr("sealscope.diagnosis.detectors.isolation.LIMIT_S", 0.5)
    monkeypatch.setattr("sealscope.diagnosis.detectors.isolation.SAMPLE_S", 0.0)
    monkeypatch.setattr(registry, "_TIMED_OUT", set())
    expected = diagnose(short)
    name = f"broken_{CASES.index(case)}"  # a thread that hangs in an import holds the lock of its module
    install(name, PLACES[place](code), {"good": f"{name}:Good"})
    with caplog.at_level(logging.WARNING, "sealscope"):
        result, start = diagnose(short), time.monotonic()
        again = diagnose(short)
    assert time.monotonic() - start < 30.0
    lines = reported(caplog)
    assert f"detector 'good' of {name} is left out" in lines[0]
    assert words in lines[0]
    assert all("\n" not in line and len(line) < 500 for line in lines)
    for each in (result, again):
        assert (each.verdict, each.score, each.reason) == (expected.verdict, expected.score, expected.reason)


REPORTS = {
    "too many": ("(make_observable('a', 0.5),) * 200_000", "at most 1000 observables, got 200000"),
    "without an end": ("itertools.repeat(make_observable('a', 0.5))", "must be a tuple, got repeat"),
    "a long name": ("(make_observable('a' * 10**6, 0.5),)", "a text of at most 200 letters"),
    "no name": ("(make_observable(None, 0.5),)", "a text of at most 200 letters"),
}


@pytest.mark.parametrize("case", REPORTS)
def test_a_report_has_limits(case: str, install: Install, short: Recording, caplog: pytest.LogCaptureFixture) -> None:
    observables, words = REPORTS[case]
    source = GOOD.replace(
        'return Observed("good", lack=f"assumed {self.rig}")', f"return Observed('good', {observables})"
    )
    imports = "import itertools\nfrom sealscope.diagnosis.detectors.registry import make_observable\n"
    install("broken", imports + source, {"good": "broken:Good"})
    with caplog.at_level(logging.WARNING, "sealscope"):
        diagnose(short)
    (line,) = reported(caplog)
    assert "detector 'good' of broken is left out" in line
    assert words in line


@pytest.mark.slow
def test_what_a_plug_in_prints_is_no_result(tmp_path: Path, short: Recording) -> None:
    """By print, by the file, by the descriptor and by a process that it starts, wherever: standard output has JSON."""
    prints = "import os, sys; print('A'); sys.__stdout__.write('B\\n'); os.write(1, b'C\\n'); os.system('echo D')"
    source = f"{prints}\n" + GOOD.replace("return None", f"\n        {prints}; return None")
    source = source.replace("self.rig = rig.name", f"self.rig = rig.name; {prints}")
    (tmp_path / "chatty.py").write_text(source, encoding="utf-8")
    info = tmp_path / "chatty-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: chatty\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\ngood = chatty:Good\n", encoding="utf-8")
    write(short, tmp_path / "log.nc")
    command = [sys.executable, "-P", "-m", "sealscope", "diagnose", "log.nc", "log.nc", "--format", "jsonl"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["file"] for row in rows] == ["log.nc", "log.nc"]
    assert "assumed" in done.stdout  # it was heard
    assert all(done.stderr.count(f"{letter}\n") >= 3 for letter in "ABCD")


def test_a_thread_that_waits_forever_leaves_no_signal_behind(monkeypatch):
    """The flag of an exception for it stayed set, and CPython 3.11 hung in the next function that was profiled."""
    import sys
    import threading

    monkeypatch.setattr("sealscope.diagnosis.detectors.isolation.LIMIT_S", 0.1)
    released = threading.Event()
    with pytest.raises(TimeoutError):
        call_plug_in(released.wait)
    calls = []
    sys.setprofile(lambda frame, event, argument: calls.append(event))
    try:
        sum(len(str(k)) for k in range(100))
    finally:
        sys.setprofile(None)
    released.set()
    assert len(calls) > 100
