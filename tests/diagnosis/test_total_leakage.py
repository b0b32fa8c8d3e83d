"""What pump and piston pass without a baseline: a leak from the first sample, and what `no leak` rests on."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording
from sealscope.reporting.messages import diagnosis_text, total_leakage
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

from ..representatives import SLOW, few
from .balance_machine import machine, step
from .judging import judge

LPM = 6.0e4
#: Leaks from the start [m^3/(s Pa)] beside those of the pump of 2.4e-13.
PUMP, WORN = 2.4e-13, 1.0e-12


def rig(G_healthy: float | None) -> Rig:
    own = load_rig("thesis")
    return (
        own.with_overrides({"pump.G_healthy": "0 m^3/(s Pa)"})
        if G_healthy is None
        else own.with_overrides({"pump.G_healthy": f"{G_healthy} m^3/(s Pa)"})
    )


def flow(recording: Recording, G: float) -> float:
    return G * float(np.mean(np.abs(recording["p_A"] - recording["p_B"]))) * LPM


@pytest.mark.parametrize("law", few(["laminar", "orifice"], 1, SLOW))
def test_a_leak_from_the_first_sample_is_stated(law: str) -> None:
    """It read "no leak; keep this recording as the baseline"."""
    worn, lost = machine(1, G=WORN), WORN
    if law == "orifice":
        C = WORN * float(np.sqrt(1.1e5))
        worn = machine(1, C=C)
        dp = np.abs(worn["p_A"] - worn["p_B"])
        lost = C * float(np.mean(np.sqrt(dp)) / np.mean(dp))
    evidence = judge(VolumeBalance(rig(None)), worn)
    assert evidence.verdict == "no leak"
    total_leakage = evidence.total_leakage
    assert total_leakage is not None
    low, high = total_leakage.interval_lpm
    assert low <= flow(worn, PUMP + lost) <= high
    assert high - low < 0.25 * total_leakage.lpm
    assert total_leakage.pressure == pytest.approx(np.mean(np.abs(worn["p_A"] - worn["p_B"])), rel=0.05)
    assert total_leakage.healthy_lpm is None
    assert not total_leakage.healthy
    assert evidence.course is not None
    assert evidence.course.whole
    if law == "laminar":
        dp, seconds = np.abs(worn["p_A"] - worn["p_B"]), float(np.median(np.diff(evidence.course.t)))
        means = [np.mean(dp[np.abs(worn.t - middle) < 0.5 * seconds]) for middle in evidence.course.t]
        true = (PUMP + lost) * LPM * np.array(means)
        assert np.mean((evidence.course.low <= true) & (true <= evidence.course.high)) > 0.9


@pytest.mark.slow
def test_the_smallest_step_is_found_and_half_of_it_is_not() -> None:
    detector = VolumeBalance(rig(None))
    for seed in (1, 2, 3):
        smallest = judge(detector, machine(seed)).total_leakage
        assert smallest is not None
        assert smallest.findable_lpm is not None
        G = smallest.findable_lpm / LPM / smallest.pressure
        assert judge(detector, machine(seed, G=step(0.0, 1.3 * G))).verdict == "leak"
        assert judge(detector, machine(seed, G=step(0.0, 0.4 * G))).verdict == "no leak"


@pytest.mark.slow
def test_against_what_a_healthy_machine_passes() -> None:
    unworn, worn = machine(1), machine(1, G=WORN)
    known = VolumeBalance(rig(2.0 * PUMP))
    evidence = judge(known, worn)
    assert evidence.verdict == "leak"
    assert evidence.onset_s is None
    assert evidence.leak_lpm == pytest.approx(flow(worn, WORN + PUMP), rel=0.1)
    assert judge(known, worn).total_leakage.lpm == pytest.approx(flow(worn, WORN + PUMP), rel=0.05)
    assert judge(known, unworn).verdict == "no leak"


@pytest.mark.slow
def test_only_what_is_known_to_be_healthy_becomes_a_baseline() -> None:
    unworn, worn = machine(1), machine(1, G=WORN)
    advice = "keep this recording as a baseline"
    unknown, known = diagnose(worn, rig=rig(None)), diagnose(unworn, rig=rig(2.0 * PUMP))
    assert advice not in unknown.next_check
    assert advice not in known.next_check
    assert advice in diagnose(unworn, [machine(2), machine(3)]).next_check
    for diagnosis in (unknown, known):
        tree = diagnosis.as_dict()["total_leakage"]
        assert set(tree) == {
            "lpm", "interval_lpm", "pressure_Pa", "findable_lpm", "healthy_lpm", "pump_share", "findable_share"
        }  # fmt: skip
        assert total_leakage(diagnosis) is not None
        assert " ".join(total_leakage(diagnosis).split()) in " ".join(diagnosis_text(diagnosis).split())


def test_no_leak_only_where_one_worth_finding_would_have_shown() -> None:
    """Pressures so noisy that a fiftieth of the pump's flow would not show."""
    noisy = machine(4, p_noise=2.0e6, x_step=2.0e-3)
    evidence = judge(VolumeBalance(rig(None)), noisy)
    assert evidence.verdict == "cannot tell"


