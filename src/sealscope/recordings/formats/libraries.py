"""Import libraries that read a format when they are needed, and silence them: messages are the caller's task."""

from __future__ import annotations

import logging
import sys
import warnings
from importlib import import_module
from types import ModuleType

from sealscope.errors import MissingExtra


def import_library(module: str, purpose: str, package: str) -> ModuleType:
    """Import an optional library of the extra `io` for reading a format, and silence its warnings and log.

    `purpose` ("a data frame") and `package`, its name for pip, appear in the error message. A library that the program
    has already imported keeps its log handlers. Raises MissingExtra if the library is not installed.
    """
    is_first = module not in sys.modules
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecations in its own libraries
            library = import_module(module)
    except ImportError as error:
        raise MissingExtra(f"{purpose} needs {package}: pip install 'sealscope[io]'") from error
    for name in list(logging.root.manager.loggerDict) if is_first else ():
        if name.partition(".")[0] == module:
            logging.getLogger(name).handlers[:] = [logging.NullHandler()]
    return library
