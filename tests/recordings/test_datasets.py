"""Public data sets: their list, the checksums, and the recordings; on small made sets, and on the real ones."""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope import datasets
from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.joining import start_seconds

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
STROKES = tuple(f"Base_000_{number}_1_9-11-2019-8-3{number}-00_AM.txt" for number in range(3))


def stroke(seed: int) -> bytes:
    counts = np.random.default_rng(seed).integers(0, 2**14, size=(50, 2))
    lines = ["Time\tPG_1\tPG_2", *(f"{k + 1}\t{a}\t{b}" for k, (a, b) in enumerate(counts))]
    return ("\n".join(lines) + "\n").encode()


@pytest.fixture
def strokes(tmp_path) -> tuple[datasets.Dataset, Path]:
    """A set of three strokes, laid out as the archive of a repository has them, with other files beside them."""
    folder = tmp_path / "copy" / "Data" / "Act_1"
    folder.mkdir(parents=True)
    for seed, name in enumerate(STROKES):
        (folder / name.replace("_AM", " AM")).write_bytes(stroke(seed))
    (folder / "train.py").write_text("pass\n")
    made = replace(
        datasets.named("vtnsi-actuator"),
        checksums={name: hashlib.sha256(stroke(seed)).hexdigest() for seed, name in enumerate(STROKES)},
        labels={name: {"seal": "healthy", "specimen": "of our own"} for name in STROKES},
    )
    return made, tmp_path / "copy"


def test_every_known_set_says_whose_it_is_and_how_its_files_are_known():
    assert {dataset.name for dataset in datasets.known()} == {"vtnsi-actuator", "zema-hydraulic"}
    for dataset in datasets.known():
        assert dataset.licence in ("MIT", "CC BY 4.0")
        assert dataset.source.startswith("https://")
        assert len(dataset.citation) > 20 and len(dataset.about) > 100
        assert all(re.fullmatch(r"[0-9a-f]{64}|md5:[0-9a-f]{32}", value) for value in dataset.checksums.values())
        assert len(set(dataset.checksums.values())) == len(dataset.checksums)
        assert set(dataset.channel_map) == {"p_A", "p_B"}
    with pytest.raises(InputError, match="a data set must be vtnsi-actuator or zema-hydraulic, got 'vtnsi-aktuator'"):
        datasets.named("vtnsi-aktuator")


def test_strokes_are_read_in_their_order_and_a_blank_in_a_name_counts_as_an_underscore(strokes):
    made, folder = strokes
    read = list(datasets.read(made, folder))
    for seed, (recording, labels) in enumerate(read):
        counts = np.loadtxt(stroke(seed).decode().splitlines(), skiprows=1)
        np.testing.assert_array_equal(recording["p_A"], counts[:, 1])
        np.testing.assert_array_equal(recording["p_B"], counts[:, 2])
        assert (recording.rate, set(recording.units.values())) == (1000.0, {"count"})
        assert labels == {"seal": "healthy", "specimen": "of our own"}
    starts = [start_seconds(recording) for recording, _ in read]
    assert np.diff(starts).tolist() == [60.0, 60.0]


def test_a_recording_does_not_know_its_labels(strokes):
    """What is known of the machine is for evaluation alone: no detector and no page can see it."""
    made, folder = strokes
    for recording, labels in datasets.read(made, folder):
        disclosed = repr((dict(recording.provenance), recording.history, list(recording.channels)))
        assert not [value for value in labels.values() if str(value) in disclosed]
        assert recording.provenance["licence"] == "MIT"


def test_an_altered_file_is_refused_and_named(strokes):
    made, folder = strokes
    path = next(folder.rglob("*_1_1_*"))
    path.write_bytes(path.read_bytes().replace(b"\n2\t", b"\n2\t1", 1))
    with pytest.raises(InputError, match=rf"{STROKES[1]} of vtnsi-actuator must have the checksum [0-9a-f]{{64}}, got"):
        datasets.read(made, folder)
    result = datasets.check(made, folder)
    assert (list(result.right), list(result.wrong)) == ([STROKES[0], STROKES[2]], [STROKES[1]])
    assert len(list(datasets.read(made, folder, check_files=False))) == 3


