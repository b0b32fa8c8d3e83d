"""A C compiler of this machine."""

from __future__ import annotations

import shutil
import sys
from typing import NamedTuple

from sealscope.errors import InputError


class Compiler(NamedTuple):
    """A C compiler; `command` has the first arguments; `cross_compiles`: True if it compiles for other systems, too."""

    command: list[str]
    cross_compiles: bool


def find_compiler() -> Compiler:
    """Find a C compiler, in the package ziglang or else in the system; raise InputError if there is none."""
    from importlib.util import find_spec

    if find_spec("ziglang") is not None:
        # -P: a package ziglang in the working folder must not run
        return Compiler([sys.executable, "-P", "-m", "ziglang", "cc"], cross_compiles=True)
    for name in ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            return Compiler([path], cross_compiles=False)
    raise InputError("C code needs a C compiler, and none was found; pip install 'sealscope[fmu]' installs one")
