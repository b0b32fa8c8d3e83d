"""Typed tables of `inference/priors.toml`: assumptions on the terms of a volume balance."""

from sealscope.storage.toml_file import PriorTable, read_priors


class DriftPriors(PriorTable):
    """Drift of each kind of coefficient, as the standard deviation of its relative change in a minute [1/min]."""

    motion: float  # coefficients of the motion, such as displacement over area
    compliance: float  # compressed oil
    air: float  # free air in the oil
    bias: float  # constant flow, such as a tachometer shows at standstill because of its offset
    leak: float  # leakage past the piston
    pump: float  # leakage of the pump
    outside: float  # leakage to the outside
    edge: float  # gain of a servo valve's control edge


class DifferencePriors(DriftPriors):
    """Standard deviation of the relative difference between recordings of one machine, for each kind of coefficient.

    The fields have no unit. They are those of `DriftPriors` and another one.

    - `speed`: flow that the pump loses in proportion to its speed.
    """

    speed: float


class LevelPriors(PriorTable):
    """Standard deviations of coefficients of a volume balance whose prior mean is zero; flows in m^3/s."""

    outside: float  # constant leakage to the outside
    bias: float  # constant flow without a recorded pressure, over the rms flow of the pump
    lag: float  # [s] delay of the position
    gas: float  # flow from an accumulator whose gas changes its temperature


class BlockPriors(PriorTable):
    """Division of a recording into blocks, and the lowest sampling rate [Hz] at which it is divided."""

    # [s] limits of a block's length
    longest: float
    shortest: float
    slowest: float  # lowest sampling rate
    blocks: int  # number of blocks of a recording, unless their length would be outside these limits
    coarse: int  # largest number of blocks in tests for changes other than leaks
    expansion: float  # relative error of the volume by which oil and air expand within a block


class ScatterPriors(PriorTable):
    """Scatter of the leakage between recordings of one machine, divided by the pump's mean flow."""

    between: float  # factor by which all standard deviations of `DifferencePriors` together may be wrong
    freedom: float  # degrees of freedom of the prior on the scatter of the motion's coefficients
    estimate: float  # smallest scatter, over the standard error that a recording states for its leakage
    finest: float  # smallest scatter of the leakage
    leak: float  # standard deviation of the leakage between recordings
    largest: float  # largest scatter of the leakage
    relative: float  # largest scatter of the leakage's logarithm
    unlike: float  # fraction of days whose unrecorded oil temperature is unlike that of all others
    session: float  # standard deviation of the leakage between sessions with oil of one viscosity
    tail: float  # probability that a healthy recording lies farther above than predicted, and the same below


class ConditionPriors(PriorTable):
    """Effect of operating conditions (load, speed, oil in K) that differ from those of the healthy recordings."""

    ratio: float  # logarithm of load or speed over those of the healthy days, a standard deviation
    oil: float  # change of the oil temperature within a day
    motion: float  # exponent of load and speed in the ratio of displaced to pumped volume, a standard deviation
    leak: float  # exponent of load and speed in a leak's conductance, a standard deviation


class OilPriors(PriorTable):
    """Effect of the oil's temperature (`per_kelvin` in 1/K) and viscosity on the leakage of a healthy machine."""

    warmest: float  # largest conductance, with the warmest oil, over the smallest
    # relative increase of a leak per kelvin, and its standard deviation
    per_kelvin: float
    per_kelvin_deviation: float
    shift: float  # [h] time in which the oil warms from its coldest to its warmest
    # a leak is inversely proportional to this power of the viscous pressure drop; its standard deviation
    per_drop: float
    per_drop_deviation: float
    # standard deviations of the logarithm of the friction between sessions, with the same seals and with worn ones
    friction_session: float
    friction_changes: float
    drop_tells: float  # probability that a change of the viscous drop is due to the oil, not to load and speed
    drop_misleads: float  # probability that something other than the oil changed the drop of the judged recording alone


class SizePriors(PriorTable):
    """Uncertainty of the sizes that convert a leak to L/min, as relative standard deviations, and the leak's law."""

    displacement: float  # displacement of the pump
    law: float  # mean flow of a leak if its law is unknown: laminar, an orifice, or between the two
    laminar: float  # prior probability of a laminar leak
    usual: float  # scale of the prior on the flow of a leak, over the pump's flow
    present: float  # prior probability that there is a leak in a recording
    readings: int  # number of independent values by which a recording tells the leak's law
    meter: float  # scale of a flow meter
    area: float  # piston area
    creep: float  # flow of a leak by which a held load creeps


class RepeatPriors(PriorTable):
    """Differences of the flow that the same motion needs on another day, as relative standard deviations."""

    scatter: float  # scatter between days
    recordings: float  # the prior on the scatter weighs as much as this number of recordings
    inflation: float  # largest factor by which the standard errors of the recordings may be too small


class GrowthPriors(PriorTable):
    """Growth of a leak after its onset within a recording."""

    steady: float  # probability that it does not grow
    most: float  # largest increase of the leak's flow until the end of the recording, over the flow at the onset
    scatter: float  # relative standard deviation of the flow of a leak that began within a recording, fitted to a rise
    from_nothing: float  # of the leaks that grow, the fraction that grows from nothing


class StepSize(PriorTable):
    """Log-normal prior on the size of a change other than a leak past the piston, or on the volume of an accumulator.

    - `size`: median size. It is in [m^3/s] for an external leak, [Pa] for free air (its volume fraction times the
      atmospheric pressure), [Pa/s] for a drift, [m^3] for an accumulator, and relative for a scale or a flow's zero.
    - `spread`: standard deviation of the logarithm of the size.
    """

    size: float
    spread: float


