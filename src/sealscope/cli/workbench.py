"""The commands `app` and `mend`: the workbench in the browser, and logs rewritten with a stated layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from sealscope.cli.options import check_folder, say

_FOLDER = "Folder of the session, made if it is new; a folder of logs opens these."


def app(
    folder: Annotated[Path, Argument(metavar="FOLDER", help=_FOLDER)] = Path("sealscope-session"),
    port: Annotated[int, Option(min=0, max=65535, help="Port of the page; 0: a free one.")] = 0,
    no_browser: Annotated[bool, Option("--no-browser", help="Print the address, open nothing.")] = False,
    replay: Annotated[
        bool, Option("--replay", help="Judge the session anew without a page; 1 if a verdict differs.")
    ] = False,
) -> None:
    """Open the workbench in the browser: logs, channels, healthy days, verdicts, trends, hold tests."""
    from sealscope.app.server import replay_session, run_app

    if replay:
        if not replay_session(folder, say):
            raise Exit(1)
        return
    run_app(folder, port, browser=not no_browser, say=say)


def mend(
    source: Annotated[Path, Argument(help="Text log to read, which is not changed.")],
    target: Annotated[Path, Argument(help="Plain CSV file to write.")],
    first_row: Annotated[int | None, Option(help="Line of the first sample, from 1.")] = None,
    heading_row: Annotated[int | None, Option(help="Line of the headings; 0: none.")] = None,
    delimiter: Annotated[str | None, Option(help="A character, or tab, blank, semicolon, comma, bar.")] = None,
    decimal: Annotated[str | None, Option(help="Decimal separator, a point or a comma.")] = None,
    time_format: Annotated[str | None, Option(metavar="FORMAT", help="Such as '%d.%m.%Y %H:%M:%S,%f'.")] = None,
    time_column: Annotated[int, Option(help="Column of the time stamps, from 1.")] = 1,
) -> None:
    """Rewrite a text log whose layout is not recognised: state what was read wrongly."""
    from sealscope.recordings import mend as mend_log

    check_folder(target)
    count = mend_log(
        source, target, first_row=first_row, heading_row=heading_row, delimiter=delimiter, decimal=decimal,
        time_format=time_format, time_column=time_column,
    )  # fmt: skip
    say(f"{target}: {count} rows")
