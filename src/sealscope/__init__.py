"""Sealscope: find internal leakage in electro-hydrostatic actuators.

    import sealscope as ss
    recording = ss.simulate(command="3 sin(4t)", leak="0.0042 L/min from 90 s", seed=1)
    print(ss.diagnose(recording))

`__init__.pyi` names the exports once, for type checkers and for this file, which loads each when it is first used.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
#: Export -> module that it is loaded from.
_HOMES = {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as \2$", _STUB, re.MULTILINE)}
# `import *` must not load LeakDetector, which needs the extra `learn`
__all__ = list(sorted({*_HOMES, "__version__"} - {"LeakDetector"}))


def __getattr__(name: str) -> Any:
    """Load the exported object `name` of the package when it is first used."""
    if name == "__version__":
        from importlib.metadata import version

        return version("sealscope")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the names that `import *` loads, i.e. all exports but LeakDetector."""
    return __all__
