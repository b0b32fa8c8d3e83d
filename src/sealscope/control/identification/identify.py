"""The parameters of a machine from its recordings: estimates with intervals, and what they cannot tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sealscope.calls import checked_call
from sealscope.control.identification.balance import UNBALANCED, balanced
from sealscope.control.identification.drive import drive_loop
from sealscope.control.identification.estimate import Estimate
from sealscope.control.identification.friction import friction
from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    import os

    from sealscope.parameters import Rig

_NEEDED = ("theta", "x", "p_A", "p_B")
#: An estimate whose interval is wider than this share of it, either way, is no estimate.
_VAGUE = 0.5
#: Ratio of the areas: so many deviations and such a share from the rig's means another kind of cylinder.
_SURE, _UNLIKE = 6.0, 0.03
#: What the regressions' laws leave out, as a share of a value: rows that do not resolve transients, averages of
#: products. Found on simulated machines other than those by which the intervals were judged.
_MODEL = {"cylinder": 2e-5, "fluid": 1e-3, "pump": 4e-4, "friction": 1e-2, "motor": 4e-4}
#: What no recording of these channels tells, and why.
_NEVER = (
    ("pump.q_b", "areas are told over the displacement only: the displacement is taken as stated"),
    ("cylinder.V", "volumes are told over the bulk modulus only: the volumes are taken as stated"),
    ("piston or pump", "the leakage of piston and pump is one conductance; it is stated as pump.G_pump"),
    ("friction.F_cfr, friction.C_c", "taken as stated: preload and breakaway are told given these"),
    ("motor.R_c, motor.C_e, motor.C_m", "taken as stated: the speed loop is told given these"),
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
        Recordings of the machine with theta, x, p_A and p_B, and u for the drive.
    rig : Rig, str or path-like
        The kind of machine, and what is stated of it: displacement, volumes, mass, motor.

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
    for recording in recordings:
        missing = [name for name in _NEEDED if name not in recording]
        if missing:
            raise InputError(f"identification must have theta, x, p_A and p_B, got a recording without {missing[0]}")
        for name in _NEEDED:
            unit = {"theta": "rad", "x": "m"}.get(name, "Pa")
            if recording.units[name] != unit:
                raise InputError(f"identification must have {name} in {unit}, got {recording.units[name]}")
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
    kept = []
    for scattered in estimates:
        estimate = scattered.with_model_error(_MODEL[scattered.name.partition(".")[0]])
        vague = 1.96 * estimate.sd > _VAGUE * abs(estimate.value)
        if vague and estimate.name not in ("pump.G_pump", "cylinder.F_l"):
            low, high = estimate.interval
            untold.append((estimate.name, f"these recordings tell it within {low:.3g} to {high:.3g} only"))
        else:
            kept.append(estimate)
    hidden = [side for side in ("cylinder.A_A", "cylinder.A_B") if side not in areas]
    untold.extend((side, "this side is never the one with the higher pressure") for side in hidden)
    return Identification(base, tuple(kept), tuple(untold))


def _other_cylinder(areas: dict[str, Estimate], rig: Rig) -> str | None:
    if len(areas) < 2:
        return None
    A, B = areas["cylinder.A_A"], areas["cylinder.A_B"]
    ratio, stated = A.value / B.value, rig.cylinder.A_A / rig.cylinder.A_B
    sd = abs(ratio) * ((A.sd / A.value) ** 2 + (B.sd / B.value) ** 2) ** 0.5
    if abs(ratio - stated) > max(_SURE * sd, _UNLIKE * stated):
        return (
            f"areas must be in the ratio of the rig's, A_A/A_B = {stated:.3g}, got {ratio:.3g}: take a rig of "
            f"{'equal areas' if abs(ratio - 1) < _UNLIKE else 'a single-rod cylinder'}"
        )
    return None
