"""The terms of a machine's volume balance, computed from recorded channels.

A balance states where the volume of oil goes that the pump delivers: into motion of the piston, compression, air and
leakage. It is linear in the unknown coefficients of the machine. For a pump-controlled cylinder

    D dtheta = sum_j c_j f_j dg_j + G (p_A - p_B) dt,

with the pump's displacement D [m^3/rad] and angle theta, the leakage conductance G [m^3/(s Pa)] and a coefficient c_j
for each term; f_j and g_j are functions of the recorded channels. A term computes its increment f_j dg_j over each
sampling interval dt, so no signal is differentiated (`weak_form`). With a servo valve, each chamber has a balance. Its
left side is the volume displaced by the piston, and its terms include the orifice flows of the valve's metering edges.
G is the same in both chambers.

The priors on the drift of each coefficient are in `priors.toml`, with unit and source.

Source: Merritt, Hydraulic Control Systems, 1967, sections 5.2 and 6.3 (continuity of the chambers, flow of edges).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.channels import METERS, flow_source
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Minimum absolute pressure in the terms of air [Pa].
MIN_ABSOLUTE_PRESSURE: float = INFERENCE.pressure.least
#: Half the time of the central difference for speed and direction [s]: a few encoder counts at slow motion.
HALF_DIFFERENCE = 0.025
#: Averaging time of the speeds from which rests (standstills) are found, and minimum length of a rest [s].
AVERAGING_TIME, MIN_REST = INFERENCE.rest.averaged, INFERENCE.rest.least


class RestLimits(NamedTuple):
    """Speeds below which a machine counts as resting: flow of the `pump` [m^3/s] and speed of the `piston` [m/s].

    `shortest`: minimum length of a rest [s].
    """

    pump: float
    piston: float
    shortest: float = MIN_REST


class Signals:
    """Samples (n,) of recorded channels by name, in SI units, and signals derived from them.

    - `rate`: sampling rate [Hz];
    - `to_absolute`: absolute minus gauge pressure [Pa] by channel, by default atmospheric pressure;
    - `offset`: sensor offset [Pa] that is subtracted from p_A - p_B;
    - `rest_limits`: speeds below which the machine rests, None to find no rests.

    `step(name)` gives the differences of neighbouring samples, and `mean(name)` their means, (n - 1,) each.
    """

    def __init__(
        self,
        channels: Mapping[str, Array],
        rate: float,
        to_absolute: Mapping[str, float] | None = None,
        offset: float = 0.0,
        rest_limits: RestLimits | None = None,
    ) -> None:
        self._channels, self.rate, self._to_absolute, self._offset = channels, rate, to_absolute or {}, offset
        self._rest_limits = rest_limits
        self._states: tuple[Array, Array] | None = None
        self.step = cache(lambda name: np.asarray(np.diff(channels[name])))
        self.mean = cache(lambda name: _interval_means(channels[name]))

    def __contains__(self, name: object) -> bool:
        return name in self._channels

    def __getitem__(self, name: str) -> Array:
        return self._channels[name]

    @property
    def dt(self) -> float:
        """Sampling interval [s]."""
        return 1.0 / self.rate

    @property
    def time_step(self) -> Array:
        """Sampling interval dt [s], repeated for each interval, shape (n - 1,)."""
        return np.full(len(next(iter(self._channels.values()))) - 1, self.dt)

    @cached_property
    def pressure_difference(self) -> Array:
        """p_A - p_B [Pa] in the middle of each sampling interval, without the sensor offset, shape (n - 1,)."""
        return self.mean("p_A") - self.mean("p_B") - self._offset

    @property
    def pressure_root(self) -> Array:
        """sign(dp) sqrt(abs(dp)) [Pa^0.5] of the pressure difference dp = p_A - p_B, shape (n - 1,)."""
        return _signed_root(self.pressure_difference)

    @cached_property
    def port_difference(self) -> Array:
        """p_1 - p_2 [Pa] of the two ports of pump or valve, in the middle of each sampling interval, shape (n - 1,)."""
        return self.mean("p_1") - self.mean("p_2")

    @cached_property
    def absolute(self) -> Mapping[str, Array]:
        """Absolute pressure [Pa] at each sample, at least `MIN_ABSOLUTE_PRESSURE`, by the names "p_A" and "p_B"."""
        return {
            name: np.maximum(self._channels[name] + self._to_absolute.get(name, P_ATM), MIN_ABSOLUTE_PRESSURE)
            for name in ("p_A", "p_B")
        }

    @cached_property
    def speed(self) -> Array:
        """Speed of the piston [m/s] at each sample, by a central difference of x; x stays constant beyond the ends."""
        half_width = max(1, round(HALF_DIFFERENCE * self.rate))  # [samples]
        return central_difference(self._channels["x"], half_width) * (0.5 * self.rate / half_width)

    @cached_property
    def carried_by_A(self) -> Array:
        """1 for each sample (n,) in which side A carries the load, i.e. p_A - p_B exceeds the sensor offset, else 0."""
        return (self._channels["p_A"] > self._channels["p_B"] + self._offset).astype(float)

    def directed_step(self, outward: bool, by_A: bool) -> Array:
        """Compute the increments (n - 1,) of x [m] in a given direction while a given side carries the load, else 0.

        `outward`: true for motion towards B or standstill, false for motion towards A; `by_A`: true if A carries the
        load (`carried_by_A`), false if B does. If direction or loaded side change within an interval, half of its
        increment counts.
        """
        is_counted = ((self.speed >= 0.0) == outward) & (self.carried_by_A == by_A)
        return _interval_means(is_counted.astype(float)) * self.step("x")

    def moving(self, pump_volume: Callable[[Signals], Array]) -> Array:
        """Return 1 for each sampling interval (n - 1,) in which pump and piston move, else 0.

        `pump_volume` computes the volume [m^3] that the pump delivers in each interval. Without `rest_limits` all
        intervals count as motion.
        """
        return self._find_states(pump_volume)[0]

    def holding(self, pump_volume: Callable[[Signals], Array]) -> Array:
        """Return 1 for each sampling interval (n - 1,) in which the pump turns and the piston rests, else 0.

        `pump_volume`: as in `moving`. Without `rest_limits` the result is 0 everywhere.
        """
        return self._find_states(pump_volume)[1]

    def _find_states(self, pump_volume: Callable[[Signals], Array]) -> tuple[Array, Array]:
        """Compute the results of `moving` and `holding`, and store them for later calls.

        Later calls return the stored results: all terms of a balance have the same `pump_volume`.
        """
        limits = self._rest_limits
        if limits is None:
            return np.ones_like(self.time_step), np.zeros_like(self.time_step)
        if self._states is None:
            pump_rests = find_rests(pump_volume(self), self.rate, limits.pump, limits.shortest)
            piston_rests = find_rests(self.step("x"), self.rate, limits.piston, limits.shortest)
            is_moving, is_holding = ~pump_rests & ~piston_rests, ~pump_rests & piston_rests
            self._states = is_moving.astype(float), is_holding.astype(float)
        return self._states


def find_rests(increments: Array, rate: float, limit: float, shortest: float = MIN_REST) -> NDArray[np.bool_]:
    """Flag the sampling intervals at rest, i.e. with a speed of at most `limit` for a time of at least `shortest` [s].

    `increments` (n,): increments of the pump's volume [m^3] or of the position [m], NaN (not at rest) where missing;
    `rate`: sampling rate [Hz]; `limit` in m^3/s or m/s. The speed is averaged over `AVERAGING_TIME`. A recording
    shorter than this time and `shortest` together has no rest.
    """
    window, min_length = max(1, round(AVERAGING_TIME * rate)), max(2, round(shortest * rate))  # [samples]
    if len(increments) < window + min_length:
        return np.zeros(len(increments), dtype=bool)
    is_known = np.isfinite(increments)
    sums = np.concatenate([[0], np.cumsum(np.where(is_known, increments, 0.0))])
    n_missing = np.concatenate([[0], np.cumsum(~is_known)])
    # a window of samples is flagged by its first sample if it is slow on average and no sample is missing
    is_slow = np.abs(sums[window:] - sums[:-window]) <= limit * window / rate
    is_slow &= n_missing[window:] == n_missing[:-window]
    n_moving = np.concatenate([[0], np.cumsum(~_extend_flags(is_slow, window))])
    is_rest_start = n_moving[min_length:] == n_moving[:-min_length]  # no moving sample among the next `min_length`
    return _extend_flags(is_rest_start, min_length)


def central_difference(values: Array, half_width: int) -> Array:
    """Compute the difference (n,) of the values `half_width` samples after and before each of n samples.

    It is not divided by the time. Beyond the ends the first and last values are repeated.
    """
    padded = np.pad(values, half_width, mode="edge")
    return np.asarray(padded[2 * half_width :] - padded[: -2 * half_width])


def _extend_flags(starts: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Flag each flagged sample of `starts` (n,) and the next `length` - 1 samples, shape (n + length - 1,)."""
    changes = np.zeros(len(starts) + length, dtype=int)  # +1 where a run begins, -1 past its end
    changes[: len(starts)] += starts
    changes[length:] -= starts
    return np.cumsum(changes)[:-1] > 0


