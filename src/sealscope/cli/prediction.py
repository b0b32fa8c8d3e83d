"""The command that predicts: what a rig, its sensors and a command let a detector find, before anyone measures."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import Annotated

import typer

from sealscope.cli.options import RigOption, SetOption, progress, rig_with


class PredictionFormat(StrEnum):
    """How a prediction is printed."""

    text = "text"
    json = "json"


def predict(
    rig: RigOption = "thesis",
    command: Annotated[str, typer.Option("--command", help="Command of the test, e.g. '3 sin(4t)'.")] = "3 sin(4t)",
    duration: Annotated[
        str, typer.Option("--duration", help="Length of a record [s]; the leak opens in its middle.")
    ] = "180",
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Probability of an alarm on a leak-free record.")
    ] = 0.01,
    detection: Annotated[
        float, typer.Option("--detection", help="Probability with which the smallest leak is to be found.")
    ] = 0.9,
    overrides: SetOption = None,
    detectors: Annotated[
        list[str] | None,
        typer.Option("--detector", help="A rule of the thesis, 'd3 of p_A fell'; repeat. [default: nine]"),
    ] = None,
    bench: Annotated[
        str,
        typer.Option("--bench", help="Machines and drifts from this bench profile (name or file), not noise alone."),
    ] = "",
    draws: Annotated[int, typer.Option("--draws", help="Machines drawn from the bench.")] = 24,
    start: Annotated[
        str | None,
        typer.Option("--start-position", help="Piston at the start, from mid-stroke [m]; by default centred."),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare/--no-compare", help="Compare the thesis's commands, with and without throttles.")
    ] = True,
    seed: Annotated[int, typer.Option("--seed", help="Seed of noise and draws.")] = 0,
    output: Annotated[
        PredictionFormat, typer.Option("--format", help="Text, or one JSON object.")
    ] = PredictionFormat.text,
) -> None:
    """Predict the smallest leak that diagnose finds, with the Cramer-Rao bound and the thesis's rules beside it.

    The rules are given the onset of the leak; the detectors of diagnose look for it.
    """
    from sealscope.campaigns.prediction.predict import STANDARD_COMMANDS, experiment_for
    from sealscope.campaigns.prediction.predict import predict as predict_leaks
    from sealscope.campaigns.prediction.rules import THESIS_RULES, DetectionTarget, check_rule
    from sealscope.units import parse_quantity

    target = DetectionTarget(
        false_alarm=false_alarm,
        detection=detection,
        rules=tuple(map(check_rule, dict.fromkeys(detectors))) if detectors else THESIS_RULES,
        seed=seed,
    )
    experiment = experiment_for(
        rig_with(rig, overrides),
        command,
        parse_quantity(duration, "s", name="--duration"),
        None if start is None else parse_quantity(start, "m", name="--start-position"),
    )
    with progress() as update:
        report = predict_leaks(
            experiment,
            target,
            commands=STANDARD_COMMANDS if compare else (),
            bench=bench,
            draws=draws,
            progress=update,
        )
    typer.echo(json.dumps(report.as_dict(), allow_nan=False) if output is PredictionFormat.json else report.text())
