"""One alarm: what leaks, how much, since when, why that is believed, and what a person did about it.

The states are those of ISA-18.2 (Management of Alarm Systems for the Process Industries): an alarm is unacknowledged
until a person has seen it, acknowledged while its cause lasts, returned where the cause went before anybody saw it, and
normal when both are over.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Level = Literal["warning", "error"]
AlarmState = Literal["unacknowledged", "acknowledged", "returned", "normal"]
#: Number that a control or a plant's catalogue of messages knows a level by.
DIAGNOSTIC_NUMBERS: dict[Level, int] = {"warning": 4101, "error": 4102}
#: Bits of the status word.
WARNING_BIT, ERROR_BIT, UNSEEN_BIT = 1, 2, 4
#: What to look at next, by cause.
NEXT_CHECKS = {
    "piston leak": "hold a load with the pump stopped: does the piston creep? Then its seal is worn",
    "piston or pump leak": "hold a load with the pump stopped: a piston that creeps has a worn seal; else measure the "
    "flow of the pump's case drain",
    "pump leak": "measure the flow of the pump's case drain",
    "leak inside or outside": "look for oil outside: rod seal, fittings, hoses; if there is none, hold a load with the "
    "pump stopped: a piston that creeps has a worn seal, else measure the flow of the pump's case drain",
    "external leak": "look for oil outside: fittings, rod seal, hoses; read the accumulator's level",
}


@dataclass(frozen=True)
class Alarm:
    """An alarm.

    Parameters
    ----------
    id : str
        Actuator and a running number.
    actuator : str
    level : {"warning", "error"}
    state : {"unacknowledged", "acknowledged", "returned", "normal"}
    raised_s, updated_s : float
        Clock of the samples when it was raised, and when it changed last [s].
    onset_s, onset_interval_s : float and pair of floats
        Since when it leaks, and its 95 % interval [s].
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Leak and its 95 % interval [L/min].
    cause, evidence, next_check : str
        Where the oil goes, why that is believed, and what to look at.
    baseline : int
        Version of the baseline it is compared with.
    mark : str
        "false" or "repaired", as a person said; "" before.
    shelved_until_s : float
        It is not announced before this clock [s].
    by_chance_per_1000_h : float, optional
        Alarms as strong as this that a healthy actuator raises per 1000 operating hours, at most.
    """

    id: str
    actuator: str
    level: Level
    state: AlarmState
    raised_s: float
    updated_s: float
    onset_s: float
    onset_interval_s: tuple[float, float]
    leak_lpm: float | None
    leak_interval_lpm: tuple[float, float] | None
    cause: str
    evidence: str
    next_check: str
    baseline: int
    mark: str = ""
    shelved_until_s: float = 0.0
    by_chance_per_1000_h: float | None = None

    @property
    def active(self) -> bool:
        """Whether its cause lasts."""
        return self.state in ("unacknowledged", "acknowledged")

    @property
    def shelved(self) -> bool:
        """Whether it is not to be announced, as of its last change."""
        return self.shelved_until_s > self.updated_s

    @property
    def diagnostic_number(self) -> int:
        """Number of the message, by level."""
        return DIAGNOSTIC_NUMBERS[self.level]

    def plain(self) -> dict[str, Any]:
        """Return it as plain values, the diagnostic number included."""
        values = asdict(self)
        for name in ("onset_interval_s", "leak_interval_lpm"):
            values[name] = None if values[name] is None else list(values[name])
        return {**values, "diagnostic_number": self.diagnostic_number, "shelved": self.shelved}


def status_word(alarms: Iterable[Alarm]) -> int:
    """Return the status bits of an actuator: 1 a warning lasts, 2 an error lasts, 4 one is to be acknowledged."""
    word = 0
    for alarm in alarms:
        if alarm.active:
            word |= ERROR_BIT if alarm.level == "error" else WARNING_BIT
        if alarm.state in ("unacknowledged", "returned") and not alarm.shelved:
            word |= UNSEEN_BIT
    return word
