"""Reading and writing recordings: a file to read has the format of its content, a file to write that of its suffix."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from sealscope.calls import checked_call
from sealscope.errors import InputError, MissingExtra, UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS
from sealscope.recordings.formats.columns import check_call, choose_columns
from sealscope.recordings.formats.table import Choose, RawTable
from sealscope.recordings.recording import Recording
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import open_regular

Reader = Callable[[Path, Choose], RawTable]
Writer = Callable[..., None]
_log = logging.getLogger(__name__)
#: Suffix -> format.
SUFFIXES: Mapping[str, str] = {
    ".nc": "netcdf",
    ".nc4": "netcdf",
    ".h5": "netcdf",
    ".hdf5": "netcdf",
    ".csv": "text",
    ".tsv": "text",
    ".txt": "text",
    ".parquet": "parquet",
    ".pq": "parquet",
}
#: First bytes of formats that are known and not read.
_FOREIGN = {
    b"CDF\x01": "a NetCDF-3 file: convert it to NetCDF-4",
    b"CDF\x02": "a NetCDF-3 file: convert it to NetCDF-4",
    b"CDF\x05": "a NetCDF-3 file: convert it to NetCDF-4",
    b"MATLAB 5.0": "a MATLAB file: save it as -v7.3 or CSV",
    b"TDSm": "a TDMS file: export it as CSV",
    b"MDF     ": "an MDF file: export it as CSV",
    b"PK\x03\x04": "a ZIP archive or an Excel workbook: export it as CSV",
    b"\x1f\x8b": "a gzip archive: unpack it",
    b"%PDF": "a PDF document",
}
_NAMES = {"netcdf": "NetCDF or HDF5", "parquet": "Parquet", "text": "text"}
_HDF5 = b"\x89HDF\r\n\x1a\n"


def _format_of(path: Path) -> str:
    """Return the format of a file by its content; raise UnreadableFile where it is none that is read."""
    place = str(path)
    try:
        with open_regular(path, "a recording") as file:
            head = file.read(16)
            if head.startswith(_HDF5):
                return "netcdf"
            if head.startswith(b"PAR1"):
                return "parquet"
            for magic, name in _FOREIGN.items():
                if head.startswith(magic):
                    raise UnreadableFile(f"a recording must be text, NetCDF, HDF5 or Parquet, got {name} ({place})")
            for offset in (512, 1024, 2048, 4096):  # HDF5 may begin after a block of the user's, as MATLAB's does
                file.seek(offset)
                if file.read(8) == _HDF5:
                    return "netcdf"
    except UnreadableFile:
        raise
    except InputError as error:
        raise UnreadableFile(str(error)) from None
    except FileNotFoundError:
        raise UnreadableFile(f"a recording must exist, got no such file ({place})") from None
    except (OSError, ValueError) as error:
        raise UnreadableFile(
            f"a recording must be readable, got: {getattr(error, 'strerror', None) or error} ({place})"
        ) from error
    return "text"


def _functions(kind: str) -> tuple[Reader, Writer]:
    """Return what reads and what writes a format; its library is loaded now."""
    if kind == "netcdf":
        from sealscope.recordings.formats.netcdf import read_netcdf, write_netcdf

        return read_netcdf, write_netcdf
    if kind == "parquet":
        from sealscope.recordings.formats.parquet import read_parquet, write_parquet

        return read_parquet, write_parquet
    from sealscope.recordings.formats.text import read_text, write_text

    return read_text, write_text


@checked_call
def read(
    path: str | os.PathLike[str],
    *,
    channel_map: Mapping[str, str] | None = None,
    rate: float | None = None,
    format: str | None = None,
) -> Recording:
    r"""Read the recording in a file: the text of any logger, NetCDF-4, HDF5 or Parquet.

    Parameters
    ----------
    path : str or path
        The file. Its content tells the format.
    channel_map : mapping of str to str, optional
        Channel (or ``t``) -> name of the file's column, or name and unit, as in ``{"p_A": "PG_1[psi]"}``. A column
        without any unit is raw counts.
    rate : float, optional
        Sampling rate [Hz], in place of a time column.
    format : {"text", "netcdf", "parquet"}, optional
        What the content must be.

    Returns
    -------
    Recording
        In SI units.

    Raises
    ------
    UnreadableFile
        If the file cannot be read as a recording; the message names the file, the place and the rule.
    InputError
        If `channel_map`, `rate` or `format` is wrong.
    MissingExtra
        If the file is a Parquet table and pyarrow is not installed.

    Examples
    --------
    >>> import sealscope as ss
    >>> from pathlib import Path
    >>> _ = Path("log.csv").write_text("t [s],p_A [bar],PG_2\n0,3,300\n0.002,3.5,310\n0.004,3,305\n")
    >>> recording = ss.read("log.csv", channel_map={"p_B": "PG_2[kPa]"})
    >>> recording
    Recording(p_A [Pa], p_B [Pa]; 3 samples, 500 Hz, 0.006 s)
    >>> recording["p_A"].tolist()
    [300000.0, 350000.0, 300000.0]
    """
    file, channel_map = Path(path), channel_map or {}
    check_call(channel_map, rate)
    if format is not None and format not in SUFFIXES.values():
        raise InputError(f"format must be one of {', '.join(sorted(set(SUFFIXES.values())))}, got {format}")
    kind = _format_of(file)
    if format not in (None, kind):
        raise UnreadableFile(f"a file read as {format} must be {format}, got {kind} ({file})")
    choose = partial(choose_columns, channel_map=channel_map, rate=rate, place=str(file))
    read_table, _ = _functions(kind)
    try:
        table = read_table(file, choose)
        if format is None and SUFFIXES.get(file.suffix.lower(), kind) != kind:
            table = replace(table, notes=(f"name ends in {file.suffix}, content is {table.kind}", *table.notes))
        return Recording(*table.samples({"file": file.name}, rate=rate, infer_rate=bool(channel_map)))
    except (MissingExtra, UnreadableFile):
        raise
    except InputError as error:
        raise UnreadableFile(str(error) if str(file) in str(error) else f"{error} ({file})") from None
    except MemoryError as error:
        raise UnreadableFile(f"a recording must be readable, got: too little memory ({file})") from error
    except Exception as error:  # format libraries raise whatever a damaged file makes them
        _log.debug("cannot read %s", file, exc_info=True)
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise UnreadableFile(f"a {_NAMES[kind]} file must be whole, got: {text} ({file})") from error


def check_target(path: str | os.PathLike[str]) -> str:
    """Return the format of a file to write by its suffix.

    Raises InputError for another suffix or a folder that does not exist. Long work calls this first, so that it does
    not fail at its end.
    """
    file = Path(path)
    kind = SUFFIXES.get(file.suffix.lower())
    if kind is None:
        raise InputError(f"a recording's file must end in {', '.join(SUFFIXES)}, got {file.name}")
    if not file.parent.is_dir():
        raise InputError(f"the folder of a file to write must exist, got {file.parent} ({file})")
    return kind


@checked_call
def write(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording; it reads back as the same recording, to the bit.

    Parameters
    ----------
    recording : Recording
        At least one sample of one channel, in SI units or raw counts.
    path : str or path
        The file to write, whole or not at all. Its suffix tells the format: .nc .nc4 .h5 .hdf5 .csv .tsv .txt .parquet
        .pq.

    Raises
    ------
    InputError
        If the suffix is another, the folder does not exist or cannot be written, or the recording could not be read
        back as it is.
    MissingExtra
        If the format is Parquet and pyarrow is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> import sealscope as ss
    >>> t = np.arange(1000) / 500
    >>> recording = ss.Recording(t, {"p_A": 3e5 + np.sin(t)}, {"p_A": "Pa"}, rate=500.0)
    >>> ss.write(recording, "log.csv")
    >>> bool(np.array_equal(ss.read("log.csv")["p_A"], recording["p_A"]))
    True
    """
    file = Path(path)
    kind = check_target(file)
    if len(recording) == 0 or not recording.channels:
        raise InputError("a recording to write must hold at least one sample of one channel")
    for name, unit in recording.units.items():
        if name not in CHANNEL_UNITS:
            raise InputError(f"a channel to write must be one of {', '.join(CHANNEL_UNITS)}, got {name}")
        if unit not in (CHANNEL_UNITS[name], COUNTS):
            raise InputError(f"channel {name} must be in {CHANNEL_UNITS[name]} or {COUNTS} to be written, got {unit}")
    _, write_table = _functions(kind)
    delimiter = {"delimiter": "," if file.suffix.lower() == ".csv" else "\t"} if kind == "text" else {}
    values, units, description = recording.series()
    with atomic_write(file) as temporary:
        write_table(temporary, values, units, description, **delimiter)
