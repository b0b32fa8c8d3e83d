"""A call with wrong arguments is refused by one line that names the right one."""

from __future__ import annotations

import inspect

import pytest

from sealscope.calls import checked_call

from .refusals import refusal


@checked_call
def simulated(command: str, *, duration: float = 1.0) -> str:
    """Say what was called."""
    if duration < 0:
        raise TypeError("from inside")
    return f"{command} {duration}"


def test_a_right_call_is_the_call_itself():
    assert simulated("sine", duration=2.0) == "sine 2.0"
    assert list(inspect.signature(simulated).parameters) == ["command", "duration"]
    assert simulated.__doc__ == "Say what was called."


@pytest.mark.parametrize(
    ("args", "kwargs", "names"),
    [
        ((), {"comand": "sine"}, "simulated, 'comand', 'command'"),
        (("sine",), {"zzz": 1}, "simulated, 'zzz'"),
        ((), {}, "simulated, 'command'"),
        (("sine", 2.0), {}, "simulated, positional"),
    ],
)
def test_a_wrong_call_names_the_right_argument(args, kwargs, names):
    with refusal(*names.split(", ")):
        simulated(*args, **kwargs)


def test_an_error_from_inside_is_left_alone():
    with pytest.raises(TypeError, match="from inside"):
        simulated("sine", duration=-1.0)
