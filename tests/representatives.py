"""Representatives of a family of cases: the default suite takes the first ones, and all run with `-m slow`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pytest

#: Marks of a case that others of its family stand for in `.ci/proofs`, too.
OTHERS = (pytest.mark.slow, pytest.mark.long)
#: Marks of a case that differs from the others in kind, and runs in `.ci/proofs`.
SLOW = (pytest.mark.slow,)


def few(cases: Iterable[Any], count: int = 2, marks: Sequence[pytest.MarkDecorator] = OTHERS) -> list[Any]:
    """The cases of `pytest.mark.parametrize`, all but the first `count` of them slow and long, or with these marks."""
    return [case if k < count else other(case, marks) for k, case in enumerate(cases)]


def other(case: Any, marks: Sequence[pytest.MarkDecorator] = OTHERS) -> Any:
    """A case, marked as one that others stand for."""
    return pytest.param(*case, marks=marks) if isinstance(case, tuple) else pytest.param(case, marks=marks)
