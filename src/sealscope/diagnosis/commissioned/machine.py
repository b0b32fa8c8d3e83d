"""A commissioned machine: its rig, the map of its logs, and the lessons of its healthy recordings."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.commissioned.cross_check import find_outliers, with_remarks, without_leaks
from sealscope.diagnosis.commissioned.lessons_file import check_lesson
from sealscope.diagnosis.detectors.detector import failure, unusable
from sealscope.diagnosis.detectors.observation import rarities_of
from sealscope.diagnosis.detectors.registry import detectors
from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY, diagnose
from sealscope.diagnosis.inspection import inspected
from sealscope.diagnosis.learnt import Learnt, Lesson
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAK
from sealscope.diagnosis.verdict.machine import assumed_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError, SealscopeError, UnreadableFile
from sealscope.parameters import Rig, load_rig
from sealscope.recordings import read
from sealscope.recordings.formats.columns import ChannelMap, counted
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.recording import Recording
from sealscope.storage.folders import inner_files

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.summary import Summary

#: Suffixes of files in a folder that are no recordings: Sealscope's own pages and settings, and notes.
NO_RECORDINGS = frozenset(
    {".toml", ".lessons", ".html", ".htm", ".pdf", ".png", ".svg", ".md", ".jsonl", ".part", ".bak"}
)
#: How a trend, or a verdict, that was written beside the recordings begins.
_WRITTEN = re.compile(rb'\s*\{\s*"(verdict|file)":|file,time[, ]')


#: Samples that are kept in memory between learning and judging; recordings beyond are read again.
_KEPT_SAMPLES = 20_000_000

#: What a person may say of an alarm's leak.
Judgement = Literal["valid", "invalid", "repaired"]
JUDGEMENTS: tuple[Judgement, ...] = get_args(Judgement)


class JudgedAlarm(NamedTuple):
    """A person's judgement of an alarm of the monitor.

    `alarm`: its name, "" for a repair without one; `mark`, said at `date_s`; of a leak since `onset_s` [s since 1970];
    `leak_lpm` [L/min] and `reason`, where they are known.
    """

    alarm: str
    mark: str
    date_s: float
    onset_s: float
    leak_lpm: float | None = None
    reason: str = ""

    def __str__(self) -> str:
        leak = "" if self.leak_lpm is None else f", {self.leak_lpm:.2g} L/min"
        onset_text = "" if self.mark == "invalid" else f", since {_date(self.onset_s)}{leak}"
        return f"{self.alarm} {self.mark} {_date(self.date_s)}{onset_text}{self.reason and f' ({self.reason})'}".strip()


class Origin(NamedTuple):
    """The file of a loaded machine, and hashes of its parts, to notice changes by others."""

    path: Path
    parts: frozenset[bytes]


def _is_taken_back(word: JudgedAlarm, later: Iterable[JudgedAlarm]) -> bool:
    """Test whether a later word calls the alarm invalid; a new alarm of the same name begins after this word."""
    answers = (answer for answer in later if answer.alarm == word.alarm and answer.onset_s <= word.date_s)
    return any(answer.mark == "invalid" for answer in answers)


def _date(moment: float) -> str:
    return datetime.fromtimestamp(moment, UTC).isoformat(" ", "minutes").removesuffix("+00:00")


@dataclass(frozen=True)
class CommissionedMachine:
    """A commissioned machine.

    Parameters
    ----------
    name : str
        Name of the machine.
    healthy : tuple of Learnt
        What each healthy recording has taught, in the order of their dates.
    rig : Rig, optional
        What is stated of the machine; None: nothing.
    channel_map : mapping of str to str, or "auto", optional
        Channel to column of its logs.
    rate : float, optional
        Sampling rate [Hz] of logs without a time column.
    limit : str, optional
        Leak from which it is to be repaired, such as "5 mL/min".
    left_out : tuple of str, optional
        Recordings that could not be used, each with the reason.
    alarms : tuple of JudgedAlarm, optional
        What persons said of the monitor's alarms, and repairs.
    origin : Origin, optional
        The file that it was loaded from.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.CommissionedMachine("actuator 7", ())
    <CommissionedMachine actuator 7: 0 healthy recordings>
    """

    name: str
    healthy: tuple[Learnt, ...]
    rig: Rig | None = None
    channel_map: ChannelMap = field(default_factory=dict)
    rate: float | None = None
    limit: str | None = None
    left_out: tuple[str, ...] = ()
    alarms: tuple[JudgedAlarm, ...] = ()
    origin: Origin | None = field(default=None, repr=False, compare=False)

    @cached_property
    def summary(self) -> Summary:
        """Summary of the machine, its sensors and the smallest leak, from the healthy recordings."""
        from sealscope.diagnosis.commissioned.summary import summarised

        return summarised(self.healthy, self.rig, self.left_out)

    def read(self, path: str | os.PathLike[str]) -> Recording:
        """Read a log of the machine by its map; a recording of Sealscope's own is read as it is."""
        return read_of_machine(path, self.channel_map, self.rate)

    def diagnose(
        self,
        recording: Recording | str | os.PathLike[str],
        *,
        false_alarm_probability: float = FALSE_ALARM_PROBABILITY,
    ) -> Diagnosis:
        """Decide whether oil bypasses the piston in a recording, or in its file, against the healthy ones.

        Arguments, result and errors as for `sealscope.diagnose`; rig, baseline and limit are the machine's.
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

    def with_healthy(self, recording: Recording, *, file: str = "recording", checksum: str = "") -> CommissionedMachine:
        """Return the machine with one more healthy recording.

        Raises InputError where it is judged leaking, or a person found a leak then, or it is known already, or cannot
        be trusted.
        """
        added = self._add(recording, file, checksum)
        if self.healthy and (result := self.diagnose(recording)).verdict == LEAK:
            raise InputError(f"a healthy recording must not leak, got one that does: {result.reason} ({file})")
        start_s = start_seconds(recording, file)
        if start_s is not None and (leak := self._find_leak(start_s, start_s + recording.duration)) is not None:
            raise InputError(f"a healthy recording must be of a time without a leak, got {leak} ({file})")
        return added

    def _add(self, recording: Recording, file: str, checksum: str) -> CommissionedMachine:
        """Return the machine with one more recording, whether it leaks or not."""
        learnt = learn(recording, assumed_rig(self.rig, recording)[0], file, checksum)
        if copy := next((earlier for earlier in self.healthy if earlier.digest == learnt.digest), None):
            raise InputError(f"a healthy recording must be new, got the samples of {copy.file} ({file})")
        healthy = sorted((*self.healthy, learnt), key=lambda lesson: (lesson.start_s or 0.0, lesson.file))
        return replace(self, healthy=tuple(healthy))

    def _find_leak(self, start_s: float, end_s: float) -> JudgedAlarm | None:
        """Find the alarm of a leak found by a person and not repaired in a time [s since 1970]; None without one."""
        repairs = [alarm.date_s for alarm in self.alarms if alarm.mark == "repaired"]
        words = enumerate(self.alarms, 1)
        alarms = (word for k, word in words if word.mark != "invalid" and not _is_taken_back(word, self.alarms[k:]))
        leaks = (word for word in alarms if word.onset_s <= end_s)
        return next((leak for leak in leaks if not any(leak.onset_s <= repair <= start_s for repair in repairs)), None)

    def since(self, start_s: float) -> CommissionedMachine:
        """Return the machine without the recordings of before a repair, `start_s` [s since 1970].

        Raises InputError where none is left.
        """
        left = tuple(
            recording for recording in self.healthy if recording.start_s is not None and recording.start_s >= start_s
        )
        if not left:
            raise InputError(f"a machine must keep a healthy recording, got none of {_date(start_s)} or later")
        alarms = tuple(alarm for alarm in self.alarms if alarm.onset_s >= start_s)
        return replace(self, healthy=left, alarms=alarms)

    def __repr__(self) -> str:
        return f"<CommissionedMachine {self.name}: {counted(len(self.healthy), 'healthy recording')}>"

    def __str__(self) -> str:
        alarms = [f"  {'alarm':<14}{alarm}" for alarm in self.alarms]
        return "\n".join([self.summary.text(self.healthy, self.rig), *alarms])


def read_of_machine(path: str | os.PathLike[str], channel_map: ChannelMap, rate: float | None) -> Recording:
    """Read a log by the map of its machine, or without the map if it lacks the map's columns.

    Raises UnreadableFile with what is wrong by the map, where neither can be read.
    """
    if not channel_map:
        return read(path, rate=rate)
    try:
        return read(path, map=channel_map, rate=rate)
    except UnreadableFile as unmapped:
        try:
            return read(path, rate=rate)
        except UnreadableFile:
            raise unmapped from None


def recordings_in(paths: Iterable[str | os.PathLike[str]] | str | os.PathLike[str]) -> list[Path]:
    """List the files of recordings of a path, of several, or of a folder; InputError where there is none.

    A link in a folder that leads out of it is left out, and a warning says so: name it to have it read.
    """
    try:
        named = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
        entries = [Path(path) for path in named]
    except TypeError:
        raise InputError(f"recordings must be a folder's path or paths of files, got {paths!r:.60}") from None
    files: list[Path] = []
    for path in entries:
        if path.is_dir():
            contents = inner_files(path, sorted(item for item in path.iterdir() if not item.name.startswith(".")))
            files += [file for file in contents if file.suffix.lower() not in NO_RECORDINGS and not _is_written(file)]
        else:
            files.append(path)
    if not files:
        raise InputError(f"a folder of recordings must hold one, got none ({', '.join(map(str, named)) or 'no path'})")
    return files


def _is_written(file: Path) -> bool:
    try:
        with file.open("rb") as opened:
            return _WRITTEN.match(opened.read(200)) is not None
    except OSError:
        return False  # it is read again, and the error then is named


def learn(recording: Recording, rig: Rig, file: str, checksum: str = "") -> Learnt:
    """Return the lessons of a healthy recording for every detector.

    Raises InputError where it cannot be trusted, or teaches nothing.
    """
    from threadpoolctl import threadpool_limits

    from sealscope.diagnosis.commissioned.summary import about_recording

    inspection = inspected(recording)
    part = inspection.part
    if inspection.defect is not None:
        raise InputError(f"a healthy recording must be whole, got one that is not: {inspection.defect} ({file})")
    lessons: dict[str, Lesson] = {}
    with np.errstate(all="ignore"), threadpool_limits(limits=1):
        for name, factory in detectors().items():
            try:
                detector = factory(rig)
                if hasattr(detector, "learn") and unusable(detector, part) is None:
                    lesson = detector.learn(part)
                    if lesson is not None:
                        check_lesson(name, lesson)
                        lessons[name] = lesson
            except Exception as error:  # as in a diagnosis, a method that fails is left out
                failure(name, getattr(factory, "distribution", None), error)
    if not lessons:
        raise InputError(f"a healthy recording must hold channels that a method reads, got none such ({file})")
    units = {name: part.units[name] for name in part.channels}
    description = {"sha256": checksum, **about_recording(recording, inspection)}
    start = start_seconds(recording, file)
    rarities = dict(rarities_of(part, rig))
    return Learnt(file, inspection.digest, units, part.rate, recording.duration, start, lessons, description, rarities)


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
) -> CommissionedMachine:
    """Commission a machine: learn from its healthy recordings once, for every later diagnosis.

    Parameters
    ----------
    paths : path-like or sequence of path-like
        A folder of healthy recordings, or their files.
    rig : Rig, str or path-like, optional
        What is stated of the machine, as for `sealscope.diagnose`.
    map : mapping of str to str, or "auto", optional
        Channel to column of the logs, as for `sealscope.read`; by default that of the rig's file.
    rate : float, optional
        Sampling rate [Hz] of logs without a time column.
    limit : str, optional
        Leak from which the machine is to be repaired, such as ``"5 mL/min"``.
    name : str, optional
        Name of the machine.
    keep : bool, optional
        Whether recordings that the others call leaking are kept; by default they are left out.

    Returns
    -------
    CommissionedMachine
        Its `diagnose` judges other recordings; `sealscope.write_machine` keeps it.

    Raises
    ------
    InputError, UnreadableFile
        A recording cannot be read or trusted, two hold the same samples, or an argument breaks a rule.

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
    RepairLimit.of(limit)
    known = None if rig is None else load_rig(rig)
    channel_map = map if map is not None else {} if known is None else known.channel_map
    machine, problems = CommissionedMachine(name, (), known, channel_map, rate, limit), list[str]()
    places, recordings, samples = dict[str, Path](), dict[str, Recording](), 0
    for path in recordings_in(paths):
        try:
            recording = machine.read(path)
            machine = machine._add(recording, path.name, checksum_of(path))
        except SealscopeError as error:
            problems.append(str(error))
            continue
        places[path.name], samples = path, samples + len(recording) * len(recording.channels)
        if samples < _KEPT_SAMPLES:
            recordings[path.name] = recording
    if not machine.healthy:
        raise InputError(f"a machine must have a healthy recording that can be used, got none: {problems[0]}")
    machine = replace(machine, left_out=tuple(problems))

    def judge(learnt: Learnt, rest: tuple[Learnt, ...]) -> Diagnosis:
        recording = recordings.get(learnt.file) or machine.read(places[learnt.file])
        return replace(machine, healthy=rest).diagnose(recording)

    outliers = find_outliers(machine.healthy, judge)
    healthy, leaking = (machine.healthy, ()) if keep else without_leaks(machine.healthy, outliers)
    return replace(machine, healthy=with_remarks(healthy, outliers), left_out=(*machine.left_out, *leaking))


def checksum_of(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    from hashlib import file_digest

    with Path(path).open("rb") as file:
        return file_digest(file, "sha256").hexdigest()
