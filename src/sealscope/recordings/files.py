"""Reading and writing a recording: a file read tells its format by its content, a file to write by its suffix."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from math import isfinite
from pathlib import Path

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.atomic import atomic_write
from sealscope.recordings.formats.columns import check_channel
from sealscope.recordings.formats.table import Table, check_writable, recording_of
from sealscope.recordings.recording import Recording

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
_HDF5 = b"\x89HDF\r\n\x1a\n"


def _format_of(path: Path) -> str:
    """The format that the content tells; raises UnreadableFile where it is none that is read."""
    place = str(path)
    try:
        if path.is_dir():
            raise UnreadableFile(f"a recording must be a file, got a folder ({place})")
        with path.open("rb") as file:
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
    except FileNotFoundError:
        raise UnreadableFile(f"a recording must exist, got no such file ({place})") from None
    except (OSError, ValueError) as error:
        raise UnreadableFile(
            f"a recording must be readable, got: {getattr(error, 'strerror', None) or error} ({place})"
        ) from error
    return "text"


def _opener(kind: str) -> Callable[[Path], AbstractContextManager[Table]]:
    if kind == "netcdf":
        from sealscope.recordings.formats.netcdf import open_hdf5

        return open_hdf5
    if kind == "parquet":
        from sealscope.recordings.formats.parquet import open_parquet

        return open_parquet
    from sealscope.recordings.formats.text import open_text

    return open_text


def read(
    path: str | os.PathLike[str],
    *,
    channel_map: Mapping[str, str] | None = None,
    rate: float | None = None,
    format: str | None = None,
) -> Recording:
    """The recording in a file: text of any logger, NetCDF-4, HDF5, or Parquet.

    `channel_map`: channel (or `t`) -> name of the file's column, or name and unit, as in ``{"p_A": "PG_1[psi]"}``; a
    column without any unit is raw counts. `rate` [Hz] wins over a time column. `format` (`text`, `netcdf`, `parquet`)
    is told by the content, and where given must agree with it.

    Raises UnreadableFile, naming the file, where it cannot be read as a recording; InputError for a wrong call.
    """
    file = Path(path)
    for channel in channel_map or {}:
        check_channel(channel)
    if rate is not None and not (isfinite(rate) and rate > 0):
        raise InputError(f"rate must be > 0 Hz, got {rate}")
    if format is not None and format not in SUFFIXES.values():
        raise InputError(f"format must be one of {', '.join(sorted(set(SUFFIXES.values())))}, got {format}")
    kind = _format_of(file)
    if format not in (None, kind):
        raise UnreadableFile(f"a file read as {format} must be {format}, got {kind} ({file})")
    try:
        with _opener(kind)(file) as found:
            table, suffix = found, SUFFIXES.get(file.suffix.lower())
            if suffix not in (None, kind) and format is None:
                table = replace(found, notes=(f"name ends in {file.suffix}, content is {found.kind}", *found.notes))
            return recording_of(table, channel_map or {}, rate)
    except (OSError, MemoryError) as error:
        raise UnreadableFile(
            f"a recording must be readable, got: {str(error) or 'too little memory'} ({file})"
        ) from error


def check_target(path: str | os.PathLike[str]) -> str:
    """The format that a file to write has by its suffix; raises InputError for another suffix or a folder that is not
    there.

    Long work asks this first, so that it does not find out at its end.
    """
    file = Path(path)
    kind = SUFFIXES.get(file.suffix.lower())
    if kind is None:
        raise InputError(f"a recording's file must end in {', '.join(SUFFIXES)}, got {file.name}")
    if not file.parent.is_dir():
        raise InputError(f"the folder of a file to write must exist, got {file.parent} ({file})")
    return kind


def write(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write `recording` in the format that the suffix tells: .nc .nc4 .h5 .hdf5 .csv .tsv .txt .parquet .pq.

    The file appears whole or not at all, and reads back as the same recording, to the bit. Raises InputError.
    """
    file = Path(path)
    kind = check_target(file)
    check_writable(recording)
    with atomic_write(file) as temporary:
        if kind == "netcdf":
            from sealscope.recordings.formats.netcdf import write_netcdf

            write_netcdf(recording, temporary)
        elif kind == "parquet":
            from sealscope.recordings.formats.parquet import write_parquet

            write_parquet(recording, temporary)
        else:
            from sealscope.recordings.formats.text import write_text

            write_text(recording, temporary, "," if file.suffix.lower() == ".csv" else "\t")
