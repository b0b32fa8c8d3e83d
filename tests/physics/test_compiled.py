"""The cache of compiled code: an edit to a law in another file is never answered with the old physics."""

from __future__ import annotations

import gc
import os
import random
import shutil
import subprocess
import sys
import time
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import config
from numba.core.errors import TypingError

import sealscope
from sealscope import compiled, numba_private
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
    call="Q = np.empty(3); leakage_series(np.full(3, 1e5), np.zeros(3), np.full(3, 1e-10), 2000.0, Q); result = Q[0]",
)
#: The solver itself, whose laws stand in six other files.
WHOLE = """
import numpy as np
from sealscope.compiled import cache_directory
from sealscope.physics.solvers.advance import advance
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run
path = integrate_run(Experiment.of(duration=0.2), ())
print(float(path["p_A"][-1]), sum(advance.stats.cache_hits.values()), cache_directory())
"""


def ask(source: Path, code: str, cache: Path | str, **more: str) -> tuple[float, int, str]:
    environment = {
        **os.environ,
        **more,
        "PYTHONPATH": str(source),
        "SEALSCOPE_CACHE_DIR": str(cache),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    value, hits, folder = process.stdout.split(maxsplit=2)
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


@pytest.mark.slow
def test_an_edited_law_in_another_file_is_seen_and_the_old_code_comes_back_with_the_old_law(copy, tmp_path):
    cache = tmp_path / "cache"
    law, doubled = "return c * dp / math.sqrt(", "return 2.0 * c * dp / math.sqrt("
    before, hits, folder = ask(copy, SMALL, cache)
    assert hits == 0
    assert str(cache) in folder
    edit(copy, "restrictors.py", law, doubled)
    after, hits, other = ask(copy, SMALL, cache)
    assert after == pytest.approx(2.0 * before, rel=1e-14)
    assert hits == 0
    assert other != folder
    edit(copy, "restrictors.py", doubled, law)
    assert ask(copy, SMALL, cache) == (before, 1, folder)  # from the cache


@pytest.mark.slow
@pytest.mark.long
def test_the_solver_sees_an_edit_of_friction(copy, tmp_path):
    before, _, _ = ask(copy, WHOLE, tmp_path / "cache")
    assert ask(copy, WHOLE, tmp_path / "cache")[:2] == (before, 1)
    edit(copy, "friction.py", "-1.0), 1.0) + F_v * v", "-1.0), 1.0) + 2.0 * F_v * v")
    after, hits, _ = ask(copy, WHOLE, tmp_path / "cache")
    assert hits == 0
    assert abs(after - before) > 100.0


@pytest.mark.slow
def test_a_cache_folder_that_cannot_be_written_is_no_error(copy, tmp_path):
    blocked = tmp_path / "a file, not a folder"
    blocked.write_text("")
    value, _, folder = ask(copy, SMALL, blocked)
    assert value > 0
    assert str(blocked) not in folder


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners and modes of folders")
@pytest.mark.parametrize(
    "whose",
    [
        "another user's",
        "kernels open to all",
        "kernels a link",
        *(pytest.param(whose, marks=pytest.mark.long) for whose in ("open to all", "a link")),
    ],
)
@pytest.mark.slow
def test_no_compiled_code_is_loaded_from_a_folder_that_others_can_write(copy, tmp_path, whose):
    temporary, home = tmp_path / "tmp", tmp_path / "home"
    temporary.mkdir()
    home.write_text("")  # no folder: the cache falls back to the temporary directory
    folder = temporary / f"sealscope-{os.getuid()}"
    target = folder / "kernels" if whose.startswith("kernels") else folder
    target.parent.mkdir(exist_ok=True, mode=0o700)
    if whose.endswith("link"):
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        target.symlink_to(tmp_path / "elsewhere")
    else:
        target.mkdir()
        target.chmod(0o777 if whose.endswith("all") else 0o700)
    if whose == "another user's":
        if os.getuid() != 0:
            pytest.skip("only root can give a folder away")
        os.chown(target, 12345, 12345)
    value, hits, used = ask(copy, SMALL, home / "cache", TMPDIR=str(temporary))
    assert value > 0
    assert (hits, used) == (0, "None")
    assert not list(temporary.rglob("*.nb?"))
    assert not (tmp_path / "elsewhere").exists() or not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners and modes of folders")
@pytest.mark.slow
def test_the_folders_of_compiled_code_are_the_user_s_alone(copy, tmp_path):
    for cache in (tmp_path / "cache", tmp_path / "open"):
        (tmp_path / "open" / "kernels").mkdir(parents=True, exist_ok=True, mode=0o755)
        _, _, folder = ask(copy, SMALL, cache)
        for place in (Path(folder), Path(folder).parent):
            assert place.is_relative_to(cache)
            assert place.lstat().st_mode & 0o777 == 0o700
    (tmp_path / "open").chmod(0o777)
    assert not Path(ask(copy, SMALL, tmp_path / "open")[2]).is_relative_to(tmp_path / "open")


@pytest.mark.parametrize(("suffix", "left"), [("nbi", 7), pytest.param("nbc", 0, marks=pytest.mark.long)])
@pytest.mark.slow
def test_a_cut_off_file_of_the_cache_is_a_miss(copy, tmp_path, suffix, left):
    before = ask(copy, SMALL, tmp_path)
    files = [path for path in Path(before[2]).rglob(f"*.{suffix}") if "leakage_series" in path.name]
    assert files
    for path in files:
        path.write_bytes(path.read_bytes()[:left])
    assert ask(copy, SMALL, tmp_path) == before
    assert ask(copy, SMALL, tmp_path) == (before[0], 1, before[2])


@pytest.mark.slow
def test_a_full_disk_is_no_error(copy, tmp_path):
    pytest.importorskip("resource")
    full = "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    full += "resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
    value, hits, _ = ask(copy, full + SMALL, tmp_path)
    assert (hits, ask(copy, SMALL, tmp_path)[0]) == (0, value)


@pytest.mark.slow
def test_an_empty_cache_folder_turns_caching_off(copy):
    value, hits, folder = ask(copy, SMALL, "")
    assert value > 0
    assert (hits, folder) == (0, "None")


@pytest.mark.slow
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


@pytest.mark.parametrize("file", ["units.py", "units.toml", "parameters/rig.py"])
def test_the_hash_follows_what_compiled_code_takes_from_elsewhere(copy, file):
    """The atmosphere's pressure, and the order of a rig's numbers in the records of the laws."""
    source = copy / "sealscope" / file
    source.write_text(source.read_text(encoding="utf-8") + "# edited\n", encoding="utf-8")
    assert source_hash(copy / "sealscope") != source_hash(PACKAGE)


def test_numba_s_own_setting_is_left_as_it_was():
    from sealscope.compiled import kernel

    before = config.CACHE_DIR

    @kernel
    def twice(x: float) -> float:
        return 2.0 * x

    assert twice(2.0) == 4.0
    assert before == config.CACHE_DIR
    assert before == numba.config.CACHE_DIR


def test_threads_that_import_kernels_at_once_cache_them_in_the_user_s_folder(tmp_path, monkeypatch):
    """The setting of one thread was taken back under another's hands: code went to the working directory, and came from
    there."""
    folder = compiled.cache_directory()
    if folder is None:
        pytest.skip("compiled code is not cached here")
    monkeypatch.chdir(tmp_path)

    class Slow(numba_private.TolerantCache):
        def __init__(self, function):
            time.sleep(random.uniform(0.0, 0.01))
            super().__init__(function)

    monkeypatch.setattr(numba_private, "TolerantCache", Slow)
    with ThreadPoolExecutor(4) as threads:
        kernels = list(threads.map(lambda _: compiled.kernel(compiled.source_hash), range(48)))
    assert {Path(kernel._cache.cache_path).parent for kernel in kernels} == {folder}
    assert not list(tmp_path.iterdir())


def test_compiled_division_by_zero_follows_ieee_754():
    from sealscope.physics.cylinder import pressure_rate

    assert compiled.kernel(lambda volume: pressure_rate(1.0, volume, 1.0))(0.0) == float("inf")


def test_a_law_is_the_same_from_python_as_within_compiled_code():
    @compiled.law
    def doubled(x):
        return 2.0 * x

    @numba.njit
    def within(x):
        return doubled(x) + 1.0

    assert within(3.0) == doubled(3.0) + 1.0 == doubled(x=3.0) + 1.0 == 7.0
    assert doubled(np.float32(0.25)) == 0.5  # of another type than within


def test_a_law_returns_no_array_to_which_it_would_count_no_reference():
    @compiled.law
    def same(values):
        return values

    with pytest.raises(TypeError, match="numbers"):
        numba.njit(lambda values: same(values)[0])(np.zeros(2))


def test_garbage_is_collected_again_after_a_compilation():
    @compiled.kernel
    def one():
        return 1

    assert gc.isenabled() and one() == 1 and gc.isenabled()


def test_a_law_that_a_rig_leaves_out_is_not_compiled():
    """What is behind len(p.law) > 0 is not even looked at where the tuple is empty: here it cannot be compiled."""
    numbers = namedtuple("numbers", ("x", "law"))

    @compiled.law
    def broken(x):
        return x.nothing_of_this_name

    @compiled.kernel
    def chosen(p):
        if len(p.law) > 0 or p.x < 0.0:
            return broken(p.x)
        return 2.0 * p.x

    @compiled.kernel
    def guarded(p):
        more = broken(p.x) if len(p.law) > 0 else 0.0
        return p.x + more

    assert guarded(numbers(1.5, ())) == 1.5
    with pytest.raises(TypingError, match="nothing_of_this_name"):
        guarded(numbers(1.5, (True,)))
    with pytest.raises(TypingError, match="nothing_of_this_name"):  # a branch that is not settled is compiled
        chosen(numbers(1.5, ()))


LOADED = """
import sys
import sealscope as ss
recording = ss.simulate(command="3 sin(4t)", duration="10 s", seed=1)
print(float(recording["p_A"].sum()), int("numba.np.linalg" in sys.modules))
"""


@pytest.mark.slow
def test_code_from_the_cache_needs_nothing_that_compiles(tmp_path):
    """What numba declares for a compilation takes longer than the loading of all kernels."""
    environment = {**os.environ, "SEALSCOPE_CACHE_DIR": str(tmp_path / "cache")}
    answers = [
        subprocess.run([sys.executable, "-c", LOADED], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    (first, compiles), (second, compiles_again) = (answer.stdout.split() for answer in answers)
    assert first == second
    assert (compiles, compiles_again) == ("1", "0")
