"""The rules of the house that a machine can check."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "sealscope"
FILES = sorted(SOURCE.rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def test_nothing_is_called_utils():
    vague = re.compile(r"^_?(utils?|helpers?|misc|common)$")
    assert not [name_of(path) for path in SOURCE.rglob("*") if vague.match(path.stem)]


def undocumented(path: Path) -> list[str]:
    """Public modules, classes and functions of a file without a docstring; methods answer for their class."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = [] if ast.get_docstring(tree) or not tree.body else [name_of(path)]
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            overload = any("overload" in ast.unparse(one) for one in getattr(node, "decorator_list", []))
            if not ast.get_docstring(node) and not overload:
                found.append(f"{name_of(path)}:{node.lineno} {node.name}")
    return found


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_what_is_public_has_a_docstring(path):
    assert undocumented(path) == []


def python_block(path: Path) -> str:
    blocks = re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert blocks, f"no Python block in {path.name}"
    return blocks[0]


def test_the_readme_s_python_runs(tmp_path, monkeypatch, capsys):
    """The lines of the README, as a newcomer copies them, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    code = python_block(ROOT / "README.md")
    assert "import sealscope as ss" in code
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
    assert "leak" in capsys.readouterr().out
