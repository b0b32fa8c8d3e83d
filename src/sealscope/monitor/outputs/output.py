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

    `part`: name under which page, log and metrics show its outages. `deliver` is called again and again; it sends the
    new events by `MonitorStore.deliver`, which remembers how far the output has come, and raises PartAway if they are
    not taken. `end` is called once, at the end.
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
            module, _, sender = table.sender.partition(":")
            yield getattr(import_module(f"sealscope.monitor.outputs.{module}"), sender).from_settings(
                actuators, table, settings
            )
