"""What the screens of the workbench do, each by functions that a script can call.

The page (`site`) asks an instance for plain values; `replay` uses one without a browser.
"""

from __future__ import annotations

import itertools
import math
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from sealscope.app.jobs import Job, JobQueue
from sealscope.app.logs import (
    VERSION,
    balance_source,
    channels_source,
    columns_source,
    describe_log,
    describe_recording,
    file_stamp,
    is_hidden,
    propose_map,
    read_for,
)
from sealscope.app.session import (
    DROPPED,
    MARKS,
    MENDED,
    REPORTS,
    MendedLog,
    ReachedVerdict,
    SessionFolder,
    SessionMachine,
)
from sealscope.app.tables import MappedTable, Source, TableCache, mean_rates
from sealscope.app.words import cover_duty, format_date, format_duty, format_length
from sealscope.diagnosis.commissioned.machine import CommissionedMachine, commission
from sealscope.diagnosis.commissioned.machine_file import read_machine, write_machine
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.hold.hold_test import hold_test
from sealscope.diagnosis.hold.result import HoldCurve, HoldResult
from sealscope.diagnosis.trend.machine_trend import Trend, trend
from sealscope.diagnosis.trend.reading import LeakReading, estimate_reading
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine, states_rig
from sealscope.errors import InputError, SealscopeError
from sealscope.recordings.formats.columns import GROUP
from sealscope.recordings.header import file_seconds, start_seconds
from sealscope.recordings.mending import StatedLayout, mend, preview_text
from sealscope.recordings.recording import Recording
from sealscope.reporting.hold import hold_text, write_hold_page
from sealscope.reporting.messages import short_text
from sealscope.reporting.page import report
from sealscope.reporting.schematic import build_circuit, draw_circuit
from sealscope.reporting.trend.page import write_trend_page
from sealscope.reporting.trend.text import headline
from sealscope.storage.folders import make_folder
from sealscope.storage.plain_values import to_plain
from sealscope.units import BAR, LITRE_PER_MINUTE, parse_quantity

#: How often the folders of logs are listed anew [s].
_LIST_S = 2.0
#: Time for which a request waits for the first rows of a table [s].
_WAIT_S = 2.0
#: Shortest time over which the flows of the balance are averaged [s].
_FLOW_S = 0.2
#: Most pauses of the reading of all logs for the one that somebody looks at, and their length [s].
_MAX_PAUSES, _PAUSE_S = 200, 0.05
#: A decimal comma, as in `5,2 mL/min`.
_COMMA = re.compile(r"(?<=\d),(?=\d)")
#: Texts of a machine that may be changed, of those the ones with a decimal comma.
_TEXTS = ("name", "rig", "bore", "rod", "rods", "displacement", "limit")
_QUANTITIES = ("bore", "rod", "displacement", "limit")


def to_point(text: str) -> str:
    """Replace a decimal comma, as in `5,2 mL/min`, by a point."""
    return _COMMA.sub(".", text.strip()) if text.count(",") == 1 else text.strip()


def areas_of(bore: str, rod: str | None, rods: str) -> tuple[str, ...]:
    """Compute the piston's areas, as texts, from the diameters of bore and rod; `rods`: sides with a rod.

    Area = pi / 4 (bore^2 - rod^2) on a side with a rod.
    """
    diameter, inner = (
        parse_quantity(bore, "m", name="bore"),
        0.0 if rod is None else parse_quantity(rod, "m", name="rod"),
    )
    if not 0.0 <= inner < diameter:
        raise InputError(f"a rod must be thinner than the bore, got {rod} in {bore}")
    areas = [0.25e6 * math.pi * (diameter**2 - (inner**2 if side in rods else 0.0)) for side in "AB"]
    texts = [f"{area:.5g} mm^2" for area in areas]
    return (texts[0],) if texts[0] == texts[1] else tuple(texts)


