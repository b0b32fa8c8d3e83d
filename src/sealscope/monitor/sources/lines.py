"""Blocks from a stream of lines, one JSON message a line."""

from __future__ import annotations

from collections.abc import Callable
from typing import BinaryIO

from sealscope.monitor.sources.source_block import LARGEST, OVERSIZED, BlockReceiver, RefusedMessage, decoded


def lines_of(stream: BinaryIO) -> Callable[[BlockReceiver], None]:
    """Return the source of a stream's lines; empty ones are passed over."""

    def hand_lines(service: BlockReceiver) -> None:
        units_of = {actuator.name: actuator.units for actuator in service.settings.actuator}
        while not service.stopping.is_set() and (line := stream.readline(LARGEST + 1)):
            if len(line) > LARGEST:
                refused = RefusedMessage(OVERSIZED, f"a line must have at most {LARGEST} bytes, got more", line)
                while line and not line.endswith(b"\n"):
                    line = stream.readline(LARGEST)
                service.hand(refused)
            elif line := line.strip():
                try:
                    service.hand(decoded(line, units_of=units_of))
                except RefusedMessage as error:
                    service.hand(RefusedMessage(error.reason, error, line))

    return hand_lines
