"""What is not known about a machine: alternatives of which one is true, their prior odds, and the evidence for each.

| unknown | alternatives | prior (`priors.toml`) | evidence of a recording | here |
| --- | --- | --- | --- | --- |
| valves at rest | `Valves` | `rest.shut_odds` | `regimes.shut_odds` | `VALVES` |
| sign of the recorded flow | right, reversed | equal | `sum_log_odds` | `FLOW_SIGN` |
| held load without a flow | creeps by leakage, a loop holds it | equal | `RecordedBalance.creep_log_odds` | `CREEP` |
| flow at rest | circulates, holds the load | `feed.circulation_odds` | `balances.flag_circulation` | `HoldCounts` |
| chambers that a pump feeds | both, one at a time, each by its displacement | `feed` | `FeedSums.find_feed` | |
| zero of p_A - p_B | near 0, any | `zero` | `fit_pressure_offset` | |
| law of a leak | exponent of its flow | `size.laminar` | `leak_flow`, `comparison` | `LAWS` |
| course of a leak | growth from its onset to the end | `growth` | `leak_flow`, `HeldChambers` | `GROWTHS` |

The first four are the same in all recordings of a machine, so their log odds add up: those of the healthy recordings,
from their summaries, are the prior of the judged one (`MachineOdds`). The others are decided, or averaged over, in each
recording.

No model describes a machine exactly, so likelihoods of models are believed less than many data would allow. They are
tempered in two ways: a residual counts as `tempering.readings` independent ones (`compare_residuals`), and a logarithm
as exact to within a relative misfit (`temper`).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.healthy import Number, Values, stored_array
from sealscope.diagnosis.priors.inference import INFERENCE, StepSize
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array


class Valves(Enum):
    """Valves between pump and cylinder while the pump rests.

    `OPEN`: they connect the two; `SHUT`: they probably cut the pump off, so that only the piston leaks at rest;
    `SURELY_SHUT`: they surely do, so that the leaks can be measured in the holds of a load.
    """

    OPEN = "open"
    SHUT = "shut"
    SURELY_SHUT = "surely shut"


class HoldCounts(NamedTuple):
    """Numbers of holds of an open circuit: with a pump `connected` to the cylinder, and with a flow `circulating`."""

    connected: int = 0
    circulating: int = 0

    @classmethod
    def measure(cls, is_held: NDArray[np.bool_], circulates: NDArray[np.bool_], rate: float) -> HoldCounts:
        """Count the holds that last for `rest.shortest_hold` (`priors.toml`) or longer.

        `is_held`, `circulates` (n - 1,): flags of the sampling intervals, the latter by `flag_circulation`; `rate`:
        sampling rate [Hz].
        """
        min_length = INFERENCE.rest.shortest_hold * rate
        runs = find_runs(is_held).tolist()
        states = [bool(circulates[first]) for first, length in runs if length >= min_length]
        return cls(connected=states.count(False), circulating=states.count(True))

    @property
    def log_odds(self) -> float:
        """Log odds that the flow circulates in a further hold; those of `feed.circulation_odds` count as one hold."""
        share = 1.0 / (1.0 + np.exp(-INFERENCE.feed.circulation_odds))
        return float(np.log((self.circulating + share) / (self.connected + 1.0 - share)))


class Unknown(NamedTuple):
    """Two alternatives: log odds of the first before any recording, and limits of the evidence.

    The log odds of one recording are believed up to +-`each_limit`, since something else may cause them, and those of
    all up to +-`total_limit`, since the machine may have been changed.
    """

    prior: float = 0.0
    each_limit: float = np.inf
    total_limit: float = np.inf

    def add(self, log_odds: Any) -> Array:
        """Add the log odds (n, ...) of n recordings to those of the prior."""
        evidence = np.sum(np.clip(log_odds, -self.each_limit, self.each_limit), axis=0)
        return np.asarray(self.prior + np.clip(evidence, -self.total_limit, self.total_limit))


def compare_residuals(square: float, other: float) -> float:
    """Compute the log likelihood ratio of a description of a volume balance to another, by residual sums of squares.

    It is N/2 log(`other` / `square`) with N = `tempering.readings` (`priors.toml`): what a balance leaves repeats from
    cycle to cycle, so that no more residuals count as independent.
    """
    return -0.5 * float(INFERENCE.tempering.readings) * math.log(square / other)


def temper(log_ratio: Any, largest: float, misfit: float) -> Any:
    """Reduce log likelihood ratios l of models that describe a change only to within a relative `misfit` m.

    The result is l / (1 + 2 m L), where L is the `largest` log likelihood ratio of the same data, at least 0. `misfit`:
    `term` or `pattern` of `[tempering]` (`priors.toml`).
    """
    return log_ratio / (1.0 + 2.0 * misfit * largest)


def step_penalty(step: float, prior: StepSize, above: bool = False) -> float:
    """Compute the penalty -2 log(prior density / largest prior density) for an improbable size of a `step`.

    The prior is normal in log(abs(`step`)) about the logarithm of its `size`, with the standard deviation `spread`.
    With `above`, only steps larger than this size are penalised.
    """
    deviation = math.log(max(abs(step), sys.float_info.min) / prior.size) / prior.spread
    return max(deviation, 0.0) ** 2 if above else deviation**2


#: Prior probability of each law of a leak, by the exponent e of its flow c |p_A - p_B|^e: 1 is laminar, 0.5 an orifice.
LAWS: dict[float, float] = {
    1.0: INFERENCE.size.laminar,
    **dict.fromkeys((0.75, 0.5), (1.0 - INFERENCE.size.laminar) / 2.0),
}
_STEADY, _GROWING = INFERENCE.growth.steady, INFERENCE.growth.most * (np.arange(6) + 1.0) / 6
#: Prior probability of each relative growth of a leak from its onset to the recording's end; first that of none.
GROWTHS: dict[float, float] = {0.0: _STEADY, **dict.fromkeys(_GROWING.tolist(), (1.0 - _STEADY) / len(_GROWING))}

VALVES = Unknown(INFERENCE.rest.shut_odds, each_limit=INFERENCE.rest.single_odds_limit)
FLOW_SIGN = Unknown(total_limit=float(np.log(1.0 / INFERENCE.sense.rewired - 1.0)))
CREEP = Unknown(each_limit=INFERENCE.rest.single_odds_limit)


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordingOdds:
    """Evidence of one recording for the unknowns of its machine, None where it tells nothing.

    - `shut_odds`, `held_odds`: log odds that valves cut the resting pump off, from the leakage in all rests, and from
      the leaks while the machine holds a load;
    - `sign_log_odds` (E,): log odds of each balance that the recorded flow has the right sign;
    - `creep_odds`: log odds that a held load creeps by leakage, if no pump's flow is recorded (`Flow.CREEP`);
    - `holds` (2,): numbers of holds (`HoldCounts`).
    """

    shut_odds: Number | None = None
    held_odds: Number | None = None
    sign_log_odds: Values | None = None
    creep_odds: Number | None = None
    holds: Annotated[Array, stored_array(2)] | None = None


class MachineOdds(NamedTuple):
    """Odds of a machine's unknowns before a recording of it is seen; by default those without healthy recordings.

    - `valves`: log odds that valves cut a resting pump off, infinite if the healthy recordings leave no doubt;
    - `rows` (E,): log odds of each balance that the recorded flow has the right sign;
    - `creep`: log odds that a held load creeps by leakage, rather than that a control loop holds it;
    - `holds`: holds of an open circuit, None if none is known.
    """

    valves: float = VALVES.prior
    flow_sign: Array | float = FLOW_SIGN.prior
    creep: float = CREEP.prior
    holds: HoldCounts | None = None

    @classmethod
    def from_healthy(
        cls, recordings: Sequence[RecordingOdds], n_balances: int, scatter_log_odds: float = 0.0
    ) -> MachineOdds:
        """Add the evidence of healthy recordings.

        `n_balances`: number of balances E of the judged recording; healthy recordings with another number tell nothing
        of the signs. `scatter_log_odds`: log odds of shut valves by the scatter of the healthy leakages. The valves
        hold a load for certain if the mean log odds of all rests, or of the rests under load, exceed `rest.sure_odds`
        (`priors.toml`).
        """
        by_rests = [recording.shut_odds for recording in recordings if recording.shut_odds is not None]
        by_holds = [recording.held_odds for recording in recordings if recording.held_odds is not None]
        creep = [recording.creep_odds for recording in recordings if recording.creep_odds is not None]
        signs = [recording.sign_log_odds for recording in recordings if recording.sign_log_odds is not None]
        holds = [recording.holds for recording in recordings if recording.holds is not None]
        is_certain = any(odds and float(np.mean(odds)) > INFERENCE.rest.sure_odds for odds in (by_rests, by_holds))
        counts = np.sum([np.zeros(2), *holds], axis=0)
        return cls(
            valves=np.inf if is_certain else float(VALVES.add(by_rests)) + scatter_log_odds,
            flow_sign=FLOW_SIGN.add([np.zeros(n_balances), *(odds for odds in signs if len(odds) == n_balances)]),
            creep=float(CREEP.add(creep)),
            holds=HoldCounts(*map(int, counts)) if counts.any() else None,
        )

    @property
    def is_valve_certain(self) -> bool:
        """True if the healthy recordings leave no doubt that shut valves hold a load at rest (`Valves.SURELY_SHUT`)."""
        return self.valves == np.inf


#: The odds without healthy recordings.
PRIOR_ODDS = MachineOdds()
