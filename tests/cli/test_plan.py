"""`sealscope plan` as a user calls it."""

from __future__ import annotations

import json

import pytest


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--find", "5 bar"), "--find"),
        (("--find", "-1 L/min"), "--find must be a flow > 0"),
        (("--detection", "1"), "--detection must be 0.5 to below 1"),
        (("--false-alarm", "0.7"), "false-alarm probability must be"),
        (("--command", "11 sin(4t)"), "the usual duty must give a volume balance"),
        (("--rig", "nowhere"), "nowhere"),
        (("--hold", "20 kN", "--area", "3117 m^2"), "area must be 1e-05 to 1 m^2, got 3117 m^2"),
        (("--hold", "20 kN", "--area", "3117 mm^2", "--drift", "3 degC"), "--drift must be 0 to 100 K, got 276.15 K"),
        (
            ("--hold", "20 kN", "--area", "3117 mm^2", "--resolution", "0.1"),
            "--resolution must be 0 to 10 mm, got 100 mm",
        ),
    ],
)
def test_wrong_options_are_refused_in_a_line(call, words: tuple[str, ...], complaint: str) -> None:
    assert complaint in call("plan", *words).refused()


def test_the_answer_comes_first(call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sealscope.campaigns.smallest.COMMANDS", ("3 sin(4t)",))
    monkeypatch.setattr("sealscope.campaigns.smallest.LOADS", ("",))
    lines = call("plan", "--command", "5 sin(2t)").out.splitlines()
    assert " for 60 s finds " in lines[0] and "L/min" in lines[0] and len(lines) == 6
    assert json.loads(call("plan", "--format", "json").out)["compared"][0]["command"] == "3 sin(4t)"
