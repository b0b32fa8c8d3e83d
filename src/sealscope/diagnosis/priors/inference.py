"""Typed tables of `inference/priors.toml`: assumptions on the terms of a volume balance."""

from sealscope.storage.toml_file import PriorTable, read_priors


class DriftPriors(PriorTable):
    """Relative change of each kind of coefficient in a minute, a standard deviation [1/min].

    - `motion`: coefficients of the motion, such as displacement over area.
    - `compliance`: compressed oil.
    - `air`: free air in the oil.
    - `bias`: constant flow, such as the zero of a tachometer.
    - `leak`: leakage past the piston.
    - `pump`: leakage of the pump.
    - `outside`: leakage to the outside.
    - `edge`: gain of a servo valve's edge.
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
    """Relative difference of each kind of coefficient between recordings of one machine, a standard deviation.

    Fields as in `DriftPriors`, but without a unit, and in addition:

    - `speed`: flow that the pump loses in proportion to its speed.
    """

    speed: float


class LevelPriors(PriorTable):
    """Size of a constant flow in a balance, a standard deviation.

    - `outside` [m^3/s]: constant leakage to the outside.
    - `gas` [m^3/s]: flow from an accumulator whose gas changes its temperature.
    """

    outside: float
    gas: float


class BlockPriors(PriorTable):
    """Division of a recording into blocks.

    - `longest`, `shortest` [s]: limits of a block's length.
    - `blocks`: number of blocks below which blocks are shorter than the longest.
    - `coarse`: largest number of blocks for changes other than those of the leak.
    """

    longest: float
    shortest: float
    blocks: int
    coarse: int


class ScatterPriors(PriorTable):
    """Scatter of the leakage between recordings of one machine; leakages are divided by the pump's mean flow.

    - `between`: factor to which the standard deviations of `DifferencePriors`, together, are uncertain.
    - `freedom`: degrees of freedom of the prior on the scatter of the motion's coefficients.
    - `estimate`: standard deviation of the scatter that a recording's own rows predict.
    - `finest`: smallest scatter of the leakage.
    - `leak`: standard deviation of the leakage between recordings.
    - `largest`: largest scatter of the leakage.
    - `relative`: largest scatter of the leakage's logarithm.
    - `unlike`: fraction of days whose unrecorded oil temperature is unlike that of all others.
    - `session`: standard deviation of the leakage between sessions.
    - `tail`: probability that a healthy recording is unlike all others.
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
    - `motion`: exponent with which displaced over pumped volume depends on load and speed, a standard deviation.
    - `leak`: exponent with which a conductance depends on load and speed, a standard deviation.
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
    - `per_drop`, `per_drop_deviation`: exponent with which a leak falls with the viscous pressure drop of the motion,
      and
      its standard deviation.
    - `drop_tells`: probability that a change of this pressure drop is due to the oil and not to the duty.
    """

    warmest: float
    per_kelvin: float
    per_kelvin_deviation: float
    shift: float
    per_drop: float
    per_drop_deviation: float
    drop_tells: float


class SizePriors(PriorTable):
    """Uncertainty of a machine's sizes, as relative standard deviations, and the law of its leak.

    - `displacement`: displacement of the pump.
    - `law`: mean flow of a leak whose law is between that of a laminar leak and that of an orifice.
    - `laminar`: prior probability of a laminar leak.
    - `readings`: number of independent readings of the leak's law in a recording.
    - `meter`: scale of a flow meter.
    - `area`: piston area.
    """

    displacement: float
    law: float
    laminar: float
    readings: int
    meter: float
    area: float


class RepeatPriors(PriorTable):
    """Flow that the same motion needs on another day, as relative standard deviations.

    - `error`: error within a recording.
    - `scatter`: scatter between days.
    - `recordings`: number of recordings that the prior on the scatter counts for.
    """

    error: float
    scatter: float
    recordings: float


class GrowthPriors(PriorTable):
    """Growth of a leak after its onset within a recording.

    - `steady`: probability that it does not grow.
    - `most`: largest growth until the end of the recording, over the size at the onset.
    """

    steady: float
    most: float


class StepSize(PriorTable):
    """Size of a change, with a log-normal prior.

    - `size`: median, of an external leak [m^3/s], of free air [Pa], of a drift [Pa/s], of a scale relative.
    - `spread`: standard deviation of the logarithm.
    """

    size: float
    spread: float


class SensePriors(PriorTable):
    """Probabilities of other causes of what looks like a wrong sign of the flow into side A.

    - `work`: that the load gives back more work than it takes.
    - `leak`: that zeros, compliance and losses of the pump look like a negative leak.
    - `sides`: that the sides A and B are exchanged in the log.
    """

    work: float
    leak: float
    sides: float


class HeldOilPriors(PriorTable):
    """Oil that is enclosed in a cylinder side while valves shut it.

    - `compressibility` [1/Pa], `deviation`: relative compression per pressure, and its relative standard deviation.
    - `dead`, `dead_deviation`: dead volume over the recorded stroke's volume, and its relative standard deviation.
    - `unlike`: largest ratio of the areas of both sides.
    - `right`: probability that the holds are right if they disagree with the whole recording.
    - `agrees`: standard deviation of the logarithm of a conductance between holds and whole recording.
    - `rare`: chance below which the holds tell something of a leak's size.
    - `settles` [s]: time in which valves shut.
    - `shortest` [s]: shortest hold.
    - `equalises` [s]: time in which a leak equalises the pressures of a hold.
    - `loaded`: log odds from which a pressure difference is surely a load.
    - `independent`: number of independent readings of one side in a hold.
    - `misfit`: fraction of the compressed volume that the terms do not describe.
    - `gain`: relative difference between the gains of two pressure sensors.
    - `charge`: variation of the charge pressure over the smallest pressure of either side.
    - `air`: volume fraction of free air in the oil.
    """

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
    gain: float
    charge: float
    air: float


class PressurePriors(PriorTable):
    """Range in which the terms of free air hold.

    - `least` [Pa]: smallest absolute pressure.
    """

    least: float


class ZeroPriors(PriorTable):
    """Offset of a pressure sensor.

    - `pressure` [Pa]: standard deviation between two sensors.
    - `far` [Pa]: standard deviation of a sensor that is far off.
    - `odds`: probability of a sensor that is far off.
    """

    pressure: float
    far: float
    odds: float


class HealthyPriors(PriorTable):
    """Leakage conductance of a healthy machine, as standard deviations.

    - `outside` [m^3/(s Pa)]: to the outside.
    - `piston` [m^3/(s Pa)]: past the piston.
    """

    outside: float
    piston: float


class HeldPriors(PriorTable):
    """A piston whose position a control loop holds or returns.

    - `half` [s]: half the width of a test function while the piston is held.
    - `settles` [s]: time in which pressures settle after a motion.
    - `slow`: largest speed of a held piston over its highest speed.
    - `averaged` [s]: time over which the speed is averaged.
    - `share`: smallest leakage of a pump over its mean flow.
    - `elsewhere`: fraction of a test function in which noise may change the sign of p_A - p_B.
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
    """A pump at rest; flows are divided by the mean flow in motion.

    - `averaged` [s]: time over which the flow is averaged.
    - `least` [s]: shortest rest.
    - `share`: largest mean flow at rest.
    - `holding`: mean flow of a pump that holds a load.
    - `moves`: smallest mean flow in a block of motion.
    - `shut`: leakage of a healthy piston over that of pump and piston, a standard deviation.
    - `open`: difference of the leakage of a pump at rest and in motion, a standard deviation.
    - `most`: largest log odds, from one healthy recording, that valves cut the pump off.
    - `alone`: the same for a judged recording.
    - `locked`: mean log odds of healthy recordings from which valves surely hold the pressures.
    """

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
