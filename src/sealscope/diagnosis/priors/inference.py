"""Typed tables of `inference/priors.toml`: assumptions on the terms of a volume balance."""

from sealscope.storage.toml_file import PriorTable, read_priors


class DriftPriors(PriorTable):
    """Drift of each kind of coefficient, as the standard deviation of its relative change in a minute [1/min]."""

    motion: float  # coefficients of the motion, such as displacement over area
    compliance: float  # compressed oil
    air: float  # free air in the oil
    bias: float  # constant flow, such as a tachometer shows at standstill because of its offset
    piston: float  # leakage past the piston
    pump: float  # leakage of the pump
    outside: float  # leakage to the outside
    edge: float  # gain of a servo valve's control edge


class DifferencePriors(DriftPriors):
    """Standard deviation of the relative difference between recordings of one machine, for each kind of coefficient.

    The fields have no unit. They are those of `DriftPriors` and another one.

    - `speed`: flow that the pump loses in proportion to its speed, a term of this comparison only.
    """

    speed: float


class LevelPriors(PriorTable):
    """Standard deviations of coefficients of a volume balance whose prior mean is zero; flows in m^3/s."""

    outside: float  # constant leakage to the outside
    bias: float  # constant flow without a recorded pressure, over the rms flow of the pump
    lag: float  # [s] delay of the position
    gas: float  # flow from an accumulator whose gas changes its temperature


class BlockPriors(PriorTable):
    """Division of a recording into blocks."""

    # [s] limits of a block's length
    longest: float
    shortest: float
    slowest: float  # [Hz] lowest sampling rate of a recording that is judged
    blocks: int  # number of blocks of a recording, unless their length would be outside these limits
    coarse: int  # largest number of blocks in tests for changes other than leaks
    expansion: float  # relative error of the volume by which oil and air expand within a block


class ScatterPriors(PriorTable):
    """Scatter of the leakage between recordings of one machine; leakages are divided by the pump's mean flow."""

    between: float  # factor by which all standard deviations of `DifferencePriors` together may be wrong
    estimate: float  # smallest scatter, over the standard error that a recording states for its leakage
    finest: float  # smallest scatter of the leakage
    largest: float  # largest scatter of the leakage
    relative: float  # largest scatter of the leakage's logarithm
    unlike: float  # fraction of days whose unrecorded oil temperature is unlike that of all others
    session: float  # standard deviation of the leakage between sessions with oil of one viscosity
    # a leakage outside the quantiles `tail` and 1 - `tail` of the prediction is evidence neither for a leak nor against
    tail: float


class ConditionPriors(PriorTable):
    """Effect of operating conditions (load, speed, oil temperature) that differ from those of healthy recordings."""

    # a condition is unusual if it lies outside the range of the healthy recordings by more than this
    ratio: float  # logarithm of the ratio of loads, or of speeds
    oil: float  # [K] difference of the oil temperatures
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
    drop_misleads: float  # probability that something else, such as worn seals, changed the judged recording's drop


class SizePriors(PriorTable):
    """Uncertainty of the sizes that convert a leak to L/min, as relative standard deviations, and the leak's law."""

    displacement: float  # displacement of the pump
    law: float  # mean flow of a leak if its law is unknown: laminar, an orifice, or between the two
    laminar: float  # prior probability of a laminar leak
    usual: float  # scale of the prior on the flow of a leak, over the pump's flow
    present: float  # prior probability that there is a leak in a recording
    within: float  # prior probability that a leak began within the recording, not before
    meter: float  # scale of a flow meter
    area: float  # piston area
    creep: float  # flow of a leak, estimated from the creep of a held load


class TemperingPriors(PriorTable):
    """Limits of the belief in likelihoods of models, as no model describes a machine exactly."""

    term: float  # relative misfit of a term or an event to what it explains
    pattern: float  # relative misfit of a pattern (levels that one cause changes) to a step
    readings: int  # number of independent readings as which the residuals of a volume balance count


