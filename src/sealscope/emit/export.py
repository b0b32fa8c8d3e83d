"""Export the estimator of a machine's stream for controllers: C99, or Structured Text."""

from __future__ import annotations

import os
import re
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.healthy import Healthy
from sealscope.diagnosis.inference.equations.balances import PUMP_VOLUMES, absolute_offset
from sealscope.diagnosis.inference.rows import SUPPORT
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.kernel.stream import RESULTS, StreamSettings
from sealscope.diagnosis.live.live_balance import BLOCK_SECONDS, LiveBalance, NotJudged
from sealscope.emit.c99 import Precision
from sealscope.emit.c_export import parts_a_sample, render_c, render_vectors
from sealscope.emit.run_program import CompiledStream
from sealscope.emit.single_precision import (
    MOST_ERROR,
    check_error,
    convert_learned,
    iter_blocks,
    learn_basis,
    measure_error,
)
from sealscope.emit.st_export import render_st
from sealscope.emit.stream_program import StreamProgram, stream_program
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS
from sealscope.recordings.quality import sensor_limit
from sealscope.recordings.recording import Array, Recording
from sealscope.storage.atomic import atomic_write

Language = Literal["c", "st"]
#: Names that begin the functions of an export: a letter, then letters, digits and single underscores.
_PREFIX = re.compile(r"[A-Za-z](?:_?[A-Za-z0-9])*")
#: Longest test vectors [s].
_VECTOR_SECONDS = 90.0


class Export(NamedTuple):
    """The files that `export_controller` wrote, and figures of the program.

    `single_error`: largest error of single precision in a block of the recordings to learn from, in standard deviations
    of its conductance; None in double precision.
    """

    files: tuple[Path, ...]
    rate: float
    state_bytes: int
    parts_a_sample: int
    learned_blocks: int
    single_error: float | None = None


