"""The only place that makes a verdict of a balance: three questions, each with an estimate, an interval and a bound.

1. Did a leak begin within the recording? (`onset.step_test`)
2. Is it more than in the baseline? (`scatter.rise`)
3. Is it more than a healthy machine passes? (the level of G against the rig's file, where it says so)

`leak` where one of them is answered with yes at its share of the false-alarm probability. Where that is the first, a
leak past piston or pump must be the most probable of all causes; where it is not, what else stepped may have raised the
level, too, and no leak is stated. `no leak` with the 95 % bound X where X is below the leak worth finding
(`priors.toml`); else `cannot tell` with X. `judgement.judged` sets it beside what the other detectors say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.blocks import Blocks, Columns, information, mean_of, zero_of
from sealscope.diagnosis.inference.onset import (
    BELOW_95,
    WITHIN_95,
    Course,
    Information,
    Interval,
    StepTest,
    course,
    step_test,
)
from sealscope.diagnosis.inference.other_steps.causes import StepHypothesis, hypotheses, probabilities
from sealscope.diagnosis.inference.other_steps.causes import stepped as stepped_cause
from sealscope.diagnosis.inference.other_steps.step import other_step
from sealscope.diagnosis.inference.scatter import RecordingSums, Rise, rise
from sealscope.diagnosis.inference.terms import LAG, ORIFICE, PUMP, Equation
from sealscope.diagnosis.verdict.evidence import (
    LEAKS,
    NO_RIG,
    RAREST,
    Cause,
    Evidence,
    LeakCourse,
    RelativeLeak,
    TotalLeakage,
)
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.oil import oil_temperature
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

SECOND: float = beliefs("inference")["verdict"]["second"]


class Size(NamedTuple):
    """What turns a flow by the assumed displacement into that of the machine.

    `scale`, its relative `deviation`; `stated`: whether L/min can be stated at all; `ratio`: displacement over area as
    measured, over the assumed one, with its interval, None where the position has no unit; `area` of the piston by the
    assumed displacement [m^2].
    """

    scale: float
    deviation: float
    stated: bool
    ratio: Interval | None
    area: float | None
    disagrees: bool = False


@dataclass(frozen=True, eq=False)
class RecordedBalance:
    """A recording's blocks with all that is asked of them.

    `lost`: tests of a step of what leaves the circuit by the accumulator's own balance, by the term's name; `plain`:
    the blocks with the zero of p_A - p_B as recorded, where they are others.
    """

    blocks: Blocks
    equations: tuple[Equation, ...]
    columns: tuple[Columns, ...]
    rig: Rig
    recording: Recording
    lost: Mapping[str, StepTest] = field(default_factory=dict)
    plain: Blocks | None = None

    @property
    def units(self) -> frozenset[tuple[str, str]]:
        """Channels with their units."""
        return frozenset(self.recording.units.items())

    @cached_property
    def leak(self) -> Information:
        """What the blocks say of the leak's coefficient."""
        return information(self.blocks, self.columns, self.columns[0].leak)

    @cached_property
    def test(self) -> StepTest | None:
        """Test of a step of the leak's coefficient."""
        return step_test(self.leak)

    @cached_property
    def through_orifice(self) -> StepTest | None:
        """Test of a step of the flow through an orifice."""
        column = self.columns[0]
        return step_test(information(self.blocks, self.columns, column.names.index(ORIFICE), column.leak))

    @cached_property
    def hypotheses(self) -> tuple[StepHypothesis, ...]:
        """Tests of all terms' coefficients, the most likely first."""
        return hypotheses(self.blocks, self.plain or self.blocks, self.equations, self.columns, self.lost)

    @cached_property
    def recording_sums(self) -> RecordingSums:
        """What the recording says of a healthy machine."""
        dated, oil = start_seconds(self.recording), oil_temperature(self.recording)
        return RecordingSums.of(self.blocks, self.columns, dated, oil)

    @cached_property
    def zero(self) -> float:
        """Zero of p_A - p_B [Pa], as a change of the leak shows it."""
        return zero_of(self.blocks, self.columns)

    @cached_property
    def root_zero(self) -> float:
        """Zero of the root of p_A - p_B [Pa^0.5], as a change of a leak through an orifice shows it."""
        return zero_of(self.blocks, self.columns, self.columns[0].names.index(ORIFICE))

    @cached_property
    def delay(self) -> tuple[float, float] | None:
        """How much later x is recorded than the flow [s], by the share of its lag in the motion, with its deviation."""
        column = self.columns[0]
        motion = [k for k in column.motion if column.names[k].startswith("motion")]
        if LAG not in column.names or not motion:
            return None
        area = _area(self, motion).measured
        value, deviation = mean_of(self.blocks, column, {column.names.index(LAG): 1.0})
        return (value / area, deviation / area) if area > 0.0 else None

    def mean(self, column: int, since: float = -np.inf) -> float:
        """Return a mean over the blocks whose middle is at `since` or later, of pressures about their zero."""
        zero = self.root_zero if column == 1 else self.zero
        values = self.blocks.flow if column == 2 else self.blocks.driving(zero, root=column == 1)
        chosen = self.blocks.time >= since
        if not chosen.any():
            chosen[-1] = True
        return float(np.average(values[chosen], weights=np.maximum(self.blocks.rows[chosen], 1e-9)))

    @cached_property
    def moving(self) -> float:
        """Mean flow while it flows [m^3/s]: the mean weighted by itself, so that standstills do not count."""
        flow = self.blocks.flow
        return float(flow @ flow / max(float(flow.sum()), np.finfo(float).tiny))

    @cached_property
    def size(self) -> Size:
        """What turns a flow by the assumed displacement into that of the machine."""
        return _size(self)

    @cached_property
    def level(self) -> Interval:
        """What passes pump and piston in all over the recording, as a conductance with its interval.

        The pressures at the pump's ports hardly differ from those of the chambers: the sum is known, its parts are not.
        """
        weights = np.maximum(self.blocks.rows, 0.0)
        return self.whole.over(weights / weights.sum())

    @cached_property
    def whole(self) -> Course:
        """What passes pump and piston in all over the blocks, as a conductance."""
        column = self.columns[0]
        apart = column.names.index(PUMP) if PUMP in column.names else None
        both = information(self.blocks, self.columns, column.leak, apart)
        test = step_test(both)
        return course(both, test, step=test is not None and test.chance < RAREST)

    def course(self, step: bool) -> Course:
        """Return the leak's coefficient over the blocks."""
        return course(self.leak, self.test, step)