def _interval_means(values: Array) -> Array:
    """Compute the means of neighbouring samples (n,), shape (n - 1,)."""
    means = values[1:] + values[:-1]
    means *= 0.5
    return means


def _signed_root(values: Array) -> Array:
    """Compute sign(v) sqrt(abs(v)) of each value v."""
    return np.asarray(np.sign(values) * np.sqrt(np.abs(values)))


#: Kinds of coefficients: each has priors on its drift and on its differences between recordings.
Coefficient = Literal["motion", "speed", "compliance", "air", "bias", "leak", "pump", "outside", "edge"]


class Term(NamedTuple):
    """A term of a volume balance: an unknown coefficient times a function of recorded channels.

    - `name`: name of the term, for example "compliance A"; `unit`: unit of the coefficient, m^3 over that of the
      increments;
    - `increments`: computes the increments f dg from `Signals` over each sampling interval, shape (n - 1,);
    - `cause`: cause of a sudden change of the coefficient, for example "external leak";
    - `drift`: entry of `priors.toml` with the prior on the coefficient's drift; "" if it is zero unless `cause` is
      present;
    - `needs`: channels from which the increments are computed;
    - `driver`: "pressure" if a pressure drives the flow, "root" if the square root of a pressure does, else "". In the
      first two cases offsets of pressure sensors change the increments.
    """

    name: str
    unit: str
    increments: Callable[[Signals], Array]
    cause: Cause
    drift: Coefficient | Literal[""] = ""
    needs: tuple[str, ...] = ()
    driver: Literal["", "pressure", "root"] = ""

    @property
    def nuisance(self) -> bool:
        """True if the coefficient is fitted in every recording, since it is unknown even in a healthy machine."""
        return bool(self.drift) and not self.compared

    @property
    def compared(self) -> bool:
        """True if the coefficient is fitted only to compare recordings: within one, the motion varies too little."""
        return self.drift == "speed"


