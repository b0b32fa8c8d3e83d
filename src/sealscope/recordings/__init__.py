"""Recordings of an actuator: the class Recording, its files, and findings on the quality of its data."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.recordings.files import read, read_parts, write
    from sealscope.recordings.formats.columns import split_map_option
    from sealscope.recordings.joining import join
    from sealscope.recordings.quality import Finding, inspect, uniform_segments

_HOMES = {
    "split_map_option": "formats.columns",
    "join": "joining",
    "read": "files",
    "read_parts": "files",
    "write": "files",
    "Finding": "quality",
    "inspect": "quality",
    "uniform_segments": "quality",
}

__all__ = [
    "CHANNEL_UNITS",
    "COUNTS",
    "Finding",
    "Recording",
    "inspect",
    "join",
    "read",
    "read_parts",
    "split_map_option",
    "uniform_segments",
    "write",
]


def __getattr__(name: str) -> object:
    """Import a public name from its module when it is first used, as these modules have heavy dependencies."""
    from importlib import import_module

    if name in _HOMES:
        return getattr(import_module(f"sealscope.recordings.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
