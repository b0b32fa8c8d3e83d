"""Logs in the dialects of test benches: written by the libraries of the formats, or by hand from their descriptions."""

from __future__ import annotations

import bz2
import datetime as dt
import gzip
import lzma
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from sealscope.recordings import Recording

RATE = 500.0
N = 200
T = np.arange(N) / RATE
P_A = 20.0 + np.sin(7.0 * T)  # bar
P_B = 18.0 - np.sin(7.0 * T)
X = 12.5 * np.sin(3.0 * T)  # mm
SIGNALS = (("p_A", P_A, "bar"), ("p_B", P_B, "bar"), ("x", X, "mm"))
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


def timeseries(name: str, values: Any, uniform: bool, unit: str = "bar") -> Any:
    """Return an object with the properties that MATLAB's timeseries stores."""
    from matio.utils.matclass import MatlabOpaque

    info = {"Units": "seconds", "Start": 0.0, "Increment": 1 / RATE, "Length": float(N)}
    properties = {"Name": name, "Data_": values[:, None], "TimeInfo": info, "DataInfo": {"Units": unit}}
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


def tdms_rate(folder: Path) -> Path:
    """Write channels without a clock, and the rate as a property of their group."""
    from nptdms import ChannelObject, GroupObject, TdmsWriter

    with TdmsWriter(folder / "log.tdms") as writer:
        channels = [ChannelObject("Log", name, values, {"unit_string": unit}) for name, values, unit in SIGNALS]
        writer.write_segment([GroupObject("Log", {"SamplingRate": RATE}), *channels])
    return folder / "log.tdms"


def tdms_group_each(folder: Path) -> Path:
    return tdms(folder, {name: {"Time": (T, "s"), "Data": (values, unit)} for name, values, unit in SIGNALS})


def structs(fields: tuple[str, ...], rows: list[tuple[Any, ...]]) -> Any:
    """Return an array of structs."""
    members = np.zeros(len(rows), dtype=[(field, object) for field in fields])
    for place, row in enumerate(rows):
        members[place] = row
    return members


def matlab_logs(folder: Path, version: str) -> Path:
    """Write what Simulink logs: a data set of signals, each a time series."""
    from matio.utils.matclass import MatlabOpaque

    members = np.empty((3, 1), dtype=object)
    for place, (name, values, unit) in enumerate(SIGNALS):
        held = {"Name": name, "BlockPath": f"rig/{name}", "Values": timeseries(name, values, False, unit)}
        members[place, 0] = MatlabOpaque(held, "Simulink.SimulationData.Signal")
    logs = MatlabOpaque({"Name": "logsout", "Storage": members}, "Simulink.SimulationData.Dataset")
    return matlab(folder, {"logsout": logs}, version)


MATRIX = np.column_stack([T, P_A, P_B, X])
LABELS = np.array(["t [s]", "p_A [bar]", "p_B [bar]", "x [mm]"], dtype=object)
#: How engineers keep signals in a MATLAB file.
STRUCTS: dict[str, dict[str, Any]] = {
    "value, unit and time": {name: {"value": values, "unit": unit, "time": T} for name, values, unit in SIGNALS},
    "array of signals": {
        "time": T,
        "log": structs(("Name", "Data", "Unit"), [(name, values, unit) for name, values, unit in SIGNALS]),
    },
    "matrix with heads": {"log": {"data": MATRIX, "colheaders": LABELS}},
    "matrix and names": {"data": MATRIX, "names": LABELS},
    "units in a struct": {
        "tout": T,
        "units": {name: unit for name, _, unit in SIGNALS},
        **{name: values for name, values, _ in SIGNALS},
    },
    "interval": {"Ts": 1 / RATE, **{name: {"value": values, "unit": unit} for name, values, unit in SIGNALS}},
    "catman": {
        key: value
        for number, (name, values, unit) in enumerate(SIGNALS, start=1)
        for key, value in (
            (f"Channel_{number}_Header", {"SignalName": name, "Unit": unit, "dt": 1 / RATE}),
            (f"Channel_{number}_Data", values[:, None]),
        )
    },
}