class Equation(NamedTuple):
    """A volume balance of a machine: its left side equals the sum of its terms.

    Parameters
    ----------
    name : str
        Name of the balance, for example "cylinder".
    left : callable
        Computes the increments of the left side [m^3] from `Signals`, shape (n - 1,).
    terms : tuple of Term
        The terms, those of the leak last.
    healthy : float
        Standard deviation of a healthy machine's leakage conductance [m^3/(s Pa)]; infinite if unknown.
    by_command : bool
        True if no channel gives the pump's flow. A speed is then computed from the command u
        (`balance.derive_drive_signals`).
    flow_sign : float
        1 if a flow into A is positive on the left side, -1 if it is negative.
    area_ratio : float
        Area of the piston on side B over that on side A; 1 in a balance of one chamber.
    """

    name: str
    left: Callable[[Signals], Array]
    terms: tuple[Term, ...]
    healthy: float = float("inf")
    by_command: bool = False
    flow_sign: float = 1.0
    area_ratio: float = 1.0


#: Names of terms: first the leak past the piston or in the pump, laminar (the tested term) and through an orifice.
LEAK, ORIFICE = "leak", "leak through an orifice"
#: Free air in both chambers together, instead of one term for each chamber.
AIR = "free air"
#: The pump's leakage, driven by the pressures at its ports.
PUMP = "pump leak"
#: The pump's leakage driven by p_A - p_B, if a valve cuts the pump off at rest: while the pump moves the piston, and
#: while it turns only to hold the load.
TURNING, HOLDING = "pump leak while it turns", "pump leak while it holds"
#: Constant flow, for example by an offset of a flow sensor; an offset of the pressure sensors changes it, too.
BIAS = "bias"
#: Suffix for an external leak that a check valve compensates.
MADE_UP = ", made up"
#: A delay between position and flow.
LAG = "lag"
#: Loss of the pump that grows with speed: incomplete filling, and slip that depends on no recorded pressure.
SPEED_LOSS = "loss over speed"
#: The constant flow while pump and piston move.
MOVING_BIAS = "bias in motion"
#: All terms that are zero in some states of the machine.
STATES = TURNING, HOLDING, MOVING_BIAS
#: Flow from the supply past a valve at its null, while the piston rests: constant part, and part over p_A - p_B.
NULL_FLOW, LOADED_NULL_FLOW = "flow past the valve at rest", "flow past the valve at rest, under load"
#: Names of two balances: of a pump-controlled cylinder with a recorded position, and of a load held by valves.
CYLINDER, LOCKED = "cylinder", "locked"
#: Name of a derived signal: the decay, with the drive's time constant, of the speed loop's unknown initial state.
START = "start"

