"""Plans over measured data: classifiers that are fitted to all tests but the ones they are judged on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from sealscope.campaigns.plan_table import Table
from sealscope.errors import InputError

Data = Literal["appendix-c", "hydraulic"]
LeaveOut = Literal["test", "condition"]


@dataclass(frozen=True)
class Logistic:
    """A logistic regression on `features` with a `ridge` on the standardised coefficients."""

    name: str
    features: tuple[str, ...]
    ridge: float


@dataclass(frozen=True)
class HeldOutPlan:
    """A campaign over measured data.

    `data`: which set; `unit` of the sizes of its faults; `leave_out`: what is held out whole in turn, a test (its part
    without and its part with the leak, or its unbroken block of cycles) or all tests of one operating condition.
    """

    name: str
    title: str
    data: Data
    leave_out: LeaveOut
    detectors: tuple[Logistic, ...]
    confidence: float
    place: str = ""
    unit: str = "L/min"
    note: str = ""


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
    part.end()
    if not isinstance(given, list) or not given:
        raise part.fail(f"detectors must be a list of tables, got {given!r}")
    found = []
    for number, one in enumerate(given, 1):
        table = Table(one, f"held_out.detectors[{number}]", place)
        features = table.take("features")
        if not isinstance(features, list) or not features or not all(isinstance(word, str) for word in features):
            raise table.fail(f"features must be a list of names, got {features!r}")
        ridge = table.number("ridge", 1.0)
        if ridge < 0:
            raise table.fail(f"ridge must be >= 0, got {ridge:g}")
        found.append(Logistic(table.text("name"), tuple(features), ridge))
        table.end()
    if len({one.name for one in found}) < len(found):
        raise part.fail("detectors must have names of their own")
    unit = "grade" if data == "hydraulic" else "L/min"
    return HeldOutPlan(name, title, data, leave_out, tuple(found), confidence, place, unit, note)  # type: ignore[arg-type]
