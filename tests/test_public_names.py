"""The public names: each is there and documents every parameter, and its examples are true."""

from __future__ import annotations

import doctest
import inspect
import re

import pytest

import sealscope as ss

PUBLIC = sorted(set(ss.__all__) - {"__version__"})


def section(docstring: str, title: str) -> str:
    """The body of a numpydoc section, empty where there is none."""
    match = re.search(rf"^{title}\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)", docstring, re.MULTILINE | re.DOTALL)
    return match.group(1) if match else ""


def documented(docstring: str) -> list[str]:
    """Names of the parameters in the section of that name, in their order; `a, b : float` documents two."""
    lines = re.findall(r"^(\*{0,2}\w[\w*, ]*?) ?:", section(docstring, "Parameters"), re.MULTILINE)
    return [name.strip().lstrip("*") for line in lines for name in line.split(",")]


@pytest.mark.parametrize("name", PUBLIC)
def test_every_parameter_and_result_is_documented(name):
    value = getattr(ss, name)
    docstring = inspect.getdoc(value) or ""
    assert docstring.splitlines()[0].endswith(".")
    if inspect.isclass(value) or not callable(value):
        return
    assert documented(docstring) == list(inspect.signature(value).parameters)
    returns = inspect.signature(value).return_annotation
    assert bool(section(docstring, "Returns")) == (returns not in (None, "None"))


@pytest.mark.parametrize("name", PUBLIC)
def test_the_examples_are_true(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    value = getattr(ss, name)
    examples = doctest.DocTestFinder(recurse=False).find(value, name, globs={})
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for example in examples:
        runner.run(example)
    assert runner.summarize(verbose=False).failed == 0
    if inspect.isfunction(value):
        assert sum(len(example.examples) for example in examples) > 0
