"""Typed tables of `inference/priors.toml`: assumptions on the terms of a volume balance."""

from sealscope.storage.toml_file import PriorTable, read_priors


class DriftPriors(PriorTable):
    """Drift of each kind of coefficient in a volume balance.

    Each field is the standard deviation of the relative change in a minute [1/min].

    - `motion`: coefficients of the motion, such as displacement over area.
    - `compliance`: compressed oil.
    - `air`: free air in the oil.
    - `bias`: constant flow, such as a tachometer shows at standstill because of its offset.
    - `leak`: leakage past the piston.
    - `pump`: leakage of the pump.
    - `outside`: leakage to the outside.
    - `edge`: gain of a servo valve's control edge.
    """

    motion: float
    compliance: float
    air: float
    bias: float
    leak: float
    pump: float
    outside: float
    edge: float


class DifferencePriors(DriftPriors):
    """Standard deviation of the relative difference between recordings of one machine, for each kind of coefficient.

    The fields have no unit. They are those of `DriftPriors` and, in addition:

    - `speed`: flow that the pump loses in proportion to its speed.
    """

    speed: float


class LevelPriors(PriorTable):
    """Standard deviations of constant flows in a volume balance; the prior mean of each flow is zero.

    - `outside` [m^3/s]: constant leakage to the outside.
    - `gas` [m^3/s]: flow from an accumulator whose gas changes its temperature.
    """

    outside: float
    gas: float


class BlockPriors(PriorTable):
    """Division of a recording into blocks.

    - `longest`, `shortest` [s]: limits of a block's length.
    - `blocks`: number of blocks of a recording, unless their length would be outside these limits.
    - `coarse`: largest number of blocks in tests for changes other than leaks.
    """

    longest: float
    shortest: float
    blocks: int
    coarse: int


class ScatterPriors(PriorTable):
    """Scatter of the leakage between recordings of one machine.

    Leakages are divided by the pump's mean flow.

    - `between`: factor by which all standard deviations of `DifferencePriors` together may be wrong.
    - `freedom`: degrees of freedom of the prior on the scatter of the motion's coefficients.
    - `estimate`: smallest scatter, over the standard error that a recording states for its leakage.
    - `finest`: smallest scatter of the leakage.
    - `leak`: standard deviation of the leakage between recordings.
    - `largest`: largest scatter of the leakage.
    - `relative`: largest scatter of the leakage's logarithm.
    - `unlike`: fraction of days whose unrecorded oil temperature is unlike that of all others.
    - `session`: standard deviation of the leakage between sessions with oil of one viscosity.
    - `tail`: probability that a healthy recording lies farther above the others than these predict, and the same below.
    """

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
    """Effect of operating conditions that differ from those of the healthy recordings.

    - `ratio`: logarithm of load or speed over those of the healthy days, a standard deviation.
    - `oil` [K]: change of the oil temperature within a day.
    - `motion`: exponent of load and speed in the ratio of displaced to pumped volume, a standard deviation.
    - `leak`: exponent of load and speed in a leak's conductance, a standard deviation.
    """

    ratio: float
    oil: float
    motion: float
    leak: float


class OilPriors(PriorTable):
    """Effect of the oil's temperature and viscosity on the leakage of a healthy machine.

    - `warmest`: largest conductance, with the warmest oil, over the smallest.
    - `per_kelvin`, `per_kelvin_deviation` [1/K]: relative increase of a leak per kelvin, and its standard deviation.
    - `shift` [h]: time in which the oil warms by the largest difference.
    - `per_drop`, `per_drop_deviation`: the leak is inversely proportional to this power of the viscous pressure drop
      of the motion; the exponent and its standard deviation.
    - `friction_session`, `friction_changes`: standard deviations of the logarithm of the friction between days, of the
      same seals, and of seals that wear.
    - `drop_tells`: probability that a change of this pressure drop is due to the oil and not to the load and speed of
      the machine.
    """

    warmest: float
    per_kelvin: float
    per_kelvin_deviation: float
    shift: float
    per_drop: float
    per_drop_deviation: float
    friction_session: float
    friction_changes: float
    drop_tells: float


