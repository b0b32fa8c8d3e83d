"""Read and write recordings: the content decides the format of a file to read, the suffix that of a file to write."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from math import inf, isfinite
from pathlib import Path
from typing import Any

from sealscope.calls import checked_call
from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS
from sealscope.recordings.formats.columns import ChannelMap, Request, with_group
from sealscope.recordings.formats.structured.archives import is_workbook, unpack
from sealscope.recordings.formats.table import RecordingFields
from sealscope.recordings.formats.text import read_text_parts
from sealscope.recordings.formats.text_layout import SNIFF, detect_encoding
from sealscope.recordings.recording import Recording, make_recording
from sealscope.recordings.subprocesses import run_on_file
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import max_unpacked_size, open_regular, raising_unreadable

#: `formats.toml`: formats that are read, and formats that are recognised by first bytes or suffix but not read.
_TABLES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("formats.toml").read_text("utf-8"))
_FORMATS, _PROPRIETARY = _TABLES["read"], _TABLES["proprietary"]
#: Format, or kind of archive, -> pattern of the first bytes, or of those that its `recognise` function may accept; and
#: pattern -> words for a format that is not read.
_BEGINS = {kind: re.compile(entry["begins"].encode()) for kind, entry in _FORMATS.items() if "begins" in entry}
_POSSIBLE = {kind: re.compile(entry["possible"].encode()) for kind, entry in _FORMATS.items() if "possible" in entry}
_ARCHIVES = {kind: re.compile(begins.encode()) for kind, begins in _TABLES["archives"].items()}
_FOREIGN = {re.compile(begins.encode()): words for begins, words in _TABLES["foreign"].items()}
#: Suffix -> format, of all files that are read.
_SUFFIXES = {suffix: kind for kind, entry in _FORMATS.items() for suffix in entry["suffixes"]}
#: Suffix -> format, of files that can be written.
SUFFIXES = {suffix: kind for suffix, kind in _SUFFIXES.items() if _FORMATS[kind].get("written")}
#: Formats read in this process.
_SAFE_FORMATS = tuple(kind for kind, entry in _FORMATS.items() if entry.get("safe"))
#: Limits for reading a file of any other format: time _BASE_TIME [s] + size / speed, memory _BASE_MEMORY [bytes] +
#: _MEMORY_RATIO * size. The speed [bytes/s] is _MIN_SPEED_SLOW for formats that `formats.toml` calls slow.
_BASE_TIME, _MIN_SPEED, _MIN_SPEED_SLOW = 10.0, 20e6, 5e5
_BASE_MEMORY, _MEMORY_RATIO = 2**31, 64
_MAX_NESTING = 3  # deepest nesting of archives that is unpacked


def _detect_format(path: Path) -> str:
    """Detect the format of a file, or the kind of an archive such as "zip", from its content.

    The names are those in `formats.toml`. A file in no known format is taken for "text". Raises UnreadableFile if the
    file is missing, empty or not readable, or has a format that is recognised but not read.
    """
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
    if format_name := next((kind for kind, begins in _BEGINS.items() if begins.match(head)), None):
        return format_name
    if any(_BEGINS["netcdf"].match(head, offset) for offset in (512, 1024, 2048, 4096)):  # after a user block of HDF5
        return "netcdf"
    # name of a format that is recognised but not read
    foreign: str | None = next((words for begins, words in _FOREIGN.items() if begins.match(head)), None)
    if foreign is None and (binary := _find_format(head, is_text=False)):
        return binary
    if foreign is None and detect_encoding(head) is None:  # a text with such a suffix (.dat) is read
        foreign = _PROPRIETARY.get(path.suffix.lower())
    if foreign is not None:
        raise UnreadableFile(f"a recording must be in a format that is read, got {foreign} ({path})")
    return _find_format(head, is_text=True) or "text"


def _find_format(head: bytes, *, is_text: bool) -> str | None:
    """Find the text or binary format whose `recognise` function accepts a file's first bytes; None if none does."""
    kinds = (kind for kind, begins in _POSSIBLE.items() if begins.match(head))
    candidates = (kind for kind in kinds if bool(_FORMATS[kind].get("text")) == is_text)
    return next((kind for kind in candidates if _format_function(kind, _FORMATS[kind]["recognise"])(head)), None)


