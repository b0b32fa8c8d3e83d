"""Overriding values by name: from Python numbers, from texts with units, and the errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig, parse_overrides
from sealscope.parameters.fields import choices_of, unit_of
from sealscope.parameters.parts import Motor
from sealscope.parameters.rig import declared_fields

from ..refusals import mentions, refusal

RIG = load_rig("thesis")
NUMBERS = [name for name, field in declared_fields().items() if field.annotation is float]
CHOICES = [name for name, field in declared_fields().items() if choices_of(field)]


def message(settings: dict[str, Any], **more: Any) -> str:
    with pytest.raises(InputError) as caught:
        RIG.with_overrides(settings, **more)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_numbers_are_si_and_texts_carry_units() -> None:
    rig = RIG.with_overrides(
        {
            "motor.R_c": "0.8[ohm]",
            "V_1": 5e-5,
            "V_2": "50[cm^3]",
            "p_A.noise": "1 psi",
            "closed_A": "50 %",
            "omega_per_volt": "26.7[rad/s/V]",
            "orifices": "present",
            "bits": "12",
            "counts": np.int64(4096),
            "L": np.float32(0.5),
        }
    )
    assert rig.motor.R_c == 0.8
    assert rig.line.V_1 == rig.line.V_2 == 5e-5
    assert rig.sensors.p_A.noise == pytest.approx(6894.757293168361)
    assert rig.sensors.p_B == RIG.sensors.p_B
    assert rig.line.closed_A == 0.5
    assert rig.motor.omega_per_volt == 26.7
    assert rig.line.orifices == "present"
    assert (rig.daq.bits, rig.sensors.theta.counts) == (12, 4096)
    assert isinstance(rig.daq.bits, int)
    assert rig.cylinder.L == 0.5


def test_source_tells_who_set_it_and_the_first_rig_is_untouched() -> None:
    rig = RIG.with_overrides({"V_1": 5e-5})
    assert rig.entry("V_1").source == "set by caller"
    assert RIG.line.V_1 == 44e-6
    assert RIG.with_overrides({"V_1": 5e-5}, source="rig survey of May").entry("line.V_1").source == "rig survey of May"
    assert rig.entry("V_2") == RIG.entry("V_2")
    assert message({"V_1": 5e-5}, source=" ") == "source must not be blank"


def test_equality_is_of_values() -> None:
    again = RIG.with_overrides({"L": "600 mm"})
    assert again == RIG
    assert hash(again) == hash(RIG)
    assert again.entry("L") != RIG.entry("L")
    assert RIG.with_overrides({"L": 0.61}) != RIG
    assert RIG != "thesis"
    assert RIG.with_overrides({}) == RIG


def test_immutable() -> None:
    with pytest.raises(Exception, match="frozen"):
        RIG.motor.R_c = 1.0  # type: ignore[misc]
    with pytest.raises(Exception, match="frozen"):
        RIG.motor = RIG.motor  # type: ignore[misc]
    with refusal("with_overrides"):
        RIG.motor.model_copy(update={"R_c": -1.0})
    assert RIG.motor.model_copy() == RIG.motor


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"V_1": -3.0}, "V_1, -3.0, caller"),
        ({"F_v": -1}, "F_v, -1.0, caller"),
        ({"d_line": "7 m"}, "d_line, 7.0, caller"),
        ({"closed_A": 1.0}, "closed_A, 1.0, caller"),
        ({"closed_B": "-1%"}, "closed_B, -0.01, caller"),
        ({"K_brk": 0.5}, "K_brk, 0.5, caller"),
        ({"p_A.noise": -1}, "sensors.p_A.noise, -1.0, caller"),
        ({"bits": 3.5}, "bits, 3.5, caller"),
        ({"bits": 40}, "bits, 40, caller"),
        ({"V_1": True}, "V_1, True, caller"),
        ({"V_1": None}, "V_1, None, caller"),
        ({"V_1": math.nan}, "V_1, nan, caller"),
        ({"F_l": math.inf}, "F_l, inf, caller"),
        ({"V_1": "5[Pa]"}, "V_1, Pa, caller"),
        ({"q_b": "4.9 cm^3"}, "q_b, cm^3, caller"),
        ({"V_1": "big"}, "V_1, 'big', caller"),
        ({"volumes": "fix"}, "volumes, 'fix', caller"),
        ({"volumes": ["fixed"]}, "volumes, ['fixed'], caller"),
        ({"V1": 1}, "'V1', V_1"),
        ({"beta": 1e9}, "'beta', fluid.K_oil"),
        ({"bulk_modulus": 1e9}, "'bulk_modulus', fluid.K_oil"),
        ({"moter.R_c": 1}, "'moter.R_c', motor.R_c"),
        ({"": 1}, "''"),
        ({"xyzzy_unknown": 1}, "'xyzzy_unknown'"),
        ({"V_1": 1e-5, "line.V_1": 2e-5}, "line.V_1, V_1"),
        ({"range_hi": 1}, "range_hi, sensors.p_1.range_hi, sensors.q_leak.range_hi"),
        ({"p_A.range_lo": "4000 psi"}, "sensors.p_A.range_lo, range_hi, 2.06843e+07 Pa"),
        ({"sensor_volts_hi": 20}, "sensor_volts_hi, 20.0, caller"),
        ({"sensor_volts_lo": -20}, "sensor_volts_lo, -20.0, caller"),
        ({"sensor_volts_lo": 10}, "sensor_volts_lo, 10.0, caller"),
    ],
)  # fmt: skip
def test_each_rule_is_told_in_one_line(settings: dict[str, Any], names: str) -> None:
    assert mentions(message(settings), *names.split(", "))


def test_dead_volume_must_be_positive_when_volumes_move() -> None:
    assert RIG.with_overrides({"V": 1.5e-4}).cylinder.V == 1.5e-4
    assert message({"V": 1.5e-4, "volumes": "position"}, source="--set") == (
        'cylinder.V must be > A_A L/2 = 0.0001899 m^3 when volumes = "position", got 0.00015 (--set)'
    )
    assert "A_B L/2 = 0.0003 m^3" in message({"A_B": 1e-3, "volumes": "position"})
    assert RIG.with_overrides({"volumes": "position"}).cylinder.volumes == "position"


def test_parts_made_by_hand_obey_the_same_rules() -> None:
    values = RIG.motor.model_dump()
    assert Motor(**values) == RIG.motor
    with refusal("R_c", "0 ohm", "-1.0"):
        Motor(**{**values, "R_c": -1.0})
    with refusal("R_d"):
        Motor(**values, R_d=1.0)
    with refusal("R_c"):
        Motor(**{name: value for name, value in values.items() if name != "R_c"})
    bare = Rig(**{part: getattr(RIG, part) for part in Rig.model_fields})
    assert bare == RIG
    with refusal("sources"):
        bare.table()


def _range(name: str) -> tuple[float, float]:
    low, high = -math.inf, math.inf
    for rule in declared_fields()[name].metadata:
        low = max(low, getattr(rule, "gt", low), getattr(rule, "ge", low))
        high = min(high, getattr(rule, "lt", high), getattr(rule, "le", high))
    return low, high


#: What the messages of rules across values say, as far as a single number of this rig can break one.
ACROSS = (
    "range",
    "sensor_volts",
    "must be < V",
    "relief valves must have an accumulator",
    'when volumes = "position"',
    "must be in a line",
    "must belong to a filter",
    "must be within the spool's stroke",
    "must be < nu_40",
)


def test_every_number_has_a_range() -> None:
    for name in NUMBERS:
        low, high = _range(name)
        assert math.isfinite(low), name
        assert math.isfinite(high), name
        assert low < high, name


@settings(deadline=None, max_examples=60)
@given(name=st.sampled_from(NUMBERS), value=st.floats(width=64))
def test_a_number_is_taken_exactly_or_refused_by_name(name: str, value: float) -> None:
    low, high = _range(name)
    try:
        rig = RIG.with_overrides({name: value})
    except InputError as error:
        assert name.rpartition(".")[2] in str(error)
        assert "\n" not in str(error)
        if low < value < high:  # only a rule across values is left
            assert any(rule in str(error) for rule in ACROSS)
    else:
        assert rig[name] == value
        assert low <= value <= high


@settings(deadline=None, max_examples=40)
@given(name=st.sampled_from(NUMBERS), fraction=st.floats(0.5, 2.0))
def test_text_and_number_agree(name: str, fraction: float) -> None:
    current = RIG[name]
    assert isinstance(current, float)
    value = current * fraction
    try:
        rig = RIG.with_overrides({name: value})
    except InputError:
        return
    assert RIG.with_overrides({name: repr(value)}) == rig
    assert RIG.with_overrides({name: f"{value!r}[{unit_of(declared_fields()[name])}]"}) == rig


#: Choices that go together only.
VALVE = {"valve.spool": "present", "supply.drive": "constant-speed"}


@pytest.mark.parametrize("name", CHOICES)
def test_every_word_of_a_choice_is_accepted(name: str) -> None:
    words = choices_of(declared_fields()[name])
    assert len(words) > 1
    for word in words:
        others = VALVE if name in VALVE and word in VALVE.values() else {}
        assert RIG.with_overrides({**others, name: f" {word} "})[name] == word


@example("", "0:\n0")
@settings(deadline=None, max_examples=60)
@given(st.text(max_size=20), st.one_of(st.text(max_size=20), st.integers(), st.none(), st.lists(st.floats())))
def test_anything_else_is_an_input_error(name: str, value: Any) -> None:
    for key in (name, "V_1"):
        try:
            RIG.with_overrides({key: value})
        except InputError as error:
            assert "\n" not in str(error)


def test_parse_overrides() -> None:
    assert parse_overrides(["V_1=1", " motor.R_c = 0.8 ", "V_1=1"]) == {"V_1": "1", "motor.R_c": "0.8"}
    for bad in ("V_1", "=3", "V_1=", "", " = "):
        with refusal("NAME=VALUE[unit]"):
            parse_overrides([bad])
    with refusal("V_1", "1", "2"):
        parse_overrides(["V_1=1", "V_1=2"])
    assert RIG.with_overrides(parse_overrides(["V_1=50[cm^3]"])).line.V_1 == 5e-5


def test_a_rig_shows_itself_in_one_line() -> None:
    assert repr(RIG).startswith("<Rig thesis: ")
    changed = RIG.with_overrides({"V_1": 5e-5, "R_c": 0.7})
    assert repr(changed).endswith(f"{len(RIG.table())} parameters, 2 overridden>")
    assert str(changed) == repr(changed)
