"""The hold test: judge a load that shut valves hold by how the piston sinks, or how the pressure falls.

It needs no motion, no pump and no healthy recordings. `readings` finds the holds, `estimates` estimates creep and leak,
`judgement` decides. Source: ISO 10100 (leakage of cylinders), ISO 14253-1 (decision rule).
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from itertools import compress

import numpy as np
from threadpoolctl import threadpool_limits

from sealscope.calls import checked_call
from sealscope.diagnosis.hold.hold_equation import HeldLoad
from sealscope.diagnosis.hold.judgement import judge_hold
from sealscope.diagnosis.hold.limits import parse_in_range
from sealscope.diagnosis.hold.readings import find_held_parts
from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.hold.set_up import SetUp, parse_set_up
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.recordings.channels import CHAMBERS, COUNTS, FLOW_SOURCES
from sealscope.recordings.header import start_seconds
from sealscope.recordings.motion import is_constant
from sealscope.recordings.quality import Finding, inspect
from sealscope.recordings.recording import Array, Recording
from sealscope.units import BAR, ML_PER_MINUTE, MM_PER_MINUTE, same_dimension

_REST = "a short rest, or one with little load across the piston, is no hold of the test: --from and --until judge it"


@checked_call
def hold_test(
    recording: Recording | None = None,
    *,
    area: str | float | Sequence[str | float] | None = None,
    volume: str | float | Sequence[str | float] | None = None,
    limit: str | None = None,
    oil: str | None = None,
    reference: str | float | None = None,
    collected: str | None = None,
    valve: str | None = None,
    capped: str | None = None,
    loaded: str | None = None,
    start: str | float | None = None,
    end: str | float | None = None,
    file: str | os.PathLike[str] | None = None,
) -> tuple[HoldResult, ...]:
    """Judge a load that shut valves hold: how fast it sinks, how much oil leaks, and whether that is within a limit.

    Parameters
    ----------
    recording : Recording, optional
        Log of the position, of one or both chamber pressures, or of a flow meter; may be absent with `collected`.
    area : str, float or sequence, optional
        Piston area (``"3117 mm^2"``, or m^2), or those of the sides A and B. Without it no flow is stated.
    volume : str, float or sequence, optional
        Volume of the held oil, line included (``"1.2 L"``, or m^3); by default it is assumed, with a wide prior.
    limit : str, optional
        Largest creep or leak that passes, such as ``"24 mm in 3 min"``, ``"15 mL/min"`` or
        ``"ISO 10100: 0.3 mL/min at 200 bar"``. Words before a colon are its name.
    oil : str, optional
        Temperature of oil that is not logged, and its course: ``"45 degC falling"``, ``"rising"`` or ``"steady"``.
    reference : str or float, optional
        Reference pressure to which the leak is converted (``"200 bar"``, or Pa).
    collected : str, optional
        Volume that was collected at the port of the unloaded side, such as ``"12 mL in 10 min"``.
    valve, capped : str, optional
        Sides with a load-holding valve, and sides whose port is capped: ``"A"``, ``"B"``, ``"A,B"`` or ``"none"``.
    loaded : str, optional
        Side that carries the load, ``"A"`` or ``"B"``; by default that of the higher pressure or, of a position alone,
        the side towards which the piston moves.
    start, end : str or float, optional
        Times of the hold (``"10 s"``, or s); by default it is found.
    file : str or path-like, optional
        Name of the recording in the results; by default that of its file.

    Returns
    -------
    tuple of HoldResult
        A result for each hold, in the order of time.

    Raises
    ------
    InputError
        No hold is found, an argument is out of its range, or a channel has no unit.

    Examples
    --------
    >>> import numpy as np
    >>> import sealscope as ss
    >>> t = np.arange(0.0, 600.0, 0.1)
    >>> x = 0.4 - 0.67e-3 * t / 60.0 + 1e-5 * np.random.default_rng(1).standard_normal(t.size)
    >>> recording = ss.Recording(t, {"x": x}, {"x": "m"}, rate=10.0)
    >>> (result,) = ss.hold_test(recording, area="3117 mm^2", limit="2 mm/min", oil="40 degC steady")
    >>> result.result, round(result.creep_mm_per_min, 2)
    ('pass', 0.67)
    """
    set_up = parse_set_up(area, volume, limit, oil, reference, collected, valve, capped, loaded, start, end)
    if recording is None:
        if set_up.collected is None:
            raise InputError("a hold test needs a recording, or the volume that was collected (collected)")
        return (judge_hold(HeldLoad(None, set_up, os.fspath(file) if file else "collected")),)
    if not isinstance(recording, Recording):
        raise InputError(f"recording must be a Recording, got {type(recording).__name__}")
    name = os.fspath(file) if file else str(recording.provenance.get("file", "recording"))
    samples = _select_samples(recording)
    findings = [finding for finding in inspect(recording) if finding.code != "too_short"]  # for detectors
    for column in recording.unused_temperatures:
        text = f"{column} is not read: if it is the oil's temperature, then --map 'T_oil={column}'"
        findings.append(Finding("unused_temperature", "warning", None, len(recording), None, text))
    moment = recording.provenance.get("start")
    if moment is None and (start_s := start_seconds(recording, name)) is not None:
        moment = np.datetime64(round(start_s - float(samples.t[0])), "s")  # of t = 0
    date = None if moment is None else str(moment)
    for column in recording.unused:
        if (unit := re.search(r"[\[(]([^\])]+)[\])]\s*$", column)) and same_dimension(unit[1], "m^3/s"):
            text = f"{column} is not read: if it is the leakage flow, then --map 'q_leak={column}'"
            findings.append(Finding("unused_flow", "warning", None, len(recording), None, text))
    parts, rests = _cut_holds(samples, set_up)
    findings += [] if not rests else [Finding("unloaded_rest", "note", None, len(rests), rests[0], _REST)]
    with threadpool_limits(limits=1):  # faster for small matrices, and the results do not depend on the machine
        return tuple(judge_hold(HeldLoad(part, set_up, name, findings, date)) for part in parts)


def judge_held_recording(
    recording: Recording, areas: Sequence[float] | None = None, limit: str | None = None
) -> tuple[HoldResult, ...]:
    """Judge a recording of a held load, or return no result if it is none.

    It is one if it has a position in units of length or, without any position, a chamber pressure, if its pump and
    command rest, and if `hold_test` finds holds in it that last for the fraction `part.share` (`priors.toml`) of its
    duration or longer. Pressures in raw counts are left out. `areas` [m^2]: of the sides A and B; `limit`: as of
    `hold_test`. Those that it refuses also give no result.
    """
    measured = recording.only(name for name in recording.channels if recording.units[name] != COUNTS)
    read = ("x",) if "x" in recording else CHAMBERS
    if not any(name in measured for name in read) or not _is_pump_at_rest(recording):
        return ()
    try:
        results = hold_test(measured, area=areas, limit=limit)
    except InputError:
        return ()
    held_s = sum((result.end_s or 0.0) - (result.start_s or 0.0) for result in results)
    return results if held_s >= HOLD.part.share * recording.duration else ()


def _is_pump_at_rest(recording: Recording) -> bool:
    """Test whether no recorded command, flow or speed of the pump changes, except for a motor that hardly turns."""
    for name in FLOW_SOURCES:
        values = recording.channels.get(name, np.zeros(1))
        finite = values[np.isfinite(values)]
        if not finite.size or is_constant(finite):
            continue
        if name != "omega" or float(np.abs(finite).max()) > HOLD.part.motor:
            return False
    return True


def _select_samples(recording: Recording) -> Recording:
    """Select the samples of the channels that a hold test reads; raise InputError if there are none."""
    names = [name for name in ("x", *CHAMBERS, "q_leak") if name in recording]
    for name in names:
        if recording.units[name] == COUNTS:
            unit = {"x": "mm", "q_leak": "mL/min"}.get(name, "bar")
            raise InputError(f"{name} must have a unit, got raw counts: state it, as in --map '{name}=COLUMN[{unit}]'")
    values = {name: recording[name] for name in names}
    if "x" in values:
        parse_in_range(float(np.nanmax(np.abs(values["x"]), initial=0.0)), "m", "position")
    names = [name for name in names if np.count_nonzero(np.isfinite(values[name])) > 0.5 * len(recording)]
    if not names:
        unused = f"; unused: {join_names(recording.unused)}" if recording.unused else ""
        raise InputError(f"a hold test needs a position, a chamber pressure or a leakage flow, got none{unused}")
    whole = np.isfinite(recording.t) & np.all([np.isfinite(values[name]) for name in names], axis=0)
    latest = np.maximum.accumulate(np.where(whole, recording.t, -np.inf))
    rows = whole & np.append(True, recording.t[1:] > latest[:-1])
    n_rows, n_whole = np.count_nonzero(rows), np.count_nonzero(whole)
    if n_rows < 0.5 * n_whole:
        raise InputError(f"time must increase, got {n_whole - n_rows} of {n_whole} samples not after those before them")
    kept = recording.only([*names, *(["T_oil"] if "T_oil" in recording else [])])
    return kept._select(rows, "samples of a hold")


def _cut_holds(samples: Recording, set_up: SetUp) -> tuple[list[Recording], list[float]]:
    """Cut the holds out of a log, or out of the part whose start or end is stated; with both, this part is the hold.

    Returns them, and the starts [s] of rests, which are none: without a load across the piston (`_find_load`), or of
    far less load over time than the longest hold, as before the lift and after the release. Raises InputError if no
    hold is left.
    """
    extent, shortest = f"in a log of {len(samples)} samples over {samples.duration:.3g} s", HOLD.part.shortest
    low, high = (-np.inf if set_up.start is None else set_up.start), (np.inf if set_up.end is None else set_up.end)
    samples = samples._select((samples.t >= low) & (samples.t <= high), "stated part")
    t, x, flow = samples.t, samples.channels.get("x"), samples.channels.get("q_leak")
    pressures = [samples[name] for name in CHAMBERS if name in samples]
    parts = [(0, len(t) - 1)] if len(t) else []
    if parts and (x is not None or pressures) and None in (set_up.start, set_up.end):
        parts = find_held_parts(t, x, pressures, flow) if len(t) > 2 else []
        extent = f"without motion {extent}"
    durations = [float(t[last] - t[first]) for first, last in parts]
    held = [part for part, duration in zip(parts, durations, strict=True) if duration >= shortest]
    held = [(first, last) for first, last in held if last - first >= 4]
    if not held:
        longest = f"{max(durations):.3g} s at most" if durations else "none"
        raise InputError(f"a hold must last {shortest:g} s with 5 samples or more, got {longest} {extent}")
    if x is not None:
        speeds = [abs(float(x[last] - x[first]) / float(t[last] - t[first])) / MM_PER_MINUTE for first, last in held]
        held = [part for part, speed in zip(held, speeds, strict=True) if speed < HOLD.part.motion]
        if not held:
            got = f"{min(speeds):.3g} mm/min {extent}: the cylinder moves"
            raise InputError(f"a held load sinks by {HOLD.part.motion:g} mm/min at most, got {got}")
    load, tank, loads = _find_load(pressures), HOLD.other.tank * BAR, np.ones(len(held))
    # beside a position, a single chamber may be the one without the load
    if load is not None and not (len(pressures) == 1 and x is not None and float(load.mean()) < tank):
        loads = np.array([float(load[first : last + 1].mean()) for first, last in held])
        if loads.max() < tank:
            sides = " across the piston" if len(pressures) > 1 else ""
            got = f"{loads.max() / BAR:.2g} bar {extent}"
            raise InputError(f"a hold needs a load of {tank / BAR:g} bar or more{sides}, got {got}")
        loads *= loads >= tank
    if flow is not None:
        loads *= [max(float(np.abs(flow[first : last + 1]).mean()), ML_PER_MINUTE * 1e-6) for first, last in held]
    loads *= [float(t[last] - t[first]) for first, last in held]
    is_loaded = loads >= HOLD.part.rest * loads.max()
    holds = [samples.samples(slice(first, last + 1)) for first, last in compress(held, is_loaded)]
    return holds, [float(t[first]) for (first, _), loaded in zip(held, is_loaded, strict=True) if not loaded]


def _find_load(pressures: Sequence[Array]) -> Array | None:
    """Find what drives a leak: the pressure (n,) of the one chamber, or the difference of both; None without any.

    Behind shut valves a piston that leaks soon has equal pressures on both sides, which tell nothing more.
    """
    return np.abs(pressures[0] - pressures[1]) if len(pressures) == 2 else next(iter(pressures), None)
