"""Steps of the coefficients of a volume balance's terms, as observables: rival descriptions of the same residual.

Each hypothesis is one step of one coefficient, at an unknown onset. The hypotheses differ only in the term, so that
their scores (twice the log likelihood ratios) can be compared directly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.estimate.change import Information, StepTest, fit_history, step_test
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.blocks import (
    Blocks,
    ColumnRoles,
    estimate_offset,
    information,
    offset_penalty,
    sum_blocks,
)
from sealscope.diagnosis.inference.changes.charge_pressure import ChargeTrend
from sealscope.diagnosis.inference.equations.terms import (
    AIR,
    BIAS,
    HOLDING,
    LEAK,
    MADE_UP,
    ORIFICE,
    PUMP,
    SPEED_LOSS,
    Equation,
    Term,
    delay_name,
)
from sealscope.diagnosis.inference.hypotheses import LAWS, step_penalty
from sealscope.diagnosis.inference.leak_flow import apparent_conductances
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.sensor_errors import DELAYED, DelayChange, DelayTest
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Name of the data that these observables describe.
VOLUMES = "volumes"
#: Name of the data that the tests of channels' delays describe.
DELAYS = "delays"
#: Observable of a change of the scale of the motion: displacement, angle or speed, or the position behind a valve.
SCALE = "scale"
#: Observable of a constant loss of flow, if the sensor of the flow has no offset.
OUTSIDE = "loss to the outside"
#: Observable of the offset of the flow's sensor.
FLOW_ZERO = "zero of the flow"
#: Exponents of the flow of leaks in p_A - p_B, by the name of the observable.
_LEAK_EXPONENTS = {LEAK: 1.0, ORIFICE: 0.5} | {f"leak of exponent {e:g}": e for e in LAWS if e < 1.0}
#: Causes whose coefficients wear can only raise: leaks.
_ONE_WAY = ("piston leak", "piston or pump leak", "pump leak", "external leak")


def volume_observables(
    blocks: Blocks,
    plain: Blocks,
    balances: Sequence[Equation],
    columns: Sequence[ColumnRoles],
    oil_loss: Mapping[str, StepTest],
    volume_ratio: float = 1.0,
    charge: ChargeTrend | None = None,
    flow_scale: float = 1.0,
    with_orifice: bool = True,
    port_offset: Estimate | None = None,
) -> tuple[Observable, ...]:
    """Test coefficients of a volume balance for a step (`_step_hypotheses`), and return the results by falling score.

    The piston's leak is tested for a step up only, as a laminar flow, and as a flow proportional to a power of p_A
    - p_B below 1, the latter with and without the sensor offset. A scale of both pressures looks like a step of it
    or of the pump's leak, so that their results state the scale (`_pressure_scale`). A laminar leak has no prior on
    its size, but pays for an improbable sensor offset. The `advantage` of a result comes from the priors on its
    size and on the power, from the sensor offset, and from the oil that the accumulator lost or the fall of the
    charge pressure.

    - `blocks`: blocks of the recording after removal of the sensor offset of p_A - p_B, for tests of laminar leaks.
    - `plain`: its blocks with the pressures as recorded, for all other tests.
    - `balances`, `columns`: the volume balances, and the roles of their columns.
    - `oil_loss`: for each external leak, by the name of its term, a step test of the oil that the accumulator lost.
    - `volume_ratio`: ratio of piston area to pump displacement as measured, over that assumed.
    - `charge`: trend of the charge pressure, None if it is unknown.
    - `flow_scale`: true flow over the flow that the balance gives with the assumed sizes.
    - `with_orifice`: also test the coefficient of an orifice's flow; false with few blocks, in which this flow looks
      like a change of the motion's scale.
    - `port_offset`: offset of p_A - p_B minus that of p_1 - p_2 [Pa], None if unknown.
    """
    # these steps need be dated only to a fraction 1 / `blocks.coarse` of the recording
    centred, recorded = (series.merge(max_blocks=INFERENCE.blocks.coarse) for series in (blocks, plain))
    # a laminar leak is tested without the sensor offset, so an improbable offset counts against the leak
    offset = estimate_offset(blocks, columns)
    leak_disadvantage = offset_penalty(offset)
    if port_offset is not None:
        # of two far sensors of the cylinder, or of the ports, either explains the difference of the offsets
        leak_disadvantage = max(
            leak_disadvantage + _port_penalty(offset, port_offset) - _port_penalty(0.0, port_offset), 0.0
        )
    observables = dict[str, Observable]()
    terms = [term for term in balances[0].terms if with_orifice or term.name != ORIFICE]
    for name, signs, coefficient, shape, is_centred in _step_hypotheses(
        centred, recorded, terms, columns, bool(oil_loss)
    ):
        step = step_test(coefficient, signs, shape)
        if step is None:
            continue
        pressure_scale = _pressure_scale(coefficient, step) if name in (PUMP, *_LEAK_EXPONENTS) else None
        if is_centred:
            advantage = -leak_disadvantage
        else:
            advantage = -_size_penalty(name, step.fitted.value, recorded, columns[0].names, volume_ratio, flow_scale)
        prior = LAWS[_LEAK_EXPONENTS.get(name, 1.0)]  # 1.0, without effect, for all but leaks past the piston
        advantage += 2.0 * float(np.log(prior / LAWS[1.0]))
        term = name.removesuffix(MADE_UP)  # the end of a name that marks a leak whose lost oil a check valve replaces
        if (accumulator_test := oil_loss.get(term)) is not None:
            advantage += _accumulator_support(step, accumulator_test)
        elif charge is not None and (name == OUTSIDE or name.startswith("external leak")):
            # the coefficient of a loss to the outside (OUTSIDE) is a flow, that of other leaks a flow per pressure
            unit_flow = 1.0 if name == OUTSIDE else recorded.driving_pressure(columns[0].names, term)
            flow = step.fitted.value * unit_flow * flow_scale
            advantage += charge.loss_support(flow, float(step.onsets[step.best]))
        observable = Observable.from_test(
            name, VOLUMES, step, n_tests=len(signs), advantage=advantage, pressure_scale=pressure_scale
        )
        # a leak that is not laminar is tested with and without the sensor offset
        observables[name] = max(
            observables.get(name, observable), observable, key=lambda test: test.score + test.advantage
        )
    return tuple(sorted(observables.values(), key=lambda observable: -observable.score))


def delay_observables(tests: Sequence[DelayTest], changes: Sequence[DelayChange]) -> tuple[Observable, ...]:
    """Convert tests of delays to observables, whose sizes are in seconds.

    A test of the position bears the name of the flow's channel if the first of the `changes` is one of that channel.
    """
    removed = {change.channel for change in changes}
    flow = next((change.channel for change in changes if change.channel not in DELAYED), "x")
    observables = []
    for channel, test, change, _, onset in tests:
        name = flow if channel == "x" and "x" not in removed else channel
        advantage = -step_penalty(change.value, INFERENCE.delay)
        # two tests: later, or earlier
        observable = Observable.from_test(delay_name(name), DELAYS, test, n_tests=2.0, advantage=advantage)
        observables.append(replace(observable, size=change.value, onset=onset))
    return tuple(observables)


def _port_penalty(offset: float, port_offset: Estimate) -> float:
    """Compute how improbable the offset of p_1 - p_2 is for an `offset` of p_A - p_B [Pa] (`offset_penalty`)."""
    usual: float = INFERENCE.zero.pressure
    return offset_penalty((offset - port_offset.value) * usual / float(np.hypot(usual, port_offset.deviation)))


def _pressure_scale(conductance: Information, step: StepTest) -> Estimate | None:
    """Compute the logarithm of a factor on both pressures that would make a leak's conductance appear to step up.

    With such a factor and the same leakage, the apparent conductance G_1 becomes G_2 = G_1 / factor. `conductance`: its
    likelihood in the blocks of the recording; `step`: test for the step. Return None if no block lies before or after
    the onset, or if the mean conductance of these blocks is not positive.
    """
    history = fit_history(conductance, step, with_step=True)
    is_after = np.asarray(conductance.time > step.onsets[step.best])
    if is_after.all() or not is_after.any():
        return None
    before, after = (history.average(flags / np.count_nonzero(flags)) for flags in (~is_after, is_after))
    if not min(before.value, after.value) > 0.0:
        return None
    relative_errors = [mean.deviation / mean.value for mean in (before, after)]
    return Estimate(math.log(before.value / after.value), math.hypot(*relative_errors))


def _size_penalty(
    name: str, size: float, blocks: Blocks, names: Sequence[str], volume_ratio: float, flow_scale: float
) -> float:
    """Compute how improbable the size of a step is: -2 log(prior density / largest density), 0 without a prior.

    A prior that only limits the size (`above`) also gives 0 for steps below its limit. `name`: name of the coefficient
    in the volume balance that changes by `size`; `names`: names of the columns of `blocks`. `volume_ratio` and
    `flow_scale` convert `size` to the quantity of the prior (`volume_observables`).
    """
    if name == SCALE:
        return step_penalty(size, INFERENCE.scale)
    if name == AIR:
        return step_penalty(size / volume_ratio, INFERENCE.free_air, above=True)
    if name == FLOW_ZERO:
        return step_penalty(size / max(blocks.moving_flow, np.finfo(float).tiny), INFERENCE.flow_zero, above=True)
    if name == OUTSIDE:
        return step_penalty(size * flow_scale, INFERENCE.outside, above=True)
    if name.startswith("external leak"):
        return step_penalty(size * flow_scale * blocks.driving_pressure(names, name), INFERENCE.outside, above=True)
    return 0.0


def _step_hypotheses(
    centred: Blocks, recorded: Blocks, terms: Sequence[Term], columns: Sequence[ColumnRoles], has_accumulator: bool
) -> Iterator[tuple[str, Sequence[float], Information, Array | None, bool]]:
    """Yield the steps to test: of each term's coefficient, of leaks that are not laminar, and of the motion's scale.

    `centred`, `recorded`: the blocks `blocks` and `plain` of `volume_observables`; `terms`: terms of the first
    equation; `has_accumulator`: true if the recording shows the volume of an accumulator. Yields for each step its
    name, the signs to test (1 up, -1 down), the likelihood of the coefficient in K blocks, the change (K,) of the
    coefficient by a unit step, None if it is 1 in every block, and true if the blocks are `centred`.
    """
    first = columns[0]
    for term in terms:
        if _is_tested(term, first, has_accumulator):
            index = first.names.index(term.name)
            is_centred = term.name in (LEAK, PUMP)
            blocks = centred if is_centred else recorded
            # a leak only grows, but a constant flow is positive for a loss from side A and negative for one from side B
            signs = (1.0,) if term.cause in _ONE_WAY and term.name != BIAS else (1.0, -1.0)
            name = term.name
            if name == BIAS:  # the cause of a constant flow: an external leak, or an offset of the flow's sensor
                name = OUTSIDE if term.cause == "external leak" else FLOW_ZERO
            yield name, signs, information(blocks, columns, index), None, is_centred
    # the removed offset was estimated for a laminar leak, and may be the effect of another law
    for blocks in (recorded, centred):
        leak = information(blocks, columns, first.leak)
        for exponent, shape in apparent_conductances(blocks, columns).items():
            if exponent < 1.0:  # 1 is the laminar leak, tested above
                yield f"leak of exponent {exponent:g}", (1.0,), leak, shape, blocks is centred
    scale = first.names.index(ORIFICE)  # the column of the orifice, no longer needed, takes the motion's volume
    motion = information(_insert_fitted_motion(recorded, columns, scale), columns, scale)
    yield SCALE, (1.0, -1.0), motion._replace(level=np.inf), None, False  # without the prior on the orifice's leak


def _is_tested(term: Term, roles: ColumnRoles, has_accumulator: bool) -> bool:
    """Return True if the coefficient of a term of the volume balance is tested for a step by itself.

    `has_accumulator`: true if the recording shows the volume of an accumulator.
    """
    # The coefficients of motion change together, with an area, the displacement or a sensor's scale: the test of SCALE
    # covers them. The motion of one recording varies too little to test SPEED_LOSS. A leaking piston raises HOLDING as
    # well, which the test of the leak covers.
    if term.name.startswith("motion") or term.name in (SPEED_LOSS, HOLDING):
        return False
    if AIR in roles.names and term.cause == "air in the oil" and term.is_fitted:
        return False  # free air changes all these coefficients: the test of AIR (not a nuisance term) covers it
    # BIAS, a constant flow, is an external leak that no pressure drives; with an accumulator a pressure drives the leak
    return not (has_accumulator and term.name == BIAS)


def _accumulator_support(balance_test: StepTest, accumulator_test: StepTest) -> float:
    """Compute twice the log likelihood ratio of an external leak to no leak, by the oil that the accumulator lost.

    Let b be the size of the leak estimated from the volume balance, a its size estimated from the accumulator for the
    same onset, and s the standard error of a. The result is (a/s)^2 - ((a - b)/s)^2.
    """
    onset = balance_test.onsets[balance_test.best]
    nearest = int(np.abs(accumulator_test.onsets - onset).argmin())
    sizes = np.array([accumulator_test.size[nearest], balance_test.fitted.value])
    measured, expected = sizes / accumulator_test.deviation[nearest]  # a/s and b/s
    return float(measured**2 - (measured - expected) ** 2)


def _insert_fitted_motion(blocks: Blocks, columns: Sequence[ColumnRoles], index: int) -> Blocks:
    """Replace the column `index` of the Gram matrices by the volume of the piston's motion; return the new blocks.

    This volume is the sum of the columns of motion, each times its coefficient fitted to the whole recording. A change
    of the sensor's scale of position or speed by the fraction s changes the coefficient of the new column by s.
    """
    gram = blocks.gram.copy()
    for equation, (roles, total) in enumerate(zip(columns, sum_blocks(blocks, columns), strict=True)):
        nuisance, motion = list(roles.nuisance), list(roles.motion)
        coefficients = np.zeros(len(total))
        coefficients[nuisance] = Gaussian.from_gram(total).among(nuisance).mean
        transform = np.eye(len(total))  # matrix from the old columns to the new ones
        transform[:, index] = 0.0
        transform[motion, index] = coefficients[motion]
        gram[:, equation] = transform.T @ gram[:, equation] @ transform
    return replace(blocks, gram=gram)