_PRESSURES = ("p_A", "p_B")
_sensor_term = partial(Term, cause="sensor fault")


def _conductance_term(
    name: str,
    increments: Callable[[Signals], Array],
    cause: Cause,
    needs: tuple[str, ...] = _PRESSURES,
    drift: Coefficient | Literal[""] = "",
) -> Term:
    """Make the term of an unknown conductance; `increments` computes the driving pressure times dt [Pa s]."""
    return Term(name, "m^3/(s Pa)", increments, cause, drift=drift, needs=needs, driver="pressure")


_LEAK_CAUSE: Cause = "piston or pump leak"
_LEAKS = (
    _conductance_term(LEAK, lambda s: s.pressure_difference * s.dt, _LEAK_CAUSE, drift="leak"),
    Term(ORIFICE, "m^3/(s Pa^0.5)", lambda s: s.pressure_root * s.dt, _LEAK_CAUSE, needs=_PRESSURES, driver="root"),
)


def _motion_term(outward: bool, by_A: bool) -> Term:
    """Make the term of the piston's motion `outward` (to B) or inward, while side A (`by_A`) or B carries the load."""
    name = f"motion {'out' if outward else 'in'}, {'A' if by_A else 'B'} carries"
    return _sensor_term(name, "m^2", lambda s: s.directed_step(outward, by_A), drift="motion", needs=("x",))


def _chamber_terms(side: str) -> tuple[Term, ...]:
    """Make the four terms of one chamber, `side` "A" or "B": two of its compliance, and two of the air in its oil.

    With the chamber's absolute pressure p, the position x, and changes d over a sampling interval, the increments are
    dp for a constant compliance, x dp for its change over the stroke, d(1/p) for free air, d ln p for dissolving air.
    """
    p, name = f"p_{side}", f"compliance {side}"
    compliance_term = partial(Term, cause="air in the oil", drift="compliance")
    air_term = partial(Term, cause="air in the oil", drift="air")
    return (
        compliance_term(name, "m^3/Pa", lambda s: s.step(p), needs=(p,)),
        compliance_term(f"{name} over the stroke", "m^2/Pa", lambda s: s.mean("x") * s.step(p), needs=(p, "x")),
        air_term(f"free air {side}", "m^3 Pa", lambda s: np.diff(1.0 / s.absolute[p]), needs=(p,)),
        air_term(f"dissolving air {side}", "m^3", lambda s: np.diff(np.log(s.absolute[p])), needs=(p,)),
    )


def _free_air_term(rig: Rig, weight_A: Callable[[Signals], Array | float]) -> Term:
    """Make the term of free air in both chambers: w V_A d(1/p_A) - (1 - w) V_B d(1/p_B).

    d is the change over a sampling interval; p_A and p_B are absolute. V_A and V_B are the volumes of the chambers at
    the current position, or at mid-stroke if the rig's file states fixed volumes. `weight_A` computes w, the weight (0
    to 1) of chamber A in the balance.
    """
    from sealscope.physics.cylinder import mid_stroke_volumes

    cylinder = rig.cylinder
    mid_volumes = dict(zip("AB", mid_stroke_volumes(cylinder), strict=True))
    # change of each volume with the position
    areas = {"A": cylinder.A_A, "B": -cylinder.A_B} if cylinder.volumes == "position" else {"A": 0.0, "B": 0.0}

    def expansion(s: Signals, side: str) -> Array:
        """Compute V d(1/p) [m^3/Pa] of the chamber `side` in each interval, with the volume V at the mean position."""
        # at least a tenth of the volume at mid-stroke: x of an unknown origin may exceed the stroke
        volumes = np.maximum(mid_volumes[side] + areas[side] * s.mean("x"), 0.1 * mid_volumes[side])
        return np.asarray(volumes * np.diff(1.0 / s.absolute[f"p_{side}"]))

    def weighted_expansion(s: Signals) -> Array:
        """Compute the increments of the term [m^3/Pa], shape (n - 1,)."""
        weight = weight_A(s)
        return np.asarray(weight * expansion(s, "A") - (1.0 - weight) * expansion(s, "B"))

    return Term(AIR, "Pa", weighted_expansion, "air in the oil", needs=("x", *_PRESSURES))


def _external_leak_term(side: str, weight: float = 1.0) -> Term:
    """Make the term of an external leak from `side` "A" or "B", with the increments `weight` max(p, 0) dt [Pa s].

    p is the gauge pressure of the side. `weight`: factor of this flow in the volume balance, 1 for a leak from A, -1
    for a leak from B, and 0 in a balance of the other chamber alone.
    """
    p = f"p_{side}"
    return _conductance_term(
        f"external leak {side}", lambda s: weight * np.maximum(s.mean(p), 0.0) * s.dt, "external leak", needs=(p,)
    )


