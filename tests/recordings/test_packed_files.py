"""What packed files may unpack to, and what the process that reads them may take: known before it is spent."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import re
import struct
import zipfile
from pathlib import Path

import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import read
from sealscope.storage.opening import max_unpacked_size

from ..refusals import refusal
from .refusals import refused

SMALL = 2**26


def workbook(path: Path, sheet: list[bytes]) -> Path:
    """Write a workbook whose one sheet is the XML of the parts, one after the other."""
    head = b'<?xml version="1.0" encoding="UTF-8"?>'
    main, office = "http://schemas.openxmlformats.org/spreadsheetml/2006/main", "http://schemas.openxmlformats.org/"
    rels = f"{office}officeDocument/2006/relationships"
    texts = {
        "[Content_Types].xml": f'<Types xmlns="{office}package/2006/content-types"></Types>',
        "_rels/.rels": f'<Relationships xmlns="{office}package/2006/relationships"><Relationship Id="r" '
        f'Type="{rels}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{main}" xmlns:r="{rels}"><sheets><sheet name="a" sheetId="1" r:id="s"/>'
        "</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{office}package/2006/relationships"><Relationship '
        f'Id="s" Type="{rels}/worksheet" Target="worksheets/sheet1.xml"/></Relationships>',
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, text in texts.items():
            archive.writestr(name, head + text.encode())
        with archive.open("xl/worksheets/sheet1.xml", "w") as file:
            for part in (head, f'<worksheet xmlns="{main}"><sheetData>'.encode(), *sheet, b"</sheetData></worksheet>"):
                file.write(part)
    return path


def rows(cells: list[tuple[str, object]]) -> bytes:
    return b"".join(b'<row><c r="%b"><v>%b</v></c></row>' % (at.encode(), str(v).encode()) for at, v in cells)


@pytest.mark.parametrize(("kind", "pack"), [("gz", gzip.compress), ("bz2", bz2.compress), ("xz", lzma.compress)])
def test_a_bomb_is_unpacked_no_further_than_its_size_allows(kind: str, pack, tmp_path: Path) -> None:
    """Each of the streams that follow each other in the file unpacks to 16 MB of zeros."""
    path = tmp_path / f"bomb.csv.{kind}"
    path.write_bytes(pack(bytes(2**24)) * 20)
    most = max_unpacked_size(path)
    assert most == max(SMALL, 200 * path.stat().st_size)
    line = re.match(rf"a packed file must unpack to at most {most} bytes, got (\d+) or more: ", refused(path, rate=500))
    assert line is not None
    assert int(line[1]) <= most + 2**20


def test_errors_name_the_file_as_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that reads has the folder in which it was started."""
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(bytes(2**24)) * 20)
    refused(path, rate=500)
    monkeypatch.chdir(tmp_path)
    with refusal("log.csv.gz", error=UnreadableFile):
        read("log.csv.gz")


def test_archives_in_archives_are_bounded_by_the_outermost(tmp_path: Path) -> None:
    path = tmp_path / "bomb.csv.gz.bz2"
    path.write_bytes(bz2.compress(gzip.compress(bytes(2**24)) * 5))  # the inner file alone might unpack to more
    assert f"at most {SMALL} bytes" in refused(path, rate=500)


def test_archives_lie_three_deep_in_each_other_at_most(tmp_path: Path) -> None:
    content = b"t [s],p_A [bar]\n0,1\n1,2\n2,3\n"
    for _ in range(3):
        content = gzip.compress(content)
    path = tmp_path / "log.csv.gz"
    path.write_bytes(content)
    assert len(read(path)) == 3
    path.write_bytes(gzip.compress(content))
    assert refused(path).startswith("archives must be nested at most 3 deep")


def test_a_sparse_archive_that_claims_12_gib(tmp_path: Path) -> None:
    path, size = tmp_path / "log.zip", 12 * 2**30
    name = b"log.csv"
    sizes = struct.pack("<HHQQ", 1, 16, size, size)
    local = struct.pack("<4s5H3L2H", b"PK\3\4", 45, 0, 0, 0, 0, 0, 2**32 - 1, 2**32 - 1, len(name), 20) + name + sizes
    entry = struct.pack(
        "<4s6H3L5H2L", b"PK\1\2", 45, 45, 0, 0, 0, 0, 0, 2**32 - 1, 2**32 - 1, len(name), 20, 0, 0, 0, 0, 0
    )
    entry += name + sizes
    start = len(local) + size
    end = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 1, 1, len(entry), start)
    end += struct.pack("<4sLQL", b"PK\6\7", 0, start + len(entry), 1)
    end += struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, len(entry), 2**32 - 1, 0)
    with path.open("wb") as file:
        file.write(local)
        file.seek(start)
        file.write(entry + end)
    if 512 * path.stat().st_blocks > 2**20:
        pytest.skip("the file system keeps no sparse files")
    assert f"must unpack to at most {SMALL} bytes, got {size} or more" in refused(path, rate=500)
    assert max_unpacked_size(path) == SMALL


@pytest.mark.parametrize("lie", [False, True])
def test_the_xml_within_a_workbook_is_bounded(lie: bool, tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    size = SMALL + 2**24
    path = workbook(tmp_path / "log.xlsx", [b" " * 2**20] * (size // 2**20))
    assert path.stat().st_size < 1_000_000
    if not lie:
        assert f"must unpack to at most {max_unpacked_size(path)} bytes, got " in refused(path, rate=500)
        return
    with zipfile.ZipFile(path) as archive:
        true = struct.pack("<L", archive.getinfo("xl/worksheets/sheet1.xml").file_size)
    path.write_bytes(path.read_bytes().replace(true, struct.pack("<L", 1000)))
    assert "must be whole" in refused(path, rate=500)


@pytest.mark.slow  # that a reader is ended when it asks for too much: test_subprocesses.py
def test_a_workbook_with_a_value_in_its_last_cell(tmp_path: Path) -> None:
    """The library asks for a cell each of 16384 x 1048576, and ends its process."""
    pytest.importorskip("python_calamine")
    path = workbook(tmp_path / "corner.xlsx", [rows([("A1", 1), ("XFD1048576", 2)])])
    assert path.stat().st_size < 5000
    assert refused(path, rate=500).startswith("a spreadsheet file must be whole, got: the library that reads it ")
    path = workbook(tmp_path / "corner.xlsx", [rows([("A1", 1), ("NTP100000", 2)])])  # 10 000 columns: 24 GB
    assert refused(path, rate=500).startswith("a spreadsheet file must be whole, got: the library that reads it ")


def test_a_workbook_of_the_same_making_is_read(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    cells = [(f"A{k}", 1e5 + k) for k in range(2, 900)]
    text = b'<row><c r="A1" t="inlineStr"><is><t>p_A [Pa]</t></is></c></row>'
    assert len(read(workbook(tmp_path / "log.xlsx", [text, rows(cells)]), rate=500)) == 898


@pytest.mark.slow
def test_a_long_log_of_standing_channels_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "log.csv.xz"
    path.write_bytes(
        lzma.compress(b"t [s],p_A [Pa]\n" + b"".join(b"%.3f,300000\n" % (k / 500) for k in range(100_000)))
    )
    assert len(read(path)) == 100_000


def test_a_file_of_the_system_that_never_ends_is_refused() -> None:
    """Linux says that it is a regular file, of no length; to read it waits for the kernel's next message."""
    if not os.access("/proc/kmsg", os.R_OK):
        pytest.skip("there is no /proc/kmsg that may be read here")
    assert refused(Path("/proc/kmsg"), rate=500) == "a recording must hold data, got an empty file (FILE)"
