"""Typed tables of `inference/pressures/priors.toml`: assumptions on machines judged by pressures and command."""

from collections.abc import Mapping
from typing import Literal

from sealscope.storage.toml_file import PriorTable, read_priors

#: Parameters of the response with a prior of their own.
Parameter = Literal[
    "gain", "bias", "K", "F_C", "F_v", "K_brk", "C_c", "side", "G", "spring", "lead", "lag", "scale", "offset"
]


class ResponseBlocks(PriorTable):
    """Division of a recording into blocks.

    - `most`: largest number of blocks.
    - `shortest` [s]: shortest block.
    - `wander` [s]: time for which other priors state the change of a parameter.
    - `slowest` [Hz]: lowest sampling rate.
    """

    most: int
    shortest: float
    wander: float
    slowest: float


class MachineScale(PriorTable):
    """Uncertainty of the rig's mass and area, as relative standard deviations.

    - `mass`: moving mass.
    - `area`: piston area.
    """

    mass: float
    area: float


class MainsPriors(PriorTable):
    """Hum of the electric mains in the pressures.

    - `lines` [Hz]: frequencies of the grids.
    - `within`: relative error of these frequencies.
    - `harmonics`: highest harmonic.
    """

    lines: tuple[float, ...]
    within: float
    harmonics: int


class ConductancePriors(PriorTable):
    """Leakage conductance past the piston.

    - `wander` [m^3/(s Pa)]: its change in 90 s, a standard deviation.
    - `level` [m^3/(s Pa)]: its standard deviation between recordings of one machine.
    - `orifice`: mean flow through an orifice, over that of the laminar leak with the same effect on the pressures.
    """

    wander: float
    level: float
    orifice: float


class FrictionLaw(PriorTable):
    """Parameters of a law of friction for the contact of piston and seal.

    - `give` [m/N]: displacement per force before the contact slides. The three numbers are centre, standard deviation
      and change in 90 s.
    - `creep` [m/s]: largest speed of creep; None to use the value of the rig.
    """

    give: tuple[float, float, float]
    creep: float | None = None


class FollowPriors(PriorTable):
    """Fits of the pressure response along a recording.

    - `window` [s]: length of the first fit.
    - `beginning` [s]: length of the beginning, which is fitted once before the actual fit to find its initial values.
    - `block` [s]: length of a block of the beginning.
    - `settling` [s]: time in which the drive starts.
    - `centring` [s]: time constant of the mean position, from which the load's spring force is counted.
    - `slow` [periods]: width of the Gaussian filter that removes the ringing.
    - `unexplained`: jumps of parameters are tried if a block's chi square exceeds this number of standard deviations.
    - `explained`: largest fraction of the variance of p_A - p_B that a valid fit leaves unexplained.
    """

    window: float
    beginning: float
    block: float
    settling: float
    centring: float
    slow: float
    unexplained: float
    explained: float


class PressureResponsePriors(PriorTable):
    """All tables of `inference/pressures/priors.toml`, for machines that are judged by pressures and command.

    Three of them are mappings from the name of a parameter. `response` gives centre, standard deviation and change in
    90 s. `start` gives the middle of the values from which fits start, and the factor from it to the largest one.
    `jump` gives the same for values after a jump.
    """

    blocks: ResponseBlocks
    scale: MachineScale
    mains: MainsPriors
    conductance: ConductancePriors
    response: Mapping[Parameter, tuple[float, float, float]]
    stribeck: FrictionLaw
    bristles: FrictionLaw
    follow: FollowPriors
    start: Mapping[Literal["gain", "K", "K_brk"], tuple[float, float]]
    jump: Mapping[Literal["G", "K"], tuple[float, float]]


PRESSURE = read_priors("sealscope.diagnosis.inference.pressures", PressureResponsePriors)
