"""What persons say of alarms, in the file of the commissioned machine that an actuator's `rig` is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from sealscope.diagnosis.commissioned.machine import JUDGEMENTS, CommissionedMachine, JudgedAlarm
from sealscope.diagnosis.commissioned.machine_file import update_machine
from sealscope.errors import SealscopeError, printable
from sealscope.monitor.alarms import Alarm
from sealscope.recordings.formats.timebase import counts_from_1970
from sealscope.recordings.joining import join
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import read_toml


def pass_on(rig: str, alarm: Alarm, mark: str, samples: Sequence[Recording]) -> str:
    """Write a person's mark of an alarm into a machine's file, and return a line about the change.

    An `invalid` alarm's `samples`, the last ones before the mark, are taught as healthy; the machine's file refuses
    those that it judges leaking. From the onset of a `valid` one on no recording is, until a repair. "" where `mark` is
    another one, or `rig` no machine's file.
    """
    path = Path(rig)
    if mark not in JUDGEMENTS or path.suffix.lower() != ".toml":
        return ""
    name, reason = printable(alarm.id), printable(alarm.reason)  # one line each, where the file is shown
    try:
        if "machine" not in read_toml(path, "a machine's file", rig):
            return ""
        shift = 0.0 if counts_from_1970(alarm.onset_s) else time.time() - alarm.updated_s
        leak = None if mark == "invalid" else alarm.leak_lpm
        judged = JudgedAlarm(name, mark, time.time(), alarm.onset_s + shift, leak, reason)
        done = "written down"

        def add_mark(machine: CommissionedMachine) -> CommissionedMachine:
            nonlocal done
            machine = replace(machine, alarms=(*machine.alarms, judged))
            if mark == "invalid":
                try:
                    machine = machine.with_healthy(_recording(samples, shift), file=name)
                    done = "taught as healthy"
                except SealscopeError as error:
                    done = f"not taught: {error}"
            return machine

        update_machine(path, add_mark)
    except (SealscopeError, ValueError, OverflowError, OSError) as error:
        done = f"not written: {error}"
    return f"{path.name}: {done}"


def _recording(samples: Sequence[Recording], shift: float) -> Recording:
    """Return samples as one recording that begins at 0 s of a date, their clock and `shift` [s since 1970]."""
    if not samples:
        raise SealscopeError("no samples of the alarm are kept: add its recording by sealscope commission --add")
    whole = join(samples) if len(samples) > 1 else samples[0]
    start = datetime.fromtimestamp(float(whole.t[0]) + shift, UTC).replace(tzinfo=None)
    return replace(whole, t=whole.t - whole.t[0], provenance={"start": start.isoformat(timespec="milliseconds")})
