"""The cases of a plan: each one record, with a name and a seed that derive from what it is."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.campaigns.plan import Plan, Use

#: Files of this room, and rooms, whose sources a record and its scores depend on.
_OWN = ("cases", "machines", "work", "entries", "statement", "batches", "short_runs")
_ROOMS = ("parameters", "physics", "signals", "simulation", "diagnosis")


@dataclass(frozen=True)
class Case:
    """One record to make and judge; `id` and the seeds derive from its content alone, so they are the same anywhere.

    `levels`: factor -> level; `leak_lpm` [L/min] and `fault`: what is put in at the plan's onset; `replicate` counts
    within the cell.
    """

    id: str
    machine_seed: int
    noise_seed: int
    use: Use
    leak_lpm: float
    law: str
    fault: str
    levels: Mapping[str, str | float]
    replicate: int


def digest(value: Any) -> str:
    """A name for plain values that differs wherever they do."""
    text = json.dumps(value, sort_keys=True, ensure_ascii=True, allow_nan=False, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()


def world(plan: Plan) -> dict[str, Any]:
    """What all cases of a plan share and a record depends on: the rig's values, the bench, length, onset, base seed."""
    rig = digest({row.name: repr(row.value) for row in plan.rig.table()})
    profile = ""
    if plan.profile:
        from sealscope.campaigns.machines import profile_key

        profile = profile_key(plan.profile)
    return {
        "rig": rig,
        "profile": profile,
        "duration_s": plan.duration_s,
        "onset_s": plan.onset_s,
        "seed": plan.seed,
    }


def cases_of(plan: Plan) -> list[Case]:
    """All cases of a plan: the records of each kind go round the cells one by one, the last round may be short."""
    cells = [dict(zip(plan.factors, levels, strict=True)) for levels in itertools.product(*plan.factors.values())]
    shared = world(plan)
    found = []
    for kind in plan.records:
        for number in range(kind.count):
            cell, replicate = cells[number % len(cells)], number // len(cells)
            content = {
                "world": shared,
                "use": kind.use,
                "leak_lpm": kind.leak_lpm,
                "law": kind.law,
                "fault": kind.fault,
                "levels": cell,
                "replicate": replicate,
            }
            name = digest(content)
            machine, noise = np.random.SeedSequence(int(name, 16)).generate_state(2, np.uint64)
            found.append(
                Case(
                    id=name[:16],
                    machine_seed=int(machine >> np.uint64(1)),
                    noise_seed=int(noise >> np.uint64(1)),
                    use=kind.use,
                    leak_lpm=kind.leak_lpm,
                    law=kind.law,
                    fault=kind.fault,
                    levels=cell,
                    replicate=replicate,
                )
            )
    return found


def code_key() -> str:
    """A hash of the sources that a row depends on: rows of other sources must not stand in the same table."""
    root = Path(__file__).resolve().parents[1]
    found = hashlib.sha256()
    own = [root / "campaigns" / f"{name}.py" for name in _OWN]
    rooms = [path for room in _ROOMS for path in sorted((root / room).rglob("*")) if path.suffix in (".py", ".toml")]
    for path in (*own, *rooms):
        found.update(path.relative_to(root).as_posix().encode() + b"\0")
        found.update(path.read_bytes())
    return found.hexdigest()[:16]
