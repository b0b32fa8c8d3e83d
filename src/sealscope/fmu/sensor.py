"""The code of a soft sensor: the observer's filters, sample by sample, as functions that C can call.

Its laws are those of `diagnosis.observer`, compiled for a rig. A run has three phases: the noise of the readings and
the senses of the channels are estimated (`SEARCH_SECONDS`); where there is no position, a bank of filters finds the
oil's stiffness (as long again); then the filter runs whose estimates are reported (`sensor_memory`). No samples are
stored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from itertools import accumulate
from operator import attrgetter
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numba import carray

from sealscope.compiled import law, pointer_at
from sealscope.diagnosis.observer.detector import BLOCK_SECONDS, EXPECTED_WALK
from sealscope.diagnosis.observer.estimates import LEAD, SUMS
from sealscope.diagnosis.observer.evidence import SIZE_ERROR
from sealscope.diagnosis.observer.model import PARAMETERS as FACTORS
from sealscope.diagnosis.observer.model import (
    STIFFNESS,
    WALKS,
    assume,
    compliance,
    displacement,
    mean_area,
    start_parameters,
)
from sealscope.diagnosis.observer.pressure_filter import (
    COVARIANCE,
    LONGEST_STEP,
    MEANS,
    ROOM,
    ROUNDS,
    SEARCH_SECONDS,
    Room,
    start_pressures,
    take_pressures,
)
from sealscope.diagnosis.observer.stream import LEAST_PRESSURE, LEAST_VOLUME, Formulation
from sealscope.diagnosis.observer.volume_filter import VOLUME_STATES, start_volume, take_volume
from sealscope.fmu.machine import numbers_of, unit_code
from sealscope.fmu.sensor_memory import (
    BLOCKS,
    CHOOSES,
    CLOCK,
    COUNT,
    FINE,
    LENGTH,
    N_TAPS,
    NOISE_A,
    OMEGA,
    PHASE,
    PUSH,
    ROUND,
    RUNS,
    SEARCHES,
    THETA,
    TURN,
    WINDOW,
    X,
    fresh,
    keep,
    search,
    senses,
    write_results,
)
from sealscope.fmu.variables import INPUT_BASE, RESULT_BASE, VALUE_BASE, VALUES, Variable
from sealscope.parameters import Rig
from sealscope.parameters.fields import leaves, unit_of
from sealscope.physics.rig import NUMBERS, throttle_readings
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES

#: Channels that a soft sensor reads, by its formulation.
INPUTS: Mapping[Formulation, tuple[str, ...]] = MappingProxyType(
    {
        "volume": ("p_A", "p_B", "theta", "x"),
        "speed": ("p_A", "p_B", "omega"),
        "command": ("p_A", "p_B", "u"),
    }
)
#: Parameters beside those of the rig: unit, words.
SAMPLING = {
    "sample": ("s", "interval of the samples that are taken"),
    "block": ("s", "length of a block, best whole cycles of the duty"),
}
_MEAN, _RISE = "pump and piston together, mean of the last blocks", "rise over the first blocks"
#: Outputs: unit, words.
RESULTS = {
    "q": ("m^3/s", f"leakage of {_MEAN}"),
    "q_low": ("m^3/s", "leakage, lower end of its 95 % interval"),
    "q_high": ("m^3/s", "leakage, upper end of its 95 % interval"),
    "q_rise": ("m^3/s", f"leakage, {_RISE}"),
    "q_rise_low": ("m^3/s", "leakage, lower end of the rise's 95 % interval"),
    "q_rise_high": ("m^3/s", "leakage, upper end of the rise's 95 % interval"),
    "conductance": ("m^3/(s Pa)", f"conductance between the chambers, {_MEAN}"),
    "misfit": ("1", "mean square of the normalised innovations of the last block, 1 where the model describes it"),
    "blocks": ("1", "blocks that were estimated"),
    "settled": ("1", "1 from the first block after those of the baseline on, else 0"),
}
#: What a function of a soft sensor returns where it fails.
FAILURES = MappingProxyType({1: "sample must be > 0 s, and a block two samples at least"})
#: Parameters of the rig that the filters read.
_GEOMETRY = ("pump.q_b", "cylinder.A_A", "cylinder.A_B", "cylinder.V", "fluid.K_oil")
_FRICTION = tuple(f"friction.{name}" for name in ("F_pr", "F_cfr", "C_c", "K_brk", "F_v", "v_th"))
_DRIVE = tuple(
    f"motor.{name}"
    for name in ("R_c", "L_c", "C_e", "C_m", "J_M", "B_M", "k_p", "K_i", "omega_per_volt", "V_max", "i_max")
)
READ: Mapping[Formulation, tuple[str, ...]] = MappingProxyType(
    {
        "volume": _GEOMETRY,
        "speed": (*_GEOMETRY, "cylinder.M_eq", *_FRICTION),
        "command": (*_GEOMETRY, "cylinder.M_eq", *_FRICTION, *_DRIVE),
    }
)
_N_VALUES = len(VALUES) + len(SAMPLING)
_SAMPLE, _BLOCK = len(VALUES), len(VALUES) + 1
_CANDIDATES = tuple(float(factor) for factor in np.geomspace(*STIFFNESS))
_STIFFNESS = FACTORS.index("stiffness")
_N_FACTORS, _N_STATES = len(FACTORS), len(VOLUME_STATES)
#: A pressure filter's memory, and blocks that never end.
_EACH = MEANS + _N_FACTORS + COVARIANCE**2 + SUMS
_NEVER = 1e18


def variables(rig: Rig, formulation: Formulation, rate: float) -> Iterator[Variable]:
    """Yield the variables of a soft sensor that takes samples at `rate` [Hz]."""
    for k, name in enumerate(INPUTS[formulation]):
        yield Variable(
            INPUT_BASE + k, name, "input", "continuous", CHANNEL_UNITS[name], f"reading: {LONG_NAMES[name]}", 0.0
        )
    declared = dict(leaves(Rig))
    for name in READ[formulation]:
        field = declared[name]
        words, value = str(field.title or name), attrgetter(name)(rig)
        yield Variable(VALUE_BASE + VALUES.index(name), name, "parameter", "fixed", unit_of(field), words, float(value))
    for k, ((name, (unit, words)), value) in enumerate(
        zip(SAMPLING.items(), (1.0 / rate, BLOCK_SECONDS), strict=True), len(VALUES)
    ):
        yield Variable(VALUE_BASE + k, name, "parameter", "fixed", unit, words, value)
    for k, (name, (unit, words)) in enumerate(RESULTS.items()):
        yield Variable(RESULT_BASE + k, name, "output", "continuous", unit, words, None)


class SensorChoice(NamedTuple):
    """What the code of a soft sensor depends on: formulation, laws of the rig, where the parameters start."""

    formulation: Formulation
    choices: tuple[bool | tuple[bool, ...], ...]
    exponent: float
    literal: bool
    start: tuple[float, ...]
    deviations: tuple[float, ...]

    @classmethod
    def of(cls, rig: Rig, formulation: Formulation) -> SensorChoice:
        """Return a rig's choice."""
        start, deviations = (tuple(map(float, values)) for values in start_parameters(assume(rig)))
        choices = tuple(assume(rig))[len(NUMBERS) :]
        return cls(formulation, choices, *throttle_readings(rig), start, deviations)


