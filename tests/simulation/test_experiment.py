"""An experiment's rules, its key, and the proof by halving the step."""

from __future__ import annotations

import inspect
from dataclasses import replace

import numpy as np
import pytest

from sealscope.errors import SimulationFailed
from sealscope.simulation.commands import Sine, polyline_from_table, sampled_signal
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run
from sealscope.simulation.leaks import Leak
from sealscope.simulation.simulate import (
    Difference,
    Proof,
    compare_trajectories,
    prove,
    simulate,
    simulate_experiment,
    simulate_with_truth,
)

from ..refusals import refusal

THROTTLED = {"orifices": "present", "closed_A": "50 %", "closed_B": "50 %"}


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"duration": 0.0}, "duration, 0 s"),
        ({"duration": float("nan")}, "duration, 0 s"),
        ({"duration": 1e9}, "20000000"),
        ({"seed": -1}, "seed, 0"),
        ({"x_0": 0.31}, "x_0"),
        ({"x_0": float("nan")}, "x_0"),
        ({"method": "imex"}, "imex, throttles"),
    ],
)
def test_an_impossible_experiment_is_refused(parts, words):
    with refusal(*words.split(", ")):
        Experiment.of(**parts)


def test_the_key_tells_experiments_apart_to_the_last_digit():
    t = np.linspace(0.0, 10.0, 5001)
    u = np.sin(t)
    nudged = u.copy()
    nudged[2500] += 1e-9
    opening = np.linspace(0.0, 1.0, 5001)
    distorted = opening.copy()
    distorted[2500] += 1e-9
    common = {"duration": 2.0}
    experiments = [
        Experiment.of(**common),
        Experiment.of(**common, command=Sine(3.0, 4.0 + 1e-9)),
        Experiment.of(**common, command=sampled_signal(t, u, "log.csv")),
        Experiment.of(**common, command=sampled_signal(t, nudged, "log.csv")),
        Experiment.of(**common, leak=Leak(coefficient=1e-13, opening=polyline_from_table(t, opening))),
        Experiment.of(**common, leak=Leak(coefficient=1e-13, opening=polyline_from_table(t, distorted))),
        Experiment.of(**common, leak=["G = 1e-13", "C = 1e-10"]),
        Experiment.of(**common, seed=1),
        Experiment.of(**common, step=1e-4),
        Experiment.of(**common, error=1e-4),
        Experiment.of(**common, method="rk4"),
        Experiment.of(**common, allow_unresolved=True),
        Experiment.of(**common, set={"R_c": 0.73 + 1e-12}),
        Experiment.of(duration=2.0 + 1 / 500),
    ]
    keys = [one.key() for one in experiments]
    assert len(set(keys)) == len(keys)
    assert Experiment.of(**common).key() == keys[0]
    assert Experiment.of(**common, command=sampled_signal(t.copy(), u.copy(), "log.csv")).key() == keys[2]


def test_a_run_is_told_in_its_provenance():
    result = simulate_experiment(Experiment.of(duration=1.0, set={"V": "200[cm^3]"}, seed=9)).recording
    reported = result.provenance
    assert reported["origin"] == "simulation"
    found_error = reported["solver"].pop("error_found_pa")
    assert 0.0 < found_error < 100.0
    assert reported["solver"] == {"method": "rk4", "step_s": 5e-4, "allow_unresolved": False, "error_pa": 100.0}
    assert reported["experiment"]["seed"] == 9
    assert "cylinder.V" in reported["experiment"]["overrides"]


@pytest.mark.slow
@pytest.mark.parametrize("values", [{}, THROTTLED], ids=["free", "throttled"])
def test_a_smaller_error_is_a_finer_and_a_truer_run(values):
    experiment = Experiment.of(duration=4.0, set=values)
    converged = integrate_run(replace(experiment, step=2e-5), ())

    def error(path):
        every = round((path.t[1] - path.t[0]) * 1e6) // round((converged.t[1] - converged.t[0]) * 1e6)
        return float(np.sqrt(np.mean((path["p_A"] - converged["p_A"][::every][: path.t.size]) ** 2)))

    steps = []
    for allowed in (None, 3.0, 0.1):
        path = integrate_run(replace(experiment, error=allowed), ())
        steps.append(path.step)
        assert error(path) < (100.0 if allowed is None else allowed)
    assert steps[0] > steps[1] > steps[2]
    reported = simulate_experiment(replace(experiment, duration=1.0, error=3.0)).recording.provenance["solver"]
    assert reported["error_pa"] == 3.0
    assert reported["error_found_pa"] < 3.0
    assert (
        "error_pa"
        not in simulate_experiment(replace(experiment, duration=1.0, step=5e-4)).recording.provenance["solver"]
    )


