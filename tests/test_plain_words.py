"""Names and first lines read plainly: a variable is a noun, a function is a verb or a noun."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "sealscope"
FILES = sorted(SOURCE.rglob("*.py"))
#: Pronouns, prepositions and participles that say nothing of what a variable holds.
VARIABLE = re.compile(
    r"about|alike|along|another|apart|aside|asked|at|beside|beyond|each|given|made|of|others|own|said|says|seen|settled"
    r"|so|such|taken|told|wanted"
)
#: ... or of what a function does.
FUNCTION = re.compile(
    VARIABLE.pattern + r"|again|all|and|begun|by|chosen|counted|cut|drawn|else|followed|found|held|here|how|it|joined"
    r"|judged|kept|known|left|lent|listed|lost|moved|named|now|one|other|put|same|shown|some|stated|than|that|then|there"
    r"|these|this|those|together|too|what|which|whole|whose|within|written"
)
#: Names of public or saved fields and of methods that others call, which keep theirs.
KEPT = {
    ("diagnosis/healthy.py", "about"),
    ("diagnosis/live/estimates.py", "judged"),
    ("diagnosis/live/watch.py", "each"),
    ("diagnosis/verdict/diagnosis.py", "about"),
    ("monitor/bounded_queue.py", "put"),
    ("simulation/bench/profile.py", "each"),
    ("simulation/experiment.py", "of"),
    ("simulation/faults.py", "at"),
}
VAGUE_BEGINNING = re.compile(
    r"(Return (all|by|how|in|it|that|those|what|whether|which)|How|It|Judge what|Say|Take what|What|Whether)\b"
)
RELATIVES = re.compile(r"\b(as|that|what|where|which|whose)\b")
#: Most relative words of a first line.
MOST_RELATIVES = 2


def stored_names(nodes: Iterable[ast.AST]) -> Iterator[tuple[int, str]]:
    """Yield line and name of each variable and argument."""
    for node in nodes:
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg


def faults_of(tree: ast.AST, file: str) -> list[str]:
    """List the names and first lines of a file that do not read plainly."""
    nodes = list(ast.walk(tree))
    faults = [
        f"{file}:{line} variable {name}"
        for line, name in stored_names(nodes)
        if VARIABLE.fullmatch(name) and (file, name) not in KEPT
    ]
    for node in nodes:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            continue
        is_function = not isinstance(node, ast.ClassDef)
        if is_function and FUNCTION.fullmatch(node.name.strip("_")) and (file, node.name) not in KEPT:
            faults.append(f"{file}:{node.lineno} function {node.name}")
        first = (ast.get_docstring(node) or "").split("\n\n")[0]
        if VAGUE_BEGINNING.match(first) or len(RELATIVES.findall(first)) > MOST_RELATIVES:
            faults.append(f"{file}:{node.lineno} first line: {first}")
    return faults


@pytest.mark.parametrize("package", sorted({path.relative_to(SOURCE).parts[0] for path in FILES}))
def test_a_package_reads_plainly(package: str):
    files = [path for path in FILES if path.relative_to(SOURCE).parts[0] == package]
    trees = {path.relative_to(SOURCE).as_posix(): ast.parse(path.read_text("utf-8")) for path in files}
    assert [fault for file, tree in trees.items() for fault in faults_of(tree, file)] == []


def test_every_exception_is_needed():
    names = set()
    for file, _ in KEPT:
        nodes = list(ast.walk(ast.parse((SOURCE / file).read_text("utf-8"))))
        names |= {(file, name) for _, name in stored_names(nodes)}
        names |= {(file, node.name) for node in nodes if isinstance(node, ast.FunctionDef)}
    assert names >= KEPT


@pytest.mark.parametrize(
    ("code", "fault"),
    [
        ("for own in blocks:\n    pass", "variable own"),
        ("def fit(given):\n    pass", "variable given"),
        ("def _shown(block):\n    pass", "function _shown"),
        ('def fit():\n    """Return what a block shows."""', "first line"),
        ('def fit():\n    """Fit as much as that which is there, where it is."""', "first line"),
    ],
)
def test_a_vague_name_is_found(code: str, fault: str):
    (found,) = faults_of(ast.parse(code), "room.py")
    assert fault in found


def test_a_plain_name_passes():
    code = 'def fit_response(block):\n    """Fit the response of a block."""\n    for sample in block:\n        pass\n'
    assert faults_of(ast.parse(code), "room.py") == []
