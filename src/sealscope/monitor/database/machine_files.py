"""Write the marks that persons give alarms into the file of the commissioned machine."""

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
from sealscope.recordings.formats.times.timebase import counts_from_1970
from sealscope.recordings.joining import join
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import read_toml


def record_mark(rig: str, alarm: Alarm, mark: str, samples: Sequence[Recording]) -> str:
    """Write the mark that a person gave an alarm into the machine's file, and return one line that states the result.

    `rig`: path of the file; `samples`: the last samples before the mark. With the mark `invalid` they are added as a
    healthy recording, unless `with_healthy` of the machine refuses them, for example because they leak. Returns "" for
    a mark that is not in `JUDGEMENTS`, or if `rig` is not a machine's file.
    """
    path = Path(rig)
    if mark not in JUDGEMENTS or path.suffix.lower() != ".toml":
        return ""
    name, reason = printable(alarm.id), printable(alarm.reason)  # one line each, as the file is shown as text
    try:
        if "machine" not in read_toml(path, "a machine's file", rig):
            return ""
        # a machine's file has times since 1970; the samples' clock may start anywhere. On it, `updated_s` is the
        # present, as the mark has just changed the alarm
        shift = 0.0 if counts_from_1970(alarm.onset_s) else time.time() - alarm.updated_s
        leak_lpm = None if mark == "invalid" else alarm.leak_lpm
        times = {"date_s": time.time(), "onset_s": alarm.onset_s + shift}
        judgement = JudgedAlarm(alarm=name, mark=mark, leak_lpm=leak_lpm, reason=reason, **times)
        outcome = "mark stored"

        def add_mark(machine: CommissionedMachine) -> CommissionedMachine:
            nonlocal outcome
            machine = replace(machine, alarms=(*machine.alarms, judgement))
            if mark == "invalid":
                try:
                    machine = machine.with_healthy(_combine_samples(samples, shift), file=name)
                    outcome = "mark stored, samples added as healthy"
                except SealscopeError as error:
                    outcome = f"mark stored, samples not added: {error}"
            return machine

        update_machine(path, add_mark)
    except (SealscopeError, ValueError, OverflowError, OSError) as error:
        outcome = f"mark not stored: {error}"
    return f"{path.name}: {outcome}"


def _combine_samples(samples: Sequence[Recording], shift: float) -> Recording:
    """Join the samples of an alarm to one recording whose times start at 0 s; raise SealscopeError if there are none.

    `shift` [s]: added to their times to give seconds since 1970.
    """
    if not samples:
        raise SealscopeError("no samples of the alarm are kept: add its recording by sealscope commission --add")
    joined = join(samples) if len(samples) > 1 else samples[0]
    start = datetime.fromtimestamp(float(joined.t[0]) + shift, UTC).replace(tzinfo=None)
    return replace(joined, t=joined.t - joined.t[0], provenance={"start": start.isoformat(timespec="milliseconds")})
