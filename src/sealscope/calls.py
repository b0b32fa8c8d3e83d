"""Check the arguments of public functions; the error for a wrong keyword suggests the nearest right one."""

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


#: Longest word for which suggestions are searched: the time of the search grows faster than the word's length.
_MAX_WORD = 200


def nearest(word: str, known: Iterable[str], count: int = 1, share: float = 0.5) -> list[str]:
    """Find up to `count` words of `known` that resemble `word`; `share` (0 to 1): lowest similarity (`difflib`)."""
    return difflib.get_close_matches(word, known, n=count, cutoff=share) if len(word) <= _MAX_WORD else []


def suggestion(word: str, known: Iterable[str]) -> str:
    """Format the end of an error message that suggests the name in `known` most similar to `word`, ignoring case.

    It is ``; did you mean NAME?``, or empty if no known name is similar.
    """
    name_by_folded = {name.casefold(): name for name in known}
    similar = nearest(word.casefold(), name_by_folded)
    return f"; did you mean {name_by_folded[similar[0]]}?" if similar else ""


def checked_call(function: Callable[P, R]) -> Callable[P, R]:
    """Wrap `function` to raise InputError for unknown, missing or superfluous arguments; their types are not checked.

    The wrapper keeps signature and docstring. The error for an unknown keyword suggests the nearest known one:
    ``simulate has no argument 'comand'; did you mean 'command'?``.
    """
    signature = inspect.signature(function)
    parameters = signature.parameters.values()
    names = [parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD]
    takes_any_keyword = len(names) < len(parameters)  # `function` has `**kwargs`, which is not in `names`
    if names[:1] in (["self"], ["cls"]):  # no keyword for callers
        del names[0]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Check the arguments, then call `function`."""
        if not takes_any_keyword:
            for name in kwargs:
                if name not in names:
                    raise InputError(
                        f"{function.__qualname__} has no argument {name!r}{suggestion(repr(name), map(repr, names))}"
                    )
        try:
            signature.bind(*args, **kwargs)
        except TypeError as error:
            raise InputError(f"{function.__qualname__}: {error}") from None
        return function(*args, **kwargs)

    return call


def argument(default: Any, kind: str, text: str, *, unit: str = "") -> Any:
    """Declare an argument of a function as a dataclass field with a default value and documentation.

    `kind`: type of the argument in words, such as "float"; `text`: its meaning; `unit`: SI unit of a number.
    """
    full_text = f"{text} [{unit}]." if unit else f"{text}."
    return field(default=default, metadata={"kind": kind, "text": full_text, "unit": unit})


def take_fields_of(arguments_class: Callable[P, V]) -> Callable[[Callable[[V], R]], Callable[P, R]]:
    """Build a decorator that makes the fields of a dataclass the parameters of a function.

    `arguments_class`: the dataclass, whose fields are declared by `argument`. The function is written with one
    parameter, an instance of it; its callers pass the fields. The decorator describes these in a section "Parameters"
    before the section "Returns" of the docstring, which must exist. Wrong arguments raise InputError (`checked_call`).
    """
    lines: list[str] = []
    for declared_field in fields(arguments_class):  # type: ignore[arg-type]
        wrapped = fill(declared_field.metadata["text"], width=110, break_long_words=False, break_on_hyphens=False)
        lines += [f"{declared_field.name} : {declared_field.metadata['kind']}, optional", indent(wrapped, "    ")]
    section = "\n".join(["Parameters", "----------", *lines, "", ""])

    def decorate(function: Callable[[V], R]) -> Callable[P, R]:
        """Wrap `function` in a function that takes the fields and passes it an instance of the dataclass."""

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            """Call `function` with an instance of the dataclass made from the arguments."""
            return function(arguments_class(*args, **kwargs))

        returns = inspect.signature(function).return_annotation
        signature = inspect.signature(arguments_class).replace(return_annotation=returns)
        call.__signature__ = signature  # type: ignore[attr-defined]
        call.__doc__ = (inspect.getdoc(function) or "").replace("Returns\n---", f"{section}Returns\n---", 1)
        return checked_call(call)

    return decorate
