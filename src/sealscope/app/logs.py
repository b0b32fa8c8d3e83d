"""What the workbench says of each log: when, how long, which channels, which defects, a small picture, its duty."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sealscope.app.session import SessionMachine
from sealscope.app.tables import Source, cache_folder, reduce_extremes
from sealscope.diagnosis.channel_checks import ChannelCheck, check_channels
from sealscope.diagnosis.commissioned.machine import read_by_map
from sealscope.diagnosis.commissioned.summary import measure_duty
from sealscope.diagnosis.flow_curves import FlowCurves, compute_flow_curves
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.errors import SealscopeError, UnreadableFile
from sealscope.parameters import Rig
from sealscope.recordings.files import iter_columns
from sealscope.recordings.formats.columns import GROUP, REST, reconstruct_map
from sealscope.recordings.formats.headings.actuators import find_actuators
from sealscope.recordings.formats.headings.labels import Label, proposed_map
from sealscope.recordings.header import start_seconds
from sealscope.recordings.recording import Array, Recording
from sealscope.reporting.charts import display_values
from sealscope.storage.atomic import atomic_write
from sealscope.storage.plain_values import to_plain
from sealscope.units import LITRE_PER_MINUTE

#: Rows of a text log that are read at a time, for its first picture.
PART_ROWS = 30_000
#: Points of a small picture, and format of the stored rows and tables.
_PICTURE, VERSION = 64, 3
#: Chambers, each with a balance of its own behind a servo valve.
_SIDES: tuple[Literal["A", "B"], ...] = ("A", "B")
_ZONE = re.compile(r"(?:Z|[+-]\d\d:?\d\d)$")


def file_stamp(path: Path) -> str:
    """Format what identifies the content of a file: its path, size and time of change."""
    status = path.stat()
    return f"{path}|{status.st_size}|{status.st_mtime_ns}"


def read_log(path: Path, machines: Sequence[SessionMachine]) -> Recording:
    """Read a log by the first of the machines' maps that fits it, else by the names of its columns."""
    error: SealscopeError | None = None
    for channel_map, rate in [*((m.channel_map, m.rate) for m in machines if m.map or m.rate), ("auto", None)]:
        try:
            return read_by_map(path, channel_map, rate)
        except UnreadableFile as reason:
            error = reason
    assert error is not None
    raise error


def read_for(machine: SessionMachine, path: Path) -> Recording:
    """Read a log by the map of a machine, as its commissioning does."""
    return read_by_map(path, machine.channel_map, machine.rate)


def describe_log(path: Path, machines: Sequence[SessionMachine]) -> dict[str, Any]:
    """Describe a log for the table, from the cache if neither the log nor the maps have changed.

    An unreadable log is described by its `error`.
    """
    try:
        maps = [(m.channel_map, m.rate) for m in machines if m.map or m.rate]
        stamp = json.dumps([VERSION, file_stamp(path), maps], sort_keys=True)
        stored = cache_folder() / "rows" / f"{sha256(stamp.encode('utf-8', 'surrogateescape')).hexdigest()[:32]}.json"
        with suppress(OSError, ValueError):
            return json.loads(stored.read_text(encoding="utf-8"))  # type: ignore[no-any-return]
        row = describe_recording(read_log(path, machines), path.name)
        with suppress(SealscopeError, OSError):
            stored.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with atomic_write(stored) as temporary:
                temporary.write_text(json.dumps(row), encoding="utf-8")
        return row
    except (SealscopeError, OSError, MemoryError) as error:
        return {"state": "unreadable", "error": " ".join((str(error) or "out of memory").split())}
    except Exception as error:  # a defect concerns this row alone
        return {"state": "unreadable", "error": f"cannot read, got {type(error).__name__}: {error}"[:500]}


def describe_recording(recording: Recording, name: str, *, with_places: bool = False) -> dict[str, Any]:
    """Describe a recording as plain values: start, length, rate, channels, findings, small picture and duty.

    `with_places`: also the times of all places at which a defect was found.
    """
    start = str(recording.provenance.get("start", ""))
    findings = [
        {"severity": finding.severity, "text": finding.text, "channel": finding.channel, "t": finding.first_t}
        | ({"places": finding.places} if with_places else {})
        for finding in inspect_recording(recording).findings
    ]
    row = {
        "state": "read",
        "start_s": start_seconds(recording, name),
        "zone": match[0] if (match := _ZONE.search(start)) and "T" in start else "",
        "seconds": recording.duration,
        "rate": recording.rate,
        "samples": len(recording),
        "channels": list(recording.channels),
        "unused": list(recording.unused),
        "format": str(recording.provenance.get("format", "")),
        "findings": findings,
        "picture": _draw_small(recording),
        "duty": measure_duty(recording),
    }
    return to_plain(row)  # type: ignore[no-any-return]


