"""`sealscope diagnose`: the output contract that other programs read, baselines, foreign logs, exit status."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sealscope.cli.app import normalise_arguments
from sealscope.cli.options import StatedMachine
from sealscope.cli.recordings import _iter_dated_diagnoses
from sealscope.reporting.messages import table_line

KEYS = {
    "file": str,
    "verdict": str,
    "reason": str,
    "onset_s": float | None,
    "onset_interval_s": list | None,
    "leak_lpm": float | None,
    "leak_interval_lpm": list | None,
    "bound_lpm": float | None,
    "unused": list,
    "false_alarm_probability": float,
    "score": float | None,
    "threshold": float | None,
    "methods": list,
    "quality": list,
    "cause": str | None,
    "next_check": str,
    "total_leakage": dict | None,
    "chance": float | None,
    "odds": str | None,
    "summary": str,
    "start": str | None,
    "machine": str | None,
    "about": dict,
    "rig": dict,
    "severity": dict | None,
    "limit": dict,
    "evidence": dict,
    "state": dict,
    "holds": list,
}
VERDICTS = {"leak", "no leak", "cannot tell"}
FOREIGN = ("--map", "p_A=PG_1", "--map", "p_B=PG_2", "--rate", "1000")
REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "vtnsi_actuator"


def check_contract(result):
    """Every key with its type, in the stated order; verdicts among the stated three."""
    assert list(result) == list(KEYS)
    for key, kind in KEYS.items():
        assert isinstance(result[key], kind), key
    assert result["verdict"] in VERDICTS
    assert result["reason"]
    for interval in (result["onset_interval_s"], result["leak_interval_lpm"]):
        assert interval is None or (len(interval) == 2 and interval[0] <= interval[1])
    for method in result["methods"]:
        assert {"name", "score", "threshold", "verdict"} <= set(method)
        assert method["verdict"] in VERDICTS
    for finding in result["quality"]:
        assert {"code", "channel", "count", "severity", "text"} <= set(finding)


def said(result, name):
    """The reason that one of the methods gives."""
    return next(item["reason"] for item in result["methods"] if item["name"] == name)


def test_jsonl_is_one_object_a_line_and_nothing_else(call, recordings):
    files = [recordings / "leak.nc", recordings / "healthy_1.nc"]
    done = call("diagnose", *files, "--format", "jsonl")
    assert (done.status, done.err) == (0, "")
    leak, healthy = done.objects
    for result, file in ((leak, files[0]), (healthy, files[1])):
        check_contract(result)
        assert result["file"] == str(file)
        assert result["false_alarm_probability"] == 0.01
    assert leak["verdict"] == "leak"
    assert leak["score"] > leak["threshold"]
    assert abs(leak["onset_s"] - 20.0) <= 10.0
    assert leak["onset_interval_s"][0] <= leak["onset_s"] <= leak["onset_interval_s"][1]
    assert leak["leak_lpm"] is None or leak["leak_lpm"] == pytest.approx(0.0135, rel=0.5)
    assert leak["cause"] in ("piston leak", "piston or pump leak")
    assert healthy["verdict"] == "no leak"
    assert healthy["score"] <= healthy["threshold"]
    assert healthy["onset_s"] is None


@pytest.mark.usefixtures("two_methods")
def test_what_detectors_may_assume_is_a_rig_by_name_or_file(call, recordings, tmp_path):
    words = ("diagnose", recordings / "leak.nc", "--format", "jsonl")
    (plain,) = call(*words).objects
    stated = call(*words, "--rig", "thesis")
    assert call("diagnose", "--rig", "thesis", recordings / "leak.nc", "--format", "jsonl") == stated
    assert plain.pop("rig") | {"stated_by": "call"} == stated.objects[0]["rig"]
    assert plain.items() <= stated.objects[0].items()
    assert "nowhere" in call(*words, "--rig", "nowhere").refused(2)
    assert "absent.toml" in call(*words, "--rig", "absent.toml").refused(2)
    page = tmp_path / "page.html"
    assert call("report", recordings / "leak.nc", "-o", page, "--rig", "thesis").status == 0
    assert "parameters of this machine were not given" not in page.read_text(encoding="utf-8")


@pytest.mark.usefixtures("two_methods")
def test_text_says_the_same(call, recordings):
    files = [recordings / "leak.nc", recordings / "healthy_1.nc"]
    done = call("diagnose", *files)
    assert (done.status, done.err) == (0, "")
    lines = done.out.splitlines()
    assert f"{files[0]}: leak" in lines
    assert f"{files[1]}: no leak" in lines
    assert any(line.startswith("  since") for line in lines)


@pytest.mark.slow
def test_a_process_of_its_own_prints_the_same(shell, call, recordings):
    words = ("diagnose", recordings / "healthy_1.nc", "--format", "jsonl")
    assert shell("sealscope", *words) == call(*words)


@pytest.mark.usefixtures("two_methods")
def test_the_false_alarm_probability_sets_the_threshold(call, recordings):
    thresholds = [
        call("diagnose", recordings / "leak.nc", "--format", "jsonl", "--false-alarm", p).objects[0]["threshold"]
        for p in (0.2, 0.001)
    ]
    assert thresholds[0] < thresholds[1]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_baselines_after_one_flag_or_one_flag_each(call, recordings):
    leak, *healthy = (recordings / name for name in ("leak.nc", "healthy_1.nc", "healthy_2.nc", "healthy_3.nc"))
    item = call("diagnose", leak, "--baseline", *healthy, "--format", "jsonl")
    each = call("diagnose", *(word for file in healthy for word in ("--baseline", file)), "--format", "jsonl", leak)
    first = call("diagnose", "--baseline", *healthy, "--format=jsonl", "--", leak)
    assert item.status == 0
    assert item == each == first
    (result,) = item.objects
    check_contract(result)
    assert "3 comparable leak-free recordings" in said(result, "rms change")


def test_a_call_with_a_file_that_is_its_own_baseline_is_refused(call, recordings):
    file = recordings / "healthy_1.nc"
    alone = call("diagnose", recordings / "leak.nc", file, "--baseline", file)
    assert "a baseline must be another recording than the file itself" in alone.refused(2)
    assert alone.out == ""  # a wrong call gives no verdict at all


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_a_baseline_is_not_its_own_baseline(call, recordings):
    files = [recordings / f"healthy_{k}.nc" for k in (1, 2)]
    done = call("diagnose", *files, "--baseline", *files, "--format", "jsonl")
    assert done.status == 0
    assert [item["file"] for item in done.objects] == [str(file) for file in files]
    for item in done.objects:
        assert "1 comparable leak-free recording" in said(item, "rms change")


@pytest.mark.usefixtures("two_methods")
def test_two_words_after_baseline_and_no_other_are_a_baseline_and_a_file(call, recordings):
    baseline, file = recordings / "healthy_1.nc", recordings / "healthy_2.nc"
    done = call("diagnose", "--format", "jsonl", "--baseline", baseline, file)
    assert done.status == 0
    assert [item["file"] for item in done.objects] == [str(file)]
    assert "1 comparable leak-free recording" in said(done.objects[0], "rms change")


@pytest.mark.parametrize(
    ("words", "spread"),
    [
        ("diagnose a", "diagnose a"),
        ("diagnose --baseline b c a", "diagnose --baseline b c a"),
        ("diagnose a --baseline b c", "diagnose --baseline b --baseline c a"),
        ("diagnose a --baseline b --rate 5 c", "diagnose --baseline b a --rate 5 c"),
        ("diagnose --baseline b --baseline c d", "diagnose --baseline b --baseline c d"),
        ("diagnose --rate 5 --baseline b c", "diagnose --baseline b c --rate 5"),
        ("diagnose a --baseline b --rig lab.toml", "diagnose --baseline b a --rig lab.toml"),
        ("diagnose --rig lab --baseline b c", "diagnose --baseline b c --rig lab"),
        ("diagnose --rate=5 --baseline b c", "diagnose --baseline b c --rate=5"),
        ("diagnose --baseline=b a", "diagnose --baseline=b a"),
        ("diagnose --baseline b c -- -a", "diagnose --baseline b --baseline c -- -a"),
        ("diagnose a -- --baseline -v", "diagnose a -- --baseline -v"),
        ("report a -o p --baseline b c", "report --baseline b --baseline c a -o p"),
        ("convert a --baseline b c", "convert a --baseline b c"),
        ("", ""),
    ],
)
def test_how_baselines_are_spread(words, spread):
    assert normalise_arguments(words.split()) == spread.split()


@pytest.mark.usefixtures("two_methods")
def test_a_missing_file_among_good_ones_costs_the_others_nothing(call, recordings, untouched):
    files = [recordings / "leak.nc", "absent.csv", recordings / "healthy_1.nc"]
    done = call("diagnose", *files, "--format", "jsonl")
    assert done.refused(1) == "a recording must exist, got no such file (absent.csv)"
    assert [item["verdict"] for item in done.objects] == ["leak", "no leak"]


def test_without_a_baseline_that_can_be_read_nothing_is_diagnosed(call, recordings, untouched):
    done = call("diagnose", recordings / "leak.nc", "--baseline", "absent.csv")
    assert done.status == 1
    assert done.out == ""
    assert done.err.splitlines()[1] == "sealscope: no baseline could be read, so nothing is diagnosed"


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_a_missing_baseline_among_good_ones(call, recordings, untouched):
    healthy = recordings / "healthy_1.nc"
    done = call("diagnose", recordings / "leak.nc", "--baseline", "absent.csv", healthy, "--format", "jsonl")
    assert "absent.csv" in done.refused(1)
    assert len(done.objects) == 1
    done = call("diagnose", recordings / "leak.nc", healthy, "--baseline", "absent.csv", healthy, "--format", "jsonl")
    assert done.status == 1
    assert [item["file"] for item in done.objects] == [str(recordings / "leak.nc")]
    assert len(done.err.splitlines()) == 2
    assert str(healthy) in done.err.splitlines()[1]


def in_one_session(strokes: Path, folder: Path) -> tuple[list[Path], list[Path]]:
    """The strokes under names that say when each was taken, one every 12 s: the leaking ones and the healthy ones."""
    copies: dict[str, list[Path]] = {"leak": [], "healthy": []}
    for k, file in enumerate([*sorted(strokes.glob("healthy_*")), *sorted(strokes.glob("leak_*"))]):
        copy = folder / f"2026-01-05_10-{12 * k // 60:02d}-{12 * k % 60:02d}_{file.name}"
        copy.write_bytes(file.read_bytes())
        copies[file.name.split("_")[0]].append(copy)
    return copies["leak"], copies["healthy"]


@pytest.mark.slow
def test_foreign_logs_without_times_may_be_of_another_day(call, strokes):
    files = sorted(strokes.glob("leak_*")) + sorted(strokes.glob("healthy_*"))[:4]
    done = call("diagnose", *files, "--baseline", *sorted(strokes.glob("healthy_*")), *FOREIGN, "--format", "jsonl")
    assert (done.status, done.err) == (0, "")
    for item in done.objects:
        assert "of which the sessions are not known" in item["reason"]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, pytest.param(4, marks=pytest.mark.long)])
def test_foreign_logs_with_a_map_and_a_rate(call, strokes, tmp_path, count):
    """Ringing alone proves no leak: oil, load and duty change it more often; what fell is stated."""
    leaking, healthy = in_one_session(strokes, tmp_path)
    files = leaking[:count] + healthy[:count]
    done = call("diagnose", *files, "--baseline", *healthy, *FOREIGN, "--format", "jsonl")
    assert (done.status, done.err) == (0, "")
    assert [item["file"] for item in done.objects] == [str(file) for file in files]
    verdicts = [item["verdict"] for item in done.objects]
    assert verdicts[:count] == ["cannot tell"] * count and "leak" not in verdicts[count:]
    assert all("fall of" in item["reason"] and "or a leak (" in item["reason"] for item in done.objects[:count])
    for item, others in zip(done.objects, [20] * count + [19] * count, strict=True):
        check_contract(item)
        assert f"{others} comparable leak-free recordings" in item["reason"]  # of both directions


@pytest.mark.slow
def test_a_stroke_beside_strokes_of_the_opposite_direction_is_no_leak(call, strokes):
    other_way = sorted(strokes.glob("healthy_*"))[1::2]
    done = call("diagnose", strokes / "leak_00.txt", "--baseline", *other_way, *FOREIGN, "--format", "jsonl")
    assert done.status == 0
    (result,) = done.objects
    assert result["verdict"] == "cannot tell"
    assert f"against {len(other_way)} comparable" in said(result, "rms change")


def test_a_foreign_log_without_a_rate_takes_its_time_column_and_without_a_map_is_refused(call, strokes, untouched):
    file = strokes / "leak_00.txt"
    assert "be given a map" in call("diagnose", file, "--rate", "1000").refused(1)
    assert "PG_9" in call("diagnose", file, "--map", "p_A=PG_9", "--rate", "1000").refused(1)


@pytest.mark.skipif(not REAL.is_dir(), reason="../shared/data/real/vtnsi_actuator is absent")
@pytest.mark.parametrize(
    "every",
    [
        pytest.param(24, marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param(1, marks=[pytest.mark.slow, pytest.mark.long]),
    ],
)
def test_every_real_stroke_gets_a_verdict(call, every):
    healthy, worn = (sorted((REAL / name).glob("*.txt")) for name in ("act_1_healthy", "act_4_seal_defect"))
    worn = worn[::every]
    done = call("diagnose", *worn, "--baseline", *healthy, *FOREIGN, "--format", "jsonl")
    assert (done.status, done.err) == (0, "")
    assert [item["file"] for item in done.objects] == [str(file) for file in worn]
    # another specimen on another day: a worn seal cannot be told from these
    assert Counter(item["verdict"] for item in done.objects)["leak"] == 0
    own = call("diagnose", *healthy[:15], "--baseline", *healthy[15:], *FOREIGN, "--format", "jsonl")
    assert (own.status, own.err) == (0, "")
    assert len(own.objects) == 15
    assert Counter(item["verdict"] for item in own.objects)["leak"] <= 1
    for item in done.objects + own.objects:
        check_contract(item)
    counts = {said(item, "rms change").split("comparable")[0].split()[-1] for item in own.objects}
    assert counts == {"15"}


@pytest.mark.slow
@pytest.mark.parametrize("form", ["jsonl", pytest.param("text", marks=pytest.mark.long)])
def test_side_by_side_says_what_one_after_the_other_says(form, tmp_path, monkeypatch):
    """In the order given, a bad file among them, to the byte, on both streams."""
    from typer.testing import CliRunner

    import sealscope.cli.recordings as module
    from sealscope.cli.app import app
    from sealscope.recordings import write
    from sealscope.simulation.simulate import simulate

    files = [tmp_path / f"{seed}.nc" for seed in range(5)]
    for seed, file in enumerate(files):
        write(simulate(command="3 sin(4t)", duration="20 s", seed=seed), file)
    files[1].write_bytes(b"nothing")
    arguments = ["diagnose", *map(str, files), "--format", form]
    monkeypatch.setattr("sealscope.campaigns.execution.workers.cores", lambda: 2)
    beside = CliRunner().invoke(app, arguments)
    monkeypatch.setattr(module, "_MIN_PARALLEL_FILES", 99)
    alone = CliRunner().invoke(app, arguments)
    assert beside.exit_code == alone.exit_code == 1
    assert beside.stdout == alone.stdout
    assert beside.stderr == alone.stderr
    assert "1.nc" in beside.stderr
    assert beside.stdout.count(".nc") >= 4


@pytest.mark.usefixtures("verbose", "two_methods")
def test_five_lines_by_default_all_with_v_one_when_quiet(call, recordings):
    short = call("diagnose", recordings / "leak.nc")
    whole = call("-v", "diagnose", recordings / "leak.nc")
    line = call("diagnose", "--quiet", recordings / "leak.nc")
    labels = [text[2:12].strip() for text in short.out.splitlines()[1:] if text[2:12].strip()]
    assert labels[:2] == ["state", "since"]
    assert {"how much", "how sure", "next"} <= set(labels) and len(labels) <= 7
    assert "method" not in labels and "  method    volume balance" in whole.out
    assert line.out == short.out.splitlines()[0] + "\n" == f"{recordings / 'leak.nc'}: leak\n"


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_scripts_may_fail_on_a_verdict(call, recordings):
    leak, healthy = recordings / "leak.nc", recordings / "healthy_1.nc"
    assert call("diagnose", leak, "--quiet", "--fail-on", "leak").status == 3
    assert call("diagnose", healthy, "--quiet", "--fail-on", "leak").status == 0
    assert call("diagnose", healthy, "--quiet", "--fail-on", "leak", "--fail-on", "no leak").status == 3


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_scripts_may_fail_on_a_level(call, recordings):
    files = (recordings / "leak.nc", recordings / "healthy_1.nc")
    words = ("--quiet", "--rig", "thesis", "--limit", "0.1 mL/min", "--fail-on")
    for level in ("monitor", "plan", "repair"):  # over the limit: as bad as each or worse
        assert call("diagnose", files[0], *words, level).status == 3
    assert call("diagnose", files[1], *words, "monitor").status == 0
    assert (
        call("diagnose", files[0], "--quiet", "--rig", "thesis", "--limit", "1 L/min", "--fail-on", "plan").status == 0
    )


def test_a_file_without_a_date_does_not_get_that_of_its_last_change(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("t [s],p_A [bar],p_B [bar]\n" + "".join(f"{k / 50},{k % 7},{k % 5}\n" for k in range(400)))
    ((start, diagnosis),) = _iter_dated_diagnoses([file], machine=StatedMachine.from_options(), joined=False)
    assert start is None
    assert str(datetime.now(UTC).year) not in table_line(diagnosis, start)