def _format_function(kind: str, name: str) -> Callable[..., Any]:
    """Import the function `name` of the module that reads files of the format `kind`."""
    module = import_module(f"sealscope.recordings.formats.{_FORMATS[kind]['module']}")
    return getattr(module, name)  # type: ignore[no-any-return]


def _read_by_format(file: Path, kind: str, request: Request) -> RecordingFields:
    """Read a file of the format `kind` to the fields of a recording; `request` chooses the columns."""
    return _format_function(kind, f"read_{kind}")(file, request)  # type: ignore[no-any-return]


@checked_call
def read(
    path: str | os.PathLike[str], *, map: ChannelMap | None = None, rate: float | None = None, group: str | None = None
) -> Recording:
    r"""Read the recording in a file: the text of any logger, or the file of a measurement program.

    Formats: MATLAB, TDMS, HDF5, Parquet, JSON, spreadsheets and others (`docs/reference/formats.md`), also inside
    .gz, .bz2, .xz, .zst, .zip or .tar. Channels of different rates are brought to the clock of the chamber pressures;
    the history says how.

    Parameters
    ----------
    path : str or path
        The file. Its content tells the format.
    map : mapping of str to str or "auto", optional
        Channel (or ``t``) -> column of the file: its name (``{"p_A": "PG_1"}``), its name and unit (``"PG_1[psi]"``),
        its number (``"#2"``), or a formula of columns, with its unit unless this follows from the columns'
        (``"ch2*0.0625-0.625 bar"``, ``"rpm*valve/100"``; ``abs``, ``sign``, ``sqrt``, ``sin``, ``cos``, ``tan``).
        A unit at the end of the column's name is read, as in ``p_bottom_bar``; a column without one is raw counts.
        ``"auto"`` chooses by the columns' names and units, in several languages; the history lists the choice.
        ``{"*": "auto", ...}`` does so for the channels that the mapping does not name.
    rate : float, optional
        Sampling rate [Hz], in place of a time column.
    group : str, optional
        Which of several actuators in the file to read, by its words in the columns' names, such as ``"boom"`` or
        ``"cylinder 2"``; implies ``"auto"``. The entry ``"group"`` of `map` does the same.

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
    return read_file(file, Request(with_group(map or {}, group), rate, file.name, file))


def read_file(file: Path, request: Request) -> Recording:
    """Read the recording in a file; `request` chooses the columns. Errors are as of `read`."""
    with _unpacked_file(file) as (inner, kind):
        return _read_unpacked(inner, kind, request)


@checked_call
def read_parts(
    path: str | os.PathLike[str],
    every: float,
    *,
    map: ChannelMap | None = None,
    rate: float | None = None,
    group: str | None = None,
) -> Iterator[Recording]:
    r"""Read a long recording part by part.

    A text log of any size is read in bounded memory; other formats are read as a whole and then cut.

    Parameters
    ----------
    path : str or path
        The file, as for `read`.
    every : float
        Length of a part [s] at the sampling rate of the file's beginning; gaps do not count. The last may be shorter.
    map : mapping of str to str or "auto", optional
        As for `read`.
    rate : float, optional
        Sampling rate [Hz], in place of a time column.
    group : str, optional
        As for `read`.

    Yields
    ------
    Recording
        The next part. Time stamps give each part its own start; other times continue from part to part.

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
    request = Request(with_group(map or {}, group), rate, file.name, file)
    if not (isfinite(every) and every > 0):
        raise InputError(f"every must be > 0 s and finite, got {every:g}")
    return _iter_parts(file, every, request)


def iter_columns(
    path: str | os.PathLike[str], *, time: str | None = None, rate: float | None = None, rows: float = inf
) -> Iterator[RecordingFields]:
    """Yield every column of a file as it is: in parts of `rows` rows if it is a text log, else at once.

    `time`: column of the time, with its unit, such as ``"clock[ms]"``, and `rate`: sampling rate [Hz], where the file
    does not tell. The entries of `channels` are called by their headings, in the order of the columns; words are
    infinite in a text log, else missing. Without a time the rows are counted at 1 Hz. Raises UnreadableFile and
    InputError as `read` does.
    """
    file = Path(path)
    request = Request({} if time is None else {"t": time}, rate, file.name, file, every_column=True)
    with _unpacked_file(file) as (inner, kind), raising_unreadable(f"{_FORMATS[kind]['words']} file", file):
        if kind == "text":
            yield from read_text_parts(inner, request, inf, rows)
        else:
            yield _read_fields(inner, kind, request)


