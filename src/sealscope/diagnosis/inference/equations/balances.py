"""The volume balances of a machine, by its circuit and the channels that are recorded, and the samples that they read.

A balance consists of terms (`terms`). There is one of a cylinder whose pump or flow meter gives the flow; one for each
chamber behind a servo valve; and one of a pump, or of a held load, while the piston stands still.

In an open circuit (`feed_one_chamber`) the pump feeds one chamber at a time while the other drains to the tank. The
coefficient of a term of motion is the area of the side that the pump feeds in this direction, whichever side
carries the load; oil that the other chamber loses to the outside does not count. While the piston rests, the side that
carries the load counts instead, by whose oil the load creeps. Compliances count on both sides, although the pump's flow
shows that of the fed chamber only: without the other, more leaks are missed (decision 68).

The samples are prepared for it: clips and holes are marked, the drive is derived, unknown flows are left out. That is
done for whole recordings (`regimes`, `circuit.without_position`), for each block of a stream (`block_stream`), and for
the curves of the workbench.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Mapping
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.control.drive import Drive
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
    MIN_ABSOLUTE_PRESSURE,
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
    Signals,
    Term,
    chamber_terms,
    compensated_leak_term,
    compliance_term,
    conductance_term,
    delay_term,
    external_leak_term,
    fitted_term,
    free_air_term,
    increments_of,
    interval_means,
    metering_edge_terms,
    motion_term,
)
from sealscope.diagnosis.inference.hypotheses import HoldCounts
from sealscope.diagnosis.inference.machine_states import (
    AVERAGING_TIME,
    NEVER,
    LoweringLimits,
    RestLimits,
    flag_lowering,
    rest_limit,
)
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import METERS, flow_source
from sealscope.recordings.corrections.gaps import flag_holes
from sealscope.recordings.motion import find_runs
from sealscope.recordings.quality import find_rails
from sealscope.recordings.recording import Array, Recording
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Channels that balances read.
READ = ("u", "theta", "omega", *METERS, "x", "p_1", "p_2", "p_A", "p_B")
#: Name of a signal that is 1 in holes (long gaps of missing samples that were filled in), else 0; absent without holes.
HOLE = "hole"
#: Name of p_A - p_B as recorded, among the samples of a recording in which pressures are clipped.
CLIPPED_DIFFERENCE = "p_A - p_B, clipped"


def bridged_samples(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples (n,) of those channels `names` that are recorded, with clipped pressures as NaN.

    Holes, i.e. long gaps of missing samples, keep the values with which the inspection filled them
    (`corrections.gaps`); the additional entry `HOLE` is then 1 there and 0 elsewhere. If a pressure is clipped, the
    additional entry `CLIPPED_DIFFERENCE` is p_A - p_B as recorded, for the pressure level of a block: clipped values
    are closer to the true ones than the mean of the other samples.
    """
    samples, is_clipped = {}, False
    is_hole = flag_holes(recording)
    if is_hole.any():
        samples[HOLE] = is_hole.astype(float)
    for name, values in recording.channels.items():
        if name in names:
            # rails: values at which the pressure transducer clips
            rails = list[float]()
            if name.startswith("p_"):
                finite = values[np.isfinite(values)]
                rails = [rail.value for rail in find_rails(finite, recording.units[name])]
            samples[name] = np.where(np.isin(values, rails), np.nan, values) if rails else values
            is_clipped |= bool(rails)
    if is_clipped and {"p_A", "p_B"} <= samples.keys():
        samples[CLIPPED_DIFFERENCE] = recording["p_A"] - recording["p_B"]
    return samples


