"""How detectors answered in a campaign that has been run: its rows in place of a simulation of the plan's own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.execution.store import read_rows
from sealscope.campaigns.plans.duty import closing_values
from sealscope.campaigns.prediction.detection import ChangeDetector, Responses, counted
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import parse_command

#: Fewest records without a leak, and of each size, that make a scatter.
FEWEST = 8


def same_duty(row: CaseRow, command: str, rig: Rig) -> bool:
    """Whether a row was run with this command and the rig's throttles; what its plan did not vary counts as equal."""
    levels = row.levels
    if "command" in levels and str(parse_command(str(levels["command"]))) != command:
        return False
    if "closed" not in levels:
        return True
    throttled = rig.line.orifices == "present"
    here = {
        "line.closed_A": rig.line.closed_A if throttled else 0.0,
        "line.closed_B": rig.line.closed_B if throttled else 0.0,
    }
    there = closing_values(levels["closed"])
    return all(abs(float(there[name]) - value) < 1e-9 for name, value in here.items())


def signed_change(row: CaseRow, detector: ChangeDetector) -> float | None:
    """The change of the log RMS behind a row's scores, whichever side was scored; None where none was."""
    for side, sign in (("fell", -1.0), ("rose", 1.0)):
        found = row.scores.get(f"{detector.quantity} of {detector.chamber} {side}")
        if found is not None and found[0] is not None:
            return sign * found[0]
    return None


def _judged(rows: Iterable[CaseRow], detectors: Sequence[ChangeDetector]) -> Array:
    made = [[signed_change(row, detector) for detector in detectors] for row in rows]
    return np.array([[np.nan if value is None else value for value in line] for line in made], dtype=np.float64)


def measured_responses(
    folder: Path, command: str, rig: Rig, duration: float, detectors: Sequence[ChangeDetector]
) -> Responses:
    """Means and scatters from the rows in a campaign's folder that have this duty and length.

    Sizes are the mean leaks [L/min] that the records really had. A detector whose change was not scored in a row is
    told as such. Raises InputError where too few rows fit.
    """
    rows = [
        row
        for row in read_rows(folder).values()
        if row.error is None
        and not row.fault
        and abs(float(row.place.get("duration_s", duration)) - duration) < 1.0
        and same_duty(row, command, rig)
    ]
    groups: dict[float, list[CaseRow]] = {}
    for row in rows:
        groups.setdefault(row.leak_lpm, []).append(row)
    free = groups.pop(0.0, [])
    sizes = sorted(size for size, members in groups.items() if len(members) >= FEWEST)
    if len(free) < FEWEST or not sizes:
        raise InputError(
            f"a campaign must hold {FEWEST} leak-free rows or more and as many of a leak with this command, throttles "
            f"and length, got {len(free)} and {max((len(one) for one in groups.values()), default=0)} ({folder})"
        )
    flows = [float(np.mean([row.flow_lpm or row.leak_lpm for row in groups[size]])) for size in sizes]
    tables = [_judged(free, detectors), *(_judged(groups[size], detectors) for size in sizes)]
    return counted(np.array(flows), tables, paired=False)
