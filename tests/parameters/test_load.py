"""Rigs from files: extension, and what does not load."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

import sealscope as ss
import sealscope.parameters
from sealscope.errors import InputError
from sealscope.parameters import load_rig

from ..refusals import mentions, refusal

THESIS = (Path(sealscope.parameters.__file__).parent / "rigs" / "thesis.toml").read_text(encoding="utf-8")
EXTENDS = '[rig]\nextends = "thesis"\n'
GOOD = 'V_1 = { value = 50, unit = "cm^3", source = "measured" }\n'

PACKAGED = "servo-valve, single-rod-eha, thesis, thesis-calibrated, thesis-closed-loop"


def write(folder: Path, text: str, name: str = "lab.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def refused(path: Path | str) -> str:
    with pytest.raises(InputError) as caught:
        load_rig(path)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_a_whole_file_of_its_own(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, THESIS.replace('name = "thesis"', 'name = "copy"')))
    assert rig == load_rig("thesis")
    assert rig.name == "copy"


def test_extending_overrides_some_values_and_keeps_the_other_sources(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, EXTENDS + "[line]\n" + GOOD))
    assert rig.line.V_1 == 5e-5
    assert rig.name == "lab"
    assert rig.entry("V_1").source == "measured"
    assert rig.entry("V_2") == load_rig("thesis").entry("V_2")
    changed = [row.name for row in rig.table() if row not in load_rig("thesis").table()]
    assert changed == ["line.V_1"]


def test_extending_a_file_beside_it(tmp_path: Path) -> None:
    write(tmp_path, EXTENDS + "[line]\n" + GOOD, "base.toml")
    other = '[rig]\nextends = "base.toml"\n[cylinder]\nM_eq = { value = 20, unit = "kg", source = "scales" }\n'
    rig = load_rig(str(write(tmp_path, other)))
    assert (rig.line.V_1, rig.cylinder.M_eq, rig.motor.R_c) == (5e-5, 20.0, 0.73)


def test_byte_order_mark_is_no_obstacle(tmp_path: Path) -> None:
    path = tmp_path / "bom.toml"
    path.write_bytes(b"\xef\xbb\xbf" + THESIS.encode())
    assert load_rig(path) == load_rig("thesis")


@pytest.mark.parametrize(
    ("entry", "names"),
    [
        ('V_1 = { value = 50, unit = "cm^3" }', "V_1, source"),
        ('V_1 = { value = 50, unit = "cm^3", source = "  " }', "V_1, source"),
        ('V_1 = { value = 50, unit = "cm^3", source = 3 }', "source, V_1, 3"),
        ('V_1 = { value = 50, source = "x" }', "V_1, unit"),
        ('V_1 = { unit = "cm^3", source = "x" }', "V_1, value"),
        ('V_1 = { value = 50, unit = "cm^3", source = "x", note = "y" }',
         "V_1, note"),
        ('V_1 = { value = "50", unit = "cm^3", source = "x" }', "V_1, '50'"),
        ('V_1 = { value = true, unit = "cm^3", source = "x" }', "V_1, True"),
        ('V_1 = { value = nan, unit = "cm^3", source = "x" }', "V_1, nan"),
        ('V_1 = { value = 1e308, unit = "Gm^3", source = "x" }', "V_1, 1e+308"),
        ('V_1 = { value = -3.0, unit = "m^3", source = "x" }', "V_1, -3.0"),
        ('V_1 = { value = 3, unit = "kg", source = "x" }', "V_1, kg"),
        ('V_1 = 3', "V_1, 3"),
        ('V1 = { value = 3, unit = "m^3", source = "x" }', "line.V1, line.V_1"),
        ('V1 = 3', "line.V1, line.V_1"),
        ('metering = { value = "meter-in", source = "x" }',
         "metering, 'meter-in'"),
        ('metering = { value = "literal", unit = "m", source = "x" }',
         "metering, 'm'"),
    ],
)  # fmt: skip
def test_a_bad_entry_is_told_with_its_file(tmp_path: Path, entry: str, names: str) -> None:
    path = write(tmp_path, EXTENDS + "[line]\n" + entry + "\n")
    assert mentions(refused(path), path, *names.split(", "))


@pytest.mark.parametrize("key", ["value", "unit", "source"])
def test_no_entry_of_a_whole_rig_can_do_without(tmp_path: Path, key: str) -> None:
    line = next(line for line in THESIS.splitlines() if line.startswith("R_c"))
    cut = {"value": "value = 0.73, ", "unit": 'unit = "ohm", '}.get(key) or ", source" + line.split(", source")[1][:-2]
    assert f"R_c must have a {key}, " in refused(write(tmp_path, THESIS.replace(line, line.replace(cut, ""))))


def test_a_missing_parameter_is_named(tmp_path: Path) -> None:
    line = next(line for line in THESIS.splitlines(keepends=True) if line.startswith("C_d"))
    path = write(tmp_path, THESIS.replace(line, ""))
    assert refused(path) == f"line.C_d is missing ({path})"
    assert refused(write(tmp_path, "")) == f"a rig file must hold data, got an empty file ({path})"


def test_a_rule_across_values_names_the_file_that_was_asked_for(tmp_path: Path) -> None:
    entry = (
        '[cylinder]\nvolumes = { value = "position", source = "x" }\nL = { value = 0.8, unit = "m", source = "x" }\n'
    )
    path = write(tmp_path, EXTENDS + entry)
    text = refused(path)
    assert text.startswith('cylinder.V must be > A_A L/2 = 0.0002532 m^3 when volumes = "position", got 0.000234')
    assert text.endswith(f"({path})")


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("[rig", "a rig file must be TOML: "),
        ("[line]\n" + GOOD + GOOD, "a rig file must be TOML: "),
        ('rig = "x"', "rig must be a table, got 'x'"),
        ('[rig]\nextend = "thesis"', "rig.extend is not known; [rig] has name, title and extends"),
        ("[rig]\nname = 3", "rig.name must be a text, got 3"),
        (
            '[rig]\nextends = "thesys"',
            f"extends must be a packaged rig ({PACKAGED}) or a .toml file, got 'thesys'",
        ),
        ('[rig]\nextends = "lab.toml"', "extends must lead to a file that extends none, got a circle"),
        (
            '[rig]\nextends = "a\\u0000b.toml"',
            f"extends must be a packaged rig ({PACKAGED}) or a .toml file, got ",
        ),
        ('[rig]\nextends = "none.toml"', "a rig file must be readable, got: No such file or directory"),
        ("[valve]\nk = 3", "valve.k is not a parameter"),
        ("a = " + "[" * 5000, "a rig file must be TOML: "),
    ],
)
def test_a_bad_file(tmp_path: Path, text: str, rule: str) -> None:
    assert refused(write(tmp_path, text)).startswith(rule)


def test_what_is_no_text_file(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\x89HDF\r\n\x1a\n\xff")
    assert refused(binary) == f"a rig file must be UTF-8 text, got byte 0x89 ({binary})"
    sparse = tmp_path / "sparse.toml"
    with sparse.open("wb") as file:
        file.truncate(2_000_000_000)
    assert refused(sparse) == f"a rig file must be at most 1000000 bytes, got more ({sparse})"
    assert "rig file must be readable, got: " in refused(tmp_path / "none.toml")
    folder = tmp_path / "folder.toml"
    folder.mkdir()
    assert refused(folder) == f"a rig file must be a file, got a folder ({folder})"


def test_an_unknown_name_lists_the_rigs() -> None:
    assert refused("thesys") == f"'thesys' is no packaged rig ({PACKAGED}) and no .toml file; did you mean thesis?"
    assert refused("").startswith("'' is no packaged rig")
    assert "is no packaged rig" in refused("a\0b.toml")


def test_a_rig_is_its_own_rig_and_another_type_is_refused():
    rig = load_rig("thesis")
    assert load_rig(rig) is rig
    with refusal("rig", "5"):
        load_rig(5)
    with refusal("load_rig", "'rg'", "'rig'"):
        load_rig(rg="thesis")


HEAVY = {
    "tables": "".join(f"[a{k}]\n" for k in range(25_000)),
    "rows": "[[healthy]]\n" * 20_000,
    "empty lists": "a = [" + "[]," * 75_000 + "]\n",
    "keys": "".join(f"k{k}=1\n" for k in range(22_500)),
    "dots": "".join(f"a.b{k}.c.d.e=1\n" for k in range(12_500)),
    "inline tables": "".join(f"k{k}={{a.b.c=1}}\n" for k in range(12_500)),
    "a long text": f'a = "{"x" * 250_000}"\n',
    "blanks in brackets": "[" + " " * 225_000 + "\n",
}


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=[pytest.mark.slow, pytest.mark.long])
        if kind in ("keys", "a long text", "dots", "inline tables")
        else kind
        for kind in HEAVY
    ],
)
@pytest.mark.parametrize(
    "load", [ss.load_rig, pytest.param(ss.read_machine, marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_a_hostile_file_takes_less_than_ten_times_its_size_in_memory(tmp_path: Path, kind: str, load) -> None:
    """The first error ends it, and what would become many objects is refused before it is parsed."""
    path = write(tmp_path, HEAVY[kind])
    with pytest.raises(InputError):  # what is imported once is not counted
        load(path)
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            load(path)
        assert tracemalloc.get_traced_memory()[1] < 10 * len(HEAVY[kind])
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("load", [ss.load_rig, ss.read_machine])
def test_rigs_and_machines_have_one_limit(tmp_path: Path, load) -> None:
    with refusal("1000000 bytes"):
        load(write(tmp_path, "#" * 1_000_001))
