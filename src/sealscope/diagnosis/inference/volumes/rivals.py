"""What else than a leak past piston or pump may have changed since the healthy recordings: rivals of its rise.

Each term whose coefficient a fault changes is fitted to what a recording's rows leave of the healthy coefficients, all
others tied to theirs within what recordings of a machine differ by (`priors.toml`), the leak's as well. The scatter of
the same number between the healthy recordings is its null (`differences`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.inference.blocks import Columns, solve
from sealscope.diagnosis.inference.differences import difference, rarity_of_size
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.scatter import FEWEST_HELD, RISE, RecordingSums
from sealscope.diagnosis.inference.terms import AIR, LEAK, SPEED_LOSS, TURNING
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array

#: Name of the data that what the turning pump loses is, where rests tell of the piston alone.
TURNING_DATA = "turning"


def rival_rises(
    judged: RecordingSums, healthy: Sequence[RecordingSums], columns: Sequence[Columns]
) -> tuple[Observable, ...]:
    """Compare each rival's coefficient in a recording with the healthy recordings'."""
    names, held = columns[0].names, held_rivals(judged, healthy)
    turns = (TURNING,) if SPEED_LOSS in names else ()  # what a meter reads has left the pump
    tested = [k for k, name in enumerate(names) if name in (AIR, *turns) or name.startswith("external leak")]
    if held is not None:
        tested = [k for k in tested if not names[k].startswith("external leak")]
    everything = np.sum([recording.sums for recording in healthy], axis=0)
    observables = []
    for k in tested:
        values = [
            _shift(subject.sums, everything - subject.sums if subject is not judged else everything, columns, k)
            for subject in (judged, *healthy)
        ]
        data = TURNING_DATA if names[k] == TURNING else RISE
        observable = difference(names[k], data, values[0], values[1:], above=names[k] != AIR)
        if observable is not None:
            observables.append(_by_size(observable, judged) if names[k].startswith("external leak") else observable)
    return (*observables, *(held or ()))


def held_rivals(judged: RecordingSums, healthy: Sequence[RecordingSums]) -> tuple[Observable, ...] | None:
    """Compare what either side loses to the outside while valves shut the chambers; None where too few hold any."""
    known = [recording.held for recording in healthy if recording.held is not None]
    if judged.held is None or len(known) < FEWEST_HELD:
        return None
    by_flow = judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    least, observables = priors("inference")["scatter"]["finest"] * by_flow, list[Observable]()
    for k, side in ((2, "A"), (4, "B")):
        numbers = [float(held[k]) for held in known]
        error = max(float(np.median([judged.held[k + 1], *(held[k + 1] for held in known)])), least)
        observable = difference(f"external leak {side}", RISE, float(judged.held[k]), numbers, error, above=True)
        observables += [] if observable is None else [_by_size(observable, judged)]
    return tuple(observables)


def _by_size(observable: Observable, judged: RecordingSums) -> Observable:
    """Return a leak to the outside with its size against it: a large one is seen."""
    return replace(observable, advantage=-rarity_of_size("outside", observable.size * judged.pressure, above=True))


def _shift(sums: Array, reference: Array, columns: Sequence[Columns], test: int) -> float:
    """Compute by how much a column's coefficient in one recording's sums (E, m, m) is beyond that of others."""
    precision, vector = 0.0, 0.0
    leak_width: float = priors("inference")["between"]["pump"]
    for e, column in enumerate(columns):
        width = column.between.copy()
        width[column.names.index(LEAK)] = leak_width
        chosen = [k for k in column.compared if k != test and np.isfinite(width[k])]
        coefficients = solve(reference[e][np.ix_(chosen, chosen)], reference[e][chosen, column.left])
        residual = sums[e][:, column.left] - sums[e][:, chosen] @ coefficients
        with np.errstate(divide="ignore", over="ignore"):
            prior = 1.0 / (np.abs(coefficients) * width[chosen]) ** 2
        matrix, cross = sums[e][np.ix_(chosen, chosen)], sums[e][chosen, test]
        tied = matrix + np.diag(np.minimum(prior, 1e9 * np.diag(matrix)))
        solved = solve(tied, np.column_stack([cross, residual[chosen]]))
        precision += float(sums[e][test, test] - cross @ solved[:, 0])
        vector += float(residual[test] - cross @ solved[:, 1])
    return vector / precision if precision > 0.0 else 0.0