def _size(balance: RecordedBalance) -> Size:
    """Weigh what is stated of displacement and area against each other.

    The balance measures their ratio. A stated displacement sizes every flow directly, a stated area by that ratio;
    where both are stated and disagree the flow lies between what either says.
    """
    column, rig = balance.columns[0], balance.rig
    believed = beliefs("inference")["size"]
    with_unit = not {("theta", "count"), ("omega", "count"), ("u", "count")} & balance.units
    pressures = not {("p_A", "count"), ("p_B", "count")} & balance.units
    states_displacement = rig.states("pump.q_b") and with_unit
    if len(balance.columns) > 1:  # behind a valve the area sizes the flow
        return Size(1.0, believed["area"], rig.states("cylinder.A_A", "cylinder.A_B") and pressures, None, None)
    motion = [k for k in column.motion if column.names[k].startswith("motion")]
    area = _area(balance, motion) if motion and ("x", "m") in balance.units else None
    if area is None or not area.measured > 0.0 or not with_unit:
        return Size(1.0, believed["displacement"], states_displacement and pressures, None, None)
    ratio = Interval(*(area.assumed / end for end in (area.measured, area.high, max(area.low, 1e-12))))
    apart = abs(1.0 / ratio.value - 1.0)
    known = float(np.hypot(believed["displacement"], believed["area"]))
    if states_displacement:
        disagrees = rig.states("cylinder.A_A", "cylinder.A_B") and apart > WITHIN_95 * known
        deviation = apart if disagrees else believed["displacement"]
        return Size(1.0, deviation, pressures, ratio, area.measured, disagrees)
    if rig.states("cylinder.A_A", "cylinder.A_B"):
        return Size(ratio.value, believed["area"], pressures, ratio, area.measured)
    return Size(1.0, known, False, ratio, area.measured)


