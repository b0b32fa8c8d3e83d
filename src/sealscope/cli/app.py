"""The command line: translation from words to calls, nothing else."""

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
    fmu,
    machine,
    monitoring,
    planning,
    plugin,
    recordings,
    reproduction,
    rigs,
    simulation,
    trend,
)
from sealscope.cli.options import complain
from sealscope.errors import InputError, SealscopeError, UnreadableFile

_WRONG_CALL, _INTERRUPTED = 2, 130
#: An interrupt that Python ignored is sent again after this time [s].
_AGAIN = 0.05

app = typer.Typer(
    rich_markup_mode="markdown",
    name="sealscope",
    help="Find internal leakage in electro-hydrostatic actuators: simulate the rig, read recordings, diagnose them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

for command in (
    simulation.demo,
    simulation.simulate,
    machine.commission,
    recordings.diagnose,
    recordings.report,
    trend.trend,
    simulation.parameters,
    planning.plan,
    recordings.inspect,
    recordings.convert,
    reproduction.reproduce,
    fmu.fmu,
):
    app.command()(command)
for group in (campaign.campaign, rigs.rigs, monitoring.monitor, plugin.plugin):
    app.add_typer(group)
_VERBOSE = "Every method's verdict; errors log what they come from. Anywhere in a call."


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help=_VERBOSE)] = False,
) -> None:
    if verbose:
        import logging

        log = logging.getLogger("sealscope")
        log.addHandler(logging.StreamHandler())
        log.setLevel(logging.DEBUG)
    if version:
        from sealscope import __version__

        typer.echo(f"sealscope {__version__}")
        raise typer.Exit


def arguments_of(words: Sequence[str]) -> list[str]:
    """Return the words of a call as the commands take them: `-v` first, an option for each baseline."""
    end = list(words).index("--") if "--" in words else len(words)
    verbose = [word for word in words[:end] if word in ("-v", "--verbose")]
    plain = [word for word in words[:end] if word not in ("-v", "--verbose")] + list(words[end:])
    if plain[:1] == ["monitor"] and len(plain) > 1 and plain[1] not in monitoring.COMMANDS:
        plain.insert(1, "run")  # `sealscope monitor FILE`
    return [*verbose[:1], *spread_baselines(plain)]


def spread_baselines(words: Sequence[str]) -> list[str]:
    """Give every file after `--baseline` an option of its own, so that `FILE... --baseline FILE...` takes wildcards.

    All words after `--baseline` up to the next option belong to it; but where no other word could be a FILE, only the
    first one does.
    """
    if "--baseline" not in words or words[0] not in ("diagnose", "report"):
        return list(words)
    end = list(words).index("--") if "--" in words else len(words)
    groups: list[list[str]] = []
    plain: list[str] = []
    of_group = False
    for word in words[1:end]:
        if word == "--baseline":
            groups.append([])
            of_group = True
            continue
        of_group = of_group and (word == "-" or not word.startswith("-"))
        (groups[-1] if of_group else plain).append(word)
    plain += words[end:]
    if not all(groups):
        raise InputError("--baseline must be followed by one file or more, got none")
    files = _command().commands[words[0]].make_context(words[0], list(plain), resilient_parsing=True).params["files"]
    options = [word for group in groups for name in (group if files else group[:1]) for word in ("--baseline", name)]
    left = [] if files else [name for group in groups for name in group[1:]]
    return [words[0], *options, *left, *plain]


@cache
def _command() -> Any:
    return typer.main.get_command(app)


def main() -> None:
    """Run the command line.

    Every error a caller can act on is one line on standard error and a status, never a traceback.
    """
    # typer brings click along or holds a copy of its own, by version: the class is wherever BadParameter's base is
    wrong_call: type[Any] = sys.modules[typer.BadParameter.__module__].ClickException
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without the character shows its code instead
            stream.reconfigure(errors="backslashreplace")
    try:
        with _no_interrupt_lost():
            status = _command()(arguments_of(sys.argv[1:]), prog_name="sealscope", standalone_mode=False)
            sys.stdout.flush()
    except typer.Exit as error:
        status = error.exit_code
    except wrong_call as error:
        error.show()
        status = _WRONG_CALL
    except (typer.Abort, KeyboardInterrupt):
        status = _INTERRUPTED
    except BrokenPipeError:
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
    except OSError:  # the reader of a pipe is gone: the rest goes nowhere, so that Python's own flush is silent
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status if isinstance(status, int) else 0)


@contextmanager
def _no_interrupt_lost() -> Iterator[None]:
    """Repeat an interrupt that Python ignored, for example in a finalizer of the compiler."""
    usual = sys.unraisablehook

    def repeat_interrupt(unraisable: Any) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            usual(unraisable)
            return
        timer = Timer(_AGAIN, os.kill, (os.getpid(), signal.SIGINT))
        timer.daemon = True
        timer.start()

    sys.unraisablehook = repeat_interrupt
    try:
        yield
    finally:
        sys.unraisablehook = usual