def _draw_small(recording: Recording) -> dict[str, Any]:
    """Reduce the channels that tell most to lines of a small picture, each scaled to 0 .. 1."""
    chosen = [name for name in ("p_A", "p_B", "x") if name in recording] or list(recording.channels)[:2]
    lines = {}
    for name in chosen:
        values = recording[name]
        low, high = reduce_extremes(values, 0, len(values), max(1, -(-len(values) // _PICTURE)))
        lines[name] = np.column_stack([low, high]).ravel()
    pressures = [lines[name] for name in lines if name.startswith("p_")]
    for name, line in lines.items():
        scale = np.concatenate(pressures) if name.startswith("p_") and pressures else line
        finite = scale[np.isfinite(scale)]
        least, most = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        lines[name] = np.round((line - least) / (most - least or 1.0), 3)
    return {name: line.tolist() for name, line in lines.items()}


def propose_map(path: Path, rate: float | None, group: str | None) -> tuple[dict[str, str], tuple[str, ...], str]:
    """Propose the column of each channel of a log, and find the actuators to which its columns belong.

    Returns the map, the names of the actuators, and why the log is not read without one of them or a map by hand, "" if
    it is. `group`: actuator whose columns are proposed.
    """
    headings = next(iter(iter_columns(path, rate=rate, rows=1000))).channels
    labels = [Label.parse(heading) for heading in headings]
    groups = find_actuators(labels).names
    try:
        recording = read_by_map(path, "auto" if group is None else {REST: "auto", GROUP: group}, rate)
    except SealscopeError as error:
        return proposed_map(labels), groups, str(error)
    return reconstruct_map(recording.provenance) or {name: name for name in recording.channels}, groups, ""


def columns_source(path: Path, time: str | None, rate: float | None) -> Source:
    """Make the source of a table of every column of a log, as it is written."""

    def iter_parts() -> Iterator[tuple[Sequence[str], Mapping[str, Any], Array, Sequence[Array]]]:
        for fields in iter_columns(path, time=time, rate=rate, rows=PART_ROWS):
            details = {"rate": fields.rate, "format": fields.kind, "notes": list(fields.history)[:40]}
            details["start_s"] = fields.provenance.get("start_epoch_s")
            yield list(fields.channels), to_plain(details), fields.t, list(fields.channels.values())

    return iter_parts


def channels_source(read: Callable[[], Recording]) -> Source:
    """Make the source of a table of a recording's channels, in the units in which they are shown."""

    def iter_parts() -> Iterator[tuple[Sequence[str], Mapping[str, Any], Array, Sequence[Array]]]:
        recording = read()
        shown = [display_values(recording, name, recording.pressure_unit) for name in recording.channels]
        names = [f"{name} [{unit}]" for name, (unit, _) in zip(recording.channels, shown, strict=True)]
        yield names, {"rate": recording.rate}, recording.t, [values for _, values in shown]

    return iter_parts


def balance_source(read: Callable[[], Recording], rig: Rig | None) -> Source:
    """Make the source of a table of a recording's volume balance: volumes [L] since the first sample.

    Without true flows, the volumes are fractions [%] of what the pump delivers in a minute. The details hold the checks
    of the channels as well, and `groups`: the columns of each chamber behind a servo valve, elsewhere one group.
    """

    def iter_parts() -> Iterator[tuple[Sequence[str], Mapping[str, Any], Array, Sequence[Array]]]:
        recording = read()
        balances = [curves for side in _SIDES if (curves := compute_flow_curves(recording, rig, side)) is not None]
        first = balances[0] if balances else None
        details: dict[str, Any] = {"checks": [_as_lists(check) for check in check_channels(recording, rig, first)]}
        if first is None:
            problem = "its channels allow no balance of volumes: it needs pressures, position and pump flow"
            yield [], to_plain(details | {"groups": [], "problem": problem}), np.empty(0), []
            return
        duration = max(float(first.t[-1] - first.t[0]), 1e-9)
        mean = float(np.abs(np.diff(first.delivered)).sum()) / duration  # [m^3/s]
        scale = 1.0 / (60.0 * LITRE_PER_MINUTE) if first.states_flow else 100.0 / 60.0 / max(mean, 1e-30)
        groups, columns = list[dict[str, Any]](), list[Array]()
        for side, curves in zip(_SIDES, balances, strict=False):
            names = [curves.source, *curves.parts]
            moved_by = next((name for name in ("piston", "valve") if name in curves.parts), None)
            group = {"names": names, "first": len(columns), "chamber": side if len(balances) > 1 else ""}
            leaked = abs(float(scale * curves.parts["leakage"][-1])) if "leakage" in curves.parts else 0.0
            groups.append(group | {"moved_by": moved_by, "closure": _closure(curves, moved_by), "leaked": leaked})
            columns += [scale * values for values in (curves.delivered, *curves.parts.values())]
        details |= {
            "unit": "L/min" if first.states_flow else "% of the pump's flow",
            "volume_unit": "L" if first.states_flow else "% of a minute's flow",
            "blocks": np.round(first.blocks, 4).tolist(),
            "groups": groups,
        }
        yield [name for group in groups for name in group["names"]], to_plain(details), first.t, columns

    return iter_parts


def _closure(curves: FlowCurves, moved_by: str | None) -> float | None:
    """Compute the range of what the part `moved_by` and the leakage leave, over that of the left side of the balance.

    The part is the piston's volume or, behind a servo valve, that of the valve; None for a held load, without either.
    """
    extent = float(np.ptp(curves.delivered))
    if moved_by is None or not extent > 0.0:
        return None
    return float(np.ptp(curves.delivered - curves.parts[moved_by] - curves.parts.get("leakage", 0.0))) / extent


def _as_lists(check: ChannelCheck) -> dict[str, Any]:
    """Convert a check to plain values, its curves to lists of five digits."""
    curves = [
        curve._asdict() | {axis: [float(f"{value:.5g}") for value in getattr(curve, axis)] for axis in ("x", "y")}
        for curve in check.curves
    ]
    return check._asdict() | {"curves": curves}


def is_hidden(name: str) -> bool:
    """Return True for a name that no log has in the workbench: hidden, or with a separator or control characters."""
    return name.startswith(".") or not name.isprintable() or os.sep in name or "/" in name or "\\" in name or not name
