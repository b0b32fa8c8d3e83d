"""The cases of a plan: one record each, with a name and seeds that derive from its content."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.campaigns.plans.duty import CONTROLLER
from sealscope.campaigns.plans.model import SimulatedPlan, Use
from sealscope.control.registry import source_of
from sealscope.simulation.bench.profile import load_profile

#: The factor whose levels are families of the plan's profile.
FAMILY = "family"
#: Parameters of a rig that a verdict is held against, and no record depends on.
_PRIORS = frozenset({"pump.G_healthy"})
_PACKAGE = Path(__file__).resolve().parents[2]
#: Parts of the package that no row depends on; the sources of all others are in the code key.
_NOT_IN_ROWS = (
    "cli",
    "reporting",
    "thesis",
    "campaigns/plans/packaged",
    "campaigns/judging",
    "campaigns/smallest.py",
    "campaigns/results.py",
)


@dataclass(frozen=True, kw_only=True)
class CaseInputs:
    """The inputs and the use of a case's record.

    `levels`: factor -> level; `leak_lpm` [L/min] of that `law` and `fault`: what is put in at the plan's onset;
    `replicate` counts within the cell.
    """

    id: str
    use: Use
    leak_lpm: float
    law: str = "laminar"
    fault: str = ""
    levels: Mapping[str, str | float]
    replicate: int = 0


@dataclass(frozen=True, kw_only=True)
class CampaignCase(CaseInputs):
    """One record to make and judge; `id` and seeds derive from its content alone, so they are the same anywhere."""

    machine_seed: int
    noise_seed: int


def digest(value: Any) -> str:
    """Compute a SHA-256 of plain values."""
    text = json.dumps(value, sort_keys=True, ensure_ascii=True, allow_nan=False, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()


def profile_key(name: str) -> str:
    """Compute a digest of the content of a bench profile, wherever its file lies."""
    profile = load_profile(name)
    return digest(repr(replace(profile, name=profile.seeds or profile.name, place="")))


def world(plan: SimulatedPlan) -> dict[str, Any]:
    """Collect the inputs that all cases of a plan share: rig, bench, length, onset and base seed."""
    return {
        "rig": digest({name: repr(value) for name, value in plan.rig.present().items() if name not in _PRIORS}),
        "profile": profile_key(plan.profile) if plan.profile else "",
        "duration_s": plan.duration_s,
        "onset_s": plan.onset_s,
        "seed": plan.seed,
    }


def _named_digests(plan: SimulatedPlan) -> dict[str, dict[str, str]]:
    """Compute factor -> level -> digest of the family or the user's controller behind the level's name.

    Another law gives other cases; a case does not depend on another family.
    """
    digests: dict[str, dict[str, str]] = {FAMILY: {}, CONTROLLER: {}}
    for level in plan.factors.get(FAMILY, ()):
        digests[FAMILY][str(level)] = digest(repr(load_profile(plan.profile).family(str(level))))
    for level in plan.factors.get(CONTROLLER, ()):
        if path := source_of(str(level)):
            digests[CONTROLLER][str(level)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return digests


def cases_of(plan: SimulatedPlan) -> list[CampaignCase]:
    """List all cases of a plan: records of each kind go round the cells in turn, and the last round may be short."""
    cells = [dict(zip(plan.factors, levels, strict=True)) for levels in itertools.product(*plan.factors.values())]
    shared = world(plan)
    digests_by_factor = _named_digests(plan)
    cases = []
    for group in plan.records:
        for number in range(group.count):
            replicate, k = divmod(number, len(cells))
            content: dict[str, Any] = {
                "use": group.use,
                "leak_lpm": group.leak_lpm,
                "law": group.law,
                "fault": group.fault,
                "levels": cells[k],
                "replicate": replicate,
            }
            levels = {key: str(level) for key, level in cells[k].items()}
            behind = {
                key: digests[levels[key]] for key, digests in digests_by_factor.items() if levels.get(key) in digests
            }
            name = digest({"world": shared, **content, **behind})
            machine, noise = np.random.SeedSequence(int(name, 16)).generate_state(2, np.uint64)
            machine_seed, noise_seed = int(machine >> np.uint64(1)), int(noise >> np.uint64(1))
            cases.append(CampaignCase(id=name[:16], machine_seed=machine_seed, noise_seed=noise_seed, **content))
    return cases


def interleave_cases(cases: Sequence[CampaignCase]) -> list[CampaignCase]:
    """Order the cases so that each kind (use, leak, law, fault) is spread evenly.

    A campaign that is ended early then has every kind in its proportion, each with its cells in turn.
    """
    kinds = [(case.use, case.leak_lpm, case.law, case.fault) for case in cases]
    counts, before = Counter(kinds), Counter[Any]()
    shares = []
    for kind in kinds:
        shares.append((before[kind] + 0.5) / counts[kind])
        before[kind] += 1
    return [cases[k] for k in sorted(range(len(cases)), key=shares.__getitem__)]


def sources() -> Iterator[Path]:
    """Yield the files of the package that a row may depend on."""
    for path in sorted(_PACKAGE.rglob("*")):
        name = path.relative_to(_PACKAGE).as_posix()
        if path.suffix in (".py", ".toml") and not f"{name}/".startswith(tuple(f"{part}/" for part in _NOT_IN_ROWS)):
            yield path


def code_key() -> str:
    """Compute a hash of the sources that a row depends on, so that rows of other sources are not mixed in."""
    return files_digest(sources())[:16]


def files_digest(paths: Iterable[Path]) -> str:
    """Compute a SHA-256 of files of the package, their names and contents."""
    key = hashlib.sha256()
    for path in paths:
        key.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        key.update(path.read_bytes())
    return key.hexdigest()
