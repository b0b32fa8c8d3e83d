"""Typed tables of `decision/priors.toml`: probabilities that a decision rests on."""

from sealscope.storage.toml_file import PriorTable, read_priors


class NullPriors(PriorTable):
    """Prior on the error of the false-alarm probabilities that a detector's own law gives.

    - `fails`: fraction of machines on which the law does not hold for a statistic.
    - `inflation`: exponential scale of the logarithm of the factor by which such a law underestimates a surprisal's
      mean.
    - `largest`: largest such factor.
    """

    fails: float
    inflation: float
    largest: float


class QuestionPriors(PriorTable):
    """Division of the false-alarm probability of a diagnosis among its tests.

    - `within`: fraction for a change within the recording if there are healthy recordings; without them, fraction for
      the
      leakage against the limit in the rig's file.
    """

    within: float


class ExplanationPriors(PriorTable):
    """Probabilities from which an explanation is named or a leak stated.

    - `heading`: factor by which another event that is named for a healthy recording may be rarer than a false leak.
    - `leak`: probability from which a change is called a leak.
    - `named`: probability from which a cause other than a leak is named.
    - `sure`: a leak is excluded if its probability is below 1 - `sure`.
    - `misfit`: smallest relative error with which a term describes the data.
    """

    heading: float
    leak: float
    named: float
    sure: float
    misfit: float


class WorthPriors(PriorTable):
    """Limits beyond which "no leak" is not stated.

    - `share`: largest upper bound of a leak, over the pump's flow.
    - `unjudged`: largest fraction of a recording after its last judged sample.
    """

    share: float
    unjudged: float


class DecisionPriors(PriorTable):
    """The tables of `decision/priors.toml`."""

    null: NullPriors
    questions: QuestionPriors
    explanation: ExplanationPriors
    worth: WorthPriors


DECISION = read_priors("sealscope.diagnosis.decision", DecisionPriors)
