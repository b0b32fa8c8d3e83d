"""The parameters of a machine from its recordings: estimates with intervals, and what they cannot tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sealscope.calls import checked_call
from sealscope.control.identification.balance import UNBALANCED, balanced
from sealscope.control.identification.drive import drive_loop
from sealscope.control.identification.edges import edges_balanced
from sealscope.control.identification.estimate import Estimate
from sealscope.control.identification.friction import friction
from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    import os

    from sealscope.parameters import Rig

#: Channels with their units, of a pump-controlled and of a valve-controlled machine.
_OF_PUMP = {"theta": "rad", "x": "m", "p_A": "Pa", "p_B": "Pa"}
_OF_VALVE = {"u": "V", "x": "m", "p_1": "Pa", "p_2": "Pa", "p_A": "Pa", "p_B": "Pa"}
#: An estimate whose interval is wider than this share of it, either way, is no estimate.
_VAGUE = 0.5
#: Ratio of the areas: so many deviations and such a share from the rig's means another kind of cylinder.
_SURE, _UNLIKE = 6.0, 0.03
#: What the regressions' laws leave out, as a share of a value: rows that do not resolve transients, averages of
#: products. Found on simulated machines other than those by which the intervals were judged.
_MODEL = {"cylinder": 2e-5, "fluid": 1e-3, "pump": 4e-4, "friction": 1e-2, "motor": 4e-4, "valve": 2e-5}
_MODEL_OF_VALVE = {**_MODEL, "fluid": 4e-4}
#: Parameters that may be zero: an interval around it is an estimate.
_AROUND_ZERO = {"pump.G_pump", "cylinder.F_l", "valve.o_PA", "valve.o_AT", "valve.o_PB", "valve.o_BT"}
#: What no recording of these channels tells, and why.
_NEVER = (
    ("pump.q_b", "areas are told over the displacement only: the displacement is taken as stated"),
    ("cylinder.V", "volumes are told over the bulk modulus only: the volumes are taken as stated"),
    ("piston or pump", "the leakage of piston and pump is one conductance; it is stated as pump.G_pump"),
    ("friction.F_cfr, friction.C_c", "taken as stated: preload and breakaway are told given these"),
    ("motor.R_c, motor.C_e, motor.C_m", "taken as stated: the speed loop is told given these"),
)
_NEVER_OF_VALVE = (
    ("cylinder.A_A, cylinder.A_B", "areas are told over the rated flow only: the areas are taken as stated"),
    _NEVER[1],
    _NEVER[3],
    ("valve.omega_s, valve.zeta_s, valve.v_max", "taken as stated: the spool is quicker than blocks of 0.25 s"),
    ("supply and motor", "neither speed nor current of the supply's pump is recorded"),
)


@dataclass(frozen=True)
class Identification:
    """What recordings tell: `estimates`, and `untold`: names and why; `mismatch`: why the rig is of another kind."""

    rig: Rig
    estimates: tuple[Estimate, ...]
    untold: tuple[tuple[str, str], ...]
    mismatch: str | None = None

    def __getitem__(self, name: str) -> Estimate:
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(name)


@checked_call
def identify(recordings: Sequence[Recording], rig: Rig | str | os.PathLike[str]) -> Identification:
    """Fit what recordings of one machine, without a leak, tell of its parameters.

    Parameters
    ----------
    recordings : sequence of Recording
        Recordings of the machine with theta, x, p_A and p_B, and u for the drive; behind a servo valve with u, x,
        p_1, p_2, p_A and p_B.
    rig : Rig, str or path-like
        The kind of machine, and what is stated of it: displacement, volumes, mass, motor; of a valve areas and spool.

    Returns
    -------
    Identification
        Estimates with intervals of 95 %, what cannot be told, and whether the rig is of another kind.

    Raises
    ------
    InputError
        No recording, or one without the channels.

    Examples
    --------
    >>> import sealscope as ss
    >>> from sealscope.control.identification import identify
    >>> run = ss.simulate(rig="thesis-closed-loop", command="position 60 mm sin(1t) + 10 mm sin(5t)", duration=30.0)
    >>> found = identify([run], "thesis-closed-loop")
    >>> low, high = found["cylinder.A_A"].interval
    >>> 600e-6 < low < high < 660e-6
    True
    """
    base = load_rig(rig)
    if not recordings:
        raise InputError("identification must have one recording or more, got none")
    valved = base.valve.spool == "present"
    _check_channels(recordings, _OF_VALVE if valved else _OF_PUMP, "a servo valve" if valved else "a pump")
    if valved:
        return _behind_valve(recordings, base)
    estimates: list[Estimate] = []
    untold = list(_NEVER)
    if base.line.orifices == "present":
        return Identification(base, (), (), "the balance of volumes has no line volumes: take line.orifices = absent")
    volumes = balanced(recordings, base)
    if isinstance(volumes, str):
        return Identification(base, (), (*untold, ("areas, stiffness, leakage, friction", volumes)))
    if volumes.left_over > UNBALANCED:
        return Identification(
            base,
            (),
            (),
            f"what the pump turns must be what the piston sweeps within {100 * UNBALANCED:g} %, got "
            f"{100 * volumes.left_over:.2g} % left over: this is no pump-controlled machine of the stated displacement",
        )
    estimates += volumes.estimates
    areas = {e.name: e for e in volumes.estimates if e.name.startswith("cylinder.A")}
    mismatch = _other_cylinder(areas, base)
    if mismatch is not None:
        return Identification(base, (), (), mismatch)
    c = base.cylinder
    told_A, told_B = areas.get("cylinder.A_A"), areas.get("cylinder.A_B")
    scale = (told_A.value / c.A_A) if told_A else told_B.value / c.A_B if told_B else 1.0
    area_A = told_A.value if told_A else scale * c.A_A
    area_B = told_B.value if told_B else scale * c.A_B
    parts = [("friction", friction(recordings, base, area_A, area_B))]
    if all("u" in recording and recording.units["u"] == "V" for recording in recordings):
        parts.append(("the drive", drive_loop(recordings, base)))
    else:
        untold.append(("the drive", "needs the command, u, in V"))
    for name, part in parts:
        if isinstance(part, str):
            untold.append((name, part))
        else:
            estimates += part
    kept = _told(estimates, untold)
    hidden = [side for side in ("cylinder.A_A", "cylinder.A_B") if side not in areas]
    untold.extend((side, "this side is never the one with the higher pressure") for side in hidden)
    return Identification(base, tuple(kept), tuple(untold))


def _check_channels(recordings: Sequence[Recording], needed: Mapping[str, str], source: str) -> None:
    for recording in recordings:
        for name, unit in needed.items():
            if name not in recording:
                *most, last = needed
                raise InputError(
                    f"identification must have {', '.join(most)} and {last} of a machine behind {source}, got a "
                    f"recording without {name}"
                )
            if recording.units[name] != unit:
                raise InputError(f"identification must have {name} in {unit}, got {recording.units[name]}")


def _told(
    estimates: Sequence[Estimate], untold: list[tuple[str, str]], model: Mapping[str, float] = _MODEL
) -> list[Estimate]:
    """Return the estimates that tell something, with what the laws leave out; add the vague ones to `untold`."""
    kept = []
    for scattered in estimates:
        estimate = scattered.with_model_error(model[scattered.name.partition(".")[0]])
        vague = 1.96 * estimate.sd > _VAGUE * abs(estimate.value)
        if vague and estimate.name not in _AROUND_ZERO:
            low, high = estimate.interval
            untold.append((estimate.name, f"these recordings tell it within {low:.3g} to {high:.3g} only"))
        else:
            kept.append(estimate)
    return kept


def _behind_valve(recordings: Sequence[Recording], rig: Rig) -> Identification:
    """Return what recordings tell of a machine behind a servo valve."""
    untold = list(_NEVER_OF_VALVE)
    edges = edges_balanced(recordings, rig)
    if isinstance(edges, str):
        return Identification(rig, (), (*untold, ("rated flow, overlaps, stiffness, friction", edges)))
    if not edges.balance.left_over <= UNBALANCED:
        return Identification(
            rig,
            (),
            (),
            f"what the valve's edges let in must be what the piston sweeps within {100 * UNBALANCED:g} %, got "
            f"{100 * edges.balance.left_over:.2g} % left over: this is no machine behind a servo valve",
        )
    ratio, stated = edges.ratio, rig.cylinder.A_A / rig.cylinder.A_B
    if abs(ratio.value - 1.0) > max(_SURE * ratio.sd, _UNLIKE):
        return Identification(rig, (), (), _of_other_areas(ratio.value * stated, stated))
    low, high = edges.piston.interval
    untold.append(
        ("leakage of the piston", f"a rig has no parameter for it; G = {low:.2g} to {high:.2g} m^3/(s Pa) (95 %)")
    )
    slid = friction(recordings, rig, rig.cylinder.A_A, rig.cylinder.A_B)
    if isinstance(slid, str):
        untold.append(("friction", slid))
        slid = ()
    return Identification(rig, tuple(_told([*edges.balance.estimates, *slid], untold, _MODEL_OF_VALVE)), tuple(untold))


def _of_other_areas(ratio: float, stated: float) -> str:
    return (
        f"areas must be in the ratio of the rig's, A_A/A_B = {stated:.3g}, got {ratio:.3g}: take a rig of "
        f"{'equal areas' if abs(ratio - 1) < _UNLIKE else 'a single-rod cylinder'}"
    )


def _other_cylinder(areas: dict[str, Estimate], rig: Rig) -> str | None:
    if len(areas) < 2:
        return None
    A, B = areas["cylinder.A_A"], areas["cylinder.A_B"]
    ratio, stated = A.value / B.value, rig.cylinder.A_A / rig.cylinder.A_B
    sd = abs(ratio) * ((A.sd / A.value) ** 2 + (B.sd / B.value) ** 2) ** 0.5
    if abs(ratio - stated) > max(_SURE * sd, _UNLIKE * stated):
        return _of_other_areas(ratio, stated)
    return None