def _compensated_leak_term(side: str) -> Term:
    """Make the term of an external leak from one side in a circuit whose check valve refills the low-pressure side.

    The leak counts only while its side has the higher pressure: max(p, 0) dt [Pa s] for A, -max(p, 0) dt for B.
    """

    def lost_volume(s: Signals) -> Array:
        """Compute the increments of the term [Pa s], shape (n - 1,)."""
        weight = _interval_means(s.carried_by_A) - float(side == "B")  # 1 or 0 for side A, 0 or -1 for side B
        return np.asarray(weight * np.maximum(s.mean(f"p_{side}"), 0.0) * s.dt)

    return _conductance_term(f"external leak {side}{MADE_UP}", lost_volume, cause="external leak")


_START = _sensor_term("start of the drive", "m^3/s", lambda s: s.mean(START) * s.dt, drift="bias", needs=(START,))
_BIAS = _sensor_term(BIAS, "m^3/s", lambda s: s.time_step, drift="bias")
_SPEED_LOSS = _sensor_term(
    SPEED_LOSS, "m s", lambda s: _interval_means(np.abs(s.speed)) * s.step("x"), drift="speed", needs=("x",)
)
_PUMP = _conductance_term(PUMP, lambda s: s.port_difference * s.dt, "pump leak", needs=("p_1", "p_2"))
#: The pressure drop of the lines acts on the pump's leakage only. With this term the leak's coefficient remains the
#: conductance of pump and piston together.
_LINES = _conductance_term(
    "pump leak by the lines",
    lambda s: (s.port_difference - s.pressure_difference) * s.dt,
    "pump leak",
    needs=("p_1", "p_2", *_PRESSURES),
    drift="pump",
)
#: The increments are changes of the piston's speed.
_LAG = _sensor_term(LAG, "m^2 s", lambda s: np.gradient(s.step("x") * s.rate), drift="motion", needs=("x",))
_CYLINDER = (
    *(_motion_term(outward, by_A) for outward in (True, False) for by_A in (True, False)),
    *_chamber_terms("A"),
    *_chamber_terms("B"),
    _LAG,
    _SPEED_LOSS,
    _BIAS,
    _LINES,
    _PUMP,
    _external_leak_term("A"),
    _external_leak_term("B", weight=-1.0),
    _compensated_leak_term("A"),
    _compensated_leak_term("B"),
    *_LEAKS,
)


def _masked(terms: Iterable[Term], mask: Callable[[Signals], Array]) -> tuple[Term, ...]:
    """Multiply the increments of terms by a `mask` (n - 1,) that is computed from the signals."""

    def masked(s: Signals, increments: Callable[[Signals], Array]) -> Array:
        """Compute the masked increments of one term."""
        return np.asarray(mask(s) * increments(s))

    return tuple(term._replace(increments=partial(masked, increments=term.increments)) for term in terms)


def _separate_at_rest(
    equation: Equation, null_flow: Callable[[Signals], Array], leaks: Sequence[str] = (LEAK, ORIFICE)
) -> Equation:
    """Give a balance behind a valve terms of its own while the piston rests, of whose coefficients nothing is known.

    While the piston rests, the spool of a servo valve is at its null: both chambers are connected with supply and
    return by edges whose small openings follow no law of the command. A leak past the piston then moves the spool, but
    hardly changes the flow. Therefore the terms `leaks` count only while the piston moves, and before them the balance
    gets two terms at rest: `null_flow` dt, and (p_A - p_B) dt.
    """
    left = equation.left
    at_rest = (
        _sensor_term(NULL_FLOW, "m^3/s", lambda s: s.holding(left) * null_flow(s) * s.dt, drift="bias"),
        _conductance_term(
            LOADED_NULL_FLOW, lambda s: s.holding(left) * s.pressure_difference * s.dt, "sensor fault", drift="bias"
        ),
    )
    terms = [_masked([term], lambda s: s.moving(left))[0] if term.name in leaks else term for term in equation.terms]
    return _insert_before_leaks(equation._replace(terms=tuple(terms)), *at_rest)


def is_separate_at_rest(equation: Equation) -> bool:
    """Return True if a balance has terms of its own while the piston rests (`_separate_at_rest`)."""
    return any(term.name == NULL_FLOW for term in equation.terms)


def _supply_volume(s: Signals) -> Array:
    """Compute the volume [m^3] through a meter in a valve's supply line in each interval, positive into chamber A."""
    return np.asarray(s.mean("q_supply") * s.dt)


