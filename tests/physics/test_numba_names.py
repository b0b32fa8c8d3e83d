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
from sealscope import compiled, numba_pipeline, numba_private

PACKAGE = Path(sealscope.__file__).parent
LISTS = (numba_private.NAMES, numba_pipeline.EXTENSION_NAMES)
NAMES = [(module, name) for names in LISTS for module in names for name in names[module]]
ATTRIBUTES = [(owner, name) for owner, names in numba_private.ATTRIBUTES.items() for name in names]


@pytest.mark.parametrize(("module", "name"), NAMES)
def test_a_name_is_there(module: str, name: str):
    assert hasattr(import_module(module), name)


@pytest.mark.parametrize(("owner", "name"), ATTRIBUTES)
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


def test_the_lists_are_complete():
    used = {use for path in PACKAGE.rglob("*.py") for use in imported_from_numba(path)}
    assert used == set(NAMES)


def test_private_classes_are_touched_in_one_module():
    private = {(module, name) for module, names in numba_private.NAMES.items() for name in names}
    shared = {("numba.core.untyped_passes", "RewriteSemanticConstants")}
    for path in PACKAGE.rglob("*.py"):
        if path.stem != "numba_private":
            assert not imported_from_numba(path) & (private - shared), path


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
print(compiled._compiler().__name__, *leakage_series(np.full(3, 1e5), np.zeros(3), np.full(3, 1e-10), 2000.0))
"""
SIMULATION = """
import numba
numba.__version__ = {version!r}
import sealscope as ss
for words in ({{}}, {{"rig": "thesis-closed-loop", "command": "position 20 mm sin(2t)"}}):
    recording = ss.simulate(duration=1.0, **words)
    print(*(f"{{recording[name][-1]:.6g}}" for name in ("x", "p_A", "p_B")))
batch = ss.simulate_batch([ss.Experiment.of(duration=2.0, seed=seed) for seed in range(2)], bounds=[0.0, 2.0])
print(*(f"{{value:.6g}}" for value in batch.rms.ravel()))
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
