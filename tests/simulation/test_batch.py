"""Runs side by side: what each of them is by itself, whatever stands beside it."""

from __future__ import annotations

import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from sealscope.compiled import kernel
from sealscope.errors import MissingExtra, SimulationFailed
from sealscope.parameters import load_rig
from sealscope.physics.lanes import WIDTH, load, store
from sealscope.signals.details import QUANTITIES
from sealscope.simulation.batch.batch import simulate_batch
from sealscope.simulation.batch.noise import half_turn_sine, logarithm, noise_keys, normals
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.changes import ParameterDrift, linear_path
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

from ..refusals import refusal

QUIET = {f"sensors.{channel}.{what}": 0.0 for channel in ("p_A", "p_B") for what in ("noise", "drift")}
QUIET["sensors.common_noise"] = 0.0
FINE = {**QUIET, "daq.bits": 24, "sensors.p_A.hum": 0.0, "sensors.p_B.hum": 0.0}
NAMES = ("p_A", "p_B")
#: One step for all; without noise the details of a run by itself see more than 0.1 % of its error.
COMMON = {"step": 5e-4, "allow_unresolved": True}


#: Rigs that differ in one number each.
CHANGED = [{"q_b": 5e-6}, {"K_oil": 7.5e8}, {"M_eq": 14.0}, {"F_v": 350.0}, {"V": 2.2e-4}, {"k_p": 1.4}, {"v_th": 0.02}]


@pytest.fixture
def rms_of(details_of):
    return details_of


