"""Does the observer's model describe the recording? Its innovations and its parameters say so."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.observer.accumulator import Estimates
from sealscope.diagnosis.observer.model import PARAMETERS, STIFFNESS
from sealscope.diagnosis.observer.stream import Formulation
from sealscope.diagnosis.observer.volume_filter import VOLUME_STATES

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Mean square of the normalised innovations, and correlation of successive ones, within which the model describes the
#: recording. Encoders that count seldom make those of the volume large for a while.
_SQUARE: dict[Formulation, tuple[float, float]] = {"volume": (0.1, 8.0), "speed": (0.7, 1.4), "command": (0.7, 1.4)}
_CORRELATION = 0.25
#: Mean square in a single block: a slipping encoder, a stuck reading.
_WORST: dict[Formulation, float] = {"volume": 400.0, "speed": 4.0, "command": 4.0}
#: Most that a block's own deviation may be for the leak to be seen at all, in units of `G_UNIT`.
_BLIND = 12.0
#: Range of the factors that a machine of the rig's kind may have.
_FACTORS = {"coulomb": (0.3, 3.0), "viscous": (0.0, 4.0), "gain": (0.6, 1.6), "breakaway": (0.0, 3.0)}
_SCALE = 0.5


def misfit(found: Estimates, formulation: Formulation, rig: Rig) -> str | None:
    """Why the estimates must not be trusted, in one line; None when they may."""
    if not (np.all(np.isfinite(found.G)) and np.all(np.isfinite(found.sd)) and np.all(np.isfinite(found.parameters))):
        return "the observer lost the recording: its model does not describe it"
    if float(np.median(found.sd)) > _BLIND:
        return "the piston hardly moves or carries no pressure: a leak cannot be seen by the observer"
    late = slice(found.G.size // 5, None)
    square, correlation = float(np.mean(found.square[late])), float(np.mean(found.correlation[late]))
    low, high = _SQUARE[formulation]
    if not low <= square <= high:
        return (
            f"the model ({rig.name}) does not describe the recording: mean square of its innovations {square:.3g}, "
            f"{low:g} to {high:g} expected"
        )
    if formulation != "volume" and abs(correlation) > _CORRELATION:
        return (
            f"the model ({rig.name}) does not describe the recording: successive innovations are correlated by "
            f"{correlation:.2f}"
        )
    worst = int(np.argmax(found.square[late])) + found.G.size // 5
    if found.square[worst] > _WORST[formulation]:
        return f"the model ({rig.name}) loses the recording in block {worst + 1}: a channel jumps or sticks there"
    return _volume_misfit(found) if formulation == "volume" else _pressure_misfit(found)


def _volume_misfit(found: Estimates) -> str | None:
    scale = float(found.parameters[-1, VOLUME_STATES.index("scale")])
    if abs(scale) > _SCALE:
        return f"angle and position do not fit the rig: pump and piston move volumes that differ by {100 * scale:.0f} %"
    return None


def _pressure_misfit(found: Estimates) -> str | None:
    last = dict(zip(PARAMETERS, found.parameters[-1], strict=True))
    for name, (low, high) in _FACTORS.items():
        if not low <= last[name] <= high:
            return f"the rig does not fit the recording: {name} would have to be {last[name]:.2g} times what is assumed"
    low, high = STIFFNESS[:2]
    if not 0.9 * low <= last["stiffness"] <= 1.1 * high:
        return (
            f"the rig does not fit the recording: stiffness would have to be {last['stiffness']:.2g} times what is "
            "assumed"
        )
    return None
