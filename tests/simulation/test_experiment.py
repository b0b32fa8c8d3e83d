"""An experiment's rules, its key, and the proof by halving the step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.errors import InputError, SimulationFailed
from sealscope.simulation.commands import Recorded, Sine
from sealscope.simulation.experiment import make_experiment
from sealscope.simulation.faults.faults import Leak, Tabulated
from sealscope.simulation.proof import prove
from sealscope.simulation.simulate import run, trajectory

THROTTLED = {"orifices": "present", "closed_A": "50 %", "closed_B": "50 %"}


@pytest.mark.parametrize(
    ("parts", "rule"),
    [
        ({"duration": 0.0}, "duration must be > 0 s"),
        ({"duration": float("nan")}, "duration must be > 0 s"),
        ({"duration": 1e9}, "must be 1 to 20000000 samples"),
        ({"seed": -1}, "seed must be >= 0"),
        ({"x_0": 0.31}, "x_0 must be within the stroke"),
        ({"x_0": float("nan")}, "x_0 must be within the stroke"),
        ({"method": "imex"}, "imex needs throttles"),
    ],
)
def test_an_impossible_experiment_is_refused(parts, rule):
    with pytest.raises(InputError, match=rule):
        make_experiment(**parts)


def test_the_key_tells_experiments_apart_to_the_last_digit():
    t = np.linspace(0.0, 10.0, 5001)
    u = np.sin(t)
    nudged = u.copy()
    nudged[2500] += 1e-9
    opening = np.linspace(0.0, 1.0, 5001)
    bent = opening.copy()
    bent[2500] += 1e-9
    common = {"duration": 2.0}
    experiments = [
        make_experiment(**common),
        make_experiment(**common, command=Sine(3.0, 4.0 + 1e-9)),
        make_experiment(**common, command=Recorded(t, u, "log.csv")),
        make_experiment(**common, command=Recorded(t, nudged, "log.csv")),
        make_experiment(**common, leak=Leak(coefficient=1e-13, opening=Tabulated(t, opening))),
        make_experiment(**common, leak=Leak(coefficient=1e-13, opening=Tabulated(t, bent))),
        make_experiment(**common, leak=["G = 1e-13", "C = 1e-10"]),
        make_experiment(**common, seed=1),
        make_experiment(**common, step=1e-4),
        make_experiment(**common, error=1e-4),
        make_experiment(**common, method="rk4"),
        make_experiment(**common, allow_unresolved=True),
        make_experiment(**common, values={"R_c": 0.73 + 1e-12}),
        make_experiment(duration=2.0 + 1 / 500),
    ]
    keys = [one.key() for one in experiments]
    assert len(set(keys)) == len(keys)
    assert make_experiment(**common).key() == keys[0]
    assert make_experiment(**common, command=Recorded(t.copy(), u.copy(), "log.csv")).key() == keys[2]


def test_a_run_is_told_in_its_provenance():
    found = run(make_experiment(duration=1.0, values={"V": "200[cm^3]"}, seed=9)).recording
    told = found.provenance
    assert told["origin"] == "simulation"
    found_error = told["solver"].pop("error_found_pa")
    assert 0.0 < found_error < 100.0
    assert told["solver"] == {"method": "rk4", "step_s": 5e-4, "allow_unresolved": False, "error_pa": 100.0}
    assert told["experiment"]["seed"] == 9
    assert "cylinder.V" in told["experiment"]["parameters_set"]


@pytest.mark.parametrize("values", [{}, THROTTLED], ids=["free", "throttled"])
def test_a_smaller_error_is_a_finer_and_a_truer_run(values):
    experiment = make_experiment(duration=4.0, values=values)
    converged = trajectory(replace(experiment, step=2e-5), ())

    def error(path):
        every = round((path.t[1] - path.t[0]) * 1e6) // round((converged.t[1] - converged.t[0]) * 1e6)
        return float(np.sqrt(np.mean((path["p_A"] - converged["p_A"][::every][: path.t.size]) ** 2)))

    steps = []
    for allowed in (None, 3.0, 0.1):
        path = trajectory(replace(experiment, error=allowed), ())
        steps.append(path.step)
        assert error(path) < (100.0 if allowed is None else allowed)
    assert steps[0] > steps[1] > steps[2]
    told = run(replace(experiment, duration=1.0, error=3.0)).recording.provenance["solver"]
    assert told["error_pa"] == 3.0
    assert told["error_found_pa"] < 3.0
    assert "error_pa" not in run(replace(experiment, duration=1.0, step=5e-4)).recording.provenance["solver"]


def test_an_error_is_positive_and_stands_alone():
    for wrong in (0.0, -20.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="error must be > 0 Pa, got"):
            run(make_experiment(duration=1.0, error=wrong))
    with pytest.raises(InputError, match=r"a stated step or a stated error, not both, got .* 0\.0005 s and error = 20"):
        make_experiment(duration=1.0, error=20.0, step=5e-4)


@pytest.mark.parametrize("values", [{}, THROTTLED], ids=["free", "throttled"])
def test_the_default_step_proves_itself(values):
    proof = prove(make_experiment(duration=20.0, leak="0.0042 L/min from 10 s", values=values))
    assert proof.resolved
    assert proof.halved == proof.step / 2
    names = [one.name for one in proof.differences]
    assert {"x", "omega", "p_A", "p_B", "p_1", "p_2", "RMS of d1 of p_A", "RMS of d4 of p_B"} <= set(names)
    pressures = [one for one in proof.differences if one.unit == "Pa" and not one.name.startswith("RMS")]
    # it is the error of the step, and the error of half the step is a small part of it
    assert all(0 < one.difference < 15.0 for one in pressures)


def test_an_under_resolved_run_is_refused_and_says_what_moved():
    coarse = {"duration": 20.0, "step": 1.5e-3, "values": {"sample_rate": "400[Hz]"}}
    with pytest.raises(SimulationFailed, match=r"under-resolved: halving the step of 0\.00125 s \(rk4\) moves "):
        prove(make_experiment(**coarse))
    proof = prove(make_experiment(**coarse, allow_unresolved=True))
    assert not proof.resolved
    assert not proof.worst().resolved


def test_a_chattering_run_cannot_prove_itself():
    experiment = make_experiment(duration=5.0, values=THROTTLED, method="rk4", step=1e-4, allow_unresolved=True)
    assert not prove(experiment).resolved


def test_progress_is_told_from_nothing_to_all():
    told: list[tuple[str, float]] = []
    run(make_experiment(duration=10.0, leak="0.01 L/min"), progress=lambda words, share: told.append((words, share)))
    assert {words for words, _ in told} == {"sizing the leak", "simulating"}
    simulating = [share for words, share in told if words == "simulating"]
    assert simulating == sorted(simulating)
    assert simulating[-1] == 1.0
    assert all(0.0 <= share <= 1.0 for _, share in told)
