"""The volume balances of a machine, by its circuit and the channels that are recorded.

A balance consists of terms (`terms`). There is one of a cylinder whose pump or flow meter gives the flow; one for each
chamber behind a servo valve; and one of a pump, or of a held load, while the piston stands still.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.diagnosis.inference.equations.expressions import increments_of
from sealscope.diagnosis.inference.equations.signals import Signals, interval_means
from sealscope.diagnosis.inference.equations.terms import (
    BIAS,
    BIAS_TERM,
    CYLINDER,
    HOLDING,
    LAG,
    LAG_TERM,
    LEAK,
    LEAKS,
    LINES_TERM,
    LOADED_NULL_FLOW,
    MOTIONS,
    MOVING_BIAS,
    NULL_FLOW,
    PRESSURES,
    PUMP_TERM,
    SPEED_LOSS_TERM,
    START,
    START_TERM,
    TURNING,
    Coefficient,
    Equation,
    Flow,
    Term,
    chamber_terms,
    compensated_leak_term,
    compliance_term,
    conductance_term,
    delay_term,
    external_leak_term,
    fitted_term,
    free_air_term,
    metering_edge_terms,
    motion_term,
)
from sealscope.diagnosis.inference.machine_states import AVERAGING_TIME, NEVER, RestLimits, rest_limit
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import METERS, flow_source
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Terms of the balance of a cylinder whose flow is that of a pump, or of a meter in one of its lines.
_CYLINDER = (
    *map(motion_term, MOTIONS),
    *chamber_terms("A"),
    *chamber_terms("B"),
    LAG_TERM,
    SPEED_LOSS_TERM,
    BIAS_TERM,
    LINES_TERM,
    PUMP_TERM,
    external_leak_term("A"),
    external_leak_term("B", weight=-1.0),
    compensated_leak_term("A"),
    compensated_leak_term("B"),
    *LEAKS,
)


def _mask_term(term: Term, mask: Callable[[Signals], Array]) -> Term:
    """Multiply the increments of a term by the factors (n - 1,) that `mask` computes from the signals."""
    return term.with_increments(lambda s: np.asarray(mask(s) * term.increments(s)))


def _separate_at_rest(equation: Equation, null_sign: Callable[[Signals], Array]) -> Equation:
    """Let the leak of a balance behind a servo valve count only in motion, and add terms of the flow while at rest.

    While the piston rests, the spool of a servo valve is at its null: both chambers are connected with supply and
    return by edges whose small openings follow no law of the command. A leak past the piston then moves the spool, but
    hardly changes the flow. The balance gets two terms at rest with unknown coefficients: a flow with the sign that
    `null_sign` computes, (n - 1,), and one in proportion to p_A - p_B. `Signals.holding` flags all rests of the piston
    here, since the flow of such a balance never counts as resting (`find_rest_limits`). The terms of `equation`
    must end with `LEAKS`.
    """
    left = equation.left
    # as the openings change from rest to rest, both coefficients drift like the error of a sensor (`drift="bias"`)
    at_rest = (
        fitted_term(NULL_FLOW, "m^3/s", lambda s: s.holding(left) * null_sign(s) * s.dt, drift="bias"),
        conductance_term(
            LOADED_NULL_FLOW, lambda s: s.holding(left) * s.pressure_difference * s.dt, "sensor fault", drift="bias"
        ),
    )
    moving_leaks = [_mask_term(term, lambda s: s.moving(left)) for term in LEAKS]
    return equation._replace(terms=(*equation.terms[: -len(LEAKS)], *at_rest, *moving_leaks))


def is_separate_at_rest(equation: Equation) -> bool:
    """Return True if a balance has terms of its own while the piston rests (`_separate_at_rest`)."""
    return any(term.name == NULL_FLOW for term in equation.terms)


def _scale_to_side_A(equation: Equation) -> Equation:
    """Adapt the balance of a cylinder to an asymmetric pump, whose displacement on the left side is that of side A.

    While B carries the load, the pump moves less oil, in the ratio of the areas, so that all terms but the offset of
    the flow sensor take a larger part of the left side.
    """
    # displacement of side A over that of the side that carries the load
    factor = f"out_A + in_A + (out_B + in_B) / {equation.area_ratio!r}"
    terms = tuple(term if term.name == BIAS else term.scaled_by(factor) for term in equation.terms)
    return equation._replace(terms=terms)


def _supply_volume(s: Signals) -> Array:
    """Compute the volume [m^3] through a meter in a valve's supply line in each interval, with the sign of `q_supply`.

    The meter reads no sign. The inspection (`corrections.unsigned`) makes the flow negative while the valve feeds
    chamber B, if it can tell when; otherwise the volume counts as fed to A throughout.
    """
    return np.asarray(s.mean("q_supply") * s.dt)


def _supply_equation(rig: Rig) -> Equation:
    """Make the volume balance of a cylinder behind a valve whose supply line has a flow meter.

    The meter sees only the chamber that the supply feeds, A if the flow is positive, so that compression and external
    leaks of the other chamber do not count, and at rest those of neither (`_separate_at_rest`). An accumulator between
    meter and valve takes up oil with the pressure of the supply, if that is recorded.
    """

    def while_fed(side: str, *terms: Term) -> list[Term]:
        """Let terms of the chamber `side` count only while the supply feeds it and the piston moves."""
        sign = 1.0 if side == "A" else -1.0
        return [
            _mask_term(term, lambda s: s.moving(_supply_volume) * (sign * s.mean("q_supply") > 0.0)) for term in terms
        ]

    def direction(s: Signals) -> Array:
        """Compute the sign of the flow in each interval, which the inspection gave to the meter's offset as well."""
        return np.sign(s.mean("q_supply"))

    air = free_air_term(rig, weight_A=lambda s: (s.mean("q_supply") > 0.0).astype(float))
    terms = (
        *map(motion_term, MOTIONS),
        *while_fed("A", *chamber_terms("A")),
        *while_fed("B", *chamber_terms("B")),
        LAG_TERM,
        BIAS_TERM.with_increments(lambda s: s.moving(_supply_volume) * direction(s) * s.dt),
        *while_fed("A", external_leak_term("A")),
        *while_fed("B", external_leak_term("B", weight=-1.0)),
        _mask_term(air, lambda s: s.moving(_supply_volume)),
        fitted_term(
            "compliance of the supply",
            "m^3/Pa",
            lambda s: direction(s) * s.step("p_1"),
            drift="compliance",
            needs=("p_1",),
        ),
        *LEAKS,
    )
    area_ratio = rig.cylinder.A_B / rig.cylinder.A_A
    equation = Equation(CYLINDER, _supply_volume, terms, flow=Flow.SUPPLY, area_ratio=area_ratio)
    return _separate_at_rest(equation, direction)