def _iter_parts(file: Path, every: float, request: Request) -> Iterator[Recording]:
    """Yield a recording in parts of `every` [s]; formats other than text are read as a whole and cut."""
    with _unpacked_file(file) as (inner, kind):
        if kind != "text":
            recording = _read_unpacked(inner, kind, request)
            n_samples = max(1, round(every * recording.rate))
            for first in range(0, len(recording), n_samples):
                yield recording.samples(slice(first, first + n_samples))
            return
        with raising_unreadable("a text file", inner):
            for fields in read_text_parts(inner, request, every):
                yield make_recording(fields)


@contextmanager
def _unpacked_file(file: Path) -> Iterator[tuple[Path, str]]:
    """Yield path and format of a file, or of the file unpacked from it if it is an archive; errors name both files.

    An archive may contain another one, up to `_MAX_NESTING` in all. The unpacked files are removed at the end.
    """
    with ExitStack() as folders:
        inner, kind = file, _detect_format(file)
        max_bytes = max_unpacked_size(file) if kind in _ARCHIVES else 0  # of each layer; a plain file has none
        try:
            for _ in range(_MAX_NESTING):  # such as a .tar.gz, an archive in an archive
                if kind in _ARCHIVES:
                    inner = folders.enter_context(unpack(inner, kind, max_bytes))
                    kind = _detect_format(inner)
            if kind in _ARCHIVES:
                raise UnreadableFile(f"archives must be nested at most {_MAX_NESTING} deep, got more ({inner})")
            yield inner, kind
        except UnreadableFile as error:
            if inner == file:
                raise
            raise UnreadableFile(str(error).replace(str(inner), f"{inner.name} in {file}")) from error


@contextmanager
def unpacked_text(file: Path) -> Iterator[Path]:
    """Yield the path of a text log, or of the one unpacked from an archive; raise UnreadableFile for other formats."""
    with _unpacked_file(file) as (inner, kind):
        if kind != "text":
            raise UnreadableFile(f"a text log must be text, got a {_FORMATS[kind]['words']} file ({file})")
        yield inner


def _read_fields(file: Path, kind: str, request: Request) -> RecordingFields:
    """Read the fields of a recording from a file of the format `kind` that is not packed in an archive.

    Formats that `formats.toml` does not call `safe` are read in a subprocess with limited time, memory and disk space.
    """
    if kind in _SAFE_FORMATS:
        return _read_by_format(file, kind, request)
    size = file.stat().st_size
    limit = _BASE_TIME + size / (_MIN_SPEED_SLOW if _FORMATS[kind].get("slow") else _MIN_SPEED)
    memory = _BASE_MEMORY + _MEMORY_RATIO * size
    return run_on_file(_read_by_format, file, kind, request, limit=limit, memory=memory, disk=max_unpacked_size(file))


def _read_unpacked(file: Path, kind: str, request: Request) -> Recording:
    """Read a recording from a file of the format `kind` that is not packed in an archive."""
    with raising_unreadable(f"{_FORMATS[kind]['words']} file", file):
        fields = _read_fields(file, kind, request)
        if _SUFFIXES.get(file.suffix.lower(), kind) != kind:
            fields = fields.with_note(f"name ends in {file.suffix}, content is {fields.kind}")
        return make_recording(fields)


def check_target(file: Path) -> None:
    """Raise InputError unless the name of `file` ends in the suffix of a format in which recordings can be written."""
    if file.suffix.lower() not in SUFFIXES:
        raise InputError(f"a recording's file must end in {', '.join(SUFFIXES)}, got {file.name}")


@checked_call
def write(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording; all of it but `bridged` reads back unchanged, to the bit.

    Parameters
    ----------
    recording : Recording
        At least one sample of one channel, in SI units or raw counts.
    path : str or path
        The file to write, atomically. Its suffix gives the format: .nc .nc4 .h5 .hdf5 .csv .tsv .txt .parquet .pq.

    Raises
    ------
    InputError
        If the suffix is unknown, the folder does not exist or cannot be written, or the recording would not read back
        unchanged.
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
    check_target(file)
    kind = SUFFIXES[file.suffix.lower()]
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
        _format_function(kind, f"write_{kind}")(temporary, values, units, description, **delimiter)
