"""`--help` of every command says what the sources say: units in brackets are text, not markup."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import pytest
import typer

import sealscope as ss
from sealscope.cli.app import app
from sealscope.cli.options import FALSE_ALARM_PROBABILITY
from sealscope.diagnosis import diagnose


def commands(command: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    command = typer.main.get_command(app) if command is None else command
    if hasattr(command, "commands"):
        for name, inner in command.commands.items():
            yield from commands(inner, (*path, name))
    else:
        yield path, command


COMMANDS = list(commands())


def plain(text: str) -> str:
    """A text without what a table draws around it, or how it breaks lines."""
    return re.sub(r"[\s`│╭╮╰╯─]+", "", text)


@pytest.mark.parametrize(("path", "command"), COMMANDS, ids=[" ".join(path) for path, _ in COMMANDS])
def test_every_option_s_text_is_shown_whole_in_80_columns(path, command, call, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERMINAL_WIDTH", "80")
    done = call(*path, "--help")
    assert done.status == 0
    assert max(map(len, done.out.splitlines())) <= 80
    shown = plain(done.out)
    for parameter in command.params:
        if text := getattr(parameter, "help", None):
            assert plain(text) in shown, (parameter.name, text)


def test_units_are_among_what_is_shown(call):
    out = call("simulate", "--help").out
    assert all(unit in out for unit in ("[s]", "[Hz]", "[m]", "'20[Pa]'"))


def test_each_argument_of_an_experiment_is_an_option_with_the_same_text_and_default():
    options = {option.name: option for option in dict(COMMANDS)["simulate",].params}
    for name, argument in inspect.signature(ss.simulate).parameters.items():
        if name == "drifts":
            continue
        assert plain(options[name].help).removesuffix(plain("Repeat for several.")) in plain(ss.simulate.__doc__)
        assert str(argument.default).removesuffix(".0") == str(options[name].default)


def test_the_default_false_alarm_probability_is_that_of_the_library() -> None:
    assert FALSE_ALARM_PROBABILITY == diagnose.FALSE_ALARM_PROBABILITY