def _supply_equation(rig: Rig) -> Equation:
    """Make the volume balance of a cylinder behind a valve whose supply line has a flow meter.

    The meter sees only the chamber that the supply feeds, A if the flow is positive, so that compression and external
    leaks of the other chamber do not count.
    """

    def fed(side: str, terms: Iterable[Term]) -> tuple[Term, ...]:
        """Let terms of the chamber `side` count only while the supply feeds it and the piston moves."""
        sign = 1.0 if side == "A" else -1.0
        return _masked(terms, lambda s: s.moving(_supply_volume) * (sign * s.mean("q_supply") > 0.0))

    def direction(s: Signals) -> Array:
        """Compute the sign of the flow in each interval; a meter without a sign has a zero in its direction."""
        return np.sign(s.mean("q_supply"))

    terms = (
        *(_motion_term(outward, by_A) for outward in (True, False) for by_A in (True, False)),
        *fed("A", _chamber_terms("A")),
        *fed("B", _chamber_terms("B")),
        _LAG,
        _BIAS._replace(increments=lambda s: s.moving(_supply_volume) * direction(s) * s.dt),
        *fed("A", (_external_leak_term("A"),)),
        *fed("B", (_external_leak_term("B", weight=-1.0),)),
        _free_air_term(rig, weight_A=lambda s: (s.mean("q_supply") > 0.0).astype(float)),
        *_LEAKS,
    )
    equation = Equation(CYLINDER, _supply_volume, terms, area_ratio=rig.cylinder.A_B / rig.cylinder.A_A)
    return _separate_at_rest(equation, direction)


def _metering_edge_terms(
    edge: str, upstream: str, downstream: str, sign: float, channels: Container[str], return_pressure: float
) -> tuple[Term, ...]:
    """Make the three terms of the flow over one metering edge of a servo valve: gain, delay and overlap.

    `edge`: name of the edge, for example "P to A"; `upstream`, `downstream`: channels of the pressures; `sign`: sign of
    the command u that opens the edge, 1 or -1; `channels`: names of the recorded channels; `return_pressure`: pressure
    [Pa] in place of p_2 if that is not recorded. With dp = upstream pressure - downstream pressure, the flow is

        flow = (gain abs(u) - overlap) sign(dp) sqrt(abs(dp)),    overlap = gain (dead band of u),

    delayed by the lag of the spool. Up to their signs, the unknown coefficients are gain, gain times lag, and overlap.
    """
    recorded = tuple(name for name in (upstream, downstream) if name in channels)

    def pressure(s: Signals, name: str) -> Array | float:
        """Return the pressure [Pa] on one side of the edge in the middle of each interval."""
        return s.mean(name) if name in recorded else return_pressure

    def pressure_root(s: Signals) -> Array:
        """Compute sign(dp) sqrt(abs(dp)) [Pa^0.5] of the pressure drop dp over the edge, shape (n - 1,)."""
        return _signed_root(np.asarray(pressure(s, upstream) - pressure(s, downstream)))

    def proportional_flow(s: Signals) -> Array:
        """Compute the increments abs(u) sign(dp) sqrt(abs(dp)) dt [V Pa^0.5 s], 0 unless u opens the edge."""
        return np.asarray(np.maximum(sign * s.mean("u"), 0.0) * pressure_root(s) * s.dt)

    edge_term = partial(_sensor_term, drift="edge", needs=("u", *recorded))
    return (
        edge_term(f"edge {edge}", "m^3/(s V Pa^0.5)", proportional_flow),
        edge_term(f"late edge {edge}", "m^3/(V Pa^0.5)", lambda s: np.gradient(proportional_flow(s))),  # gain times lag
        edge_term(f"overlap {edge}", "m^3/(s Pa^0.5)", lambda s: (sign * s.mean("u") > 0.0) * pressure_root(s) * s.dt),
    )


def _chamber_equation(side: str, rig: Rig, channels: Container[str]) -> Equation:
    """Make the volume balance of one chamber, `side` "A" or "B", of a cylinder behind a servo valve.

    The volume displaced by the piston equals the flow over the valve's edges, less compression and leakage. An overlap
    of the edges (dead band) reduces the flow in both directions of motion. So does a leak, if friction makes p_A - p_B
    change its sign with the direction of motion. Only the prior on a healthy piston separates a leak from an overlap.
    """
    is_A = side == "A"
    area = rig.cylinder.A_A if is_A else rig.cylinder.A_B
    sign = 1.0 if is_A else -1.0  # a positive command connects A to the supply and B to the return
    return_pressure = rig.supply.p_return
    terms = (
        *_metering_edge_terms(f"P to {side}", "p_1", f"p_{side}", sign, channels, return_pressure),
        *_metering_edge_terms(f"{side} to T", f"p_{side}", "p_2", -sign, channels, return_pressure),
        *_chamber_terms(side),
        _BIAS,
        # each chamber's balance has the same terms of air and external leaks; those of the other chamber are zero
        _free_air_term(rig, weight_A=lambda s: float(is_A)),
        _external_leak_term("A", weight=float(is_A)),
        _external_leak_term("B", weight=-float(not is_A)),
        *_LEAKS,
    )
    equation = Equation(
        f"chamber {side}", lambda s: -area * s.step("x"), terms, INFERENCE.healthy.piston, flow_sign=-1.0
    )
    return _separate_at_rest(equation, lambda s: np.ones_like(s.time_step))


