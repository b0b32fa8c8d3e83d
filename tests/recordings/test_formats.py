"""Formats: what a row of `formats.toml` says is what the module, the tests, the extra `io` and the page have."""

from __future__ import annotations

import ast
import re
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from sealscope.recordings import files

from ..fuzz.recordings import KINDS

ROOT = Path(__file__).resolve().parents[2]
FORMATS = files._FORMATS
FOLDER = Path(files.__file__).parent / "formats"
KEYS = {"words", "module", "suffixes", "begins", "recognise", "possible", "text", "safe", "slow", "written"}


@pytest.mark.parametrize("kind", FORMATS)
def test_a_row_names_functions_of_its_module(kind: str) -> None:
    row = FORMATS[kind]
    assert set(row) <= KEYS
    module = import_module(f"sealscope.recordings.formats.{row['module']}")
    wanted = [f"read_{kind}"] + [f"write_{kind}"] * row.get("written", False)
    wanted += [row["recognise"]] if "recognise" in row else []
    assert all(callable(getattr(module, name, None)) for name in wanted), wanted
    assert ("recognise" in row) == ("possible" in row)


def test_a_table_of_commas_is_asked_for_no_other_format(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "_format_function", lambda kind, name: pytest.fail(f"{kind} is loaded"))
    head = b"t [s],p_A [Pa],p_B [Pa]\n0.0,1.0,2.0\n"
    assert files._find_format(head, is_text=False) is files._find_format(head, is_text=True) is None


def test_no_file_is_both_read_and_refused() -> None:
    suffixes = [suffix for row in FORMATS.values() for suffix in row["suffixes"]]
    assert len(suffixes) == len(set(suffixes))
    assert not set(suffixes) & set(files._PROPRIETARY)
    for kind, begins in files._BEGINS.items():
        head = re.sub(rb"\|.*|\\\..*|\(.*", b"", begins.pattern)
        assert not [words for foreign, words in files._FOREIGN.items() if foreign.match(head)], kind


def test_the_page_lists_every_suffix() -> None:
    page = (ROOT / "docs" / "reference" / "formats.md").read_text(encoding="utf-8")
    assert [suffix for row in FORMATS.values() for suffix in row["suffixes"] if f"`{suffix}`" not in page] == []


def test_every_format_has_a_file_that_fuzzers_change(tmp_path: Path) -> None:
    """Files of a format of its own: a row of `FILES` in `dialects.py`."""
    mutated = {files._detect_format(write_file(tmp_path)) for write_file in KINDS.values()}
    assert mutated >= set(FORMATS)


def test_what_a_module_imports_is_installed_with_the_extra_io() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = {re.split("[<>=]", line)[0] for line in project["optional-dependencies"]["io"]}
    calls = [
        node
        for path in FOLDER.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "import_library"
    ]
    packages = {argument.value for call in calls for argument in call.args[2:] if isinstance(argument, ast.Constant)}
    assert len(packages) > 3
    assert packages <= extra
