"""Read blocks of samples from a stream of lines, each of which is a JSON message."""

from __future__ import annotations

from codecs import BOM_UTF8
from collections.abc import Callable
from typing import BinaryIO

from sealscope.monitor.sources.source_block import (
    MAX_MESSAGE_BYTES,
    OVERSIZED,
    BlockReceiver,
    RefusedMessage,
    decode_message,
)


def line_source(stream: BinaryIO) -> Callable[[BlockReceiver], None]:
    """Build a source that submits the blocks in the lines of a stream until it ends; empty lines are skipped."""

    def submit_lines(service: BlockReceiver) -> None:
        units_of = {actuator.name: actuator.units for actuator in service.settings.actuator}
        while not service.stopping.is_set() and (line := stream.readline(MAX_MESSAGE_BYTES + 1)):
            if len(line) > MAX_MESSAGE_BYTES:
                rule = f"a line must have at most {MAX_MESSAGE_BYTES} bytes, got more"
                refusal = RefusedMessage(OVERSIZED, rule, line)
                while line and not line.endswith(b"\n"):  # skip the rest of the line
                    line = stream.readline(MAX_MESSAGE_BYTES)
                service.submit(refusal)
            elif line := line.removeprefix(BOM_UTF8).strip():  # some shells begin a stream with the mark
                try:
                    service.submit(decode_message(line, units_of=units_of))
                except RefusedMessage as error:
                    service.submit(RefusedMessage(error.reason, error, line))

    return submit_lines