class TotalPriors(PriorTable):
    """Total leakage of pump and piston."""

    misfit: float  # flow that the terms do not describe, over the pump's mean flow in motion, a standard deviation


class RepeatPriors(PriorTable):
    """Relative differences, between days, of the flow that the same motion needs."""

    scatter: float  # standard deviation between days
    recordings: float  # the prior on this scatter weighs as much as this number of recordings
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


class DelayPriors(StepSize):
    """Changes of a channel's delay within a recording: `size` and `spread` [s] of a change, and three others.

    - `odds`: odds that the delay of a channel changes;
    - `clock`: standard deviation of the drift of a delay by the clocks of two recorders [s/min];
    - `other`: probability below which an alternative channel is excluded.
    """

    odds: float
    clock: float
    other: float


class SensePriors(PriorTable):
    """Probabilities of causes by which the sign of a recorded flow looks wrong, or has become wrong."""

    # the sign looks wrong for another reason:
    driving_load: float  # the load gives back more work than it takes
    leak: float  # offsets of sensors, compressed oil or losses of the pump look like a negative leak
    sides: float  # the sides A and B are exchanged in the log
    motion_score: float  # standard errors by which flow and motion correlate, in either sense, while the piston moves
    rewired: float  # the sign is wrong, as the sensor was reversed since the healthy recordings


class HeldOilPriors(PriorTable):
    """Holds, i.e. times in which shut valves enclose the oil in both sides of a cylinder."""

    # [1/Pa] relative compression per pressure, and the standard deviation of its logarithm
    compressibility: float
    deviation: float
    # dead volume over the recorded stroke's volume: usual value, smallest value, relative standard deviation
    dead_volume: float
    least_dead_volume: float
    dead_volume_deviation: float
    # logarithm of the piston areas' ratio, high pressure side over the other; its standard deviation
    log_area_ratio: float
    log_area_ratio_deviation: float
    load_side_probability: (
        float  # probability that the pressures tell which side carries the load, despite offsets of the sensors
    )
    largest_area_ratio: float  # largest plausible ratio of the two piston areas
    weight_of_holds: float  # probability that holds state a leak's flow right if the whole recording states another
    scatter: float  # relative standard deviation of a leak's flow in holds, beyond the errors of its fit
    agreement: (
        float  # ratio of the conductances from holds and whole recording, the standard deviation of its logarithm
    )
    significance: float  # p-value below which a rise of the leakage in the holds counts for the flow of the leak
    shutting_time: float  # [s] time in which valves shut
    time_before: float  # [s] time before a hold in which the flow shows the leakage of the pump
    pump_session: float  # relative standard deviation of this leakage between sessions with the same oil
    shortest: float  # [s] shortest hold
    equalising_time: float  # [s] time in which a leak equalises the pressures of a hold
    load_odds: float  # log odds from which a pressure difference is surely a load, not an offset of the sensors
    independent_readings: float  # number of independent readings of one side in a hold
    misfit: float  # fraction of the compressed volume that this model of the oil does not describe
    share_from_start: float  # fraction of the leaks that exist from the start of a recording
    gain: float  # relative difference between the gains of two pressure sensors
    charge_margin: (
        float  # above the charge pressure by this fraction of it and `resolution`, no check valve feeds a side
    )
    tank_pressure: float  # [Pa] gauge pressure in a line to the tank, a standard deviation
    open_probability: float  # probability that the side without the load is open to the charge line
    time_above_charge: float  # usual fraction of a hold in which an open side is above the charge pressure
    resolution: float  # [Pa] difference of pressures that a sensor hardly resolves
    averaging_time: float  # [s] time over which a pressure is averaged before it is compared with the charge pressure
    # volume fraction of free air in the oil, and the standard deviation of its logarithm
    air: float
    air_deviation: float


class PressurePriors(PriorTable):
    """Smallest absolute pressure [Pa] at which free air is modelled; below it oil boils."""

    least: float


