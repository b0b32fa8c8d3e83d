"""Recordings in an archive (.gz, .bz2, .xz, .zst, .zip, .tar), unpacked into a private folder while they are read.

A process of its own unpacks (`run_apart`), and stops where more comes out than a file of this size may hold.
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
from sealscope.recordings.apart import file_apart
from sealscope.recordings.formats.libraries import library
from sealscope.storage.opening import whole
from sealscope.storage.unpacking import check_unpacked

T = TypeVar("T")
_SUFFIXES = (".gz", ".bz2", ".xz", ".zst", ".zip", ".tar", ".tgz")
#: What lies beside a recording in an archive and is none.
_DOCUMENTS = (".pdf", ".md", ".png", ".jpg", ".jpeg", ".doc", ".docx", ".html", ".xml", ".json", ".toml", ".ini")
#: A workbook is a ZIP archive with one of these members.
_WORKBOOK = ("[Content_Types].xml", "mimetype")
#: Longest time that unpacking may take [s], and what is added for the size of the archive [bytes/s].
_LONGEST, _SLOWEST = 20.0, 1e6
_CHUNK, _MEMORY = 2**20, 2**30


def is_workbook(path: Path) -> bool:
    """Test whether a ZIP archive is a spreadsheet."""
    with whole("a zip archive", path):
        return _run_limited(_is_workbook, path)


def _run_limited(work: Callable[..., T], path: Path, *arguments: Any) -> T:
    limit = _LONGEST + path.stat().st_size / _SLOWEST
    return file_apart(work, path, *arguments, limit=limit, memory=_MEMORY)


def _is_workbook(path: Path) -> bool:
    with zipfile.ZipFile(path) as archive:
        return any(name in archive.NameToInfo for name in _WORKBOOK)


@contextmanager
def unpacked(path: Path, kind: str, most: int) -> Iterator[Path]:
    """Unpack the single file of an archive, and remove it at the end.

    Raises UnreadableFile where a ZIP or tar holds no recording or several, where the archive is damaged, and where it
    unpacks to more than `most` bytes, or half of what the disk has room for; MissingExtra for .zst without pyarrow.
    """
    with tempfile.TemporaryDirectory(prefix="sealscope-") as folder:
        most = min(most, shutil.disk_usage(folder).free // 2)
        with whole(f"a {kind} archive", path):
            target = _run_limited(_unpack, path, kind, Path(folder), most)
        yield target


def _unpack(path: Path, kind: str, folder: Path, most: int) -> Path:
    """Write the single file of an archive into a folder, and return its path."""
    name = path.stem if path.suffix.lower() in _SUFFIXES else path.name
    with _opened(path, kind) as (source, member, size):
        check_unpacked(size, most, path)
        last = Path(member or name).name
        target = folder / (last if last.strip(".") else "recording")
        with target.open("wb") as file:
            while data := source.read(_CHUNK):
                check_unpacked(file.tell() + len(data), most, path)
                file.write(data)
    return target


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[tuple[IO[bytes], str, int]]:
    """Open the single file of an archive; its name and size are "" and 0 where the archive does not say."""
    with ExitStack() as stack:
        if kind == "zip":
            packed = stack.enter_context(zipfile.ZipFile(path))
            name = _only([info.filename for info in packed.infolist() if not info.is_dir()], path)
            yield stack.enter_context(packed.open(name)), name, packed.getinfo(name).file_size
        elif kind == "tar":
            tape = stack.enter_context(tarfile.open(path))
            name = _only([member.name for member in tape.getmembers() if member.isfile()], path)
            inner = tape.extractfile(name)
            assert inner is not None
            yield stack.enter_context(inner), name, tape.getmember(name).size
        elif kind == "zstd":
            stream = library("pyarrow", "a .zst archive", "pyarrow").CompressedInputStream(str(path), "zstd")
            yield stack.enter_context(stream), "", 0
        else:
            module = import_module({"gzip": "gzip", "bz2": "bz2", "xz": "lzma"}[kind])
            yield stack.enter_context(module.open(path)), "", 0


def _only(names: Sequence[str], path: Path) -> str:
    """Return the recording among the names of an archive's files, which documents may lie beside."""
    names = [name for name in names if "__MACOSX" not in name and not Path(name).name.startswith(".")]
    data = [name for name in names if Path(name).suffix.lower() not in _DOCUMENTS] if len(names) > 1 else names
    data = [name for name in data if len(data) == 1 or not Path(name).stem.lower().startswith(("readme", "license"))]
    if len(data) != 1:
        shown = ", ".join(name[:40] for name in names[:6]) or "none"
        raise UnreadableFile(
            f"an archive must hold a single file, got {len(names)}: {shown}: unpack it, and name its files ({path})"
        )
    return data[0]