def test_an_error_is_positive_and_stands_alone():
    for wrong in (0.0, -20.0, float("nan"), float("inf")):
        with refusal("error", "0 Pa"):
            simulate_experiment(Experiment.of(duration=1.0, error=wrong))
    with refusal("0.0005 s", "error", "20"):
        Experiment.of(duration=1.0, error=20.0, step=5e-4)


@pytest.mark.parametrize("values", [{}, THROTTLED], ids=["free", "throttled"])
def test_the_default_step_proves_itself(values):
    proof = prove(Experiment.of(duration=20.0, leak="0.0042 L/min from 10 s", set=values))
    assert proof.resolved
    assert proof.halved == proof.step / 2
    names = [one.name for one in proof.differences]
    assert {"x", "omega", "p_A", "p_B", "p_1", "p_2", "RMS of d1 of p_A", "RMS of d4 of p_B"} <= set(names)
    pressures = [one for one in proof.differences if one.unit == "Pa" and not one.name.startswith("RMS")]
    # it is the error of the step, and the error of half the step is a small part of it
    assert all(0 < one.difference < 15.0 for one in pressures)


def test_a_proof_asks_for_the_error_that_is_stated():
    experiment = Experiment.of(command="5 sin(2t)", duration=4.0, set={"sample_rate": "250[Hz]"})
    run = integrate_run(experiment, ())
    fine = integrate_run(experiment, (), step=run.step / 2)
    moved = max(row.difference for row in compare_trajectories(experiment, run, fine) if row.name.startswith("p_"))
    for error, resolved in ((None, True), (1.1 * moved, True), (0.9 * moved, False)):
        differences = compare_trajectories(replace(experiment, error=error), run, fine)
        assert all(row.resolved for row in differences) == resolved, error
    assert 50.0 < moved < 100.0  # the default error


def test_an_under_resolved_run_is_refused_and_says_what_moved():
    coarse = {"duration": 20.0, "step": 1.5e-3, "set": {"sample_rate": "400[Hz]"}}
    with refusal("0.00125 s", "rk4", error=SimulationFailed):
        prove(Experiment.of(**coarse))
    proof = prove(Experiment.of(**coarse, allow_unresolved=True))
    assert not proof.resolved
    assert not proof.worst().resolved


def test_what_must_not_move_at_all_is_the_worst_that_moves():
    steady, still = Difference("p_A", 5.0, "Pa", 10.0), Difference("d1", 1e-3, "Pa", 0.0)
    for rows in ((steady, still), (still,)):
        proof = Proof("rk4", 1e-3, 5e-4, rows)
        assert not proof.resolved
        assert proof.worst() is still


def test_a_chattering_run_cannot_prove_itself():
    experiment = Experiment.of(duration=5.0, set=THROTTLED, method="rk4", step=1e-4, allow_unresolved=True)
    assert not prove(experiment).resolved


@pytest.mark.parametrize(("leak", "words"), [("0.01 L/min", "sizing the leak"), (None, "simulating")])
def test_progress_is_told_from_nothing_to_all(leak, words):
    """The last run that sizes a leak is the run."""
    reported: list[tuple[str, float]] = []
    simulate_experiment(
        Experiment.of(duration=10.0, leak=leak), progress=lambda words, share: reported.append((words, share))
    )
    assert {words for words, _ in reported} == {words}
    shares = [share for _, share in reported]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert all(0.0 <= share <= 1.0 for share in shares)