class _Area(NamedTuple):
    """The area of the side that carries [m^2]: `measured` by the assumed displacement, with its interval; `assumed`."""

    measured: float
    low: float
    high: float
    assumed: float


def _area(balance: RecordedBalance, motion: list[int]) -> _Area:
    """Return the area of the side that carries, the mean of both ways and sides in the proportion that they occur."""
    column, cylinder = balance.columns[0], balance.rig.cylinder
    energy = np.einsum("kii->i", balance.blocks.gram[:, 0])[motion]
    shares = energy / max(float(energy.sum()), np.finfo(float).tiny)
    value, deviation = mean_of(balance.blocks, column, dict(zip(motion, shares, strict=True)))
    value, half = abs(value), WITHIN_95 * deviation
    stated = [cylinder.A_A if column.names[k].endswith("A carries") else cylinder.A_B for k in motion]
    return _Area(value, value - half, value + half, float(shares @ stated))


def judge(balance: RecordedBalance, probability: float, baseline: Sequence[RecordingSums] = ()) -> Evidence:
    """Return the evidence of a balance at a false-alarm probability, against what healthy recordings say."""
    test = balance.test
    against = rise(balance.recording_sums, baseline, balance.columns) if baseline else None
    if test is None and against is None:
        return Evidence("cannot tell", "p_A and p_B hardly differ, or too few samples are whole: no leak would show")
    questions = questions_of(balance, against, probability)
    answered = next((own for own in questions if own.chance < own.probability), None)
    causes: dict[Cause, float] = {}
    if answered is not None and answered.name == WITHIN and test is not None:
        flow, pump = test.fitted[0] * balance.mean(0), balance.mean(2)
        beside = other_step(balance.recording, RAREST)  # it takes a leak away
        causes = probabilities(balance.hypotheses, beside, flow / pump if pump > 0.0 else 0.0)
        answered = answered if is_leak(causes) else None
    if answered is None:
        judging = questions[0]
        bound = bound_of(balance, against)
        enough = balance.moving > 0.0 and bound <= beliefs("inference")["worth"]["share"] * balance.moving
        enough &= not may_be_leak(causes)
        cause = stepped_cause(balance.hypotheses, probability, other_step(balance.recording, probability))
        evidence = Evidence("no leak" if enough else "cannot tell", "", cause=None if cause in LEAKS else cause)
    else:
        judging = answered
        evidence = Evidence("leak", "", cause=_together(balance))
        if answered.name == WITHIN:
            evidence = _step(balance, causes)
        elif against is not None:
            evidence = _flow(balance, evidence, *_of_rise(balance, against))
        else:
            level, pressure = balance.level, balance.mean(0)
            deviation = (level.high - level.low) * pressure / (2 * WITHIN_95)
            evidence = _flow(balance, evidence, level.value * pressure, deviation)
    return _with_figures(balance, evidence, against, questions, judging)


#: The three questions, by name.
WITHIN, AGAINST, LEVEL = "within the recording", "against the baseline", "against the rig's file"


class Question(NamedTuple):
    """A question asked: its score and threshold, the chance of the score, its share of the false-alarm probability."""

    name: str
    score: float
    threshold: float
    chance: float
    probability: float


