"""Calls of public functions: a wrong argument is refused by a message that names the nearest right one."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable
from dataclasses import field, fields
from textwrap import fill, indent
from typing import Any, ParamSpec, TypeVar

from sealscope.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
V = TypeVar("V")


#: Longest word that near ones are looked for: the search takes longer than in proportion to the length.
_LONGEST_WORD = 200


def nearest(word: str, known: Iterable[str], count: int = 1, share: float = 0.5) -> list[str]:
    """Find up to `count` of the known words that share at least `share` of their letters with `word`."""
    return difflib.get_close_matches(word, known, n=count, cutoff=share) if len(word) <= _LONGEST_WORD else []


def closest(word: str, known: Iterable[str]) -> str:
    """Format ``; did you mean NAME?`` with the known name nearest to `word`, or an empty text."""
    folded = {name.casefold(): name for name in known}
    near = nearest(word.casefold(), folded)
    return f"; did you mean {folded[near[0]]}?" if near else ""


def checked_call(function: Callable[P, R]) -> Callable[P, R]:
    """Make a call with wrong arguments raise InputError; signature and docstring stay those of `function`.

    An unknown keyword is answered with the nearest known one: ``simulate has no argument 'comand'; did you mean
    'command'?``. Missing and surplus arguments raise InputError too. What the function itself raises is not touched.
    """
    signature = inspect.signature(function)
    parameters = signature.parameters.values()
    names = [parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD]
    any_keyword = len(names) < len(parameters)
    if names[:1] in (["self"], ["cls"]):
        del names[0]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not any_keyword:
            for name in kwargs:
                if name not in names:
                    raise InputError(
                        f"{function.__qualname__} has no argument {name!r}{closest(repr(name), map(repr, names))}"
                    )
        try:
            signature.bind(*args, **kwargs)
        except TypeError as error:
            raise InputError(f"{function.__qualname__}: {error}") from None
        return function(*args, **kwargs)

    return call


def argument(default: Any, kind: str, text: str, *, unit: str = "") -> Any:
    """Declare an argument as a field of a dataclass: its type in words, its meaning, and the SI unit of a number."""
    return field(
        default=default, metadata={"kind": kind, "text": f"{text} [{unit}]." if unit else f"{text}.", "unit": unit}
    )


def with_arguments_of(declared: Callable[P, V]) -> Callable[[Callable[[V], R]], Callable[P, R]]:
    """Give a function of a dataclass the `argument` fields of that class as arguments, in signature and docstring."""
    rows: list[str] = []
    for declared_field in fields(declared):  # type: ignore[arg-type]
        wrapped = fill(declared_field.metadata["text"], 110, break_long_words=False, break_on_hyphens=False)
        rows += [f"{declared_field.name} : {declared_field.metadata['kind']}, optional", indent(wrapped, "    ")]
    section = "\n".join(["Parameters", "----------", *rows, "", ""])

    def decorated(function: Callable[[V], R]) -> Callable[P, R]:
        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            return function(declared(*args, **kwargs))

        returns = inspect.signature(function).return_annotation
        call.__signature__ = inspect.signature(declared).replace(return_annotation=returns)  # type: ignore[attr-defined]
        call.__doc__ = (inspect.getdoc(function) or "").replace("Returns\n---", f"{section}Returns\n---", 1)
        return checked_call(call)

    return decorated