@pytest.mark.parametrize(
    ("volumes", "throttled"),
    [  # each pair is compiled of its own, a law in each of them is in one of the first two
        pytest.param("fixed", False, id="fixed-free"),
        pytest.param("position", True, id="position-throttled", marks=pytest.mark.slow),
        pytest.param("position", False, id="position-free", marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("fixed", True, id="fixed-throttled", marks=[pytest.mark.slow, pytest.mark.long]),
    ],
)
def test_each_run_is_what_it_is_by_itself(check_rig, rms_of, throttled, volumes):
    leaks = [None, "G = 6e-13 from 4 s", "C = 2e-10 from 3 s", "G = 1e-12 growing from 2 s to 9 s", "G = 6e-13"]
    bounds = [0.0, 2.5, 4.0, 10.0]
    experiments = [
        Experiment.of(
            rig=check_rig(throttled, volumes=volumes, p_charge="0.5[MPa]", **QUIET, **changed),
            command=f"{2 + 0.2 * k} sin(4t {'+ 0.2' if k % 2 else ''}) + 0.05",
            leak=leaks[k % len(leaks)],
            duration=10.0,
            seed=k,
            **COMMON,
        )
        for k, changed in enumerate(CHANGED)
    ]
    batch = simulate_batch(experiments, bounds=bounds)
    for k, one in enumerate(experiments):
        alone = simulate_experiment(one)
        np.testing.assert_allclose(batch.rms[k], rms_of(alone.recording, bounds), rtol=1e-6)
        assert batch.mean_leak_lpm[k] == pytest.approx(alone.truth.mean_leak_lpm, rel=1e-4, abs=1e-12)
    assert np.all(batch.steps == 5e-4)
    # the anti-alias filter, gain, offset, hum and saturation too
    values = {"sensors.p_A.gain_error": 0.01, "sensors.p_A.offset": 4000.0, "sensors.p_B.range_hi": 4.9e5}
    observed = replace(experiments[1], rig=experiments[1].rig.with_overrides(values))
    changed = simulate_batch([observed], bounds=bounds)
    np.testing.assert_allclose(changed.rms[0], rms_of(simulate_experiment(observed).recording, bounds), rtol=1e-6)
    assert np.abs(changed.rms[0] / batch.rms[1] - 1.0).max() > 1e-3


@pytest.mark.long
@pytest.mark.slow
def test_single_rods_run_side_by_side(rms_of):
    rig = load_rig("single-rod-eha").with_overrides({**FINE, "sensors.p_A.range_hi": 1e8})
    options = {"command": "5 sin(2t)", "duration": 4.0, "step": 1e-4, "allow_unresolved": True}
    experiments = [
        Experiment.of(rig=rig, set={"F_l": force}, leak=leak, **options)
        for force, leak in ((0.0, None), (2000.0, "G = 1e-11 from 2 s"), (-2000.0, "G = 1e-12"))
    ]
    batch = simulate_batch(experiments, bounds=[0.0, 4.0])
    for k, experiment in enumerate(experiments):
        alone = rms_of(simulate_experiment(experiment).recording, [0.0, 4.0])
        np.testing.assert_allclose(batch.rms[k], alone, rtol=2e-3)
    assert np.all(np.ptp(batch.rms, axis=0) > 0)


def test_hum_is_read_as_by_itself_up_to_its_phase(check_rig, rms_of):
    values = {**FINE, "sensors.p_A.hum": 1e5, "sensors.p_A.hum_frequency": 50.0}
    one = Experiment.of(rig=check_rig(**values), command="0 sin(t)", duration=8.0)
    batch = simulate_batch([one], bounds=[0.0, 8.0])
    np.testing.assert_allclose(batch.rms[0, 0], rms_of(simulate_experiment(one).recording, [0.0, 8.0])[0], rtol=2e-3)
    assert batch.rms[0, 0, 0, 2] > 1e4
    swelling = replace(one, drifts=(ParameterDrift("sensors.p_A.hum", linear_path(0.8, 8.0)),))
    bounds = [0.0, 2.0, 6.0, 8.0]
    swelled = simulate_batch([swelling], bounds=bounds).rms[0, 0]
    np.testing.assert_allclose(swelled, rms_of(simulate_experiment(swelling).recording, bounds)[0], rtol=2e-3)
    assert swelled[2, 2] > 1.5 * swelled[0, 2]


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])  # without throttles, and with
def test_drifting_machines_are_what_they_are_by_themselves(rms_of, seed):
    one = draw("bench", seed, duration=12.0).experiment(duration=12.0)
    one = replace(one, rig=one.rig.with_overrides(FINE), step=5e-4 if one.rig.line.orifices == "absent" else 1e-3)
    one = replace(one, allow_unresolved=True)
    assert one.drifts
    bounds = [0.0, 6.0, 12.0]
    machine_drifts = tuple(drift for drift in one.drifts if not drift.parameter.startswith("sensors."))
    # a batch interpolates the drifts of instruments over seconds, which moves a few codes of the converter
    for experiment, within in ((one, 2e-3), (replace(one, drifts=machine_drifts), 1e-9)):
        alone = rms_of(simulate_experiment(experiment).recording, bounds)
        np.testing.assert_allclose(simulate_batch([experiment], bounds=bounds).rms[0], alone, rtol=within)


def test_drifting_and_leaking_machines_do_not_depend_on_those_beside_them():
    options = {"duration": 6.0, "command": "3 sin(4t)", "load": None, "step": 5e-4, "allow_unresolved": True}
    leaks = ["0.01 L/min from 3 s", "0.2 L/min orifice from 2 s", None]
    machines = [draw("bench", seed, duration=6.0) for seed in range(30)]
    free = [machine for machine in machines if machine.closed == 0.0][:3]
    experiments = [machine.experiment(leak=leak, **options) for machine, leak in zip(free, leaks, strict=True)]
    whole = simulate_batch(experiments)
    for k, experiment in enumerate(experiments):
        alone = simulate_batch([experiment])
        assert alone.coefficients[0] == whole.coefficients[k]
        np.testing.assert_array_equal(alone.rms[0], whole.rms[k])


def test_other_commands_are_what_they_are_by_themselves(rms_of):
    noisy = Experiment.of(command="prbs 1 every 0.5 s seed 4", set=QUIET, duration=8.0, **COMMON)
    result = simulate_batch([noisy], bounds=[0.0, 8.0]).rms[0]
    np.testing.assert_allclose(result, rms_of(simulate_experiment(noisy).recording, [0.0, 8.0]), rtol=1e-6)