def samples_without_holes(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples (n,) of the channels `names` as `bridged_samples` does, but NaN in long gaps."""
    samples = bridged_samples(recording, names)
    is_hole = samples.pop(HOLE, np.zeros(0)) > 0.0
    return {name: np.where(is_hole, np.nan, values) for name, values in samples.items()} if is_hole.any() else samples


def derive_drive_signals(
    samples: Mapping[str, Array], rig: Rig, rate: float, *, loaded: bool = False
) -> dict[str, Array]:
    """Add signals from a model of the drive to the samples of a recording, each an array (n,) by channel name.

    `rate`: sampling rate [Hz]. The added entry `START` is exp(-t/lag) at the time t since the first sample: the effect
    of the drive's unknown initial state decays with the time constant lag. If only the command u shows the pump's flow,
    the drive's response to u is added as the pump's speed "omega" [rad/s], NaN where u is missing. If `loaded` is true,
    the drive responds to the load p_A - p_B as well. Otherwise the droop of the real speed under load counts as
    leakage.
    """
    drive = Drive.from_rig(rig)
    derived = {START: np.exp(-np.arange(len(samples["p_A"])) / (rate * drive.lag))}
    if flow_source(samples) == "u":
        u = _hold_missing(samples["u"])
        load = np.zeros(len(u))
        if loaded:
            dp = _hold_missing(samples["p_A"] - samples["p_B"])
            # the order of the pump's ports is unknown: the load is dp or -dp, whichever correlates positively with u
            load = dp if float((u - u.mean()) @ (dp - dp.mean())) >= 0.0 else -dp
        speed = drive.speed(u, load, rate)
        derived["omega"] = np.where(np.isnan(samples["u"]), np.nan, speed)
    return {**samples, **derived}


def _hold_missing(values: Array) -> Array:
    """Replace each missing value (NaN) of an array (n,) by the last known one; by 0 before the first."""
    last = np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(len(values))))
    return np.where(last < 0, 0.0, values[last])


def without_lowering(
    samples: Mapping[str, Array], rate: float, balance: Equation, limits: LoweringLimits | None = None
) -> dict[str, Array]:
    """Set the channel of the pump's flow to NaN while the piston moves past the resting pump (`flag_lowering`).

    `samples`: arrays by channel name at the `rate` [Hz]; `balance`: volume balance, whose left side is the pump's flow;
    `limits`: as in `flag_lowering`.
    """
    signals = Signals(samples, rate)
    difference = signals.compute_pressure_difference()
    is_lowered = flag_lowering(balance.left(signals), samples["x"], difference, rate, limits)
    return without_flow(samples, is_lowered)


def without_flow(samples: Mapping[str, Array], is_unknown: NDArray[np.bool_]) -> dict[str, Array]:
    """Set the channel of the pump's flow to NaN on either side of the sampling intervals that `is_unknown` flags."""
    source = flow_source(samples)  # not None: the balance has a recorded flow
    if source is None or not is_unknown.any():
        return dict(samples)
    is_touched = np.append(is_unknown, False) | np.append(False, is_unknown)
    return {**samples, source: np.where(is_touched, np.nan, samples[source])}


def absolute_offset(pressure: Array) -> float:
    """Compute absolute minus gauge pressure [Pa] for a sensor with the readings `pressure` (n,) [Pa].

    It is the atmospheric pressure, or more where the lowest reading would otherwise lie below `MIN_ABSOLUTE_PRESSURE`.
    """
    finite = pressure[np.isfinite(pressure)]
    min_reading = float(np.min(finite)) if finite.size else 0.0
    return max(P_ATM, MIN_ABSOLUTE_PRESSURE - min_reading)


#: Side of the terms of leaks to the outside, by their names.
_SIDES = {term.name: side for side in "AB" for term in (external_leak_term(side), compensated_leak_term(side))}


class FeedSums(NamedTuple):
    """Sums over the time in which pump and piston move, which show how an open circuit's pump feeds the chambers.

    They add up over the parts of a recording, so that a stream learns them block by block.

    Parameters
    ----------
    volumes : pair of floats
        Volume of the pump [m^3], > 0, while x grows and while it falls.
    distances : tuple of 4 floats
        Distance of the piston [m], > 0, in each of `MOTIONS`.
    work : float
        Sum of the products of the increments of volume and distance [m^4]: > 0 if flow and position have one sense.
    delivered, time : float, float
        Volume that the pump delivers either way [m^3], and the time [s] over which its flow is known.
    """

    volumes: tuple[float, ...] = (0.0, 0.0)
    distances: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    work: float = 0.0
    delivered: float = 0.0
    time: float = 0.0

    @classmethod
    def measure(cls, equation: Equation, signals: Signals, span: slice = slice(None)) -> FeedSums:
        """Sum over the sampling intervals `span` of the signals, which have limits of rest."""
        volume, step = equation.left(signals)[span], signals.step("x")[span]
        is_known = (signals.moving(equation.left)[span] > 0.0) & np.isfinite(volume)
        is_counted = is_known & np.isfinite(step)
        # of a coarse encoder most increments are 0, so that its averaged speed tells the direction
        weights = {motion: signals.direction_weights(*motion)[span][is_counted] for motion in MOTIONS.values()}
        counted_volume, counted_step = volume[is_counted], step[is_counted]
        volumes = [
            abs(float((weights[outward, True] + weights[outward, False]) @ counted_volume)) for outward in (True, False)
        ]
        return cls(
            volumes=tuple(volumes),
            distances=tuple(abs(float(weight @ counted_step)) for weight in weights.values()),
            work=float(counted_volume @ counted_step),
            delivered=float(np.abs(volume[is_known]).sum()),
            time=float(np.count_nonzero(is_known) * signals.dt),
        )

    def add(self, other: FeedSums) -> FeedSums:
        """Return the sums over two parts of a recording."""
        return FeedSums(
            volumes=tuple(map(sum, zip(self.volumes, other.volumes, strict=True))),
            distances=tuple(map(sum, zip(self.distances, other.distances, strict=True))),
            work=self.work + other.work,
            delivered=self.delivered + other.delivered,
            time=self.time + other.time,
        )

    @property
    def ways(self) -> tuple[float, float]:
        """Distance [m] while x grows, and while it falls."""
        out_A, out_B, in_A, in_B = self.distances
        return out_A + out_B, in_A + in_B

    @property
    def flow_per_speed(self) -> tuple[float, float]:
        """Volume over distance [m^2] while x grows, and while it falls, both of which must have been recorded."""
        (volume_out, volume_in), (way_out, way_in) = self.volumes, self.ways
        return volume_out / way_out, volume_in / way_in

    @property
    def mean_flow(self) -> float | None:
        """Mean flow in motion [m^3/s], None without motion."""
        return self.delivered / self.time if self.time > 0.0 else None

    def find_feed(self, area_ratio: float) -> Feed:
        """Find the chamber that the pump feeds while x grows: that of the larger area if more flow moves the piston.

        Flows are compared per distance, whatever the signs of flow and position. If the areas differ by less than these
        ratios scatter (`feed.scatter` of `priors.toml`), it is A if the flow is positive while x grows. `area_ratio`:
        that of `Equation`.
        """
        areas_tell = abs(float(np.log(area_ratio))) > INFERENCE.feed.scatter
        if areas_tell and min(self.ways) > 0.0:
            flow_out, flow_in = self.flow_per_speed
            feeds_A = (flow_out > flow_in) == (area_ratio < 1.0)
        else:
            feeds_A = self.work >= 0.0
        sense = float(np.sign(self.work))  # of the flow while x grows
        return Feed("A" if feeds_A else "B", sense if feeds_A else -sense)


class Feed(NamedTuple):
    """Order in which the pump of an open circuit feeds the chambers.

    `outward`: chamber that it feeds while x grows; `sign_A`: sign of its flow while it feeds A, 0 if it never moves.
    """

    outward: Literal["A", "B"]
    sign_A: float


def feed_one_chamber(equation: Equation, feed: Feed) -> Equation:
    """Adapt the volume balance of a cylinder to a pump that feeds one chamber at a time.

    The terms of motion count the creep of a piston at rest with the area of the side that carries the load. A leak to
    the outside counts while its chamber is fed or, while the pump rests, carries the load. The signals from which the
    terms are computed must have limits of rest.
    """
    adapted = equation._replace(fed_outward=feed.outward)

    def adapt(term: Term) -> Term:
        """Adapt one term."""
        if term.name in MOTIONS:
            return term.with_increments(partial(_carried_increments, term=term, equation=adapted))
        if term.name in _SIDES:
            counted = partial(_counted_increments, term=term, left=equation.left, sign_A=feed.sign_A)
            return term.with_increments(counted)
        return term

    return adapted._replace(terms=tuple(map(adapt, equation.terms)))


def motions_of_side(equation: Equation, side: str) -> list[str]:
    """Return the names of the terms of motion (`MOTIONS`) whose coefficient is the piston's area on `side` "A" or "B".

    In a closed circuit that is the side that carries the load, otherwise the one that the pump feeds.
    """
    if not equation.fed_outward:
        return [name for name in MOTIONS if name.endswith(f"{side} carries")]
    return [name for name, (outward, _) in MOTIONS.items() if outward == (equation.fed_outward == side)]


def flag_circulation(
    equation: Equation, signals: Signals, mean_flow: float | None, healthy_holds: HoldCounts | None = None
) -> NDArray[np.bool_]:
    """Flag the sampling intervals (n - 1,) in which the pump's flow probably circulates to the tank, past the cylinder.

    Valves of an open circuit may be in neutral while the pump turns and the piston rests. Otherwise the pump holds the
    load, and its flow is what leaks and compresses the oil. The two are told apart for each hold by its mean flow, as a
    fraction f of that in motion. A flow that circulates has any fraction up to 1. That of a pump that holds the load is
    a log-normal one, with the median `feed.holding_flow` and the spread `feed.spread` (`priors.toml`); or, with the
    probability `size.present`, it has any fraction up to 1 as well, since a leak stalls the piston. The log odds of a
    flow that circulates are those of `healthy_holds`, the holds of the healthy recordings. Holds that are shorter than
    `rest.shortest_hold`, in which a pump builds up a pressure, have no leak and the prior odds. Nothing is flagged if f
    is unknown. Each block of a stream judges a hold by the part of it that the block's samples contain. `mean_flow`:
    `FeedSums.mean_flow`.
    """
    prior, healthy_log_odds = INFERENCE.feed, (healthy_holds or HoldCounts()).log_odds
    flow, is_held = np.abs(equation.left(signals)), signals.holding(equation.left) > 0.0
    circulates = np.zeros(len(flow), dtype=bool)
    if not (mean_flow and is_held.any()):
        return circulates
    for first, length in find_runs(is_held).tolist():
        hold = slice(first, first + length)
        flow_held = flow[hold][np.isfinite(flow[hold])] * signals.rate
        if not flow_held.any():
            continue
        fraction = float(flow_held.mean()) / mean_flow
        deviation = np.log(fraction / prior.holding_flow) / prior.spread
        density = np.exp(-0.5 * deviation**2) / (fraction * prior.spread * np.sqrt(2.0 * np.pi))
        is_lasting = length >= INFERENCE.rest.shortest_hold * signals.rate
        leaks, log_odds = (INFERENCE.size.present, healthy_log_odds) if is_lasting else (0.0, prior.circulation_odds)
        # the density of f is 1 if the flow circulates or leaks, also for a few f above 1
        circulates[hold] = log_odds - np.log(max((1.0 - leaks) * density + leaks, np.finfo(float).tiny)) > 0.0
    return circulates


def _counted_increments(signals: Signals, *, term: Term, left: Callable[[Signals], Array], sign_A: float) -> Array:
    """Compute the increments (n - 1,) of a leak to the outside, 0 while neither the pump's flow nor a load shows it.

    `left`: left side of the volume balance, the pump's flow; `sign_A`: its sign while the pump feeds A.
    """
    turns = signals.moving(left) + signals.holding(left) > 0.0  # the pump
    counts_A = np.where(turns, sign_A * left(signals) > 0.0, interval_means(signals.carried_by_A))
    return np.asarray(term.increments(signals) * (counts_A if _SIDES[term.name] == "A" else 1.0 - counts_A))


def _carried_increments(signals: Signals, *, term: Term, equation: Equation) -> Array:
    """Compute the increments (n - 1,) of a term of motion whose creep at rest moves the area that carries the load.

    While pump or piston rests, the increments are multiplied by the area of the side that carries the load, over that
    of the side that the pump feeds in this direction.
    """
    _, by_A = MOTIONS[term.name]
    feeds_A = term.name in motions_of_side(equation, "A")
    area_B = equation.area_ratio  # over the area of A
    factor = (1.0 if by_A else area_B) / (1.0 if feeds_A else area_B)
    is_moving = signals.moving(equation.left)
    return np.asarray(term.increments(signals) * np.where(is_moving > 0.0, 1.0, factor))


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
    (`derive_drive_signals`). The offset of the flow, which cannot be separated from leakage under a
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

    If the pump's flow is recorded, the circuit must have valves that hold the load, and the command must be recorded:
    it is constant while they are shut. If the command alone is recorded, nobody may state the displacement of a pump
    otherwise, as the command may then be that of a valve. If neither is recorded, any circuit is accepted, although a
    control loop may then hold the load and replace the leaking oil.
    """
    if not {"x", *PRESSURES} <= channels:
        return None
    source = flow_source(channels)  # the pump's flow, or else the command
    may_be_shut = rig.circuit.holds_load or (source == "u" and not rig.states("pump.q_b"))
    if source is not None and not (may_be_shut and "u" in channels):
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
    command, from which the speed has been derived (`derive_drive_signals`). Return None if none of them
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
    """Add terms of the delays of the position, unless the balance has `LAG`, and of the chamber pressures.

    They are tested in `sensor_errors`. A pressure counts in the balances that contain the compliance of its chamber.
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