def mdf_other(folder: Path, compression: int = 0, prefix: str = "", text: str = "") -> Path:
    """Write MDF 4: compressed, with names behind a `prefix`, or with a `text` for one value of a channel."""
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        file.append([Signal(values, T, unit=unit, name=prefix + name) for name, values, unit in SIGNALS[:2]])
        conversion = {"lower_0": 9999.0, "upper_0": 9999.0, "text_0": text} if text else None
        position = np.where((np.arange(N) == N // 2) & bool(text), 9999.0, X)
        file.append([Signal(position, T, unit="mm", name=f"{prefix}x", conversion=conversion)])
        file.save(folder / "log.mf4", overwrite=True, compression=compression)
    return folder / "log.mf4"


def sheets(folder: Path, heads: list[list[Any]], times: Any = None, hidden: bool = False) -> Path:
    """Write a workbook with these rows above the samples; `hidden`: and a longer sheet that is not shown."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    if hidden:
        other = book.create_sheet("Old")
        other.sheet_state = "hidden"
        for row in [["t [s]", "p_A [bar]", "p_B [bar]", "x [mm]"], *[[k, 0.0, 0.0, 0.0] for k in range(2 * N)]]:
            other.append(row)
    for row in heads:
        book.active.append(row)
    for time, *values in zip(
        T.tolist() if times is None else times, P_A.tolist(), P_B.tolist(), X.tolist(), strict=True
    ):
        book.active.append([time, *values])
    book.save(folder / "log.xlsx")
    return folder / "log.xlsx"


def frame(folder: Path, index: str, ending: str = "parquet") -> Path:
    """Write a data frame of pandas whose index is the time."""
    import pandas as pd

    columns = pd.DataFrame({f"{name} [{unit}]": values for name, values, unit in SIGNALS})
    times = pd.to_timedelta((T * 1e9).round().astype("int64"), unit="ns")
    if ending == "feather":
        columns.assign(**{"t [s]": T}).to_feather(folder / "log.feather")
    else:
        named = pd.Timestamp("2024-05-31T12:00") + times if index == "moments" else times
        columns.set_index(pd.Index(named, name="time" if index == "named" else None)).to_parquet(folder / "log.parquet")
    return folder / f"log.{ending}"


def hdf5_group_each(folder: Path) -> Path:
    import h5py

    with h5py.File(folder / "log.h5", "w") as file:
        for name, values, unit in SIGNALS:
            group = file.create_group(name)
            group.create_dataset("time", data=T).attrs["unit"] = "s"
            group.create_dataset("data", data=values).attrs["unit"] = unit
    return folder / "log.h5"


def hdf5_table(folder: Path) -> Path:
    import h5py

    held = np.rec.fromarrays(list(MATRIX.T), names=["t [s]", "p_A [bar]", "p_B [bar]", "x [mm]"])
    with h5py.File(folder / "log.h5", "w") as file:
        file["log"] = np.asarray(held)
    return folder / "log.h5"


def lvm_spaced(folder: Path) -> Path:
    """Write a LabVIEW measurement in which each channel has a time, and the header leaves a cell for it."""
    path = lvm(folder, "Multi")
    spaced = ("Samples", "Date\t2024/05/31\t", "Time\t12:00:00.2500000", "Y_Unit", "X_Dim", "X0", "Delta_X")
    lines = [
        "\t\t".join(line.split("\t")).replace("\t\t", "\t", 1) if line.startswith(spaced) else line
        for line in path.read_text().splitlines()
    ]
    path.write_text("\r\n".join(lines) + "\r\n", newline="")
    return path


class Dialect(NamedTuple):
    """How a log is written, what is said of it when it is read, and the last digit of its samples [bar, bar, mm]."""

    write: Writer
    options: Mapping[str, Any] = {}
    digit: float = 0.0


def rows(times: list[str], join: str = ",", comma: bool = False) -> str:
    """Return the samples as lines of text, six digits behind the point."""
    lines = [
        join.join([time, *(f"{value:.6f}" for value in values)])
        for time, *values in zip(times, P_A, P_B, X, strict=True)
    ]
    return "\n".join(lines).replace(".", "," if comma else ".") + "\n"


def log(
    head: str,
    times: list[str] | None = None,
    *,
    encoding: str = "utf-8",
    change: Callable[[str], str] = str,
    **form: Any,
) -> Writer:
    """Return what writes a text with this head above the samples; `change`: what is done to the whole text."""
    body = rows([f"{t:.3f}" for t in T] if times is None else times, **form)

    def write(folder: Path) -> Path:
        (folder / "log.csv").write_bytes(change(head + body).encode(encoding))
        return folder / "log.csv"

    return write


def unreadable(word: str) -> Writer:
    """Return what writes a log in which one sample is a word."""

    def write(folder: Path) -> Path:
        path = log("t [s],p_A [bar],p_B [bar],x [mm]\n")(folder)
        lines = path.read_text().splitlines()
        lines[100] = lines[100].rpartition(",")[0] + f",{word}"
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


def pack(content: bytes, folder: Path, ending: str) -> Path:
    """Write a log's bytes inside an archive and return its path."""
    path = folder / f"log.csv.{ending}"
    if ending == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("folder/log.csv", content)
    elif ending == "zst":
        import pyarrow

        with pyarrow.CompressedOutputStream(str(path), "zstd") as file:
            file.write(content)
    else:
        path.write_bytes({"gz": gzip, "bz2": bz2, "xz": lzma}[ending].compress(content))
    return path


def among_documents(folder: Path) -> Path:
    """Write a log beside a report in an archive in an archive."""
    import tarfile

    content = log("t [s],p_A [bar],p_B [bar],x [mm]\n")(folder)
    (folder / "report.pdf").write_bytes(b"%PDF-1.4")
    with tarfile.open(folder / "log.tar.gz", "w:gz") as archive:
        archive.add(content, "run/log.csv")
        archive.add(folder / "report.pdf", "run/report.pdf")
    return folder / "log.tar.gz"


def parquet(folder: Path) -> Path:
    import pandas as pd

    frame = pd.DataFrame({"t [s]": T, "p_A [bar]": P_A, "p_B [bar]": P_B, "x [mm]": X})
    frame.to_parquet(folder / "log.parquet")
    return folder / "log.parquet"


def hdf5(folder: Path) -> Path:
    import h5py

    with h5py.File(folder / "log.h5", "w") as file:
        for name, values, unit in (("t", T, "s"), ("p_A", P_A, "bar"), ("p_B", P_B, "bar"), ("x", X, "mm")):
            file.create_dataset(name, data=values).attrs["units"] = unit
    return folder / "log.h5"


def with_lines(*more: str, at: int = N // 2) -> Callable[[str], str]:
    """Return what puts lines among the samples."""
    return lambda text: "\n".join([*(lines := text.splitlines())[:at], *more, *lines[at:]]) + "\n"


def quoted(text: str) -> str:
    """Return a text with quotation marks around every cell, and decimal commas in them."""
    return "\n".join(",".join(f'"{cell.replace(".", ",")}"' for cell in line.split(",")) for line in text.splitlines())


def thousands(sign: str, decimal: str, join: str) -> Writer:
    """Return what writes pressures in Pa with a sign between their thousands."""
    signs = str.maketrans({",": sign, ".": decimal})

    def write(folder: Path) -> Path:
        columns = (T, P_A * 1e5, P_B * 1e5, X)
        lines = [join.join(f"{value:,.6f}".translate(signs) for value in row) for row in zip(*columns, strict=True)]
        (folder / "log.csv").write_text(join.join(("t [s]", "p_A [Pa]", "p_B [Pa]", "x [mm]\n")) + "\n".join(lines))
        return folder / "log.csv"

    return write


def in_unit(pressure: str, factor: float, length: str, metre: float, offset: float = 0.0) -> Writer:
    """Return what writes samples in other units; `factor`, `metre`: what they are in Pa and m."""
    columns = zip(T, (P_A * 1e5 + offset) / factor, (P_B * 1e5 + offset) / factor, X * 1e-3 / metre, strict=True)
    text = f"t [s],p_A [{pressure}],p_B [{pressure}],x [{length}]\n"
    text += "\n".join(",".join(f"{value:.12g}" for value in row) for row in columns)

    def write(folder: Path) -> Path:
        (folder / "log.csv").write_text(text.replace('["]', '[""]') if '"' in length else text)
        return folder / "log.csv"

    return write


def moments(*start: int, fall: float = 0.0) -> list[dt.datetime]:
    """Return the local time of each sample; from the next full hour on the clocks are put back by `fall` [h]."""
    begin = dt.datetime(*start)
    hour = begin.replace(minute=0, second=0, microsecond=0) + dt.timedelta(hours=1)
    times = [begin + dt.timedelta(seconds=float(t)) for t in T]
    return [time - dt.timedelta(hours=fall) * (time >= hour) for time in times]


def no_time(text: str) -> str:
    """Return a text of samples without its first column; the lines above them stay."""
    return "\n".join(line.split(",", 1)[-1] if line.count(",") == 3 else line for line in text.splitlines())


MOMENTS = moments(2024, 5, 31, 23, 59, 59, 900000)
MILLI = [(m, m.microsecond // 1000) for m in MOMENTS]
HEADS = "p_A [bar],p_B [bar],x [mm]\n"
TEXTS: dict[str, Dialect] = {
    "text, comma": Dialect(log("t [s]," + HEADS)),
    "text, semicolon and decimal comma": Dialect(log("t [s];p_A [bar];p_B [bar];x [mm]\n", join=";", comma=True)),
    "text, tab": Dialect(log("t [s]\tp_A [bar]\tp_B [bar]\tx [mm]\n", join="\t")),
    "text, blanks": Dialect(log("t [s]   p_A [bar]   p_B [bar]   x [mm]\n", join="   ")),
    "text, units in a row of their own": Dialect(log("Time,p_A,p_B,x\ns,bar,bar,mm\n")),
    "text, preamble": Dialect(log("Operator: N. N.\nOil: 41 degC\n\nt [s]," + HEADS)),
    "text, commented head": Dialect(log("# t [s],p_A [bar],p_B [bar],x [mm]\n")),
    "text, ms": Dialect(log("t [ms]," + HEADS, [f"{1e3 * t:.0f}" for t in T])),
    "text, UTF-16": Dialect(log("t [s]," + HEADS, encoding="utf-16")),
    "text, byte order mark": Dialect(log("t [s]," + HEADS, encoding="utf-8-sig")),
    "text, Latin-1": Dialect(log("Prüfstand: 3 µ\n\nt [s]," + HEADS, encoding="latin-1")),
    "text, date and time over midnight": Dialect(
        log("Datum,Zeit," + HEADS, [f"{m:%d.%m.%Y},{m:%H:%M:%S.%f}" for m in MOMENTS])
    ),
    "text, American date": Dialect(
        log("Time," + HEADS, [f"{m:%m/%d/%Y %I:%M:%S}.{m.microsecond // 1000:03d} {m:%p}" for m in MOMENTS])
    ),
    "text, ISO 8601": Dialect(log("Time," + HEADS, [f"{m:%Y-%m-%dT%H:%M:%S.%f}Z" for m in MOMENTS])),
    "text, seconds since 1970": Dialect(log("t [s]," + HEADS, [f"{1717199999.9 + t:.3f}" for t in T])),
    "text, OVERLOAD in a cell": Dialect(unreadable("OVERLOAD")),
    "text, #N/A in a cell": Dialect(unreadable("#N/A")),
    "text, an empty cell": Dialect(unreadable("")),
    "text, German names": Dialect(log("Zeit [s],Druck A [bar],Druck B [bar],Weg [mm]\n"), {"map": "auto"}),
    "text, units as suffixes": Dialect(log("time_s,PA_bar,PB_bar,Weg_mm\n"), {"map": "auto"}),
    "text, English names": Dialect(log("Time (s),Cyl_P_Cap (bar),Cyl_P_Rod (bar),Position (mm)\n"), {"map": "auto"}),
    "text, mapped names": Dialect(
        log("Zeit,Druck1,Druck2,Weg1\n"),
        {"map": {"t": "Zeit[s]", "p_A": "Druck1[bar]", "p_B": "Druck2[bar]", "x": "Weg1[mm]"}},
    ),
    "text, names twice": Dialect(log("t [s],P,P,s\n"), {"map": {"p_A": "#2[bar]", "p_B": "#3[bar]", "x": "#4[mm]"}}),
    "text, no head": Dialect(log(""), {"map": {"t": "#1[s]", "p_A": "#2[bar]", "p_B": "#3[bar]", "x": "#4[mm]"}}),
    "text, a rate and no time": Dialect(
        log("no," + HEADS, [str(k) for k in range(N)]),
        {"map": {"p_A": "p_A", "p_B": "p_B", "x": "x"}, "rate": RATE},
    ),
    "text, quoted decimal commas": Dialect(log("t [s],p_A [bar],p_B [bar],x [mm]\n", change=quoted)),
    "text, thousands with points": Dialect(thousands(".", ",", ";")),
    "text, thousands with commas": Dialect(thousands(",", ".", ";")),
    "text, thousands with narrow blanks": Dialect(thousands("\u202f", ",", "\t")),
    "text, thousands with strokes": Dialect(thousands("'", ".", ";")),
    "text, heading repeated": Dialect(
        log("Time,p_A,p_B,x\ns,bar,bar,mm\n", change=with_lines("Time,p_A,p_B,x", "s,bar,bar,mm"))
    ),
    "text, marks among the samples": Dialect(log("t [s]," + HEADS, change=with_lines("EVENT,valve opened", "# pause"))),
    "text, a summary at the end": Dialect(log("t [s]," + HEADS, change=with_lines("Min,1,2,3", "", "End", at=N + 1))),
    "text, a row of types": Dialect(log("Time,p_A,p_B,x\ns,bar,bar,mm\nREAL,REAL,REAL,REAL\n")),
    "text, units above names": Dialect(log("s,bar,bar,mm\nt,p_A,p_B,x\n")),
    "text, groups above names": Dialect(log(",Pressure,,Position\nTime,A,B,Cyl\ns,bar,bar,mm\n"), {"map": "auto"}),
    "text, rows that say what they hold": Dialect(
        log(
            '"Model","DL"\n"TraceName","p_A","p_B","x"\n"VUnit","bar","bar","mm"\n"SampleRate",500,500,500\n\n',
            [""] * N,
        )
    ),
    "text, index and columns of pandas": Dialect(log("signal,p_A,p_B,x\nunit,bar,bar,mm\nt [s],,,\n")),
    "text, quoted units": Dialect(log("Zeit\tp_A\tp_B\tx\n's'\t'bar'\t'bar'\t'mm'\n", join="\t", comma=True)),
    "text, unit behind a stroke": Dialect(log("Time,p_A/bar,p_B/bar,x/mm\n")),
    "text, ruled table": Dialect(log("t [s] | p_A [bar] | p_B [bar] | x [mm]\n---|---|---|---\n", join=" | ")),
    "text, last sample first": Dialect(
        log("t [s]," + HEADS, change=lambda text: "\n".join([(lines := text.splitlines())[0], *lines[:0:-1]]))
    ),
    "text, rate above": Dialect(log("Sample rate: 500 Hz\n\nt," + HEADS, change=no_time)),
    "text, interval above": Dialect(log("Abtastintervall [ms]: 2\n\nt," + HEADS, change=no_time)),
    "text, shared stamps and a rate above": Dialect(
        log("Sampling frequency,500\nTime," + HEADS, ["31.05.2024 12:00"] * N)
    ),
    "text, UTF-16 without a mark": Dialect(log("t [s]," + HEADS, encoding="utf-16-le")),
    "text, old Mac": Dialect(log("t [s]," + HEADS, change=lambda text: text.replace("\n", "\r"))),
    "text, absolute pressures": Dialect(in_unit("bar abs", 1e5, "cm", 1e-2, 101325.0)),
    "text, MPa(a) and inches": Dialect(in_unit("MPa(a)", 1e6, "inch", 0.0254, 101325.0)),
    "text, gauge pressures in capitals": Dialect(in_unit("KPA", 1e3, "MM", 1e-3)),
    "text, kp and mil": Dialect(in_unit("kp/cm2", 98066.5, "mil", 2.54e-5)),
    "text, barü and Zoll": Dialect(in_unit("barü", 1e5, "Zoll", 0.0254)),
    "text, psig": Dialect(in_unit("psi gauge", 6894.757293168361, "in", 0.0254)),
    "text, clock over midnight": Dialect(log("Time," + HEADS, [f"{m:%H:%M:%S}.{ms:03d}" for m, ms in MILLI])),
    "text, four colons": Dialect(log("Uhrzeit," + HEADS, [f"{m:%H:%M:%S}:{ms:03d}" for m, ms in MILLI])),
    "text, minutes and seconds": Dialect(log("Time," + HEADS, [f"{m:%M:%S}.{ms:03d}" for m, ms in MILLI])),
    "text, clock with a comma": Dialect(
        log("Zeit;p_A [bar];p_B [bar];x [mm]\n", [f"{m:%H:%M:%S},{ms:03d}" for m, ms in MILLI], join=";", comma=True)
    ),
    "text, year of two digits": Dialect(
        log("Datum,Uhrzeit," + HEADS, [f"{m:%d.%m.%y,%H:%M:%S}.{ms:03d}" for m, ms in MILLI])
    ),
    "text, American year of two digits": Dialect(
        log("Time," + HEADS, [f"{m:%m/%d/%y %I:%M:%S}.{ms:03d} {m:%p}" for m, ms in MILLI])
    ),
    "text, named month": Dialect(log("Zeitstempel," + HEADS, [f"{m:%d-%b-%Y %H:%M:%S}.{ms:03d}" for m, ms in MILLI])),
    "text, lengths of time": Dialect(log("Time," + HEADS, [f"0 days 00:00:{t:09.6f}" for t in T])),
    "text, basic ISO 8601": Dialect(log("Time," + HEADS, [f"{m:%Y%m%dT%H%M%S}.{ms:03d}" for m, ms in MILLI])),
    "text, Chinese date": Dialect(
        log("时间," + HEADS, [f"{m:%Y}年{m:%m}月{m:%d}日 {m:%H:%M:%S}.{ms:03d}" for m, ms in MILLI])
    ),
    "text, clocks put back": Dialect(
        log("Time," + HEADS, [f"{m:%Y-%m-%d %H:%M:%S.%f}" for m in moments(2024, 10, 27, 2, 59, 59, 800000, fall=1.0)])
    ),
    "text, clocks put forward": Dialect(
        log("Time," + HEADS, [f"{m:%Y-%m-%d %H:%M:%S.%f}" for m in moments(2024, 3, 31, 1, 59, 59, 800000, fall=-1.0)])
    ),
    "text, days since 1899": Dialect(log("Date/Time," + HEADS, [repr(45443.99 + t / 86400) for t in T.tolist()])),
    "text, GB 18030": Dialect(
        log("时间(s),无杆腔压力(bar),有杆腔压力(bar),位移（mm）\n", encoding="gb18030"),
        {"map": "auto"},
    ),
    "text, Shift JIS": Dialect(
        log("時間[s],ヘッド側圧力[bar],ロッド側圧力[bar],変位[mm]\n", encoding="shift_jis"),
        {"map": "auto"},
    ),
    **{
        f"text, {language}": Dialect(log(head + "\n"), {"map": "auto"})
        for language, head in {
            "French": "Temps écoulé (s),Pression côté fond (bar),Pression côté tige (bar),Course (mm)",
            "Italian": "Tempo [s],Pressione lato fondello [bar],Pressione lato stelo [bar],Corsa [mm]",
            "Spanish": "Tiempo (s),Presión émbolo (bar),Presión vástago (bar),Carrera (mm)",
            "Portuguese": "Tempo (s),Pressão A (bar),Pressão B (bar),Posição (mm)",
            "Dutch": "Tijd (s),Druk A (bar),Druk B (bar),Positie (mm)",
            "Polish": "Czas [s],Ciśnienie A [bar],Ciśnienie B [bar],Położenie [mm]",
            "German compounds": "Messzeit in s,Zylinderdruck_A in bar,Zylinderdruck_B in bar,Zylinderweg in mm",
            "Czech": "Čas [s],Tlak A [bar],Tlak B [bar],Poloha [mm]",
            "Swedish": "Tid (s),Tryck A (bar),Tryck B (bar),Läge (mm)",
            "Russian": "Время (с),Давление A (бар),Давление B (бар),Положение (мм)",
            "Korean": "시간(s),A실압력(bar),B실압력(bar),변위(mm)",
            "cap and head": "Time (s),Cap Pressure (bar),Head Pressure (bar),Stroke (mm)",
            "head and rod": "Time (s),Head End Pressure (bar),Rod End Pressure (bar),Stroke (mm)",
            "extend and retract": "Time (s),Extend Pressure (bar),Retract Pressure (bar),LVDT (mm)",
            "ports": "Time (s),Port A Pressure (bar),Port B Pressure (bar),Displacement (mm)",
        }.items()
    },
}
DIALECTS: dict[str, Dialect] = {
    **{name: Dialect(write) for name, write in FILES.items()},
    "TDMS, rate of the group": Dialect(tdms_rate),
    "TDMS, a group each": Dialect(tdms_group_each),
    **{
        f"MATLAB {version}, Simulink's data set": Dialect(lambda folder, version=version: matlab_logs(folder, version))
        for version in ("v7", "v7.3")
    },
    **{
        f"MATLAB 5, {form}": Dialect(lambda folder, held=held: matlab(folder, held, "5"))
        for form, held in STRUCTS.items()
    },
    "MDF 4.10, compressed": Dialect(lambda folder: mdf_other(folder, compression=2)),
    "MDF 4.10, names with points": Dialect(lambda folder: mdf_other(folder, prefix="Rig.Cyl.")),
    "MDF 4.10, text in a cell": Dialect(lambda folder: mdf_other(folder, text="SNA")),
    "Excel, hidden sheet": Dialect(
        lambda folder: sheets(folder, [["t [s]", "p_A [bar]", "p_B [bar]", "x [mm]"]], hidden=True)
    ),
    "Excel, merged heads": Dialect(
        lambda folder: sheets(folder, [["Zeit", "Druck", None, "Weg"], [None, "A", "B"], ["s", "bar", "bar", "mm"]]),
        {"map": "auto"},
    ),
    "Excel, times of the day": Dialect(
        lambda folder: sheets(
            folder,
            [["Uhrzeit", "p_A [bar]", "p_B [bar]", "x [mm]"]],
            [m.time() for m in moments(2024, 5, 31, 23, 59, 59, 9)],
        )
    ),
    "Parquet, index of moments": Dialect(lambda folder: frame(folder, "moments")),
    "Parquet, index of times": Dialect(lambda folder: frame(folder, "")),
    "Parquet, named index": Dialect(lambda folder: frame(folder, "named")),
    "Feather": Dialect(lambda folder: frame(folder, "", "feather")),
    "HDF5, a group each": Dialect(hdf5_group_each),
    "HDF5, table": Dialect(hdf5_table),
    "LabVIEW, a time each, spaced": Dialect(lvm_spaced),
    "archive, tar.gz with a report": Dialect(among_documents, digit=1e-6),
    "Parquet": Dialect(parquet),
    "HDF5": Dialect(hdf5),
    **{name: own._replace(digit=1e-6) for name, own in TEXTS.items()},
}


def deviations(recording: Recording) -> dict[str, float]:
    """Return the largest deviation of each channel from what was written [bar, bar, mm], but missing samples."""
    sources = {"p_A": (P_A, 1e5), "p_B": (P_B, 1e5), "x": (X, 1e-3)}
    return {name: float(np.nanmax(np.abs(recording[name] / unit - values))) for name, (values, unit) in sources.items()}
