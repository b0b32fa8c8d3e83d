"""The commands `simulate`, `parameters` and `demo`."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Context, Option, echo

from sealscope.cli import options as opt
from sealscope.errors import InputError
from sealscope.paragraphs import paragraph

if TYPE_CHECKING:
    from sealscope.simulation.experiment import Experiment

_PROVE = "Halve the step and report how far everything moves; fail if too far."
_FMU = "Record this unit (.fmu, a program that runs with your rights) instead of the rig, by the rig's instruments."
_FOLDER = "Folder for the recordings and the page."
_MAP = "The unit's own name of a channel or an input; repeat."


@opt.with_experiment_options
def simulate(
    output: Annotated[Path, Option("--output", "-o", help="Recording to write (.nc, .h5, .csv, .parquet).")],
    experiment: Experiment,  # built from the options that the decorator adds
    prove: Annotated[bool, Option("--prove", help=_PROVE)] = False,
    truth: Annotated[Path | None, Option(help="Write what was put in (leaks, onset) to this JSON file.")] = None,
    fmu: Annotated[Path | None, Option(help=_FMU)] = None,
    maps: Annotated[list[str] | None, Option("--map", metavar="CHANNEL=NAME", help=_MAP)] = None,
) -> None:
    """Simulate the rig, or run an FMU, and record it with the rig's instruments."""
    from sealscope.recordings import write
    from sealscope.recordings.files import check_target
    from sealscope.simulation.simulate import simulate_experiment, write_truth

    check_target(output)
    opt.check_folder(output)
    if truth is not None:
        opt.check_folder(truth)
        if truth.resolve() == output.resolve():
            raise InputError(f"recording and truth must be two files, got {output} for both")
    if fmu is not None and (truth is not None or prove):
        raise InputError("--truth and --prove need a simulated rig and cannot be combined with --fmu")
    if fmu is None and maps:
        raise InputError("--map names the variables of an FMU and needs --fmu")
    with opt.progress() as report:
        if fmu is None:
            run = simulate_experiment(experiment, report, prove=prove)
            recording = run.recording
            source, *lines = run.lines()  # the solver; leaks and faults
        else:
            from sealscope.fmu.recording import record_fmu

            recording = record_fmu(fmu, experiment, map=_parse_maps(maps or ()), progress=report)
            source, lines = fmu.name, []
    write(recording, output)
    if fmu is None and truth is not None:
        write_truth(run.truth, truth)
    if fmu is None and run.proof is not None:
        echo(run.proof.text())
    summary = f"{output}: {len(recording)} samples at {recording.rate:g} Hz, {experiment.command} ({source})"
    for line in (summary, *lines):
        opt.say_wrapped(line)


def _parse_maps(options: Sequence[str]) -> dict[str, str]:
    """Parse the options `--map CHANNEL=NAME`; raise InputError for any other text, or a channel given twice."""
    names: dict[str, str] = {}
    for text in options:
        channel, _, name = map(str.strip, text.partition("="))
        if not (channel and name):
            raise InputError(f"--map must be CHANNEL=NAME, got {text}")
        if channel in names:
            raise InputError(f"--map {channel} must be given once, got {names[channel]} and {name}")
        names[channel] = name
    return names


def parameters(
    rig: opt.RigArgument = "thesis",
    overrides: opt.SetOption = None,
    form: Annotated[Literal["table", "csv", "json"], Option("--format", help="Table, CSV or JSON.")] = "table",
) -> None:
    """List a rig's parameters: symbol, name, value, unit and source."""
    from sealscope.storage.csv_file import guard_cell

    loaded_rig = opt.load_rig_with(rig, overrides)
    columns = ("symbol", "name", "meaning", "value", "unit", "source")
    rows = [{column: getattr(row, column) for column in columns} for row in loaded_rig.table()]
    if form == "json":
        echo(json.dumps(rows, indent=1))
    elif form == "csv":
        writer = csv.DictWriter(sys.stdout, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: guard_cell(value) for name, value in row.items()} for row in rows)
    else:
        width = min(get_terminal_size((80, 24)).columns, 120)
        name_width = max(len(row["name"]) for row in rows) + 2
        lines = [paragraph(f"{loaded_rig.name}: {loaded_rig.title}", width=width), ""]
        for row in rows:
            value = f"{row['value']:.6g}" if isinstance(row["value"], float) else str(row["value"])
            line = f"{row['name']:<{name_width}}{value} {row['unit'] if row['unit'] != '1' else ''}".rstrip()
            with_meaning = f"{line}  {row['meaning']}"
            has_room = len(with_meaning) <= width
            texts = [row["source"]] if has_room else [row["meaning"], row["source"]]
            lines.append(with_meaning if has_room else line)
            lines += [paragraph(text, "    ", width=width) for text in texts if text]
        opt.say("\n".join(lines))


def demo(
    context: Context,
    folder: Annotated[Path, Option("--output", "-o", help=_FOLDER)] = Path("sealscope-demo"),
    seed: opt.SeedOption = 1,
) -> None:
    """Commission a simulated machine on five healthy recordings, then judge a healthy and a leaking one.

    With -v it prints what was learnt, and the verdicts of all methods.
    """
    from sealscope.demo import run_demo
    from sealscope.reporting.messages import diagnosis_text, short_text
    from sealscope.storage.folders import make_folder

    make_folder(folder)
    with opt.progress() as report_progress:
        result = run_demo(folder, seed, report_progress)
    shows_all = opt.is_verbose(context)
    echo(f"{result.machine_file}: learnt from {len(result.machine.healthy)} healthy recordings")
    echo(str(result.machine) if shows_all else f"  smallest leak it will show: {result.machine.summary.smallest}")
    for diagnosis in (result.healthy, result.diagnosis):
        text = diagnosis_text(diagnosis) if shows_all else short_text(diagnosis)
        # without a leak only the verdict and the state, which are the first two lines
        echo(text if shows_all or diagnosis.verdict == "leak" else "\n".join(text.splitlines()[:2]))
    echo(f"truth:     {result.truth.mean_leak_lpm:.4f} L/min from {result.truth.onset_s:.1f} s")
    echo(f"recording: {result.recording}\npage:      {result.page}")