def test_a_fault_of_the_machine_comes_in_when_it_does_by_itself(rms_of):
    one = Experiment.of(fault="friction x1.5 from 5.13 s", set=QUIET, duration=10.0, **COMMON)
    bounds = [0.0, 5.0, 10.0]
    result = simulate_batch([one], bounds=bounds).rms[0]
    np.testing.assert_allclose(result, rms_of(simulate_experiment(one).recording, bounds), rtol=1e-6)
    assert np.abs(result[0, 1] / result[0, 0] - 1.0).max() > 0.05


@pytest.mark.parametrize("onset", ["from 5 s", "growing from 4 s to 5 s"])
def test_a_fault_that_needs_a_shorter_step_gets_it_as_by_itself(onset):
    """It begins after the seconds of the run in which the step is sought."""
    one = Experiment.of(fault=f"friction x10 {onset}", set={"p_charge": "1 MPa"}, duration=6.0)
    assert simulate_batch([one]).steps[0] == simulate_experiment(one).recording.provenance["solver"]["step_s"] < 5e-4
    for simulate in (simulate_experiment, lambda experiment: simulate_batch([experiment])):
        with refusal("step", "0.0005 s", error=SimulationFailed):
            simulate(replace(one, step=5e-4))


def test_a_fault_that_has_hardly_begun_needs_no_shorter_step():
    one = Experiment.of(fault="friction x10 growing from 5 s to 200 s", set={"p_charge": "1 MPa"}, duration=6.0)
    assert simulate_batch([replace(one, step=5e-4)]).steps[0] == 5e-4


@pytest.mark.slow
def test_valves_in_the_lines_move_as_they_do_by_themselves(check_rig, rms_of):
    rig = check_rig(True, volumes="position", p_charge="2 MPa", G_circ=2e-10, **QUIET)
    moves = [f"{what} from 2 s to 3.1 s within 0.2 s" for what in ("shut-off A to 0 %", "circulation")]
    options = {"rig": rig, "command": "3 sin(4t)", "duration": 5.0, "step": 2.5e-4, "allow_unresolved": True}
    experiments = [Experiment.of(**options, fault=moves), Experiment.of(**options, fault="shut-off B to 5 % from 3 s")]
    bounds = [0.0, 2.2, 3.2, 5.0]
    batch = simulate_batch(experiments, bounds=bounds)
    for k, one in enumerate(experiments):  # cells are those of all runs of a set
        np.testing.assert_allclose(batch.rms[k], rms_of(simulate_experiment(one).recording, bounds), rtol=1e-4)
    assert np.abs(batch.rms[0, :, 1] / batch.rms[1, :, 1] - 1.0).min() > 0.05
    with refusal("step", error=SimulationFailed):  # where the pump's oil circulates
        stiff = rig.with_overrides({"G_circ": 2e-9})
        simulate_batch([Experiment.of(**options | {"rig": stiff, "allow_unresolved": False}, fault=moves)])


@pytest.mark.slow
def test_loads_push_side_by_side_as_they_do_by_themselves(check_rig, rms_of):
    """Over time, two kinds of them, and over position and velocity."""
    loads = [
        "300 N sin(3t)",
        "step 400 N at 2 s",
        "150 N sin(3t) + 40 N/mm over x from 1 mm + 2 kN s/m over v - 1 kN s/m over v from 5 mm/s",
    ]
    experiments = [
        Experiment.of(rig=check_rig(p_charge="2 MPa", F_v=300.0 + 20.0 * k, **QUIET), load=load, duration=6.0, **COMMON)
        for k, load in enumerate(loads)
    ]
    bounds = [0.0, 3.0, 6.0]
    batch = simulate_batch(experiments, bounds=bounds)
    for k, experiment in enumerate(experiments):
        alone = simulate_experiment(experiment)
        np.testing.assert_allclose(batch.rms[k], rms_of(alone.recording, bounds), rtol=1e-6)
    assert np.ptp(batch.rms[:, 0, 1, 2]) > 1.0