class ZeroPriors(PriorTable):
    """Error of p_A - p_B [Pa] at equal pressures, which the zeros of both pressure sensors cause together."""

    pressure: float  # standard deviation of the error of two usual sensors
    far: float  # standard deviation of the error of two sensors that are far off
    odds: float  # probability that two sensors are far off


class HealthyPriors(PriorTable):
    """Standard deviations of the leakage of a healthy machine."""

    outside: float  # [m^3/(s Pa)] conductance to the outside
    piston: float  # [m^3/(s Pa)] conductance past the piston
    turbulent: float  # fraction of the leakage that flows as through an orifice


class HeldPriors(PriorTable):
    """A piston without a recorded position, which a control loop holds or returns."""

    half_width: float  # [s] half the width of a test function (weight of samples in one equation) of a held piston
    settling_time: float  # [s] time in which pressures settle after a motion
    held_speed: float  # largest speed of a held piston over its highest speed
    averaging_time: float  # [s] time over which the speed is averaged
    least_leakage: float  # smallest leakage of a pump over its mean flow
    ambiguous_share: float  # fraction of a test function's weight in which noise may change the sign of p_A - p_B
    ramp_share: float  # fraction of the samples in motion whose command is within the dead band
    null_distance: float  # largest distance of a command from its null where a valve is shut, over the dead band
    creep_speed: float  # [m/s] largest speed of a load that shut valves hold


class FeedPriors(PriorTable):
    """Chambers that a pump feeds."""

    one_chamber_odds: float  # log odds, before any recording, that the pump feeds one chamber at a time
    asymmetric_odds: float  # the same, that the flows of an asymmetric pump have the ratio of the piston areas
    side_pressure: float  # [Pa] magnitude of p_A - p_B from which it tells the side whose area the pump's flow moves
    scatter: float  # relative scatter of the ratio of flow to speed in either direction, a standard deviation
    # of a pump that turns while the piston rests
    circulation_odds: float  # log odds, before any recording, that its flow circulates to the tank
    holding_flow: float  # mean flow if it holds the load, over that in motion: the median of a log-normal distribution
    spread: float  # standard deviation of the logarithm of this fraction


class RestPriors(PriorTable):
    """A pump at rest, from which valves may cut off the cylinder; flows are divided by the mean flow in motion."""

    averaging_time: float  # [s] time over which the flow is averaged
    shortest: float  # [s] shortest rest
    flow_at_rest: float  # largest flow at rest, averaged over `averaging_time`
    shortest_hold: float  # [s] shortest time for which a pump that turns slowly is taken to hold a load
    holding_flow: float  # mean flow of a pump that holds a load
    # smallest mean flow of a block in motion; also the largest flow of a meter, or speed over the mean speed, at rest
    motion_fraction: float
    lowering_speed: (
        float  # smallest speed at the mean load, over the mean speed, of a piston that passes a resting pump
    )
    leakage_if_shut: float  # leakage at rest over that in motion if valves cut the pump off, a standard deviation
    scatter_if_open: (
        float  # relative difference of the leakage at rest and in motion if no valve shuts, a standard deviation
    )
    compliance_error: float  # relative error of a compliance at rest that is fitted in motion, a standard deviation
    # log odds that valves cut the pump off
    shut_odds: float  # before any recording
    odds_limit: float  # limit of the log odds that the rests of a recording give
    single_odds_limit: float  # narrower limit, for the judged recording alone and in sums over healthy recordings
    sure_odds: float  # mean over the healthy recordings above which the valves surely hold the pressures


class InferencePriors(PriorTable):
    """All tables of `inference/priors.toml`, the assumptions on the terms of a volume balance."""

    drift: DriftPriors
    level: LevelPriors
    delay: DelayPriors
    blocks: BlockPriors
    between: DifferencePriors
    scatter: ScatterPriors
    conditions: ConditionPriors
    oil: OilPriors
    size: SizePriors
    tempering: TemperingPriors
    total: TotalPriors
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
    feed: FeedPriors
    rest: RestPriors


INFERENCE = read_priors("sealscope.diagnosis.inference", InferencePriors)