def test_a_text_means_what_the_number_means():
    numbers = {"duration": 90.0, "rate": 250.0, "x_0": 0.01, "step": 5e-4, "leak": "0.0042 L/min from 90 s"}
    texts = {
        "duration": "1.5 min", "rate": "0.25[kHz]", "x_0": "10 mm", "step": "500[us]",
        "leak": "0.0042[L/min] from 1.5 min",
    }  # fmt: skip
    one, other = Experiment.of(**numbers), Experiment.of(**texts)
    assert (one.duration, one.rate, one.x_0, one.step) == (90.0, 250.0, 0.01, 5e-4)
    assert one.key() == other.key()
    assert Experiment.of(error="20[Pa]").error == Experiment.of(error="0.02 kPa").error == 20.0
    growing = Experiment.of(leak="7e-8[m^3/s] orifice growing from 1[min] to 0.05[h]").leaks[0]
    assert growing == Experiment.of(leak="0.0042 L/min orifice growing from 60 s to 180").leaks[0]
    fault = "sensor p_A offset 2[psi] growing from 0.5 min to 1 min"
    assert (
        Experiment.of(fault=fault).faults
        == Experiment.of(fault="sensor p_A offset 2 psi growing from 30 to 60 s").faults
    )


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"comand": "3 sin(4t)"}, "Experiment.of, 'comand', 'command'"),
        ({"duration": None}, "duration, None"),
        ({"duration": "20 psi"}, "duration"),
        ({"command": 3}, "command, 3"),
        ({"leak": 0.0042}, "leak, 0.0042"),
        ({"fault": [3]}, "fault, 3"),
        ({"set": "V_1=3"}, "set, 'V_1=3'"),
        ({"seed": 1.5}, "seed, 1.5"),
        ({"rig": 5}, "rig, 5"),
        ({"leak": "1 L/min from 2 psi"}, "leak"),
        ({"leak": "1[psi]"}, "leak, unit"),
    ],
)
def test_a_wrong_argument_is_refused_by_name(parts, words):
    with refusal(*words.split(", ")):
        Experiment.of(**parts)
    if "comand" not in parts:
        with refusal(*words.split(", ")):
            simulate(**parts)


def test_simulate_names_itself():
    with refusal("simulate", "'comand'", "'command'"):
        simulate(comand="3 sin(4t)")
    with refusal("simulate"):
        simulate("3 sin(4t)")
    with refusal("experiment", "Experiment"):
        simulate_experiment("3 sin(4t)")
    with refusal("simulate_with_truth"):
        simulate_with_truth(Experiment.of())


def test_simulate_and_an_experiment_take_the_same_arguments():
    ours, theirs = (dict(inspect.signature(function).parameters) for function in (simulate, Experiment.of))
    assert dict(inspect.signature(simulate_with_truth).parameters) == ours
    assert ours == theirs


COARSE = {"duration": 20.0, "step": 1.5e-3, "set": {"sample_rate": "400[Hz]"}}


def test_a_stated_step_is_checked_like_a_chosen_one():
    with refusal("0.00125 s", "rk4", error=SimulationFailed):
        simulate_experiment(Experiment.of(**COARSE))
    solver = simulate_experiment(Experiment.of(**COARSE, allow_unresolved=True)).recording.provenance["solver"]
    assert solver["allow_unresolved"]
    assert solver["error_found_pa"] > 100.0
    fine = simulate_experiment(Experiment.of(duration=4.0, step=5e-4)).recording.provenance["solver"]
    assert 0.0 < fine["error_found_pa"] < 100.0


def test_the_check_of_a_stated_step_changes_no_byte():
    experiment = Experiment.of(duration=6.0, step=5e-4, leak="G = 6e-13 from 3 s")
    checked, unchecked = (integrate_run(experiment, experiment.leaks, step=step) for step in (None, 5e-4))
    assert np.isnan(unchecked.error)
    np.testing.assert_array_equal(checked.rows, unchecked.rows)


def test_a_proof_integrates_half_the_step_and_nothing_else_twice(monkeypatch):
    counted: list[float | None] = []

    def count(*args, step=None, **more):
        counted.append(step)
        return integrate_run(*args, step=step, **more)

    for module in ("simulate", "integrate"):
        monkeypatch.setattr(f"sealscope.simulation.{module}.integrate_run", count)
    experiment = Experiment.of(duration=6.0, leak="0.01 L/min from 3 s")
    simulate_experiment(experiment)
    without = len(counted)
    run = simulate_experiment(experiment, prove=True)
    assert run.proof is not None
    assert counted[without:] == [*counted[:without], run.proof.step / 2]