@pytest.mark.long
@pytest.mark.slow
def test_oil_boils_side_by_side_as_it_does_by_itself(check_rig, rms_of):
    values = {"p_vap": "2 kPa", "p_charge": "0 Pa", "F_v": 6000.0, **QUIET, "sensors.p_A.range_lo": -2e5}
    rig, bounds = check_rig(**values, **{"sensors.p_B.range_lo": -2e5}), [0.0, 6.0]
    one = Experiment.of(rig=rig, command="9 sin(4t)", duration=6.0, **COMMON)
    alone = simulate_experiment(one)
    assert alone.truth.outputs["p_B"].min() == 2e3 - 101325
    np.testing.assert_allclose(simulate_batch([one], bounds=bounds).rms[0], rms_of(alone.recording, bounds), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("volumes", ["fixed", "position"])  # of throttled rigs
def test_neither_order_nor_number_nor_threads_change_a_run(check_rig, volumes):
    experiments = [
        Experiment.of(
            rig=check_rig(k % 3 == 0, volumes="fixed" if k % 3 else volumes),
            command=f"{2 + k % 2} sin({3 + k % 2}t)",
            duration=6.0,
            seed=k,
            step=1e-3,
        )
        for k in range(11)
    ]
    whole = simulate_batch(experiments)
    for threads in (1, 3):
        order = np.random.default_rng(threads).permutation(11)
        shuffled = simulate_batch([experiments[k] for k in order], threads=threads)
        np.testing.assert_array_equal(shuffled.rms, whole.rms[order])
    np.testing.assert_array_equal(simulate_batch(experiments[4:5]).rms, whole.rms[4:5])
    assert np.unique(whole.rms[:, 0, 0, 0]).size == 11  # every seed has noise of its own


def test_a_leak_of_a_stated_mean_has_it(check_rig):
    experiments = [
        Experiment.of(rig=check_rig(), command="3 sin(4t)", leak=f"{mean} L/min {law} from 3 s", duration=8.0, seed=k)
        for k, (mean, law) in enumerate([(0.0042, "laminar"), (0.01, "orifice"), (0.05, "laminar")])
    ]
    batch = simulate_batch(experiments)
    np.testing.assert_allclose(batch.mean_leak_lpm, [0.0042, 0.01, 0.05], rtol=2e-3)
    alone = simulate_experiment(experiments[1]).truth
    assert batch.coefficients[1] == pytest.approx(alone.leaks[0].coefficient, rel=3e-3)
    with refusal("leak", "run 0", error=SimulationFailed):
        simulate_batch([Experiment.of(leak="1.5 L/min", command="1 sin(4t)", duration=2.0)])


def test_the_noise_is_white_and_of_the_stated_size(check_rig):
    one = Experiment.of(rig=check_rig(), command="0 sin(t)", duration=20.0, step=5e-4)
    batch = simulate_batch([replace(one, seed=k) for k in range(64)], bounds=[0.0, 20.0])
    sensors = one.rig.sensors
    for channel, name in enumerate(NAMES):
        step = one.rig.daq.step * (getattr(sensors, name).range_hi - getattr(sensors, name).range_lo) / 10.0
        expected = np.sqrt(getattr(sensors, name).noise ** 2 + sensors.common_noise**2 + step**2 / 12.0)
        mean_square = np.mean(batch.rms[:, channel, 0, :4] ** 2, axis=0)
        np.testing.assert_allclose(np.sqrt(mean_square), expected, rtol=6e-3)
    # common noise alone links the channels; it has that share of the power
    squares = batch.rms[:, :, 0, 0] ** 2
    assert np.corrcoef(squares.T)[0, 1] < 0.5


@kernel
def draw_normals(key, n, out):
    for k in range(n):
        one, two = normals(load(key, 0), k)
        store(out, 2 * k, one)
        store(out, 2 * k + 1, two)


@kernel
def elementary(x, out):
    for k in range(x.shape[0]):
        store(out, 2 * k, logarithm(load(x, k)))
        store(out, 2 * k + 1, half_turn_sine(load(x, k) - 0.5))


def test_the_normal_numbers_are_normal_and_independent():
    n = 50_000
    out = np.empty((2 * n, WIDTH))
    draw_normals(noise_keys(list(range(WIDTH)))[None].copy(), n, out)
    pvalues = [stats.kstest(out[:, lane], "norm").pvalue for lane in range(WIDTH)]
    assert min(pvalues) > 1e-4
    assert abs(np.mean(out**4) - 3.0) < 0.03
    between = np.corrcoef(out.T) - np.eye(WIDTH)
    assert np.abs(between).max() < 5.0 / np.sqrt(2 * n)
    for lag in (1, 2, 3, 6):
        assert np.abs(np.mean(out[lag:] * out[:-lag])) < 5.0 / np.sqrt(2 * n * WIDTH)
    again = np.empty((2 * n, WIDTH))
    draw_normals(noise_keys([7] * WIDTH)[None].copy(), n, again)
    np.testing.assert_array_equal(again[:, 0], out[:, 7])  # a key's numbers are the same in any lane


def test_the_elementary_functions_of_the_noise():
    x = np.r_[np.random.default_rng(0).random(8000), 2.0**-52, 1.0, 0.5, 0.25, 1e-12, 0.7071, 0.70711, 1 - 1e-9]
    out = np.empty((2 * x.size // WIDTH, WIDTH))
    elementary(x.reshape(-1, WIDTH), out)
    np.testing.assert_allclose(out[::2].ravel(), np.log(x), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(out[1::2].ravel(), np.sin(np.pi * (x - 0.5)), rtol=0, atol=1e-12)


def test_memory_does_not_grow_with_the_length_of_the_runs(check_rig):
    """Four times as long, they take no tenth of what the added samples would; other threads' memory counts, too."""

    def experiments(duration: float) -> list[Experiment]:
        return [Experiment.of(rig=check_rig(), duration=duration, seed=k, step=1e-3) for k in range(16)]

    def peak(duration: float) -> float:
        runs = experiments(duration)
        tracemalloc.start()
        simulate_batch(runs, threads=1)
        result = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return result

    def samples(duration: float) -> float:
        return sum(2 * run.sample_times().nbytes for run in experiments(duration))

    peak(10.0)
    assert peak(80.0) - peak(20.0) < 0.1 * (samples(80.0) - samples(20.0))


def test_the_changes_are_those_of_the_thesis_s_statistic(check_rig, rms_of):
    one = Experiment.of(rig=check_rig(**QUIET), leak="G = 3e-12 from 10 s", duration=20.0, step=5e-4)
    batch = simulate_batch([one])
    expected = rms_of(simulate_experiment(one).recording, [0.0, 10.0, 20.0])
    changes = np.array([[batch.changes(channel, detail)[0] for detail in QUANTITIES] for channel in NAMES])
    np.testing.assert_allclose(changes, 100.0 * (expected[:, 1] / expected[:, 0] - 1.0), atol=1e-3)
    assert batch.changes("p_A", "d3")[0] < -5.0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"leak": ["G = 1e-13", "C = 1e-11"]}, "leak, 2, run 1"),
        ({"fault": "sensor p_A offset -2 psi from 2 s"}, "fault, sensor, run 1"),
        ({"set": {"sensors.p_B.drop_rate": 0.1}}, "sensors.p_B.drop_rate, 0.1, run 1"),
        ({"set": {"motor.integrator": "euler"}}, "motor.integrator, euler, run 1"),
        ({"leak": "0.01 L/min", "fault": "oil +5 K"}, "leak, temperature, run 1"),
        ({"duration": 5.0}, "duration, 4, 5, run 1"),
    ],
)
def test_a_run_that_cannot_be_side_by_side_is_refused(values, words):
    with refusal(*words.split(", ")):
        simulate_batch([Experiment.of(duration=4.0), Experiment.of(**{"duration": 4.0, **values})])


