"""The public names: each documents every parameter and shows an example, and all examples are true."""

from __future__ import annotations

import ast
import doctest
import inspect
import re
from importlib import import_module
from pathlib import Path

import pytest

import sealscope as ss

from .representatives import SLOW, other


def public() -> dict[str, object]:
    """Public names and their values."""
    return {name: getattr(ss, name) for name in ss.__all__ if name != "__version__"}


VALUES = public()
PUBLIC = sorted(VALUES)


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
    value = VALUES[name]
    docstring = inspect.getdoc(value) or ""
    assert docstring.splitlines()[0].endswith(".")
    if inspect.isclass(value):
        lineage = [inspect.cleandoc(ancestor.__doc__ or "") for ancestor in value.__mro__[:-1]]
        described = {parameter for text in lineage for parameter in documented(text)}
        assert set(inspect.signature(value).parameters) - described == set()
    elif callable(value):
        assert documented(docstring) == list(inspect.signature(value).parameters)
        returns = inspect.signature(value).return_annotation
        assert bool(section(docstring, "Returns") or section(docstring, "Yields")) == (returns not in (None, "None"))


@pytest.mark.parametrize("name", [name for name in PUBLIC if inspect.isclass(VALUES[name])])
def test_every_public_member_of_a_class_is_documented(name):
    value = VALUES[name]
    members = {
        member: inspect.getdoc(getattr(value, member))
        for member, own in vars(value).items()
        if not member.startswith("_") and (callable(own) or isinstance(own, property | classmethod | staticmethod))
    }
    assert [member for member, text in members.items() if not text] == []


#: Names whose examples simulate or commission for seconds.
LONG = ("Trend", "Watch", "commission", "trend", "write_machine", "Diagnosis")


@pytest.mark.parametrize("name", [other(name, SLOW) if name in LONG else name for name in PUBLIC])
def test_the_examples_are_true(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    value = VALUES[name]
    examples = doctest.DocTestFinder(recurse=inspect.isclass(value)).find(value, name, globs={})
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for example in examples:
        runner.run(example)
    assert runner.summarize(verbose=False).failed == 0
    # a class shows in its own docstring how it is used, whatever its methods show
    assert sum(len(example.examples) for example in examples if example.name == name) > 0


def test_the_stub_names_each_export_once_and_is_what_python_loads():
    tree = ast.parse(Path(ss.__file__).with_suffix(".pyi").read_text("utf-8"))
    imports = [(node.module, alias) for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    lines = [(module, alias) for module, alias in imports if alias.asname is not None]  # others serve the stub itself
    names = [alias.asname for _, alias in lines]
    assert len(set(names)) == len(names)
    assert {*names, "__version__"} == {*ss.__all__, "LeakDetector"}
    for module, alias in lines:
        assert getattr(ss, alias.name) is getattr(import_module(str(module)), str(alias.asname))
