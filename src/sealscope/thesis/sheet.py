"""Appendix C of the thesis: the 41 leakage tests, and the data sheet of their measurements.

The package contains only the inputs of the tests. The measured values are read from two files that a user may have.
"""

from __future__ import annotations

import csv
import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from pathlib import Path

import numpy as np

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES

COLUMNS = tuple(product(CHAMBERS, QUANTITIES))
#: Units of the columns. The sheet states none; psi is assumed.
UNITS = {name: "psi^2" if name == "d3d4" else "psi" for name in QUANTITIES}
#: Name of the rig that was fitted to the leak-free columns of Appendix C.
BENCH_RIG = "thesis-calibrated"
#: File of the measured data sheet for each chamber, and the environment variable that names the folder of both files.
FILES = {"p_A": "appendix_c_pa.csv", "p_B": "appendix_c_pb.csv"}
VARIABLE = "SEALSCOPE_SHEET"
#: Reason for which an item is left out if the sheet is not given.
MISSING = "needs the data sheet: give --sheet"
_HALVES = ("no_leak", "leak")
_POSITIVE_COLUMNS = ("mean_leak_lpm", "input_amplitude_v", "input_omega_rad_s")
_CLOSED_COLUMN, _LEVEL_COLUMN = "orifice_closed_pct", "leakage_level"


@dataclass(frozen=True)
class Condition:
    """The inputs of one leakage test of Appendix C; `number` counts the tests from 1, in the printed order.

    `command`: voltage as text, such as "3 sin(4t)"; `closed_pct`: closing of both throttles [%], 0 if they are open;
    `mean_leak_lpm`: mean leak [L/min] after the bypass valve was opened; `level`: position of the bypass's needle
    valve, such as "large". The level does not determine the leak, which is 10 to 16 mL/min for "large" and 4 to 14 for
    "extra-small".
    """

    number: int
    command: str
    closed_pct: float
    mean_leak_lpm: float
    level: str

    @property
    def group(self) -> tuple[str, float]:
        """Command and closing of both throttles [%]; tests with the same group differ only in the leak."""
        return self.command, self.closed_pct


_, *_LINES = files(__package__).joinpath("appendix_c.csv").read_text(encoding="utf-8").splitlines()


#: The tests of Appendix C of the thesis, in its order.
APPENDIX_C: tuple[Condition, ...] = tuple(
    Condition(number, command, float(closed_pct), float(leak), level)
    for number, (command, closed_pct, leak, level) in enumerate(csv.reader(_LINES), 1)
)
#: The distinct operating conditions (command, closing [%]) of these tests, in order of first appearance.
GROUPS = tuple(dict.fromkeys(condition.group for condition in APPENDIX_C))


def mean_leaks() -> Array:
    """Return the mean leak [L/min] of each test of Appendix C, (tests,)."""
    return np.array([row.mean_leak_lpm for row in APPENDIX_C])


@dataclass(frozen=True, eq=False)
class DataSheet:
    """The data sheet of Appendix C, measured or simulated.

    `rms[chamber][quantity]` (tests, 2): RMS without and with the leak of the wavelet details "d1" .. "d4" [psi] and
    "d3d4" [psi^2], their product, of "p_A" and "p_B". The tests are those of `APPENDIX_C`, in its order; a sheet
    simulated with drifting parameters may have them twice.
    """

    rms: Mapping[str, Mapping[str, Array]]

    @property
    def tests(self) -> int:
        """Number of tests in the data sheet."""
        return len(self.rms["p_A"]["d3"])

    def log_change(self, chamber: str, quantity: str) -> Array:
        """Compute log(RMS with / RMS without the leak) of a wavelet detail, such as "d3", in each test, (tests,)."""
        pairs = self.rms[chamber][quantity]
        return np.asarray(np.log(pairs[:, 1] / pairs[:, 0]))

    def log_ratio(self, other: DataSheet, chamber: str, quantity: str) -> Array:
        """Compute log(RMS / RMS in another sheet) of a wavelet detail without the leak, in each test, (tests,)."""
        return np.asarray(np.log(self.rms[chamber][quantity][:, 0] / other.rms[chamber][quantity][:, 0]))

    def count_same_signs(self, other: DataSheet, chamber: str, quantity: str) -> int:
        """Count the tests in which the RMS of a detail changes with the leak in the same direction in another sheet."""
        changes = (np.sign(sheet.log_change(chamber, quantity)) for sheet in (self, other))
        return int(np.sum(np.equal(*changes)))


