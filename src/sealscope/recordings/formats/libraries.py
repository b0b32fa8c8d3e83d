"""Libraries that read a format: loaded when they are needed, and silent, as messages are the caller's."""

from __future__ import annotations

import logging
import sys
import warnings
from importlib import import_module
from types import ModuleType

from sealscope.errors import MissingExtra


def library(module: str, reads: str, package: str) -> ModuleType:
    """Import a library of the extra `io`, silent but for handlers that a program has set up, or raise MissingExtra."""
    fresh = module not in sys.modules
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what its own libraries will change one day
            loaded = import_module(module)
    except ImportError as error:
        raise MissingExtra(f"{reads} needs {package}: pip install 'sealscope[io]'") from error
    for name in list(logging.root.manager.loggerDict) if fresh else ():
        if name.partition(".")[0] == module:
            logging.getLogger(name).handlers[:] = [logging.NullHandler()]
    return loaded
