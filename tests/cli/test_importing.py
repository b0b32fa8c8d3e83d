"""What importing costs: nothing heavy is loaded before it is used."""

from __future__ import annotations

import json
import sys

import pytest
from scipy.fft import next_fast_len

import sealscope as ss
from sealscope.recordings.quality import fast_length

from ..representatives import OTHERS

HEAVY = {
    "numba",
    "scipy",
    "pywt",
    "xarray",
    "pandas",
    "pydantic",
    "pint",
    "typer",
    "rich",
    "h5py",
    "h5netcdf",
    "pyarrow",
    "sklearn",
}
SHOW = "import json, sys; print(json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"


@pytest.mark.parametrize(
    ("first", "allowed"),
    [
        ("import sealscope; sealscope.Recording, sealscope.read, sealscope.write, dir(sealscope)", set()),
        ("import sealscope.cli", {"typer", "rich", "pydantic"}),
    ],
)
def test_heavy_libraries_wait_until_they_are_used(shell, first, allowed):
    done = shell(sys.executable, "-c", f"{first}; {SHOW}")
    assert (done.status, done.err) == (0, "")
    assert HEAVY & set(json.loads(done.out)) <= allowed


#: Libraries that take a fifth of a second each, and that no recording without gaps needs.
SLOW = ("pandas", "scipy.optimize", "scipy.interpolate", "scipy.sparse", "scipy.stats")
#: What a command loads at most, modules of other packages with it, and packages that it does not need.
BUDGETS = {
    "-h": (370, ("numpy", "scipy")),
    "parameters": (415, ("scipy", "numba")),
    "inspect run.nc": (485, ("scipy", "numba")),
    "convert run.csv run2.nc": (530, ("scipy", "numba", "pandas")),
    "diagnose run.csv": (1015, (*SLOW, "sealscope.campaigns", "sealscope.simulation.experiment")),
    "trend . --every 1d": (1105, (*SLOW, "sealscope.campaigns")),
    "report run.nc -o page.html": (1045, (*SLOW, "sealscope.campaigns", "sealscope.simulation.experiment")),
}
NEVER = ("sealscope.thesis", "sealscope.monitor", "sealscope.fmu", "pint", "xarray", "sklearn", "matplotlib", "dask")
COUNT = """
import json, sys
from sealscope.cli.app import main
sys.argv = ["sealscope", *sys.argv[1:]]
try:
    main()
except SystemExit as ended:
    print(json.dumps([ended.code, sorted(sys.modules)]), file=sys.stderr)
"""


@pytest.fixture(scope="module")
def run_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    recording = ss.simulate(duration="10 s", seed=1)
    for name in ("run.nc", "run.csv"):
        ss.write(recording, folder / name)
    ss.diagnose(ss.read(folder / "run.csv"))  # compiled before: the compiler is not counted
    return folder


#: Commands that load what another one here loads, and little else: they are slow.
SIMILAR = ("inspect run.nc", "trend . --every 1d", "diagnose run.csv")
#: ... and by hand alone.
ALIKE = ("parameters", "convert run.csv run2.nc", "report run.nc -o page.html")


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(words, marks=OTHERS if words in ALIKE else pytest.mark.slow if words in SIMILAR else ())
        for words in BUDGETS
    ],
)
def test_a_command_loads_what_it_needs(shell, run_files, command):
    budget, needless = BUDGETS[command]
    words = [str((run_files / word).resolve()) if "." in word else word for word in command.split()]

    def run() -> tuple[int, list[str]]:
        status, modules = json.loads(shell(sys.executable, "-c", COUNT, *words).err.splitlines()[-1])
        return status, modules

    status, modules = run()
    if len(modules) > budget:  # to compile what is not in the cache yet loads more of numba
        status, modules = run()
    assert status == 0
    assert [name for name in modules if name in (*needless, *NEVER)] == []
    assert len(modules) <= budget


@pytest.mark.slow
def test_a_length_is_fast_as_scipy_says():
    for count in (*range(1, 3000), 123_457, 7_654_321):
        assert fast_length(count) == next_fast_len(count, real=True)
