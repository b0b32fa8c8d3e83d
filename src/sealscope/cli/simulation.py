"""The commands that simulate: simulate, parameters, demo."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from typing import Annotated, Any

import typer

from sealscope.cli.options import (
    RigOption,
    SeedOption,
    SetOption,
    check_folder,
    complete_rigs,
    progress,
    rig_with,
    say,
)
from sealscope.errors import InputError

_INDENTED: Mapping[str, Any] = {"initial_indent": "    ", "subsequent_indent": "    "}


class TableFormat(StrEnum):
    """How tables are printed."""

    table = "table"
    csv = "csv"
    json = "json"


def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Recording to write (.nc, .h5, .csv, .parquet).")],
    rig: RigOption = "thesis",
    command: Annotated[
        str,
        typer.Option(
            "--command",
            help="Command, e.g. '3 sin(4t)', 'chirp 3 from 0.1 Hz to 5 Hz over 60 s'; or a target for the piston: "
            "'position 50 mm sin(2t)'.",
        ),
    ] = "3 sin(4t)",
    load: Annotated[
        str | None,
        typer.Option(
            "--load",
            help="Force against +x beside the rig's own, e.g. '2 kN', 'step 500 N at 3 s', '200 N/mm over x', "
            "'2 kN s/m over v', 'file LOAD.csv' (F [N] over t, x or v).",
        ),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(
            "--controller",
            help="What follows a target: pi, flatness, fault-tolerant, fault-tolerant-flatness, or your own as "
            "FILE.py:NAME or MODULE:NAME. [default: pi]",
        ),
    ] = None,
    leak: Annotated[
        list[str] | None, typer.Option("--leak", help="Leak, e.g. '0.0042 L/min from 90 s'; repeat to combine.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            help="Another fault, e.g. 'air 1 % from 90 s', 'sensor p_A offset 2 psi'; repeat.",
        ),
    ] = None,
    duration: Annotated[str, typer.Option("--duration", help="Length, e.g. '180', '3 min' [s].")] = "180",
    rate: Annotated[
        str | None, typer.Option("--rate", help="Sampling rate [Hz]; by default the rig's own (daq.sample_rate).")
    ] = None,
    start: Annotated[
        str, typer.Option("--start-position", help="Piston position at the start, from mid-stroke [m].")
    ] = "0",
    seed: SeedOption = 0,
    overrides: SetOption = None,
    method: Annotated[str, typer.Option("--method", help="auto, rk4 or imex.")] = "auto",
    step: Annotated[str | None, typer.Option("--step", help="Largest step of the solver [s].")] = None,
    error: Annotated[
        str | None,
        typer.Option(
            "--error", help="Error that a pressure may have, e.g. '20[Pa]', instead of a step. [default: 100]"
        ),
    ] = None,
    prove: Annotated[
        bool, typer.Option("--prove", help="Halve the step and report how far everything moves; fail if too far.")
    ] = False,
    allow_unresolved: Annotated[
        bool, typer.Option("--allow-unresolved", help="Let an unstable or unresolved run through, marked.")
    ] = False,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="Write what was put in (leaks, onset) to this JSON file.")
    ] = None,
    fmu: Annotated[
        Path | None,
        typer.Option(
            "--fmu",
            help="Record this unit (.fmu, a program that runs with your rights) instead of the rig, by the rig's "
            "instruments.",
        ),
    ] = None,
    maps: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="CHANNEL=NAME", help="The unit's own name of a channel or an input; repeat."),
    ] = None,
) -> None:
    """Simulate the rig, or run somebody else's unit, and record it as the rig's instruments would."""
    from sealscope.recordings import write
    from sealscope.recordings.files import check_target
    from sealscope.simulation.experiment import Experiment
    from sealscope.simulation.simulate import simulate_with_truth, write_truth

    check_target(output)
    check_folder(output)
    if truth is not None:
        check_folder(truth)
        if truth.resolve() == output.resolve():
            raise InputError(f"recording and truth must be two files, got {output} for both")
    experiment = Experiment.of(
        rig=rig_with(rig, overrides),
        command=command,
        load=load,
        controller=controller,
        leak=leak,
        fault=fault,
        duration=duration,
        rate=rate,
        x_0=start,
        seed=seed,
        method=method,  # type: ignore[arg-type]  # checked by Experiment
        step=step,
        error=error,
        allow_unresolved=allow_unresolved,
    )
    if fmu is not None:
        if truth is not None or prove:
            raise InputError("--truth and --prove are of the rig, got them with --fmu")
        from sealscope.fmu.recording import record_fmu

        with progress() as report:
            recording = record_fmu(fmu, experiment, map=_names(maps), progress=report)
        write(recording, output)
        typer.echo(f"{output}: {len(recording)} samples at {recording.rate:g} Hz, {experiment.command} ({fmu.name})")
        return
    if maps:
        raise InputError("--map names the variables of a unit, got it without --fmu")
    with progress() as report:
        run = simulate_with_truth(experiment, report, prove=prove)
    write(run.recording, output)
    if truth is not None:
        write_truth(run.truth, truth)
    if run.proof is not None:
        typer.echo(run.proof.text())
    solver = run.recording.provenance["solver"]
    typer.echo(
        f"{output}: {len(run.recording)} samples at {experiment.rate:g} Hz, {experiment.command} "
        f"({solver['method']}, h = {solver['step_s']:.3g} s)"
    )
    for leak_ in run.truth.leaks:
        typer.echo(f"leak: {leak_}")
    for fault_ in run.truth.faults:
        typer.echo(f"fault: {fault_}")
    if run.truth.leaks:
        typer.echo(f"mean leak while open: {run.truth.mean_leak_lpm:.5g} L/min")
    if "q_comp" in run.recording:
        from sealscope.units import LITRE_PER_MINUTE

        flow = float(run.recording["q_comp"][-max(1, round(experiment.rate)) :].mean())
        typer.echo(f"the controller makes good: {flow / LITRE_PER_MINUTE:.4g} L/min at the end (channel q_comp)")


def _names(maps: Sequence[str] | None) -> dict[str, str]:
    pairs = [text.partition("=") for text in maps or ()]
    for channel, sign, name in pairs:
        if not (channel and sign and name):
            raise InputError(f"--map must be CHANNEL=NAME, got {channel}{sign}{name}")
    return {channel.strip(): name.strip() for channel, _, name in pairs}


def parameters(
    rig: Annotated[
        str, typer.Argument(help="Rig by name, or the path of a rig's TOML file.", autocompletion=complete_rigs)
    ] = "thesis",
    overrides: SetOption = None,
    output: Annotated[TableFormat, typer.Option("--format", help="Table, CSV or JSON.")] = TableFormat.table,
) -> None:
    """List a rig's parameters: symbol, name, value, unit and source."""
    loaded = rig_with(rig, overrides)
    columns = ("symbol", "name", "meaning", "value", "unit", "source")
    rows = [{column: getattr(row, column) for column in columns} for row in loaded.table()]
    if output is TableFormat.json:
        typer.echo(json.dumps(rows, indent=1))
    elif output is TableFormat.csv:
        writer = csv.DictWriter(sys.stdout, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    else:
        say(_listing(f"{loaded.name}: {loaded.title}", rows, min(get_terminal_size((80, 24)).columns, 120)))


def _listing(title: str, rows: Sequence[Mapping[str, Any]], width: int) -> str:
    """Return parameters as lines of at most `width` columns: name, value, unit and meaning, then the source."""
    wide = max(len(row["name"]) for row in rows) + 2
    lines = [*wrap(title, width), ""]
    for row in rows:
        value = f"{row['value']:.6g}" if isinstance(row["value"], float) else str(row["value"])
        line = f"{row['name']:<{wide}}{value} {row['unit'] if row['unit'] != '1' else ''}".rstrip()
        whole = f"{line}  {row['meaning']}"
        lines += [whole] if len(whole) <= width else [line, *wrap(row["meaning"], width, **_INDENTED)]
        lines += wrap(row["source"], width, **_INDENTED)
    return "\n".join(lines)


def demo(
    context: typer.Context,
    folder: Annotated[Path, typer.Option("--output", "-o", help="Folder for the recordings and the page.")] = Path(
        "sealscope-demo"
    ),
    seed: SeedOption = 1,
) -> None:
    """Commission a simulated machine on five healthy recordings, then judge a healthy and a leaking one.

    With -v what was learnt, and every method's verdict.
    """
    from sealscope.demo import run_demo
    from sealscope.reporting import diagnosis_text, short_text
    from sealscope.storage.folders import make_folder

    make_folder(folder)
    with progress() as report_progress:
        result = run_demo(folder, seed, report_progress)
    whole = bool(context.find_root().params.get("verbose"))
    typer.echo(f"{result.machine_file}: learnt from {len(result.machine.healthy)} healthy recordings")
    typer.echo(str(result.machine) if whole else f"  smallest leak it will show: {result.machine.summary.smallest}")
    for diagnosis in (result.healthy, result.diagnosis):
        text = diagnosis_text(diagnosis) if whole else short_text(diagnosis)
        typer.echo(text if whole or diagnosis.verdict == "leak" else "\n".join(text.splitlines()[:2]))
    typer.echo(f"truth:     {result.truth.mean_leak_lpm:.4f} L/min from {result.truth.onset_s:.1f} s")
    typer.echo(f"recording: {result.recording}")
    typer.echo(f"page:      {result.page}")
