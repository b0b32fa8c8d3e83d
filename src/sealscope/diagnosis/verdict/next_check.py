"""What to check next on the machine, for each cause that a change can have."""

from __future__ import annotations

from collections.abc import Mapping

from sealscope.diagnosis.verdict.evidence import Cause, Verdict

_BY_CAUSE: Mapping[Cause, str] = {
    "piston leak": (
        "Make sure that the bypass valve across the cylinder is shut; then hold the piston against a load with the "
        "motor at rest and watch x: creep confirms a worn piston seal."
    ),
    "piston or pump leak": (
        "Tell the seal from the pump: shut the valves between pump and cylinder and hold the piston against a load; "
        "creep is the seal's. Make sure before that the bypass valve across the cylinder is shut."
    ),
    "pump leak": (
        "Block the cylinder lines and turn the pump slowly against the closed ports: flow or pressure that is lost "
        "there is lost in the pump; check its case drain."
    ),
    "external leak": (
        "Look for oil at the rod seals, fittings and hoses, and compare the charge pressure with its set value; fill "
        "up only after the spot is found."
    ),
    "friction change": (
        "Compare oil and seal temperature with earlier recordings, and look at rod, guides and load for binding or "
        "side force; repeat when the machine is warm."
    ),
    "air in the oil": (
        "Bleed the circuit, check the charge pressure and the suction side for drawn-in air, and record again."
    ),
    "sensor fault": (
        "Compare the pressure sensors with one another at rest, and the encoders at a stop; check cables, supply and "
        "range before any seal is changed."
    ),
    "changed duty": (
        "Record again under the command, load and oil temperature of the earlier recordings; a changed duty cannot be "
        "compared with them."
    ),
}


def next_check(verdict: Verdict, cause: Cause | None) -> str:
    """What to check next, in one or two sentences."""
    if cause is not None:
        return _BY_CAUSE[cause]
    if verdict == "leak":
        return (
            "Repeat the recording with the same command and oil temperature, with the bypass valve shut: a worn seal "
            "shows again. What was recorded does not tell the seal from an open bypass, and maybe not from a worn pump."
        )
    if verdict == "no leak":
        return "Nothing needs a check; keep this recording as a baseline for later ones with the same command."
    return "Remove the cause that the reason names and record again; a verdict was not forced out of these data."
