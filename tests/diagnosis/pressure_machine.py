"""A machine with known truth for the checks of the pressure model: the rig without throttles, simulated once a case,
its instruments' noise drawn anew a seed; and records of a linear model whose parameters walk, without any machine."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from sealscope.diagnosis.pressure_model.model import ORIFICE, G
from sealscope.diagnosis.pressure_model.tracking.track import Track
from sealscope.diagnosis.pressure_model.tracking.wander import wander
from sealscope.recordings.recording import Recording
from sealscope.simulation.changes import Linear, ParameterDrift
from sealscope.simulation.commands import Command, Recorded
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import record
from sealscope.simulation.integrate import Trajectory, oversampling
from sealscope.simulation.sizing import sized_run

ONSET = 60.0
LEAK = f"0.0042 L/min from {ONSET:g} s"
#: What the pump alone lets pass [m^3/(s Pa)]; the detector's rig knows nothing of it.
G_PUMP = 2.4e-13
#: High enough that no stroke empties a chamber.
P_CHARGE = 8e5
READ = ("u", "p_A", "p_B")
NOISE = ("sensors.p_A.noise", "sensors.p_B.noise", "sensors.common_noise")


def _sum_of_sines(t: np.ndarray) -> np.ndarray:
    return 3.0 * np.sin(4.0 * t) + 2.5 * np.sin(np.sqrt(17.0) * np.pi / 5.0 * t)


def _stepped(t: np.ndarray) -> np.ndarray:
    """Levels of 2 to 6 V either way in turn, held for 0.4 to 1.2 s, 60 ms from one to the next."""
    random = np.random.default_rng(11)
    begins = np.cumsum(random.uniform(0.4, 1.2, 400))
    levels = random.uniform(2.0, 6.0, 400) * np.where(np.arange(400) % 2, -1.0, 1.0)
    return np.interp(t, np.column_stack([begins, begins + 0.06])[:-1].ravel(), np.repeat(np.r_[0.0, levels], 2)[1:-3])


#: Commands that no words say.
OF_THEIR_OWN = {"incommensurate": _sum_of_sines, "stepped": _stepped}


def _command(words: str, duration: float) -> Command | str:
    if words not in OF_THEIR_OWN:
        return words
    t = np.arange(round(duration * 500.0) + 2) / 500.0
    return Recorded(t, OF_THEIR_OWN[words](t), words)


@lru_cache(maxsize=12)
def _case(
    command: str, leak: str | None, fault: str | None, drift: tuple[str, float] | None, values: tuple, duration: float
) -> tuple[Experiment, Trajectory, np.ndarray]:
    drifts = () if drift is None else (ParameterDrift(drift[0], Linear(drift[1], duration)),)
    experiment = Experiment.of(
        command=_command(command, duration),
        leak=leak,
        fault=fault,
        drifts=drifts,
        duration=duration,
        set={"pump.G_pump": G_PUMP, "fluid.p_charge": P_CHARGE, **dict(values)},
    )
    _, path = sized_run(experiment)
    return experiment, path, experiment.command.volts(experiment.sample_times())


def recorded(
    seed: int = 1,
    *,
    command: str = "7 sin(4t)",
    leak: str | tuple[str, ...] | None = None,
    fault: str | None = None,
    drift: tuple[str, float] | None = None,
    duration: float = 120.0,
    noise: float = 1.0,
    **values: float,
) -> Recording:
    """u, p_A, p_B at 500 Hz; `drift`: a parameter and its even change over the record, as a share; `noise`: as many
    times the usual; `values`: parameters by dotted name with two underscores for the dot."""
    chosen = tuple(sorted((name.replace("__", "."), value) for name, value in values.items()))
    experiment, path, volts = _case(command, leak, fault, drift, chosen, duration)
    rig = experiment.rig
    if noise != 1.0:
        rig = rig.with_overrides({name: noise * rig[name] for name in NOISE})
    return record(rig, path, volts, oversampling(experiment), seed).only(READ)


def true_difference(**case: object) -> tuple[np.ndarray, np.ndarray]:
    """The command (n,) [V] and p_A - p_B (n,) [Pa] at the samples of a case, as no instrument reads them; `case`: what
    `recorded` takes."""
    volts, states = true_states(**case)
    return volts, states["p_A"] - states["p_B"]


def true_states(**case: object) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The command (n,) [V], p_A and p_B [Pa] and x [m] (n,) at the samples of a case."""
    chosen = {"command": "7 sin(4t)", "leak": None, "fault": None, "drift": None, "duration": 30.0, **case}
    names = ("command", "leak", "fault", "drift", "duration")
    values = tuple(sorted((name.replace("__", "."), chosen[name]) for name in chosen if name not in names))
    command, leak, fault, drift, duration = (chosen[name] for name in names)
    experiment, path, volts = _case(command, leak, fault, drift, values, duration)
    at = slice(0, volts.size * oversampling(experiment), oversampling(experiment))
    return volts, {name: path[name][at] for name in ("p_A", "p_B", "x")}


def of_linear_model(
    like: Track, theta: np.ndarray, speed: float, random: np.random.Generator, step: float = 0.0, after: int = 0
) -> Track:
    """A track as its own linear model draws it: parameters walk as expected of them from the anchored fit, each block's
    right side has the noise of its information; `step` of G [m^3/(s Pa)] after a block."""
    walk = wander(theta, like.units, like.seconds, speed)
    blocks, size = like.r.shape
    path = np.cumsum(np.vstack([np.zeros(size), walk * random.standard_normal((blocks - 1, size))]), axis=0)
    known = like.anchor > 0
    mean = like.centre.copy()
    mean[known] += random.standard_normal(int(known.sum())) / np.sqrt(like.anchor[known])
    path += mean - path.mean(axis=0)
    path[after:, G] += step / like.units[G]
    r = np.empty_like(like.r)
    for b in range(blocks):
        values, vectors = np.linalg.eigh(like.N[b])
        r[b] = like.N[b] @ path[b] + vectors @ (np.sqrt(np.maximum(values, 0.0)) * random.standard_normal(size))
    return replace(like, r=r, r_all=np.insert(r, ORIFICE, like.r_all[:, ORIFICE], axis=1))
