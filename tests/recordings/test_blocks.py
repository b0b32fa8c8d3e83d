"""What is decided of a log is decided once: the sizes of the blocks in which it is read change nothing."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sealscope as ss
from sealscope.errors import SealscopeError
from sealscope.recordings.formats import text

from .exports import TEXTS

#: Cells that some readers of numbers take for one, and others do not.
ODD = [
    "1e5",
    "1.5D+3",
    "\u22125.0",
    " 7 ",
    "1 000.5",
    "1'000",
    "+.5",
    "5.",
    "nan",
    "-NaN",
    "NAN",
    "#N/A",
    "0x1F",
    "1_000",
    "\uff11",
    "1f",
    "--",
    "1e400",
    "''",
]
#: How loggers write moments; with a comma in place of the point where the log has one.
STAMPS = {
    "month/day": "%m/%d/%Y %H:%M:%S.%f",
    "day/month": "%d/%m/%Y %H:%M:%S.%f",
    "day-month": "%d-%m-%Y %H:%M:%S.%f",
    "month-day": "%m-%d-%y %H:%M:%S.%f",
    "ISO": "%Y-%m-%dT%H:%M:%S.%f",
    "halves": "%d/%m/%Y %I:%M:%S.%f %p",
    "points": "%d.%m.%Y %H:%M:%S.%f",
    "two columns": "%d/%m/%Y;%H:%M:%S.%f",
}


def outcome(path: Path, **given: object) -> tuple[object, ...]:
    """All that reading a file gives, comparable: its recording, or the reason why there is none."""
    try:
        recording = ss.read(path, **given)  # type: ignore[arg-type]
    except SealscopeError as error:
        return (str(error),)
    values = {"t": recording.t, **recording.channels}
    bits = {name: own.tobytes() for name, own in values.items()}
    return bits, dict(recording.units), recording.rate, dict(recording.provenance), recording.history


def in_blocks(path: Path, size: int, large: bool = False, **given: object) -> tuple[object, ...]:
    """What reading in blocks of this size gives; a `large` log's plain blocks are read by pyarrow, if installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "_CHUNK", size)
        patch.setattr(text, "_MIN_ARROW_SIZE", 0 if large else 2**40)
        return outcome(path, **given)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow, pytest.mark.long]) if k % 3 else name for k, name in enumerate(TEXTS)],
)
def test_logs_of_loggers_in_the_smallest_blocks(name: str, tmp_path: Path) -> None:
    path = TEXTS[name].write(tmp_path)
    assert in_blocks(path, 1, map="auto") == outcome(path, map="auto")


def clocked(form: str, start: datetime, step: timedelta, count: int) -> list[str]:
    return [(start + k * step).strftime(STAMPS[form]) for k in range(count)]


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    form=st.sampled_from([*STAMPS, "seconds"]),
    day=st.datetimes(datetime(2024, 1, 1), datetime(2024, 12, 31)),
    step=st.sampled_from([timedelta(milliseconds=10), timedelta(minutes=50), timedelta(days=9)]),
    changes=st.lists(
        st.tuples(
            st.integers(0, 39), st.sampled_from(["OVERLOAD", "missing", "no time", "comment", "blank", "heading", *ODD])
        ),
        max_size=4,
    ),
    comma=st.booleans(),
    quoted=st.booleans(),
    cut=st.integers(0, 12),
    size=st.sampled_from([1, 64, 500]),
    large=st.booleans(),
)
def test_any_log_in_small_blocks(
    form: str,
    day: datetime,
    step: timedelta,
    changes: list[tuple[int, str]],
    comma: bool,
    quoted: bool,
    cut: int,
    size: int,
    large: bool,
    tmp_path: Path,
) -> None:
    times = (
        [f"{k * step.total_seconds():.3f}" for k in range(200)] if form == "seconds" else clocked(form, day, step, 200)
    )
    head = "Date;Time;p_A [bar];p_B [bar]" if ";" in times[0] else "Time;p_A [bar];p_B [bar]"
    rows = [
        f'{time};{k % 7}.;"{k % 5}.25"' if quoted and k % 3 == 0 else f"{time};{k % 7}.;2.5"
        for k, time in enumerate(times)
    ]
    for row, change in changes:
        time = times[row]
        rows[row] = {
            "missing": f"{time};;2.5",
            "no time": ";" * time.count(";") + ";3.;2.5",
            "comment": f"# pause\n{rows[row]}",
            "blank": f"\n{rows[row]}",
            "heading": f"{head}\n{rows[row]}",
        }.get(change, f"{time};{change};2.5")
    written = "\n".join(rows) + "\n"
    written = written.replace(".", ",") if comma else written
    path = tmp_path / "log.csv"
    path.write_text(f"{head}\n{written[: len(written) - cut]}")
    assert in_blocks(path, size, large) == outcome(path)


@pytest.mark.parametrize(
    ("form", "first", "step"),
    [
        ("day/month", datetime(2024, 6, 12, 23, 59, 50), timedelta(milliseconds=20)),
        ("two columns", datetime(2024, 6, 12, 23, 59, 50), timedelta(milliseconds=20)),
        ("halves", datetime(2024, 6, 12, 23, 59, 50), timedelta(milliseconds=20)),
        ("month/day", datetime(2024, 6, 12, 23, 59, 50), timedelta(milliseconds=20)),
        ("month-day", datetime(2024, 5, 12, 23, 59, 50), timedelta(milliseconds=20)),
        ("day-month", datetime(2024, 5, 12, 23, 59, 50), timedelta(milliseconds=20)),
        ("day/month", datetime(2024, 12, 9), timedelta(days=1)),
        ("day/month", datetime(2024, 6, 5, 23, 59, 50), timedelta(milliseconds=20)),  # no number over 12 in it
        ("month-day", datetime(2024, 6, 5, 23, 59, 50), timedelta(milliseconds=20)),
        ("day/month", datetime(2024, 6, 12), timedelta(days=19)),  # 12 June to 1 July: the other order goes back
    ],
)
def test_days_and_months_stand_in_one_order_in_the_whole_log(
    form: str, first: datetime, step: timedelta, tmp_path: Path
) -> None:
    count = 1000 if step < timedelta(days=1) else 2 if step > timedelta(days=1) else 8
    times = clocked(form, first, step, count)
    head = "Date;Time;p_A [bar]" if ";" in times[0] else "Time;p_A [bar]"
    path = tmp_path / "log.csv"
    path.write_text("\n".join([head, *(f"{time};3.5" for time in times)]) + "\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "_CHUNK", 1000)
        recording = ss.read(path)
        parts = list(ss.read_parts(path, 100 * step.total_seconds()))
    assert recording.provenance["start"].startswith(first.isoformat())
    assert recording.t == pytest.approx(step.total_seconds() * np.arange(count), abs=1e-6)
    begins = [first + 100 * k * step for k in range(len(parts))]
    assert [part.provenance["start"][:19] for part in parts] == [begin.isoformat()[:19] for begin in begins]


def test_a_date_that_contradicts_the_others_names_its_line(tmp_path: Path) -> None:
    days = [*["13/06/2024"] * 100, "06/14/2024", *["13/06/2024"] * 100]
    path = tmp_path / "log.csv"
    path.write_text("Time;p_A [bar]\n" + "".join(f"{day} 12:00:00.{k:03};1\n" for k, day in enumerate(days)))
    for size in (64, 2**19):
        (reason,) = in_blocks(path, size)
        assert "got '06/14/2024 12:00:00.100' (line 102" in str(reason)
