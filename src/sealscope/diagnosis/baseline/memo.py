"""What a detector once found of a recording, for as long as that recording is in use.

Many files are compared with the same leak-free recordings; what a fit of a model finds in these does not change from
file to file.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.recordings.recording import Recording

_T = TypeVar("_T")
_found: WeakKeyDictionary[Recording, dict[Hashable, tuple[Rig, Any]]] = WeakKeyDictionary()


def remembered(recording: Recording, detector: str, rig: Rig, find: Callable[[Recording], _T]) -> _T:
    """What `find` says of the recording, asked once for a detector that assumes `rig`.

    Recordings and rigs count as the same where they are the same object: neither changes once made.
    """
    known = _found.setdefault(recording, {})
    key = (detector, id(rig))
    if key not in known:
        known[key] = (rig, find(recording))  # the rig is kept, or its id might become another's
    found: _T = known[key][1]
    return found
