"""Public data sets: which are known, and their recordings from a folder that the user downloaded.

No data are part of Sealscope, and nothing is fetched. `datasets.toml` holds title, licence, source and the checksum of
each file; a file is read after its checksum is found right.

Examples
--------
>>> import sealscope as ss
>>> for known in ss.datasets.known():
...     print(known.name, known.licence, known.source)
vtnsi-actuator MIT https://github.com/vtnsi/actuator_dataset
zema-hydraulic CC BY 4.0 https://doi.org/10.5281/zenodo.1323611
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Literal, NamedTuple

import numpy as np

from sealscope.calls import checked_call, closest
from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS, Array
from sealscope.recordings.recording import Recording
from sealscope.storage.opening import open_regular, whole
from sealscope.storage.toml_file import read_toml
from sealscope.units import to_si

_CATALOGUE = Path(__file__).with_suffix(".toml")
#: Columns of `profile.txt`, and the length of a cycle [s].
_GRADES = ("cooler_percent", "valve_percent", "pump_leakage", "accumulator_bar", "not_stable")
_CYCLE_S = 60
_SENSORS = tuple(f"PS{number}" for number in range(1, 7))
_CHUNK = 2**20


@dataclass(frozen=True)
class Dataset:
    """A public data set: what it is, whose, and the checksums of its files.

    Parameters
    ----------
    name, title : str
        Name by which it is read, and what it is.
    licence, source, citation : str
        Under which licence, where and as whose work it is published.
    layout : {"strokes", "cycles"}
        A file for each recording, or matrices with a row for each recording.
    about : str
        What one has to know before anything is concluded from it.
    channel_map : mapping of str to str
        Channel -> column or sensor, unless the caller gives another map.
    checksums : mapping of str to str
        File -> SHA-256 in hexadecimal, or ``md5:`` and an MD5.
    labels : mapping of str to mapping
        File -> what is known of its recording.
    rate : float, optional
        Sampling rate [Hz], where the files do not state it.
    """

    name: str
    title: str
    licence: str
    source: str
    citation: str
    layout: Literal["strokes", "cycles"]
    about: str
    channel_map: Mapping[str, str]
    checksums: Mapping[str, str]
    labels: Mapping[str, Mapping[str, str | float]] = field(default_factory=dict)
    rate: float | None = None


class LabelledRecording(NamedTuple):
    """A recording, and beside it what is known of the machine: for evaluation, never for a detector."""

    recording: Recording
    labels: Mapping[str, str | float]


class FolderCheck(NamedTuple):
    """What of a data set lies in a folder.

    `right` and `wrong`: files with and without the stated checksum; `unknown`: with names that have none; `missing`:
    names that are not there.
    """

    right: Mapping[str, Path]
    wrong: Mapping[str, Path]
    unknown: tuple[Path, ...]
    missing: tuple[str, ...]


@cache
def _catalogue() -> Mapping[str, Dataset]:
    tree = read_toml(_CATALOGUE, "the list of data sets", _CATALOGUE.name)
    return {name: _dataset(name, table) for name, table in tree.items()}


def _dataset(name: str, table: Mapping[str, Any]) -> Dataset:
    parts = table["parts"]
    return Dataset(
        name=name,
        channel_map=MappingProxyType(table["channel_map"]),
        checksums=MappingProxyType({file: value for part in parts for file, value in part["files"].items()}),
        labels=MappingProxyType({file: part.get("labels", {}) for part in parts for file in part["files"]}),
        **{key: value for key, value in table.items() if key not in ("parts", "channel_map")},
    )


def known() -> tuple[Dataset, ...]:
    """Return the data sets that are known, by name.

    Returns
    -------
    tuple of Dataset
        Title, licence, source, citation, checksums and what to mind, of each.

    Examples
    --------
    >>> import sealscope as ss
    >>> [(known.name, len(known.checksums)) for known in ss.datasets.known()]
    [('vtnsi-actuator', 239), ('zema-hydraulic', 8)]
    """
    return tuple(_catalogue().values())


def named(dataset: str | Dataset) -> Dataset:
    """Return a data set by its name.

    Parameters
    ----------
    dataset : str or Dataset
        Its name; a `Dataset` is returned as it is.

    Returns
    -------
    Dataset
        The data set.

    Raises
    ------
    InputError
        If there is none of that name.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.datasets.named("zema-hydraulic").licence
    'CC BY 4.0'
    """
    if isinstance(dataset, Dataset):
        return dataset
    if dataset not in _catalogue():
        near = closest(str(dataset), _catalogue())
        raise InputError(f"a data set must be {' or '.join(_catalogue())}, got {dataset!r}{near}")
    return _catalogue()[dataset]


def _has(path: Path, checksum: str) -> bool:
    """Return whether a file has a checksum, its lines ended as they are or, as Git leaves them on Windows, by CR LF."""
    kind, _, digest = checksum.rpartition(":")
    as_it_is, with_newlines = (hashlib.new(kind or "sha256", usedforsecurity=False) for _ in range(2))
    held = b""
    with open_regular(path, "a data set's file") as file:
        while chunk := file.read(_CHUNK):
            as_it_is.update(chunk)
            held += chunk
            last = b"\r" if held.endswith(b"\r") else b""
            with_newlines.update(held[: len(held) - len(last)].replace(b"\r\n", b"\n"))
            held = last
    with_newlines.update(held)
    return digest in (as_it_is.hexdigest(), with_newlines.hexdigest())


def _folder(folder: str | os.PathLike[str]) -> Path:
    path = Path(folder)
    if not path.is_dir():
        raise InputError(f"a data set's folder must be one, got {path}")
    return path


@checked_call
def check(dataset: str | Dataset, folder: str | os.PathLike[str]) -> FolderCheck:
    r"""Compare the files of a folder, and of those within it, with a data set's checksums.

    Parameters
    ----------
    dataset : str or Dataset
        The data set, or its name.
    folder : str or path
        Where it was downloaded to. A blank in a file's name counts as an underscore.

    Returns
    -------
    FolderCheck
        Which files are there with the right checksum, with another, without any that is known, and which are missing.

    Raises
    ------
    InputError
        If there is no such data set or folder, or a file cannot be read.

    Examples
    --------
    >>> import sealscope as ss
    >>> from pathlib import Path
    >>> _ = Path("profile.txt").write_text("3\t100\t0\t130\t1\n")
    >>> checked = ss.datasets.check("zema-hydraulic", ".")
    >>> list(checked.wrong), "data.zip" in checked.missing
    (['profile.txt'], True)
    """
    checksums = named(dataset).checksums
    right: dict[str, Path] = {}
    wrong: dict[str, Path] = {}
    unknown = []
    for path in sorted(own for own in _folder(folder).rglob("*") if own.is_file()):
        name = path.name.replace(" ", "_")
        if name not in checksums:
            unknown.append(path)
        elif name not in right:
            with whole("a data set's file", path):
                (right if _has(path, checksums[name]) else wrong).setdefault(name, path)
    wrong = {name: path for name, path in wrong.items() if name not in right}
    missing = tuple(name for name in checksums if name not in right and name not in wrong)
    return FolderCheck({name: right[name] for name in checksums if name in right}, wrong, tuple(unknown), missing)


@checked_call
def read(
    dataset: str | Dataset,
    folder: str | os.PathLike[str],
    *,
    map: Mapping[str, str] | None = None,
    check_files: bool = True,
) -> Iterator[LabelledRecording]:
    r"""Read the recordings of a data set from a folder, after the checksums of their files.

    Parameters
    ----------
    dataset : str or Dataset
        The data set, or its name.
    folder : str or path
        Where it was downloaded to; what is not there is left out.
    map : mapping of str to str, optional
        Channel -> column or sensor, in place of the data set's own map.
    check_files : bool, default True
        Whether a file must have its checksum; with False, matrices without a known one are read, too.

    Returns
    -------
    iterator of LabelledRecording
        Recording and labels, one after another; the labels are for evaluation alone.

    Raises
    ------
    InputError
        If there is no such data set or folder, the folder holds none of its files, or one has another checksum.
    UnreadableFile
        If a file is not what the data set's layout says.

    Examples
    --------
    The means of each second of two cycles, as a set of one's own in the layout of ``zema-hydraulic``:

    >>> from dataclasses import replace
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import sealscope as ss
    >>> for sensor in ("PS1", "PS2"):
    ...     np.savetxt(f"{sensor}_1hz.tsv", np.full((2, 60), 150.0), delimiter="\t")
    >>> _ = Path("profile.txt").write_text("3\t100\t0\t130\t1\n3\t100\t2\t130\t0\n")
    >>> first, second = ss.datasets.read("zema-hydraulic", ".", check_files=False)
    >>> first.recording
    Recording(p_A [Pa], p_B [Pa]; 60 samples, 1 Hz, 60 s)
    >>> second.labels["pump_leakage"], float(second.recording["p_A"][0])
    (2.0, 15000000.0)
    """
    chosen = named(dataset)
    checked = check(chosen, folder)
    if check_files and checked.wrong:
        name, path = next(iter(checked.wrong.items()))
        raise InputError(
            f"{name} of {chosen.name} must have the checksum {chosen.checksums[name]}, got another: download it anew "
            f"({path})"
        )
    files = {**checked.right, **checked.wrong}
    if not check_files:
        files = {**{path.name: path for path in checked.unknown}, **files}
    channels = dict(chosen.channel_map if map is None else map)
    recordings = _cycles if chosen.layout == "cycles" else _strokes
    return recordings(chosen, files, channels, Path(folder))


def _nothing(dataset: Dataset, folder: Path, *names: str) -> InputError:
    return InputError(
        f"the folder of {dataset.name} must hold {' or '.join(names)}, got none: its files are at {dataset.source} "
        f"({folder})"
    )


def _origin(dataset: Dataset) -> dict[str, str]:
    return {"dataset": dataset.name, "licence": dataset.licence}


def _strokes(
    dataset: Dataset, files: Mapping[str, Path], channels: Mapping[str, str], folder: Path
) -> Iterator[LabelledRecording]:
    """Return the recordings of a set with a file for each; raise InputError where there is none."""
    from sealscope.recordings.files import read as read_file

    names = [name for name in dataset.checksums if name in files]
    if not names:
        raise _nothing(dataset, folder, f"files such as {next(iter(dataset.checksums))}")

    def strokes() -> Iterator[LabelledRecording]:
        for name in names:
            recording = read_file(files[name], map=channels, rate=dataset.rate)
            recording = replace(recording, provenance={**recording.provenance, **_origin(dataset)})
            yield LabelledRecording(recording, MappingProxyType(dict(dataset.labels.get(name, {}))))

    return strokes()


def _cycles(
    dataset: Dataset, files: Mapping[str, Path], channels: Mapping[str, str], folder: Path
) -> Iterator[LabelledRecording]:
    """Return the recordings of a set of matrices, a row of each.

    They are taken from the archive, else from its unpacked files, else from the files of each second's means.
    """
    for channel, sensor in channels.items():
        if CHANNEL_UNITS.get(channel) != "Pa" or sensor not in _SENSORS:
            raise InputError(f"map must map pressures to {_SENSORS[0]}..{_SENSORS[-1]}, got {channel}={sensor}")
    sensors = tuple(channels.values())
    if "data.zip" in files:
        with whole("a data set's archive", files["data.zip"]), zipfile.ZipFile(files["data.zip"]) as archive:
            grades = _matrix(archive.open("profile.txt"), "profile.txt")
            tables = {sensor: _matrix(archive.open(f"{sensor}.txt"), f"{sensor}.txt") for sensor in sensors}
    else:
        ending = ".txt" if all(f"{sensor}.txt" in files for sensor in sensors) else "_1hz.tsv"
        needed = ("profile.txt", *(f"{sensor}{ending}" for sensor in sensors))
        if missing := [name for name in needed if name not in files]:
            raise _nothing(dataset, folder, "data.zip", missing[0])
        opened = (open_regular(files[name], "a data set's file") for name in needed)
        grades, *columns = (_matrix(file, str(files[name])) for file, name in zip(opened, needed, strict=True))
        tables = dict(zip(sensors, columns, strict=True))
    shapes = {table.shape for table in tables.values()}
    rows, samples = next(iter(shapes))
    if len(shapes) > 1 or grades.shape != (rows, len(_GRADES)) or samples % _CYCLE_S:
        raise UnreadableFile(
            f"matrices of {dataset.name} must have a row for each row of profile.txt, {len(_GRADES)} columns there and "
            f"a multiple of {_CYCLE_S} else, got {grades.shape} and {sorted(shapes)} ({folder})"
        )
    rate = samples / _CYCLE_S
    t = np.arange(samples) / rate
    pascals = {channel: to_si(tables[sensor], "bar", "Pa") for channel, sensor in channels.items()}

    def cycles() -> Iterator[LabelledRecording]:
        for row, marks in enumerate(grades):
            recording = Recording(
                t,
                {channel: values[row] for channel, values in pascals.items()},
                dict.fromkeys(pascals, "Pa"),
                rate,
                provenance={"file": f"{dataset.name} cycle {row + 1}", **_origin(dataset)},
                history=(f"channels {', '.join(f'{channel} = {sensor}' for channel, sensor in channels.items())}",),
            )
            yield LabelledRecording(recording, MappingProxyType(dict(zip(_GRADES, map(float, marks), strict=True))))

    return cycles()


def _matrix(file: IO[bytes], place: str) -> Array:
    """Return the numbers of a table without a head, and close its file; raise UnreadableFile for anything else."""
    with file:
        try:
            values = np.loadtxt(file, dtype=np.float64, ndmin=2)
        except ValueError as error:
            raise UnreadableFile(f"a data set's file must be a table of numbers, got: {error} ({place})") from None
    if not (values.size and np.all(np.isfinite(values))):
        raise UnreadableFile(f"a data set's file must hold finite numbers, got {values.shape} ({place})")
    return values
