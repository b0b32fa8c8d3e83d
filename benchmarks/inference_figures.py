"""Figures of docs/explanation/inference.md, drawn from a simulated leak and from healthy blocks of random machines.

    python benchmarks/inference_figures.py

The same bytes in every run of one version of the libraries: seeds and the identifiers of the drawing are fixed.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

import sealscope as ss
from sealscope.diagnosis.estimate.change import Information, fit_history, step_test
from sealscope.diagnosis.inference.blocks import information
from sealscope.diagnosis.inference.regimes import recorded_blocks
from sealscope.diagnosis.inference.rows import SPAN, peak_weight, row_weight, stride_samples
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Array
from sealscope.units import LITRE_PER_MINUTE

matplotlib.use("svg")
import matplotlib.pyplot as plt

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "explanation"
ONSET, LEAK = 90.0, 0.0005
DRAWS, BLOCKS = 2000, 20


def balance() -> None:
    """Draw the test function, the leak of each block beside the course fitted to them, and the chance of each onset."""
    rig = load_rig("thesis")
    recording = ss.simulate(rig=rig, leak=f"{LEAK} L/min from {ONSET:g} s", seed=5)
    made = recorded_blocks(recording, rig)
    assert made is not None
    regime = made.regime(made.odds)
    blocks, columns = regime.blocks, regime.columns
    step_information = information(blocks, columns, columns[0].leak)
    test = step_test(step_information)
    assert test is not None
    unit = float(blocks.mean_pressure().mean()) / LITRE_PER_MINUTE
    free = np.linalg.pinv(step_information.precision, hermitian=True)
    fitted = fit_history(step_information, test, with_step=True)
    before = float((unit * fitted.mean)[blocks.time < ONSET].mean())
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11.0, 3.2), layout="constrained")
    stride, peak = stride_samples(recording.rate), peak_weight(recording.rate)
    phi = np.array([row_weight(k, stride, peak) for k in range(SPAN * stride)])
    t = (np.arange(phi.size) + 0.5) / recording.rate
    left.plot(t, phi, label=r"$\phi$ [1/s]")
    left.plot(t, np.gradient(phi, t) / 10.0, "--", label=r"$\dot\phi/10$ [1/s$^2$]")
    left.set(xlabel="t [s]", title="a test function")
    left.legend()
    middle.errorbar(
        blocks.time,
        unit * (free @ step_information.vector) - before,
        1.96 * unit * np.sqrt(np.diag(free)),
        fmt=".",
        color="0.6",
    )
    middle.plot(blocks.time, unit * fitted.mean - before, label="level, slope, walk, step")
    middle.plot([0.0, ONSET, ONSET, 180.0], [0.0, 0.0, LEAK, LEAK], "k:", label="what was put in")
    middle.set(xlabel="t [s]", ylabel="L/min", title="leak's coefficient a block")
    middle.legend()
    right.plot(test.onsets, 2.0 * (test.likelihood - test.likelihood.max()) + test.score)
    right.axhline(test.threshold(0.01), color="k", ls=":", label="1 % of healthy recordings")
    right.set(xlabel="onset [s]", ylabel="score", title="likelihood ratio over onsets")
    right.legend()
    save(figure, "inference-balance")


def null() -> None:
    """Draw how often healthy blocks score as high as the formula says, and what a leak does to the ringing."""
    random = np.random.default_rng(1)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.2), layout="constrained")
    index: Array = np.arange(BLOCKS, dtype=float)
    for walk in (0.0, 0.05, 1.0):
        chances = []
        for _ in range(DRAWS):
            precision = np.exp(0.5 * random.standard_normal(BLOCKS))
            wandering = np.sqrt(walk) * np.cumsum(random.standard_normal(BLOCKS))
            vector = precision * wandering + np.sqrt(precision) * random.standard_normal(BLOCKS)
            test = step_test(Information(3.0 * (index + 0.5), np.diag(precision), np.asarray(vector)))
            assert test is not None
            chances.append(test.chance)
        left.loglog(np.sort(chances), (np.arange(DRAWS) + 1.0) / DRAWS, label=f"walk's variance {walk:g} a block")
    left.plot([1e-3, 1.0], [1e-3, 1.0], "k:")
    left.set(xlim=(1e-3, 1.0), ylim=(1e-3, 1.0), xlabel="chance stated", ylabel="share of healthy blocks")
    left.set_title(f"{BLOCKS} blocks, {DRAWS} draws")
    left.legend(loc="upper left")
    tau = np.linspace(0.0, 0.25, 1500)
    for more, style in ((0.0, "-"), (8.0, "--")):
        sigma = 12.0 + more - 35.0 * np.exp(-10.0 * 1.5 * tau)  # dF/dv falls with exp(-10 v), v = 1.5 m/s^2 tau
        decay = np.exp(-np.cumsum(sigma) * tau[1])
        right.plot(tau, decay * np.cos(2.0 * np.pi * 60.0 * tau), style, lw=0.9, label=f"G/C = {more:g} 1/s")
    right.set(xlabel="time since the reversal [s]", ylabel="ring of $p_A - p_B$, relative", title="ring-down")
    right.legend(loc="lower right")
    save(figure, "inference-null")


def save(figure: plt.Figure, name: str) -> None:
    """Write a figure without date and with fixed identifiers."""
    with matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(FOLDER / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    balance()
    null()
