"""What could explain the rest: named hypotheses on the calibrated rig, each held against both halves of the sheet.

The model is symmetric: both chambers ring alike, and a leak damps both. In Appendix C d3 of p_A falls with the leak and
d4 of p_B rises. Each hypothesis changes the rig in both halves of a test (`always`) or between them (`then`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.conditions import APPENDIX_C, Condition
from sealscope.thesis.identification.forward import QUANTITIES, Group, log_rms, noise_of, simulated
from sealscope.thesis.sheet import Sheet

if TYPE_CHECKING:
    from sealscope.parameters import Rig


@dataclass(frozen=True)
class Hypothesis:
    """A difference between the real rig and the calibrated one.

    `always`: parameters in both halves; `factors`: parameters multiplied, `then`: multiplied in the leaking half only;
    `x_0`, `x_0_then` [m]: where the piston starts in the two halves; `more_closed_B`: share of its bore by which
    throttle B stands further closed than A; `gain_B`: what sensor B reads of a true change; `law` of the leak.
    """

    name: str
    always: Mapping[str, float | str] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    then: Mapping[str, float] = field(default_factory=dict)
    x_0: float = 0.0
    x_0_then: float = 0.0
    more_closed_B: float = 0.0
    gain_B: float = 1.0
    law: Literal["laminar", "orifice"] = "laminar"


_MOVES: Mapping[str, float | str] = {"cylinder.volumes": "position"}
#: The hypotheses on what the symmetric rig leaves unexplained.
HYPOTHESES: tuple[Hypothesis, ...] = (
    Hypothesis("the calibrated rig"),
    Hypothesis("the bypass leaks as an orifice", law="orifice"),
    Hypothesis("volumes change with the stroke", _MOVES),
    Hypothesis("the piston starts 100 mm nearer to cap A", _MOVES, x_0=-0.10, x_0_then=-0.10),
    Hypothesis("it moves 100 mm towards cap B between the halves", _MOVES, x_0=-0.10, x_0_then=0.0),
    Hypothesis("it moves 200 mm towards cap B between the halves", _MOVES, x_0=-0.20, x_0_then=0.0),
    Hypothesis("throttle B 10 % further closed", more_closed_B=0.10),
    Hypothesis("line volume 1 twice line volume 2", factors={"line.V_1": 1.4, "line.V_2": 0.7}),
    Hypothesis("sensor B reads 10 % less", gain_B=0.9),
    Hypothesis("bulk modulus 10 % lower with the leak (air)", then={"fluid.K_oil": 0.9}),
    Hypothesis("breakaway 5 % higher with the leak", then={"friction.K_brk": 1.05}),
    Hypothesis(
        "it moves 100 mm towards cap B, breakaway 5 % higher",
        _MOVES,
        then={"friction.K_brk": 1.05},
        x_0=-0.10,
        x_0_then=0.0,
    ),
)


@dataclass(frozen=True)
class Outcome:
    """What the rig predicts under a hypothesis: the sheet it makes, and in how many of the tests it agrees."""

    hypothesis: Hypothesis
    sheet: Sheet

    def ratio(self, measured: Sheet) -> Array:
        """Geometric mean of simulated/measured leak-free RMS, (2, 5)."""
        return self._mean(lambda c, q: np.log(self.sheet.rms[c][q][:, 0] / measured.rms[c][q][:, 0]))

    def change(self) -> Array:
        """Geometric mean of the RMS with over without leak, (2, 5)."""
        return self._mean(lambda c, q: np.log(self.sheet.rms[c][q][:, 1] / self.sheet.rms[c][q][:, 0]))

    def right_sign(self, measured: Sheet) -> Array:
        """In how many tests the sign of the change is the measured one, (2, 5)."""
        made, real = (
            [[np.sign(of.rms[c][q][:, 1] - of.rms[c][q][:, 0]) for q in QUANTITIES] for c in CHAMBERS]
            for of in (self.sheet, measured)
        )
        return np.asarray(np.sum(np.array(made) == np.array(real), axis=-1))

    def _mean(self, of: Callable[[str, str], Array]) -> Array:
        return np.asarray(np.exp([[float(np.mean(of(c, q))) for q in QUANTITIES] for c in CHAMBERS]))


def outcome(rig: Rig, hypothesis: Hypothesis, conditions: tuple[Condition, ...] = APPENDIX_C) -> Outcome:
    """Simulate the tests, without and with their leaks, on the rig as the hypothesis has it."""
    h = hypothesis
    before = _multiplied(rig.with_overrides(h.always) if h.always else rig, h.factors)
    after = _multiplied(before, h.then)
    cache: dict[Group, Array] = {}
    made = np.empty((len(conditions), 2, len(CHAMBERS), len(QUANTITIES)))
    for row, condition in enumerate(conditions):
        closed = {"line.closed_B": min(0.99, condition.closed_pct / 100.0 + h.more_closed_B)}
        if condition.group not in cache:
            cache[condition.group] = simulated(before, condition, x_0=h.x_0, values=closed)
        leak = f"{condition.mean_leak_lpm} L/min {h.law}"
        leaking = simulated(after, condition, leak=leak, x_0=h.x_0_then, values=closed)
        for half, squares in enumerate((cache[condition.group], leaking)):
            for k, chamber in enumerate(CHAMBERS):
                read = squares[k] * np.array([h.gain_B**2] * 4 + [h.gain_B**4]) if k else squares[k]
                made[row, half, k] = np.exp(log_rms(read, noise_of(rig, chamber)))
    return Outcome(
        h,
        Sheet({c: {q: made[:, :, k, j] for j, q in enumerate(QUANTITIES)} for k, c in enumerate(CHAMBERS)}),
    )


def _multiplied(rig: Rig, factors: Mapping[str, float]) -> Rig:
    return rig.with_overrides({name: float(rig[name]) * by for name, by in factors.items()}) if factors else rig