@pytest.mark.parametrize(
    ("command", "load"),
    [
        pytest.param("5 sin(2t)", 0.0, marks=pytest.mark.slow),
        pytest.param("5 sin(2t)", -3000.0, marks=pytest.mark.slow),
        pytest.param("3 sin(4t)", 2000.0, marks=pytest.mark.slow),
    ],
)
def test_a_single_rod_s_total_is_stated_from_the_first_sample(command: str, load: float) -> None:
    """An angle has no zero of the flow: what drifts over a cycle is what pump and piston pass together."""
    own = load_rig("single-rod-eha")
    loaded = {"cylinder.F_l": load}
    experiment = Experiment.of(rig=own, set=loaded, command=command, duration=60, leak="0.1 L/min from 0 s", seed=3)
    simulated = simulate_experiment(experiment)
    difference = simulated.truth.outputs["p_A"] - simulated.truth.outputs["p_B"]
    true = own.pump.G_pump * float(np.abs(difference).mean()) * LPM + simulated.truth.mean_leak_lpm
    diagnosis = diagnose(simulated.recording, rig=own)
    assert diagnosis.total_leakage is not None
    assert diagnosis.total_leakage.lpm == pytest.approx(true, rel=0.05)
    low, high = diagnosis.total_leakage.interval_lpm or pytest.fail("no interval")
    assert low <= true <= high
    worn = true / LPM / float(np.abs(difference).mean()) > own.pump.G_healthy
    assert diagnosis.verdict == ("leak" if worn else "no leak")


@pytest.mark.slow
@pytest.mark.parametrize(
    "stated", few([{"pump.q_b": "4.9[cm^3/rev]"}, {"cylinder.A_A": "633 mm^2", "cylinder.A_B": "633 mm^2"}], 1, SLOW)
)
def test_a_size_alone_says_nothing_of_what_a_healthy_pump_leaks(stated: dict[str, str]) -> None:
    """The pump of another rig is none of this machine's: with a size alone a worn or a large pump was a leak."""
    pump_leaks = machine(1, G=20 * PUMP)
    result = diagnose(pump_leaks, rig=unstated_rig().with_overrides(stated))
    assert result.verdict == "no leak" and result.total_leakage.healthy_lpm is None
    assert diagnose(pump_leaks, rig="thesis").verdict == "leak"


def test_the_limit_of_a_healthy_machine_is_compared_with_the_true_leakage() -> None:
    """Piston, leakage and limit twice as large: the recording is the same, and so is what exceeds the limit."""
    worn, excess = machine(1, G=WORN), []
    for factor in (1.0, 2.0):
        area = f"{factor * 633.0} mm^2"
        stated = {"cylinder.A_A": area, "cylinder.A_B": area, "pump.G_healthy": f"{factor * PUMP} m^3/(s Pa)"}
        detector = VolumeBalance(unstated_rig().with_overrides(stated))
        leak = detector.observe(worn).leak
        assert leak is not None and leak.excess is not None and leak.excess > 3.0
        excess.append(leak.excess)
    assert excess[1] == pytest.approx(excess[0], rel=1e-6)