def _chamber_equation(side: str, rig: Rig, channels: Container[str]) -> Equation:
    """Make the volume balance of one chamber, `side` "A" or "B", of a cylinder behind a servo valve.

    The volume A dx displaced by the piston equals the flow over the valve's edges, less compression and leakage. The
    left side is -A dx, so that a leak from A to B has a positive coefficient in both balances. An overlap of the edges
    (dead band) reduces the flow in both directions of motion. So does a leak, if friction makes p_A - p_B change its
    sign with the direction of motion: only the prior on a healthy piston separates the two. The leak counts only in
    motion; at rest a flow over the valve's null, of one unknown sign, takes its place (`_separate_at_rest`).
    """
    is_A = side == "A"
    area = rig.cylinder.A_A if is_A else rig.cylinder.A_B
    sign = 1.0 if is_A else -1.0  # a positive command connects A to the supply and B to the return
    return_pressure = rig.supply.p_return
    terms = (
        *metering_edge_terms(f"P to {side}", "p_1", f"p_{side}", sign, channels, return_pressure),
        *metering_edge_terms(f"{side} to T", f"p_{side}", "p_2", -sign, channels, return_pressure),
        *chamber_terms(side),
        BIAS_TERM,
        # each chamber's balance has the same terms of air and external leaks; those of the other chamber are zero
        free_air_term(rig, weight_A=lambda s: float(is_A)),
        external_leak_term("A", weight=float(is_A)),
        external_leak_term("B", weight=-float(not is_A)),
        *LEAKS,
    )
    equation = Equation(
        f"chamber {side}", lambda s: -area * s.step("x"), terms, INFERENCE.healthy.piston, Flow.VALVE, flow_sign=-1.0
    )
    return _separate_at_rest(equation, lambda s: np.ones_like(s.time_step))


