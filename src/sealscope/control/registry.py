"""Controllers by name: the ones that are built in, and a user's own as `MODULE:NAME` or `FILE.py:NAME`."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sealscope.calls import closest
from sealscope.control.controller import Controller
from sealscope.control.fault_tolerant import FaultTolerant
from sealscope.control.flatness import Flatness
from sealscope.control.position import position_controller
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What makes each built-in controller for what a rig is said to be.
CONTROLLERS: Mapping[str, Callable[[Rig], Controller]] = {
    "pi": position_controller,
    "flatness": Flatness.of,
    "fault-tolerant": FaultTolerant.of,
    "fault-tolerant-flatness": lambda rig: FaultTolerant.of(rig, Flatness.of(rig)),
}


def controller_named(name: str, rig: Rig) -> Controller:
    """Return the controller of a name for what a rig is said to be.

    `name`: one of `CONTROLLERS`, or ``MODULE:NAME`` or ``FILE.py:NAME`` of a class or function: called with the rig
    where it has a method `of`, that is called instead. Raises InputError for an unknown name, and for what is made
    without `rate`, `delay` and `start`.

    Examples
    --------
    >>> import sealscope as ss
    >>> from sealscope.control import controller_named
    >>> controller_named("pi", ss.load_rig("thesis-closed-loop")).rate
    500.0
    """
    if name in CONTROLLERS:
        return CONTROLLERS[name](rig)
    place, mark, attribute = name.rpartition(":")
    if not mark or not place or not attribute:
        known = ", ".join(CONTROLLERS)
        raise InputError(
            f"controller must be one of {known}, or MODULE:NAME or FILE.py:NAME of your own, got {name!r}"
            f"{closest(name, tuple(CONTROLLERS))}"
        )
    try:
        make: Any = getattr(_module(place), attribute)
        made = make.of(rig) if hasattr(make, "of") else make(rig)
    except InputError:
        raise
    except Exception as error:  # a user's code may raise anything
        raise InputError(f"controller {name} could not be made: {type(error).__name__}: {error}") from error
    missing = [part for part in ("rate", "delay", "start") if not hasattr(made, part)]
    if missing:
        raise InputError(f"a controller must have rate, delay and start, got {name} without {', '.join(missing)}")
    return made  # type: ignore[no-any-return]


def source_of(name: str) -> Path | None:
    """Return the file that a user's own controller is written in, None for a built-in one."""
    place = name.rpartition(":")[0]
    if name in CONTROLLERS or not place:
        return None
    return Path(getattr(_module(place), "__file__", None) or place)


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
