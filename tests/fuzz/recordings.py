"""Recordings of every format, to be mutated."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from sealscope.errors import MissingExtra, UnreadableFile
from sealscope.recordings import Recording, inspect, read, write

from ..recordings.dialects import DIALECTS, FILES, P_A, P_B, RATE, T, pack
from ..recordings.exports import EXPORTS
from .mutations import changed_bytes
from .targets import Use

RECORDING = Recording(T, {"p_A": 1e5 * P_A, "p_B": 1e5 * P_B}, {"p_A": "Pa", "p_B": "Pa"}, RATE)
#: Kind -> the dialect that is mutated.
_DIALECTS = {
    "text": "text, preamble",
    "TDMS": "TDMS, waveform",
    "MATLAB 4": "MATLAB 4",
    "MATLAB 5": "MATLAB 5, struct",
    "MATLAB 7.3": "MATLAB v7.3, struct",
    "MDF 3": "MDF 3.30",
    "MDF 4": "MDF 4.10",
    "LabVIEW": "LabVIEW, packets",
    "spreadsheet": "Excel",
    "JSON lines": "JSON lines, value and unit",
    "JSON document": "JSON, array of signals",
    "long table": "long, historian with units",
    "scope": "a clock each, TwinCAT Scope",
    "quantity": "units in cells, quoted decimal commas",
    "channel table": "Graphtec GL",
    "split time": "time, date and hours, minutes, seconds",
}


def first_word(name: str) -> str:
    return re.split(r"\W", name)[0]


# of each other format the first file in `FILES`
for name in FILES:
    if first_word(name) not in map(first_word, _DIALECTS.values()):
        _DIALECTS[first_word(name)] = name


def dialect(kind: str, folder: Path) -> Path:
    try:
        path = {**DIALECTS, **EXPORTS}[_DIALECTS[kind]].write(folder)
        read(path, **{**DIALECTS, **EXPORTS}[_DIALECTS[kind]].options)
    except (ImportError, MissingExtra) as error:
        pytest.skip(str(error))
    return path


def own(name: str, folder: Path) -> Path:
    write(RECORDING, folder / name)
    return folder / name


KINDS: dict[str, Callable[[Path], Path]] = {
    **{kind: partial(dialect, kind) for kind in _DIALECTS},
    "own text": partial(own, "log.csv"),
    "NetCDF": partial(own, "log.nc"),
    "Parquet": partial(own, "log.parquet"),
    "gzip": lambda folder: pack(own("log.csv", folder).read_bytes(), folder, "gz"),
}


def mutated(kind: str, folder: Path) -> Use:
    """Read mutations of a file of this kind; an error must name it in one line."""
    path = KINDS[kind](folder)
    whole = path.read_bytes()

    def use(draw: random.Random) -> bool:
        path.write_bytes(changed_bytes(whole, draw))
        try:
            inspect(read(path))
            return True
        except UnreadableFile as error:
            assert "\n" not in str(error), str(error)
            assert path.name in str(error), str(error)
            return False

    return use


RECORDINGS: dict[str, Callable[[Path], Use]] = {f"{kind} files": partial(mutated, kind) for kind in KINDS}
