"""A commissioned machine: its rig, the channel map of its logs, and the summaries of its healthy recordings."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.assumed_rig import assumed_rig, infer_rig
from sealscope.diagnosis.commissioned.summary import cross_check
from sealscope.diagnosis.detectors.registry import (
    detectors,
    limit_threads,
    log_failure,
    stored_surprisals,
    unusable_reason,
)
from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY, diagnose
from sealscope.diagnosis.healthy import SummarisedRecording, summary_table
from sealscope.diagnosis.hold.hold_test import judge_held_recording
from sealscope.diagnosis.hold.recorded_holds import (
    is_hold_results,
    read_hold_results,
    summarise_hold,
    summarise_result,
)
from sealscope.diagnosis.inference.changes.healthy_levels import HealthyLevels
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAK
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError, SealscopeError, UnreadableFile
from sealscope.paragraphs import format_count
from sealscope.parameters import Rig, load_rig
from sealscope.recordings import read
from sealscope.recordings.files import read_file
from sealscope.recordings.formats.columns import GROUP, REST, ChannelMap, Request, as_mapping
from sealscope.recordings.header import start_seconds
from sealscope.recordings.recording import Recording
from sealscope.storage.folders import iter_inner_files

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.summary import MachineSummary

#: Suffixes of files in a folder that are not recordings: Sealscope's own pages and settings, and notes.
NO_RECORDINGS = frozenset(
    {".toml", ".healthy", ".html", ".htm", ".pdf", ".png", ".svg", ".md", ".jsonl", ".part", ".bak"}
)
#: Beginning of a file with a trend or a verdict, which users may have written into the folder of the recordings.
_OWN_OUTPUT = re.compile(rb'\s*\{\s*"(verdict|file)":|file,time[, ]')
#: Most samples of all recordings that are kept in memory while commissioning; further recordings are read twice.
_MAX_SAMPLES = 20_000_000

#: Judgements that a person may give on an alarm.
Judgement = Literal["valid", "invalid", "repaired"]
JUDGEMENTS: tuple[Judgement, ...] = get_args(Judgement)


class JudgedAlarm(NamedTuple):
    """A person's judgement (`mark`) of an alarm of the monitor, or a repair.

    `alarm`: name of the alarm, "" for a repair without an alarm; `mark`: "valid", "invalid" or "repaired"; `date_s`,
    `onset_s`: times of the judgement and of the onset of the leak [s since 1970]; `leak_lpm`: flow of the leak [L/min],
    None if unknown; `reason`: reason given by the person, may be empty.
    """

    alarm: str
    mark: str
    date_s: float
    onset_s: float
    leak_lpm: float | None = None
    reason: str = ""

    def __str__(self) -> str:
        leak = "" if self.leak_lpm is None else f", {self.leak_lpm:.2g} L/min"
        onset_text = "" if self.mark == "invalid" else f", since {_format_date(self.onset_s)}{leak}"
        reason = f" ({self.reason})" if self.reason else ""
        return f"{self.alarm} {self.mark} {_format_date(self.date_s)}{onset_text}{reason}".strip()


class Origin(NamedTuple):
    """Path of the file that a machine was loaded from, and hashes of its parts, which show later changes by others."""

    path: Path
    parts: frozenset[bytes]


def _format_date(moment: float) -> str:
    """Format a time [s since 1970] as date, hour and minute in UTC, such as "2024-05-31 07:30"."""
    return datetime.fromtimestamp(moment, UTC).isoformat(" ", "minutes").removesuffix("+00:00")


@dataclass(frozen=True)
class CommissionedMachine:
    """A machine with its healthy recordings, with which its other recordings are compared.

    Parameters
    ----------
    name : str
        Name of the machine.
    healthy : tuple of SummarisedRecording
        Its healthy recordings, in the order of their dates.
    rig : Rig, optional
        Stated parameters of the machine, None if nothing is stated.
    channel_map : mapping of str to str, or "auto", optional
        Column of its logs for each channel; "auto" to find the channels by the columns' names.
    rate : float, optional
        Sampling rate [Hz] of logs without a time column.
    limit : str, optional
        Smallest leak that calls for a repair, such as "5 mL/min"; None for the default (`RepairLimit.parse`).
    left_out : tuple of str, optional
        Recordings that could not be used, each with the reason.
    alarms : tuple of JudgedAlarm, optional
        Judgements of persons on the monitor's alarms, and repairs.
    origin : Origin, optional
        The file that the machine was loaded from.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.CommissionedMachine("actuator 7", ())
    <CommissionedMachine actuator 7: 0 healthy recordings>
    """

    name: str
    healthy: tuple[SummarisedRecording, ...]
    rig: Rig | None = None
    channel_map: ChannelMap = field(default_factory=dict)
    rate: float | None = None
    limit: str | None = None
    left_out: tuple[str, ...] = ()
    alarms: tuple[JudgedAlarm, ...] = ()
    origin: Origin | None = field(default=None, repr=False, compare=False)

    @cached_property
    def summary(self) -> MachineSummary:
        """Summary of the machine, its sensors and the smallest detectable leak, from the healthy recordings."""
        from sealscope.diagnosis.commissioned.summary import summarise_machine

        return summarise_machine(self.healthy, self.rig, self.left_out)

    def read(self, path: str | os.PathLike[str], *, map: ChannelMap | None = None) -> Recording:
        """Read a log with the channel map, and the entries of `map` added to it, as `read_by_map`."""
        return read_by_map(path, self.channel_map, self.rate, map)

    def diagnose(
        self, recording: Recording | str | os.PathLike[str], *, false_alarm_probability: float = FALSE_ALARM_PROBABILITY
    ) -> Diagnosis:
        """Decide if a recording, or the log at a path, shows a leak, given the machine's healthy recordings.

        Arguments, result and errors are as in `sealscope.diagnose`; rig, baseline and repair limit are the machine's.
        """
        judged = recording if isinstance(recording, Recording) else self.read(recording)
        return diagnose(
            judged,
            self.healthy,
            false_alarm_probability=false_alarm_probability,
            rig=self.rig,
            limit=self.limit,
            file=None if isinstance(recording, Recording) else recording,
        )

    def with_healthy(self, recording: Recording, *, file: str = "recording") -> CommissionedMachine:
        """Return the machine with one more healthy recording.

        `file` is the name of the recording. Raises InputError if the recording is judged leaking, overlaps in time with
        a confirmed leak, has the samples of a known one, cannot be trusted, or if no detector can use it.
        """
        extended = self._with_recording(recording, file)
        if self.healthy:
            diagnosis = self.diagnose(recording)
            if diagnosis.verdict == LEAK:
                raise InputError(f"a healthy recording must not leak, got one that does: {diagnosis.reason} ({file})")
        start_s = start_seconds(recording, file)
        if start_s is not None and (leak := self._find_confirmed_leak(start_s, start_s + recording.duration)):
            raise InputError(f"a healthy recording must be from a time without a leak, got {leak} ({file})")
        return extended

    def _with_recording(self, recording: Recording, file: str) -> CommissionedMachine:
        """Return the machine with one more healthy recording, which is not tested for leaks (`with_healthy`).

        Raises InputError if the recording has the samples of a known one, cannot be trusted, or if no detector can use
        it.
        """
        rig, _ = assumed_rig(self.rig, recording)
        return self._with_summary(summarise_healthy(recording, rig, file))

    def with_holds(self, path: Path) -> CommissionedMachine:
        """Return the machine with the healthy hold tests of a file of `sealscope hold --format jsonl`.

        Raises InputError if one states no leak with its pressure or is known, UnreadableFile if the file cannot be
        read.
        """
        machine = self
        for result in read_hold_results(path):
            machine = machine._with_summary(summarise_result(result))
        return machine

    def _with_summary(self, summarised: SummarisedRecording) -> CommissionedMachine:
        """Return the machine with one more healthy recording; raise InputError if it has the samples of a known one."""
        if known := next((earlier for earlier in self.healthy if earlier.digest == summarised.digest), None):
            raise InputError(f"a healthy recording must be new, got the samples of {known.file} ({summarised.file})")
        return replace(self, healthy=_sort_by_date((*self.healthy, summarised)))

    def _find_confirmed_leak(self, start_s: float, end_s: float) -> JudgedAlarm | None:
        """Find a confirmed leak that was open between `start_s` and `end_s` [s since 1970]; None if there was none.

        An alarm judged "valid" or "repaired" is a confirmed leak, open from its onset until the next repair. A later
        judgement "invalid" of an alarm with the same name revokes it; one whose onset is after the confirmation is
        another alarm.
        """
        for k, leak in enumerate(self.alarms):
            is_revoked = any(
                later.mark == "invalid" and later.alarm == leak.alarm and later.onset_s <= leak.date_s
                for later in self.alarms[k + 1 :]
            )
            is_repaired = any(
                alarm.mark == "repaired" and leak.onset_s <= alarm.date_s <= start_s for alarm in self.alarms
            )
            if leak.mark != "invalid" and leak.onset_s <= end_s and not is_revoked and not is_repaired:
                return leak
        return None

    def since(self, start_s: float) -> CommissionedMachine:
        """Return a copy of the machine without the recordings and alarms from before `start_s` [s since 1970].

        Recordings of unknown time are dropped, too. Raises InputError if no recording remains.
        """
        healthy = tuple(
            recording for recording in self.healthy if recording.start_s is not None and recording.start_s >= start_s
        )
        if not healthy:
            raise InputError(f"a machine must keep a healthy recording, got none of {_format_date(start_s)} or later")
        alarms = tuple(alarm for alarm in self.alarms if alarm.onset_s >= start_s)
        return replace(self, healthy=healthy, alarms=alarms)

    def __repr__(self) -> str:
        return f"<CommissionedMachine {self.name}: {format_count(len(self.healthy), 'healthy recording')}>"

    def __str__(self) -> str:
        alarms = [f"  {'alarm':<14}{alarm}" for alarm in self.alarms]
        return "\n".join([self.summary.text(self.healthy, self.rig, self.limit), *alarms])


def read_by_map(
    path: str | os.PathLike[str], channel_map: ChannelMap, rate: float | None, added: ChannelMap | None = None
) -> Recording:
    """Read a log with the channel map of its machine or, if the log does not fit the map, without a map.

    An entry of the map whose column the log lacks is left out, and the history says so; the others, such as "auto",
    count. The entries of `added` come first, and must fit. `rate` is the sampling rate [Hz] of a log without a time
    column. If both attempts fail, the first UnreadableFile is raised.
    """
    file, extra = Path(path), as_mapping(added or {})
    columns = as_mapping(channel_map) | extra
    try:
        return read_file(file, Request(columns, rate, file.name, file, frozenset(columns.keys() - extra.keys())))
    except UnreadableFile as map_error:
        if not columns:
            raise
        try:
            return read(path, map=extra, rate=rate)
        except UnreadableFile:
            raise map_error from None


def recordings_in(paths: Iterable[str | os.PathLike[str]] | str | os.PathLike[str]) -> list[Path]:
    """List the files of recordings at one or several paths, each a file or a folder.

    In a folder, hidden files, files with a suffix in `NO_RECORDINGS`, results of Sealscope, and links that lead out of
    the folder are left out, the latter with a warning. Raises InputError if no file remains.
    """
    try:
        named_paths = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
        folders_and_files = [Path(path) for path in named_paths]
    except TypeError:
        raise InputError(f"recordings must be a folder's path or paths of files, got {paths!r:.60}") from None
    files: list[Path] = []
    for path in folders_and_files:
        if path.is_dir():
            visible = sorted(item for item in path.iterdir() if not item.name.startswith("."))
            candidates = (file for file in iter_inner_files(path, visible) if file.suffix.lower() not in NO_RECORDINGS)
            files += [file for file in candidates if not _is_own_output(file)]
        else:
            files.append(path)
    if not files:
        place = ", ".join(map(str, named_paths)) or "no path"
        raise InputError(f"a folder of recordings must hold one, got none ({place})")
    return files


def _is_own_output(file: Path) -> bool:
    """Return True if a file begins like a verdict or a trend of this program; False if it cannot be read."""
    try:
        with file.open("rb") as content:
            return _OWN_OUTPUT.match(content.read(200)) is not None
    except OSError:
        return False  # the error is reported when the recording is read


def summarise_healthy(recording: Recording, rig: Rig, file: str) -> SummarisedRecording:
    """Compute the summaries of a healthy recording by all detectors that can use the recording.

    `rig` states the sizes that the detectors assume, and `file` is the name of the recording. A detector that fails is
    left out, and its error is logged. Raises InputError if the recording cannot be trusted, or if no detector can use
    it.
    """
    from sealscope.diagnosis.commissioned.healthy_file import check_summary
    from sealscope.diagnosis.commissioned.summary import describe_recording

    with limit_threads():
        inspection = inspect_recording(recording)
        part = inspection.part
        if inspection.defect is not None:
            raise InputError(f"a healthy recording must be whole, got one that is not: {inspection.defect} ({file})")
        summaries = dict[str, Mapping[str, Any]]()
        with np.errstate(all="ignore"):
            for name, factory in detectors().items():
                try:
                    detector = factory(rig)
                    can_learn = hasattr(detector, "learn") and unusable_reason(detector, part) is None
                    if can_learn and (table := summary_table(detector, part)) is not None:  # type: ignore[arg-type]
                        check_summary(name, table)
                        summaries[name] = table
                except Exception as error:  # as in a diagnosis, a method that fails is left out
                    distribution = getattr(factory, "distribution", None)  # package of a plug-in, None if built in
                    log_failure(name, distribution, error)
        cylinder, is_stated = rig.cylinder, rig.states("cylinder.A_A", "cylinder.A_B")
        holds = judge_held_recording(recording, (cylinder.A_A, cylinder.A_B) if is_stated else None)
        if (hold := summarise_hold(holds)) is not None:
            summaries[hold.method] = hold.table()
        if not summaries:
            raise InputError(f"a healthy recording must have channels that a method can use, got none ({file})")
        if (levels := summary_table(HealthyLevels(), part)) is not None:  # friction, drifts and spectra
            summaries[HealthyLevels.name] = levels
        return SummarisedRecording(
            file,
            digest=inspection.digest,
            units={name: part.units[name] for name in part.channels},
            rate=part.rate,
            seconds=recording.duration,
            start_s=start_seconds(recording, file),
            summaries=summaries,
            about=describe_recording(recording, inspection),
            statistics=stored_surprisals(part, rig),
        )


@checked_call
def commission(
    paths: Iterable[str | os.PathLike[str]] | str | os.PathLike[str],
    *,
    rig: Rig | str | os.PathLike[str] | None = None,
    map: ChannelMap | None = None,
    rate: float | None = None,
    limit: str | None = None,
    name: str = "machine",
    keep: bool = False,
    progress: Callable[[int, int, str], None] = lambda done, total, file: None,
) -> CommissionedMachine:
    """Commission a machine: learn from its healthy recordings once, for every later diagnosis.

    Parameters
    ----------
    paths : path-like or sequence of path-like
        A folder of healthy recordings, or their files, or those with results of hold tests (JSON lines).
    rig : Rig, str or path-like, optional
        Stated parameters of the machine: a Rig, the name of a packaged rig or the path of a TOML file; by default
        nothing is stated, but the recordings may show the circuit (`infer_rig`).
    map : mapping of str to str, or "auto", optional
        Name of the column in the logs by channel, such as ``{"p_A": "PG_1"}``, as for `sealscope.read`; by default the
        map in the rig's file.
    rate : float, optional
        Sampling rate [Hz] of logs without a time column.
    limit : str, optional
        Smallest leak that calls for a repair: a flow (``"5 mL/min"``) or a creep speed of the piston (``"8 mm/min"``,
        the default).
    name : str, optional
        Name of the machine.
    keep : bool, optional
        True to keep recordings in which a comparison with the others finds a leak; by default they are left out.
    progress : callable, optional
        Function that is called with the number of steps done, their total and the recording's name, before each step:
        two a recording. An exception that it raises ends the commissioning.

    Returns
    -------
    CommissionedMachine
        The machine. Its method `diagnose` judges other recordings, and `sealscope.write_machine` saves it.

    Raises
    ------
    InputError, UnreadableFile
        There is no recording, none can be used, or `rig` or `limit` is not valid. If only some recordings cannot be
        used, or are copies, they are listed in `left_out` instead.

    Examples
    --------
    >>> import sealscope as ss
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as healthy:
    ...     for seed in (1, 2, 3):
    ...         ss.write(ss.simulate(duration="20 s", seed=seed), Path(healthy, f"run{seed}.nc"))
    ...     machine = ss.commission(healthy)
    >>> machine.diagnose(ss.simulate(duration="20 s", leak="0.02 L/min", seed=4)).verdict
    'leak'
    """
    RepairLimit.parse(limit)
    stated_rig, stated_map = None if rig is None else load_rig(rig), map
    if map is None:
        map = {} if stated_rig is None else stated_rig.channel_map
    machine = CommissionedMachine(name, (), stated_rig, map, rate, limit)
    problems: list[str] = []
    files = recordings_in(paths)
    path_of = dict(zip(_distinct_names(files), files, strict=True))  # by label
    recording_of = _read_into_memory(machine, path_of)  # by label, too
    machine = replace(machine, rig=infer_rig(stated_rig, list(recording_of.values())))
    n_steps = 2 * len(path_of)
    for number, (label, path) in enumerate(path_of.items()):
        progress(number, n_steps, label)
        try:
            if is_hold_results(path):
                machine = machine.with_holds(path)
                continue
            recording = recording_of.get(label) or machine.read(path)
            machine = machine._with_recording(recording, label)
        except SealscopeError as error:
            problems.append(str(error))
    if not machine.healthy:
        raise InputError(f"a machine must have a healthy recording that can be used, got none: {problems[0]}")
    recorded = [entry for entry in machine.healthy if entry.units]  # results of hold tests have no samples
    if stated_map is not None and recorded and not any(_fits_map(recording, stated_map) for recording in recorded):
        read(files[0], map=stated_map, rate=rate)  # raises the error of the map, without which the others were read

    labels = list(path_of)

    def judge(healthy: SummarisedRecording, reference: tuple[SummarisedRecording, ...]) -> Diagnosis:
        """Diagnose a healthy recording against others; its samples are read again unless they were kept in memory."""
        progress(len(labels) + labels.index(healthy.file), n_steps, healthy.file)
        recording = recording_of.get(healthy.file) or machine.read(path_of[healthy.file])
        return replace(machine, healthy=reference).diagnose(recording)

    remaining, leaking = cross_check(recorded, judge, keep)
    results = [entry for entry in machine.healthy if not entry.units]
    return replace(machine, healthy=_sort_by_date((*remaining, *results)), left_out=(*problems, *leaking))


def _sort_by_date(healthy: Iterable[SummarisedRecording]) -> tuple[SummarisedRecording, ...]:
    """Sort recordings by date; those of unknown date come first."""
    return tuple(sorted(healthy, key=lambda entry: (entry.start_s or 0.0, entry.file)))


def _read_into_memory(machine: CommissionedMachine, path_of: Mapping[str, Path]) -> dict[str, Recording]:
    """Read recordings by label, in order, as many as have less than `_MAX_SAMPLES` samples together, but at least one.

    Unreadable recordings are left out.
    """
    recordings, n_samples = dict[str, Recording](), 0
    for label, path in path_of.items():
        with suppress(SealscopeError):
            recording = machine.read(path)
            n_samples += len(recording) * len(recording.channels)
            if recordings and n_samples >= _MAX_SAMPLES:
                break
            recordings[label] = recording
    return recordings


def _fits_map(recording: SummarisedRecording, channel_map: ChannelMap) -> bool:
    """Return True if a recording has all channels that a map names, so that it was read with the map.

    The entries `REST` and `GROUP` and the time `t` name no channel; the map "auto" fits any recording.
    """
    return channel_map == "auto" or channel_map.keys() - {REST, GROUP, "t"} <= recording.units.keys()


def _distinct_names(paths: Sequence[Path]) -> list[str]:
    """Label recordings by the names of their files, or by the paths within their common folder if names are equal."""
    counts = Counter(path.name for path in paths)
    if len(counts) == len(paths):  # no two names are equal
        return list(counts)
    folder = os.path.commonpath([path.absolute().parent for path in paths])
    return [path.name if counts[path.name] == 1 else path.absolute().relative_to(folder).as_posix() for path in paths]
