"""Campaigns over recordings of real machines: the same scorers, calibration and judgement as over simulated ones."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from sealscope.campaigns.plan import Promise, Use
from sealscope.campaigns.plan_table import Table
from sealscope.campaigns.work import Row
from sealscope.errors import InputError, SealscopeError

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Told how many recordings have their row and how many there are.
Progress = Callable[[int, int, int], None]


@dataclass(frozen=True)
class RecordingSet:
    """Recordings that belong together: files by pattern in the order of the numbers in their names, the `first` to
    before the `end`-th of them; `size` 0 for sound ones, else the grade of the leak."""

    files: str
    use: Use
    size: float
    first: int
    end: int
    label: str


@dataclass(frozen=True)
class RecordedPlan:
    """A campaign over recordings in a folder that the caller has; `unit` of the sets' sizes; `views` and `assumed` as
    in `plan.Plan`, the thesis's rig being assumed where nothing is said."""

    name: str
    title: str
    channel_map: Mapping[str, str]
    rate_hz: float | None
    sets: tuple[RecordingSet, ...]
    unit: str
    false_alarm: float
    promise: Promise
    confidence: float
    detectors: tuple[str, ...]
    place: str = ""
    note: str = ""
    views: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    assumed: Rig | None = None


def read_recorded(tree: Mapping[str, Any], place: str) -> RecordedPlan:
    """The plan in a TOML file's tables; raises InputError with the place for whatever breaks a rule."""
    for key in tree:
        if key not in ("campaign", "recordings", "views"):
            raise InputError(
                f"[{key}] is not known; a plan over recordings has [campaign], [views] and [recordings] ({place})"
            )
    head = Table(tree.get("campaign", {}), "campaign", place)
    part = Table(tree["recordings"], "recordings", place)
    channel_map = part.take("map", {})
    if not isinstance(channel_map, dict) or not all(isinstance(one, str) for one in channel_map.values()):
        raise part.fail(f"map must be a table of channel = column, got {channel_map!r}")
    given = part.take("sets")
    if not isinstance(given, list) or not given:
        raise part.fail(f"sets must be a list of tables, got {given!r}")
    name = head.text("name")
    views = head.views(tree.get("views", {}))
    plan = RecordedPlan(
        name=name,
        title=head.text("title", name),
        channel_map=channel_map,
        rate_hz=part.number("rate", unit="Hz") if "rate" in part.left else None,
        sets=tuple(_set(Table(one, f"recordings.sets[{k}]", place)) for k, one in enumerate(given, 1)),
        unit=part.text("unit", "L/min"),
        false_alarm=head.share("false_alarm", 0.01),
        promise=head.choice("promise", get_args(Promise), "average"),  # type: ignore[arg-type]
        confidence=head.share("confidence", 0.95),
        detectors=head.detectors(views),
        place=place,
        note=head.text("note", ""),
        views=views,
        assumed=head.assumed(None),
    )
    head.end()
    part.end()
    if not any(one.use == "judge" for one in plan.sets):
        raise part.fail("sets must have one to judge, got none")
    return plan


def _set(table: Table) -> RecordingSet:
    found = RecordingSet(
        files=table.text("files"),
        use=table.choice("use", get_args(Use), "judge"),  # type: ignore[arg-type]
        size=table.number("size", 0.0),
        first=table.whole("first", 1, least=1),
        end=table.whole("end", 10**9, least=2),
        label=table.text("label", ""),
    )
    table.end()
    if found.size < 0 or (found.use == "calibrate" and found.size > 0):
        raise table.fail(f"size must be >= 0, and 0 to calibrate, got {found.size:g}")
    if Path(found.files).is_absolute() or ".." in Path(found.files).parts:
        raise table.fail(f"files must be a pattern within the folder, got {found.files!r}")
    return found


def _natural(path: Path) -> list[str | int]:
    """Names in the order in which people count: stroke 2 before stroke 10."""
    return [int(word) if word.isdigit() else word for word in re.split(r"(\d+)", path.name)]


def _files(plan: RecordedPlan, folder: Path) -> Iterator[tuple[RecordingSet, Path]]:
    for one in plan.sets:
        found = sorted((path for path in folder.glob(one.files) if path.is_file()), key=_natural)
        chosen = found[one.first - 1 : one.end - 1]
        if not chosen:
            raise InputError(f"a set's files must be there, got none for {one.files!r} ({folder})")
        yield from ((one, path) for path in chosen)


def recorded_rows(plan: RecordedPlan, folder: Path, progress: Progress | None = None) -> list[Row]:
    """A row for each recording, in the order of their ids; one that cannot be judged is a row with its error."""
    files = list(_files(plan, folder))
    rows = {}
    for number, (one, path) in enumerate(files, 1):
        row = _row(plan, one, path, path.relative_to(folder).as_posix())
        if row.id in rows:
            raise InputError(f"a recording must be in one set, got it in two ({path})")
        rows[row.id] = row
        if progress is not None:
            progress(number, len(files), sum(row.error is not None for row in rows.values()))
    return [rows[name] for name in sorted(rows)]


def _row(plan: RecordedPlan, of: RecordingSet, path: Path, name: str) -> Row:
    base = partial(
        Row,
        id=hashlib.sha256(name.encode()).hexdigest()[:16],
        use=of.use,
        leak_lpm=of.size,
        fault="",
        levels={"set": of.label or of.files},
        replicate=0,
    )
    from sealscope.campaigns.entries import stated
    from sealscope.diagnosis.calibration.calibrated import look_at, looked_at, place_of
    from sealscope.recordings import read

    try:
        recording = read(path, channel_map=plan.channel_map or None, rate=plan.rate_hz)
        part, _, reason = looked_at(recording)
        if reason is not None:
            return base(error=f"{name}: {reason}")
        look = look_at(part, 0.5, plan.false_alarm, plan.assumed)
        scores, statements = stated(look, plan.detectors, plan.views)
        return base(place=asdict(place_of(part)), scores=scores, statements=statements)
    except SealscopeError as error:
        return base(error=str(error))
