"""Representatives of a family of cases: the default suite takes the first ones, and all run with `-m slow`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

#: Marks of a case that others of its family stand for in `.ci/proofs`, too.
OTHERS = (pytest.mark.slow, pytest.mark.long)


def few(cases: Iterable[Any], count: int = 2) -> list[Any]:
    """The cases of `pytest.mark.parametrize`, all but the first `count` of them slow and long."""
    return [case if k < count else other(case) for k, case in enumerate(cases)]


def other(case: Any) -> Any:
    """A case, marked as one that others stand for."""
    return pytest.param(*case, marks=OTHERS) if isinstance(case, tuple) else pytest.param(case, marks=OTHERS)
