"""The thesis's own data sheet, its Appendix C, read from the two files of it where somebody has them."""

from __future__ import annotations

import csv
import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.recording import Array
from sealscope.thesis.conditions import APPENDIX_C, Condition

FILES = {"p_A": "appendix_c_pa.csv", "p_B": "appendix_c_pb.csv"}
QUANTITIES = ("d1", "d2", "d3", "d4", "d3d4")
VARIABLE = "SEALSCOPE_SHEET"
MISSING = "needs the data sheet: give --sheet"
_CONDITION = ("mean_leak_lpm", "input_amplitude_v", "input_omega_rad_s", "orifice_closed_pct", "leakage_level")


@dataclass(frozen=True, eq=False)
class Sheet:
    """The thesis's own data sheet (its Appendix C), read from the two files of it where they are given.

    `rms[chamber][quantity]`: (41, 2) RMS without and with the leak, chambers "p_A", "p_B", quantities d1..d4, d3d4;
    rows in the order of `conditions.APPENDIX_C`.
    """

    rms: Mapping[str, Mapping[str, Array]]


def find_sheet(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """The folder of the sheet: `folder`, else the environment's SEALSCOPE_SHEET, else `./data` where it lies there.

    Raises InputError where a folder was named that does not hold both files.
    """
    named = folder if folder is not None else os.environ.get(VARIABLE) or None
    found = Path(named) if named is not None else Path("data")
    missing = [name for name in FILES.values() if not (found / name).is_file()]
    if not missing:
        return found
    if named is None:
        return None
    place = "--sheet" if folder is not None else VARIABLE
    raise InputError(f"{place} must name a folder with {' and '.join(FILES.values())}, got {found}")


def read_sheet(folder: Path) -> tuple[Sheet, str]:
    """The sheet in `folder`, and a hash of its bytes.

    Raises UnreadableFile where a file cannot be read, InputError where a column or a row is missing, a value is not a
    positive number, or a row is not the test that stands in `conditions.APPENDIX_C`.
    """
    rms: dict[str, dict[str, Array]] = {}
    digest = hashlib.sha256()
    for chamber, name in FILES.items():
        path = folder / name
        try:
            raw = path.read_bytes()
            rows = list(csv.DictReader(raw.decode("utf-8-sig").splitlines()))
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise UnreadableFile(f"a sheet must be a CSV file in UTF-8, got: {error} ({path})") from None
        digest.update(raw)
        wanted = (*_CONDITION, *(f"{quantity}_{when}" for quantity in QUANTITIES for when in ("no_leak", "leak")))
        missing = [column for column in wanted if not rows or column not in rows[0]]
        if missing:
            raise InputError(f"the sheet must have the column {missing[0]} ({path})")
        if len(rows) != len(APPENDIX_C):
            raise InputError(f"the sheet must have {len(APPENDIX_C)} rows, got {len(rows)} ({path})")
        for row, condition in zip(rows, APPENDIX_C, strict=True):
            _check(row, condition, path)
        rms[chamber] = {
            quantity: np.array([[_positive(row, f"{quantity}_{w}", n, path) for w in ("no_leak", "leak")]
                                for n, row in enumerate(rows, 1)])
            for quantity in QUANTITIES
        }  # fmt: skip
    return Sheet(rms), digest.hexdigest()


def _positive(row: dict[str, str], column: str, number: int, path: Path) -> float:
    text = row[column]
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{column} must be a number > 0, got {text!r} ({path}, row {number})")
    return value


def _check(row: dict[str, str], condition: Condition, path: Path) -> None:
    """Refuse a row that is another test than the one expected at its place."""
    values = [_positive(row, column, condition.number, path) for column in _CONDITION[:3]]
    leak, amplitude, omega = values
    try:
        closed = float(row["orifice_closed_pct"])
    except (TypeError, ValueError):
        closed = math.nan
    command = f"{amplitude:g} sin({'' if omega == 1 else f'{omega:g}'}t)"
    given = (command, closed, leak, (row["leakage_level"] or "").strip())
    expected = (condition.command, condition.closed_pct, condition.mean_leak_lpm, condition.level)
    if given != expected:
        raise InputError(f"row {condition.number} must be the test {_words(expected)}, got {_words(given)} ({path})")


def _words(test: tuple[str, float, float, str]) -> str:
    command, closed, leak, level = test
    return f"{command!r}, {closed:g} % closed, {leak:g} L/min, {level}"