def equations(rig: Rig, channels: frozenset[str]) -> tuple[Equation, ...]:
    """Return the volume balances of a machine that can be computed from the recorded `channels`; empty if none can.

    The position and both chamber pressures are always needed. Where a valve meters the flow into the chambers, and u
    and p_1 are recorded, there is one balance for each chamber. The pressure of the return is p_2, or `supply.p_return`
    of the rig if neither p_2 nor a flow meter is recorded. Otherwise there is one balance of the cylinder, whose flow
    is that of `pump_volume`.
    """
    if not {"x", *PRESSURES} <= channels:
        return ()
    # without p_2, a metered flow is preferred to an assumed pressure of the return
    has_return = "p_2" in channels or not channels & {*METERS}
    if not rig.circuit.pump_moves_piston and {"u", "p_1"} <= channels and has_return:
        return tuple(_select_recorded_terms(_chamber_equation(side, rig, channels), channels) for side in "AB")
    left, source = pump_volume(rig, channels), flow_source(channels)
    if left is None:
        return ()
    if source == "q_supply":
        return (_select_recorded_terms(_supply_equation(rig), channels),)
    # a speed computed from an angle has no offset, so that a constant residual flow is external leakage
    bias = BIAS_TERM._replace(cause="external leak", drift="outside") if "theta" in channels else BIAS_TERM
    terms = [bias if term is BIAS_TERM else term for term in _CYLINDER]
    if source == "u":
        terms.insert(0, START_TERM)
    if source == "q_pump":  # a meter is downstream of the filling loss
        terms.remove(SPEED_LOSS_TERM)
    # half of the air is in either chamber; on a single rod all is on the loaded side, as check valves keep the other at
    # the charge pressure
    single_rod = rig.cylinder.single_rod
    air = free_air_term(rig, weight_A=lambda s: interval_means(s.carried_by_A) if single_rod else 0.5)
    area_ratio = rig.cylinder.A_B / rig.cylinder.A_A
    equation = Equation(
        CYLINDER, left, tuple(terms), flow=_FLOWS.get(str(source), Flow.PUMP), area_ratio=area_ratio,
        left_expression=PUMP_VOLUMES.get(str(source), ""),
    )  # fmt: skip
    balance = _insert_before_leaks(equation, air)
    if rig.circuit.has_asymmetric_pump:
        balance = _scale_to_side_A(balance)
    return (_select_recorded_terms(balance, channels | {START}),)  # START is derived from the command


#: Leaks in a balance without a piston in motion: to the outside, and past piston and pump.
_STANDSTILL_LEAKS = (external_leak_term("A"), external_leak_term("B", weight=-1.0), *LEAKS)
#: Terms of such a balance of both chambers: their compliances, and the leaks.
_STANDSTILL = (*(chamber_terms(side)[0] for side in "AB"), *_STANDSTILL_LEAKS)


def circulation(rig: Rig, channels: frozenset[str]) -> Equation | None:
    """Return the volume balance of a pump over whole cycles or at standstill; None if circuit or channels allow none.

    The piston then displaces no net volume, so that the position need not be known. The signals must contain `START`
    (`balance_samples.derive_drive_signals`). The offset of the flow, which cannot be separated from leakage under a
    steady load, is assumed to be zero.
    """
    left = pump_volume(rig, channels)
    if not rig.circuit.pump_feeds_chambers or left is None or not channels.issuperset(PRESSURES):
        return None
    # here the speed that is computed from a command includes the droop under load, as a recorded one does
    flow = _FLOWS.get(str(flow_source(channels - {"u"})), Flow.PUMP)
    return Equation("circulation", left, (START_TERM, *_STANDSTILL), flow=flow)


