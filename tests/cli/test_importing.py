"""What importing costs: nothing heavy is loaded before it is used."""

from __future__ import annotations

import json
import sys

import pytest
from scipy.fft import next_fast_len

import sealscope as ss
from sealscope.recordings.quality import fast_length

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


#: What a command loads at most, modules of other packages with it, and packages that it does not need.
BUDGETS = {
    "-h": (380, ("numpy", "scipy")),
    "parameters": (430, ("scipy", "numba")),
    "inspect run.nc": (500, ("scipy", "numba")),
    "convert run.csv run2.nc": (560, ("scipy", "numba", "pandas")),
    "diagnose run.csv": (1200, ("pandas", "sealscope.campaigns", "sealscope.simulation.experiment")),
    "trend . --every 1d": (1280, ("pandas", "sealscope.campaigns")),
    "report run.nc -o page.html": (1280, ("sealscope.campaigns", "sealscope.simulation.experiment")),
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
    return folder


@pytest.mark.parametrize("command", BUDGETS)
def test_a_command_loads_what_it_needs(shell, run_files, command):
    budget, needless = BUDGETS[command]
    words = [str((run_files / word).resolve()) if "." in word else word for word in command.split()]
    done = shell(sys.executable, "-c", COUNT, *words)
    status, modules = json.loads(done.err.splitlines()[-1])
    assert status == 0
    assert [name for name in modules if name in (*needless, *NEVER)] == []
    assert len(modules) <= budget


def test_a_length_is_fast_as_scipy_says():
    for count in (*range(1, 3000), 123_457, 7_654_321):
        assert fast_length(count) == next_fast_len(count, real=True)
