"""Blocks of a balance from samples: streams equal recordings, and what must not change an answer does not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sealscope as ss
from sealscope.diagnosis.estimate.change import StepTest, step_test
from sealscope.diagnosis.inference.block_stream import BlockStream
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, estimate_offset, information
from sealscope.diagnosis.inference.equations.balances import equations
from sealscope.diagnosis.inference.regimes import recorded_blocks
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

from ..representatives import few
from .balance_machine import DISPLACEMENT, irregular, machine, step

RIG = load_rig("thesis")
READ = ("theta", "x", "p_A", "p_B", "p_1", "p_2")
LEAK = 1e-13  # m^3/(s Pa): 0.001 L/min at 1.6 bar


@cache
def leaking(leak: float = LEAK, duration: float = 60.0, seed: int = 1, load: float = 0.0) -> Recording:
    return machine(
        seed, G=step(0.0, leak, 0.5 * duration), speed=irregular(3), load=load, duration=duration, x_step=0.0
    )


def changed(recording: Recording, **changes: Callable[[Mapping[str, np.ndarray]], np.ndarray]) -> Recording:
    channels = {**recording.channels, **{name: of(recording.channels) for name, of in changes.items()}}
    return Recording(recording.t, channels, recording.units, recording.rate)


def judged(recording: Recording) -> tuple[StepTest, Blocks]:
    made = recorded_blocks(recording, RIG)
    assert made is not None
    regime = made.regime(made.odds)
    blocks, columns = regime.blocks, regime.columns
    test = step_test(information(blocks, columns, columns[0].leak))
    assert test is not None
    return test, blocks


def same(first: StepTest, second: StepTest, rel: float) -> None:
    assert second.score == pytest.approx(first.score, rel=rel, abs=rel)
    assert np.array(second.fitted) == pytest.approx(np.array(first.fitted), rel=rel)
    assert second.onsets[second.best] == pytest.approx(first.onsets[first.best])


@settings(deadline=None, max_examples=8)
@given(st.lists(st.integers(1, 3000), min_size=1, max_size=12), st.sampled_from([1, 3, 5]))
def test_pieces_of_any_size_make_the_same_blocks(sizes: list[int], support: int) -> None:
    recording = leaking(duration=20.0)
    samples = {name: recording[name].copy() for name in READ}
    samples["p_A"][1500:1510] = np.nan
    balances = equations(RIG, frozenset(READ))

    def made(cuts: np.ndarray) -> Blocks:
        stream = BlockStream(balances, recording.rate, 1.0, support)
        ends = [*cuts, recording.t.size]
        starts = [0, *cuts]
        parts = [
            stream.push({name: values[start:end] for name, values in samples.items()}, last=end == ends[-1])
            for start, end in zip(starts, ends, strict=True)
        ]
        return Blocks.join([part for part in parts if part is not None])

    cuts = np.cumsum(sizes)
    whole, pieces = made(np.array([], dtype=int)), made(cuts[cuts < recording.t.size])
    assert len(whole) == len(pieces) >= 17
    for name in ("start", "end", "rows", "flow", "pressures"):
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), rtol=1e-9)
    size = np.sqrt(np.einsum("keii->kei", whole.gram))
    scale = np.maximum(size[..., :, None] * size[..., None, :], 1e-300)
    np.testing.assert_allclose(pieces.gram / scale, whole.gram / scale, atol=1e-9)


def test_missing_samples_cost_their_rows_only() -> None:
    recording = leaking()
    lost = np.zeros(recording.t.size, dtype=bool)
    lost[3000:3100] = lost[9000:9400] = True
    absurd = changed(recording, p_A=lambda c: np.where(lost, 1e9, c["p_A"]), x=lambda c: np.where(lost, -7.0, c["x"]))
    gap = Recording(recording.t, absurd.channels, recording.units, recording.rate, bridged=lost)
    whole, left = judged(recording), judged(gap)
    assert whole[1].rows.sum() - left[1].rows.sum() <= 30  # 2.5 s of strides, and a span at each end of two gaps
    assert left[0].score == pytest.approx(whole[0].score, rel=0.3)
    assert left[0].fitted[0] == pytest.approx(LEAK, abs=4.0 * left[0].fitted[1])


@pytest.mark.parametrize("load", [0.0, 2e5])
def test_swapped_sides_and_reversed_encoders_change_nothing(load: float) -> None:
    recording = leaking(load=load)
    test, _ = judged(recording)
    assert test.score > 30.0
    swapped = {
        name: (lambda c, other=other: c[other])
        for name, other in zip(READ[2:], ("p_B", "p_A", "p_2", "p_1"), strict=True)
    }
    backwards = {name: (lambda c, name=name: -c[name]) for name in ("theta", "x")}
    for changes in ({**swapped, **backwards}, {"theta": backwards["theta"]}, {"x": backwards["x"]}, backwards, swapped):
        same(test, judged(changed(recording, **changes))[0], rel=2e-3)


def test_a_position_that_is_late_is_late_whatever_its_sign() -> None:
    recording = leaking()
    late = round(0.02 * recording.rate)  # samples

    def delay(sign: float) -> float:
        moved = changed(recording, x=lambda c: sign * np.concatenate([np.full(late, c["x"][0]), c["x"][:-late]]))
        balance = VolumeBalance(RIG).balance(moved)
        assert balance is not None and balance.position_delay is not None
        return balance.position_delay.value

    assert delay(1.0) == pytest.approx(0.02, abs=0.004)
    assert delay(-1.0) == pytest.approx(delay(1.0), rel=1e-3)


def test_clipped_peaks_of_a_pressure_still_drive_the_leak() -> None:
    """They lose their rows, but the mean pressure hardly changes."""
    recording = leaking(load=2e5)
    side = max(("p_A", "p_B"), key=lambda name: float(recording[name].mean()))  # that of the load
    highest = np.quantile(recording[side], 0.8)
    clipped = changed(recording, **{side: lambda c: np.minimum(c[side], highest)})
    whole, left = judged(recording)[1], judged(clipped)[1]
    assert left.rows.sum() < 0.8 * whole.rows.sum()
    assert left.pressure_weights == pytest.approx(whole.pressure_weights)
    mean_pressures = [
        np.average(blocks.mean_pressure(0.0), weights=blocks.pressure_weights) for blocks in (whole, left)
    ]
    recorded = np.abs(clipped["p_A"] - clipped["p_B"]).mean()
    assert mean_pressures[1] == pytest.approx(recorded, rel=0.03)
    assert 0.9 * mean_pressures[0] < mean_pressures[1] <= mean_pressures[0]


def test_a_press_whose_pump_moves_more_oil_outward_than_back_is_wired_as_it_is() -> None:
    """The rod takes no oil back, and the press presses only at the end: its strokes do no work against the mean load.

    Speed and leakage passed for reversed on such days, and the healthy leakage of a press varied from -1 to 1.
    """
    seal, pressed, cycle, working = 2e-14, 60e5, 10.0, 200.0

    def speed(t: np.ndarray) -> np.ndarray:
        phase = t % cycle  # out, pressing against what leaks, back, a rest
        stroke = 10.0 * np.sin(0.5 * np.pi * phase)
        cycles = np.select(
            [phase < 2.0, phase < 6.0, phase < 8.0], [stroke, seal * pressed / DISPLACEMENT, stroke], 0.0
        )
        return np.where(t < working, cycles, 0.0)

    def load(t: np.ndarray) -> np.ndarray:
        phase = np.where(t < working, t % cycle, 0.0)
        return pressed * np.clip((phase - 2.0) / 0.3, 0.0, 1.0) * np.clip((6.0 - phase) / 0.3, 0.0, 1.0)

    def without_rod(c: Mapping[str, np.ndarray]) -> np.ndarray:
        turned = np.diff(c["theta"], prepend=c["theta"][0])
        return np.cumsum(np.where(turned < 0.0, 0.5 * turned, turned))

    press = changed(machine(1, speed=speed, load=load, duration=working + 12.0, G_pump=seal), theta=without_rod)
    balance = VolumeBalance(RIG).balance(press)
    assert balance is not None
    assert balance.conductance.value / seal == pytest.approx(1.0, rel=0.05)


def test_a_machine_that_brakes_what_others_drive_is_wired_as_it_is() -> None:
    """A die cushion: the load drives the piston both ways, so that the pressures work against the motion."""
    cushion = machine(1, speed=irregular(3), load=lambda t: -2e6 * np.sign(irregular(3)(t)), G_pump=5e-13)
    balance = VolumeBalance(RIG).balance(cushion)
    assert balance is not None
    assert balance.conductance.value == pytest.approx(5e-13, rel=0.1)


@pytest.mark.parametrize("rate", [2.0, 10.0])
def test_a_slow_logger_of_a_slow_machine_tells_a_leak(rate: float) -> None:
    """As a plant's historian records a gate or a turbine's valve."""
    slow = machine(
        2, G=step(0.0, LEAK, 1200.0), speed=lambda t: 12.0 * np.sin(0.1 * t), duration=2400.0, rate=rate, x_step=0.0
    )
    assert VolumeBalance(RIG).usable(slow) is None
    test, _ = judged(slow)
    assert test.score > 30.0
    assert test.fitted[0] == pytest.approx(LEAK, abs=4.0 * test.fitted[1])
    assert test.onset().low < 1200.0 < test.onset().high


def test_units_of_a_file_change_nothing(tmp_path: Path) -> None:
    recording = leaking(duration=30.0)
    tables = {
        "si": {"theta [rad]": 1.0, "x [m]": 1.0, "p_A [Pa]": 1.0, "p_B [Pa]": 1.0, "p_1 [Pa]": 1.0, "p_2 [Pa]": 1.0},
        "rig": {"theta [deg]": 180.0 / np.pi, "x [mm]": 1e3, "p_A [bar]": 1e-5, "p_B [kPa]": 1e-3,
                "p_1 [MPa]": 1e-6, "p_2 [bar]": 1e-5},
    }  # fmt: skip
    tests = []
    for name, table in tables.items():
        columns = [recording.t, *(recording[head.split()[0]] * factor for head, factor in table.items())]
        path = tmp_path / f"{name}.csv"
        np.savetxt(path, np.column_stack(columns), fmt="%.15g", delimiter=",", header="t [s]," + ",".join(table),
                   comments="")  # fmt: skip
        tests.append(judged(ss.read(path))[0])
    same(*tests, rel=1e-6)


@pytest.mark.parametrize("load", [0.0, 3e5])
@pytest.mark.parametrize(
    ("side", "shift"), few([("p_A", -6e5), ("p_B", 6e5), ("p_A", 1e5), ("p_A", 3e5), ("p_B", -1e5)])
)
def test_a_shifted_zero_leaves_score_and_size(side: str, shift: float, load: float) -> None:
    recording = leaking(5e-13, load=load)
    test, blocks = judged(recording)
    moved, apart = judged(changed(recording, **{side: lambda c: c[side] + shift}))
    assert moved.score == pytest.approx(test.score, rel=0.1)
    assert moved.fitted[0] == pytest.approx(test.fitted[0], rel=0.05)
    assert moved.onsets[moved.best] == pytest.approx(test.onsets[test.best], abs=1.0)
    added = shift if side == "p_A" else -shift
    columns = tuple(ColumnRoles(balance) for balance in equations(RIG, frozenset(recording.channels)))
    zeros = [estimate_offset(own, columns) for own in (apart, blocks)]
    assert zeros[0] - zeros[1] == pytest.approx(added, abs=2e4 + 0.03 * abs(added))
    # what a leak passes: coefficient times mean size of the pressure difference about its zero
    flows = [
        own.fitted[0] * float(of.mean_pressure(zero).mean())
        for own, of, zero in zip((moved, test), (apart, blocks), zeros, strict=True)
    ]
    assert flows[0] == pytest.approx(flows[1], rel=0.05)


def test_a_shifted_zero_makes_no_leak() -> None:
    for seed in range(4):
        healthy = leaking(0.0, seed=seed)
        for shift in (-6e5, 3e5):
            test, _ = judged(changed(healthy, p_A=lambda c, shift=shift: c["p_A"] + shift))
            assert test.chance > 1e-3


def test_a_glitch_does_not_decide() -> None:
    recording = leaking(5e-13)
    test, _ = judged(recording)
    for name, size in (("p_A", 3e7), ("x", 0.1), ("theta", 100.0)):
        moved, _ = judged(
            changed(recording, **{name: lambda c, n=name, s=size: c[n] + s * (np.arange(c[n].size) == 4000)})
        )
        assert moved.fitted[0] == pytest.approx(test.fitted[0], abs=4.0 * test.fitted[1])
        assert moved.score == pytest.approx(test.score, rel=0.25)


def test_the_score_grows_with_the_leak() -> None:
    scores = [judged(leaking(leak))[0].score for leak in (0.0, 5e-14, 1e-13, 2e-13, 5e-13, 1e-12)]
    assert (np.diff(scores) > 0.0).all()
    assert scores[0] < 12.0 < scores[2]


@pytest.mark.slow
@pytest.mark.long
def test_longer_recordings_never_widen_the_interval() -> None:
    deviations = []
    for duration in (20.0, 40.0, 80.0, 160.0):
        result = [judged(leaking(duration=duration, seed=seed))[0].fitted for seed in (1, 2, 3)]
        deviations.append(np.mean([deviation for _, deviation in result]))
        assert np.mean([size for size, _ in result]) == pytest.approx(LEAK, abs=4.0 * deviations[-1] / np.sqrt(3.0))
    assert (np.diff(deviations) < 0.0).all()
    assert deviations[-1] < 0.6 * deviations[0]
