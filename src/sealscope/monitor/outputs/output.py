"""The outputs of alarms that the settings switch on, each by a table of its own.

A new output is a module in this folder with a class that has the methods of `Output`, and in `monitor/settings.py` the
class of its table, whose `sender` names the first class, with a field of `MonitorSettings`. `deliver` of the new class
calls `store.deliver(NAME, send)`. The function `send` takes an event, skips it unless `is_announced`, and returns
False if the event was not taken and must be sent again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, Self

from sealscope.monitor.settings import MonitorSettings, OutputSettings

if TYPE_CHECKING:
    from sealscope.monitor.actuators import WatchedActuators

#: Events that the detector causes; they are not announced while an alarm is shelved.
_DETECTOR_EVENTS = ("raised", "error", "warning", "returned")


def is_announced(event: Mapping[str, Any]) -> bool:
    """Return True if an event is to be sent; for a shelved alarm, only the marks and comments of persons are sent."""
    return event["event"] not in _DETECTOR_EVENTS or not event["alarm"]["shelved"]


class Output(Protocol):
    """An output of alarms; `part`: name under which the page, the log and the metrics show its outages.

    `deliver` is called again and again; `end` is called once, at the end. Both send the new events by
    `MonitorStore.deliver`, which stores how far the output has come. An error begins an outage of the output; of
    PartAway only the text is logged.
    """

    part: str

    @classmethod
    def from_settings(cls, actuators: WatchedActuators, table: Any, settings: MonitorSettings) -> Self:
        """Build the output from its `table` of the `settings`; raise InputError if a secret cannot be read."""

    def deliver(self) -> None:
        """Send the new events."""

    def end(self) -> None:
        """Send the remaining events and close connections."""


def open_outputs(actuators: WatchedActuators, settings: MonitorSettings) -> Iterator[Output]:
    """Build and yield the outputs of alarms that the settings switch on, one for each table such as [webhook]."""
    for name in type(settings).model_fields:
        table = getattr(settings, name)
        if isinstance(table, OutputSettings):
            module_name, _, class_name = table.sender.partition(":")
            module = import_module(f"sealscope.monitor.outputs.{module_name}")
            yield getattr(module, class_name).from_settings(actuators, table, settings)