def questions_of(balance: RecordedBalance, against: Rise | None, probability: float) -> list[Question]:
    """Return the questions that can be asked of a balance."""
    healthy = balance.rig.pump.G_healthy
    # a drive's droop with the load passes for a level of the leak
    measured = len(balance.columns) == 1 and not balance.equations[0].by_command
    if not (healthy > 0.0 and against is None and balance.size.stated and measured):
        return questions(balance.test, against, probability)
    own = balance.level
    deviation = float(np.hypot((own.high - own.low) / (2 * WITHIN_95), own.value * balance.size.deviation))
    level = (own.value - healthy) / max(deviation, np.finfo(float).tiny)
    return questions(balance.test, against, probability, level)


def questions(
    test: StepTest | None, against: Rise | None, probability: float, level: float | None = None
) -> list[Question]:
    """Return the questions that can be asked, each with its share of the false-alarm probability.

    `level`: that of the leak above a healthy machine's, in deviations.
    """
    from scipy.special import ndtr, ndtri

    possible = []
    second = SECOND * probability if test is not None and (against is not None or level is not None) else 0.0
    if test is not None:
        share = second if against is not None else probability - second
        possible.append(Question(WITHIN, test.score, test.threshold(share), test.chance, share))
    if against is not None:
        share = probability - second
        possible.append(Question(AGAINST, against.score, against.threshold(share), against.chance, share))
    if level is not None:
        share = second or probability
        possible.append(Question(LEVEL, level, float(-ndtri(share)), float(ndtr(-level)), share))
    return possible


def is_leak(causes: dict[Cause, float]) -> bool:
    """Whether a leak past piston or pump is more probable than every other cause; either may be the pump's alone.

    They lie in parallel, and often are one hypothesis under two names: their probabilities do not add.
    """
    pump = causes.get("pump leak", 0.0)
    leak = sum(causes.get(cause, 0.0) for cause in LEAKS)
    others = max((share for cause, share in causes.items() if cause not in (*LEAKS, "pump leak")), default=0.0)
    return max(leak, pump) > others and leak > RAREST * pump


def may_be_leak(causes: dict[Cause, float]) -> bool:
    """Whether a change that has one of these causes may as well be a leak past the piston."""
    sure: float = beliefs("inference")["verdict"]["sure"]
    return sum(causes.get(own, 0.0) for own in LEAKS) >= 1.0 - sure


def _together(balance: RecordedBalance) -> Cause:
    return "piston or pump leak" if len(balance.columns) == 1 else "piston leak"


def _step(balance: RecordedBalance, causes: dict[Cause, float]) -> Evidence:
    """Return the evidence of a leak that began within the recording; its law is weighed, laminar against an orifice."""
    test, orifice = balance.test, balance.through_orifice
    assert test is not None
    onset = test.onset()
    flows, deviations, scores = [], [], []
    for own, mean in ((test, 0), (orifice, 1)):
        if own is not None:
            pressure = balance.mean(mean, onset.value)
            flows.append(own.fitted[0] * pressure)
            deviations.append(own.fitted[1] * pressure)
            scores.append(own.score)
    weights = np.exp(0.5 * (np.array(scores) - max(scores)))
    weights /= weights.sum()
    value = float(weights @ flows)
    spread = float(np.sqrt(weights @ (np.square(deviations) + (np.array(flows) - value) ** 2)))
    pump = causes.get("pump leak", 0.0)
    cause: Cause = _together(balance)
    if "pump leak" in causes and pump < RAREST:
        cause = "piston leak"
    evidence = Evidence("leak", "", onset_s=onset.value, onset_interval_s=(onset.low, onset.high), cause=cause)
    return _flow(balance, evidence, value, spread)


def _of_rise(balance: RecordedBalance, against: Rise) -> tuple[float, float]:
    """Return a rise against the baseline and its deviation as flows [m^3/s]."""
    pressure = balance.mean(0)
    half = 0.5 * (against.interval()[1] - against.interval()[0]) / WITHIN_95
    return against.value * pressure, half * pressure


