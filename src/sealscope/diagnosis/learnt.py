"""What healthy recordings tell, computed once for each recording and kept on disk for later processes.

Detectors summarise a healthy recording, and its own changes are tested, each time that another recording is judged
beside it. The results depend on the samples of the recording, the assumed rig and the sources of this package only:
the name of a result's file is a hash of these. The files lie beside the compiled code, in the folder of these sources
(`compiled.cache_directory`), so that those of older sources are removed with it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sealscope.compiled import cache_directory
from sealscope.recordings.recording import Recording, compute_once
from sealscope.storage.kept_results import MISSING, SUFFIX, keep_result, plain_json, remove_oldest, restore_result

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_T = TypeVar("_T")
#: Most results that are kept.
MAX_RESULTS = 5000
#: Packages on which results depend, beside those on whose sources the name of the cache folder depends.
_PACKAGES = ("recordings", "evaluation")


@cache
def results_folder() -> Path | None:
    """Create the folder of the results of these sources, and return its path; None if nothing is cached."""
    directory = cache_directory()
    if directory is None:
        return None
    sources, root = sha256(), Path(__file__).parents[1]
    for package in _PACKAGES:
        for file in sorted(file for file in (root / package).rglob("*") if file.suffix in (".py", ".toml")):
            sources.update(file.read_bytes())
    folder = directory / f"learnt-{sources.hexdigest()[:16]}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError:
        return None
    remove_oldest(folder, MAX_RESULTS)
    return folder


def learn_once(
    recording: Recording, key: tuple[str, ...], compute: Callable[[Recording], _T], rig: Rig | None = None
) -> _T:
    """Return `compute(recording)`, computed once for each content of a recording, `key` and `rig`.

    The result is cached with the recording, and kept on disk if its values are plain (`storage.kept_results`).
    """

    def restore_or_compute(samples: Recording) -> _T:
        """Restore the result from disk, or compute and keep it."""
        assumed = None if rig is None else rig.as_dict()
        return _restore_or_compute(
            lambda: json.dumps([_digest(samples), key, assumed], default=str), lambda: compute(samples)
        )

    return compute_once(recording, (*key, rig), restore_or_compute)


def keep_once(content: Any, compute: Callable[[], _T]) -> _T:
    """Return `compute()`, kept on disk by the plain values `content` on which alone it depends."""
    return _restore_or_compute(lambda: plain_json(content), compute)


def _restore_or_compute(content: Callable[[], str], compute: Callable[[], _T]) -> _T:
    """Restore a result from disk by the text `content()` on which it depends, or compute and keep it."""
    folder = results_folder()
    if folder is None:
        return compute()
    file = folder / (sha256(content().encode()).hexdigest() + SUFFIX)
    result = restore_result(file)
    if result is MISSING:
        result = compute()
        keep_result(file, result)
    return result  # type: ignore[no-any-return]


def _digest(recording: Recording) -> str:
    """Compute the SHA-256 of all that a recording holds, in hexadecimal digits; the result is cached with it."""
    return compute_once(recording, ("content",), _compute_digest)


def _compute_digest(recording: Recording) -> str:
    """Compute the SHA-256 of the samples, units, rate, origin and history of a recording."""
    content = sha256(recording.t.tobytes())
    for values in recording.channels.values():
        content.update(values.tobytes())
    if recording.bridged is not None:
        content.update(recording.bridged.tobytes())
    description = [dict(recording.units), recording.rate, dict(recording.provenance), recording.history]
    content.update(json.dumps(description, default=str).encode())
    return content.hexdigest()