class SizePriors(PriorTable):
    """Uncertainty of the sizes that convert a leak to L/min, as relative standard deviations, and the leak's law.

    - `displacement`: displacement of the pump.
    - `law`: mean flow of a leak if its law is unknown: laminar, an orifice, or between the two.
    - `laminar`: prior probability of a laminar leak.
    - `readings`: number of independent values by which a recording tells the leak's law.
    - `meter`: scale of a flow meter.
    - `area`: piston area.
    - `creep`: flow of a leak by which a held load creeps.
    """

    displacement: float
    law: float
    laminar: float
    readings: int
    meter: float
    area: float
    creep: float


class RepeatPriors(PriorTable):
    """Differences of the flow that the same motion needs on another day, as relative standard deviations.

    - `scatter`: scatter between days.
    - `recordings`: the prior on the scatter weighs as much as this number of recordings.
    - `inflation`: largest factor by which the standard errors of the recordings may be too small.
    """

    scatter: float
    recordings: float
    inflation: float


class GrowthPriors(PriorTable):
    """Growth of a leak after its onset within a recording.

    - `steady`: probability that it does not grow.
    - `most`: largest increase of the leak's flow until the end of the recording, over the flow at the onset.
    """

    steady: float
    most: float


class StepSize(PriorTable):
    """Log-normal prior on the size of a change other than a leak past the piston, or on the volume of an accumulator.

    - `size`: median size. It is in [m^3/s] for an external leak, [Pa] for free air (its volume fraction times the
      atmospheric pressure), [Pa/s] for a drift, [m^3] for an accumulator, and relative for a scale or a zero of the
      flow.
    - `spread`: standard deviation of the logarithm of the size.
    """

    size: float
    spread: float


class SensePriors(PriorTable):
    """Probabilities that a sign of the recorded flow looks wrong for another reason than wrong wiring.

    - `work`: the load gives back more work than it takes.
    - `leak`: offsets of sensors, compressed oil and losses of the pump look like a negative leak.
    - `sides`: the sides A and B are exchanged in the log.
    - `rewired`: a recording has another sign than the healthy recordings before it.
    """

    work: float
    leak: float
    sides: float
    rewired: float


class HeldOilPriors(PriorTable):
    """Oil that is enclosed in the sides of a cylinder while shut valves hold it; such a time is a hold.

    - `compressibility` [1/Pa], `deviation`: relative compression per pressure, and the standard deviation of its
      logarithm.
    - `dead`, `dead_deviation`, `least_dead`: dead volume over the recorded stroke's volume, its relative standard
      deviation, and the smallest one.
    - `sides`, `sides_deviation`: logarithm of the ratio of the piston areas, of the side with the highest pressure over
      the other, and its standard deviation.
    - `sides_told`: probability that the pressures tell which side carries, whatever the offsets of the sensors.
    - `unlike`: largest ratio of the two piston areas.
    - `right`: probability that the holds are right about a leak's flow if they disagree with the whole recording.
    - `agrees`: standard deviation of the logarithm of the ratio of the conductances from holds and whole recording.
    - `rare`: p-value (probability in a healthy machine) of a rise of the leakage in the holds, below which the rise
      is used to estimate the flow of the leak.
    - `settles` [s]: time in which valves shut.
    - `before` [s]: time before a hold in which the flow shows the leakage of the pump.
    - `pump_session`: relative standard deviation of this leakage between sessions with the same oil.
    - `shortest` [s]: shortest hold.
    - `equalises` [s]: time in which a leak equalises the pressures of a hold.
    - `loaded`: log odds from which a pressure difference is surely due to a load, and not to an offset of the
      sensors.
    - `independent`: number of independent readings of one side in a hold.
    - `misfit`: fraction of the compressed volume that this model of the oil does not describe.
    - `from_start`: fraction of the leaks that exist from the start of a recording.
    - `gain`: relative difference between the gains of two pressure sensors.
    - `charge`: relative margin above the charge pressure from which no check valve feeds a side.
    - `resolved` [Pa]: margin in addition, below which a sensor does not tell a pressure from the charge pressure.
    - `steady` [s]: time over which a pressure is averaged before it is compared with the charge pressure.
    - `air`, `air_deviation`: volume fraction of free air in the oil, and the standard deviation of its
      logarithm.
    """

    compressibility: float
    deviation: float
    dead: float
    least_dead: float
    dead_deviation: float
    sides: float
    sides_deviation: float
    sides_told: float
    unlike: float
    right: float
    agrees: float
    rare: float
    settles: float
    before: float
    pump_session: float
    shortest: float
    equalises: float
    loaded: float
    independent: float
    misfit: float
    from_start: float
    gain: float
    charge: float
    resolved: float
    steady: float
    air: float
    air_deviation: float


