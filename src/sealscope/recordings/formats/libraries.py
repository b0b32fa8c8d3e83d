"""Import libraries that read a format when they are needed."""

from __future__ import annotations

import warnings
from importlib import import_module
from types import ModuleType

from sealscope.errors import MissingExtra


def import_library(module: str, purpose: str, package: str) -> ModuleType:
    """Import an optional library of the extra `io`; raise MissingExtra if it is not installed.

    `purpose` ("a data frame") and `package`, its name for pip, appear in the error message.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecations in its own libraries
            return import_module(module)
    except ImportError as error:
        raise MissingExtra(f"{purpose} needs {package}: pip install 'sealscope[io]'") from error
