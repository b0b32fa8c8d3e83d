"""The outputs of alarms that the settings switch on, each by a table of its own.

Settings and the class that sends are a pair: `OutputSettings.sender` names the class in this folder.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, Self

from sealscope.monitor.settings import MonitorSettings, OutputSettings

if TYPE_CHECKING:
    from sealscope.monitor.actuators import WatchedActuators


class Output(Protocol):
    """An output of alarms.

    `part`: name under which page, log and metrics show its outages. `deliver` is called again and again; `end` is
    called once, at the end. Both send the new events by `MonitorStore.deliver`, which stores how far the output has
    come, and raise PartAway if the receiver does not accept them.
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
    """Build the outputs of alarms that the settings switch on, one for each table such as [webhook]; yield each."""
    for name in type(settings).model_fields:
        table = getattr(settings, name)
        if isinstance(table, OutputSettings):
            module_name, _, class_name = table.sender.partition(":")
            module = import_module(f"sealscope.monitor.outputs.{module_name}")
            yield getattr(module, class_name).from_settings(actuators, table, settings)