@checked_call
def export_controller(
    folder: str | os.PathLike[str],
    *,
    language: Language = "c",
    rig: Rig | str | os.PathLike[str] = "thesis",
    rate: float | None = None,
    flow: str | None = None,
    false_alarms_per_1000_h: float = 1.0,
    learn: Sequence[Recording] = (),
    precision: Precision = "double",
    prefix: str = "leak",
    origin: str = "",
) -> Export:
    """Export the estimator of a running actuator's leakage as source text for a controller.

    Parameters
    ----------
    folder : path
        Folder to write into; files of the same names are replaced.
    language : {"c", "st"}, default "c"
        C99, or Structured Text of IEC 61131-3.
    rig : Rig, str or path, default "thesis"
        Sizes of the machine: of its circuit, piston area and pump displacement are used.
    rate : float, optional
        Samples a second [Hz]; by default that of the recordings to learn from, or 100 Hz.
    flow : {"theta", "omega", "q_pump"}, optional
        Channel that gives the pump's flow: its angle, its speed, or a flow meter; by default the one that the
        recordings to learn from have, or the angle.
    false_alarms_per_1000_h : float, default 1
        Largest number of false alarms of a healthy machine per 1000 operating hours.
    learn : sequence of Recording, optional
        Healthy recordings, from which the program begins to know the machine. The first also gives test vectors.
    precision : {"double", "single"}, default "double"
        Precision of C's real numbers. Single precision computes in columns learned from the recordings, and must err by
        at most a tenth of a standard deviation in each of their blocks.
    prefix : str, default "leak"
        Beginning of all names.
    origin : str, optional
        Where the sizes are from, in words.

    Returns
    -------
    Export
        The written files, and figures of the program.

    Raises
    ------
    InputError
        The machine's balance needs what no controller computes, its displacement is not stated, a recording lacks a
        channel or has another rate, or the monitor estimates otherwise from it, single precision errs too much, or
        learning needs a C compiler and there is none.

    Examples
    --------
    >>> import sealscope as ss
    >>> export = ss.export_controller("leak", rig="thesis", rate=100.0)  # doctest: +SKIP
    >>> [path.name for path in export.files]  # doctest: +SKIP
    ['leak.h', 'leak.c', 'main.c', 'Makefile', 'README.md']
    """
    if language not in ("c", "st"):
        raise InputError(f"language must be c or st, got {language!r}")
    if precision not in ("double", "single"):
        raise InputError(f"precision must be double or single, got {precision!r}")
    if precision == "single" and (language != "c" or not learn):
        lacking = "the language c" if language != "c" else "healthy recordings to learn from"
        raise InputError(f"single precision must have {lacking}")
    if not _PREFIX.fullmatch(prefix) or len(prefix) > 16:
        raise InputError(f"prefix must be a name of at most 16 letters and digits, got {prefix!r}")
    machine = load_rig(rig)
    healthy_rate, healthy_flow = controller_inputs(learn[0]) if learn else (100.0, "theta")
    rate = float(healthy_rate if rate is None else rate)
    flow = healthy_flow if flow is None else flow
    unit = stream_program(StreamSettings.from_rig(machine, rate, flow, false_alarms_per_1000_h))
    words: dict[str, Any] = {
        "prefix": prefix,
        "title": machine.title,
        "origin": origin or machine.name,
        "alarm_rate": false_alarms_per_1000_h,
    }
    samples = [_samples_of(recording, unit) for recording in learn]
    if samples:
        unit = stream_program(unit.settings._replace(to_absolute=absolute_offsets(samples[0], unit.settings)))
    learned: Sequence[float] = ()
    blocks, error = 0, None
    if samples:
        stream, blocks = _learn(unit, samples, words)
        _check_against_watch(CompiledStream(unit, render_c(unit, **words), prefix), samples, machine)
        if precision == "single":
            double, unit = stream, stream_program(unit.settings._replace(basis=learn_basis(stream)))
            stream = CompiledStream(unit, render_c(unit, **words), prefix)
            convert_learned(double, stream)
            learned = stream.saved()
            error = measure_error(double, stream, samples)
            check_error(error)
        else:
            learned = stream.saved()
    texts: Mapping[str, str]
    if language == "c":
        texts = render_c(unit, **words, learned=learned)
        if samples:
            vectors = samples[0][: round(_VECTOR_SECONDS * unit.settings.rate)]
            texts = {**texts, **render_vectors(CompiledStream(unit, texts, prefix), vectors)}
    else:
        texts = render_st(unit, **words, learned=learned)
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        with atomic_write(place / name) as temporary:
            Path(temporary).write_text(text, encoding="utf-8")
    files = tuple(place / name for name in texts)
    return Export(files, unit.settings.rate, unit.state_bytes, parts_a_sample(unit.settings), blocks, error)


def _flow_source(channels: Container[str]) -> str | None:
    """Choose the best of the channels that give a controller the pump's flow; None if all are absent."""
    return next((name for name in PUMP_VOLUMES if name in channels), None)


def controller_inputs(recording: Healthy) -> tuple[float, str]:
    """Return the rate [Hz] and the channel of the pump's flow that a controller has in common with a recording.

    Raises InputError if the recording has none of these channels.
    """
    if (flow := _flow_source(recording.units)) is None:
        got = ", ".join(recording.units)
        raise InputError(
            f"a controller must have the pump's angle, speed or flow ({', '.join(PUMP_VOLUMES)}), got {got}"
        )
    return float(round(recording.rate, 3)), flow


def _samples_of(recording: Recording, unit: StreamProgram) -> Array:
    """Return the samples (n, 4) of a recording in the order of the program; raise InputError if one is missing."""
    settings = unit.settings
    lacking = [name for name in settings.channels if name not in recording]
    if lacking:
        source, rule = _flow_source(recording.channels), f"must have {', '.join(lacking)}"
        if source and lacking == [settings.channels[2]]:
            rule += f"; its flow is {source}: state it as the flow"
        raise InputError(f"a recording to learn from {rule}, got {', '.join(recording.channels)}")
    if raw := [name for name in settings.channels if recording.units[name] == COUNTS]:
        raise InputError(f"a recording to learn from must have channels in units, got raw counts of {', '.join(raw)}")
    if abs(recording.rate / settings.rate - 1.0) > 1e-3:
        raise InputError(f"a recording to learn from must have the rate {settings.rate:g} Hz, got {recording.rate:g}")
    return np.stack([recording[name] for name in settings.channels], axis=1)


