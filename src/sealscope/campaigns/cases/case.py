"""The cases of a plan, one for each record to simulate, with an id and seeds that are computed from its inputs."""

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

from sealscope.campaigns.plans.duty import CONTROLLER, FAMILY
from sealscope.campaigns.plans.model import SimulatedPlan, Use
from sealscope.control.registry import find_controller_source
from sealscope.simulation.bench.profile import Profile

#: Parameters of a rig that only verdicts use; no simulated record depends on them.
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
    """The inputs of one record of a campaign; `use`, `leak_lpm`, `law` and `fault` are those of its `RecordGroup`.

    `levels`: value (level) of each factor; `replicate`: number, from 0, among records that agree in all other inputs.
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
    """One record to simulate and judge, whose seeds and `id` follow from a hash of all its inputs (`list_cases`).

    `machine_seed`: seed by which its machine is drawn from the plan's profile; `noise_seed`: seed of the sensors'
    noise.
    """

    machine_seed: int
    noise_seed: int


def digest(value: Any) -> str:
    """Compute the SHA-256 hash (hex) of a value's JSON text, with the `repr` of objects that JSON does not have."""
    text = json.dumps(value, sort_keys=True, ensure_ascii=True, allow_nan=False, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()


def profile_key(profile: Profile) -> str:
    """Compute a hash (hex) of the content of a profile, from which machines are drawn."""
    # the seeds of cases depend on this hash, and so on the profile's name; a renamed profile that must draw the same
    # cases as before states its former name in `seeds`
    return digest(repr(replace(profile, name=profile.seeds or profile.name, place="")))


def shared_inputs(plan: SimulatedPlan) -> dict[str, Any]:
    """Collect the inputs that all records of a plan share: hashes of rig and profile, length, onset and base seed."""
    return {
        "rig": digest({name: repr(value) for name, value in plan.rig.present_values().items() if name not in _PRIORS}),
        "profile": profile_key(plan.machine_profile) if plan.machine_profile else "",
        "duration_s": plan.duration_s,
        "onset_s": plan.onset_s,
        "seed": plan.seed,
    }


def _level_digests(plan: SimulatedPlan) -> dict[str, dict[str, str]]:
    """Compute hashes of the machine families and controller files of a plan's factors, by factor and level (value).

    The id of a case depends on those of its own levels only, so its stored row stays valid if another level is edited.
    """
    digests: dict[str, dict[str, str]] = {FAMILY: {}, CONTROLLER: {}}
    if plan.machine_profile is not None:
        for level in plan.factors.get(FAMILY, ()):
            digests[FAMILY][str(level)] = digest(repr(plan.machine_profile.family(str(level))))
    for level in plan.factors.get(CONTROLLER, ()):
        if path := find_controller_source(str(level)):
            digests[CONTROLLER][str(level)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return digests


def list_cases(plan: SimulatedPlan) -> list[CampaignCase]:
    """List all cases of a plan, one for each record.

    The records of a group take the combinations of the factors' levels in turn; `replicate` counts the completed turns.
    """
    cells = [dict(zip(plan.factors, levels, strict=True)) for levels in itertools.product(*plan.factors.values())]
    shared = shared_inputs(plan)
    digests_by_factor = _level_digests(plan)
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
            level_digests = {
                key: digests[levels[key]] for key, digests in digests_by_factor.items() if levels.get(key) in digests
            }
            case_digest = digest({"world": shared, **content, **level_digests})
            machine, noise = np.random.SeedSequence(int(case_digest, 16)).generate_state(2, np.uint64)  # two seeds
            # 63 bits: the seeds are stored as signed 64-bit integers
            machine_seed, noise_seed = int(machine >> np.uint64(1)), int(noise >> np.uint64(1))
            cases.append(CampaignCase(id=case_digest[:16], machine_seed=machine_seed, noise_seed=noise_seed, **content))
    return cases


def interleave_cases(cases: Sequence[CampaignCase]) -> list[CampaignCase]:
    """Reorder the cases of a campaign, with each group of the plan (`RecordGroup`) spread evenly over the list.

    If a campaign is ended early, the completed cases are from all groups, in nearly the planned proportions.
    """
    groups = [(case.use, case.leak_lpm, case.law, case.fault) for case in cases]
    n_total, n_listed = Counter(groups), Counter[Any]()
    positions = []  # position of each case within its group, from 0 to 1
    for group in groups:
        positions.append((n_listed[group] + 0.5) / n_total[group])
        n_listed[group] += 1
    return [cases[k] for k in np.argsort(positions, kind="stable")]


def iter_sources() -> Iterator[Path]:
    """Yield the package's source files on which the result of a record may depend."""
    left_out = [_PACKAGE / part for part in _NOT_IN_ROWS]
    for path in sorted(_PACKAGE.rglob("*")):
        if path.suffix in (".py", ".toml") and not any(path.is_relative_to(part) for part in left_out):
            yield path


def code_key() -> str:
    """Compute a hash (16 hex digits) of the source files on which the result of a record may depend."""
    return files_digest(iter_sources())[:16]


def files_digest(paths: Iterable[Path]) -> str:
    """Compute the SHA-256 hash (hex) of the names and contents of files of this package."""
    sha = hashlib.sha256()
    for path in paths:
        sha.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        sha.update(path.read_bytes())
    return sha.hexdigest()
