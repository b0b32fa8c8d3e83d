"""The summaries of a machine lie beside its text: whole, checked, found again, and never half of a pair."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.healthy_file import (
    SUFFIX,
    SUMMARY_TYPES,
    Line,
    format_summary,
    parse_summary,
    read_lines,
)
from sealscope.diagnosis.rms_change.rms_detector import RmsChange
from sealscope.errors import InputError
from sealscope.storage.plain_state import plain_array

from ...refusals import refusal


@pytest.fixture
def pair(file: Path, tmp_path: Path) -> tuple[Path, Path]:
    """Copies of a machine's text and of its summaries."""
    text, summaries = tmp_path / "actuator7.toml", tmp_path / "actuator7.healthy"
    text.write_bytes(file.read_bytes())
    summaries.write_bytes(file.with_suffix(SUFFIX).read_bytes())
    return text, summaries


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        ss.read_machine(path)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_summary_is_read_as_it_was_learnt(machine):
    """To the last bit, with names that this version does not know."""
    statistics = {"rise": 0.1 + 0.2, "later kind": 1e-300}
    summaries = {**machine.healthy[0].summaries, "a plug-in's": {"names": ["a", "b"], "n": 3, "curve": [0.1, 0.2]}}
    learnt = replace(machine.healthy[0], statistics=statistics, summaries=summaries)
    again = parse_summary(format_summary(learnt), learnt.file, "place")
    assert (again.digest, again.units, again.rate, again.seconds) == (
        learnt.digest, learnt.units, learnt.rate, learnt.seconds,
    )  # fmt: skip
    assert again.about == learnt.about
    assert again.statistics == statistics
    np.testing.assert_array_equal(again.summaries["volume balance"]["sums"], summaries["volume balance"]["sums"])
    assert format_summary(again) == format_summary(learnt)
    np.testing.assert_array_equal(again.summaries["a plug-in's"].pop("curve"), [0.1, 0.2])
    assert again.summaries["a plug-in's"] == {"names": ["a", "b"], "n": 3}


def test_a_file_of_an_earlier_version_is_read_and_written_to_the_byte():
    """A simulated machine, a press whose valves shut at rest, and a hold test, as plain tables were written."""
    lines, kinds = read_lines(Path(__file__).with_name("earlier.healthy")), set()
    for line in lines:
        recording = parse_summary(line, "earlier", "place")
        restored = [summary for kind in SUMMARY_TYPES if (summary := recording.summary(kind)) is not None]
        kinds |= {type(summary) for summary in restored}
        tables = {summary.method: summary.table() for summary in restored}
        assert format_summary(replace(recording, summaries=tables)) == line
    assert len(lines) == 3 and kinds == set(SUMMARY_TYPES)


@pytest.mark.parametrize(
    ("method", "entries"),
    [
        ("hold test", {"bar": 0.0}),
        ("rms change", {"duty": np.zeros(3)}),
        ("pressure response", {"law": "sand"}),
        ("volume balance", {"holds": np.zeros(3)}),
        ("signals", {"octaves": np.zeros((4, 2))}),
    ],
)
def test_a_summary_with_a_wrong_entry_is_refused(method, entries):
    lines = read_lines(Path(__file__).with_name("earlier.healthy"))
    recordings = [parse_summary(line, "earlier", "place") for line in lines]
    recording = next(recording for recording in recordings if method in recording.summaries)
    table = recording.summaries[method]
    with refusal(next(iter(entries))):
        format_summary(replace(recording, summaries={method: {**table, **entries}}))


def test_the_text_is_small(pair, machine):
    """What a person edits is three lines a recording, however large their summaries."""
    text, summaries = pair
    rows = text.read_text().partition("\n[[healthy]]\n")[2]
    assert len(rows) < 150 * len(machine.healthy)
    assert len(summaries.read_bytes()) > 30 * len(rows)


def test_numbers_that_are_not_finite_are_no_summary(machine):
    for value in (np.nan, np.inf, 1e300):
        with refusal("run1.nc"):
            format_summary(replace(machine.healthy[0], statistics={"rise": value}))


