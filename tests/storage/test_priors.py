"""Typed tables of `priors.toml`: each package's loads, and a wrong file is refused by file, table, key and rule."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import import_module
from importlib.resources import files
from inspect import getsource
from pathlib import Path
from types import ModuleType
from typing import Literal, get_type_hints

import pytest

from sealscope.errors import InputError
from sealscope.storage.toml_file import PriorTable, read_priors

#: Package with a `priors.toml` -> the module of its tables.
TABLES = {
    "sealscope.recordings": "sealscope.recordings.priors",
    **{
        f"sealscope.diagnosis.{name}": f"sealscope.diagnosis.priors.{name.split('.')[-1]}"
        for name in ("commissioned", "decision", "inference", "live", "rms_change", "trend", "verdict")
    },
    "sealscope.diagnosis.inference.changes": "sealscope.diagnosis.priors.changes",
    "sealscope.diagnosis.inference.pressures": "sealscope.diagnosis.priors.pressures",
}


class Zeros(PriorTable):
    pressure: float
    count: int
    odds: float = 0.5


class Tables(PriorTable):
    zero: Zeros
    widths: Mapping[Literal["gain"], tuple[float, float]]


GOOD = {
    "[zero]": "",
    "pressure": '{ value = 2, unit = "Pa", source = "assumed" }',
    "count": '{ value = 3, unit = "1", source = "assumed" }',
    "[widths]": "",
    "gain": '{ value = [1, 0.5], unit = "1", source = "assumed" }',
}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "machines"
    folder.mkdir()
    (folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(__import__("sys").modules, "machines", raising=False)
    return folder


def tables_of(folder: Path, rows: Mapping[str, str]) -> Tables:
    lines = [f"{key} = {row}" if row else key for key, row in rows.items()]
    (folder / "priors.toml").write_text("\n".join(lines), encoding="utf-8")
    return read_priors("machines", Tables)


def test_tables_have_the_stated_types(package: Path) -> None:
    tables = tables_of(package, GOOD)
    assert (tables.zero.pressure, tables.zero.count, tables.zero.odds) == (2.0, 3, 0.5)
    assert dict(tables.widths) == {"gain": (1.0, 0.5)}
    assert isinstance(tables.zero.pressure, float)
    with pytest.raises(TypeError):
        tables.widths["gain"] = (1.0, 1.0)  # type: ignore[index]
    with pytest.raises(AttributeError):
        tables.zero.pressure = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("key", "row", "named"),
    [
        ("pressure", '{ value = "2", unit = "Pa", source = "assumed" }', "[zero] pressure"),
        ("pressure", "{ value = 2 }", "[zero] pressure"),
        ("count", '{ value = 3.5, unit = "1", source = "assumed" }', "[zero] count"),
        ("count", '{ value = true, unit = "1", source = "assumed" }', "[zero] count"),
        ("gain", '{ value = [1], unit = "1", source = "assumed" }', "[widths] gain"),
        ("offset", GOOD["gain"], "'offset'"),
        ("[colours]", "", "'colours'"),
    ],
)
def test_a_wrong_row_is_named(package: Path, key: str, row: str, named: str) -> None:
    with pytest.raises(InputError) as raised:
        tables_of(package, GOOD | {key: row})
    assert "machines/priors.toml" in str(raised.value)
    assert named in str(raised.value)


@pytest.mark.parametrize("key", ["pressure", "gain"])
def test_a_missing_row_is_named(package: Path, key: str) -> None:
    with pytest.raises(InputError, match=repr(key)):
        tables_of(package, {name: row for name, row in GOOD.items() if name != key})


def kinds_of(module: ModuleType) -> dict[str, type]:
    """Return the class of each table that is no mapping."""
    root = next(value for value in vars(module).values() if isinstance(value, PriorTable))
    kinds = get_type_hints(type(root))
    return {name: kind for name, kind in kinds.items() if isinstance(kind, type)}


@pytest.mark.parametrize("package", TABLES)
def test_docstrings_and_comments_state_the_units_of_the_file(package: str) -> None:
    kinds = kinds_of(import_module(TABLES[package]))
    tables = tomllib.loads((files(package) / "priors.toml").read_text("utf-8"))
    for table, kind in kinds.items():
        text = " ".join(getsource(kind).split())
        for name, row in tables[table].items():
            assert row["unit"] == "1" or row["unit"] in text, f"[{table}] {name}: {row['unit']}"
