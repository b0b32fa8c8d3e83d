"""The public names: each is there, is documented, and its examples are true."""

from __future__ import annotations

import doctest
import inspect

import pytest

import sealscope

NAMES = [name for name in sealscope.__all__ if name != "__version__"]


@pytest.mark.parametrize("name", NAMES)
def test_the_examples_of_a_public_name_are_true(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    value = getattr(sealscope, name)
    assert inspect.getdoc(value)
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for example in doctest.DocTestFinder(recurse=False).find(value, name, globs={}):
        runner.run(example)
    assert runner.summarize(verbose=False).failed == 0
