"""The cache of compiled code: an edit to a law in another file is never answered with the old physics."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from numba.core import config

import sealscope
from sealscope.compiled import source_hash

PACKAGE = Path(sealscope.__file__).parent
PROBE = """
import sys
import numpy as np
from sealscope.compiled import cache_directory
from sealscope.physics.{home} import {kernel}
{call}
hits = sum({kernel}.stats.cache_hits.values()) if cache_directory() else 0
print(float(result), hits, cache_directory())
"""
#: A small kernel that calls a law of another file: compiles in a second or two.
SMALL = PROBE.format(
    home="leakage",
    kernel="leakage_series",
    call="result = leakage_series(np.full(3, 1e5), np.zeros(3), np.full(3, 1e-10), 2000.0)[0]",
)
#: The solver itself, whose laws stand in six other files.
WHOLE = """
import numpy as np
from sealscope.compiled import cache_directory
from sealscope.parameters import load_rig
from sealscope.physics.solvers.rk4 import advance_rk4
from sealscope.simulation.integrate import integrate
run = integrate(load_rig(), lambda t: (3 * np.sin(4 * t), 0 * t, 0 * t), 0.2, 500.0)
print(float(run["p_A"][-1]), sum(advance_rk4.stats.cache_hits.values()), cache_directory())
"""


def ask(source: Path, code: str, cache: Path | str) -> tuple[float, int, str]:
    environment = {
        **os.environ,
        "PYTHONPATH": str(source),
        "SEALSCOPE_CACHE_DIR": str(cache),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    told = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    value, hits, folder = told.stdout.split(maxsplit=2)
    return float(value), int(hits), folder.strip()


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    shutil.copytree(PACKAGE, tmp_path / "source" / "sealscope", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "source"


def edit(copy: Path, file: str, old: str, new: str) -> None:
    path = copy / "sealscope" / "physics" / file
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_an_edited_law_in_another_file_is_seen_and_the_old_code_comes_back_with_the_old_law(copy, tmp_path):
    cache = tmp_path / "cache"
    law, doubled = "return c * dp / math.sqrt(", "return 2.0 * c * dp / math.sqrt("
    before, hits, folder = ask(copy, SMALL, cache)
    assert hits == 0
    assert str(cache) in folder
    assert ask(copy, SMALL, cache)[:2] == (before, 1)  # from the cache
    edit(copy, "restrictors.py", law, doubled)
    after, hits, other = ask(copy, SMALL, cache)
    assert after == pytest.approx(2.0 * before, rel=1e-14)
    assert hits == 0
    assert other != folder
    edit(copy, "restrictors.py", doubled, law)
    assert ask(copy, SMALL, cache) == (before, 1, folder)


@pytest.mark.slow
def test_the_solver_sees_an_edit_of_friction(copy, tmp_path):
    before, _, _ = ask(copy, WHOLE, tmp_path / "cache")
    assert ask(copy, WHOLE, tmp_path / "cache")[:2] == (before, 1)
    edit(copy, "friction.py", "-1.0), 1.0) + F_v * v", "-1.0), 1.0) + 2.0 * F_v * v")
    after, hits, _ = ask(copy, WHOLE, tmp_path / "cache")
    assert hits == 0
    assert abs(after - before) > 100.0


def test_a_cache_folder_that_cannot_be_written_is_no_error(copy, tmp_path):
    blocked = tmp_path / "a file, not a folder"
    blocked.write_text("")
    value, _, folder = ask(copy, SMALL, blocked)
    assert value > 0
    assert str(blocked) not in folder


def test_an_empty_cache_folder_turns_caching_off(copy):
    value, hits, folder = ask(copy, SMALL, "")
    assert value > 0
    assert (hits, folder) == (0, "None")


def test_only_so_many_generations_are_kept(copy, tmp_path):
    cache = tmp_path / "cache"
    for name in "abcdef":
        (cache / "kernels" / name).mkdir(parents=True)
    _, _, folder = ask(copy, SMALL, cache)
    left = sorted(path.name for path in (cache / "kernels").iterdir())
    assert Path(folder).name in left
    assert len(left) == 4


def test_the_hash_follows_every_source_of_a_compiled_room(copy):
    root = copy / "sealscope"
    before = source_hash(root)
    assert before == source_hash(PACKAGE)
    (root / "physics" / "new_law.py").write_text("x = 1\n")
    added = source_hash(root)
    (root / "physics" / "new_law.py").rename(root / "physics" / "renamed.py")
    assert len({before, added, source_hash(root)}) == 3


def test_numba_s_own_setting_is_left_as_it_was():
    from sealscope.compiled import kernel

    before = config.CACHE_DIR

    @kernel
    def twice(x: float) -> float:
        return 2.0 * x

    assert twice(2.0) == 4.0
    assert before == config.CACHE_DIR
    assert before == numba.config.CACHE_DIR


def test_compiled_division_by_zero_follows_ieee_754():
    from sealscope.physics.cylinder import pressure_rate

    assert pressure_rate(1.0, 0.0, 1.0) == float("inf")
