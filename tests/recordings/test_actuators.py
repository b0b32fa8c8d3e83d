"""Columns of several actuators in one table are never read as one, and those of one actuator are never refused."""

from __future__ import annotations

from pathlib import Path
from time import process_time

import numpy as np
import pytest

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings import read
from sealscope.recordings.formats.columns import Request, choose_columns
from sealscope.recordings.formats.headings.actuators import find_actuators
from sealscope.recordings.formats.headings.labels import Label

from ..refusals import refusal

#: Pairs of words for two machines, and how a heading joins them to the rest.
PAIRS = [
    *[("Boom", "Stick"), ("bucket", "arm"), ("main boom", "jib boom"), ("Ausleger", "Stiel"), ("Löffel", "Ausleger")],
    *[("cylinder 1", "cylinder 2"), ("cyl1", "cyl2"), ("Zylinder 3", "Zylinder 1"), ("Presse 1", "Presse 2")],
    *[("left cylinder", "right cylinder"), ("links", "rechts"), ("Achse A", "Achse B"), ("axis 1", "axis 2")],
    *[("Hubzylinder", "Kippzylinder"), ("front axle cylinder", "rear axle cylinder"), ("1", "2"), ("fleche", "godet")],
]
SIDES = [("head", "rod"), ("Kolbenseite", "Stangenseite"), ("cap", "rod"), ("bottom", "annulus")]
SHARED = ["Drehzahl [1/min]", "oil temp [°C]"]


def draw_headings(generator: np.random.Generator) -> tuple[dict[str, tuple[str, ...]], tuple[str, str]]:
    """Draw headings of two machines: by machine those of p_A, p_B and x; and the two words."""
    words = PAIRS[generator.integers(len(PAIRS))]
    sides = SIDES[generator.integers(len(SIDES))]
    joint, order = str(generator.choice([" ", "_", "."])), int(generator.choice([1, -1]))
    quantities = ((f"pressure {sides[0]}", "bar"), (f"pressure {sides[1]}", "bar"), ("stroke", "mm"))
    headings = {
        word: tuple(joint.join([word, name][::order]) + f" [{unit}]" for name, unit in quantities) for word in words
    }
    return headings, words


def choose(headings: list[str], **options: str) -> dict[str, str]:
    """Choose the columns by the map "auto", or by a `group`: channel -> heading."""
    labels = [Label.parse(heading) for heading in ["t [s]", *headings]]
    choice = choose_columns(labels, Request({"*": "auto", **options}))
    return {channel: labels[formula.columns[0]].whole for channel, formula in choice.channels.items()}


@pytest.mark.parametrize("seed", range(60))
def test_columns_of_two_machines_are_a_question_and_a_group_answers_it(seed: int) -> None:
    """Pressures of different machines, with or without all the others of both: the question names both groups."""
    generator = np.random.default_rng(seed)
    headings, (first, second) = draw_headings(generator)
    of_first, of_second = headings[first], headings[second]
    if generator.random() < 0.5:  # the head's pressure and the stroke of one machine, the rod's pressure of the other
        columns = {first: [of_first[0], of_first[2]], second: [of_second[1]]}
    else:
        columns = {first: list(of_first), second: list(of_second)}
    all_columns = [*columns[first], *columns[second], *SHARED]
    all_columns = [all_columns[k] for k in generator.permutation(len(all_columns))]
    with pytest.raises(InputError) as error:
        choose(all_columns)
    assert str(error.value).startswith("columns must be those of one actuator")
    assert all(heading in str(error.value) for heading in (*columns[first], *columns[second]))
    for word, expected in columns.items():
        channels = choose(all_columns, group=word.upper() if generator.random() < 0.5 else word)
        assert {*channels.values()} == {*expected, *SHARED}
    # a column named by the user tells the machine
    assert {*choose(all_columns, x=of_first[2]).values()} == {*columns[first], *SHARED}
    # both pressures named by the user, of whatever machines, are read
    chosen = choose(all_columns, p_A=of_first[0], p_B=of_second[1])
    assert (chosen["p_A"], chosen["p_B"]) == (of_first[0], of_second[1])


