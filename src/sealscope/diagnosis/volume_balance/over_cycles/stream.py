"""The cycle balance of a running machine: a window of whole cycles, looked at anew after each, in bounded memory.

The statistic and its rate are those of the volume balance's stream (`volume_balance.stream`); the position and the
shaft's angle are not needed.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from sealscope.diagnosis.isolation import isolated, signatures
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.volume_balance.live import WindowStream
from sealscope.diagnosis.volume_balance.over_cycles.detector import CycleBalance
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


class SequentialCycles(WindowStream):
    """Cycle balance of a live machine under a load, which names onset and L/min of a leak.

    It needs both chamber pressures and the command, or the shaft's speed or angle; the position where it is recorded.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the pump's displacement and the drive's law.
    alarms_per_hour : float, default 0.01
        False alarms of a healthy machine per operating hour, at most.
    window : int, default 60
        Blocks that are searched for a rise, 16 or more.

    Attributes
    ----------
    state : BalanceState
        The state after the last update. `refused` counts the windows without a score; `total_lpm` is None, since the
        drive's zero is not known.

    Raises
    ------
    InputError
        For a rate of alarms for which no threshold can be set, or a window of under 16 blocks.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(
    ...     rig="thesis-closed-loop", command="position 40 mm sin(2t)", load="1 kN", duration="2 min",
    ...     leak="0.01 L/min from 80 s", seed=1,
    ... ).only(["u", "p_A", "p_B"])
    >>> balance = ss.SequentialCycles("thesis-closed-loop", alarms_per_hour=0.1)
    >>> for start in range(0, 120, 10):
    ...     state = balance.update(recording.between(start, start + 10))
    >>> round(state.alarm.onset_s), f"{state.alarm.leak_lpm:.2f} L/min"
    (80, '0.01 L/min')
    """

    def __init__(
        self, rig: Rig | str | os.PathLike[str] = "thesis", *, alarms_per_hour: float = 0.01, window: int = 60
    ) -> None:
        from sealscope.parameters import load_rig

        super().__init__(CycleBalance(load_rig(rig)), CycleBalance.reads, alarms_per_hour, window)

    def _examined(self, window: Recording, probability: float) -> Evidence:
        evidence = super()._examined(window, probability)
        seen = signatures(window) if evidence.verdict == "leak" else None
        return evidence if seen is None else isolated(evidence, seen)
