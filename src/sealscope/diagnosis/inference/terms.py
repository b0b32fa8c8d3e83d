"""The terms of a machine's volume balance, as rows of data.

A balance is linear in what is not known of the machine. For a pump-controlled cylinder

    D dtheta = sum_j c_j f_j dg_j + G (p_A - p_B) dt,

with the pump's displacement D [m^3/rad], the leakage conductance G [m^3/(s Pa)] and a coefficient c_j for each term;
f_j and g_j are functions of the recorded channels. A term gives its increment f_j dg_j over each sampling interval, so
that nothing is differentiated (`weak_form`). Behind a servo valve each chamber has a balance of its own, whose left
side is what the piston displaces and whose terms are the orifice flows of the valve's edges; G is the same in both.

What is believed of a term is in `priors.toml`: how fast its coefficient may drift, each with unit and source.

Source: Merritt, Hydraulic Control Systems, 1967, sections 5.2 and 6.3 (continuity of the chambers, flow of the edges).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.channels import flow_source
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: The least absolute pressure that the terms of air are computed for [Pa].
LEAST_ABSOLUTE: float = priors("inference")["pressure"]["least"]
#: Half the time over which speed and direction of motion are taken [s]: a few counts of an encoder at slow motion.
HALF_DIFFERENCE = 0.025
#: Time over which speeds are averaged to find rests, and the shortest rest [s].
AVERAGED, LEAST_REST = (priors("inference")["rest"][name] for name in ("averaged", "least"))


class Signals:
    """Samples of the channels that terms read, with what several terms share.

    Parameters
    ----------
    channels : mapping of str to array_like of float, shape (n,)
        Values in SI units.
    rate : float
        Sampling rate [Hz].
    zeros : mapping of str to float
        What is added to a gauge pressure to make it an absolute one [Pa], by the channel's name.
    zero : float, optional
        What p_A - p_B reads too much [Pa].
    still : tuple of two floats, optional
        Largest mean rate of the pump's volume [m^3/s] and speed of the piston [m/s] at rest; by default nothing rests.
    """

    def __init__(
        self,
        channels: Mapping[str, Array],
        rate: float,
        zeros: Mapping[str, float],
        zero: float = 0.0,
        still: tuple[float, float] = (-1.0, -1.0),
    ) -> None:
        self._channels, self.rate, self._zeros, self._zero = channels, rate, zeros, zero
        self._still = still
        self._stands: Array | None = None
        self._steps: dict[str, Array] = {}
        self._means: dict[str, Array] = {}

    def __contains__(self, name: object) -> bool:
        return name in self._channels

    def __getitem__(self, name: str) -> Array:
        return self._channels[name]

    def step(self, name: str) -> Array:
        """Return the increments of a channel, shape (n - 1,)."""
        if name not in self._steps:
            self._steps[name] = _steps(self._channels[name])
        return self._steps[name]

    def mean(self, name: str) -> Array:
        """Return the means of neighbouring samples, shape (n - 1,)."""
        if name not in self._means:
            self._means[name] = _middle(self._channels[name])
        return self._means[name]

    @property
    def dt(self) -> float:
        """Sampling interval [s]."""
        return 1.0 / self.rate

    @property
    def time_step(self) -> Array:
        """Sampling interval [s] of each increment, shape (n - 1,)."""
        return np.full(len(next(iter(self._channels.values()))) - 1, self.dt)

    @cached_property
    def pressure_difference(self) -> Array:
        """p_A - p_B [Pa] in the middle of each interval, about its zero."""
        return self.mean("p_A") - self.mean("p_B") - self._zero

    @cached_property
    def port_difference(self) -> Array:
        """p_1 - p_2 [Pa] in the middle of each interval."""
        return self.mean("p_1") - self.mean("p_2")

    @cached_property
    def absolute(self) -> Mapping[str, Array]:
        """Absolute pressure [Pa] of each chamber, at least `LEAST_ABSOLUTE`."""
        return {
            name: np.maximum(self._channels[name] + self._zeros.get(name, P_ATM), LEAST_ABSOLUTE)
            for name in ("p_A", "p_B")
        }

    @cached_property
    def speed(self) -> Array:
        """Speed of the piston [m/s] at each sample, by a central difference."""
        half = max(1, round(HALF_DIFFERENCE * self.rate))
        x = self._channels["x"]
        padded = np.concatenate([x[:1].repeat(half), x, x[-1:].repeat(half)])
        return np.asarray((padded[2 * half :] - padded[: -2 * half]) * (0.5 * self.rate / half))

    @cached_property
    def outward(self) -> Array:
        """1 where the piston moves towards B or stands still, else 0, at each sample."""
        return (self.speed >= 0.0).astype(float)

    @cached_property
    def carried_by_A(self) -> Array:
        """1 where p_A > p_B, else 0, at each sample."""
        return (self._channels["p_A"] > self._channels["p_B"] + self._zero).astype(float)

    def directed_step(self, outward: bool, by_A: bool) -> Array:
        """Return the increments of x of one direction while one side carries the pressure [m]."""
        out_A, out, by = self._ways
        share = (out_A if by_A else out - out_A) if outward else (by - out_A if by_A else 1.0 - out - by + out_A)
        return np.asarray(share * self.step("x"))

    @cached_property
    def _ways(self) -> tuple[Array, Array, Array]:
        """Shares of each interval in which the piston moves outward while A carries, moves outward, and A carries."""
        return _middle(self.outward * self.carried_by_A), _middle(self.outward), _middle(self.carried_by_A)

    def stands(self, left: Callable[[Signals], Array]) -> Array:
        """Return 1 for each interval in which the pump, by its volume, or the piston stands still, else 0."""
        if self._stands is None:
            pump = find_rests(left(self), self.rate, self._still[0])
            self._stands = (pump | find_rests(self.step("x"), self.rate, self._still[1])).astype(float)
        return self._stands

    def acceleration_step(self) -> Array:
        """Return the increments of the piston's speed [m/s], by which a delay between channels shows."""
        return _slope(self.step("x") * self.rate)


