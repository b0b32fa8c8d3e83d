"""Names of numba beyond its manual: each is there, and runs without the private ones are the same."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from functools import cache
from importlib import import_module
from pathlib import Path

import numba
import pytest

import sealscope
from sealscope import compiled

PACKAGE = Path(sealscope.__file__).parent
#: Names of numba that its manual lacks, by module, but which the package uses for every version.
EXTENSION_NAMES = {
    "numba.core": ("cgutils", "ir"),
    "numba.core.compiler": ("CompilerBase", "DefaultPassBuilder"),
    "numba.core.compiler_machinery": ("FunctionPass", "register_pass"),
    "numba.core.ir_utils": ("get_definition", "guard"),
    "numba.core.typeconv": ("Conversion",),
    "numba.core.typing.templates": ("AbstractTemplate", "infer_global", "signature"),
    "numba.core.untyped_passes": ("RewriteSemanticConstants",),
}
#: Attributes of numba that `numba_private` overrides, calls or sets.
ATTRIBUTES = {
    "numba.core.caching:FunctionCache": (
        *("load_overload", "_load_overload", "_guard_against_spurious_io_errors"),
        *("save_overload", "flush", "cache_path"),
    ),
    "numba.core.codegen:JITCodeLibrary": (
        *("_finalize_final_module", "_optimize_functions", "get_pointer_to_function"),
    ),
    "numba.core.compiler:CompilerBase": ("compile_extra", "define_pipelines"),
    "numba.core.compiler_machinery:PassManager": ("add_pass", "finalize"),
    "numba.core.lowering:Lower": ("lower_getitem", "lower_setitem", "loadvar", "typeof"),
    "numba.core.registry:CPUDispatcher": ("add_overload", "compile"),
    "numba.core.typed_passes:BaseNativeLowering": ("lowering_class",),
    "numba.core.config": ("CACHE_DIR",),
}


@pytest.mark.parametrize(("owner", "name"), [(owner, name) for owner, names in ATTRIBUTES.items() for name in names])
def test_an_attribute_is_there(owner: str, name: str):
    module, _, owned = owner.partition(":")
    place = import_module(module)
    assert hasattr(getattr(place, owned) if owned else place, name)


@cache
def imported_from_numba(path: Path) -> set[tuple[str, str]]:
    """Collect what a file imports from within numba, (module, name)."""
    source = path.read_text("utf-8")
    if "numba" not in source:
        return set()
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom)]
    inner = [node for node in nodes if (node.module or "").startswith(("numba.core", "numba.cpython", "numba.np"))]
    return {(str(node.module), alias.name) for node in inner for alias in node.names}


def test_every_imported_name_is_there_and_the_list_of_extensions_is_complete():
    used = {path: imported_from_numba(path) for path in PACKAGE.rglob("*.py")}
    for module, name in set.union(*used.values()):
        assert hasattr(import_module(module), name)
    extensions = {(module, name) for module, names in EXTENSION_NAMES.items() for name in names}
    assert set.union(*(names for path, names in used.items() if path.stem != "numba_private")) == extensions


def test_the_installed_numba_is_of_a_known_version():
    assert compiled.is_known_version(numba.__version__)


@pytest.mark.parametrize(
    ("version", "known"),
    [("0.61.1", False), ("0.61.2", True), ("0.68.0rc1", True), ("0.69.0", False), ("1.0.0", False)],
)
def test_versions_are_compared_by_number(version: str, known: bool):
    assert compiled.is_known_version(version) is known


RUN = """
import numba
numba.__version__ = {version!r}
from sealscope import compiled
from sealscope.physics.leakage import leakage_series
import numpy as np
Q = np.empty(3)
leakage_series(np.full(3, 1e5), np.zeros(3), np.full(3, 1e-10), 2000.0, Q)
print(compiled._compiler().__name__, *Q)
"""
SIMULATION = """
import numba
numba.__version__ = {version!r}
import sealscope as ss
for words in ({{}}, {{"rig": "thesis-closed-loop", "command": "position 20 mm sin(2t)"}}):
    recording = ss.simulate(duration=1.0, **words)
    print(*(f"{{recording[name][-1]:.6g}}" for name in ("x", "p_A", "p_B")))
"""


def run(code: str, version: str, folder: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "SEALSCOPE_CACHE_DIR": folder, "PYTHONPATH": str(PACKAGE.parent)}
    return subprocess.run(
        [sys.executable, "-c", code.format(version=version)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )


@pytest.mark.slow
def test_an_unknown_version_compiles_by_the_documented_way(tmp_path: Path):
    known, unknown = (run(RUN, version, str(tmp_path / "cache")) for version in (numba.__version__, "99.0.0"))
    assert known.stdout.split()[0] == "sealscope.numba_private"
    assert unknown.stdout.split()[0] == "sealscope.numba_pipeline"
    assert known.stdout.split()[1:] == unknown.stdout.split()[1:]
    assert "numba 99.0.0 is not a version from 0.61.2 to before 0.69.0" in unknown.stderr
    assert not known.stderr


@pytest.mark.slow
@pytest.mark.long
def test_runs_by_the_documented_way_are_the_same(tmp_path: Path):
    known, unknown = (run(SIMULATION, version, str(tmp_path / "cache")) for version in (numba.__version__, "99.0.0"))
    assert known.stdout == unknown.stdout
