"""Controllers by name: built-in ones, installed ones, and a user's as `MODULE:NAME` or `FILE.py:NAME`.

A distribution installs a controller by an entry point of the group `sealscope.controllers`. It names a class or
function that `controller_named` can call.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from functools import cache
from hashlib import sha256
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sealscope.calls import suggestion
from sealscope.control.controller import Controller
from sealscope.control.fault_tolerant import FaultTolerant
from sealscope.control.flatness import Flatness
from sealscope.control.position import PositionPI
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: The functions that build the built-in controllers from a rig, by name.
CONTROLLERS: Mapping[str, Callable[[Rig], Controller]] = {
    "pi": PositionPI.from_rig,
    "flatness": Flatness.from_rig,
    "fault-tolerant": FaultTolerant.from_rig,
    "fault-tolerant-flatness": lambda rig: FaultTolerant.from_rig(rig, Flatness.from_rig(rig)),
}
#: Group of the entry points by which distributions install controllers.
GROUP = "sealscope.controllers"


@cache
def _installed() -> Mapping[str, EntryPoint]:
    """Find the entry points of the controllers that installed distributions provide, by name."""
    return {point.name: point for point in entry_points(group=GROUP)}


def is_installed(name: str) -> bool:
    """Return True if `name` is a built-in controller or one that an installed distribution provides."""
    return name in CONTROLLERS or name in _installed()


def check_controller_name(name: str) -> None:
    """Raise InputError unless `name` is a known controller, or has the form ``MODULE:NAME`` or ``FILE.py:NAME``."""
    module_or_file, _, attribute = name.rpartition(":")
    if not is_installed(name) and not (module_or_file and attribute):
        names = (*CONTROLLERS, *_installed())
        raise InputError(
            f"controller must be one of {', '.join(names)}, or MODULE:NAME or FILE.py:NAME of your own, got {name!r}"
            f"{suggestion(name, names)}"
        )


def controller_named(name: str, rig: Rig) -> Controller:
    """Make the controller called `name` for a rig.

    `name`: a built-in or installed controller, or ``MODULE:NAME`` or ``FILE.py:NAME`` of a class or function. A class
    with a method `from_rig` makes the controller by this method; any other class or function is called with the rig.
    Raises InputError for an unknown name, for code that fails, and for a controller without `rate`, `delay` or `start`.
    """
    if name in CONTROLLERS:
        return CONTROLLERS[name](rig)
    check_controller_name(name)
    module_or_file, _, attribute = name.rpartition(":")
    try:
        if name in _installed():
            factory: Any = _installed()[name].load()
        else:
            factory = getattr(_load_module(module_or_file), attribute)
        controller = getattr(factory, "from_rig", factory)(rig)
    except InputError:
        raise
    except Exception as error:  # a user's code may raise anything
        raise InputError(f"controller {name} could not be made: {type(error).__name__}: {error}") from error
    missing_parts = [part for part in ("rate", "delay", "start") if not hasattr(controller, part)]
    if missing_parts:
        raise InputError(f"a controller must have rate, delay and start; {name} lacks {', '.join(missing_parts)}")
    return controller  # type: ignore[no-any-return]


def find_controller_source(name: str) -> Path | None:
    """Find a controller's source file without importing it; None for a built-in one, InputError if there is none."""
    if name in CONTROLLERS:
        return None
    check_controller_name(name)
    stated_module_or_file, _, _ = name.rpartition(":")
    module_or_file = _installed()[name].module if name in _installed() else stated_module_or_file
    path = Path(module_or_file) if module_or_file.endswith(".py") else _find_module_file(module_or_file)
    if path is None or not path.is_file():
        raise InputError(f"a controller's file must exist, got {module_or_file}")
    return path


def _find_module_file(module: str) -> Path | None:
    """Find the file of a module, such as "my_package.control", without importing its packages; None if not found."""
    parts = module.split(".")
    folders = None  # folders of the package that contains the module, None for a top-level module
    for depth in range(1, len(parts) + 1):
        name = ".".join(parts[:depth])
        specs = (finder.find_spec(name, folders) for finder in sys.meta_path)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None or (depth < len(parts) and spec.submodule_search_locations is None):
            return None  # not found, or inside a module that is no package
        folders = spec.submodule_search_locations
    # the origin of a built-in module is a word, not a file: the caller refuses it
    return Path(spec.origin) if spec is not None and spec.origin else None


def _load_module(module_or_file: str) -> Any:
    """Import a module by name, or a Python file by path; raise InputError if there is no such file."""
    if not module_or_file.endswith(".py"):
        return importlib.import_module(module_or_file)
    path = Path(module_or_file)
    if not path.is_file():
        raise InputError(f"a controller's file must exist, got {module_or_file}")
    name = f"sealscope_controller_{sha256(path.read_bytes()).hexdigest()[:16]}"  # an edited file gets another name
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # before it is executed: `dataclass` looks up the module of its class
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