def test_a_damaged_summary_is_named(pair):
    text, summaries = pair
    data = bytearray(summaries.read_bytes())
    data[data.index(b"run") if b"run" in data else len(data) // 2] ^= 1
    summaries.write_bytes(data)
    message = refused(text)
    assert "must have the SHA-256" in message
    assert "run" in message
    assert "take its [[healthy]] out of the machine's file, or commission it anew" in message


def test_without_its_damaged_summary_the_machine_has_the_others(pair):
    text, summaries = pair
    rows = summaries.read_bytes().splitlines(keepends=True)
    rows[2] = rows[2].replace(b'"rate":', b'"rote":')
    summaries.write_bytes(b"".join(rows))
    assert "run2.nc" in refused(text)
    parts = text.read_text().split("[[healthy]]")
    text.write_text("[[healthy]]".join(part for part in parts if "run2.nc" not in part))
    assert [learnt.file for learnt in ss.read_machine(text).healthy] == ["run1.nc", "run3.nc"]


def test_a_summary_that_is_not_there_is_named(pair):
    text, summaries = pair
    summaries.write_bytes(b"".join(summaries.read_bytes().splitlines(keepends=True)[:-1]))
    assert "of run3.nc must be in the file of healthy summaries, but is missing" in refused(text)


def test_summaries_that_were_left_behind_are_asked_for(pair):
    text, summaries = pair
    summaries.unlink()
    assert refused(text).startswith("actuator7.healthy must be in the folder of the machine's file: move it there")


def test_a_pair_is_renamed_or_its_text_alone(pair, tmp_path):
    text, summaries = pair
    alone = text.rename(tmp_path / "press.toml")
    assert len(ss.read_machine(alone).healthy) == 3
    summaries.rename(tmp_path / "press.healthy")
    assert len(ss.read_machine(alone).healthy) == 3
    ss.write_machine(ss.read_machine(alone), alone)
    assert 'summaries = "press.healthy"' in alone.read_text()


@pytest.mark.parametrize("name", ["../actuator7.healthy", "/etc/passwd", "sub/actuator7.healthy", "passwd"])
def test_a_text_names_no_summaries_elsewhere(pair, tmp_path, name):
    text, _ = pair
    other = tmp_path / "inner"
    other.mkdir()
    hostile = other / "hostile.toml"
    hostile.write_text(text.read_text().replace('summaries = "actuator7.healthy"', f'summaries = "{name}"'))
    assert "machine.summaries" in refused(hostile)


@pytest.mark.slow
def test_each_text_keeps_its_summaries_whichever_file_was_written_last(pair, machine, monkeypatch):
    """Broken off after any of the three files, text and kept text are those of before or of after."""
    text, _ = pair
    ss.write_machine(replace(machine, name="kept"), text)
    ss.write_machine(replace(machine, name="first"), text)
    new = ss.simulate(command="3 sin(4t)", duration="20 s", seed=40)
    later = replace(machine.with_healthy(new, file="new.nc"), name="later")
    later = replace(later, healthy=later.healthy[2:])
    from sealscope.diagnosis.commissioned import healthy_file, machine_file

    def written(count: int) -> list[tuple[str, int]]:
        """Texts after a write that ends before its file number `count`."""
        left, write = [count], healthy_file.atomic_write

        def stop(path: Path):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return write(path)

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(healthy_file, "atomic_write", stop)
            patch.setattr(machine_file, "atomic_write", stop)
            ss.write_machine(later, text)
        texts = (ss.read_machine(path) for path in (text, text.with_suffix(".toml.bak")))
        return [(known.name, len(known.healthy)) for known in texts]

    assert [written(count) for count in range(3)] == [
        [("first", 3), ("kept", 3)],
        [("first", 3), ("kept", 3)],
        [("first", 3), ("first", 3)],
    ]
    ss.write_machine(later, text)
    assert len(ss.read_machine(text).healthy) == 2
    assert len(ss.read_machine(text.with_suffix(".toml.bak")).healthy) == 3


def test_summaries_that_no_text_names_are_kept_for_its_copies_while_they_are_few(pair, machine, monkeypatch):
    text, summaries = pair
    copy = text.with_name("before.toml")
    copy.write_bytes(text.read_bytes())
    for _ in range(3):
        ss.write_machine(replace(machine, healthy=machine.healthy[:1]), text)
    assert len(ss.read_machine(copy).healthy) == 3
    monkeypatch.setattr("sealscope.diagnosis.commissioned.machine_file._SPARE", 0)
    ss.write_machine(replace(machine, healthy=machine.healthy[:1]), text)
    assert len(summaries.read_bytes().splitlines()) == 2


def test_a_torn_line_is_a_summary_that_is_missing(pair):
    text, summaries = pair
    data = summaries.read_bytes()
    second = data.splitlines(keepends=True)[2]
    summaries.write_bytes(data.replace(second, second[:40] + b"\n"))
    assert "of run2.nc must be in the file of healthy summaries" in refused(text)


def altered(line: Line, change: str, value: object) -> Line:
    tree = json.loads(line.data)
    *path, name = change.split("/")
    place = tree
    for part in path:
        place = place[part]
    place[name.strip()] = value
    data = json.dumps(tree).encode()
    return Line(sha256(data).hexdigest(), data)


def packed(values: object) -> dict[str, object]:
    return plain_array(np.asarray(values, dtype=float))


def sums_of(scale: float) -> dict[str, object]:
    return packed(np.full((1, 25, 25), scale))


HOSTILE = {
    "digest": (3, "digest"),
    "rate": (-1.0, "rate"),
    "seconds": (0.0, "seconds"),
    "units": ([], "units"),
    "start_s": ("now", "start_s"),
    "summaries/volume balance/sums": ([[1.0]], "must be an array of numbers"),
    "summaries/volume balance/sums ": (sums_of(0.0), "sums must be sums of squares and products"),
    "summaries/volume balance/sums  ": (sums_of(1e200), "finite numbers with a magnitude below 1e+100"),
    "summaries/volume balance/sums   ": (sums_of(np.nan), "finite numbers"),
    "summaries/volume balance/scale": (1e300, "scale"),
    "summaries/volume balance/flow": (-1.0, "flow"),
    "summaries/volume balance/stroke": (packed([0.2, 0.1]), "stroke must hold the lower and the upper end"),
    "summaries/volume balance/start_s": (1e18, "start_s"),
    "summaries/pressure response/law": ("coulomb", "law must be stribeck or bristles, got 'coulomb'"),
    "summaries/pressure response/sums": (packed([1.0]), "sums must be of the shape (1, 16, 16), got (1,)"),
    "summaries/rms change/duty": (packed([1.0, 2.0]), "levels and duty must be of the shapes (10,) and (4,)"),
    "summaries/rms change/duty ": (packed([1.0, 2.0, 3.0, 1e9]), "must be logarithms"),
    "about/noise": ({"p_A": "x"}, "noise: p_A"),
    "summaries/volume balance/terms": (["a"], "sums must be of the shape"),
    "summaries/volume balance/pressure": (None, "pressure"),
    "summaries/rms change/levels": ({"shape": [3], "f8": "AAAA"}, "levels"),
    "summaries/other": ([[], []] * 4000, "must hold its numbers in arrays"),
    "statistics/rise": ("high", "statistics: rise"),
}


@pytest.mark.parametrize("change", HOSTILE)
def test_an_altered_summary_with_the_right_checksum_is_refused_in_one_line(pair, change):
    line = read_lines(pair[1])[0]
    value, rule = HOSTILE[change]
    with pytest.raises(InputError) as caught:
        parse_summary(altered(line, change, value), "run1.nc", "hostile.healthy")
    message = str(caught.value)
    assert message.startswith("the summary of run1.nc is wrong: ")
    assert rule in message
    assert "hostile.healthy" in message
    assert "\n" not in message


@pytest.mark.slow
@pytest.mark.long
def test_a_file_of_summaries_takes_less_than_ten_times_its_size_in_memory(pair):
    """The worst that may be written: many short summaries of empty lists."""
    text, summaries = pair
    line = read_lines(summaries)[0]
    bare = {"digest": "a", "units": {}, "rate": 1.0, "seconds": 1.0, "summaries": {"other": {"x": [[]] * 25}}}
    rows = []
    for number in range(2000):
        data = json.dumps({**bare, "digest": f"{number:064}"}).replace(" ", "").encode()
        rows.append((sha256(data).hexdigest(), data))
    summaries.write_bytes(
        b"sealscope healthy summaries 1\n" + b"".join(b"%b %b\n" % (own.encode(), data) for own, data in rows)
    )
    head = text.read_text().partition("\n[[healthy]]\n")[0]
    text.write_text(head + "".join(f'\n[[healthy]]\nfile = "r"\nsummary = "{own}"\n' for own, _ in rows))
    assert parse_summary(line, "run1.nc", "place").digest
    tracemalloc.start()
    try:
        assert len(ss.read_machine(text).healthy) == 2000
        assert tracemalloc.get_traced_memory()[1] < 10 * (text.stat().st_size + summaries.stat().st_size)
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_a_main_method_that_cannot_run_is_never_no_leak(machine, monkeypatch):
    """What the others say is stated beside it."""
    judged = ss.simulate(command="3 sin(4t)", duration="20 s", seed=41)
    assert machine.diagnose(judged).verdict == "no leak"

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("sealscope.diagnosis.inference.volumes.volume_detector.VolumeBalance.observe", fail)
    diagnosis = machine.diagnose(judged)
    assert diagnosis.verdict == "cannot tell"
    assert "volume balance cannot be computed on this recording: singular matrix" in diagnosis.reason


@pytest.mark.slow
def test_what_could_not_be_read_again_is_not_learnt(folder, tmp_path, monkeypatch):
    """The other methods' summaries are kept, and the machine is written."""
    learn = RmsChange.learn
    monkeypatch.setattr(RmsChange, "learn", lambda *words: replace(learn(*words), levels=np.full(10, -np.inf)))
    machine = ss.commission(folder / "run1.nc", rig="thesis")
    assert "rms change" not in machine.healthy[0].summaries
    assert len(ss.read_machine(ss.write_machine(machine, tmp_path / "m.toml")).healthy) == 1
