"""Blocks from a stream of lines, one JSON message a line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import BinaryIO

from sealscope.monitor.sources.source_block import (
    LARGEST,
    OVERSIZED,
    BlockReceiver,
    RefusedMessage,
    SourceBlock,
    decoded,
)


def lines_of(stream: BinaryIO) -> Callable[[BlockReceiver], None]:
    """Return the source of a stream's lines."""

    def hand_lines(service: BlockReceiver) -> None:
        for block in _blocks(stream):
            service.hand(block)
            if service.stopping.is_set():
                return

    return hand_lines


def _blocks(stream: BinaryIO) -> Iterator[SourceBlock | RefusedMessage]:
    """Yield the block of every line, or the error where a line holds none; empty lines are passed over."""
    while line := stream.readline(LARGEST + 1):
        if len(line) > LARGEST:
            refused = RefusedMessage(OVERSIZED, f"a line must have at most {LARGEST} bytes, got more", line)
            while line and not line.endswith(b"\n"):
                line = stream.readline(LARGEST)
            yield refused
        elif line := line.strip():
            try:
                yield decoded(line)
            except RefusedMessage as error:
                yield RefusedMessage(error.reason, error, line)
