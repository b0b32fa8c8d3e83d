"""Files of measurement programs, written by their own libraries where they write, read to the channels they hold."""

from __future__ import annotations

import bz2
import datetime as dt
import gzip
import lzma
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import Recording, read

pytest.importorskip("nptdms")
pytest.importorskip("matio")
pytest.importorskip("asammdf")
pytest.importorskip("python_calamine")

RATE = 500.0
N = 200
T = np.arange(N) / RATE
P_A = 20.0 + np.sin(7.0 * T)  # bar
P_B = 18.0 - np.sin(7.0 * T)
X = 12.5 * np.sin(3.0 * T)  # mm
START = dt.datetime(2024, 5, 31, 12, 0, 0, 250000, tzinfo=dt.UTC)
Writer = Callable[[Path], Path]


def tdms(folder: Path, groups: dict[str, dict[str, Any]], **properties: Any) -> Path:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(folder / "log.tdms") as writer:
        writer.write_segment(
            [
                ChannelObject(group, name, data, {**properties, "unit_string": unit})
                for group, channels in groups.items()
                for name, (data, unit) in channels.items()
            ]
        )
    return folder / "log.tdms"


def tdms_waveform(folder: Path) -> Path:
    channels = {"p_A": (P_A, "bar"), "p_B": (P_B, "bar"), "x": (X, "mm")}
    start = np.datetime64("2024-05-31T12:00:00.250000", "us")
    return tdms(folder, {"Measured": channels}, wf_increment=1 / RATE, wf_start_offset=0.0, wf_start_time=start)


def tdms_time_column(folder: Path) -> Path:
    return tdms(folder, {"Log": {"Time": (T, "s"), "p_A": (P_A, "bar"), "p_B": (P_B, "bar"), "x": (X, "mm")}})


def tdms_other_groups(folder: Path) -> Path:
    fast = {"p_A": (P_A, "bar"), "p_B": (P_B, "bar"), "x": (X, "mm")}
    other = {"p_A": (np.zeros(4), "bar"), "oil": (np.full(4, 40.0), "degC")}
    return tdms(folder, {"Statistics": other, "Fast": fast}, wf_increment=1 / RATE)


def matlab(folder: Path, held: dict[str, Any], version: str) -> Path:
    path = folder / "log.mat"
    if version in ("4", "5"):
        from scipy.io import savemat

        savemat(path, held, format=version, oned_as="row")
    else:
        from matio import save_to_mat

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on the resolution of time deltas
            save_to_mat(path, held, version=version)
    return path


def vectors(folder: Path, version: str) -> Path:
    return matlab(folder, {"t": T[None, :], "p_A": P_A[:, None] * 1e5, "p_B": P_B * 1e5, "x": X * 1e-3}, version)


def struct(folder: Path, version: str) -> Path:
    fields = {"t": T, "p_A": P_A * 1e5, "p_B": P_B * 1e5, "x": X * 1e-3, "remark": "rig 3"}
    return matlab(folder, {"log": fields, "operator": "N. N."}, version)


def table(folder: Path, version: str) -> Path:
    import pandas as pd

    return matlab(folder, {"T": pd.DataFrame({"t": T, "p_A": P_A * 1e5, "p_B": P_B * 1e5, "x": X * 1e-3})}, version)


def timetable(folder: Path, version: str) -> Path:
    import pandas as pd

    times = pd.TimedeltaIndex((T * 1e9).round().astype("timedelta64[ns]").astype("timedelta64[ms]"), name="Time")
    frame = pd.DataFrame({"p_A": P_A * 1e5, "p_B": P_B * 1e5, "x": X * 1e-3}, index=times)
    return matlab(folder, {"TT": frame}, version)


def structure_with_time(folder: Path, version: str) -> Path:
    signals = np.zeros(3, dtype=[("values", object), ("dimensions", object), ("label", object)])
    for place, (name, values) in enumerate({"p_A": P_A * 1e5, "p_B": P_B * 1e5, "x": X * 1e-3}.items()):
        signals[place] = (values[:, None], 1.0, name)
    return matlab(folder, {"ScopeData": {"time": T[:, None], "signals": signals, "blockName": "rig/Scope"}}, version)


