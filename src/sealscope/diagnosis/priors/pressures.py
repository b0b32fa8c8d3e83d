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
    - `wander` [s]: time for which the change of a parameter is stated.
    - `slowest` [Hz]: lowest sampling rate.
    """

    most: int
    shortest: float
    wander: float
    slowest: float


class MachineScale(PriorTable):
    """Uncertainty of the rig's sizes, as relative standard deviations.

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
    - `orifice`: mean flow of an orifice over that of the laminar leak that fits the response best.
    """

    wander: float
    level: float
    orifice: float


class FrictionLaw(PriorTable):
    """A law of friction; the unit of lengths per force is [m/N].

    - `give` [m/N]: compliance of the contact before it slides: centre, standard deviation and change in 90 s.
    - `creep` [m/s]: largest speed of creep; None to use the value of the rig.
    """

    give: tuple[float, float, float]
    creep: float | None = None


class FollowPriors(PriorTable):
    """Fits along a recording.

    - `window` [s]: length of the first fit.
    - `beginning` [s]: length of the beginning, which is run once before the fit.
    - `block` [s]: length of a block of the beginning.
    - `settling` [s]: time in which the drive starts.
    - `centring` [s]: time constant of the mean position, from which the load's spring force is counted.
    - `slow` [periods]: width of the Gaussian filter that removes the ringing.
    - `unexplained`: standard deviations of a block's chi square above which jumps of parameters are tried.
    - `explained`: largest fraction of the variance of p_A - p_B that valid parameters leave unexplained.
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
    """The tables of `inference/pressures/priors.toml`.

    Three of them are mappings by the name of a parameter. `response` gives centre, standard deviation and change in
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
