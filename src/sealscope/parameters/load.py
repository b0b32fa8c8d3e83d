"""Load rigs from TOML files: packaged ones by their names, and a user's own, each of which may extend another."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from sealscope.calls import checked_call, suggestion
from sealscope.errors import InputError
from sealscope.parameters.rig import ParameterEntry, Rig, flatten_entries
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import is_file_path
from sealscope.storage.toml_file import read_toml

_PACKAGED = Path(__file__).parent / "rigs"
_MAX_LAYERS = 8
_MAP = "[map]"
#: Tables in the file of a commissioned machine in addition to its rig.
MACHINE_TABLES = ("machine", "learnt", "healthy", "alarms")


def rig_names() -> tuple[str, ...]:
    """List the names of the packaged rigs."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


@checked_call
def rigs() -> tuple[str, ...]:
    """Return the names of the packaged rigs, which `load_rig` loads.

    Returns
    -------
    tuple of str
        In alphabetical order.

    Examples
    --------
    >>> import sealscope as ss
    >>> "thesis" in ss.rigs()
    True
    """
    return rig_names()


@checked_call
def load_rig(rig: Rig | str | os.PathLike[str] = "thesis") -> Rig:
    """Load the parameters of a rig.

    Parameters
    ----------
    rig : Rig, str or path-like, optional
        Name of a packaged rig, or path of a TOML file with value, unit and source for each parameter; a Rig is
        returned as it is. The command `sealscope parameters NAME` prints the parameters of a rig. A file may say
        ``[rig] extends = "thesis"`` (or the path of another file) and then states only the values that differ. A
        table ``[map]`` names the columns of the machine's logs (``p_A = "PG_1[psi]"``). The file that commissioning
        writes for a machine can be loaded, too, if it states an area.

    Returns
    -------
    Rig
        The parameters, immutable, in SI units.

    Raises
    ------
    InputError
        The file cannot be read, a name is unknown, or a value has no source, a wrong unit or is out of its range.

    Examples
    --------
    >>> import sealscope as ss
    >>> rig = ss.load_rig("thesis")
    >>> rig["cylinder.L"]
    0.6
    >>> ss.load_rig(rig) is rig
    True
    """
    if isinstance(rig, Rig):
        return rig
    if not isinstance(rig, str | os.PathLike):
        raise InputError(f"rig must be a Rig, the name of a rig or a path, got {rig!r}")
    text = os.fspath(rig)
    if text in rig_names():
        return _load_packaged(text)
    if "\0" in text or not _is_path(text):
        raise InputError(
            f"{text!r} is no packaged rig ({', '.join(rig_names())}) and no .toml file{suggestion(text, rig_names())}"
        )
    return _load_file(Path(text), text)


@lru_cache(maxsize=32)
def _load_packaged(name: str) -> Rig:
    """Load a packaged rig by its name; later calls return the same object."""
    return _load_file(_PACKAGED / f"{name}.toml", f"rigs/{name}.toml")


def _is_path(text: str) -> bool:
    """Test whether a text is a rig file's path: it ends in .toml, contains a slash, or names an existing file."""
    return text.endswith(".toml") or "/" in text or os.sep in text or is_file_path(text)


def _load_file(path: Path, place: str) -> Rig:
    """Load a rig from its file, called `place` in messages, and from the files that this one extends."""
    rig_table, entries, columns = _read_layers(path, place, visited=())
    name, title = rig_table.get("name", path.stem), rig_table.get("title", "")
    rig = Rig.from_entries(entries, name=name, title=title, place=place)
    return rig.with_channel_map(columns) if columns else rig


def save_channel_map(path: str | os.PathLike[str], columns: Mapping[str, str]) -> None:
    """Write the map `columns`, channel -> column, into a rig's file as its table `[map]`, in place of an earlier one.

    Raises InputError if `path` is not the file of a rig or cannot be written; the file is then unchanged.
    """
    if os.fspath(path) in rig_names():
        raise InputError(f"a map must be saved in your own rig's file (.toml), got the packaged rig {path}")
    file = Path(path)
    load_rig(file)  # raises if this is not a rig's file
    lines = file.read_text(encoding="utf-8-sig").splitlines()
    map_lines = [number for number, line in enumerate(lines) if line.strip() == _MAP]
    if map_lines:  # delete the table up to the heading of the next one
        start = map_lines[0]
        end = next((k for k in range(start + 1, len(lines)) if lines[k].lstrip().startswith("[")), len(lines))
        del lines[start:end]
    while lines and not lines[-1].strip():
        lines.pop()
    table = [f"{json.dumps(channel)} = {json.dumps(column)}" for channel, column in columns.items()]
    with atomic_write(file) as temporary:
        temporary.write_text("\n".join([*lines, "", _MAP, *table]) + "\n", encoding="utf-8")
        _read_layers(temporary, os.fspath(path), visited=())  # raises if the result is not a rig's file


def _read_layers(
    path: Path, place: str, visited: tuple[Path, ...]
) -> tuple[dict[str, str], dict[str, ParameterEntry], dict[str, str]]:
    """Read a rig's file together with the files that it extends.

    Returns its table `[rig]`, the parameters by dotted name, and the map from channel to column of the machine's logs.
    A parameter of the file replaces that of an extended file, and a table `[map]` that is not empty the whole map. The
    tables `MACHINE_TABLES` of a commissioned machine are left out. `place`: name of the file in messages; `visited`:
    the files that extend it, directly or indirectly. Raises InputError for a wrong table or key, and for files that
    extend each other in a circle, or more than `_MAX_LAYERS` deep.
    """
    file = path.resolve()
    if file in visited or len(visited) >= _MAX_LAYERS:
        raise InputError(
            f"extends must lead to a file that extends none, got a circle or more than {_MAX_LAYERS} files ({place})"
        )
    tree = read_toml(path, "a rig file", place)
    if "machine" in tree:
        tree = {name: table for name, table in tree.items() if name not in MACHINE_TABLES}
        if not set(tree) - {"map"}:  # no tables of a rig: neither a rig nor sizes were stated at commissioning
            raise InputError(f"a machine's file must state an area to be a rig, got none: commission it anew ({place})")
    rig_table = tree.pop("rig", {})
    if not isinstance(rig_table, dict):
        raise InputError(f"rig must be a table, got {rig_table!r} ({place})")
    for key, value in rig_table.items():
        if key not in ("name", "title", "extends"):
            raise InputError(f"rig.{key} is not known; [rig] has name, title and extends ({place})")
        if not isinstance(value, str) or not value.strip():
            raise InputError(f"rig.{key} must be a text, got {value!r} ({place})")
    channel_map = tree.pop("map", {})
    if not isinstance(channel_map, dict) or not all(
        isinstance(column, str) and column.strip() for column in channel_map.values()
    ):
        raise InputError(
            f"map must be a table of channels and the names of their columns, got {channel_map!r:.80} ({place})"
        )
    entries: dict[str, ParameterEntry] = {}
    columns: dict[str, str] = {}
    base = rig_table.get("extends")
    if base in rig_names():
        _, entries, columns = _read_layers(_PACKAGED / f"{base}.toml", f"rigs/{base}.toml", (*visited, file))
    elif base is not None and "\0" not in base and _is_path(base):
        _, entries, columns = _read_layers(path.parent / base, os.fspath(Path(place).parent / base), (*visited, file))
    elif base is not None:
        raise InputError(
            f"extends must be a packaged rig ({', '.join(rig_names())}) or a .toml file, got {base!r} ({place})"
        )
    return rig_table, entries | flatten_entries(tree.items(), place), channel_map or columns