def find_rests(increments: Array, rate: float, still: float) -> NDArray[np.bool_]:
    """Find the intervals of rests: the mean rate over `AVERAGED` seconds stays below `still` for `LEAST_REST`.

    `increments` (n,) of the pump's volume or of x; missing ones are no rest.
    """
    size, least = max(1, round(AVERAGED * rate)), max(2, round(LEAST_REST * rate))
    if still < 0.0 or len(increments) < size + least:
        return np.zeros(len(increments), dtype=bool)
    known = np.isfinite(increments)
    volume, missing = (
        np.concatenate([[0], np.cumsum(values)]) for values in (np.where(known, increments, 0.0), ~known)
    )
    below = np.abs(volume[size:] - volume[:-size]) <= still * size / rate
    below &= missing[size:] == missing[:-size]
    covered = _spread(below, size)  # every interval of a quiet stretch
    runs = np.concatenate([[0], np.cumsum(~covered)])
    whole = runs[least:] == runs[:-least]
    return _spread(whole, least)


def _spread(starts: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Mark the `length` places from each start on, shape (n + length - 1,)."""
    counts = np.zeros(len(starts) + length, dtype=int)
    counts[: len(starts)] += starts
    counts[length:] -= starts
    return np.cumsum(counts)[:-1] > 0


def _middle(values: Array) -> Array:
    middle = values[1:] + values[:-1]
    middle *= 0.5
    return middle


def _steps(values: Array) -> Array:
    return values[1:] - values[:-1]


def _slope(values: Array) -> Array:
    """Return half the difference of a value's neighbours, at the ends the whole one to its neighbour."""
    slope = np.empty_like(values)
    slope[0], slope[-1] = values[1] - values[0], values[-1] - values[-2]
    slope[1:-1] = 0.5 * (values[2:] - values[:-2])
    return slope


class Term(NamedTuple):
    """A term of a balance: a row of data.

    `increments` gives f dg over each sampling interval, shape (n - 1,); `unit` is that of its coefficient; `cause` is
    what a step of the coefficient means; `nuisance`: the coefficient is unknown in any machine and drifts as `drift`
    allows (a table of `priors.toml`), else it is zero unless that cause is present; `compared`: or unless recordings,
    whose duties differ, are compared; `needs`: channels; `driven`: by a "pressure" or by its "root", so that a zero of
    the sensors acts on the flow.
    """

    name: str
    formula: str
    unit: str
    increments: Callable[[Signals], Array]
    cause: Cause
    drift: str = ""
    nuisance: bool = True
    compared: bool = False
    needs: tuple[str, ...] = ()
    driven: str = ""


class Equation(NamedTuple):
    """A balance: what gives the increments of its left side [m^3], and its terms, with those of the leak last.

    `healthy`: what is believed of a healthy machine's leak (a row of `priors.toml`), where that says more than nothing;
    `by_command`: no channel gives its flow, so that `balance.commanded` makes a speed of the command; `takes`: 1 where
    a flow into A is positive on the left, -1 where it is negative.
    """

    name: str
    left: Callable[[Signals], Array]
    terms: tuple[Term, ...]
    healthy: str = ""
    by_command: bool = False
    takes: float = 1.0


#: The leak past the piston, laminar and as through an orifice; the first names the coefficient that is tested.
LEAK, ORIFICE = "leak", "leak through an orifice"
#: Free air in both chambers at once; what single coefficients of its kind do it does.
AIR = "free air"
#: The pump's own leakage, by the pressures at its ports.
PUMP = "pump leak"
#: What passes or is read whatever the pressures are; a zero of the pressures acts through it.
BIAS = "bias"
#: What the name of a leak to the outside ends with where a check valve makes it up.
MADE_UP = ", made up"
#: The balance with a position of a pump-controlled cylinder, and that of a load that shut valves hold, by name.
CYLINDER = "cylinder"
LOCKED = "locked"
#: What remains of a speed loop's state at the first sample, which nothing recorded tells (19 s of the thesis's drive).
START = "start"

_LEAKS = (
    Term(
        LEAK,
        "(p_A - p_B) dt",
        "m^3/(s Pa)",
        lambda s: s.pressure_difference * s.dt,
        "piston or pump leak",
        "leak",
        needs=("p_A", "p_B"),
        driven="pressure",
    ),
    Term(
        ORIFICE,
        "sign(p_A - p_B) sqrt(abs(p_A - p_B)) dt",
        "m^3/(s Pa^0.5)",
        lambda s: np.sign(s.pressure_difference) * np.sqrt(np.abs(s.pressure_difference)) * s.dt,
        "piston or pump leak",
        nuisance=False,
        needs=("p_A", "p_B"),
        driven="root",
    ),
)


def _motion_by_side(outward: bool, by_A: bool) -> Term:
    way, side = ("out", "in")[not outward], "AB"[not by_A]
    return Term(
        f"motion {way}, {side} carries",
        f"dx, v {'>=' if outward else '<'} 0, p_{side} the larger",
        "m^2",
        lambda s: s.directed_step(outward, by_A),
        "sensor fault",
        "motion",
        needs=("x",),
    )


def _of_side(side: str) -> tuple[Term, ...]:
    name = f"p_{side}"
    return (
        Term(
            f"compliance {side}",
            f"dp_{side}",
            "m^3/Pa",
            lambda s: s.step(name),
            "air in the oil",
            "compliance",
            needs=(name,),
        ),
        Term(
            f"compliance {side} over the stroke",
            f"x dp_{side}",
            "m^2/Pa",
            lambda s: s.mean("x") * s.step(name),
            "air in the oil",
            "compliance",
            needs=(name, "x"),
        ),
        Term(
            f"free air {side}",
            f"d(1/p_{side})",
            "m^3 Pa",
            lambda s: _steps(1.0 / s.absolute[name]),
            "air in the oil",
            "air",
            needs=(name,),
        ),
        Term(
            f"dissolving air {side}",
            f"d(log p_{side})",
            "m^3",
            lambda s: _steps(np.log(s.absolute[name])),
            "air in the oil",
            "air",
            needs=(name,),
        ),
    )


def _released(rig: Rig, share: Callable[[Signals], Array | float]) -> Term:
    """Return free air in both chambers at once, each by its volume; `share`: how far side A's balance counts."""
    from sealscope.physics.cylinder import volumes_at_middle

    cylinder = rig.cylinder
    middle = dict(zip("AB", volumes_at_middle(cylinder), strict=True))
    areas = {"A": cylinder.A_A, "B": -cylinder.A_B} if cylinder.volumes == "position" else {"A": 0.0, "B": 0.0}

    def released(s: Signals) -> Array:
        by_A = share(s)
        volumes = {side: np.maximum(middle[side] + areas[side] * s.mean("x"), 0.1 * middle[side]) for side in "AB"}
        expands = {side: volumes[side] * _steps(1.0 / s.absolute[f"p_{side}"]) for side in "AB"}
        return np.asarray(by_A * expands["A"] - (1.0 - by_A) * expands["B"])

    formula = "V_A d(1/p_A) - V_B d(1/p_B)"
    return Term(AIR, formula, "Pa", released, "air in the oil", nuisance=False, needs=("x", "p_A", "p_B"))


def _lost_outside(side: str, share: float = 1.0) -> Term:
    """Return the external leak of one side; `share`: how far it counts in the balance, and its sign there."""
    name = f"p_{side}"
    return Term(
        f"external leak {side}",
        f"{'-' if share < 0.0 else ''}max(p_{side}, 0) dt",
        "m^3/(s Pa)",
        lambda s: share * np.maximum(s.mean(name), 0.0) * s.dt,
        "external leak",
        nuisance=False,
        needs=(name,),
        driven="pressure",
    )


def _made_up(side: str) -> Term:
    """Return the external leak of one side, made up by a check valve on the side of lower pressure.

    While that is the same side, the balance shows nothing. What B loses the pump need not take: it is negative.
    """
    name = f"p_{side}"

    def made_up_volume(s: Signals) -> Array:
        carries = _middle(s.carried_by_A)
        return np.asarray((carries if side == "A" else carries - 1.0) * np.maximum(s.mean(name), 0.0) * s.dt)

    return Term(
        f"external leak {side}{MADE_UP}",
        f"{'-' if side == 'B' else ''}[{name} the larger] max({name}, 0) dt",
        "m^3/(s Pa)",
        made_up_volume,
        "external leak",
        nuisance=False,
        needs=("p_A", "p_B"),
        driven="pressure",
    )


#: A delay between position and flow.
LAG = "lag"
_LAG = Term(LAG, "dv", "m^2 s", lambda s: s.acceleration_step(), "sensor fault", "motion", needs=("x",))
#: What a pump loses the more, the faster it turns: its filling, and slip that no recorded pressure drives.
SPEED_LOSS = "loss over speed"
_SPEED_LOSS = Term(
    SPEED_LOSS,
    "abs(v) dx",
    "m s",
    lambda s: _middle(np.abs(s.speed)) * s.step("x"),
    "sensor fault",
    "speed",
    nuisance=False,
    compared=True,
    needs=("x",),
)
_BIAS = Term(BIAS, "dt", "m^3/s", lambda s: s.time_step, "sensor fault", "bias")
_PUMP = Term(
    PUMP,
    "(p_1 - p_2) dt",
    "m^3/(s Pa)",
    lambda s: s.port_difference * s.dt,
    "pump leak",
    nuisance=False,
    needs=("p_1", "p_2"),
    driven="pressure",
)
#: With it the leak's coefficient is that of pump and piston together, and what the lines add is the pump's alone;
#: without lines it is zero.
_LINES = Term(
    "pump leak by the lines",
    "((p_1 - p_2) - (p_A - p_B)) dt",
    "m^3/(s Pa)",
    lambda s: (s.port_difference - s.pressure_difference) * s.dt,
    "pump leak",
    "pump",
    needs=("p_1", "p_2", "p_A", "p_B"),
    driven="pressure",
)

_START = Term(
    "start of the drive",
    "exp(-t/tau) dt",
    "m^3/s",
    lambda s: s.mean(START) * s.dt,
    "sensor fault",
    "bias",
    needs=(START,),
)

_CYLINDER = (
    *(_motion_by_side(outward, by_A) for outward in (True, False) for by_A in (True, False)),
    *_of_side("A"),
    *_of_side("B"),
    _LAG,
    _SPEED_LOSS,
    _BIAS,
    _LINES,
    _PUMP,
    _lost_outside("A"),
    _lost_outside("B", -1.0),
    _made_up("A"),
    _made_up("B"),
    *_LEAKS,
)


class _Way(NamedTuple):
    """One edge of the valve at a chamber: what it connects, and the sign of the command that opens it."""

    name: str
    drop: tuple[str, str]
    opens: float

    @classmethod
    def at_chamber(cls, side: str, rising: bool) -> _Way:
        """Return the edge from the supply into a chamber (`rising`), or from the chamber to the return."""
        opens = 1.0 if (side == "A") == rising else -1.0
        return cls(
            *((f"P to {side}", ("p_1", f"p_{side}")) if rising else (f"{side} to T", (f"p_{side}", "p_2"))), opens
        )

    def root(self, s: Signals) -> Array:
        """Return the root of the pressure drop with its sign [Pa^0.5]."""
        drop = s.mean(self.drop[0]) - s.mean(self.drop[1])
        return np.asarray(np.sign(drop) * np.sqrt(np.abs(drop)))

    def term(self, name: str, opening: str, unit: str, increments: Callable[[Signals], Array]) -> Term:
        """Return a term of this edge's flow."""
        formula = opening.replace("u", "u" if self.opens > 0 else "-u") + f" sqrt({self.drop[0]} - {self.drop[1]}) dt"
        return Term(f"{name} {self.name}", formula, unit, increments, "sensor fault", "edge", needs=("u", *self.drop))


def _edges(side: str) -> tuple[Term, ...]:
    """Return the flow of a chamber's edges over their gain; late, by the spool's lag; by overlap, underlap and wear."""
    terms = []
    for way in (_Way.at_chamber(side, True), _Way.at_chamber(side, False)):

        def gain(s: Signals, way: _Way = way) -> Array:
            return np.asarray(np.maximum(way.opens * s.mean("u"), 0.0) * way.root(s) * s.dt)

        def late(s: Signals, gain: Callable[[Signals], Array] = gain) -> Array:
            return _slope(gain(s))

        def overlap(s: Signals, way: _Way = way) -> Array:
            return np.asarray((way.opens * s.mean("u") > 0.0) * way.root(s) * s.dt)

        terms += [
            way.term("edge", "max(u, 0)", "m^3/(s V Pa^0.5)", gain),
            way.term("late edge", "d max(u, 0)", "m^3/(V Pa^0.5)", late),
            way.term("overlap", "[u > 0]", "m^3/(s Pa^0.5)", overlap),
        ]
    return tuple(terms)


def _chamber(side: str, rig: Rig) -> Equation:
    """Return the balance of one chamber behind a valve: what the piston displaces is what its edges pass.

    An overlap takes from the flow in either direction what a leak under friction's pressure takes: only what is known
    of a healthy piston tells them apart, and so friction that changes from a leak.
    """
    area = rig.cylinder.A_A if side == "A" else rig.cylinder.A_B
    lost = (_lost_outside("A", float(side == "A")), _lost_outside("B", -float(side == "B")))
    terms = (*_edges(side), *_of_side(side), _BIAS, _released(rig, lambda s: float(side == "A")), *lost, *_LEAKS)
    return Equation(f"chamber {side}", lambda s: -area * s.step("x"), terms, "piston", takes=-1.0)


def equations(rig: Rig, channels: frozenset[str]) -> tuple[Equation, ...]:
    """Return the balances of a machine that its recorded channels allow, empty where they allow none.

    Behind a servo valve that of each chamber; else that of the cylinder, with the pump's angle, its speed, a flow meter
    or, for want of these, the command as the source of its flow.
    """
    if rig.valve.spool == "present" and {"x", "u", "p_1", "p_2"} <= channels:
        sides = [side for side in "AB" if f"p_{side}" in channels]
        balances = [_chamber(side, rig) for side in sides]
        return tuple(_with_channels(balance, channels) for balance in balances) if len(sides) == 2 else ()
    left = pump_volume(rig, channels)
    if left is None or not {"x", "p_A", "p_B"} <= channels:
        return ()
    by_command = flow_source(channels) == "u"
    # an angle has no zero of a speed: what is lost whatever the pressures are is lost to the outside
    terms = [
        term._replace(cause="external leak", drift="outside") if term.name == BIAS and "theta" in channels else term
        for term in ((_START, *_CYLINDER) if by_command else _CYLINDER)
    ]
    if flow_source(channels) == "q_pump":  # a meter reads what the pump's filling leaves
        terms.remove(_SPEED_LOSS)
    one_side = rig.cylinder.single_rod
    terms.insert(-len(_LEAKS), _released(rig, lambda s: _middle(s.carried_by_A) if one_side else 0.5))
    balance = Equation(CYLINDER, left, tuple(terms), by_command=by_command)
    return (_with_channels(balance, channels | {START}),)


_STORED = tuple(
    term for side in "AB" for term in _of_side(side) if term.drift == "compliance" and "x" not in term.needs
)


def circulation(rig: Rig, channels: frozenset[str]) -> Equation | None:
    """Return the balance of a pump's delivery while the piston displaces nothing; None if no channel gives it.

    Over whole cycles or at standstill: neither motion nor position is in it. A zero of the flow is not told from
    leakage under a steady load, and is taken for none.
    """
    left = pump_volume(rig, channels)
    if rig.valve.spool == "present" or left is None or not {"p_A", "p_B"} <= channels:
        return None
    return Equation("circulation", left, (_START, *_STORED, _lost_outside("A"), _lost_outside("B", -1.0), *_LEAKS))


def locked(rig: Rig, channels: frozenset[str]) -> Equation | None:
    """Return the balance of a load that shut valves hold: what the loaded side loses, the piston gives way by.

    Whether seal, valve or line loses it, the channels do not tell; a command that stands still tells that they are
    shut. x grows as A fills. None for a pump-controlled machine, or where position, command or a pressure is missing.
    """
    if rig.valve.spool != "present" or not {"x", "u", "p_A", "p_B"} <= channels:
        return None

    def gives_way(s: Signals) -> Array:
        area = rig.cylinder.A_A if np.nanmean(s.pressure_difference) > 0.0 else rig.cylinder.A_B
        return -area * s.step("x")

    return Equation(LOCKED, gives_way, (*_STORED, _lost_outside("A"), _lost_outside("B", -1.0), *_LEAKS))


def pump_volume(rig: Rig, channels: frozenset[str]) -> Callable[[Signals], Array] | None:
    """Return the function for the increments of the pump's delivered volume [m^3]; None if no channel gives them.

    By its angle, its speed, a flow meter, or the speed that the drive makes of the command. A meter's scale for each
    direction is in the areas of that direction.
    """
    displacement, source = rig.pump.q_b / (2.0 * np.pi), flow_source(channels)
    if source == "theta":
        return lambda s: displacement * s.step("theta")
    if source == "q_pump":
        return lambda s: s.mean("q_pump") * s.dt
    if source == "omega" or (source == "u" and rig.valve.spool != "present"):
        return lambda s: displacement * s.mean("omega") * s.dt
    return None


#: Columns that count at rest, while the pump or the piston stands still: leakage and zero (`regimes`).
REST_LEAK, REST_BIAS = "leak at rest", "bias at rest"
RESTS = (REST_LEAK, REST_BIAS)
#: What passes the pump alone, where a valve cuts it off at rest.
TURNING = "pump leak while it turns"


def with_rests(equation: Equation) -> Equation:
    """Add to a pump's balance the columns that count at rest, before those of the leak."""
    left = equation.left

    def term(name: str, formula: str, unit: str, increments: Callable[[Signals], Array]) -> Term:
        return Term(name, f"[rest] {formula}", unit, increments, "pump leak", nuisance=False, driven="pressure")

    rests = (
        term(REST_LEAK, "(p_A - p_B) dt", "m^3/(s Pa)", lambda s: s.stands(left) * s.pressure_difference * s.dt),
        term(REST_BIAS, "dt", "m^3/s", lambda s: s.stands(left) * s.dt),
    )
    return equation._replace(terms=_before_leaks(equation, rests))


def shut_at_rest(equation: Equation) -> Equation:
    """Return a pump's balance where a valve cuts the pump off at rest: its leakage and zero count in motion."""
    left = equation.left
    pump = Term(
        TURNING,
        "[moves] (p_A - p_B) dt",
        "m^3/(s Pa)",
        lambda s: (1.0 - s.stands(left)) * s.pressure_difference * s.dt,
        "pump leak",
        "pump",
        needs=("p_A", "p_B"),
        driven="pressure",
    )
    terms = (
        term._replace(formula="[moves] dt", increments=lambda s: (1.0 - s.stands(left)) * s.dt)
        if term.name == BIAS
        else term
        for term in _before_leaks(equation, (pump,))
    )
    return equation._replace(terms=tuple(terms))


def _before_leaks(equation: Equation, terms: tuple[Term, ...]) -> tuple[Term, ...]:
    return (*equation.terms[: -len(_LEAKS)], *terms, *equation.terms[-len(_LEAKS) :])


def _with_channels(equation: Equation, channels: frozenset[str]) -> Equation:
    return equation._replace(terms=tuple(term for term in equation.terms if channels.issuperset(term.needs)))