def layout(formulation: Formulation) -> dict[str, tuple[int, int]]:
    """Return where each part of a soft sensor's memory begins, and its length."""
    if formulation == "volume":
        n = _N_STATES
        parts = {"y": n, "P": n**2, "sums": SUMS, "walk": n, "row": LEAD + 2 * n, "held": n**2 + n, "room": 2 * n}
    else:
        n = _N_FACTORS
        parts = {"bank": len(_CANDIDATES) * _EACH, "likelihood": len(_CANDIDATES), "filter": _EACH, "start": n}
        parts |= {"deviations": n, "walk": n, "row": LEAD + 2 * n, "room": sum(math.prod(shape) for shape in ROOM)}
    begins = accumulate((LENGTH, *parts.values()))
    return {name: (begin, size) for (name, size), begin in zip(parts.items(), begins, strict=False)}


def size(formulation: Formulation) -> int:
    """Return the length of a soft sensor's memory."""
    return sum(layout(formulation)["room"])


def functions(choice: SensorChoice) -> dict[str, Callable[..., Any]]:
    """Return the functions of a soft sensor, to be compiled: ``start``, ``advance`` and ``report`` as of a machine."""
    formulation = choice.formulation
    sample = _sample_of_volumes(choice) if formulation == "volume" else _sample_of_pressures(choice)
    length, row, n_inputs, n_results = (
        size(formulation),
        layout(formulation)["row"][0],
        len(INPUTS[formulation]),
        len(RESULTS),
    )
    size_error, expected, quantiles = SIZE_ERROR[formulation], EXPECTED_WALK[formulation], _quantiles()

    def start(values: Any, inputs: Any, x_0: float, y: Any) -> int:
        v = carray(values, _N_VALUES)
        fresh(carray(y, length))
        return 0 if v[_SAMPLE] > 0.0 and v[_BLOCK] >= 2.0 * v[_SAMPLE] else 1

    def advance(values: Any, inputs: Any, slopes: Any, y: Any, span: float, steps: int) -> int:
        v, m = carray(values, _N_VALUES), carray(y, length)
        a, b = carray(inputs, n_inputs), carray(slopes, n_inputs)
        t, h = m[CLOCK], v[_SAMPLE]
        while t < span - 1e-6 * h:  # a sample at the end is the next step's first
            sample(y, v, a[0] + b[0] * t, a[1] + b[1] * t, a[2] + b[2] * t, a[n_inputs - 1] + b[n_inputs - 1] * t)
            t += h
        m[CLOCK] = t - span
        return 0

    def report(values: Any, inputs: Any, y: Any, results: Any) -> int:
        m = carray(y, length)
        misfit = m[row + 2] if m[BLOCKS] > 0.0 else 0.0
        block_s, out = carray(values, _N_VALUES)[_BLOCK], carray(results, n_results)
        walk = expected * (block_s / BLOCK_SECONDS) ** 2
        write_results(m, block_s, misfit, size_error, walk, quantiles, out)
        return 0

    return {"start": start, "advance": advance, "report": report}


