"""Recordings of every format, to be mutated."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import Recording, inspect, read, write

from ..recordings.exports import EXPORTS
from .mutations import changed_bytes
from .targets import Use

RATE, N = 500.0, 240
T = np.arange(N) / RATE
RECORDING = Recording(
    T,
    {"p_A": 2e5 + 5e4 * np.sin(20 * T), "p_B": 2e5 - 5e4 * np.sin(20 * T), "x": 0.01 * np.sin(20 * T)},
    {"p_A": "Pa", "p_B": "Pa", "x": "m"},
    RATE,
)
#: Longest time that a file may take [s], with the start of a process that reads it; a loop takes for ever.
LONGEST = 45.0


def own(folder: Path, name: str) -> Path:
    write(RECORDING, folder / name)
    return folder / name


def logged(folder: Path) -> Path:
    rows = "".join(f"{t:.3f};{a:.3f};{b:.3f}\n" for t, a, b in zip(T, RECORDING["p_A"], RECORDING["p_B"], strict=True))
    text = "Operator: N. N.\nOil temperature = 41 degC\nTime [s];p_A [Pa];p_B [kPa]\n" + rows
    (folder / "log.txt").write_text(text)
    return folder / "log.txt"


def tdms(folder: Path) -> Path:
    nptdms = pytest.importorskip("nptdms")
    channels = [
        nptdms.ChannelObject("Log", name, RECORDING[name], {"unit_string": unit, "wf_increment": 1 / RATE})
        for name, unit in RECORDING.units.items()
    ]
    with nptdms.TdmsWriter(folder / "log.tdms") as writer:
        writer.write_segment(channels)
    return folder / "log.tdms"


def matlab(folder: Path, version: str) -> Path:
    held = {"t": T, **RECORDING.channels}
    if version == "v7.3":
        matio = pytest.importorskip("matio")
        matio.save_to_mat(folder / "log.mat", {"log": held}, version=version)
    else:
        pytest.importorskip("matio")
        from scipy.io import savemat

        savemat(folder / "log.mat", held if version == "4" else {"log": held}, format=version)
    return folder / "log.mat"


def mdf(folder: Path, version: str) -> Path:
    asammdf = pytest.importorskip("asammdf")
    signals = [asammdf.Signal(RECORDING[name], T, unit=unit, name=name) for name, unit in RECORDING.units.items()]
    with asammdf.MDF(version=version) as file:
        file.append(signals)
        return Path(file.save(folder / "log.mf4", overwrite=True))


def xlsx(folder: Path) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    pytest.importorskip("python_calamine")
    book = openpyxl.Workbook()
    book.active.append(["t [s]", "p_A [Pa]", "p_B [Pa]"])
    for row in zip(T, RECORDING["p_A"], RECORDING["p_B"], strict=True):
        book.active.append([float(value) for value in row])
    book.save(folder / "log.xlsx")
    return folder / "log.xlsx"


def gzipped(folder: Path) -> Path:
    import gzip

    (folder / "log.csv.gz").write_bytes(gzip.compress(own(folder, "log.csv").read_bytes()))
    return folder / "log.csv.gz"


KINDS: dict[str, Callable[[Path], Path]] = {
    "text": logged,
    "own text": lambda folder: own(folder, "log.csv"),
    "NetCDF": lambda folder: own(folder, "log.nc"),
    "Parquet": lambda folder: own(folder, "log.parquet"),
    "TDMS": tdms,
    "MATLAB 4": lambda folder: matlab(folder, "4"),
    "MATLAB 5": lambda folder: matlab(folder, "5"),
    "MATLAB 7.3": lambda folder: matlab(folder, "v7.3"),
    "MDF 3": lambda folder: mdf(folder, "3.30"),
    "MDF 4": lambda folder: mdf(folder, "4.10"),
    "spreadsheet": xlsx,
    "gzip": gzipped,
    **{
        kind: EXPORTS[name].write
        for kind, name in {
            "JSON lines": "JSON lines, value and unit",
            "JSON document": "JSON, array of signals",
            "long table": "long, historian with units",
            "scope": "a clock each, TwinCAT Scope",
            "quantity": "units in cells, quoted decimal commas",
            "channel table": "Graphtec GL",
            "split time": "time, date and hours, minutes, seconds",
        }.items()
    },
}


def mutated(kind: str, folder: Path) -> Use:
    """Read mutations of a file of this kind; an error must name it in one line."""
    path = KINDS[kind](folder)
    whole = path.read_bytes()

    def use(draw: random.Random) -> bool:
        path.write_bytes(changed_bytes(whole, draw))
        begin = time.perf_counter()
        try:
            inspect(read(path))
            return True
        except UnreadableFile as error:
            assert "\n" not in str(error), str(error)
            assert path.name in str(error), str(error)
            return False
        finally:
            assert time.perf_counter() - begin < LONGEST

    return use


RECORDINGS: dict[str, Callable[[Path], Use]] = {f"{kind} files": partial(mutated, kind) for kind in KINDS}
