"""Rigs as files: one TOML a rig, packaged by name or a user's own, which may extend another."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from sealscope.calls import checked_call, closest
from sealscope.errors import InputError
from sealscope.parameters.rig import ParameterEntry, Rig, flatten
from sealscope.storage.opening import names_a_file
from sealscope.storage.toml_file import read_toml

_PACKAGED = Path(__file__).parent / "rigs"
_DEEPEST = 8


def rig_names() -> tuple[str, ...]:
    """Names of the packaged rigs."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


@checked_call
def load_rig(rig: Rig | str | os.PathLike[str] = "thesis") -> Rig:
    """Load the parameters of a rig.

    Parameters
    ----------
    rig : Rig, str or path-like, optional
        Name of a packaged rig (`sealscope parameters` lists one), or path of a TOML file with value, unit and source
        for each parameter; a Rig is returned as it is. A file may say ``[rig] extends = "thesis"`` (or the path of
        another file) and then states only the values that differ.

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
        return _packaged(text)
    if "\0" in text or not _is_path(text):
        raise InputError(
            f"{text!r} is no packaged rig ({', '.join(rig_names())}) and no .toml file{closest(text, rig_names())}"
        )
    return _build(Path(text), text)


@lru_cache(maxsize=32)
def _packaged(name: str) -> Rig:
    return _build(_PACKAGED / f"{name}.toml", f"rigs/{name}.toml")


def _is_path(text: str) -> bool:
    return text.endswith(".toml") or "/" in text or os.sep in text or names_a_file(text)


def _build(path: Path, place: str) -> Rig:
    head, entries = _collect(path, place, ())
    return Rig.from_entries(entries, name=head.get("name", path.stem), title=head.get("title", ""), place=place)


def _collect(path: Path, place: str, seen: tuple[Path, ...]) -> tuple[dict[str, str], dict[str, ParameterEntry]]:
    """Head and entries of a file, on top of those of the rig it extends."""
    here = path.resolve()
    if here in seen or len(seen) >= _DEEPEST:
        raise InputError(f"extends must end at a rig of its own, got a circle or more than {_DEEPEST} files ({place})")
    tree = read_toml(path, "a rig file", place)
    head = tree.pop("rig", {})
    if not isinstance(head, dict):
        raise InputError(f"rig must be a table, got {head!r} ({place})")
    for key, value in head.items():
        if key not in ("name", "title", "extends"):
            raise InputError(f"rig.{key} is not known; [rig] has name, title and extends ({place})")
        if not isinstance(value, str) or not value.strip():
            raise InputError(f"rig.{key} must be a text, got {value!r} ({place})")
    entries: dict[str, ParameterEntry] = {}
    base = head.get("extends")
    if base in rig_names():
        entries = _collect(_PACKAGED / f"{base}.toml", f"rigs/{base}.toml", (*seen, here))[1]
    elif base is not None and "\0" not in base and _is_path(base):
        entries = _collect(path.parent / base, os.fspath(Path(place).parent / base), (*seen, here))[1]
    elif base is not None:
        raise InputError(
            f"extends must be a packaged rig ({', '.join(rig_names())}) or a .toml file, got {base!r} ({place})"
        )
    return head, entries | flatten(tree.items(), place)