class PressurePriors(PriorTable):
    """Smallest pressure at which free air is modelled.

    - `least` [Pa]: this absolute pressure, below which oil boils.
    """

    least: float


class ZeroPriors(PriorTable):
    """Error of p_A - p_B at equal pressures, which the zeros of both pressure sensors cause together.

    - `pressure` [Pa]: standard deviation of the error of two usual sensors.
    - `far` [Pa]: standard deviation of the error if the sensors are far off.
    - `odds`: probability that they are far off.
    """

    pressure: float
    far: float
    odds: float


class HealthyPriors(PriorTable):
    """Leakage conductance of a healthy machine.

    Each field is a standard deviation.

    - `outside` [m^3/(s Pa)]: leakage to the outside.
    - `piston` [m^3/(s Pa)]: leakage past the piston.
    """

    outside: float
    piston: float


class HeldPriors(PriorTable):
    """A piston without a recorded position, which a control loop holds or returns.

    - `half` [s]: half the width of a test function, the smooth weight of samples in one equation, while the piston is
      held.
    - `settles` [s]: time in which pressures settle after a motion.
    - `slow`: largest speed of a held piston over its highest speed.
    - `averaged` [s]: time over which the speed is averaged.
    - `share`: smallest leakage of a pump over its mean flow.
    - `elsewhere`: fraction of a test function's weight in which noise may change the sign of p_A - p_B.
    - `creep` [m/s]: largest speed of a load that shut valves hold.
    """

    half: float
    settles: float
    slow: float
    averaged: float
    share: float
    elsewhere: float
    creep: float


class RestPriors(PriorTable):
    """A pump at rest, from which valves may cut off the cylinder.

    Flows are divided by the mean flow in motion.

    - `averaged` [s]: time over which the flow is averaged.
    - `least` [s]: shortest rest.
    - `share`: largest averaged flow at rest.
    - `holding`: mean flow of a pump that holds a load.
    - `moves`: smallest mean flow of the pump in a block that counts as motion, and smallest flow by a flow meter.
    - `shut`: leakage at rest over that in motion if valves cut the pump off, a standard deviation.
    - `open`: relative difference of the leakage at rest and in motion if no valve shuts, a standard deviation.
    - `compliance`: relative error of a compliance at rest that is fitted in motion, a standard deviation.
    - `valves`: log odds, before any recording, that valves cut the pump off.
    - `most`: limit of the log odds, from a healthy recording, that valves cut the pump off.
    - `alone`: the same limit for a judged recording.
    - `locked`: mean log odds of healthy recordings from which valves surely hold the pressures.
    """

    averaged: float
    least: float
    share: float
    holding: float
    moves: float
    shut: float
    open: float
    compliance: float
    valves: float
    most: float
    alone: float
    locked: float


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