class SensePriors(PriorTable):
    """Probabilities that a sign of the recorded flow looks wrong for another reason than wrong wiring."""

    work: float  # the load gives back more work than it takes
    leak: float  # offsets of sensors, compressed oil and losses of the pump look like a negative leak
    sides: float  # the sides A and B are exchanged in the log
    rewired: float  # a recording has another sign than the healthy recordings before it


class HeldOilPriors(PriorTable):
    """Holds, i.e. times in which shut valves enclose the oil in both sides of a cylinder (in Pa and 1/Pa)."""

    # relative compression per pressure, and the standard deviation of its logarithm
    compressibility: float
    deviation: float
    # dead volume over the recorded stroke's volume: usual value, smallest value, relative standard deviation
    dead: float
    least_dead: float
    dead_deviation: float
    # logarithm of the piston areas' ratio, high pressure side over the other; its standard deviation
    sides: float
    sides_deviation: float
    sides_told: float  # probability that the pressures tell which side carries, whatever the offsets of the sensors
    unlike: float  # largest plausible ratio of the two piston areas
    right: float  # probability that the holds are right about a leak's flow if they disagree with the whole recording
    scatter: float  # relative standard deviation of a leak's flow in holds, beyond the errors of its fit
    agrees: float  # standard deviation of the logarithm of the ratio of the conductances from holds and whole recording
    rare: float  # p-value of a rise of the leakage in the holds, below which they give the flow of the leak
    settles: float  # [s] time in which valves shut
    before: float  # [s] time before a hold in which the flow shows the leakage of the pump
    pump_session: float  # relative standard deviation of this leakage between sessions with the same oil
    shortest: float  # [s] shortest hold
    equalises: float  # [s] time in which a leak equalises the pressures of a hold
    loaded: float  # log odds from which a pressure difference is surely a load, not an offset of the sensors
    independent: float  # number of independent readings of one side in a hold
    misfit: float  # fraction of the compressed volume that this model of the oil does not describe
    from_start: float  # fraction of the leaks that exist from the start of a recording
    gain: float  # relative difference between the gains of two pressure sensors
    charge: float  # relative margin above the charge pressure from which no check valve feeds a side
    tank: float  # standard deviation of the gauge pressure in a line to the tank
    open: float  # probability that the side without the load is open to the charge line
    above: float  # usual fraction of a hold in which an open side is above the charge pressure
    resolved: float  # further margin, within which a sensor cannot tell a pressure from the charge pressure
    steady: float  # [s] time over which a pressure is averaged before it is compared with the charge pressure
    # volume fraction of free air in the oil, and the standard deviation of its logarithm
    air: float
    air_deviation: float


class PressurePriors(PriorTable):
    """Smallest absolute pressure [Pa] at which free air is modelled; below it oil boils."""

    least: float


class ZeroPriors(PriorTable):
    """Error of p_A - p_B [Pa] at equal pressures, which the zeros of both pressure sensors cause together."""

    pressure: float  # standard deviation of the error of two usual sensors
    far: float  # standard deviation of the error if the sensors are far off
    odds: float  # probability that they are far off


class HealthyPriors(PriorTable):
    """Standard deviations of the leakage conductances of a healthy machine, in m^3/(s Pa) or as a fraction."""

    outside: float  # leakage to the outside
    piston: float  # leakage past the piston
    turbulent: float  # part of the leakage that flows as through an orifice, as a fraction


class HeldPriors(PriorTable):
    """A piston without a recorded position, which a control loop holds or returns: times in s, speeds in m/s."""

    half: float  # half the width of a test function (weight of samples in one equation) of a held piston
    settles: float  # time in which pressures settle after a motion
    slow: float  # largest speed of a held piston over its highest speed
    averaged: float  # time over which the speed is averaged
    share: float  # smallest leakage of a pump over its mean flow
    elsewhere: float  # fraction of a test function's weight in which noise may change the sign of p_A - p_B
    creep: float  # largest speed of a load that shut valves hold


class RestPriors(PriorTable):
    """A pump at rest, from which valves may cut off the cylinder; flows are divided by the mean flow in motion."""

    averaged: float  # [s] time over which the flow is averaged
    least: float  # [s] shortest rest
    share: float  # largest averaged flow at rest
    lasting: float  # [s] shortest time for which a pump that turns slowly is taken to hold a load
    holding: float  # mean flow of a pump that holds a load
    moves: float  # smallest mean flow of the pump in a block that counts as motion, and smallest flow by a flow meter
    lowers: float  # smallest speed, over the mean speed, of a load that a valve lowers while the pump rests
    shut: float  # leakage at rest over that in motion if valves cut the pump off, a standard deviation
    open: float  # relative difference of the leakage at rest and in motion if no valve shuts, a standard deviation
    compliance: float  # relative error of a compliance at rest that is fitted in motion, a standard deviation
    valves: float  # log odds, before any recording, that valves cut the pump off
    most: float  # limit of the log odds, from a healthy recording, that valves cut the pump off
    alone: float  # the same limit for a judged recording
    locked: float  # mean log odds of healthy recordings from which valves surely hold the pressures


class InferencePriors(PriorTable):
    """All tables of `inference/priors.toml`, the assumptions on the terms of a volume balance."""

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
    flow_zero: StepSize
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