def absolute_offsets(samples: Array, settings: StreamSettings) -> tuple[float, float]:
    """Compute absolute minus gauge pressures p_A and p_B [Pa] from the first blocks, as a stream in Python does."""
    n_stride, block_strides, _ = settings.counts
    first_blocks = samples[: SUPPORT * n_stride * block_strides]
    limits = [sensor_limit(CHANNEL_UNITS[name]) for name in settings.channels]
    present = first_blocks[(np.abs(first_blocks) <= limits).all(axis=1)]
    return absolute_offset(present[:, 0]), absolute_offset(present[:, 1])


def _learn(unit: StreamProgram, recordings: Sequence[Array], words: Mapping[str, Any]) -> tuple[CompiledStream, int]:
    """Run the program on healthy recordings; return it, and how many blocks it estimated.

    The recordings are fed twice, as at first the program knows nothing of the machine. Raises InputError if no block
    could be estimated, or if the program, when it knows the machine, raises an alarm.
    """
    stream = CompiledStream(unit, render_c(unit, **words), str(words["prefix"]))
    blocks, threshold = 0, RESULTS.index("threshold")
    for is_known in (False, True):
        for k, samples in enumerate(recordings):
            if k or is_known:
                stream.resume()
            for results in stream.feed(samples, parts_a_sample(unit.settings)):
                if is_known and stream.state.alarm:
                    limit, seconds = results[threshold], results[RESULTS.index("since")]
                    raise InputError(
                        f"a controller must raise no alarm on a healthy recording, got one in number {k + 1}: its "
                        f"leakage rises {stream.state.n_ended * BLOCK_SECONDS - seconds:.0f} s after its beginning "
                        f"with a score over {limit:.1f}, and a controller weighs no other cause than a leak"
                    )
            stream.acknowledge()
            blocks += 0 if is_known else int(stream.state.n_estimated)
    if not blocks:
        raise InputError("recordings to learn from must have a minute of motion or more, got none that was estimated")
    return stream, blocks


def _check_against_watch(stream: CompiledStream, recordings: Sequence[Array], rig: Rig) -> None:
    """Raise InputError unless the live balance estimates the same conductances from each recording.

    Both run the same laws, but a controller knows no loads that are lowered past the resting pump, and restores no sign
    of a flow.
    """
    settings = stream.unit.settings
    n_block = settings.counts[0] * settings.counts[1]
    for k, samples in enumerate(recordings, 1):
        stream.initialise()
        stated = {int(number): estimate for number, estimate in iter_blocks(stream, samples)}
        channels = dict(zip(settings.channels, samples.T, strict=True))
        run = SampleRun(np.arange(len(samples)) / settings.rate, channels, settings.rate, follows=False)
        balance = LiveBalance(rig, settings.channels)
        parts = balance.take(run)
        results = [blocks for blocks in parts if not isinstance(blocks, NotJudged)]
        watched = {round(b.begin * settings.rate / n_block): (b.total, b.sd) for blocks in results for b in blocks}
        last = max(watched, default=-1)  # the live balance waits for what follows a block
        numbers = watched.keys() | {number for number in stated if number <= last}
        differing = [
            number
            for number in numbers
            if number not in stated
            or number not in watched
            or not np.abs(np.subtract(stated[number], watched[number])).max() <= MOST_ERROR * watched[number][1]
        ]
        if balance.is_unsigned:  # also where it waits for blocks to learn from
            raise InputError(
                f"a controller must read a flow with a sign, got {settings.channels[2]} in number {k}, which is never "
                "below zero though x moves both ways: the monitor restores its sign, a controller cannot"
            )
        if differing:
            lowered = "its load is lowered past the resting pump, which a controller does not tell from a leak"
            reason = f": {lowered}" if balance.has_lowered else ""
            got = f"{len(differing)} of {len(numbers)} blocks that differ in number {k}{reason}"
            raise InputError(f"a controller must estimate from a recording what the monitor does, got {got}")