def equations(rig: Rig, channels: frozenset[str]) -> tuple[Equation, ...]:
    """Return the volume balances of a machine that can be computed from the recorded `channels`; empty if none can.

    Where a valve meters the flow into the chambers, and x, u and p_1 are recorded, there is one balance for each
    chamber. If neither p_2 nor a flow meter is recorded, the return has the pressure of the rig, `supply.p_return`.
    Otherwise there is one balance of the cylinder, in which the pump's flow is computed from its angle, its speed, a
    flow meter or, without these, the command.
    """
    has_return = "p_2" in channels or not channels & {*METERS}
    if not rig.circuit.pump_feeds_chambers and {"x", "u", "p_1"} <= channels and has_return:
        if not channels.issuperset(_PRESSURES):
            return ()
        return tuple(_select_recorded_terms(_chamber_equation(side, rig, channels), channels) for side in "AB")
    left, source = pump_volume(rig, channels), flow_source(channels)
    if left is None or not {"x", *_PRESSURES} <= channels:
        return ()
    if source == "q_supply":
        return (_select_recorded_terms(_supply_equation(rig), channels),)
    # a speed computed from an angle has no offset, so that a constant residual flow is external leakage
    bias = _BIAS._replace(cause="external leak", drift="outside") if "theta" in channels else _BIAS
    terms = [bias if term is _BIAS else term for term in _CYLINDER]
    if source == "u":
        terms.insert(0, _START)
    if source == "q_pump":  # a meter is downstream of the filling loss
        terms.remove(_SPEED_LOSS)
    # the air is half in either chamber; on a single rod it is in the one that carries the load
    single_rod = rig.cylinder.single_rod
    air = _free_air_term(rig, weight_A=lambda s: _interval_means(s.carried_by_A) if single_rod else 0.5)
    area_ratio = rig.cylinder.A_B / rig.cylinder.A_A
    equation = Equation(CYLINDER, left, tuple(terms), by_command=source == "u", area_ratio=area_ratio)
    balance = _insert_before_leaks(equation, air)
    return (_select_recorded_terms(balance, channels | {START}),)  # START is derived from the command


#: Leaks in a balance without a piston in motion: to the outside, and past piston and pump.
_STANDSTILL_LEAKS = (_external_leak_term("A"), _external_leak_term("B", weight=-1.0), *_LEAKS)
#: Terms of such a balance of both chambers: their compliances, and the leaks.
_STANDSTILL = (*(_chamber_terms(side)[0] for side in "AB"), *_STANDSTILL_LEAKS)


def circulation(rig: Rig, channels: frozenset[str]) -> Equation | None:
    """Return the volume balance of a pump while the piston displaces no net volume.

    The balance holds over whole cycles or at standstill, so the position need not be known. The offset of the flow,
    which cannot be separated from leakage under a steady load, is assumed to be zero. Return None if the pump does not
    feed the chambers, or if its delivery or a chamber's pressure is not recorded.
    """
    left = pump_volume(rig, channels)
    if not rig.circuit.pump_feeds_chambers or left is None or not channels.issuperset(_PRESSURES):
        return None
    return Equation("circulation", left, (_START, *_STANDSTILL))


