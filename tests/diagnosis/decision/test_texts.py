"""Every text of a reason is asked for by some key, and every key that is asked for has a text."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).resolve().parents[3] / "src" / "sealscope" / "diagnosis"
TEXTS: dict[str, dict[str, str]] = tomllib.loads((SOURCE / "decision" / "texts.toml").read_text(encoding="utf-8"))


@cache
def trees() -> list[ast.Module]:
    """The syntax trees of the package."""
    return [ast.parse(path.read_text(encoding="utf-8")) for path in SOURCE.rglob("*.py")]


def calls(name: str) -> Iterator[list[Any]]:
    """Yield the constant arguments of each call of a function."""
    for tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == name:
                yield [argument.value if isinstance(argument, ast.Constant) else None for argument in node.args]


def test_every_key_that_is_asked_for_has_a_text() -> None:
    asked = [(table, key) for table, key, *_ in calls("text_of") if isinstance(table, str) and isinstance(key, str)]
    assert asked
    assert [key for key in asked if key[1] not in TEXTS[key[0]]] == []


def test_every_text_is_asked_for() -> None:
    constants = set()
    for tree in trees():
        constants |= {
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
    unused = {f"{table}.{key}" for table, keys in TEXTS.items() for key in keys if key not in constants}
    made = {f"alarm.conductance_{key}" for key in ("within", "against")}
    assert unused - made == set()


def test_every_remark_has_a_text_and_is_made() -> None:
    """A remark is a key with its values."""
    made = {arguments[0] for arguments in calls("Remark") if isinstance(arguments[0], str)}
    conditional = {"zero too high", "zero too low", "x late", "x early"}
    conditional |= {key for key in TEXTS["remark"] if key.startswith("delay ")}
    conditional.add("channels missing")  # a doubt of the comparison, not of a detector
    assert made | conditional == set(TEXTS["remark"])
