"""Blocks from a stream of lines, one JSON message a line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

from sealscope.monitor.sources.source_block import LARGEST, OVERSIZED, RefusedMessage, SourceBlock, decoded


def blocks_of_lines(stream: BinaryIO) -> Iterator[SourceBlock | RefusedMessage]:
    """Yield the block of every line, or the error where a line holds none; empty lines are passed over."""
    while True:
        line = stream.readline(LARGEST + 1)
        if not line:
            return
        if len(line) > LARGEST:
            refused = RefusedMessage(OVERSIZED, f"a line must have at most {LARGEST} bytes, got more", line)
            while line and not line.endswith(b"\n"):
                line = stream.readline(LARGEST)
            yield refused
            continue
        line = line.strip()
        if not line:
            continue
        try:
            yield decoded(line)
        except RefusedMessage as error:
            yield RefusedMessage(error.reason, error, line)