def timeseries(name: str, values: Any, uniform: bool) -> Any:
    """Return an object with the properties that MATLAB's timeseries stores."""
    from matio.utils.matclass import MatlabOpaque

    info = {"Units": "seconds", "Start": 0.0, "Increment": 1 / RATE, "Length": float(N)}
    properties = {"Name": name, "Data_": values[:, None], "TimeInfo": info, "DataInfo": {"Units": "bar"}}
    properties["Time_"] = np.empty((0, 0)) if uniform else T[:, None]
    return MatlabOpaque(properties, "timeseries")


def mdf(folder: Path, version: str, name: str) -> Path:
    from asammdf import MDF, Signal

    with MDF(version=version) as file:
        file.header.start_time = START
        file.append([Signal(P_A, T, unit="bar", name="p_A"), Signal(P_B, T, unit="bar", name="p_B")], comment="fast")
        file.append([Signal(X, T, unit="mm", name="x")], comment="position")
        file.save(folder / name, overwrite=True)
    return folder / name


def xlsx(folder: Path) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.title = "Info"
    book.active.append(["Operator", "N. N."])
    sheet = book.create_sheet("Data")
    sheet.append(["exported by a logger"])
    sheet.append(["Time", "p_A", "p_B", "x"])
    sheet.append(["s", "bar", "bar", "mm"])
    for row in zip(T, P_A, P_B, X, strict=True):
        sheet.append([float(value) for value in row])
    book.save(folder / "log.xlsx")
    return folder / "log.xlsx"


def ods(folder: Path) -> Path:
    """Write OpenDocument's content.xml by hand, from the published format."""
    rows = "".join(
        "<table:table-row>"
        + "".join(
            f'<table:table-cell office:value-type="float" office:value="{float(value)!r}"><text:p/></table:table-cell>'
            for value in row
        )
        + "</table:table-row>"
        for row in zip(T, P_A, P_B, X, strict=True)
    )
    names = "".join(
        f'<table:table-cell office:value-type="string"><text:p>{name}</text:p></table:table-cell>'
        for name in ("t [s]", "p_A [bar]", "p_B [bar]", "x [mm]")
    )
    space = "urn:oasis:names:tc:opendocument:xmlns"
    content = (
        f'<?xml version="1.0"?><office:document-content xmlns:office="{space}:office:1.0" '
        f'xmlns:table="{space}:table:1.0" xmlns:text="{space}:text:1.0" office:version="1.2"><office:body>'
        f'<office:spreadsheet><table:table table:name="Log"><table:table-row>{names}</table:table-row>{rows}'
        "</table:table></office:spreadsheet></office:body></office:document-content>"
    )
    kind = "application/vnd.oasis.opendocument.spreadsheet"
    manifest = (
        f'<?xml version="1.0"?><manifest:manifest xmlns:manifest="{space}:manifest:1.0">'
        f'<manifest:file-entry manifest:full-path="/" manifest:media-type="{kind}"/></manifest:manifest>'
    )
    with zipfile.ZipFile(folder / "log.ods", "w") as archive:
        archive.writestr("mimetype", kind)
        archive.writestr("content.xml", content)
        archive.writestr("META-INF/manifest.xml", manifest)
    return folder / "log.ods"


