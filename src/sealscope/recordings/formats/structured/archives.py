"""Recordings in an archive (.gz, .bz2, .xz, .zst, .zip, .tar), unpacked into a private folder while they are read.

A subprocess unpacks them (`run_in_subprocess`), and stops if the output exceeds the limit for an archive of this size.
"""

from __future__ import annotations

import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any, TypeVar

from sealscope.errors import UnreadableFile
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.subprocesses import run_on_file
from sealscope.storage.opening import check_unpacked, raising_unreadable

T = TypeVar("T")
_SUFFIXES = (".gz", ".bz2", ".xz", ".zst", ".zip", ".tar", ".tgz")
#: Suffixes of documents that accompany a recording in an archive.
_DOCUMENTS = (".pdf", ".md", ".png", ".jpg", ".jpeg", ".doc", ".docx", ".html", ".xml", ".json", ".toml", ".ini")
#: A ZIP archive with one of these members, of Office Open XML and OpenDocument, is taken for a workbook.
_WORKBOOK = ("[Content_Types].xml", "mimetype")
#: Longest time to unpack an archive: _BASE_TIME [s] + size / _MIN_SPEED [bytes/s].
_BASE_TIME, _MIN_SPEED = 20.0, 1e6
#: Bytes unpacked at a time, and most memory of the subprocess [bytes].
_CHUNK, _MEMORY = 2**20, 2**30


def is_workbook(path: Path) -> bool:
    """Test whether a ZIP archive is a spreadsheet, in a subprocess; raise UnreadableFile if it is damaged."""
    with raising_unreadable("a zip archive", path):
        return _run_limited(_is_workbook, path)


def _run_limited(work: Callable[..., T], path: Path, *arguments: Any) -> T:
    """Run `work(path, *arguments)` in a subprocess whose time limit grows with the file, and return its result."""
    limit = _BASE_TIME + path.stat().st_size / _MIN_SPEED
    return run_on_file(work, path, *arguments, limit=limit, memory=_MEMORY)


def _is_workbook(path: Path) -> bool:
    """Test whether a ZIP archive has a member that spreadsheets and other office documents have (`_WORKBOOK`)."""
    with zipfile.ZipFile(path) as archive:
        return any(name in archive.NameToInfo for name in _WORKBOOK)


@contextmanager
def unpack(path: Path, kind: str, max_bytes: int) -> Iterator[Path]:
    """Unpack the single file of a `kind` of archive, such as "zip", yield its path, and remove it at the end.

    Raises UnreadableFile if the archive does not hold a single recording, is damaged, or unpacks to more than
    `max_bytes` or half of the free disk space. Raises MissingExtra for .zst without pyarrow.
    """
    with tempfile.TemporaryDirectory(prefix="sealscope-") as folder:
        max_bytes = min(max_bytes, shutil.disk_usage(folder).free // 2)
        with raising_unreadable(f"a {kind} archive", path):
            target = _run_limited(_unpack, path, kind, Path(folder), max_bytes)
        yield target


def _unpack(path: Path, kind: str, folder: Path, max_bytes: int) -> Path:
    """Unpack the single file of an archive into a folder, up to `max_bytes`, and return its path."""
    name = path.stem if path.suffix.lower() in _SUFFIXES else path.name
    with _open_member(path, kind) as (source, member, size):
        check_unpacked(size, max_bytes, path)
        member_name = Path(member or name).name
        target = folder / (member_name if member_name.strip(".") else "recording")  # not `.` or `..`
        with target.open("wb") as file:
            while data := source.read(_CHUNK):
                check_unpacked(file.tell() + len(data), max_bytes, path)
                file.write(data)
    return target


@contextmanager
def _open_member(path: Path, kind: str) -> Iterator[tuple[IO[bytes], str, int]]:
    """Open the single file in a `kind` of archive; yield (stream, name or "", size [bytes] or 0 if not known)."""
    with ExitStack() as stack:
        if kind == "zip":
            zip_archive = stack.enter_context(zipfile.ZipFile(path))
            name = _select_recording([info.filename for info in zip_archive.infolist() if not info.is_dir()], path)
            yield stack.enter_context(zip_archive.open(name)), name, zip_archive.getinfo(name).file_size
        elif kind == "tar":
            tar_archive = stack.enter_context(tarfile.open(path))
            name = _select_recording([member.name for member in tar_archive.getmembers() if member.isfile()], path)
            stream = tar_archive.extractfile(name)
            assert stream is not None
            yield stack.enter_context(stream), name, tar_archive.getmember(name).size
        elif kind == "zstd":
            stream = import_library("pyarrow", "a .zst archive", "pyarrow").CompressedInputStream(str(path), "zstd")
            yield stack.enter_context(stream), "", 0
        else:
            module = import_module({"gzip": "gzip", "bz2": "bz2", "xz": "lzma"}[kind])
            yield stack.enter_context(module.open(path)), "", 0


def _select_recording(names: Sequence[str], path: Path) -> str:
    """Select the only file of an archive that is no document and not hidden; a single file may be of any kind."""
    names = [name for name in names if "__MACOSX" not in name and not Path(name).name.startswith(".")]
    candidates = [name for name in names if Path(name).suffix.lower() not in _DOCUMENTS] if len(names) > 1 else names
    if len(candidates) > 1:
        candidates = [name for name in candidates if not Path(name).stem.lower().startswith(("readme", "license"))]
    if len(candidates) != 1:
        listing = ", ".join(name[:40] for name in names[:6]) or "none"
        raise UnreadableFile(
            f"an archive must hold a single file, got {len(names)}: {listing}: unpack it, and name its files ({path})"
        )
    return candidates[0]