def _flow(balance: RecordedBalance, evidence: Evidence, value: float, deviation: float) -> Evidence:
    """Return the evidence with the flow [m^3/s] of a leak and its deviation, as far as the machine's size is known."""
    size = balance.size
    pump = balance.mean(2)
    deviations = [deviation, value * size.deviation, value * beliefs("inference")["size"]["law"]]
    half = WITHIN_95 * float(np.linalg.norm(deviations))
    low, high = max(value - half, 0.0), value + half
    relative = RelativeLeak(
        pump_share=value / pump if pump > 0.0 else None,
        pump_share_interval=_over((value - WITHIN_95 * deviation, value + WITHIN_95 * deviation), pump),
        creep=None if size.area is None else value / size.area,
        creep_interval=_over((value - WITHIN_95 * deviation, value + WITHIN_95 * deviation), size.area),
    )
    evidence = replace(evidence, relative=relative)
    if not size.stated:
        return replace(evidence, refuses=frozenset({"leak_lpm"}))
    unit = size.scale / LITRE_PER_MINUTE
    return replace(evidence, leak_lpm=value * unit, leak_interval_lpm=(low * unit, high * unit))


def _over(interval: tuple[float, float], unit: float | None) -> tuple[float, float] | None:
    return None if unit is None or not unit > 0.0 else (max(interval[0], 0.0) / unit, interval[1] / unit)


def bound_of(balance: RecordedBalance, against: Rise | None) -> float:
    """Return the 95 % upper bound of a leak that began within the recording or came since the baseline [m^3/s]."""
    bounds = []
    if against is not None:
        bounds.append(against.bound() * balance.mean(0))
    elif balance.test is not None:
        bounds.append(balance.test.bound() * balance.mean(0))
    size = float(np.hypot(balance.size.deviation, beliefs("inference")["size"]["law"]))
    return max(max(bounds, default=np.inf), 0.0) * (1.0 + BELOW_95 * size)


def asked(evidence: Evidence, questions: Sequence[Question], judging: Question, what: str) -> Evidence:
    """Return the evidence with the figures of the question that judges, and where there are several with all of them.

    `what`: what the questions are about.
    """
    parts = tuple(
        Evidence(
            "leak" if evidence.verdict == "leak" and own is judging else "no leak",
            f"{what} {own.name}",
            own.score,
            own.threshold,
            detector=own.name,
            chance=max(own.chance, RAREST),
        )
        for own in questions
    )
    return replace(
        evidence,
        score=judging.score,
        threshold=judging.threshold,
        chance=max(judging.chance, RAREST),
        parts=parts if len(parts) > 1 else (),
    )


def _with_figures(
    balance: RecordedBalance,
    evidence: Evidence,
    against: Rise | None,
    questions: Sequence[Question],
    judging: Question,
) -> Evidence:
    """Return the evidence with scores, thresholds, course, total, bound and the reason in words."""
    size = balance.size
    bound = bound_of(balance, against)
    findable = None if evidence.verdict == "leak" else _findable(balance, questions)
    stated = size.stated and evidence.verdict != "leak" and np.isfinite(bound)
    evidence = replace(
        asked(evidence, questions, judging, "leakage"),
        total_leakage=_total_leakage(balance, balance.level, findable),
        ratio=None if size.ratio is None else size.ratio.value,
        ratio_interval=None if size.ratio is None else (size.ratio.low, size.ratio.high),
        bound_lpm=bound * size.scale / LITRE_PER_MINUTE if stated else None,
        course=_leak_course(balance, evidence) if size.stated else None,
    )
    return replace(evidence, reason=_reason(balance, evidence, bound, judging.name))


def _findable(balance: RecordedBalance, questions: Sequence[Question]) -> float | None:
    """Return the smallest step within the recording that would have been found [m^3/s]."""
    share = next((own.probability for own in questions if own.name == WITHIN), None)
    if balance.test is None or share is None:
        return None
    return balance.test.findable(share) * balance.mean(0)