def locked(rig: Rig, channels: frozenset[str]) -> Equation | None:
    """Return the volume balance of a load that is held by shut valves; None if circuit or channels do not allow it.

    The left side is the volume that must have leaked from A to B to let the piston move: -dx times the piston's area
    on the loaded side, where x is assumed to grow as A fills. Leaks of seal, valve and line cannot be separated.

    The balance needs the position and both pressures. If a command or the pump's flow is recorded, the circuit must
    have valves that hold the load, and the command must be recorded: it is constant while they are shut. If neither is
    recorded, any circuit is accepted, although a control loop may then hold the load and replace the leaking oil.
    """
    if not {"x", *_PRESSURES} <= channels:
        return None
    has_flow = flow_source(channels) is not None  # a command, or a flow of the pump
    if has_flow and not (rig.circuit.holds_load and "u" in channels):
        return None
    areas = {"A": rig.cylinder.A_A, "B": rig.cylinder.A_B}

    def loaded_side(s: Signals) -> str:
        """Return the side, "A" or "B", that on average carries the load."""
        return "A" if np.nanmean(s["p_A"] * areas["A"] - s["p_B"] * areas["B"]) > 0.0 else "B"

    compliance = Term(
        "compliance of the loaded side",
        "m^3/Pa",
        lambda s: s.step(f"p_{loaded_side(s)}"),
        "air in the oil",
        drift="compliance",
        needs=_PRESSURES,
    )
    return Equation(LOCKED, lambda s: -areas[loaded_side(s)] * s.step("x"), (compliance, *_STANDSTILL_LEAKS))


def pump_volume(rig: Rig, channels: frozenset[str]) -> Callable[[Signals], Array] | None:
    """Return a function that computes from `Signals` the volume [m^3] that the pump delivers in each sampling interval.

    The volume follows from the best recorded channel (`flow_source`): the pump's angle, its speed, a flow meter, or the
    command, from which the speed is derived. Return None if none of them is recorded, or only the command of a pump
    that does not feed the chambers. An error of a flow meter's scale shows as an error of the piston areas.
    """
    displacement, source = rig.pump.q_b / (2.0 * np.pi), flow_source(channels)
    if source == "theta":
        return lambda s: displacement * s.step("theta")
    if source == "q_pump":
        return lambda s: s.mean("q_pump") * s.dt
    if source == "q_supply":
        return _supply_volume
    if source == "omega" or (source == "u" and rig.circuit.pump_feeds_chambers):
        return lambda s: displacement * s.mean("omega") * s.dt
    return None


def with_rests(equation: Equation) -> Equation:
    """Add three terms to a pump's volume balance that are zero in some states of the machine (`STATES`).

    The new terms are inserted before those of the leak. Their increments, 0 in all other states, are

    - (p_A - p_B) dt while the pump moves the piston (`TURNING`),
    - (p_A - p_B) dt while the pump turns and the piston rests, to hold the load (`HOLDING`),
    - dt while pump and piston move (`MOVING_BIAS`).
    """
    left = equation.left
    in_motion = Term(MOVING_BIAS, "m^3/s", lambda s: s.moving(left) * s.dt, "pump leak", driver="pressure")
    return _insert_before_leaks(equation, *_pump_leakage_terms(left), in_motion)


def shut_at_rest(equation: Equation) -> Equation:
    """Adapt a pump's volume balance to valves that cut the pump off from the cylinder while the pump rests.

    Two terms are added for the pump's leakage: while it moves the piston, and while it only holds the load. The
    constant flow (`BIAS`) counts only while pump and piston move.
    """
    left = equation.left
    shut = _insert_before_leaks(equation, *_pump_leakage_terms(left, drift="pump"))
    return shut._replace(
        terms=tuple(
            term._replace(increments=lambda s: s.moving(left) * s.dt) if term.name == BIAS else term
            for term in shut.terms
        )
    )


def _pump_leakage_terms(
    pump_volume: Callable[[Signals], Array], drift: Coefficient | Literal[""] = ""
) -> tuple[Term, Term]:
    """Make two terms of a pump's leakage: while it moves the piston, and while it turns to hold the load.

    The increments of a term are (p_A - p_B) dt in its state of the machine, and 0 at other times. `pump_volume`
    computes the volume [m^3] that the pump delivers in each interval; `drift`: entry of `priors.toml` with the prior on
    the drift of both coefficients, or "" for terms that are not part of every fit.
    """
    # no further channels are needed: the balance requires both pressures anyway
    make_term = partial(_conductance_term, cause="pump leak", needs=(), drift=drift)
    return (
        make_term(TURNING, lambda s: s.moving(pump_volume) * s.pressure_difference * s.dt),
        make_term(HOLDING, lambda s: s.holding(pump_volume) * s.pressure_difference * s.dt),
    )


def _insert_before_leaks(equation: Equation, *terms: Term) -> Equation:
    """Return a volume balance with additional terms before the leak's terms, which stay last."""
    first_leak = len(equation.terms) - len(_LEAKS)
    return equation._replace(terms=(*equation.terms[:first_leak], *terms, *equation.terms[first_leak:]))


def _select_recorded_terms(equation: Equation, channels: frozenset[str]) -> Equation:
    """Return a volume balance without the terms that need a channel outside of `channels`."""
    return equation._replace(terms=tuple(term for term in equation.terms if channels.issuperset(term.needs)))