def locked(rig: Rig, channels: frozenset[str]) -> Equation | None:
    """Return the volume balance of a load that is held by shut valves; None if circuit or channels do not allow it.

    The left side is the volume that must have leaked from A to B to let the piston move: -dx times the piston's area
    on the loaded side, where x is assumed to grow as A fills. Leaks of seal, valve and line cannot be separated.

    If a command or the pump's flow is recorded, the circuit must have valves that hold the load, and the command must
    be recorded: it is constant while they are shut. If neither is recorded, any circuit is accepted, although a control
    loop may then hold the load and replace the leaking oil.
    """
    if not {"x", *PRESSURES} <= channels:
        return None
    has_flow = flow_source(channels) is not None  # a command, or a flow of the pump
    if has_flow and not (rig.circuit.holds_load and "u" in channels):
        return None
    areas = {"A": rig.cylinder.A_A, "B": rig.cylinder.A_B}

    def loaded_side(s: Signals) -> str:
        """Return the side, "A" or "B", that on average carries the load."""
        return "A" if np.nanmean(s["p_A"] * areas["A"] - s["p_B"] * areas["B"]) > 0.0 else "B"

    compliance = compliance_term(
        "compliance of the loaded side", "m^3/Pa", lambda s: s.step(f"p_{loaded_side(s)}"), needs=PRESSURES
    )
    terms = (compliance, *_STANDSTILL_LEAKS)
    return Equation("locked", lambda s: -areas[loaded_side(s)] * s.step("x"), terms, flow=Flow.CREEP)


#: Source of the flow by the channel that shows it, if that is not the pump's angle or speed.
_FLOWS = {"q_pump": Flow.METER, "q_supply": Flow.SUPPLY, "u": Flow.COMMAND}
#: The volume that a pump delivers, as an expression of the channel that shows it.
PUMP_VOLUMES = {
    "theta": "displacement * change(theta)",
    "omega": "displacement * mean(omega) * dt",
    "q_pump": "mean(q_pump) * dt",
}


def pump_volume(rig: Rig, channels: frozenset[str]) -> Callable[[Signals], Array] | None:
    """Return a function that computes from `Signals` the volume [m^3] that the pump delivers in each sampling interval.

    The volume follows from the best recorded channel (`flow_source`): the pump's angle, its speed, a flow meter, or the
    command, from which the speed has been derived (`balance_samples.derive_drive_signals`). Return None if none of them
    is recorded, or only the command of a pump that does not feed the chambers.
    """
    source = flow_source(channels)
    if source == "q_supply":
        return _supply_volume
    if source == "u" and rig.circuit.pump_feeds_chambers:
        source = "omega"
    return increments_of(PUMP_VOLUMES[source], rig.pump.q_b / (2.0 * np.pi)) if source in PUMP_VOLUMES else None


def with_rests(equation: Equation) -> Equation:
    """Add three terms to a pump's volume balance, each of which counts in one state of the machine only (`STATES`).

    From these columns `regimes.apply_regime` makes the balance for valves that are open, or shut, while the pump rests.
    The increments, 0 in all other states, are (p_A - p_B) dt while the pump moves the piston (`TURNING`) or turns to
    hold the load (`HOLDING`), and dt while pump and piston move (`MOVING_BIAS`).
    """
    left = equation.left
    in_motion = Term(MOVING_BIAS, "m^3/s", lambda s: s.moving(left) * s.dt, "pump leak")
    return _insert_before_leaks(equation, *_pump_leakage_terms(equation), in_motion)


def shut_at_rest(equation: Equation) -> Equation:
    """Adapt a pump's volume balance to valves that cut the pump off from the cylinder while the pump rests.

    The pump's leakage gets two terms (`_pump_leakage_terms`), and the constant flow (`BIAS`) counts only while pump and
    piston move.
    """
    left = equation.left
    shut = _insert_before_leaks(equation, *_pump_leakage_terms(equation, drift="pump"))
    return shut._replace(
        terms=tuple(
            term.with_increments(lambda s: s.moving(left) * s.dt) if term.name == BIAS else term for term in shut.terms
        )
    )


