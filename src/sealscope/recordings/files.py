"""Reading and writing recordings: a file to read has the format of its content, a file to write that of its suffix."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from math import isfinite
from pathlib import Path
from typing import Any

from sealscope.calls import checked_call
from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.apart import file_apart
from sealscope.recordings.archives import is_workbook, unpacked
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS
from sealscope.recordings.formats.columns import ChannelMap, Wanted
from sealscope.recordings.formats.matlab import is_matlab_4
from sealscope.recordings.formats.structured.json_log import is_json
from sealscope.recordings.formats.structured.lvm import is_lvm
from sealscope.recordings.formats.table import RecordingFields
from sealscope.recordings.formats.text import read_text_parts
from sealscope.recordings.formats.text_layout import SNIFF, encoding_of
from sealscope.recordings.recording import Recording, recording_of
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import open_regular, whole
from sealscope.storage.unpacking import most_unpacked

#: `formats.toml`: the formats that are read, and what is known by its first bytes or its suffix and not read.
_TABLES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("formats.toml").read_text("utf-8"))
_FORMATS, _PROPRIETARY = _TABLES["read"], _TABLES["proprietary"]
_BEGINS = {kind: re.compile(entry["begins"].encode()) for kind, entry in _FORMATS.items() if "begins" in entry}
_ARCHIVES = {kind: re.compile(begins.encode()) for kind, begins in _TABLES["archives"].items()}
_FOREIGN = {re.compile(begins.encode()): words for begins, words in _TABLES["foreign"].items()}
#: Suffix -> format of any file, and of a file to write.
_SUFFIXES = {suffix: kind for kind, entry in _FORMATS.items() for suffix in entry["suffixes"]}
SUFFIXES = {suffix: kind for suffix, kind in _SUFFIXES.items() if kind in ("netcdf", "text", "parquet")}
#: Formats that are read in the program itself; the others' libraries end it, or fill its memory, on some files.
_TEXTS = ("text", "lvm")
#: Longest time that such a file may take [s], and what is added for its size [bytes/s]; most memory [bytes], and so
#: many times its size.
_LONGEST, _SLOWEST, _SLOWEST_SHEETS = 10.0, 20e6, 5e5
_MEMORY, _MEMORY_SHARE = 2**31, 64
#: Archives within archives that are unpacked.
_DEEPEST_ARCHIVE = 3


def _format_of(path: Path) -> str:
    """Return the format of a file, or kind of archive, by its content; raise UnreadableFile where none is read."""
    try:
        with open_regular(path, "a recording") as file:
            head = file.read(SNIFF)
    except FileNotFoundError:
        raise UnreadableFile(f"a recording must exist, got no such file ({path})") from None
    except InputError as error:
        raise UnreadableFile(str(error)) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UnreadableFile(f"a recording must be readable, got: {reason} ({path})") from error
    if archive := next((kind for kind, begins in _ARCHIVES.items() if begins.match(head)), None):
        return "spreadsheet" if archive == "zip" and is_workbook(path) else archive
    if known := next((kind for kind, begins in _BEGINS.items() if begins.match(head)), None):
        return known
    if any(_BEGINS["netcdf"].match(head, offset) for offset in (512, 1024, 2048, 4096)):  # after a block of the user's
        return "netcdf"
    foreign: str | None = next((words for begins, words in _FOREIGN.items() if begins.match(head)), None)
    if foreign is None and is_matlab_4(head):
        return "matlab"
    if foreign is None and encoding_of(head) is None:
        foreign = _PROPRIETARY.get(path.suffix.lower())
    if foreign is not None:
        raise UnreadableFile(f"a recording must be in a format that is read, got {foreign} ({path})")
    return "lvm" if is_lvm(head) else "json" if is_json(head) else "text"


def _member(kind: str, verb: str) -> Callable[..., Any]:
    """Return ``read_KIND`` or ``write_KIND`` of the format's module; its library is loaded now."""
    module = import_module(f"sealscope.recordings.formats.{_FORMATS[kind]['module']}")
    return getattr(module, f"{verb}_{kind}")  # type: ignore[no-any-return]


def _read_here(file: Path, kind: str, request: Wanted) -> RecordingFields:
    return _member(kind, "read")(file, request)  # type: ignore[no-any-return]


@checked_call
def read(
    path: str | os.PathLike[str],
    *,
    map: ChannelMap | None = None,
    rate: float | None = None,
) -> Recording:
    r"""Read the recording in a file: the text of any logger, or the file of a measurement program.

    Formats: text, NetCDF-4, HDF5, Parquet, TDMS, MATLAB (v4 to v7.3), MDF 3 and 4, LabVIEW's .lvm, JSON (lines,
    records, columns) and spreadsheets (.xlsx, .xlsb, .xls, .ods), each also inside .gz, .bz2, .xz, .zst, .zip or
    .tar. Channels of different rates are brought to the clock of the chamber pressures; the history says how.

    Parameters
    ----------
    path : str or path
        The file. Its content tells the format.
    map : mapping of str to str or "auto", optional
        Channel (or ``t``) -> name of the file's column, or name and unit, as in ``{"p_A": "PG_1[psi]"}``, or number,
        as in ``{"p_A": "#2"}``, or a constant plus columns times factors and the unit, as in
        ``{"p_A": "ch2*0.0625-0.625 bar"}``. A unit at the end of the column's name is read, as in ``p_bottom_bar``; a
        column without any is raw counts. ``"auto"``: what the columns' names and units
        tell, in several languages; the history says what was taken. ``{"*": "auto", ...}``: so for the channels that
        the mapping does not name.
    rate : float, optional
        Sampling rate [Hz], in place of a time column.

    Returns
    -------
    Recording
        In SI units.

    Raises
    ------
    UnreadableFile
        If the file cannot be read as a recording; the message names the file, the place and the rule.
    InputError
        If `map` or `rate` is wrong.
    MissingExtra
        If the library that reads the format is not installed.

    Examples
    --------
    >>> import sealscope as ss
    >>> from pathlib import Path
    >>> _ = Path("log.csv").write_text("t [s],p_A [bar],PG_2\n0,3,300\n0.002,3.5,310\n0.004,3,305\n")
    >>> recording = ss.read("log.csv", map={"p_B": "PG_2[kPa]"})
    >>> recording
    Recording(p_A [Pa], p_B [Pa]; 3 samples, 500 Hz, 0.006 s)
    >>> recording["p_A"].tolist()
    [300000.0, 350000.0, 300000.0]
    """
    file = Path(path)
    request = Wanted(map or {}, rate, file.name)
    with _inner(file) as (inner, kind):
        return _read(inner, kind, request)


