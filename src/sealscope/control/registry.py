"""Controllers by name: those that are built in or installed, and a user's own as `MODULE:NAME` or `FILE.py:NAME`.

A distribution installs a controller by an entry point of the group `sealscope.controllers`, of a class or function as
`controller_named` calls it.
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

from sealscope.calls import closest
from sealscope.control.controller import Controller
from sealscope.control.fault_tolerant import FaultTolerant
from sealscope.control.flatness import Flatness
from sealscope.control.position import PositionPI
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What makes each built-in controller for what a rig is said to be.
CONTROLLERS: Mapping[str, Callable[[Rig], Controller]] = {
    "pi": PositionPI.from_rig,
    "flatness": Flatness.from_rig,
    "fault-tolerant": FaultTolerant.from_rig,
    "fault-tolerant-flatness": lambda rig: FaultTolerant.from_rig(rig, Flatness.from_rig(rig)),
}


GROUP = "sealscope.controllers"


@cache
def _installed() -> Mapping[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def is_installed(name: str) -> bool:
    """Return True for the name of a controller that is built in or installed, False for a user's own."""
    return name in CONTROLLERS or name in _installed()


def check_name(name: str) -> None:
    """Raise InputError where no controller can have this name; nothing is imported."""
    place, mark, attribute = name.rpartition(":")
    if not is_installed(name) and not (mark and place and attribute):
        names = (*CONTROLLERS, *_installed())
        raise InputError(
            f"controller must be one of {', '.join(names)}, or MODULE:NAME or FILE.py:NAME of your own, got {name!r}"
            f"{closest(name, names)}"
        )


def controller_named(name: str, rig: Rig) -> Controller:
    """Make the controller of a name from a rig's parameters.

    `name`: one of `CONTROLLERS` or of an installed one, or ``MODULE:NAME`` or ``FILE.py:NAME`` of a class or function:
    called with the rig; where it has a method `from_rig`, that is called instead. Raises InputError for an unknown
    name, and for a controller without `rate`, `delay` and `start`.

    Examples
    --------
    >>> import sealscope as ss
    >>> from sealscope.control import controller_named
    >>> controller_named("pi", ss.load_rig("thesis-closed-loop")).rate
    500.0
    """
    if name in CONTROLLERS:
        return CONTROLLERS[name](rig)
    check_name(name)
    place, _, attribute = name.rpartition(":")
    try:
        make: Any = _installed()[name].load() if name in _installed() else getattr(_module(place), attribute)
        build = getattr(make, "from_rig", None) or getattr(make, "of", make)  # `of`: the former name
        controller = build(rig)
    except InputError:
        raise
    except Exception as error:  # a user's code may raise anything
        raise InputError(f"controller {name} could not be made: {type(error).__name__}: {error}") from error
    missing = [part for part in ("rate", "delay", "start") if not hasattr(controller, part)]
    if missing:
        raise InputError(f"a controller must have rate, delay and start, got {name} without {', '.join(missing)}")
    return controller  # type: ignore[no-any-return]


def source_of(name: str) -> Path | None:
    """Find the source file of a user's own or an installed controller; None for a built-in one.

    Nothing is imported for that. Raises InputError where there is no such file.
    """
    if name in CONTROLLERS:
        return None
    place = _installed()[name].module if name in _installed() else name.rpartition(":")[0]
    path = Path(place) if place.endswith(".py") else _file_of(place)
    if path is None or not path.is_file():
        raise InputError(f"a controller's file must exist, got {place}")
    return path


def _file_of(module: str) -> Path | None:
    """Find the file of a module without importing its packages."""
    parts, folders = module.split("."), None
    for count in range(1, len(parts) + 1):
        name = ".".join(parts[:count])
        specs = (finder.find_spec(name, folders) for finder in sys.meta_path)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None:
            return None
        folders = spec.submodule_search_locations
    return Path(spec.origin) if spec is not None and spec.origin else None


def _module(place: str) -> Any:
    if not place.endswith(".py"):
        return importlib.import_module(place)
    path = Path(place)
    if not path.is_file():
        raise InputError(f"a controller's file must exist, got {place}")
    name = f"sealscope_controller_{sha256(path.read_bytes()).hexdigest()[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
