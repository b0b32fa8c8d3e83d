"""Typed tables of `decision/priors.toml`: probabilities that a decision rests on."""

from sealscope.storage.toml_file import PriorTable, read_priors


class FalseAlarmPriors(PriorTable):
    """Allowed probability of the verdict "leak" on a leak-free recording."""

    probability: float  # default
    # limits for a caller; smaller p-values than `rarest` are not stated
    rarest: float
    largest: float


class NullPriors(PriorTable):
    """Prior on the error of the p-values that a detector states for healthy recordings (`decision.case`).

    For right p-values the mean of -log(p-value) is 1. Wrong p-values are too small, and this mean is a factor > 1.
    """

    wrong_share: float  # fraction of machines on which the p-values of a test are wrong
    inflation: float  # scale of the exponential prior on the logarithm of this factor
    largest: float  # largest factor


class QuestionPriors(PriorTable):
    """Division of the false-alarm probability of a diagnosis among its tests."""

    # fraction of the test for a change within the recording if there are healthy recordings, and without these of the
    # test by the limit in the rig's file
    within: float


class ExplanationPriors(PriorTable):
    """Thresholds on the probability of an explanation, above which a verdict states it, and errors of explanations."""

    heading: float  # allowed probability of naming another event by mistake, over that of a false leak
    leak: float  # probability above which a change is called a leak
    named: float  # probability, among all causes of the change, above which a cause other than a leak is named
    happened: float  # the same if the change may also be pure chance; both limits must be exceeded
    sure: float  # a leak, or another event, is excluded if its probability is below 1 - `sure`
    combined: float  # smallest logarithm of the Bayes factor with which an event is combined with others
    scale: float  # relative error of a common factor on both pressures, as computed from leakage, friction or noise


class WorthPriors(PriorTable):
    """Limits beyond which the verdict "no leak" would say too little and is not stated."""

    share: float  # largest upper bound of an undetected leak, over the pump's mean flow
    unjudged: float  # largest fraction of a recording after its last judged sample


class DecisionPriors(PriorTable):
    """All tables of `decision/priors.toml`, the probabilities on which a decision rests."""

    false_alarm: FalseAlarmPriors
    null: NullPriors
    questions: QuestionPriors
    explanation: ExplanationPriors
    worth: WorthPriors


DECISION = read_priors("sealscope.diagnosis.decision", DecisionPriors)
