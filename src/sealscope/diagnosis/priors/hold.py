"""Typed tables of `hold/priors.toml`: assumptions on a load that shut valves hold."""

from sealscope.storage.toml_file import PriorTable, read_priors


class HeldPart(PriorTable):
    """The part of a log in which a load is held."""

    speed: float  # [mm/s] largest speed of a held piston
    motion: float  # [mm/min] largest mean speed of a held piston
    creep: float  # [mm/s] speed below which every piston is held
    ratio: float  # speed of a motion, over that of the slower parts of a log
    travel: float  # [mm] largest slip of a held piston, or its settling
    pressure: float  # [bar/s] largest rate of a held pressure
    decay: float  # [1/s] the same, over the pressure
    fall: float  # largest change of a pressure that slips and settling make, over the pressure
    noise: float  # [standard deviations] largest step that is noise
    position: float  # [mm] largest noise of a position
    scatter: float  # [bar] largest noise of a pressure
    shortest: float  # [s] shortest hold
    rest: float  # smallest load times duration of a hold, over the largest
    share: float  # smallest held share of a recording of a held load
    motor: float  # [rad/s] largest speed of a motor at rest
    bin: float  # [s] time over which samples are averaged to find holds


class SettlingPriors(PriorTable):
    """An exponential after a valve has shut."""

    present: float  # probability that something settles within the hold
    times: tuple[float, ...]  # [s] time constants
    shortest: float  # [times between readings] shortest of them
    longest: float  # [durations of the hold] longest of them
    stopped: float  # probability that the piston rests on its stop
    rest: float  # [mm/min] standard deviation of its creep
    strain: tuple[float, ...]  # standard deviations of the amplitude of the oil's relative compression


class BendPriors(PriorTable):
    """A slow change of the speed about its mean."""

    present: float  # its probability
    times: tuple[float, ...]  # [durations of the hold] of exponential changes
    sizes: tuple[float, ...]  # standard deviations, over the whole travel


class CoolingPriors(PriorTable):
    """Temperature of oil that is not logged, an exponential."""

    times: tuple[float, ...]  # [s] time constants
    sizes: tuple[float, ...]  # [K] standard deviations of the whole change
    bore: tuple[float, float]  # [s/m] usual time over the bore, and deviation of its logarithm
    stated: tuple[float, float]  # mean and standard deviation of the change of stated oil, over its excess
    ambient: float  # [degC] temperature that stated oil approaches
    shapes: tuple[float, float, float]  # polynomials of a temperature's course, over its range
    step: float  # [K] step of a constant temperature
    lag: tuple[float, float]  # [s] mean and standard deviation of a thermometer's delay
    misfit: float  # share of the effect of a logged temperature that its column leaves
    steady: float  # [K] standard deviation of the change of oil that is stated to be steady
    expansion: float  # [1/K] thermal expansion of oil in a cylinder
    expansion_deviation: float  # relative standard deviation


class ColumnPriors(PriorTable):
    """Length of the column of held oil, its volume over the piston's area."""

    dead: float  # [m] added to the position
    unknown: float  # [m] without a position
    deviation: float  # standard deviation of the logarithm
    unknown_deviation: float  # ... without a position
    stated: float  # that of a stated volume


class TightHolds(PriorTable):
    """Loads that are held without a leak."""

    present: float  # their probability
    rate: float  # [mm/min] standard deviation of their creep
    leaks: tuple[float, ...]  # [mm/min] means of the creep of the others, of twice its standard deviation
    fed: float  # probability of a creep of either sign
    lifts: tuple[float, ...]  # [mm/min] standard deviations of that


class NoisePriors(PriorTable):
    """Noise of means over parts of a hold."""

    nodes: int  # number of parts
    white: float  # probability of independent errors
    walking: float  # probability of a random walk
    times: tuple[float, float]  # [durations of the hold] correlation times of a wander
    slow: float  # share of the second of them
    ratios: tuple[float, ...]  # variance of the wander over that of the white noise
    walks: tuple[float, ...]  # variance of a random walk at the end of the hold over that of the white noise
    steps: tuple[float, ...]  # [encoder steps] noise of a reading at the passage from one step to the next
    position: float  # [mm] step of a constant position
    pressure: float  # [bar] step of a constant pressure


class OtherSide(PriorTable):
    """Pressure of the side without the load, and chances from which something is named."""

    sure: float  # largest chance of no leak of one that is named, where the oil is not logged
    locked: float  # probability that a side whose pressure is not logged is locked
    offset: float  # [bar] standard deviation of the zero of a pressure
    minor: float  # largest gain of the other side over the leak, where the piston is not named
    material: float  # least gain of the side over the leak
    tank: float  # [bar] largest pressure of a side that may be open to the tank


class LoadPriors(PriorTable):
    """Standard deviations of what a position does not tell of the oil."""

    gauge: float  # relative error of area and position
    friction: float  # [bar] variation of a free load's pressure that is not logged
    change: float  # [bar] the same above a locked side
    sinking: float  # probability that a piston sinks whose position is not logged
    steady: float  # [bar] change of the pressure of a load that sinks
    stiffness: float  # relative compression above a locked side or a spring


class MeterPriors(PriorTable):
    """A leakage flow meter."""

    settling: tuple[float, ...]  # standard deviations of what settles, over the volume of the hold


class CollectedOil(PriorTable):
    """Errors of a collected volume."""

    deviation: float  # relative standard deviation
    drop: float  # [mL] standard deviation


class HeldLoadPriors(PriorTable):
    """All tables of `hold/priors.toml`, the assumptions on a load that shut valves hold."""

    part: HeldPart
    settling: SettlingPriors
    bend: BendPriors
    cooling: CoolingPriors
    column: ColumnPriors
    tight: TightHolds
    noise: NoisePriors
    other: OtherSide
    load: LoadPriors
    meter: MeterPriors
    collected: CollectedOil


HOLD = read_priors("sealscope.diagnosis.hold", HeldLoadPriors)
