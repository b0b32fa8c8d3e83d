"""Expect a refusal by what it names, not by its sentence: the rule's subject, the value and the place."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sealscope.errors import InputError


def mentions(text: str, *words: object) -> bool:
    """Test whether a text holds each word, value or path as a whole: `1` is not in `1.5`, `p_A` not in `p_AB`."""
    return all(_holds(text, str(word)) for word in words)


def _holds(text: str, wanted: str) -> bool:
    begin = r"(?<!\w)(?<!\d\.)" if re.match(r"\w", wanted) else ""
    end = r"(?!\w|\.\d)" if re.search(r"\w$", wanted) else ""
    return re.search(begin + re.escape(wanted) + end, text) is not None


@contextmanager
def refusal(*words: object, error: type[Exception] = InputError) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """Expect an error of one line that names each of `words`."""
    with pytest.raises(error) as caught:
        yield caught
    text = str(caught.value)
    assert "\n" not in text
    assert [word for word in words if not mentions(text, word)] == [], text
