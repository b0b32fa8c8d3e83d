"""Faults in words, as a command line has them."""

from __future__ import annotations

import re
from collections.abc import Callable

from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS
from sealscope.simulation.commands import NUMBER, TIME, UNSIGNED, seconds
from sealscope.simulation.faults.duty import DutyChange
from sealscope.simulation.faults.faults import WHEN, Fault, From, Growing, opening_from
from sealscope.simulation.faults.rig import AirInOil, ExternalLeakage, FrictionChange, PumpLeakage
from sealscope.simulation.faults.sensors import SensorGain, SensorOffset, SensorStuck
from sealscope.units import parse_quantity

_N = NUMBER
_FACTOR = rf"(?:x\s*(?P<times>{_N})|(?P<percent>[-+]\s*{UNSIGNED})\s*%)"
_SHARE = rf"(?P<share>{_N})\s*(?P<sign>%?)"
_SIZE = rf"(?P<size>{_N}\s*(?:\[[^\]]+\]|[a-zA-Z0-9^/_]+))"
_TAIL = rf"(?:\s+{WHEN})?"
_Part = dict[str, str | None]


def _number(text: str | None) -> float:
    return float((text or "0").replace(" ", ""))


def _factor(part: _Part) -> float:
    return _number(part["times"]) if part["times"] is not None else 1.0 + _number(part["percent"]) / 100.0


def _share(part: _Part) -> float:
    return _number(part["share"]) / (100.0 if part["sign"] else 1.0)


def _rod_seal(part: _Part) -> Fault:
    side = "A" if (part["side"] or "").upper() == "A" else "B"
    if part["G"] is not None:
        return ExternalLeakage(side, coefficient=_number(part["G"]), opening=opening_from(part))  # type: ignore[arg-type]
    flow = parse_quantity(part["size"] or "", "m^3/s", name="a rod seal's leak")
    return ExternalLeakage(side, flow=flow, opening=opening_from(part))  # type: ignore[arg-type]


def _duty(part: _Part) -> Fault:
    opening = opening_from(part)
    assert isinstance(opening, From | Growing)
    return DutyChange(_number(part["amplitude"] or "1"), _number(part["speed"] or "1"), opening)


def _offset(part: _Part) -> Fault:
    channel = part["channel"] or ""
    offset = parse_quantity(part["size"] or "", CHANNEL_UNITS.get(channel, "Pa"), name="a sensor's offset")
    return SensorOffset(channel, offset, opening_from(part))


def _stuck(part: _Part) -> Fault:
    until = {} if part["until"] is None else {"until": seconds(part["until"])}
    return SensorStuck(part["channel"] or "", seconds(part["since"]), **until)


_SENSOR = r"sensor\s+(?P<channel>\w+)"
_FORMS: tuple[tuple[str, Callable[[_Part], Fault]], ...] = (
    (rf"pump\s+leak(?:age)?\s+{_FACTOR}{_TAIL}", lambda p: PumpLeakage(_factor(p), None, opening_from(p))),
    (
        rf"pump\s+leak(?:age)?\s+G\s*=\s*(?P<G>{_N}){_TAIL}",
        lambda p: PumpLeakage(None, _number(p["G"]), opening_from(p)),
    ),
    (
        rf"(?:rod\s+seal|external\s+leak(?:age)?)\s+(?P<side>[ABab])\s+"
        rf"(?:G\s*=\s*(?P<G>{_N})|{_SIZE}){_TAIL}",
        _rod_seal,
    ),
    (rf"friction\s+{_FACTOR}{_TAIL}", lambda p: FrictionChange(_factor(p), opening_from(p))),
    (rf"air\s+{_SHARE}{_TAIL}", lambda p: AirInOil(_share(p), opening_from(p))),
    (rf"{_SENSOR}\s+offset\s+{_SIZE}{_TAIL}", _offset),
    (rf"{_SENSOR}\s+gain\s+{_SHARE}{_TAIL}", lambda p: SensorGain(p["channel"] or "", _share(p), opening_from(p))),
    (rf"{_SENSOR}\s+stuck(?:\s+from\s+(?P<since>{TIME})(?:\s+to\s+(?P<until>{TIME}))?)?", _stuck),
    (
        rf"duty(?=\s+[af])(?:\s+amplitude\s+x\s*(?P<amplitude>{_N}))?(?:\s+frequency\s+x\s*(?P<speed>{_N}))?{_TAIL}",
        _duty,
    ),
)


def parse_fault(text: str) -> Fault | None:
    """A fault from words.

    `pump leak x3 from 90 s`, `pump leak G = 5e-13`, `rod seal A 0.01 L/min from 90 s` (flow at the charge pressure),
    `friction +20 % growing from 60 s to 120 s`, `air 1 % from 90 s`, `sensor p_A offset 2 psi from 90 s`, `sensor p_A
    gain -1 %`, `sensor p_A stuck from 90 s to 100 s`, `duty amplitude x1.5 frequency x0.8 from 90 s`, or `none`.
    Raises InputError that shows the forms when the text is none of them.
    """
    stripped = text.strip()
    if stripped.lower() in ("none", "no fault"):
        return None
    for pattern, make in _FORMS:
        if found := re.fullmatch(pattern, stripped):
            return make(found.groupdict())
    raise InputError(
        "fault must be like 'pump leak x3 from 90 s', 'rod seal A 0.01 L/min from 90 s', 'friction +20 % growing from "
        "60 s to 120 s', 'air 1 % from 90 s', 'sensor p_A offset 2 psi from 90 s', 'sensor p_A gain 1 %', 'sensor p_A "
        f"stuck from 90 s', 'duty amplitude x1.5 from 90 s' or 'none', got {text!r}"
    )
