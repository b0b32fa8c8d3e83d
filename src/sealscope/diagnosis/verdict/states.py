"""States of a machine by NAMUR NE 107, for a recording or a watched actuator.

The tables are in `states.toml`: the states, the conditions that lead to them, the causes, and what is to be done.

Source: NAMUR NE 107 (2017); its states in OPC UA: OPC 10000-100, DeviceHealthEnumeration, used by OPC 10000-110.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from typing import Any

from sealscope.diagnosis.verdict.evidence import LEAK

#: Conditions of a machine that leaks past piston or pump. Their state is the same for all causes of the leak.
LEAK_OVER_LIMIT = "leak over the limit"
LEAKING = LEAK, LEAK_OVER_LIMIT


@dataclass(frozen=True, kw_only=True)
class MachineState:
    """State of a machine by NAMUR NE 107, from `states.toml`.

    - `name`, `symbol`: the state, such as "maintenance required", and the letter that NE 107 gives it, such as "M".
    - `health`: number of the state in OPC UA's DeviceHealthEnumeration.
    - `severity`: severity of an OPC UA event for the state, 1 to 1000; 0 for good.
    - `condition`: condition that led to the state, such as "leak" or "no data".
    - `since_s`: time at which the state began, on the clock of the samples [s]; None if unknown.
    - `cause`, `action`: cause of the change, None if no cause is known, and the action to take.
    """

    name: str
    symbol: str
    health: int
    severity: int
    condition: str
    since_s: float | None
    cause: str | None
    action: str

    def as_dict(self) -> dict[str, Any]:
        """Return the fields of the state by name, as plain values for JSON."""
        return {**vars(self)}


@cache
def _tables() -> Mapping[str, Mapping[str, Any]]:
    """Read the tables of `states.toml`, by their names; the result is cached."""
    return tomllib.loads((files("sealscope.diagnosis.verdict") / "states.toml").read_text("utf-8"))


@lru_cache(maxsize=1024)
def state_of(
    condition: str, cause: str | None = None, *, since_s: float | None = None, action: str | None = None
) -> MachineState:
    """Return the state of a machine for a condition of `states.toml`; raise KeyError for an unknown condition.

    State and action are those of the condition or, if `states.toml` lists the `cause` of the change, those of the
    cause; with a leak past piston or pump (`LEAKING`) only the condition gives the state. `since_s`: time at which the
    state began [s]; `action`: replaces that of `states.toml`.
    """
    tables = _tables()
    name = tables["conditions"][condition]["state"]
    if condition not in LEAKING:
        name = tables["causes"].get(cause or "", {}).get("state", name)
    action = action or action_of(condition, cause)
    return MachineState(
        name=name, **tables["states"][name], condition=condition, since_s=since_s, cause=cause, action=action
    )


def find_separation(cause: str) -> str | None:
    """Return the text of `states.toml` that tells how to distinguish a cause from a leak; None if there is no text."""
    text: str | None = _tables()["causes"].get(cause, {}).get("separates")
    return text


@cache
def joint_causes() -> Mapping[str, tuple[str, ...]]:
    """Return groups of causes that some data cannot separate, by the joint name of each group in `states.toml`.

    For example, "external leak or sensor fault" is the joint name of "external leak" and "sensor fault".
    """
    return {name: tuple(row["joins"]) for name, row in _tables()["causes"].items() if "joins" in row}


def action_of(condition: str, cause: str | None = None, parts: Sequence[str] = ()) -> str:
    """Return the action of `states.toml` for the cause of a change; without a listed cause, that for the condition.

    For a leak past piston or pump, the text begins with the checks of `parts`, components whose leakage may be mistaken
    for that of a worn seal, such as "bypass". Raises KeyError for an unknown condition or, with such a leak, part.
    """
    tables = _tables()
    row = tables["causes"].get(cause or "", tables["conditions"][condition])
    action: str = row["action"]
    part_checks = [str(tables["parts"][part]) for part in parts] if condition in LEAKING else []
    return " ".join([*part_checks, action])
