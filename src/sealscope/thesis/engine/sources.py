"""What a result rests on: the source files that a module reaches, and the versions of the libraries under them.

A result is kept under a hash of both, so that after an edit only what the edit can have changed is made anew.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path

PACKAGE = "sealscope"
LIBRARIES = ("numpy", "scipy", "numba", "PyWavelets")
_DATA = (".toml", ".j2", ".css", ".js")


@cache
def sources_key(module: str, libraries: Sequence[str] = LIBRARIES) -> str:
    """Hash every file that `module` reaches (see `reached_files`) and the versions of the installed `libraries`."""
    digest = hashlib.sha256()
    for path in reached_files(module):
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    for library in libraries:
        try:
            version = metadata.version(library)
        except metadata.PackageNotFoundError:
            version = "none"
        digest.update(f"{library} {version}".encode())
    return digest.hexdigest()


def reached_files(module: str) -> tuple[Path, ...]:
    """Find the files of this package that `module` imports, directly or through others, at its top or in functions.

    Names taken from a room itself (`from sealscope.recordings import read`) load lazily, so they count as the whole
    room with its data files. Imports for type checkers alone do not count.
    """
    files: set[Path] = set()
    pending = [module]
    while pending:
        name = pending.pop()
        path = _file(name)
        if path is None or path in files:
            continue
        files.add(path)
        pending += _imported(path)
        if path.name == "__init__.py" and name != PACKAGE:
            files.update(part for part in path.parent.rglob("*") if part.suffix in _DATA)
            parts = (part.relative_to(path.parent).with_suffix("").parts for part in path.parent.rglob("*.py"))
            pending += [".".join((name, *inner)).removesuffix(".__init__") for inner in parts]
    return tuple(sorted(files))


@cache
def _file(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


@cache
def _imported(path: Path) -> tuple[str, ...]:
    names = _names(ast.parse(path.read_text(encoding="utf-8")))
    return tuple(name for name in names if name.split(".")[0] == PACKAGE)


def _names(node: ast.AST) -> Iterator[str]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING":
            continue
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module:
            for alias in child.names:
                inner = f"{child.module}.{alias.name}"
                yield inner if child.module.split(".")[0] == PACKAGE and _file(inner) is not None else child.module
        else:
            yield from _names(child)
