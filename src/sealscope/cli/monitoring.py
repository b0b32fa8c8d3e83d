"""The commands `sealscope monitor ...`: the service, its settings, a demonstration and exports."""

from __future__ import annotations

import logging
import signal
import sys
from pathlib import Path
from typing import Annotated

from typer import Argument, Option, Typer, echo

from sealscope.cli.options import check_folder, write_text
from sealscope.errors import InputError

#: Words after `monitor` that are commands or options; any other word is a file of settings.
COMMANDS = ("init", "run", "demo", "export", "dashboard", "-h", "--help")

monitor = Typer(
    name="monitor",
    help="Watch running actuators: alarms in litres per minute. `sealscope monitor FILE` is the service.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)
FileOption = Annotated[Path, Option("--output", "-o", metavar="FILE", help="The file to write.")]


@monitor.command()
def init(output: FileOption = Path("monitor.toml")) -> None:
    """Write a commented file of settings for the monitor."""
    from sealscope.monitor.settings import template

    if output.exists():
        raise InputError(f"a new file of settings must not exist yet, got {output}")
    check_folder(output)
    write_text(output, template())
    echo(f"{output}: written; sealscope monitor {output}")


@monitor.command()
def run(
    file: Annotated[Path, Argument(metavar="FILE", help="Settings, as `sealscope monitor init` writes them.")],
    once: Annotated[bool, Option("--once", help="End when standard input and folders hold nothing new.")] = False,
) -> None:
    """Watch the actuators of FILE: read blocks of samples, and print alarms as JSON lines on standard output."""
    if not logging.getLogger("sealscope").handlers:  # -v adds one
        logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    from sealscope.monitor.supervisor import LimitedLines

    line_limit = LimitedLines()  # shared by all handlers, so that messages from outside cannot fill the disk
    for handler in (*logging.getLogger().handlers, *logging.getLogger("sealscope").handlers):
        handler.addFilter(line_limit)
    _serve(file, once=once)


@monitor.command()
def demo(
    folder: Annotated[Path | None, Option("--output", "-o", metavar="FOLDER", help="Folder of the database.")] = None,
    port: Annotated[int, Option(min=0, max=65535, help="Port of the page.")] = 8765,
    speed: Annotated[float, Option(min=0.1, max=1000.0, help="Times real time.")] = 20.0,
) -> None:
    """Watch three simulated actuators, by default at 20 times real time; one leaks after two simulated minutes."""
    import tempfile

    from sealscope.live_simulation import DEMO
    from sealscope.storage.folders import make_folder

    with tempfile.TemporaryDirectory() as temporary:
        demo_folder = Path(temporary) if folder is None else folder
        make_folder(demo_folder)
        file = demo_folder / "demo.toml"
        write_text(file, DEMO.format(port=port, speed=speed))
        _serve(file)


@monitor.command()
def export(
    file: Annotated[Path, Argument(metavar="FILE", help="Settings of the monitor.")],
    folder: Annotated[Path, Option("--output", "-o", metavar="FOLDER", help="Where the tables are written.")],
) -> None:
    """Write people's judgements of alarms as labelled data: alarms.csv and estimates.csv."""
    from sealscope.monitor.database.export import export_labels
    from sealscope.monitor.database.store import MonitorStore
    from sealscope.monitor.settings import read_settings
    from sealscope.storage.folders import make_folder

    database = read_settings(file).database
    if "://" not in database and not Path(database).exists():  # it would be created, and empty
        raise InputError(f"the monitor's database must exist, got none ({database})")
    store = MonitorStore(database)
    make_folder(folder)
    alarms, estimates = export_labels(store, folder)
    echo(f"{folder}: {alarms} alarms, {estimates} estimates")


@monitor.command()
def dashboard(file: FileOption = Path("grafana.json")) -> None:
    """Write a Grafana dashboard for the metrics that the monitor's page offers under /metrics."""
    import json

    from sealscope.monitor.outputs.grafana import dashboard as grafana

    check_folder(file)
    write_text(file, json.dumps(grafana(), indent=1) + "\n")
    echo(f"{file}: written")


def _serve(file: Path, *, once: bool = False) -> None:
    """Run the monitor with a file of settings until this process receives SIGTERM or SIGINT.

    Without a page it also ends when all its sources of samples have ended. `once`: a source ends if it has no new data.
    """
    from sealscope.monitor.service import Service
    from sealscope.monitor.settings import read_settings

    settings = read_settings(file)
    sources = []
    if any(actuator.simulate is not None for actuator in settings.actuator):
        from sealscope.live_simulation import make_simulated_sources

        sources = make_simulated_sources(settings, lambda text: echo(text, err=True))
    service = Service(settings, once=once, sources=sources)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: service.stop())
    if service.page is not None:
        echo(f"page: {service.page.address}", err=True)
    service.run()