def test_bad_calls_and_bad_runs_are_refused(check_rig):
    with refusal("batch", "none"):
        simulate_batch([])
    for bounds in ([0.0], [1.0, 1.0], [0.0, 9.0], [-1.0, 2.0]):
        with refusal("bounds", "4 s"):
            simulate_batch([Experiment.of(duration=4.0)], bounds=bounds)
    good = Experiment.of(rig=check_rig(), duration=4.0, step=1e-3)
    with refusal("run 1", "pressures", error=SimulationFailed):
        simulate_batch([good, replace(good, command=Experiment.of(command="9 sin(4t)").command, x_0=0.29)])
    with refusal("step", error=SimulationFailed):
        simulate_batch([replace(good, step=1 / 500)])


def test_late_channels_are_read_late(check_rig, rms_of):
    values = {**QUIET, "sensors.p_A.delay": "0.7 [ms]", "sensors.p_B.delay": "3 [ms]"}
    one = Experiment.of(rig=check_rig(**values), duration=6.0, step=5e-4)
    prompt = Experiment.of(rig=check_rig(**QUIET), duration=6.0, step=5e-4)
    bounds = [0.0, 1.01, 3.0, 6.0]
    batch = simulate_batch([one, prompt], bounds=bounds)
    np.testing.assert_allclose(batch.rms[0], rms_of(simulate_experiment(one).recording, bounds), rtol=1e-6)
    np.testing.assert_allclose(batch.rms[1], rms_of(simulate_experiment(prompt).recording, bounds), rtol=1e-6)
    assert np.abs(batch.rms[0] / batch.rms[1] - 1.0).max() > 1e-5