def _sample_of_volumes(choice: SensorChoice) -> Callable[..., Any]:
    """Return the law that takes a sample of pressures, angle and position."""
    where, n = layout("volume"), _N_STATES
    y_at, P_at, sums_at, walk_at, row_at, held_at, room_at = (begin for begin, _ in where.values())
    length = size("volume")
    numbers = numbers_of(choice.choices, choice.exponent, choice.literal)
    displaced, area_of, stored = law(displacement), law(mean_area), law(compliance)

    @law
    def sample(memory: Any, v: Any, p_A: float, p_B: float, theta: float, x: float) -> None:
        m, p, h = carray(memory, length), numbers(v, 0.0, 0.0), v[_SAMPLE]
        area, D, c = area_of(p), displaced(p), stored(p)
        y, P = carray(pointer_at(memory, y_at), n), carray(pointer_at(memory, P_at), (n, n))
        sums, walk = carray(pointer_at(memory, sums_at), SUMS), carray(pointer_at(memory, walk_at), n)
        if m[PHASE] == SEARCHES:
            search(m, theta, x, p_A - p_B, theta, x, p_A - p_B, h, True)
            if m[COUNT] < round(SEARCH_SECONDS / h):
                return
            senses(m)
            of_theta, of_x, of_dp = D * m[TURN], -area, -c * m[PUSH]
            power = of_theta**2 * m[FINE] + of_x**2 * m[FINE + 1] + of_dp**2 * m[FINE + 2]
            power += 2.0 * of_theta * (of_x * m[FINE + 3] + of_dp * m[FINE + 4]) + 2.0 * of_x * of_dp * m[FINE + 5]
            m[NOISE_A] = max(power / (m[COUNT] - N_TAPS + 1.0), LEAST_VOLUME**2)
            start_volume(area, c, p.K_oil, v[_BLOCK], y, P, sums, walk)
            m[PHASE], m[THETA], m[X] = RUNS, theta, x
            return
        row, room = carray(pointer_at(memory, row_at), LEAD + 2 * n), carray(pointer_at(memory, room_at), (2, n))
        held, swept = carray(pointer_at(memory, held_at), (n + 1, n)), area * (x - m[X])
        z, dp = D * m[TURN] * (theta - m[THETA]) - swept, m[PUSH] * (p_A - p_B)
        block = max(2.0, round(v[_BLOCK] / h))
        if take_volume(z, swept, dp, h, area, y, P, sums, m[NOISE_A], walk, block, row, held, room):
            keep(m, row, v[_BLOCK])

    return sample  # type: ignore[no-any-return]