def with_delays(equation: Equation) -> Equation:
    """Add terms of the delays of the position, unless the balance has `LAG`, and of the chamber pressures (`delays`).

    A pressure counts in the balances that contain the compliance of its chamber.
    """
    terms = []
    if LAG not in (term.name for term in equation.terms):
        # behind a servo valve, the displaced volume is the left side
        terms.append(delay_term("x", lambda s: -equation.left(s), "s", needs=("x",)))
    names = [term.name for term in equation.terms]
    for side in "AB":
        channel = f"p_{side}"
        weight = float(f"compliance {side}" in names)
        terms.append(delay_term(channel, partial(_weighted_step, channel, weight), "m^3 s/Pa", needs=(channel,)))
    return _insert_before_leaks(equation, *terms)


def _weighted_step(channel: str, weight: float, s: Signals) -> Array:
    """Compute the differences of neighbouring samples of a channel, times a weight."""
    return weight * s.step(channel)


def _pump_leakage_terms(equation: Equation, drift: Coefficient | Literal[""] = "") -> tuple[Term, Term]:
    """Make two terms of a pump's leakage: while it moves the piston, and while it turns to hold the load.

    Their increments are those of the leak in `equation`, whose left side is the pump's flow; `drift`: that of `Term`.
    """
    pump_volume, leak = equation.left, next(term for term in equation.terms if term.name == LEAK)
    # no further channels are needed: the balance requires both pressures anyway
    make_term = partial(conductance_term, cause="pump leak", needs=(), drift=drift)
    return (
        make_term(TURNING, lambda s: s.moving(pump_volume) * leak.increments(s)),
        make_term(HOLDING, lambda s: s.holding(pump_volume) * leak.increments(s)),
    )


def _insert_before_leaks(equation: Equation, *terms: Term) -> Equation:
    """Return a volume balance with additional terms before the leak's terms, which stay last."""
    *other_terms, laminar_leak, orifice_leak = equation.terms
    return equation._replace(terms=(*other_terms, *terms, laminar_leak, orifice_leak))


def _select_recorded_terms(equation: Equation, channels: frozenset[str]) -> Equation:
    """Return a volume balance without the terms that need a channel outside of `channels`."""
    return equation._replace(terms=tuple(term for term in equation.terms if channels.issuperset(term.needs)))


def find_rest_limits(samples: Mapping[str, Array], rate: float, balance: Equation) -> RestLimits:
    """Compute the flow of the pump and the speed of the piston below which they count as resting.

    Both are those of `rest_limit`, with two exceptions:

    - A balance with terms of its own at rest (`is_separate_at_rest`) needs the stops of the piston only. The flow never
      counts as resting (`NEVER`), so that a stop of the piston is `holding`. The piston's limit is the fraction
      `rest.motion_fraction` (`priors.toml`) of its mean speed in motion, and stops shorter than `MIN_REST` count.
    - If the flow is that of a meter (`q_pump`), it alone decides. Below the same fraction of its mean in motion, the
      valves are taken as shut, and a piston that still moves creeps by a leak: it never counts as resting.

    `samples`: arrays by channel name at the `rate` [Hz]; `balance`: volume balance, whose left side is the pump's flow.
    """
    signals = Signals(samples, rate)
    if is_separate_at_rest(balance):
        max_speed = rest_limit(signals.step("x"), rate, fraction=INFERENCE.rest.motion_fraction)
        return RestLimits(pump=NEVER, piston=max_speed, shortest=AVERAGING_TIME)
    if flow_source(samples) == "q_pump":  # no angle or speed of the pump is recorded
        max_flow = rest_limit(balance.left(signals), rate, fraction=INFERENCE.rest.motion_fraction)
        return RestLimits(pump=max_flow, piston=NEVER)
    return RestLimits(pump=rest_limit(balance.left(signals), rate), piston=rest_limit(signals.step("x"), rate))