def lvm(folder: Path, columns: str = "One", comma: bool = False, packets: int = 1, name: str = "log.lvm") -> Path:
    """Write a LabVIEW measurement file from the format's published description."""
    separator = ","
    lines = ["LabVIEW Measurement", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab"]
    lines += [f"Decimal_Separator\t{separator if comma else '.'}", f"X_Columns\t{columns}", "Time_Pref\tRelative"]
    lines += ["Operator\tN. N.", "Date\t2024/05/31", "Time\t12:00:00.25", "***End_of_Header***\t", "\t"]
    for part in np.array_split(np.arange(N), packets):
        moment = f"12:00:{0.25 + T[part[0]]:010.7f}"
        lines += ["Channels\t3\t\t", f"Samples\t{len(part)}\t{len(part)}\t{len(part)}"]
        lines += ["Date\t2024/05/31\t2024/05/31\t2024/05/31", f"Time\t{moment}\t{moment}\t{moment}"]
        lines += ["Y_Unit_Label\tbar\tbar\tmm", "X_Dimension\tTime\tTime\tTime", "X0\t0.0\t0.0\t0.0"]
        lines += [f"Delta_X\t{1 / RATE}\t{1 / RATE}\t{1 / RATE}", "***End_of_Header***\t\t\t"]
        heads = ["X_Value", "p_A", "X_Value", "p_B", "X_Value", "x"] if columns == "Multi" else ["X_Value", "p_A"]
        heads += [] if columns == "Multi" else ["p_B", "x"]
        lines.append("\t".join([*heads, "Comment"]))
        for i in part:
            time = repr(float(T[i] - T[part[0]])) if columns != "No" else ""
            cells = [repr(float(values[i])) for values in (P_A, P_B, X)]
            row = [cell for value in cells for cell in (time, value)] if columns == "Multi" else [time, *cells]
            lines.append("\t".join(row).replace(".", "," if comma else "."))
    text = "\r\n".join(lines) + "\r\n"
    if comma:
        text = text.replace(f"Delta_X\t{1 / RATE}", f"Delta_X\t{1 / RATE}".replace(".", ","))
    (folder / name).write_text(text, newline="")
    return folder / name


FILES: dict[str, Writer] = {
    "TDMS, waveform": tdms_waveform,
    "TDMS, time column": tdms_time_column,
    "TDMS, two groups": tdms_other_groups,
    "MATLAB 4": lambda folder: vectors(folder, "4"),
    **{
        f"MATLAB {version}, {form.__name__}": lambda folder, form=form, version=version: form(folder, version)
        for version in ("v7", "v7.3")
        for form in (vectors, struct, table, timetable, structure_with_time)
    },
    "MATLAB 5, struct": lambda folder: struct(folder, "5"),
    "MDF 3.30": lambda folder: mdf(folder, "3.30", "log.mdf"),
    "MDF 4.10": lambda folder: mdf(folder, "4.10", "log.mf4"),
    "Excel": xlsx,
    "OpenDocument": ods,
    "LabVIEW, time column": lvm,
    "LabVIEW, decimal comma": lambda folder: lvm(folder, comma=True),
    "LabVIEW, no time": lambda folder: lvm(folder, "No"),
    "LabVIEW, a time each": lambda folder: lvm(folder, "Multi"),
    "LabVIEW, packets": lambda folder: lvm(folder, packets=4),
    "LabVIEW, packets without time": lambda folder: lvm(folder, "No", packets=4),
}
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


def test_the_group_that_holds_most_channels_is_read(tmp_path: Path) -> None:
    recording = read(tdms_other_groups(tmp_path))
    assert "channels of group Fast read, not those of the same name of Statistics" in recording.history
    other = read(tmp_path / "log.tdms", channel_map={"p_A": "Statistics/p_A", "p_B": "oil[bar]"})
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
    path = tmp_path / f"log.csv.{ending}"
    if ending == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("folder/log.csv", text)
    elif ending == "zst":
        import pyarrow

        with pyarrow.CompressedOutputStream(str(path), "zstd") as file:
            file.write(text)
    else:
        path.write_bytes({"gz": gzip, "bz2": bz2, "xz": lzma}[ending].compress(text))
    recording = read(path)
    agrees(recording)
    assert recording.provenance["file"] == path.name
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(UnreadableFile, match=r"archive must be whole.*log\.csv"):
        read(path)


def test_an_archive_of_two_files_names_them(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "logs.zip", "w") as archive:
        archive.writestr("a.csv", "t,p_A\n")
        archive.writestr("b.csv", "t,p_A\n")
    with pytest.raises(UnreadableFile, match=r"must hold a single file, got 2: a\.csv, b\.csv"):
        read(tmp_path / "logs.zip")


def test_what_an_archive_unpacks_to_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sealscope.recordings.archives.LARGEST", 1_000_000)
    (tmp_path / "bomb.csv.gz").write_bytes(gzip.compress(b"0" * 20_000_000))
    with pytest.raises(UnreadableFile, match="must unpack to at most 1000000 bytes"):
        read(tmp_path / "bomb.csv.gz")


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
    with pytest.raises(UnreadableFile, match=r"u must have its samples in the file itself"):
        read(path)


def test_what_a_file_says_of_its_recording(tmp_path: Path) -> None:
    from nptdms import ChannelObject, RootObject, TdmsWriter

    with TdmsWriter(tmp_path / "log.tdms") as writer:
        root = RootObject({"Operator": "N. N.", "Oil temperature": 41.5})
        writer.write_segment([root, ChannelObject("Log", "p_A", P_A, {"unit_string": "bar", "wf_increment": 1 / RATE})])
    assert read(tmp_path / "log.tdms").provenance["about"]["Oil temperature"] == "41.5"
    assert read(lvm(tmp_path)).provenance["about"] == {"operator": "N. N."}
    assert read(xlsx(tmp_path)).provenance.get("about") is None
