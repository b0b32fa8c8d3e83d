"""Public measured data sets as samples for held-out classifiers; the data are the caller's own copy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sealscope.campaigns.held_out.classifiers import MeasuredSamples
from sealscope.errors import InputError, UnreadableFile

#: Channels of the hydraulic set and their files; the means of each second over cycles of 60 s.
HYDRAULIC = ("PS1", "PS2", "PS3", "PS4", "PS5", "PS6", "EPS1", "FS1", "FS2")
_CYCLES, _SECONDS = 2205, 60


def hydraulic_samples(folder: Path) -> MeasuredSamples:
    """Read the "condition monitoring of hydraulic systems" set: each cycle's mean and standard deviation.

    `folder` holds `profile.txt` and `one_hz_means/NAME_1hz.tsv`. The size of the fault is the grade of internal pump
    leakage (1 or 2), a test is an unbroken block of cycles of one condition, the operating condition the cooler's
    state, which sets the oil's temperature. Raises UnreadableFile for a file that is not there or of another shape.
    Source: Helwig, Pignanelli and Schuetze, I2MTC 2015, doi 10.1109/I2MTC.2015.7151267.
    """
    labels = _table(folder / "profile.txt", 5)
    features = {}
    for name in HYDRAULIC:
        values = _table(folder / "one_hz_means" / f"{name}_1hz.tsv", _SECONDS)
        features[f"mean of {name}"] = values.mean(axis=1)
        features[f"scatter of {name}"] = values.std(axis=1)
    changed = np.any(np.diff(labels[:, :4], axis=0) != 0, axis=1)
    blocks = np.concatenate([[0], np.cumsum(changed)])
    return MeasuredSamples(
        features=features,
        leak_lpm=labels[:, 2],
        tests=[int(block) for block in blocks],
        levels=[{"cooler": f"{state:g} %"} for state in labels[:, 0]],
    )


def _table(path: Path, columns: int) -> np.ndarray:
    try:
        values = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except OSError as error:
        raise UnreadableFile(f"a data set's file must be readable, got: {error.strerror or error} ({path})") from None
    except ValueError as error:
        raise UnreadableFile(f"a data set's file must be a table of numbers, got: {error} ({path})") from None
    if values.shape != (_CYCLES, columns) or not np.all(np.isfinite(values)):
        raise UnreadableFile(f"a data set's file must hold {_CYCLES} x {columns} numbers, got {values.shape} ({path})")
    return values


def needs_folder(folder: Path | None, what: str) -> Path:
    """Return the folder of a data set; raise InputError that says what is needed where it is not given or is none."""
    if folder is None:
        raise InputError(f"the plan needs {what}: give its folder with --data")
    if not folder.is_dir():
        raise InputError(f"--data must be the folder of {what}, got {folder}")
    return folder
