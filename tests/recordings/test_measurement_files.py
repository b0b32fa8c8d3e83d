"""Files of measurement programs, written by their own libraries where they write, read to the channels they hold."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import Recording, read

from ..refusals import refusal
from .dialects import (
    DIALECTS,
    FILES,
    P_A,
    P_B,
    RATE,
    N,
    T,
    X,
    deviations,
    lvm,
    matlab,
    pack,
    structs,
    tdms,
    tdms_other_groups,
    timeseries,
    vectors,
    xlsx,
)

pytest.importorskip("nptdms")
pytest.importorskip("matio")
pytest.importorskip("asammdf")
pytest.importorskip("python_calamine")

#: Files that know the moment of their first sample.
STAMPED = ("TDMS, waveform", "MDF", "LabVIEW")


def agrees(recording: Recording) -> None:
    """Hold the recording against what was written; units as the file states them, or raw counts where it has none."""
    factor = {"Pa": 1.0, "count": 1e-5, "m": 1.0}
    assert recording.rate == RATE
    assert recording.t - recording.t[0] == pytest.approx(T, abs=1e-9)
    for name, values, unit in (("p_A", P_A, 1e5), ("p_B", P_B, 1e5), ("x", X, 1e-3)):
        assert recording[name] == pytest.approx(values * unit, rel=1e-12), name
        assert recording.units[name] in factor


@pytest.mark.parametrize("kind", FILES)
def test_files(kind: str, tmp_path: Path) -> None:
    recording = read(FILES[kind](tmp_path))
    agrees(recording)
    if kind.startswith(STAMPED):
        assert recording.provenance["start"].startswith("2024-05-31T12:00:00.25")


@pytest.mark.parametrize("name", [name for name in DIALECTS if name not in FILES])
def test_dialects_are_read_to_their_last_digit(name: str, tmp_path: Path) -> None:
    dialect = DIALECTS[name]
    recording = read(dialect.write(tmp_path), **dialect.options)
    assert recording.rate == pytest.approx(RATE, rel=1e-6)
    assert len(recording) == N
    missing = sum(int(np.isnan(recording[channel]).sum()) for channel in ("p_A", "p_B", "x"))
    assert missing == ("in a cell" in name or "empty cell" in name)
    assert recording.t - recording.t[0] == pytest.approx(T, abs=1e-6)
    for channel, off in deviations(recording).items():
        assert off <= 0.5 * dialect.digit + 1e-11, channel


def test_the_group_that_holds_most_channels_is_read(tmp_path: Path) -> None:
    recording = read(tdms_other_groups(tmp_path))
    assert "channels of group Fast read, not those of the same name of Statistics" in recording.history
    other = read(tmp_path / "log.tdms", map={"p_A": "Statistics/p_A", "p_B": "oil[bar]"})
    assert len(other) == 4


def test_timeseries_and_logs(tmp_path: Path) -> None:
    for uniform in (False, True):
        held = {name: timeseries(name, values, uniform) for name, values in (("p_A", P_A), ("p_B", P_B))}
        recording = read(matlab(tmp_path, held, "v7"))
        assert recording.rate == RATE
        assert recording["p_B"] == pytest.approx(P_B * 1e5, rel=1e-12)


def test_rates_are_brought_to_that_of_the_pressures(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    slow, fast = np.arange(41) / 100, np.arange(5 * N) / 2500
    kept = np.delete(np.arange(41), slice(20, 30))  # a gap of ten slow samples
    with MDF(version="4.10") as file:
        file.append([Signal(P_A, T, unit="bar", name="p_A"), Signal(P_B, T, unit="bar", name="p_B")])
        file.append([Signal(3.0 * slow[kept], slow[kept], unit="mm", name="x")])
        file.append([Signal(2.0 * fast, fast, unit="V", name="u")])
        file.save(tmp_path / "log.mf4")
    recording = read(tmp_path / "log.mf4")
    assert "x at 100 Hz: interpolated linearly to 500 Hz" in recording.history
    assert "u at 2500 Hz: averaged over each interval of 500 Hz" in recording.history
    inside = (T > 0.19) & (T < 0.3)
    assert np.isnan(recording["x"][inside]).all()
    assert recording["x"][~inside] == pytest.approx(3e-3 * T[~inside], abs=1e-12)
    # the mean of five samples from one and a fifth of an interval before to one after is the value in their middle
    assert recording["u"][1:-1] == pytest.approx(2.0 * T[1:-1], abs=2.0 / 2500)


@pytest.mark.parametrize("ending", ["gz", "bz2", "xz", "zst", "zip"])
def test_archives(ending: str, tmp_path: Path) -> None:
    rows = "".join(f"{t},{a!r},{b!r},{x!r}\n" for t, a, b, x in zip(T, P_A.tolist(), P_B.tolist(), X, strict=True))
    text = ("t [s],p_A [bar],p_B [bar],x [mm]\n" + rows.replace("np.float64(", "").replace(")", "")).encode()
    path = pack(text, tmp_path, ending)
    recording = read(path)
    agrees(recording)
    assert recording.provenance["file"] == path.name
    path.write_bytes(path.read_bytes()[:-60])
    with refusal("log.csv", error=UnreadableFile):
        read(path)


def test_an_archive_of_two_files_names_them(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "logs.zip", "w") as archive:
        archive.writestr("a.csv", "t,p_A\n")
        archive.writestr("b.csv", "t,p_A\n")
    with refusal("2", "a.csv", "b.csv", error=UnreadableFile):
        read(tmp_path / "logs.zip")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("log.7z", b"7z\xbc\xaf\x27\x1c" + bytes(99), "7z, unpack"),
        ("log.dat", b"|CF,2,1,1;|CK,1,3,1,1;" + P_A.tobytes(), "imc FAMOS, export"),
        ("log.dat", b"DIAEXTENDED  {@:ENGLISH\n", "DIAdem, TDMS, CSV"),
        ("log.tdm", b'<?xml version="1.0"?><usi:tdm version="1.0"/>', "DIAdem, TDMS"),
        ("log.tdx", P_A.tobytes(), "DIAdem, export"),
        ("log.bin", P_A.tobytes(), "catman, MATLAB, TDMS, ASCII"),
        ("log.svdx", P_A.tobytes(), "TwinCAT Scope, CSV"),
        ("log.unv", b"    -1\n    58\np_A\n", "UFF 58, MATLAB, CSV"),
        ("log.dxd", b"DEWESoft" + bytes(range(256)), "Dewesoft, export"),
        ("log.json", b'[{"t": 0}]\n', "channel"),
        ("log.csv", b"{rig 3}\n[0]\n", "JSON, CSV"),
        ("log.npy", b"\x93NUMPY\x01\0", "NumPy, CSV"),
    ],
)
def test_what_is_not_read_names_the_way_out(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with refusal(*words.split(", "), name, error=UnreadableFile):
        read(tmp_path / name)


@pytest.mark.parametrize("kind", ["TDMS, waveform", "MATLAB v7, vectors", "MATLAB v7.3, table", "MDF 4.10", "Excel"])
def test_a_damaged_file_is_refused_in_one_line(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = FILES[kind](tmp_path)
    whole = path.read_bytes()
    for share in (0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            read(path)
        except UnreadableFile as error:
            assert path.name in str(error)
            assert "\n" not in str(error)
    output = capfd.readouterr()
    assert output.out == output.err == ""


def test_a_matlab_file_that_reads_from_another_file_is_refused(tmp_path: Path) -> None:
    import h5py

    (tmp_path / "secret").write_bytes(bytes(range(80)))
    path = vectors(tmp_path, "v7.3")
    with h5py.File(path, "r+") as file:
        data = file.create_dataset("u", (10,), "f8", external=[(str(tmp_path / "secret"), 0, 80)])
        data.attrs["MATLAB_class"] = np.bytes_("double")
    with refusal("u", error=UnreadableFile):
        read(path)


def test_what_a_file_says_of_its_recording(tmp_path: Path) -> None:
    from nptdms import ChannelObject, RootObject, TdmsWriter

    with TdmsWriter(tmp_path / "log.tdms") as writer:
        root = RootObject({"Operator": "N. N.", "Oil temperature": 41.5})
        writer.write_segment([root, ChannelObject("Log", "p_A", P_A, {"unit_string": "bar", "wf_increment": 1 / RATE})])
    assert read(tmp_path / "log.tdms").provenance["about"]["Oil temperature"] == "41.5"
    assert read(lvm(tmp_path)).provenance["about"] == {"operator": "N. N."}
    assert read(xlsx(tmp_path)).provenance.get("about") is None


def test_packets_of_several_days_have_one_order_of_day_and_month(tmp_path: Path) -> None:
    path = lvm(tmp_path, packets=2)
    first, second = (f"Date{3 * f'{chr(9)}{day}/06/2024'}" for day in (12, 13))
    packets = path.read_text().replace(f"Date{3 * f'{chr(9)}2024/05/31'}", first)
    at = packets.rindex(first)
    path.write_text(packets[:at] + second + packets[at + len(first) :])
    recording = read(path)
    assert recording.provenance["start"].startswith("2024-06-12T12:00:00.25")
    assert recording.t[[0, -1]] == pytest.approx([0.0, 86400 + T[-1]])


@pytest.mark.parametrize("kind", ["TDMS", "JSON"])
def test_groups_with_stamps_of_their_own_begin_when_they_say(kind: str, tmp_path: Path) -> None:
    start = np.datetime64("2024-05-31T12:00:00.250", "us")
    early, late = (start + np.round(1e6 * (T + delay)).astype("timedelta64[us]") for delay in (0.0, 0.2))
    if kind == "TDMS":
        fast = {"Time": (early, ""), "p_A": (P_A, "bar"), "p_B": (P_B, "bar")}
        path = tdms(tmp_path, {"Fast": fast, "Late": {"Time": (late, ""), "x": (X, "mm")}})
    else:
        groups = {
            "Fast": {"Time": early.astype(str).tolist(), "p_A [bar]": P_A.tolist(), "p_B [bar]": P_B.tolist()},
            "Late": {"Time": late.astype(str).tolist(), "x [mm]": X.tolist()},
        }
        path = tmp_path / "log.json"
        path.write_text(json.dumps(groups))
    recording = read(path)
    assert recording.provenance["start"] == "2024-05-31T12:00:00.25"
    assert recording["p_A"] == pytest.approx(1e5 * P_A)
    assert np.isnan(recording["x"][:100]).all()
    assert recording["x"][100:] == pytest.approx(1e-3 * X[:100], abs=1e-9)


def lvm_of_lengths(path: Path, columns: str, clocks: list[tuple[float, np.ndarray]], names: str) -> Path:
    """Write a LabVIEW file of channels with these steps [s] and samples, which end in blanks; `names` of columns."""
    lines = [f"LabVIEW Measurement\nX_Columns\t{columns}\n***End_of_Header***\n", "Channels\t3", "X0\t0\t0\t0"]
    lines += ["\t".join(["Delta_X", *(repr(step) for step, _ in clocks)]), "Y_Unit_Label\tbar\tbar\tmm"]
    lines += ["***End_of_Header***", names.replace(" ", "\t")]
    for k in range(N):
        cells = {
            name: repr(float(values[k])) if k < len(values) else ""
            for name, (_, values) in zip(("p_A", "p_B", "x"), clocks, strict=True)
        }
        cells["X_Value"] = repr(k * clocks[0][0]) if columns == "Multi" else ""
        lines.append("\t".join(cells[name] for name in names.split(" ")))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("slow", ["x", "p"])
def test_labview_channels_without_times_have_steps_of_their_own(slow: str, tmp_path: Path) -> None:
    coarse = (10 / RATE, N // 10)
    pressure, position = ((1 / RATE, N), coarse) if slow == "x" else (coarse, (1 / RATE, N))
    signals = [(P_A, *pressure), (P_B, *pressure), (X, *position)]
    clocks = [(step, np.interp(np.arange(count) * step, T, values)) for values, step, count in signals]
    recording = read(lvm_of_lengths(tmp_path / "log.lvm", "No", clocks, "X_Value p_A p_B x"))
    assert recording.rate == 1 / pressure[0]
    assert len(recording) == pressure[1]
    t = recording.t
    for name, values, unit in (("p_A", P_A, 1e5), ("p_B", P_B, 1e5), ("x", X, 1e-3)):
        known = np.isfinite(recording[name])
        assert known.mean() > 0.9
        assert recording[name][known] == pytest.approx(unit * np.interp(t, T, values)[known], rel=0.01, abs=2e-4)


def test_labview_channels_that_follow_one_column_of_times_may_end_early(tmp_path: Path) -> None:
    clocks = [(1 / RATE, P_A), (1 / RATE, P_B[:-10]), (1 / RATE, X)]
    recording = read(lvm_of_lengths(tmp_path / "log.lvm", "Multi", clocks, "X_Value p_A p_B X_Value x"))
    assert recording["p_A"] == pytest.approx(1e5 * P_A)
    assert recording["p_B"][:-10] == pytest.approx(1e5 * P_B[:-10])
    assert np.isnan(recording["p_B"][-10:]).all()


def test_of_two_simulink_scopes_that_with_most_channels_is_read(tmp_path: Path) -> None:
    def scope(t: np.ndarray, **signals: np.ndarray) -> dict[str, object]:
        rows = [(values[:, None], label) for label, values in signals.items()]
        return {"time": t[:, None], "signals": structs(("values", "label"), rows)}

    held = {"trial": scope(T[::2], p_A=np.zeros(N // 2)), "run": scope(T, p_A=P_A, p_B=P_B, x=X)}
    recording = read(matlab(tmp_path, held, "v7"))
    assert recording.rate == RATE
    assert recording["p_A"] == pytest.approx(P_A)
    assert any("run" in line and "trial" in line for line in recording.history)


def test_a_formula_without_a_value_is_a_missing_sample(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["t [s]", "p_A [bar]", "x [mm]"])
    for k in range(N):  # a sheet's =IF(test, value) is FALSE where the test fails
        book.active.append([float(T[k]), float(P_A[k]), float(X[k]) if k % 2 else False])
    book.save(tmp_path / "log.xlsx")
    recording = read(tmp_path / "log.xlsx")
    assert recording["p_A"] == pytest.approx(1e5 * P_A)
    assert np.array_equal(np.isnan(recording["x"]), np.arange(N) % 2 == 0)