@checked_call
def read_parts(
    path: str | os.PathLike[str],
    every: float,
    *,
    map: ChannelMap | None = None,
    rate: float | None = None,
) -> Iterator[Recording]:
    r"""Read a long recording part by part.

    A text log is read in bounded memory, whatever its size; other formats are read whole and cut.

    Parameters
    ----------
    path : str or path
        The file, as for `read`.
    every : float
        Length of a part [s], by the sampling rate of the file's beginning; the last may be shorter. Gaps do not count.
    map : mapping of str to str or "auto", optional
        As for `read`.
    rate : float, optional
        Sampling rate [Hz], in place of a time column.

    Yields
    ------
    Recording
        The next part. Its start is its own where the file has stamps; other times go on from part to part.

    Raises
    ------
    UnreadableFile
        If the file, or the next part of it, cannot be read as a recording.
    InputError
        If `every`, `map` or `rate` is wrong.

    Examples
    --------
    >>> import sealscope as ss
    >>> from pathlib import Path
    >>> rows = "".join(f"{k / 500},{300 + k % 7}\n" for k in range(1000))
    >>> _ = Path("long.csv").write_text("t [s],p_A [kPa]\n" + rows)
    >>> [part.duration for part in ss.read_parts("long.csv", every=0.8)]
    [0.8, 0.8, 0.4]
    """
    file = Path(path)
    request = Wanted(map or {}, rate, file.name)
    if not (isfinite(every) and every > 0):
        raise InputError(f"every must be > 0 s and finite, got {every:g}")
    return _parts(file, every, request)


def _parts(file: Path, every: float, request: Wanted) -> Iterator[Recording]:
    with _inner(file) as (inner, kind):
        if kind != "text":
            whole_file = _read(inner, kind, request)
            size = max(1, round(every * whole_file.rate))
            for first in range(0, len(whole_file), size):
                yield whole_file.samples(slice(first, first + size))
            return
        with whole("a text file", inner):
            for fields in read_text_parts(inner, request, every):
                yield recording_of(fields)


@contextmanager
def _inner(file: Path) -> Iterator[tuple[Path, str]]:
    """Yield the file, or what is packed in it, and its format; what is wrong with either is an UnreadableFile."""
    with ExitStack() as folders:
        inner, kind = file, _format_of(file)
        most = most_unpacked(file) if kind in _ARCHIVES else 0
        try:
            for _ in range(_DEEPEST_ARCHIVE):  # a .tar.gz is an archive in an archive
                if kind in _ARCHIVES:
                    inner = folders.enter_context(unpacked(inner, kind, most))
                    kind = _format_of(inner)
            if kind in _ARCHIVES:
                raise UnreadableFile(f"at most {_DEEPEST_ARCHIVE} archives may lie in each other, got more ({inner})")
            yield inner, kind
        except UnreadableFile as error:
            if inner == file:
                raise
            raise UnreadableFile(str(error).replace(str(inner), f"{inner.name} in {file}")) from error


def _read(file: Path, kind: str, request: Wanted) -> Recording:
    """Read a file that is no archive: by a process of its own where the format is none of text."""
    with whole(f"{_FORMATS[kind]['words']} file", file):
        if kind in _TEXTS:
            fields = _read_here(file, kind, request)
        else:
            size = file.stat().st_size
            limit = _LONGEST + size / (_SLOWEST_SHEETS if kind in ("spreadsheet", "json") else _SLOWEST)
            memory = _MEMORY + _MEMORY_SHARE * size
            fields = file_apart(_read_here, file, kind, request, limit=limit, memory=memory, disk=most_unpacked(file))
        if _SUFFIXES.get(file.suffix.lower(), kind) != kind:
            fields = fields.with_note(f"name ends in {file.suffix}, content is {fields.kind}")
        return recording_of(fields)


def check_target(path: str | os.PathLike[str]) -> str:
    """Return the format of a file to write by its suffix; raise InputError for another."""
    file = Path(path)
    kind = SUFFIXES.get(file.suffix.lower())
    if kind is None:
        raise InputError(f"a recording's file must end in {', '.join(SUFFIXES)}, got {file.name}")
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
    >>> import sealscope as ss
    >>> ss.write(ss.Recording([0.0, 0.002], {"p_A": [3e5, 3.1e5]}, {"p_A": "Pa"}, rate=500.0), "log.csv")
    >>> ss.read("log.csv")["p_A"].tolist()
    [300000.0, 310000.0]
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
    delimiter = {"delimiter": "," if file.suffix.lower() == ".csv" else "\t"} if kind == "text" else {}
    values, units, description = recording.series()
    with atomic_write(file) as temporary:
        _member(kind, "write")(temporary, values, units, description, **delimiter)
