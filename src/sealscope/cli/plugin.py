"""`sealscope plugin new`: a distribution with a detector of one's own, ready to be installed and judged."""

from __future__ import annotations

import keyword
import re
from pathlib import Path
from typing import Annotated

import typer

from sealscope.errors import InputError

plugin = typer.Typer(
    name="plugin", help="Detectors of your own; `plugin new NAME` writes a distribution to begin with."
)

_PYPROJECT = """\
[build-system]
requires = ["hatchling>=1.24"]
build-backend = "hatchling.build"

[project]
name = "{dashed}"
version = "0.1.0"
description = "A detector for Sealscope: {words}"
requires-python = ">=3.11"
dependencies = ["numpy", "scipy", "sealscope"]

[project.entry-points."sealscope.detectors"]
"{words}" = "{module}:{cls}"

[tool.hatch.build.targets.wheel]
only-include = ["{module}.py"]
"""
_MODULE = '''\
"""{words}: what it sees, and by which statistic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import ttest_ind

from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.parameters import Rig
from sealscope.recordings import Recording

#: Length of a part whose mean counts as one observation [s]: several cycles of the duty.
PART_SECONDS = 5.0
FEWEST = 8


class {cls}:
    """Change of the mean of |p_A - p_B| between a baseline, or the first half, and the rest. Replace it by yours."""

    name = "{words}"  # that of the entry point

    def __init__(self, rig: Rig) -> None:
        """`rig` is what a detector may assume of the machine; this one assumes nothing."""

    def usable(self, recording: Recording) -> str | None:
        """Return None, or in a line what is missing."""
        if not {{"p_A", "p_B"}} <= set(recording.channels):
            return "needs p_A and p_B"
        needed = 2 * FEWEST * PART_SECONDS
        return None if recording.duration >= needed else f"needs {{needed:g}} s or more, got {{recording.duration:g}} s"

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Return the evidence; `baseline`: leak-free recordings of the same machine, maybe none."""
        means = _means(recording)
        known = [_means(healthy) for healthy in baseline]
        half = means.size // 2
        before, after = (np.concatenate(known), means) if known else (means[:half], means[half:])
        if min(before.size, after.size) < 2 or not np.isfinite(means).all() or np.ptp(means) == 0.0:
            return Evidence("cannot tell", "the pressures do not move, or there is too little of them")
        chance = max(float(ttest_ind(before, after, equal_var=False).pvalue), 1e-300)
        score, threshold = -float(np.log10(chance)), -float(np.log10(false_alarm_probability))
        change = 100.0 * (after.mean() / before.mean() - 1.0)
        verdict = "leak" if score > threshold else "no leak"
        return Evidence(verdict, f"the mean of |p_A - p_B| changed by {{change:+.1f}} %", score, threshold)


def _means(recording: Recording) -> np.ndarray:
    """Return the mean of |p_A - p_B| of each whole part."""
    n = round(PART_SECONDS * recording.rate)
    dp = np.abs(recording["p_A"] - recording["p_B"])
    return dp[: dp.size // n * n].reshape(-1, n).mean(axis=1)
'''
_TEST = '''\
"""The contract: pytest, after `pip install -e .`."""

import pytest
import sealscope as ss

from {module} import {cls}


@pytest.fixture(scope="module")
def recording():
    return ss.simulate(command="5 sin(2t)", duration="90 s", leak="0.05 L/min from 45 s", seed=1)


def test_it_says_what_it_needs(recording):
    detector = {cls}(ss.load_rig())
    assert detector.usable(recording) is None
    assert "p_B" in detector.usable(recording.only(["p_A"]))


def test_thresholds_rise_with_fewer_false_alarms_and_scores_are_the_recording_s(recording):
    evidences = [{cls}(ss.load_rig()).examine(recording, (), p) for p in (0.2, 0.05, 0.01)]
    assert len({{evidence.score for evidence in evidences}}) == 1
    assert sorted(evidence.threshold for evidence in evidences) == [evidence.threshold for evidence in evidences]


def test_another_zero_of_the_clock_changes_nothing(recording):
    shifted = recording.between(0.0, 1e9)
    one, other = ({cls}(ss.load_rig()).examine(run, (), 0.05) for run in (recording, shifted))
    assert one.score == pytest.approx(other.score)
'''
_JUDGE = """\
# What it finds, and whether its false-alarm rate is the one it states: sealscope campaign run judge.toml

[campaign]
name = "{dashed}"
title = "{words}"
profile = "bench"
duration = "180 s"
onset = "90 s"
rate = "500 Hz"
false_alarm = 0.01
seed = 1
detectors = ["{words}", "rms change", "diagnose"]

[factors]
command = ["3 sin(4t)", "5 sin(2t)"]
closed = ["0 %", "50 %"]

[[records]]
count = 400

[[records]]
leak = "0.0042 L/min"
count = 100

[[records]]
leak = "0.05 L/min"
count = 100
"""
_README = """\
# {words}

A detector for Sealscope. `pip install -e . && pytest`; then it stands among the methods of every `sealscope diagnose`,
and `sealscope campaign run judge.toml` says what it finds at which rate of false alarms.
"""


@plugin.callback()
def _plugin() -> None:
    """Detectors of your own; `plugin new NAME` writes a distribution to begin with."""


@plugin.command()
def new(
    name: Annotated[str, typer.Argument(help="Name of the detector in plain words, e.g. 'stroke time'.")],
    folder: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to make; by default the name with dashes.")
    ] = None,
) -> None:
    """Write a distribution with a detector of your own: code that runs, tests, a plan that judges it."""
    from sealscope.storage.atomic import atomic_write
    from sealscope.storage.folders import make_folder

    if not re.fullmatch(r"[a-z][a-z0-9]*( [a-z0-9]+){0,5}", name) or len(name) > 60:
        raise InputError(f"a detector's name must be plain words of a-z and 0-9, as 'stroke time', got {name[:60]!r}")
    module = name.replace(" ", "_")
    if keyword.iskeyword(module):
        raise InputError(f"a detector's name must be no word of Python's, got {name!r}")
    values = {"words": name, "dashed": name.replace(" ", "-"), "module": module, "cls": name.title().replace(" ", "")}
    place = folder or Path(values["dashed"])
    if place.exists():
        raise InputError(f"a plug-in's folder must be new, got {place}, which exists")
    make_folder(place)
    texts = {"pyproject.toml": _PYPROJECT, f"{module}.py": _MODULE, f"test_{module}.py": _TEST}
    for file, text in (texts | {"judge.toml": _JUDGE, "README.md": _README}).items():
        with atomic_write(place / file) as temporary:
            temporary.write_text(text.format(**values), encoding="utf-8")
    typer.echo(
        f"{place}: written; pip install -e {place}, then its name stands among the methods of sealscope diagnose"
    )