def _total_leakage(balance: RecordedBalance, level: Interval, findable: float | None) -> TotalLeakage:
    size, pressure, pump = balance.size, balance.mean(0), balance.mean(2)
    healthy = balance.rig.pump.G_healthy
    flow = pressure * size.scale / LITRE_PER_MINUTE
    wide = 1.0 + WITHIN_95 * size.deviation
    stated = size.stated and len(balance.columns) == 1  # a valve's edges pass as well, by an amount that is not known
    low, high = (
        end * flow * (wide if (end > 0.0) == upper else 1.0 / wide)
        for end, upper in zip(level[1:], (False, True), strict=True)
    )
    return TotalLeakage(
        lpm=level.value * flow if stated else None,
        interval_lpm=(low, high) if stated else None,
        pressure=pressure,
        findable_lpm=None if findable is None or not size.stated else findable * size.scale / LITRE_PER_MINUTE,
        healthy_lpm=healthy * pressure / LITRE_PER_MINUTE if healthy > 0.0 else None,
        pump_share=max(level.value, 0.0) * pressure / pump if pump > 0.0 and len(balance.columns) == 1 else None,
        findable_share=None if findable is None or not pump > 0.0 else findable / pump,
    )


def _leak_course(balance: RecordedBalance, evidence: Evidence) -> LeakCourse:
    """Return the leak over the recording: what came with it, or what passes in all where none began."""
    whole, time = evidence.onset_s is None, balance.blocks.time
    own = balance.whole if evidence.onset_s is None else balance.course(step=True).beyond(time < evidence.onset_s)
    value, deviation = own.mean, np.sqrt(np.maximum(np.diag(own.covariance), 0.0))
    unit = balance.blocks.driving(balance.zero) * balance.size.scale / LITRE_PER_MINUTE
    half = WITHIN_95 * np.hypot(deviation, value * balance.size.deviation)
    return LeakCourse(time, value * unit, (value - half) * unit, (value + half) * unit, whole=whole)


def _level_text(total: TotalLeakage | None) -> str:
    """Return what passes in all beside what a healthy machine passes, in words."""
    if total is None or total.lpm is None or total.healthy_lpm is None:
        return "pump and piston together pass more than a healthy machine"
    return (
        f"pump and piston together pass {total.lpm:.3g} L/min, a healthy machine at most {total.healthy_lpm:.2g} "
        "L/min by the rig's file (pump.G_healthy)"
    )


def _reason(balance: RecordedBalance, evidence: Evidence, bound: float, question: str) -> str:
    """Return why, in one line."""
    share = f"{100.0 * bound / balance.mean(2):.2g} % of the pump's flow" if balance.mean(2) > 0.0 else "any size"
    limit = f"{evidence.bound_lpm:.2g} L/min" if evidence.bound_lpm is not None else share
    if evidence.verdict == "leak":
        text = {
            WITHIN: "leakage steps up within the recording, beyond the drift of this machine",
            AGAINST: "leakage is above that of the healthy recordings by more than they scatter",
            LEVEL: _level_text(evidence.total_leakage),
        }[question]
        if "leak_lpm" in evidence.refuses:
            text += f"; {NO_RIG}"
    elif evidence.verdict == "no leak":
        text = f"no leak above {limit} (95 %)"
    else:
        text = f"a leak of up to {limit} would not show (95 %)"
        text += "; a longer recording, with the load or direction changing, bounds it closer"
    size = balance.size
    if size.ratio is not None and size.disagrees:
        text += f"; displacement over area is {size.ratio.value:.3g} times the assumed one: flows lie between both"
    if abs(balance.zero) > 2.0 * WITHIN_95 * beliefs("inference")["zero"]["pressure"]:
        text += f"; p_A - p_B reads {abs(balance.zero) / 1e5:.2g} bar too {'much' if balance.zero > 0.0 else 'little'}"
    if (late := balance.delay) is not None and abs(late[0]) > 1.0 / balance.recording.rate + WITHIN_95 * late[1]:
        text += f"; x is recorded {1e3 * abs(late[0]):.3g} ms {'later' if late[0] > 0.0 else 'earlier'} than the flow"
    if evidence.verdict != "leak" and evidence.cause is not None:
        text += f"; what stepped is rather {evidence.cause}"
    return text