@pytest.mark.parametrize(
    "headings",
    [
        "Boom head pressure [bar], Boom rod pressure [bar], Boom stroke [mm]",
        "Pressure A left chamber [bar], Pressure B right chamber [bar], x [mm]",
        "Upper chamber pressure A [bar], Lower chamber pressure B [bar], stroke [mm]",
        "Druck Kolbenkammer oben [bar], Druck Stangenkammer unten [bar], Weg [mm]",
        "PT101A [bar], PT101B [bar], stroke LT102 [mm]",
        "Pressure A (ch1) [bar], Pressure B (ch2) [bar], x (ch3) [mm]",
        "P_cyl1 [bar], P_cyl2 [bar], x [mm]",
        "Cylinder A [bar], Cylinder B [bar], Cylinder position [mm]",
        "Head pressure sensor blue [bar], Rod pressure sensor red [bar], Position laser [mm]",
        "HBM Kolbendruck [bar], Keller Stangendruck [bar], HBM Weg [mm]",
        "ADC1_pA [bar], ADC2_pB [bar], ADC1_x [mm]",
        "Dev1/ai0 pA [bar], Dev1/ai1 pB [bar], Dev2/ai0 x [mm]",
        "Press 1 [bar], Press 2 [bar], Pos [mm]",
        "Cap pressure 1 [bar], Rod pressure 2 [bar], Position 3 [mm]",
        "Pressure extend side [bar], Pressure retract side [bar], Stroke [mm]",
        "Rig.Cyl.p_A [bar], Rig.Cyl.p_B [bar], Rig.Cyl.x [mm]",
        "pBore_bar, pRod_bar, stroke_mm",
    ],
)
def test_a_log_of_one_machine_with_odd_words_is_read(headings: str) -> None:
    """Words for chambers, sensors, loggers and tags are no words for machines."""
    assert {"p_A", "p_B", "x"} <= choose(headings.split(", ")).keys()


@pytest.mark.parametrize(
    ("headings", "expected"),
    [
        # another machine without pressures is not read, and not asked about
        ("Boom pA [bar], Boom pB [bar], Boom x [mm], Stick x [mm], Slew motor speed [rpm]", {"p_A", "p_B", "x"}),
        # the channels' own names go before
        ("p_A [bar], p_B [bar], x [mm], p_A_2 [bar], p_B_2 [bar], x_2 [mm]", {"p_A", "p_B", "x"}),
    ],
)
def test_columns_of_a_machine_that_cannot_be_meant_are_left_out(headings: str, expected: set[str]) -> None:
    assert choose(headings.split(", ")).keys() == expected


def test_a_group_that_the_columns_do_not_have_is_named() -> None:
    headings = ["Boom head [bar]", "Stick rod [bar]", "Boom stroke [mm]"]
    with refusal("group", "'arm'", "boom, stick"):
        choose(headings, group="arm")
    with refusal("group", "'arm'", "none"):
        choose(["Druck A [bar]", "Druck B [bar]"], group="arm")
    assert find_actuators([Label.parse("p_A [bar]")]).names == ()


def test_names_within_paths_are_of_one_machine_without_a_map_too(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("t [s],cyl1.p_A [bar],cyl2.p_B [bar],cyl1.x [mm]\n0,1,2,3\n1,1,2,3\n")
    with pytest.raises(UnreadableFile, match="columns must be those of one actuator"):
        read(file)
    recording = read(file, group="cyl 1")
    assert recording.channels.keys() == {"p_A", "x"}
    assert recording.unused == ()


@pytest.mark.parametrize(
    "heading", ["w{k}x pressure A [bar]", "cyl {k} p_A [bar]", "p_A_{k} [bar]", "boom {k} head [bar]"]
)
def test_many_columns_take_no_quadratic_time(heading: str) -> None:
    """The time of four times as many columns is far from sixteen times as long; number 0 is one, too."""
    seconds = []
    for count in (150, 600):
        labels = [Label.parse(heading.format(k=k)) for k in range(count)]
        begin = process_time()
        find_actuators(labels)
        seconds.append(process_time() - begin)
    assert seconds[1] < 12.0 * seconds[0] + 0.2
