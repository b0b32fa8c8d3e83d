"""Typed tables of `inference/pressures/priors.toml`: assumptions on machines judged by pressures and command."""

from collections.abc import Mapping
from typing import Literal

from sealscope.storage.toml_file import PriorTable, read_priors

#: Parameters of the response with a prior of their own.
Parameter = Literal[
    "gain", "bias", "K", "F_C", "F_v", "K_brk", "C_c", "side", "G", "spring", "lead", "lag", "scale", "offset"
]


class ResponseBlocks(PriorTable):
    """Division of a recording into blocks."""

    most: int  # largest number of blocks
    shortest: float  # [s] shortest block
    wander: float  # [s] time for which other priors state the change of a parameter
    slowest: float  # [Hz] lowest sampling rate


class MachineScale(PriorTable):
    """Uncertainty of the rig's mass and area, as relative standard deviations."""

    mass: float  # moving mass
    area: float  # piston area


class MainsPriors(PriorTable):
    """Hum of the electric mains in the pressures."""

    lines: tuple[float, ...]  # [Hz] frequencies of the grids
    within: float  # relative error of these frequencies
    harmonics: int  # highest harmonic


class ConductancePriors(PriorTable):
    """Leakage conductance past the piston."""

    wander: float  # [m^3/(s Pa)] its change in 90 s, a standard deviation
    level: float  # [m^3/(s Pa)] its standard deviation between recordings of one machine
    # mean flow of a leak by any law, over that of the laminar leak with the same effect: mean, standard deviation
    law: tuple[float, float]


class FrictionLaw(PriorTable):
    """Parameters of a law of friction for the contact of piston and seal."""

    # [m/N] displacement per force before sliding, as a row of `PressureResponsePriors.response`
    give: tuple[float, float, float, float]
    creep: float | None = None  # [m/s] below this speed the contact creeps; None to use the rig's `friction.v_th`


class FollowPriors(PriorTable):
    """Fits of the pressure response along a recording."""

    window: float  # [s] length of the first fit
    beginning: float  # [s] length of the beginning, fitted first to find initial values
    block: float  # [s] length of a block of the beginning
    settling: float  # [s] time in which the drive starts
    centring: float  # [s] time constant of the mean position, from which the load's spring force is counted
    slow: float  # [periods of the ringing] width of the Gaussian filter that removes the ringing
    unexplained: float  # jumps are tried above this chi square of a block, in standard deviations from its mean
    explained: float  # largest fraction of the variance of p_A - p_B in a block that a valid fit leaves unexplained


class PressureResponsePriors(PriorTable):
    """All tables of `inference/pressures/priors.toml`, for machines that are judged by pressures and command.

    Three of them are mappings from the name of a parameter, whose values are over the rig's own or in the unit that the
    file states. `response` gives centre, standard deviation, change in 90 s and difference between recordings. `start`
    gives the middle of the values from which fits start, and the factor from it to the largest one. `jump` gives the
    same for values after a jump.
    """

    blocks: ResponseBlocks
    scale: MachineScale
    mains: MainsPriors
    conductance: ConductancePriors
    response: Mapping[Parameter, tuple[float, float, float, float]]
    stribeck: FrictionLaw
    bristles: FrictionLaw
    follow: FollowPriors
    start: Mapping[Literal["gain", "K", "K_brk"], tuple[float, float]]
    jump: Mapping[Literal["G", "K"], tuple[float, float]]


PRESSURE = read_priors("sealscope.diagnosis.inference.pressures", PressureResponsePriors)
