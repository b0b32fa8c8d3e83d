"""Typed tables of `inference/priors.toml`: priors on the terms of a balance."""

from sealscope.storage.toml_file import PriorTable, read_priors


class DriftPriors(PriorTable):
    """Change of each kind of coefficient in a minute, as a fraction of its size (standard deviation) [1/min]."""

    motion: float
    compliance: float
    air: float
    bias: float
    leak: float
    pump: float
    outside: float
    edge: float


class DifferencePriors(DriftPriors):
    """Difference of each kind of coefficient between recordings of one machine, as a fraction of its size."""

    speed: float


class LevelPriors(PriorTable):
    """Size of a coefficient (standard deviation): `outside`, `gas` [m^3/s]."""

    outside: float
    gas: float


class BlockPriors(PriorTable):
    """Blocks of a recording: `longest`, `shortest` [s]; the others are numbers."""

    longest: float
    shortest: float
    blocks: int
    coarse: int


class ScatterPriors(PriorTable):
    """Scatter of the leakage between recordings."""

    between: float
    freedom: float
    estimate: float
    finest: float
    leak: float
    largest: float
    relative: float
    unlike: float
    session: float
    tail: float


class ConditionPriors(PriorTable):
    """Difference of the operating conditions from those of the healthy recordings; `oil` [K]."""

    ratio: float
    oil: float
    motion: float
    leak: float


class OilPriors(PriorTable):
    """Effect of the oil on a healthy machine's leakage: `per_kelvin`, `per_kelvin_deviation` [1/K]; `shift` [h]."""

    warmest: float
    per_kelvin: float
    per_kelvin_deviation: float
    shift: float
    per_drop: float
    per_drop_deviation: float
    drop_tells: float


class SizePriors(PriorTable):
    """Relative standard deviations of a machine's sizes, and the law of its leak."""

    displacement: float
    law: float
    laminar: float
    readings: int
    meter: float
    area: float


class RepeatPriors(PriorTable):
    """Relative standard deviations of the flow needed for the same motion from day to day."""

    error: float
    scatter: float
    recordings: float


class GrowthPriors(PriorTable):
    """Growth of a leak after its onset within a recording: fraction that stay constant, and largest growth."""

    steady: float
    most: float


class StepSize(PriorTable):
    """Size of a change: its median, and the standard deviation of its logarithm.

    `size` [m^3/s] of an external leak, [Pa] of free air, [Pa/s] of a drift.
    """

    size: float
    spread: float


class SensePriors(PriorTable):
    """Probabilities of other causes for the symptoms of a wrong sign of the flow into side A."""

    work: float
    leak: float
    sides: float


class HeldOilPriors(PriorTable):
    """Oil of a cylinder side that valves shut: `compressibility` [1/Pa]; `settles`, `shortest`, `equalises` [s]."""

    compressibility: float
    deviation: float
    dead: float
    dead_deviation: float
    unlike: float
    right: float
    agrees: float
    rare: float
    settles: float
    shortest: float
    equalises: float
    loaded: float
    independent: float
    misfit: float
    charge: float
    air: float


class PressurePriors(PriorTable):
    """Range of the terms of air: `least` absolute pressure [Pa]."""

    least: float


class ZeroPriors(PriorTable):
    """Offset of a pressure sensor (standard deviations): `pressure`, `far` [Pa]; the others are numbers."""

    pressure: float
    far: float
    odds: float


class HealthyPriors(PriorTable):
    """Conductance of a healthy machine's leaks (standard deviation): `outside`, `piston` [m^3/(s Pa)]."""

    outside: float
    piston: float


class HeldPriors(PriorTable):
    """A piston whose position a control loop holds or returns: `half`, `settles`, `averaged` [s]; `creep` [m/s]."""

    half: float
    settles: float
    slow: float
    averaged: float
    share: float
    elsewhere: float
    creep: float


class RestPriors(PriorTable):
    """A pump at rest: `averaged`, `least` [s]; the others are numbers."""

    averaged: float
    least: float
    share: float
    holding: float
    moves: float
    shut: float
    open: float
    most: float
    alone: float
    locked: float


class InferencePriors(PriorTable):
    """The tables of `inference/priors.toml`."""

    drift: DriftPriors
    level: LevelPriors
    blocks: BlockPriors
    between: DifferencePriors
    scatter: ScatterPriors
    conditions: ConditionPriors
    oil: OilPriors
    size: SizePriors
    repeats: RepeatPriors
    growth: GrowthPriors
    scale: StepSize
    sense: SensePriors
    outside: StepSize
    held_oil: HeldOilPriors
    free_air: StepSize
    pressure: PressurePriors
    zero: ZeroPriors
    healthy: HealthyPriors
    held: HeldPriors
    rest: RestPriors


INFERENCE = read_priors("sealscope.diagnosis.inference", InferencePriors)
