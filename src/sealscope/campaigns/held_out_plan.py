"""Plans over measured data: classifiers that are fitted to all tests but the ones they are judged on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from math import isfinite
from typing import Any, Literal, get_args

from sealscope.campaigns.plan_table import Table
from sealscope.errors import InputError

Data = Literal["appendix-c", "hydraulic"]
LeaveOut = Literal["test", "condition"]
#: More groups have too many unions to try them all.
MOST_GROUPS = 8


@dataclass(frozen=True)
class Logistic:
    """A logistic regression on `features` with a `ridge` on the standardised coefficients."""

    name: str
    features: tuple[str, ...]
    ridge: float


@dataclass(frozen=True)
class Chosen:
    """A logistic regression whose features and ridge are chosen in the training samples alone: any union of `groups`
    of features, with any of `ridges`, the pair with the least loss on tests held out within the training samples."""

    name: str
    groups: tuple[tuple[str, ...], ...]
    ridges: tuple[float, ...]

    def candidates(self) -> list[Logistic]:
        """Every union of groups with every ridge, few features first and of these the larger ridge first."""
        unions = [one for size in range(1, len(self.groups) + 1) for one in combinations(self.groups, size)]
        return [
            Logistic(self.name, tuple(feature for group in union for feature in group), ridge)
            for union in unions
            for ridge in sorted(self.ridges, reverse=True)
        ]


Classifier = Logistic | Chosen


@dataclass(frozen=True)
class HeldOutPlan:
    """A campaign over measured data.

    `data`: which set; `unit` of the sizes of its faults; `leave_out`: what is held out whole in turn, a test (its part
    without and its part with the leak, or its unbroken block of cycles) or all tests of one operating condition;
    `permutations`: how often labels are swapped within tests to see what chance reaches, 0 for no such checks, and
    their `seed`.
    """

    name: str
    title: str
    data: Data
    leave_out: LeaveOut
    detectors: tuple[Classifier, ...]
    confidence: float
    place: str = ""
    unit: str = "L/min"
    note: str = ""
    permutations: int = 0
    seed: int = 0


def read_held_out(tree: Mapping[str, Any], place: str) -> HeldOutPlan:
    """The plan in a TOML file's tables; raises InputError with the place for whatever breaks a rule."""
    for key in tree:
        if key not in ("campaign", "held_out"):
            raise InputError(f"[{key}] is not known; a plan over measured data has [campaign] and [held_out] ({place})")
    head = Table(tree.get("campaign", {}), "campaign", place)
    name = head.text("name")
    title, confidence = head.text("title", name), head.share("confidence", 0.95)
    note = head.text("note", "")
    head.end()
    part = Table(tree["held_out"], "held_out", place)
    data = part.choice("data", get_args(Data))
    leave_out = part.choice("leave_out", get_args(LeaveOut), "test")
    given = part.take("detectors")
    permutations = part.whole("permutations", 0, least=0)
    seed = part.whole("seed", 0, least=0)
    part.end()
    if not isinstance(given, list) or not given:
        raise part.fail(f"detectors must be a list of tables, got {given!r}")
    found = tuple(_classifier(Table(one, f"held_out.detectors[{k}]", place)) for k, one in enumerate(given, 1))
    if len({one.name for one in found}) < len(found):
        raise part.fail("detectors must have names of their own")
    return HeldOutPlan(
        name,
        title,
        data,  # type: ignore[arg-type]
        leave_out,  # type: ignore[arg-type]
        found,
        confidence,
        place,
        "grade" if data == "hydraulic" else "L/min",
        note,
        permutations,
        seed,
    )


def _classifier(table: Table) -> Classifier:
    name = table.text("name")
    if "choose" in table.left:
        given = table.take("choose")
        if not isinstance(given, list) or not given:
            raise table.fail(f"choose must be a list of lists of names, got {given!r}")
        groups = tuple(_names(table, "choose must be a list of lists of names", one) for one in given)
        if len(groups) > MOST_GROUPS:
            raise table.fail(f"choose must have at most {MOST_GROUPS} groups, got {len(groups)}")
        ridges = table.take("ridges")
        if not isinstance(ridges, list) or not ridges or not all(_ridge(one) and one > 0 for one in ridges):
            raise table.fail(f"ridges must be a list of numbers > 0, got {ridges!r}")
        table.end()
        return Chosen(name, groups, tuple(float(one) for one in ridges))
    features = _names(table, "features must be a list of names", table.take("features"))
    ridge = table.number("ridge", 1.0)
    if ridge < 0:
        raise table.fail(f"ridge must be >= 0, got {ridge:g}")
    table.end()
    return Logistic(name, features, ridge)


def _ridge(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _names(table: Table, rule: str, given: Any) -> tuple[str, ...]:
    if not isinstance(given, list) or not given or not all(isinstance(word, str) for word in given):
        raise table.fail(f"{rule}, got {given!r}")
    return tuple(given)
