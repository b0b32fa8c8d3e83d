"""Recordings of an actuator: the class Recording, its files, and findings on the quality of its data."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from sealscope.recordings.channels import CHANNEL_UNITS as CHANNEL_UNITS
from sealscope.recordings.channels import COUNTS as COUNTS
from sealscope.recordings.recording import Recording as Recording

if TYPE_CHECKING:
    from sealscope.recordings.files import read as read
    from sealscope.recordings.files import read_parts as read_parts
    from sealscope.recordings.files import write as write
    from sealscope.recordings.formats.columns import split_map_option as split_map_option
    from sealscope.recordings.joining import join as join
    from sealscope.recordings.mending import mend as mend
    from sealscope.recordings.quality import Finding as Finding
    from sealscope.recordings.quality import inspect as inspect
    from sealscope.recordings.quality import uniform_segments as uniform_segments

_NAMES = {
    "files": ("read", "read_parts", "write"),
    "formats.columns": ("split_map_option",),
    "joining": ("join",),
    "mending": ("mend",),
    "quality": ("Finding", "inspect", "uniform_segments"),
}


def __getattr__(name: str) -> object:
    """Import an exported name when it is first used, as these modules have heavy dependencies."""
    for module, names in _NAMES.items():
        if name in names:
            return getattr(import_module(f"sealscope.recordings.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
