"""A calibration as a rig file: only the values that differ, each with its interval and source."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.identification.fit import Calibration
from sealscope.thesis.identification.forward import own_noise

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_RECORD = "docs/decisions/0006-calibration.md"
_FITTED = (
    'fitted to the leak-free columns of Appendix C of "Understanding Effect and Diagnosis of Internal Leakage in '
    'Hydrostatic Actuation Systems"'
)
_HEAD = f"""\
# The rig of the thesis as its own measurements say it is: what the thesis leaves unknown, fitted to the leak-free
# columns of its Appendix C. Made by sealscope.thesis.identification.fit.fit; how and how well is told in
# {_RECORD}.

[rig]
name = "thesis-calibrated"
title = "EHA test rig of the thesis, fitted to its leak-free tests (Appendix C)"
extends = "thesis"
"""
#: Why a setting that is common to all trials has its value.
_CHOSEN = {
    "line.orifices": "assumed: the throttles' bodies stay in the line when they are fully open, and Appendix C names "
    f"the tests by how far they were closed, from 0 %; see {_RECORD}",
}


def rig_toml(calibration: Calibration, base: Rig) -> str:
    """The text of a rig file that extends `base`; four digits of each fitted value."""
    lines: dict[str, list[str]] = {}
    for name, value, source in _values(calibration, base):
        entry = base.entry(name)
        group, _, symbol = name.rpartition(".")
        if isinstance(value, str):
            shown, unit = json.dumps(value), ""
        else:
            shown, unit = f"{_in_unit(base, name, value):.4g}", f'unit = "{entry.unit}", '
        lines.setdefault(group, []).append(f"{symbol} = {{ value = {shown}, {unit}source = {json.dumps(source)} }}")
    return _HEAD + "".join(f"\n[{group}]\n" + "\n".join(of) + "\n" for group, of in lines.items())


def write_rig(calibration: Calibration, base: Rig, path: str | os.PathLike[str]) -> None:
    """Write `rig_toml`, whole or not at all."""
    from sealscope.recordings.atomic import atomic_write

    with atomic_write(path) as temporary:
        temporary.write_text(rig_toml(calibration, base), encoding="utf-8")


def _values(calibration: Calibration, base: Rig) -> Iterator[tuple[str, float | str, str]]:
    best, intervals = calibration.best, dict(calibration.intervals)
    found: list[tuple[str, float | str, str]] = [
        (name, value, _CHOSEN.get(name, f"assumed: see {_RECORD}")) for name, value in calibration.common.items()
    ]
    first = ""
    for name, value in best.settings.items():
        first = name if name in intervals else first  # parameters fitted as one share the interval of the first
        low, high = (_in_unit(base, name, bound) for bound in intervals[first])
        unit = base.entry(name).unit
        unit = "" if unit == "1" else f" {unit}"
        found.append((name, value, f"{_FITTED}: 95 % {low:.3g} to {high:.3g}{unit}, see {_RECORD}"))
    rig = calibration.rig(base)
    for chamber, port in zip(CHAMBERS, ("p_1", "p_2"), strict=True):
        sigma, (low, high) = best.noise[chamber], intervals[f"noise.{chamber}"]
        own = own_noise(rig, chamber, sigma)
        told = f"with common noise and conversion {sigma:.3g} psi, 95 % {low:.3g} to {high:.3g} psi, see {_RECORD}"
        found.append((f"sensors.{chamber}.noise", own, f"{_FITTED}: {told}"))
        found.append((f"sensors.{port}.noise", own, f"assumed: as {chamber}; no record of {port} is analysed"))
    tried = ", ".join(f"{trial.misfit:.3f} at {trial.rate:g} Hz" for trial in calibration.trials)
    told = f"{_FITTED}: least root-mean-square log residual of {tried}, see {_RECORD}"
    found.append(("daq.sample_rate", best.rate, told))
    order = {row.name: place for place, row in enumerate(base.table())}
    yield from sorted(found, key=lambda one: order[one[0]])


def _in_unit(base: Rig, name: str, value: float) -> float:
    from sealscope.units import from_si

    units = {row.name: row.unit for row in base.table()}
    return from_si(float(value), base.entry(name).unit, units[name], name=name)
