"""The command line of Sealscope, which only translates the arguments of a call to function calls."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from threading import Timer
from typing import Annotated, Any

import typer

from sealscope.cli import (
    campaign,
    export,
    fmu,
    hold,
    machine,
    monitoring,
    planning,
    plugin,
    recordings,
    reproduction,
    rigs,
    simulation,
    trend,
    workbench,
)
from sealscope.cli.options import complain
from sealscope.errors import InputError, SealscopeError, UnreadableFile

_WRONG_CALL, _INTERRUPTED = 2, 130
#: An interrupt that Python ignored is repeated after this time [s].
_REPEAT_SECONDS = 0.05

app = typer.Typer(
    rich_markup_mode="markdown",
    name="sealscope",
    help="Find internal leakage in electro-hydrostatic actuators: simulate the rig, read recordings, diagnose them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

for command in (
    simulation.demo, simulation.simulate, machine.commission, recordings.diagnose, recordings.report, trend.trend,
    hold.hold, simulation.parameters, planning.plan, recordings.inspect, recordings.convert, workbench.mend,
    workbench.app, reproduction.reproduce, fmu.fmu, export.export,
):  # fmt: skip
    app.command()(command)
for group in (campaign.campaign, rigs.rigs, monitoring.monitor, plugin.plugin):
    app.add_typer(group)
_VERBOSE = "Every method's verdict; errors log what they come from. Anywhere in a call."


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help=_VERBOSE)] = False,
) -> None:
    """Handle the options of all commands: `--verbose` logs details, `--version` prints the version and exits."""
    if verbose:
        import logging

        log = logging.getLogger("sealscope")
        log.addHandler(logging.StreamHandler())
        log.setLevel(logging.DEBUG)
    if version:
        from sealscope import __version__

        typer.echo(f"sealscope {__version__}")
        raise typer.Exit


def normalise_arguments(arguments: Sequence[str]) -> list[str]:
    """Rearrange the arguments of a call to the form that typer understands.

    `-v` is moved to the beginning, the place of options of all commands; `--baseline` is repeated before each baseline
    (`_spread_baselines`); and `monitor FILE` becomes `monitor run FILE`.
    """
    end = list(arguments).index("--") if "--" in arguments else len(arguments)  # after `--` there are no options
    without_verbose = [argument for argument in arguments[:end] if argument not in ("-v", "--verbose")]
    verbose = ["-v"] if len(without_verbose) < end else []
    remaining = _spread_baselines(without_verbose, arguments[end:])
    if remaining[:1] == ["monitor"] and len(remaining) > 1 and remaining[1] not in monitoring.COMMANDS:
        remaining.insert(1, "run")  # `sealscope monitor FILE`
    return [*verbose, *remaining]


def _spread_baselines(arguments: Sequence[str], operands: Sequence[str]) -> list[str]:
    """Repeat the option `--baseline` of diagnose and report before each baseline file, as typer requires.

    All arguments after `--baseline` up to the next option are baselines. If the call has no other files, only the first
    file after each `--baseline` is a baseline, and the others are diagnosed. `operands`: the arguments from `--` on,
    which stay at the end. Raises InputError if no file follows.
    """
    if "--baseline" not in arguments or arguments[0] not in ("diagnose", "report"):
        return [*arguments, *operands]
    baselines: list[list[str]] = []  # the files after each `--baseline`
    remaining: list[str] = []  # all other arguments
    group = remaining  # the list to which the present argument belongs
    for argument in arguments[1:]:
        if argument == "--baseline":
            group = []
            baselines.append(group)
            continue
        if argument != "-" and argument.startswith("-"):  # the next option ends the baselines; `-` is standard input
            group = remaining
        group.append(argument)
    remaining += operands
    if not all(baselines):
        raise InputError("--baseline must be followed by one file or more, got none")
    command = _click_command().commands[arguments[0]]
    # find out whether there are files among the remaining arguments; wrong options raise no error here
    files = command.make_context(arguments[0], list(remaining), resilient_parsing=True).params["files"]
    if not files:
        remaining = [name for group in baselines for name in group[1:]] + remaining
        baselines = [group[:1] for group in baselines]
    options = [argument for group in baselines for name in group for argument in ("--baseline", name)]
    return [arguments[0], *options, *remaining]


@cache
def _click_command() -> Any:
    """Build the click command of the whole command line."""
    return typer.main.get_command(app)


def main() -> None:
    """Run the command line, and end the process with an exit status.

    The status is that of the command, by default 0; 1 for a failure; 2 for a wrong call; or 130 for an interrupt
    (Ctrl-C). An error that the caller can act on is printed as one line on standard error.
    """
    # some versions of typer contain a copy of click: take the exception of the module in which BadParameter is defined
    wrong_call: type[Any] = sys.modules[typer.BadParameter.__module__].ClickException
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a character that the terminal lacks is printed as its code
            stream.reconfigure(errors="backslashreplace")
    try:
        with _repeating_lost_interrupts():
            status = _click_command()(normalise_arguments(sys.argv[1:]), prog_name="sealscope", standalone_mode=False)
            sys.stdout.flush()
    except typer.Exit as error:
        status = error.exit_code
    except wrong_call as error:
        error.show()
        status = _WRONG_CALL
    except (typer.Abort, KeyboardInterrupt):
        status = _INTERRUPTED
    except BrokenPipeError:  # the reader of the output has ended
        status = 1
    except SealscopeError as error:
        complain(error)
        status = _WRONG_CALL if isinstance(error, InputError) and not isinstance(error, UnreadableFile) else 1
    except (OSError, MemoryError) as error:
        complain(str(error) or "out of memory")
        status = 1
    if status == _INTERRUPTED:  # typer may have turned the interrupt into this status
        complain("interrupted")
    try:
        sys.stdout.flush()
    except OSError:  # discard the rest, or Python's flush at exit would complain
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status if isinstance(status, int) else 0)  # a command that succeeds returns None


@contextmanager
def _repeating_lost_interrupts() -> Iterator[None]:
    """Repeat each interrupt (Ctrl-C) that Python ignores within the `with` block.

    Python ignores exceptions in code that cannot pass them on, such as a finalizer of the compiler.
    """
    original_hook = sys.unraisablehook

    def repeat_interrupt(unraisable: Any) -> None:
        """Send SIGINT to this process again if the ignored exception `unraisable` was a KeyboardInterrupt."""
        if unraisable.exc_type is not KeyboardInterrupt:
            original_hook(unraisable)
            return
        # later: an interrupt within this hook would be ignored, too
        timer = Timer(_REPEAT_SECONDS, os.kill, (os.getpid(), signal.SIGINT))
        timer.daemon = True
        timer.start()

    sys.unraisablehook = repeat_interrupt
    try:
        yield
    finally:
        sys.unraisablehook = original_hook