def log_change_to_percent(change: Array | float) -> float:
    """Convert a change c of a logarithm, or the mean of several, to the relative change 100 (exp(c) - 1) [%]."""
    return float(100.0 * np.expm1(np.mean(change)))


def find_sheet(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Find the folder of the measured data sheet: `folder`, else that named by SEALSCOPE_SHEET, else `./data` or None.

    Raises InputError if a named folder lacks a file.
    """
    named_folder = folder if folder is not None else os.environ.get(VARIABLE) or None
    candidate = Path(named_folder if named_folder is not None else "data")
    if all((candidate / name).is_file() for name in FILES.values()):
        return candidate
    if named_folder is None:
        return None
    source = "--sheet" if folder is not None else VARIABLE
    raise InputError(f"{source} must name a folder with {' and '.join(FILES.values())}, got {candidate}")


def read_sheet(folder: Path) -> tuple[DataSheet, str]:
    """Read the measured data sheet in `folder`; return it with a SHA-256 digest of its two files.

    Raises UnreadableFile if a file cannot be read, and InputError if a column is missing, a value is no valid number,
    or the rows are not the tests of `APPENDIX_C`.
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
        rms_columns = (f"{quantity}_{half}" for quantity in QUANTITIES for half in _HALVES)
        for column in (*_POSITIVE_COLUMNS, _CLOSED_COLUMN, _LEVEL_COLUMN, *rms_columns):
            if not rows or column not in rows[0]:
                raise InputError(f"the sheet must have the column {column} ({path})")
        if len(rows) != len(APPENDIX_C):
            raise InputError(f"the sheet must have {len(APPENDIX_C)} rows, got {len(rows)} ({path})")
        for row, condition in zip(rows, APPENDIX_C, strict=True):
            _check_condition(row, condition, path)
        numbered = list(enumerate(rows, 1))
        rms[chamber] = {
            name: np.array([[_parse_number(row, f"{name}_{half}", n, path) for half in _HALVES] for n, row in numbered])
            for name in QUANTITIES
        }
    return DataSheet(rms), digest.hexdigest()


def _parse_number(row: dict[str, str], column: str, number: int, path: Path, *, allow_zero: bool = False) -> float:
    """Parse a number of the data sheet; raise InputError unless it is finite and > 0, or 0 if `allow_zero`.

    `number`, `path`: row number and file, for messages.
    """
    try:
        value = float(row[column] or "nan")  # an empty cell is no number > 0
    except ValueError:
        value = math.nan
    if not (0.0 < value < math.inf or (allow_zero and value == 0.0)):
        rule = f"a number {'>=' if allow_zero else '>'} 0"
        raise InputError(f"{column} must be {rule}, got {row[column]!r} ({path}, row {number})")
    return value


def _check_condition(row: dict[str, str], condition: Condition, path: Path) -> None:
    """Check that a row of the data sheet states the same test as `condition`; raise InputError otherwise."""
    leak, amplitude, omega = (_parse_number(row, column, condition.number, path) for column in _POSITIVE_COLUMNS)
    closed = _parse_number(row, _CLOSED_COLUMN, condition.number, path, allow_zero=True)
    command = f"{amplitude:g} sin({'' if omega == 1 else f'{omega:g}'}t)"  # such as "3 sin(4t)"
    row_condition = Condition(condition.number, command, closed, leak, (row[_LEVEL_COLUMN] or "").strip())
    if row_condition != condition:
        expected, actual = (
            f"{test.command!r}, {test.closed_pct:g} % closed, {test.mean_leak_lpm:g} L/min, {test.level}"
            for test in (condition, row_condition)
        )
        raise InputError(f"row {condition.number} must be the test {expected}, got {actual} ({path})")
