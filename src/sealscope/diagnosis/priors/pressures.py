"""Typed tables of `inference/pressures/priors.toml`: priors on machines judged by pressures and command."""

from collections.abc import Mapping
from typing import Literal

from sealscope.storage.toml_file import PriorTable, read_priors

#: Parameters of the response with a prior of their own.
Parameter = Literal[
    "gain", "bias", "K", "F_C", "F_v", "K_brk", "C_c", "side", "G", "spring", "lead", "lag", "scale", "offset"
]


class ResponseBlocks(PriorTable):
    """Blocks of a recording: `shortest`, `wander` [s]; `slowest` [Hz]; the others are numbers."""

    most: int
    shortest: float
    wander: float
    slowest: float


class MachineScale(PriorTable):
    """Relative standard deviations of the rig's sizes."""

    mass: float
    area: float


class MainsPriors(PriorTable):
    """Lines of the mains: `lines` [Hz]; the others are numbers."""

    lines: tuple[float, ...]
    within: float
    harmonics: int


class ConductancePriors(PriorTable):
    """Conductance past the piston: `wander`, `level` [m^3/(s Pa)]; the others are numbers."""

    wander: float
    level: float
    orifice: float


class FrictionLaw(PriorTable):
    """A law of friction: compliance `give` [m/N] before sliding, and largest creep speed [m/s].

    `creep` is None to use the value of the rig.
    """

    give: tuple[float, float, float]
    creep: float | None = None


class FollowPriors(PriorTable):
    """Fits along a recording: `window`, `beginning`, `block`, `settling`, `centring` [s]; `slow` [periods]."""

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

    By the parameter's name, `response`: centre, standard deviation and wander in 90 s; `start`, `jump`: middle of the
    values that fits start from, and the factor to the largest.
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
