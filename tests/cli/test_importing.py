"""What importing costs: nothing heavy is loaded before it is used."""

from __future__ import annotations

import json
import sys

import pytest

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
        ("import sealscope", set()),
        ("import sealscope; sealscope.Recording, sealscope.read, sealscope.write, dir(sealscope)", set()),
        ("import sealscope.cli", {"typer", "rich", "pydantic"}),
    ],
)
def test_heavy_libraries_wait_until_they_are_used(shell, first, allowed):
    done = shell(sys.executable, "-c", f"{first}; {SHOW}")
    assert (done.status, done.err) == (0, "")
    assert HEAVY & set(json.loads(done.out)) <= allowed
