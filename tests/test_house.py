"""The rules of the house that a machine can check."""

from __future__ import annotations

import ast
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import get_args

import pytest

from sealscope.diagnosis.verdict.evidence import Verdict

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "sealscope"
FILES = sorted(SOURCE.rglob("*.py"))
FOLDERS = sorted({path.parent for path in FILES})
#: The longest chain of imports between the files and folders of one folder.
MOST_DEPTH = 6


def name_of(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def entries(folder: Path) -> set[str]:
    """Modules and packages side by side in a folder of the source."""
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    return modules | {path.parent.name for path in folder.glob("*/*.py")}


@cache
def tree_of(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imported(path: Path) -> set[str]:
    """Every module of the package that a file imports, wherever in the file, by its full name and that of its names."""
    names = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("sealscope"):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name.startswith("sealscope")}
    return names


def depth(folder: Path) -> int:
    """Longest chain of imports between the entries of a folder; raises RecursionError where they form a circle."""
    prefix = ".".join(("sealscope", *folder.relative_to(SOURCE).parts)) + "."
    needs: dict[str, set[str]] = {entry: set() for entry in entries(folder)}
    for path in folder.rglob("*.py"):
        owner = path.relative_to(folder).with_suffix("").parts[0]
        targets = {name.removeprefix(prefix).split(".")[0] for name in imported(path) if name.startswith(prefix)}
        needs.setdefault(owner, set()).update(targets & needs.keys() - {owner})
    known: dict[str, int] = {}

    def chain(entry: str) -> int:
        if entry not in known:
            known[entry] = max((1 + chain(other) for other in needs[entry]), default=0)
        return known[entry]

    return max(map(chain, entries(folder)), default=0)


@pytest.mark.parametrize("folder", FOLDERS[1:], ids=name_of)  # the order of the packages is import-linter's
def test_imports_within_a_folder_are_few_steps_deep(folder):
    assert depth(folder) <= MOST_DEPTH


def test_a_module_of_the_diagnosis_has_a_name_of_its_own():
    """A name in a message, a stack or a search leads to one file."""
    names = [path.stem for path in (SOURCE / "diagnosis").rglob("*.py") if path.stem != "__init__"]
    assert sorted({name for name in names if names.count(name) > 1}) == []


def test_the_depth_of_a_folder_is_measured():
    assert depth(SOURCE / "diagnosis") >= 3
    assert "physics" in entries(SOURCE)


def test_a_class_name_stands_in_one_package():
    packages: dict[str, set[str]] = {}
    for path in FILES:
        package = path.relative_to(SOURCE).parts[0]
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef):
                packages.setdefault(node.name, set()).add(package)
    assert len(packages) > 100
    assert {name: sorted(homes) for name, homes in packages.items() if len(homes) > 1} == {}


#: Where the words of a verdict stand: in their type, and as the name of an attribute of a watch.
VERDICT_FILES = {"diagnosis/verdict/evidence.py", "diagnosis/live/watch.py"}


def test_the_words_of_a_verdict_stand_in_one_place():
    words = set(get_args(Verdict))
    found = {
        name_of(path)
        for folder in ("diagnosis", "monitor")
        for path in (SOURCE / folder).rglob("*.py")
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Constant) and node.value in words
    }
    assert found == VERDICT_FILES


def test_nothing_is_called_utils():
    vague = re.compile(r"^_?(utils?|helpers?|misc|common)$")
    assert not [name_of(path) for path in SOURCE.rglob("*") if vague.match(path.stem)]


def undocumented(path: Path) -> list[str]:
    """Public modules, classes and functions of a file without a docstring; methods answer for their class."""
    tree = tree_of(path)
    result = [] if ast.get_docstring(tree) or not tree.body else [name_of(path)]
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            overload = any("overload" in ast.unparse(one) for one in getattr(node, "decorator_list", []))
            if not ast.get_docstring(node) and not overload:
                result.append(f"{name_of(path)}:{node.lineno} {node.name}")
    return result


def test_what_is_public_has_a_docstring():
    assert {name_of(path): names for path in FILES if (names := undocumented(path))} == {}


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


def test_prose_wraps_at_120_columns() -> None:
    root = Path(__file__).parents[1]
    pages = [*root.glob("*.md"), *(root / "docs").rglob("*.md")]
    long = []
    for page in pages:
        code = False
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
            code ^= line.startswith("```")
            prose = not code and not line.lstrip().startswith("|") and " " in line[40:120]
            if prose and len(line) > 120 and "generated" not in page.parts:
                long.append(f"{page.relative_to(root)}:{number}")
    assert len(pages) > 10
    assert long == []


#: Most lines of a decision record: a page. Longer tables stand in `docs/results.md`.
PAGE = 60
DECISIONS = sorted((ROOT / "docs" / "decisions").glob("0*.md"))


@pytest.mark.parametrize("path", DECISIONS, ids=lambda path: path.stem)
def test_a_decision_is_a_page(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= PAGE
    assert lines[0].startswith(f"# {int(path.stem[:4])}. ")
    assert any(re.match(r"(?:\*\*|## )(?:Decision|Choice)\b", line) for line in lines)


def test_decisions_are_numbered_in_turn():
    """A decision that no longer holds is deleted; the others keep their numbers."""
    numbers = [int(path.stem[:4]) for path in DECISIONS]
    assert numbers == sorted(set(numbers))


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("priors.toml")), ids=lambda path: path.parent.name)
def test_a_belief_states_value_unit_and_source(path):
    for table in tomllib.loads(path.read_text("utf-8")).values():
        for name, row in table.items():
            assert set(row) == {"value", "unit", "source"}, name
            assert row["unit"] and row["source"], name
