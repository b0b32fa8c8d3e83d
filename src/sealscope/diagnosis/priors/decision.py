"""Typed tables of `decision/priors.toml`: priors of decisions."""

from sealscope.storage.toml_file import PriorTable, read_priors


class NullPriors(PriorTable):
    """Prior on the error of a detector's null distribution for healthy recordings."""

    fails: float
    inflation: float
    largest: float


class QuestionPriors(PriorTable):
    """Fraction of the false-alarm probability for each test of a diagnosis."""

    within: float


class ExplanationPriors(PriorTable):
    """Probabilities above which an explanation is named or a leak stated."""

    heading: float
    leak: float
    named: float
    sure: float
    misfit: float


class WorthPriors(PriorTable):
    """Limits beyond which an upper bound of a leak, or an unjudged rest of a recording, is too large to state."""

    share: float
    unjudged: float


class DecisionPriors(PriorTable):
    """The tables of `decision/priors.toml`."""

    null: NullPriors
    questions: QuestionPriors
    explanation: ExplanationPriors
    worth: WorthPriors


DECISION = read_priors("sealscope.diagnosis.decision", DecisionPriors)