def test_a_checkout_with_other_ends_of_lines_is_the_same_set(strokes):
    made, folder = strokes
    for path in folder.rglob("*.txt"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert len(datasets.check(made, folder).right) == 3
    path.write_bytes(path.read_bytes() + b"\r")  # of ends of lines, a bare return is none
    assert len(datasets.check(made, folder).wrong) == 1


def test_ends_of_lines_across_the_pieces_of_a_large_file(tmp_path, monkeypatch):
    monkeypatch.setattr(datasets, "_CHUNK", 3)
    for text in (b"ab\r\ncd\n", b"a\r\r\n\r\n", b"\r\n", b"abc\r"):
        (tmp_path / "f").write_bytes(text)
        digest = hashlib.sha256(text.replace(b"\r\n", b"\n")).hexdigest()
        assert datasets._has(tmp_path / "f", digest)
        assert datasets._has(tmp_path / "f", "md5:" + hashlib.md5(text).hexdigest())
        assert not datasets._has(tmp_path / "f", hashlib.sha256(text + b"x").hexdigest())


def test_a_part_of_a_set_is_read_and_a_second_copy_is_not(strokes):
    made, folder = strokes
    (folder / "again").mkdir()
    (folder / "again" / STROKES[0]).write_bytes(stroke(0))
    next(folder.rglob("*_2_1_*")).unlink()
    assert len(list(datasets.read(made, folder))) == 2
    assert datasets.check(made, folder).missing == (STROKES[2],)


@pytest.mark.parametrize("name", ["vtnsi-actuator", "zema-hydraulic"])
def test_a_folder_without_the_set_is_told_where_it_is(tmp_path, name):
    with pytest.raises(InputError, match=re.escape(f"its files are at {datasets.named(name).source}")):
        datasets.read(name, tmp_path)
    with pytest.raises(InputError, match="a data set's folder must be one, got"):
        datasets.read(name, tmp_path / "nowhere")


BAR = {
    sensor: np.round(np.random.default_rng(k).normal(150, 5, (4, 600)), 2) for k, sensor in enumerate(("PS1", "PS2"))
}
GRADES = "3\t100\t0\t130\t1\n3\t100\t2\t130\t0\n20\t90\t1\t90\t0\n100\t73\t0\t100\t0\n"


def matrix(values: np.ndarray) -> str:
    return "".join("\t".join(map(repr, map(float, row))) + "\r\n" for row in values)


@pytest.fixture
def cycles(tmp_path) -> tuple[datasets.Dataset, Path]:
    """A set of four cycles at 10 Hz, as an archive."""
    with zipfile.ZipFile(tmp_path / "data.zip", "w") as archive:
        archive.writestr("profile.txt", GRADES)
        for sensor, values in BAR.items():
            archive.writestr(f"{sensor}.txt", matrix(values))
    digest = hashlib.md5((tmp_path / "data.zip").read_bytes()).hexdigest()
    return replace(datasets.named("zema-hydraulic"), checksums={"data.zip": f"md5:{digest}"}), tmp_path


def test_cycles_of_an_archive(cycles):
    made, folder = cycles
    read = list(datasets.read(made, folder, map={"p_A": "PS2", "p_1": "PS1"}))
    assert [labels["pump_leakage"] for _, labels in read] == [0, 2, 1, 0]
    for row, (recording, _) in enumerate(read):
        np.testing.assert_allclose(recording["p_A"], 1e5 * BAR["PS2"][row], rtol=1e-15)
        np.testing.assert_allclose(recording["p_1"], 1e5 * BAR["PS1"][row], rtol=1e-15)
        assert (recording.rate, recording.duration) == (10.0, 60.0)


def test_unpacked_matrices_say_the_same_but_have_no_checksum(cycles, tmp_path_factory):
    made, folder = cycles
    unpacked = tmp_path_factory.mktemp("unpacked")
    with zipfile.ZipFile(folder / "data.zip") as archive:
        archive.extractall(unpacked)
    with pytest.raises(InputError, match=r"must hold data\.zip or profile\.txt, got none"):
        datasets.read(made, unpacked)
    pairs = zip(datasets.read(made, folder), datasets.read(made, unpacked, check_files=False), strict=True)
    for packed, loose in pairs:
        assert packed.labels == loose.labels
        np.testing.assert_array_equal(packed.recording["p_A"], loose.recording["p_A"])


def test_matrices_that_do_not_fit_are_refused(cycles, tmp_path_factory):
    made, _ = cycles
    folder = tmp_path_factory.mktemp("odd")
    for sensor, values in BAR.items():
        (folder / f"{sensor}.txt").write_text(matrix(values))
    for text, error in (
        (
            GRADES.replace("100\t73\t0\t100\t0\n", ""),
            r"a row for each row of profile\.txt, .* got \(3, 5\) and \[\(4, 600\)\]",
        ),
        ("a\tb\n", r"must be a table of numbers, got: .*/profile\.txt\)"),
        ("nan\t1\t1\t1\t1\n", r"must hold finite numbers"),
    ):
        (folder / "profile.txt").write_text(text)
        with pytest.raises(UnreadableFile, match=error):
            datasets.read(made, folder, check_files=False)
    with pytest.raises(InputError, match=r"map must map pressures to PS1\.\.PS6, got x=PS1"):
        datasets.read(made, folder, map={"x": "PS1"}, check_files=False)


@pytest.mark.skipif(not REAL.is_dir(), reason="../shared/data/real is absent")
def test_the_real_strokes():
    result = datasets.check("vtnsi-actuator", REAL)
    assert (len(result.right), result.wrong, result.missing) == (239, {}, ())
    name = "Leak_000_0_303_9-10-2019-4-37-01_PM.txt"
    own = ss.read(REAL / "vtnsi_actuator" / "act_4_seal_defect" / name, map={"p_A": "PG_1", "p_B": "PG_2"}, rate=1000)
    strokes = datasets.read("vtnsi-actuator", REAL / "vtnsi_actuator" / "act_4_seal_defect")
    same, labels = next(item for item in strokes if item.recording.provenance["file"] == name)
    np.testing.assert_array_equal(same["p_A"], own["p_A"])
    assert (labels["specimen"], labels["seal"], len(list(strokes))) == ("4", "defective", 29)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(not REAL.is_dir(), reason="../shared/data/real is absent")
def test_all_real_strokes():
    read = list(datasets.read("vtnsi-actuator", REAL))
    assert Counter(labels["specimen"] for _, labels in read) == {"1": 104, "2": 105, "4": 30}
    assert all(len(recording) == 3000 for recording, _ in read)


@pytest.mark.skipif(not REAL.is_dir(), reason="../shared/data/real is absent")
def test_the_real_cycles():
    read = list(datasets.read("zema-hydraulic", REAL))
    assert Counter(labels["pump_leakage"] for _, labels in read) == {0: 1221, 1: 492, 2: 492}  # as its authors count
    assert Counter(labels["cooler_percent"] for _, labels in read) == {3: 732, 20: 732, 100: 741}
    assert all(1e7 < recording["p_A"].mean() < 2e7 for recording, _ in read)