class Workbench:
    """The state of a session's screens: the description of its logs, work in the background, and results.

    `version` grows with each change, so that a page asks for what is new.
    """

    def __init__(self, folder: SessionFolder, cache: TableCache | None = None) -> None:
        folder.open()
        self.folder, self.cache = folder, cache or TableCache()
        self._versions, self.version = itertools.count(1), 0
        self._lock = threading.RLock()
        self._rows: dict[str, dict[str, Any]] = {}
        self._problems: list[tuple[str, str]] = []
        self._listed, self._stamps = 0.0, dict[str, str]()
        self._machines: dict[str, CommissionedMachine] = {}
        self._results: dict[tuple[str, str], dict[str, Any]] = {}
        self._trends: dict[str, Trend] = {}
        self.reading, self.work = (JobQueue(name, self.note_change) for name in ("reading", "work"))

    def note_change(self) -> None:
        """Count a change."""
        self.version = next(self._versions)

    def close(self) -> None:
        """End the work in the background."""
        self.reading.close()
        self.work.close()

    # ---- logs

    def refresh(self, *, force: bool = False) -> None:
        """List the logs of the session, and describe those that are new or have changed, in the background."""
        with self._lock:
            if not force and time.monotonic() - self._listed < _LIST_S:
                return
            self._listed = time.monotonic()
            session = self.folder.read()
            keys, problems = self.folder.list_keys()
            maps = repr([(m.map, m.rate) for m in session.machine])
            new = []
            for key in keys:
                path = self.folder.path_of(key)
                try:
                    stamp = f"{file_stamp(path)}|{maps}"
                    status = path.stat()
                except OSError as error:
                    stamp, status = f"{error}", None
                if self._stamps.get(key) == stamp:
                    continue
                self._stamps[key] = stamp
                row = {"key": key, "name": Path(key).name, "size": status.st_size if status else 0, "state": "waiting"}
                row |= {
                    "changed_s": status.st_mtime if status else None,
                    "mended": str(path) != str(self.folder.folder / key),
                }
                self._set_row(key, self._rows.get(key, {}) | row)
                new.append(key)
            gone = [key for key in self._rows if key not in set(keys)]
            for key in gone:
                self._rows.pop(key)
                self._stamps.pop(key, None)
            if gone or problems != self._problems:
                self.note_change()
            self._problems = problems
        if new:
            self.reading.submit("read logs", f"{len(new)} logs", lambda job: self._describe(job, new))

    def _set_row(self, key: str, row: dict[str, Any]) -> None:
        self.note_change()
        words = {"date": format_date(row)}
        if row["state"] == "read":
            words |= {"length": format_length(row["seconds"]), "duty_words": format_duty(row)}
        self._rows[key] = row | words | {"version": self.version}

    def _describe(self, job: Job, keys: Sequence[str]) -> None:
        """Describe logs, one after the other."""
        for number, key in enumerate(keys):
            job.progress(number, len(keys), Path(key).name)
            for _ in range(_MAX_PAUSES):  # what somebody looks at goes first
                if self.cache.n_filling == 0:
                    break
                time.sleep(_PAUSE_S)
            with self._lock:
                if key not in self._rows:
                    continue
            described = describe_log(self.folder.path_of(key), self.folder.read().machine)
            with self._lock:
                if key in self._rows:
                    self._set_row(key, self._rows[key] | {"error": ""} | described)
        job.progress(len(keys), len(keys))

    def state(self, since: int = -1) -> dict[str, Any]:
        """Return the session's state: machines, jobs, and the rows of logs that changed after the version `since`."""
        self.refresh()
        session = self.folder.read()
        with self._lock:
            version = self.version
            rows = [row for row in self._rows.values() if row["version"] > since]
            keys = list(self._rows)
            read = [row for row in self._rows.values() if row["state"] == "read"]
        return {
            "version": version,
            "folder": str(self.folder.folder),
            "machines": [asdict(machine) | {"cover": cover_duty(read, machine.healthy)} for machine in session.machine],
            "sources": list(session.sources),
            "keys": keys,
            "rows": rows,
            "problems": self._problems,
            "jobs": [job.as_dict() for queue in (self.reading, self.work) for job in queue.jobs()],
        }

    def open_paths(self, paths: Sequence[str]) -> None:
        """Add folders or logs by their paths, which are taken from the session's folder; ~ is the user's."""
        found = []
        for text in paths:
            if not text.strip() or "\0" in text or len(text) > 4000:
                raise InputError(f"a path must name a folder or a log, got {text[:60]!r}")
            try:
                path = self.folder.folder / Path(text.strip().strip('"')).expanduser()
                exists = path.exists()
            except (OSError, RuntimeError, ValueError) as error:
                raise InputError(f"a path must be readable, got: {error}") from None
            if not exists:
                raise InputError(f"a path must name a folder or a log, got none there ({path})")
            found.append(path)
        self.folder.add_sources(found)
        self.refresh(force=True)

    def close_source(self, source: str) -> None:
        """Remove a folder or log from the session; the files stay."""
        self.folder.update(
            lambda session: replace(session, sources=tuple(key for key in session.sources if key != source))
        )
        self.refresh(force=True)

    def find_log(self, key: str) -> Path:
        """Return the path of a log of the session; raise InputError for any other."""
        with self._lock:
            if key in self._rows:
                return self.folder.path_of(key)
        if key in self.folder.list_keys()[0]:
            return self.folder.path_of(key)
        raise InputError(f"a log must be one of the session, got {key[:80]!r}")

    # ---- dropped files

    def _part_of(self, name: str, size: int) -> tuple[Path, Path]:
        """Return the path of a dropped file, and of the part that has come; check name and size."""
        if is_hidden(name) or len(name.encode("utf-8", "replace")) > 200:
            raise InputError(f"a dropped file must have a plain name of at most 200 bytes, got {name[:80]!r}")
        if not 0 < size <= 2**40:
            raise InputError(f"a dropped file must have 1 byte to 1 TiB, got {size}")
        folder = self.folder.folder / DROPPED
        if folder.is_symlink():
            raise InputError(f"the folder of dropped files must not be a link ({folder})")
        make_folder(folder)
        return folder / name, folder / f".{name}.{size}.part"

    def received(self, name: str, size: int) -> int:
        """Count the bytes of a dropped file that have come."""
        target, part = self._part_of(name, size)
        if target.exists() and target.stat().st_size == size and not part.exists():
            return size
        return part.stat().st_size if part.exists() else 0

    def receive(self, name: str, size: int, offset: int, data: bytes) -> int:
        """Append a piece of a dropped file at its offset; return how many bytes have come.

        Raises InputError for another offset. The last piece makes the file one of the session.
        """
        target, part = self._part_of(name, size)
        with self._lock:
            if part.is_symlink() or target.is_symlink():
                raise InputError(f"a dropped file must not replace a link, got {name!r}")
            known = self.received(name, size)
            if known != offset or offset + len(data) > size:
                raise InputError(f"a piece must begin at {known} and end by {size}, got {offset} and {len(data)} bytes")
            with part.open("ab") as file:
                file.write(data)
            known += len(data)
            if known == size:
                part.replace(target)
                self.folder.add_sources([target])
                self.refresh(force=True)
        return known

    # ---- layout of a log

    def preview(self, key: str, layout: Mapping[str, Any]) -> dict[str, Any]:
        """Show the first lines of a log, and how they are read with a stated layout."""
        preview = preview_text(self.folder.folder / self._check_log(key), StatedLayout(**layout))
        return to_plain(preview)  # type: ignore[no-any-return]

    def _check_log(self, key: str) -> str:
        self.find_log(key)
        return key

    def mend_log(self, key: str, layout: Mapping[str, Any]) -> int:
        """Rewrite a log with a stated layout, and use the new file in place of the log."""
        source = self.folder.folder / self._check_log(key)
        folder = self.folder.folder / MENDED
        make_folder(folder)
        stated = asdict(StatedLayout(**layout))
        target = folder / f"{Path(key).stem[:150]}.csv"
        used_targets = {log.target for log in self.folder.read().mended if log.file != key}
        for number in itertools.count(2):
            if self.folder.key_of(target) not in used_targets:
                break
            target = folder / f"{Path(key).stem[:150]} ({number}).csv"
        n_rows = mend(source, target, **stated)
        log = MendedLog(file=key, target=self.folder.key_of(target), **stated)
        self.folder.update(
            lambda session: replace(session, mended=(*(m for m in session.mended if m.file != key), log))
        )
        self.refresh(force=True)
        return n_rows

    # ---- machines and their channels

    def change_machine(self, name: str, values: Mapping[str, Any]) -> SessionMachine:
        """Change what is stated of a machine, or add one; decimal commas are read, and areas follow from the bore."""
        unknown = set(values) - {*_TEXTS, "map", "rate", "area", "repairs", "hold"}
        if unknown:
            raise InputError(
                f"a machine has {', '.join(_TEXTS)}, map, rate, area, repairs, hold, got {min(unknown)[:60]!r}"
            )
        changed: dict[str, Any] = {}
        for text_name in _TEXTS:
            if text_name in values:
                text = str(values[text_name] or "").strip()
                changed[text_name] = (to_point(text) if text_name in _QUANTITIES else text) or None
        if "rods" in changed and changed["rods"] not in ("A", "B", "AB"):
            raise InputError(f"a rod must leave side A, B or AB, got {str(changed['rods'])[:40]!r}")
        if "rate" in values:
            rate = str(values["rate"] or "").strip()
            changed["rate"] = parse_quantity(to_point(rate), "Hz", name="rate") if rate else None
        if "map" in values:
            columns = values["map"]
            if not isinstance(columns, dict) or not all(isinstance(v, str) for v in columns.values()):
                raise InputError("a map must be a table of channels and columns")
            changed["map"] = {str(channel): column.strip() for channel, column in columns.items() if column.strip()}
        if "area" in values:
            changed["area"] = tuple(to_point(str(text)) for text in values["area"] or () if str(text).strip())
        if "hold" in values:
            stated = {str(field): to_point(str(text or "")) for field, text in dict(values["hold"]).items()}
            changed["hold"] = {field: text for field, text in stated.items() if text}
        if "repairs" in values:
            changed["repairs"] = tuple(map(str, values["repairs"]))

        def apply(session: Any) -> Any:
            known = next((machine for machine in session.machine if machine.name == name), None)
            machine = replace(known or SessionMachine(name=name), **changed)
            if machine.bore and "area" not in values:
                machine = replace(machine, area=areas_of(machine.bore, machine.rod, machine.rods))
            elif "area" in values:
                machine = replace(machine, bore=None, rod=None)
            return session.with_machine(machine, name)

        session = self.folder.update(apply)
        if set(changed) - {"hold", "repairs"}:  # the others change what is read and how it is judged
            with self._lock:
                self._machines.pop(name, None)
                self._results = {place: result for place, result in self._results.items() if place[0] != name}
        self.note_change()
        return session.find_machine(changed.get("name") or name)

    def remove_machine(self, name: str) -> None:
        """Remove a machine from the session; its file stays."""
        self.folder.update(
            lambda session: replace(session, machine=tuple(m for m in session.machine if m.name != name))
        )
        self.note_change()

    def propose(self, name: str, key: str) -> dict[str, Any]:
        """Propose a map of a log's columns for a machine, and name the actuators of the log if there are several."""
        machine = self.folder.read().find_machine(name)
        proposed, groups, problem = propose_map(self.find_log(key), machine.rate, machine.map.get(GROUP))
        return {"map": proposed, "groups": groups if len(groups) > 1 else (), "problem": problem}

    def table(self, kind: str, key: str, name: str = "", stated_time: str | None = None) -> MappedTable:
        """Open a table of a log: its "columns", the "channels" of a machine, or its "balance" of flows or "volumes"."""
        path = self.find_log(key)
        machine = self.folder.read().find_machine(name) if name else SessionMachine(name="machine")
        stamp = f"{VERSION}|{'balance' if kind == 'volumes' else kind}|{file_stamp(path)}"

        def read() -> Recording:
            return read_for(machine, path)

        source: Source
        if kind == "columns":
            time_column = machine.map.get("t") if stated_time is None else stated_time or None
            source = columns_source(path, time_column, machine.rate)
            stamp += f"|{time_column}|{machine.rate}"
        elif kind == "channels":
            source = channels_source(read)
            stamp += f"|{machine.channel_map}|{machine.rate}"
        elif kind in ("balance", "volumes"):
            source = balance_source(read, machine.build_rig())
            stamp += f"|{machine.channel_map}|{machine.rate}|{machine.rig}|{machine.area}|{machine.displacement}"
        else:
            raise InputError(f"a table must be columns, channels, balance or volumes, got {kind[:40]!r}")
        return self.cache.open(stamp, source, _WAIT_S)

    def window(
        self,
        kind: str,
        key: str,
        name: str,
        indices: Sequence[int],
        begin: float | None,
        end: float | None,
        pixels: int,
    ) -> dict[str, Any]:
        """Return a window of a table (`MappedTable.window`), of the flows in a balance as means, with its headings."""
        table = self.table(kind, key, name)
        state: dict[str, Any] = {"names": table.names, "complete": table.complete}
        state |= {"error": table.error, "count": table.count}
        if not indices:  # what is asked for once, before the first window
            state["about"] = table.details
        if any(not 0 <= index < len(table.names) for index in indices):  # as of a map that has changed
            text = f"a column must be one of {len(table.names)}, got {max(indices)}"
            return {"t": [], "lines": [], "first": 0.0, "last": 0.0} | state | {"error": table.error or text}
        if kind == "balance":
            return mean_rates(table, indices, begin, end, pixels, _FLOW_S) | state
        return table.window(indices, begin, end, pixels) | state

    def describe_channels(self, name: str, key: str) -> dict[str, Any]:
        """Describe a log as read by a machine's map: channels with their units, findings, duty and history."""
        machine = self.folder.read().find_machine(name)
        recording = read_for(machine, self.find_log(key))
        columns = recording.provenance.get("columns")
        row = describe_recording(recording, Path(key).name, with_places=True)
        for finding in row["findings"]:
            finding["places"] = finding["places"] or [t for t in [finding["t"]] if t is not None]
        row["units"] = {
            channel: recording.unit_in_log(channel) or recording.units[channel] for channel in recording.channels
        }
        row["columns"] = dict(columns) if isinstance(columns, Mapping) else {}
        row["history"] = list(recording.history)[:60]
        return row

    def draw_machine(self, name: str, channels: Sequence[str]) -> str:
        """Draw the machine as SVG, with its stated sizes and its recorded `channels`."""
        machine = self.folder.read().find_machine(name)
        rig = machine.build_rig()
        if rig is None or states_rig(rig):
            return draw_circuit(build_circuit(rig, channels), channels)
        sizes = (rig.cylinder.A_A, rig.cylinder.A_B)
        stated = {
            "area_stated": rig.states("cylinder.A_A", "cylinder.A_B"),
            "displacement_stated": rig.states("pump.q_b"),
        }
        assumed = AssumedMachine(rig.name, "call", sum(sizes) / 2.0, rig.pump.q_b, areas=sizes, **stated)
        return draw_circuit(build_circuit(None, channels, assumed), channels)

    # ---- healthy days

    def mark(self, name: str, keys: Sequence[str], mark: str | None) -> None:
        """Mark logs of a machine as healthy, rejected or suspect, or take their marks away."""
        if mark is not None and mark not in MARKS:
            raise InputError(f"a mark must be one of {', '.join(MARKS)}, got {mark[:40]!r}")
        for key in keys:
            self.find_log(key)

        def apply(session: Any) -> Any:
            machine = session.find_machine(name)
            for key in keys:
                machine = machine.mark_file(key, mark)
            return session.with_machine(machine)

        self.folder.update(apply)
        self.note_change()

    def _file_of(self, machine: SessionMachine) -> Path:
        return self.folder.folder / f"{machine.name}.toml"

    def healthy_paths(self, machine: SessionMachine) -> list[Path]:
        """List the paths of a machine's healthy logs, in the order of the session."""
        keys = self.folder.list_keys()[0]
        return [self.folder.path_of(key) for key in keys if key in machine.healthy]

    def commission(self, name: str, progress: Callable[[int, int, str], None] = lambda *_: None) -> CommissionedMachine:
        """Commission a machine from its healthy logs, and write its file beside the session's."""
        stated = self.folder.read().find_machine(name)
        paths = self.healthy_paths(stated)
        if not paths:
            raise InputError("a machine needs healthy logs: tick at least one, better five of different days")
        machine = commission(
            paths,
            rig=stated.build_rig(),
            map=stated.channel_map,
            rate=stated.rate,
            limit=stated.limit,
            name=stated.name,
            progress=progress,
        )
        write_machine(machine, self._file_of(stated))
        with self._lock:
            self._machines[name] = read_machine(self._file_of(stated))
            self._results = {place: result for place, result in self._results.items() if place[0] != name}
        self.folder.update(lambda session: session.with_machine(replace(session.find_machine(name), commissioned=True)))
        self.note_change()
        return machine

    def machine(self, name: str) -> CommissionedMachine | None:
        """Return the commissioned machine, from its file if it was saved before; None if it is not commissioned."""
        with self._lock:
            if name not in self._machines:
                stated = self.folder.read().find_machine(name)
                if not stated.commissioned or not self._file_of(stated).exists():
                    return None
                self._machines[name] = read_machine(self._file_of(stated))
            return self._machines[name]

    def learnt(self, name: str) -> dict[str, Any]:
        """Return the summary of a commissioned machine: its text, the smallest leak, and the days that stand out."""
        machine = self.machine(name)
        if machine is None:
            return {"known": False}
        summary = machine.summary
        smallest, count, size, half = summary.smallest, len(machine.healthy), "not known", ""
        if smallest is not None:
            share = f"{100.0 * smallest.share:.2g} % of the pump’s flow"
            size = share if smallest.lpm is None else f"{1000.0 * smallest.lpm:.2g} mL/min, {share}"
            half = "More healthy days alone do not halve this: twice the load does."
            if smallest.halved_by is not None:
                half = f"{smallest.halved_by * count} healthy days instead of {count} would halve this."
        problems = {recording.file: list(recording.about.get("wrong", ())) for recording in machine.healthy}
        return {  # type: ignore[no-any-return]
            "known": True,
            "file": self._file_of(self.folder.read().find_machine(name)).name,
            "text": str(machine),
            "smallest": to_plain(summary.smallest),
            "size": size,
            "half": half,
            "count": len(machine.healthy),
            "problems": {file: texts for file, texts in problems.items() if texts},
            "left_out": list(machine.left_out),
        }

    # ---- verdicts

    def judge(self, name: str, key: str) -> Diagnosis:
        """Judge a log of a machine, against its healthy ones if it is commissioned, and keep the verdict."""
        stated = self.folder.read().find_machine(name)
        path = self.find_log(key)
        machine = self.machine(name)
        recording = machine.read(path) if machine is not None else read_for(stated, path)
        if machine is not None:
            diagnosis = replace(machine.diagnose(recording), file=str(path))
        else:
            diagnosis = diagnose(recording, rig=stated.build_rig(), limit=stated.limit, file=path)
        result = diagnosis.as_dict() | {
            "text": short_text(diagnosis),
            "key": key,
            "against": len(machine.healthy) if machine else 0,
        }
        result |= {"limit_lpm": to_plain(diagnosis.limit_lpm), "start_s": start_seconds(recording, path.name)}
        course = diagnosis.course
        if course is not None:
            lines = {name: getattr(course, name).tolist() for name in ("t", "lpm", "low", "high")}
            result["course"] = lines | {"whole": course.whole}
        with self._lock:
            self._results[name, key] = to_plain(result)

        def keep(session: Any) -> Any:
            known = session.find_machine(name)
            earlier = next((verdict for verdict in known.verdicts if verdict.file == key), None)
            reached = ReachedVerdict(
                file=key, verdict=diagnosis.verdict, summary=diagnosis.summary, leak_lpm=to_plain(diagnosis.leak_lpm),
                bound_lpm=to_plain(diagnosis.bound_lpm), opinion="" if earlier is None else earlier.opinion,
            )  # fmt: skip
            return session.with_machine(known.keep_verdict(reached))

        self.folder.update(keep)
        self.note_change()
        return diagnosis

    def verdict(self, name: str, key: str) -> dict[str, Any] | None:
        """Return the verdict on a log as plain values, None if it was not judged since the session was opened."""
        with self._lock:
            return self._results.get((name, key))

    def set_opinion(self, name: str, key: str, opinion: str) -> None:
        """Note what a person makes of a verdict: "confirmed", "rejected" or ""."""
        if opinion not in ("", "confirmed", "rejected"):
            raise InputError(f"an opinion must be confirmed or rejected, got {opinion[:40]!r}")

        def keep(session: Any) -> Any:
            known = session.find_machine(name)
            verdicts = [replace(v, opinion=opinion) for v in known.verdicts if v.file == key]
            if not verdicts:
                raise InputError(f"a verdict must be reached before it is confirmed, got none ({key[:80]})")
            return session.with_machine(known.keep_verdict(verdicts[0]))

        self.folder.update(keep)
        self.note_change()

    def write_report(self, name: str, key: str) -> str:
        """Write the page of a verdict into the session's folder of reports; return its name."""
        stated, machine = self.folder.read().find_machine(name), self.machine(name)
        path = self.find_log(key)
        diagnosis = self.judge(name, key)
        folder = self.folder.folder / REPORTS
        make_folder(folder)
        page = folder / f"{path.stem[:150]}.html"
        rig = machine.rig if machine is not None else stated.build_rig()
        report(read_for(stated, path), page, diagnosis, rig=rig, title=None if machine is None else machine.name)
        return page.name

    def judge_in_background(self, name: str, keys: Sequence[str]) -> Job:
        """Judge logs one after the other; one that cannot be judged is skipped, and its error noted."""

        def work(job: Job) -> None:
            errors = []
            for number, key in enumerate(keys):
                job.progress(number, len(keys), Path(key).name)
                try:
                    self.judge(name, key)
                except SealscopeError as error:
                    errors.append(f"{Path(key).name}: {error}")
            job.progress(len(keys), len(keys))
            if errors:
                raise InputError(f"{len(errors)} of {len(keys)} logs could not be judged: {errors[0]}")

        return self.work.submit("judge", name, work)

    def commission_in_background(self, name: str) -> Job:
        """Commission a machine, with progress."""
        return self.work.submit("commission", name, lambda job: self.commission(name, job.progress))

    # ---- trend

    def compute_trend(self, name: str, progress: Callable[[int, int, str], None] = lambda *_: None) -> Trend:
        """Estimate the trend of a machine over its healthy, judged and suspect logs."""
        stated = self.folder.read().find_machine(name)
        machine = self.machine(name)
        used = {*stated.healthy, *stated.suspect, *(verdict.file for verdict in stated.verdicts)}
        keys = [key for key in self.folder.list_keys()[0] if key in used and key not in stated.rejected]
        rig = machine.rig if machine is not None else stated.build_rig()
        readings: list[LeakReading] = []
        for number, key in enumerate(keys):
            path = self.folder.path_of(key)
            progress(number, len(keys), path.name)
            recording = read_for(stated, path)
            reading = estimate_reading(recording, rig, path.name)
            if reading.start is None:
                reading = replace(reading, start=file_seconds(recording, path))
            readings.append(reading)
        result = trend(readings, rig=rig, healthy=max(1, len(stated.healthy)), limit=stated.limit)
        with self._lock:
            self._trends[name] = result
        self.note_change()
        return result

    def trend_in_background(self, names: Sequence[str]) -> Job:
        """Estimate the trends of machines, one after the other."""

        def work(job: Job) -> None:
            for name in names:
                self.compute_trend(name, job.progress)

        return self.work.submit("estimate the trend", ", ".join(names), work)

    def trend(self, name: str, *, recorded: bool = False) -> dict[str, Any]:
        """Return the trend of a machine as its screen draws it; `known` is False before it is estimated.

        `recorded`: the leaks as the verdicts state them, in place of the estimates at reference oil and pressure.
        Points with time, value, interval, bound and label; unit; the limit and what it is made of; the result in words.
        """
        stated = self.folder.read().find_machine(name)
        with self._lock:
            result = self._trends.get(name)
            starts = {key: row.get("start_s") or row.get("changed_s") for key, row in self._rows.items()}
        allowed, total, healthy = self._limit_of(stated), None, None
        if result is not None and result.wear is not None and result.limit is not None:
            total, healthy = result.limit, result.wear.healthy.value
        unit = "L/min" if recorded or result is None else result.unit
        limit, words = (allowed if recorded or result is None else total), ""
        if healthy is not None and total is not None:
            parts = f"{total:.3g} at reference pressure = {healthy:.3g} of the healthy days + {total - healthy:.3g}"
            words = f"limit {limit:.3g}, the rise that is allowed: {parts}" if recorded else f"limit {parts} allowed"
        points: list[dict[str, Any]] = []
        if recorded:
            for v in stated.verdicts:
                size = v.verdict if v.bound_lpm is None else f"below {v.bound_lpm:.3g} L/min"
                size = size if v.leak_lpm is None else f"{v.leak_lpm:.3g} L/min"
                point = {
                    "t": starts.get(v.file),
                    "value": v.leak_lpm,
                    "bound": v.bound_lpm,
                    "leak": v.verdict == "leak",
                }
                points.append(point | {"label": f"{v.file}: {size}"})
        elif result is not None:
            pressure, leak_above = (
                result.pressure,
                total if result.verdict == "leak" and total is not None else math.inf,
            )
            unit += "" if pressure is None else f" at {pressure / BAR:.3g} bar"
            points = [
                {"t": p.start, "value": p.value, "low": p.low, "high": p.high, "bound": None}
                | {"leak": p.low is not None and p.low > leak_above, "label": f"{p.file}: {p.value:.3g} {result.unit}"}
                for p in result.points
                if p.value is not None
            ]
        leaking = [Path(v.file).name for v in stated.verdicts if v.verdict == "leak"]
        text = "Not estimated yet." if result is None else f"{headline(result)}. {result.reason.capitalize()}."
        if leaking:
            text = f"Judged a leak by itself: {', '.join(leaking)}; see Verdict. The trend compares means: {text}"
        elif result is not None:
            text += f" {result.next_check}"
        found = [] if result is None else [p.start for p in result.repairs]
        remarks = [] if result is None else [f"{p.file}: {p.note}" for p in result.points if p.note]
        return to_plain(  # type: ignore[no-any-return]
            {"known": result is not None, "unit": unit, "limit": limit, "limit_words": words, "points": points}
            | {"words": text, "remarks": remarks, "repairs": list(stated.repairs), "seen": found}
        )

    def _limit_of(self, stated: SessionMachine) -> float | None:
        """Convert the stated repair limit of a machine to L/min; None without one, or if its area is not known."""
        return None if stated.limit is None else self.limit_lpm(stated.limit, stated.name)["lpm"]

    def write_trend(self, name: str) -> str:
        """Write the page of a machine's trend; return its name."""
        result = self._trends.get(name) or self.compute_trend(name)
        folder = self.folder.folder / REPORTS
        make_folder(folder)
        return write_trend_page(folder / f"{name} trend.html", result, title=name).name

    # ---- hold test

    def hold(self, name: str, key: str) -> tuple[HoldResult, ...]:
        """Judge the held loads in a log of a machine, or without a log the oil that was collected."""
        stated = self.folder.read().find_machine(name)
        settings: dict[str, Any] = {"area": stated.area or None, **stated.hold}
        if not key:
            if "collected" not in stated.hold:
                raise InputError("a hold test needs a log, or the oil that was collected, such as 12 mL in 10 min")
            return hold_test(**settings)
        path = self.find_log(key)
        return hold_test(read_for(stated, path), file=str(path), **settings)

    def describe_hold(self, name: str, key: str) -> list[dict[str, Any]]:
        """Return the results of a hold test as plain values, each with its text and its curve."""
        return [
            result.as_dict() | {"text": hold_text(result), "curve": to_plain(_reduce_curve(result.curve))}
            for result in self.hold(name, key)
        ]

    def write_hold(self, name: str, key: str) -> str:
        """Write the page of a hold test; return its name."""
        folder = self.folder.folder / REPORTS
        make_folder(folder)
        return write_hold_page(self.hold(name, key), folder / f"{name} hold test.html").name

    # ---- limit

    def limit_lpm(self, text: str | None, name: str, rated_rpm: str = "") -> dict[str, Any]:
        """Understand a repair limit: a flow, a creep speed, or "2 %" of the pump's flow at a rated speed.

        Returns the text as the command line takes it, and the flow [L/min] if it is known.
        """
        from sealscope.diagnosis.verdict.severity import RepairLimit

        machine = self.folder.read().find_machine(name)
        text = to_point(text or "") or None
        if text is not None and text.endswith("%"):
            if not machine.displacement:
                raise InputError("a limit in % of the rated flow needs the displacement of the pump")
            share = parse_quantity(text[:-1], "", name="limit") / 100.0
            turns = parse_quantity(to_point(rated_rpm) or "0", "rpm", name="rated speed")
            flow = share * turns / 60.0 * parse_quantity(machine.displacement, "m^3/rev", name="displacement")
            if not flow > 0.0:
                raise InputError(f"a limit in % needs a rated speed above 0 rpm, got {rated_rpm[:40]!r}")
            text = f"{flow / LITRE_PER_MINUTE * 1000.0:.4g} mL/min"
        limit = RepairLimit.parse(text)
        rig = machine.build_rig()
        area = 0.5 * (rig.cylinder.A_A + rig.cylinder.A_B) if rig is not None and rig.states("cylinder.A_A") else None
        return {"text": text, "words": str(limit), "lpm": limit.flow_lpm(area)}


def _reduce_curve(curve: HoldCurve | None) -> dict[str, Any] | None:
    """Return the trace of a hold as lists."""
    if curve is None:
        return None
    names = ("t", "values", "fit", "low", "high")
    return {"channel": curve.channel, "unit": curve.unit} | {name: getattr(curve, name).tolist() for name in names}
