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
    """Hash over every file that `module` reaches (see `reached`) and over the versions of `libraries`."""
    digest = hashlib.sha256()
    for path in reached(module):
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    for library in libraries:
        digest.update(f"{library} {_version(library)}".encode())
    return digest.hexdigest()


def reached(module: str) -> tuple[Path, ...]:
    """Files of this package that `module` imports, directly or through others, at its top or inside functions.

    Names taken from a room itself (`from sealscope.recordings import read`) load lazily, so they count as the whole
    room with its data files. Imports for type checkers alone do not count.
    """
    files: dict[Path, None] = {}
    pending, seen = [module], set()
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        path = _file(name)
        if path is None:
            continue
        files[path] = None
        pending += _imported(path)
        if path.name == "__init__.py" and name != PACKAGE:
            for part in sorted(path.parent.rglob("*")):
                if part.suffix in _DATA:
                    files[part] = None
                elif part.suffix == ".py":
                    pending.append(_name(part, name, path.parent))
    return tuple(sorted(files))


def _name(part: Path, room: str, folder: Path) -> str:
    inner = part.relative_to(folder).with_suffix("").parts
    return ".".join((room, *(word for word in inner if word != "__init__")))


@cache
def _file(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


@cache
def _imported(path: Path) -> tuple[str, ...]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return tuple(name for name in _names(tree) if name.split(".")[0] == PACKAGE)


def _names(node: ast.AST) -> Iterator[str]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING":
            for other in child.orelse:
                yield from _names(other)
        elif isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module and not child.level:
            for alias in child.names:
                inner = f"{child.module}.{alias.name}"
                within = child.module.split(".")[0] == PACKAGE
                yield inner if within and _file(inner) is not None else child.module
        else:
            yield from _names(child)


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "none"