@pytest.mark.slow
def test_valve_controlled_runs_side_by_side_are_what_they_are_by_themselves(rms_of):
    bounds = [0.0, 2.5, 5.0]
    experiments = [
        Experiment.of(
            rig="servo-valve",
            command=f"{1 + 0.1 * k} sin(4t)",
            leak="G = 6e-13 from 2 s" if k % 2 else None,
            duration=5.0,
            seed=k,
            set={**QUIET, "o_PA": 1e-6 * k, "p_set": 7e6 + 1e5 * k},
            **(COMMON | {"step": 2.5e-4}),
        )
        for k in range(9)
    ]
    batch = simulate_batch(experiments, bounds=bounds)
    for k, one in enumerate(experiments):
        alone = simulate_experiment(one)
        np.testing.assert_allclose(batch.rms[k], rms_of(alone.recording, bounds), rtol=1e-6)
        assert batch.mean_leak_lpm[k] == pytest.approx(alone.truth.mean_leak_lpm, rel=1e-4, abs=1e-12)


def test_a_batch_tells_its_numbers_by_name(monkeypatch):
    runs = [Experiment.of(duration=4.0, seed=seed) for seed in range(2)]
    batch = simulate_batch(runs, bounds=[0.0, 1.5, 2.5, 4.0])
    assert (len(batch), repr(batch)) == (2, "<Batch: 2 runs, segments between 0, 1.5, 2.5, 4 s>")
    np.testing.assert_array_equal(batch.rms_of("p_B", "d3d4"), batch.rms[:, 1, :, 4])
    with refusal("channel", "'p_C'", "p_A"):
        batch.changes("p_C", "d3")
    with refusal("detail", "'d5'", "d1"):
        batch.rms_of("p_A", "d5")
    pytest.importorskip("pandas")
    table = batch.to_pandas()
    assert list(table["run"]) == [0, 0, 0, 1, 1, 1]
    assert list(table["stop [s]"]) == [1.5, 2.5, 4.0] * 2
    np.testing.assert_array_equal(table["d3 of p_A [Pa]"], batch.rms_of("p_A", "d3").ravel())
    monkeypatch.setitem(sys.modules, "pandas", None)
    with refusal("pandas", error=MissingExtra):
        batch.to_pandas()


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"experiments": ["3 sin(4t)"]}, "a batch, '3 sin(4t)'"),
        ({"error": "20[m]"}, "error"),
        ({"thread": 1}, "simulate_batch, 'thread', 'threads'"),
    ],
)
def test_a_wrong_batch_is_refused_by_name(parts, words):
    with refusal(*words.split(", ")):
        simulate_batch(**{"experiments": [Experiment.of(duration=1.0)], **parts})