def _sample_of_pressures(choice: SensorChoice) -> Callable[..., Any]:
    """Return the law that takes a sample of pressures and speed, or command."""
    commanded, where, n = choice.formulation == "command", layout(choice.formulation), _N_FACTORS
    bank_at, alive_at, filter_at, start_at, spread_at, walk_at, row_at, room_at = (begin for begin, _ in where.values())
    length, candidates = size(choice.formulation), len(_CANDIDATES)
    numbers = numbers_of(choice.choices, choice.exponent, choice.literal)
    rooms = tuple(accumulate((room_at, *(math.prod(shape) for shape in ROOM))))
    start_of, deviation_of, walk_of = choice.start, choice.deviations, tuple(value**2 / 60.0 for value in WALKS)
    (first_stop, left), (last_stop, _) = ROUNDS

    @law
    def room_of(memory: Any) -> Any:
        J, E = carray(pointer_at(memory, rooms[0]), ROOM[0]), carray(pointer_at(memory, rooms[1]), ROOM[1])
        T, B = carray(pointer_at(memory, rooms[2]), ROOM[2]), carray(pointer_at(memory, rooms[3]), ROOM[3])
        S, W = carray(pointer_at(memory, rooms[4]), ROOM[4]), carray(pointer_at(memory, rooms[5]), ROOM[5])
        k1, k2 = carray(pointer_at(memory, rooms[6]), MEANS), carray(pointer_at(memory, rooms[7]), MEANS)
        k3, k4 = carray(pointer_at(memory, rooms[8]), MEANS), carray(pointer_at(memory, rooms[9]), MEANS)
        mid, gain = carray(pointer_at(memory, rooms[10]), MEANS), carray(pointer_at(memory, rooms[11]), COVARIANCE)
        return Room(J, E, T, B, S, W, k1, k2, k3, k4, mid, gain)

    @law
    def parts(memory: Any, at: int) -> Any:
        q_at, P_at = at + MEANS, at + MEANS + n
        z, q = carray(pointer_at(memory, at), MEANS), carray(pointer_at(memory, q_at), n)
        P = carray(pointer_at(memory, P_at), (COVARIANCE, COVARIANCE))
        return z, q, P, carray(pointer_at(memory, P_at + COVARIANCE * COVARIANCE), SUMS)

    @law
    def begin(memory: Any, at: int, stiffness: float) -> None:
        start, deviations = carray(pointer_at(memory, start_at), n), carray(pointer_at(memory, spread_at), n)
        for k in range(n):
            start[k], deviations[k] = start_of[k], deviation_of[k]
        start[_STIFFNESS], deviations[_STIFFNESS] = stiffness, deviation_of[_STIFFNESS] * stiffness
        z, q, P, sums = parts(memory, at)
        start_pressures(start, deviations, carray(pointer_at(memory, NOISE_A), 2), z, q, P, sums)

    @law
    def drop_least_likely(m: Any) -> None:
        alive = 0
        for k in range(candidates):
            alive += m[alive_at + k] > -math.inf
        for _ in range(alive - left):
            worst = -1
            for k in range(candidates):
                likelihood = m[alive_at + k]
                if likelihood > -math.inf and (worst < 0 or likelihood < m[alive_at + worst]):
                    worst = k
            m[alive_at + worst] = -math.inf

    @law
    def end_search(memory: Any, m: Any) -> None:
        senses(m)
        for k in range(2):
            m[NOISE_A + k] = max(m[FINE + 1 + k] / (m[COUNT] - N_TAPS + 1.0), LEAST_PRESSURE**2)
        for k in range(candidates):
            begin(memory, bank_at + k * _EACH, _CANDIDATES[k])
            m[alive_at + k] = 0.0
        m[PHASE], m[COUNT], m[ROUND] = CHOOSES, 0.0, 0.0

    @law
    def end_choice(memory: Any, m: Any, block_s: float) -> None:
        best = 0
        for k in range(candidates):
            if m[alive_at + k] > m[alive_at + best]:
                best = k
        begin(memory, filter_at, parts(memory, bank_at + best * _EACH)[1][_STIFFNESS])
        for k in range(n):
            m[walk_at + k] = walk_of[k] * block_s
        m[PHASE] = RUNS

    @law
    def sample(memory: Any, v: Any, p_A: float, p_B: float, given: float, _: float) -> None:
        m, h, drive = carray(memory, length), v[_SAMPLE], given
        if not commanded:  # the mean speed since the sample before
            drive = 0.5 * (given + m[OMEGA]) if m[COUNT] + m[PHASE] > 0.0 else given
            m[OMEGA] = given
        if m[PHASE] == SEARCHES:
            search(m, given, p_A, p_B, given, p_A - p_B, 0.0, h, False)
            if m[COUNT] >= round(SEARCH_SECONDS / h):
                end_search(memory, m)
            return
        drive *= m[TURN]
        running = m[PHASE] == RUNS
        p, room, noise = numbers(v, 0.0, 0.0), room_of(memory), carray(pointer_at(memory, NOISE_A), 2)
        walk, row = carray(pointer_at(memory, walk_at), n), carray(pointer_at(memory, row_at), LEAD + 2 * n)
        steps = int(max(1.0, math.ceil(h / (LONGEST_STEP if running else 2.0 * LONGEST_STEP) - 1e-9)))
        block = max(2.0, round(v[_BLOCK] / h)) if running else _NEVER
        for k in range(1 if running else candidates):
            if running or m[alive_at + k] > -math.inf:
                z, q, P, sums = parts(memory, filter_at if running else bank_at + k * _EACH)
                closed = take_pressures(
                    drive, p_A, p_B, commanded, h, steps, p, z, q, P, sums, noise, walk, block, row, room
                )
                if closed:
                    keep(m, row, v[_BLOCK])
                if not running:
                    m[alive_at + k] = sums[1] if math.isfinite(sums[1]) else -math.inf
        if running:
            return
        m[COUNT] += 1.0
        if m[ROUND] == 0.0 and m[COUNT] >= round(first_stop / h):
            m[ROUND] = 1.0
            drop_least_likely(m)
        if m[COUNT] >= round(last_stop / h):
            end_choice(memory, m, v[_BLOCK])

    return sample  # type: ignore[no-any-return]


def _quantiles() -> tuple[float, ...]:
    """Return Student's t of 95 % intervals for 1, 2, ... degrees of freedom."""
    from scipy.special import stdtrit

    return tuple(float(stdtrit(freedom, 0.975)) for freedom in range(1, WINDOW))


@lru_cache(maxsize=8)
def sensor_code(choice: SensorChoice) -> Mapping[str, str]:
    """Return the LLVM code of a soft sensor (`unit_code`)."""
    return unit_code(functions(choice))
