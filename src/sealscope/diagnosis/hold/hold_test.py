"""The hold test: judge a load that shut valves hold by how the piston sinks, or how the pressure falls.

It needs no motion, no pump and no healthy recordings. `readings` finds the holds, `estimates` estimates creep and leak,
`judgement` decides. Source: ISO 10100 (leakage of cylinders), ISO 14253-1 (decision rule).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from sealscope.calls import checked_call
from sealscope.diagnosis.hold.hold_equation import HeldLoad
from sealscope.diagnosis.hold.judgement import judge_hold
from sealscope.diagnosis.hold.readings import find_held_parts
from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.hold.set_up import parse_set_up
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.channels import COUNTS, FLOW_SOURCES
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.motion import is_constant
from sealscope.recordings.quality import inspect
from sealscope.recordings.recording import Recording
from sealscope.units import parse_quantity


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
    set_up = parse_set_up(area, volume, limit, oil, reference, collected, valve, capped, loaded)
    if recording is None:
        if set_up.collected is None:
            raise InputError("a hold test needs a recording, or the volume that was collected (collected)")
        return (judge_hold(HeldLoad(None, set_up, os.fspath(file) if file else "collected")),)
    if not isinstance(recording, Recording):
        raise InputError(f"recording must be a Recording, got {type(recording).__name__}")
    name = os.fspath(file) if file else str(recording.provenance.get("file", "recording"))
    samples = _select_samples(recording)
    findings, moment = inspect(recording), recording.provenance.get("start")
    if moment is None and (start_s := start_seconds(recording, name)) is not None:
        moment = np.datetime64(round(start_s - float(samples.t[0])), "s")  # of t = 0
    date = None if moment is None else str(moment)
    parts = _cut_holds(samples, start, end)
    with threadpool_limits(limits=1):  # faster for small matrices, and the results do not depend on the machine
        return tuple(judge_hold(HeldLoad(part, set_up, name, findings, date)) for part in parts)


def judge_held_recording(
    recording: Recording, areas: Sequence[float] | None = None, limit: str | None = None
) -> tuple[HoldResult, ...]:
    """Judge a recording of a held load, or return no result if it is none.

    It is one if it has a position in units of length, its pump and command rest, and `hold_test` finds holds in it that
    last for the fraction `part.share` (`priors.toml`) of its duration or longer. `areas` [m^2]: of the sides A and B;
    `limit`: as of `hold_test`. A limit or areas that `hold_test` refuses also give no result.
    """
    if "x" not in recording or recording.units["x"] == COUNTS or not _is_pump_at_rest(recording):
        return ()
    try:
        results = hold_test(recording, area=areas, limit=limit)
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
            raise InputError(f"{name} must have a unit, got raw counts: state it, as in --map '{name}=COLUMN[bar]'")
    values = {name: recording[name] for name in names}
    names = [name for name in names if np.count_nonzero(np.isfinite(values[name])) > 0.5 * len(recording)]
    if not names:
        unused = f"; unused: {join_names(recording.unused)}" if recording.unused else ""
        raise InputError(f"a hold test needs a position, a chamber pressure or a leakage flow, got none{unused}")
    rows = np.isfinite(recording.t) & np.all([np.isfinite(values[name]) for name in names], axis=0)
    later = np.maximum.accumulate(np.where(rows, recording.t, -np.inf))
    rows &= np.append(True, recording.t[1:] > later[:-1])
    kept = recording.only([*names, *(["T_oil"] if "T_oil" in recording else [])])
    return kept._select(rows, "samples of a hold")


def _cut_holds(samples: Recording, start: Any, end: Any) -> list[Recording]:
    """Cut the holds out of a log, those between `start` and `end` if these are stated; raise InputError without any."""
    shortest = HOLD.part.shortest
    if start is not None or end is not None:
        first = samples.t[0] if start is None else parse_quantity(start, "s", name="from")
        last = samples.t[-1] if end is None else parse_quantity(end, "s", name="until")
        rows = np.flatnonzero((samples.t >= first) & (samples.t <= last))
        parts = [(int(rows[0]), int(rows[-1]))] if rows.size > 1 else []
    elif len(samples) < 3:
        parts = []
    else:
        loaded = [samples[name] for name in CHAMBERS if name in samples]
        highest = max(loaded, key=lambda p: float(np.median(p)), default=None)
        parts = find_held_parts(samples.t, samples.channels.get("x"), highest)
    durations = [float(samples.t[last] - samples.t[first]) for first, last in parts]
    held = [part for part, duration in zip(parts, durations, strict=True) if duration >= shortest]
    held = [(first, last) for first, last in held if last - first >= 4]
    if not held:
        longest = f"{max(durations):.3g} s at most" if durations else "no sample"
        raise InputError(f"a hold must last {shortest:g} s with 5 samples or more, got {longest} without motion")
    return [samples.samples(slice(first, last + 1)) for first, last in held]
