"""False alarms per 1000 operating hours of watched actuators that drift, and delays of leaks, in compressed time.

    python benchmarks/monitor_months.py [--hours 300] [--actuators 4] [--rate 20] [--minutes 8] [--leaks]

A library of blocks is cut from a simulated recording of the thesis's rig (20 min, other noise in each block). An
operating hour is made of them by their sums of products: a conductance g takes g times the integral of dp from the
displaced volume, and friction scales dp, both exactly. So an hour costs half a second in place of minutes, and no
sample is shared with what the tests were made on. Each actuator runs two shifts of 8 h a day and rests at night. Its
conductance is

    g(t) = g_0 4^((T - 20 K)/30 K) (1 + slow(t)),

where the oil warms from 20 to 50 C with a time constant of 1 to 3 h each morning and cools at night, slow is an
Ornstein-Uhlenbeck process of 3 % and 40 min, friction (dp) another of 10 % and 3 h. g_0 is drawn for 0.0004 to 0.003
L/min of cold oil. The baseline is learned over the first 8 h. Nobody says when a leak begins; an alarm is false where
none is there, and is dismissed as a person would.

With `--leaks` each actuator gets one leak after ten operating hours: steps of 0.002, 0.0042, 0.015 L/min, and a growth
from 0 to 0.005 L/min in a week.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace

import numpy as np
from scipy.special import gammaincinv

import sealscope as ss
from sealscope.diagnosis.volume_balance.blocks import I_AB, I_ROOT, BalanceBlocks, Y, balance_channels, block_samples
from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.growth import WARMEST
from sealscope.units import LITRE_PER_MINUTE

SHIFT_S, DAY_S = 16 * 3600.0, 24 * 3600.0
STEPS = (0.002, 0.0042, 0.015)
WEEK_LPM = 0.005
ONSET_S = 10 * 3600.0


def library(seed: int) -> tuple[ss.Recording, list[BalanceBlocks]]:
    """Return a recording and its blocks, each with its own noise."""
    recording = ss.simulate(command="3 sin(4t)", duration=1200.0, seed=seed).only(("x", "theta", "p_A", "p_B"))
    detector = VolumeBalance(ss.load_rig("thesis"))
    length = block_samples(recording.between(0.0, 60.0), 3.0)
    blocks = detector.blocks(recording, length, balance_channels(recording))
    return recording, [blocks.chosen(np.array([k])) for k in range(25, len(blocks))]


def changed(block: BalanceBlocks, t: float, g: float, friction: float) -> BalanceBlocks:
    """Return a block as of the clock t, with a conductance and with dp scaled."""
    turn = np.eye(block.gram.shape[1])
    turn[I_AB, I_AB], turn[I_ROOT, I_ROOT] = friction, math.sqrt(friction)
    turn[Y, I_AB] = -g * friction
    return replace(
        block,
        t=np.array([t]),
        gram=turn @ block.gram @ turn.T,
        slope=block.slope @ turn.T,
        stored=block.stored @ turn.T,
        abs_dp=block.abs_dp * friction,
        root_dp=block.root_dp * math.sqrt(friction),
    )


class Wander:
    """An Ornstein-Uhlenbeck process."""

    def __init__(self, random: np.random.Generator, size: float, seconds: float) -> None:
        self._random, self._size, self._seconds = random, size, seconds
        self.value = size * random.standard_normal()

    def after(self, seconds: float) -> float:
        """Return the value after so many seconds."""
        keep = math.exp(-seconds / self._seconds)
        self.value = keep * self.value + self._size * math.sqrt(1.0 - keep**2) * self._random.standard_normal()
        return self.value


def main() -> None:
    """Watch, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=300.0, help="operating hours of each actuator")
    parser.add_argument("--actuators", type=int, default=4)
    parser.add_argument("--rate", type=float, default=20.0, help="stated false alarms per 1000 h")
    parser.add_argument("--minutes", type=float, default=8.0, help="no further actuator is begun after so long")
    parser.add_argument("--leaks", action="store_true", help="each actuator gets a leak after ten hours")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    recording, blocks = library(chosen.seed)
    flow = float(np.mean([block.abs_dp[0] for block in blocks])) / LITRE_PER_MINUTE
    began, hours, false = time.monotonic(), 0.0, 0
    by_test: dict[str, int] = {}
    for number in range(chosen.actuators):
        if time.monotonic() - began > 60.0 * chosen.minutes:
            break
        random = np.random.default_rng([chosen.seed, number])
        cold = random.uniform(0.0004, 0.003) / flow
        tau = random.uniform(1.0, 3.0) * 3600.0
        slow, friction = Wander(random, 0.03, 2400.0), Wander(random, 0.1, 3 * 3600.0)
        watch = ss.watch("thesis", false_alarms_per_1000_h=chosen.rate, learn_hours=8.0)
        watch.update(recording.between(0.0, 61.0))
        watch.dismiss()
        seconds = blocks[0].seconds
        day_s = warm = ran = 0.0
        day, opened = 0, 0.0
        kind = number % (len(STEPS) + 1)
        while ran < chosen.hours * 3600.0:
            day_s += seconds
            if day_s > SHIFT_S:
                day, day_s = day + 1, 0.0
                warm *= math.exp(-(DAY_S - SHIFT_S) / tau)
            ran += seconds
            clock = 1000.0 + day * DAY_S + day_s
            warm += (1.0 - warm) * (1.0 - math.exp(-seconds / tau))
            g = cold * WARMEST**warm * (1.0 + slow.after(seconds))
            lpm = 0.0
            if chosen.leaks and ran > ONSET_S:
                opened = opened or clock
                since = clock - opened
                lpm = STEPS[kind] if kind < len(STEPS) else min(1.0, since / (7 * DAY_S)) * WEEK_LPM
            scaled = math.exp(friction.after(seconds))
            block = changed(blocks[random.integers(len(blocks))], clock, g + lpm / flow, scaled)
            estimate = watch.judged(block, clock + 0.5 * seconds)
            if watch.leak is None:
                continue
            leak = watch.leak
            if lpm > 0.0:
                size = "no L/min" if leak.leak_lpm is None else f"{estimate.leak_lpm:.4f} L/min"
                low, high = estimate.leak_interval_lpm or (math.nan, math.nan)
                after = (clock - opened) / 3600.0
                print(
                    f"actuator {number}: true {lpm * scaled:.4f} L/min, alarm ({leak.test}) {after:.3f} h"
                    f" after the onset, states {size} ({low:.4f} to {high:.4f})"
                )
                break
            false += 1
            by_test[leak.test] = by_test.get(leak.test, 0) + 1
            watch.dismiss()
        else:
            if chosen.leaks:
                print(f"actuator {number}: true {lpm:.4f} L/min at the end, no alarm")
        hours += ran / 3600.0
        print(f"actuator {number}: {ran / 3600:.0f} h, {false} false alarms so far {by_test}", flush=True)
    low = float(gammaincinv(false, 0.025)) if false else 0.0
    high = float(gammaincinv(false + 1, 0.975))
    print(
        f"{false} false alarms in {hours:.0f} h: {1000 * false / hours:.2f} per 1000 h "
        f"(95 %: {1000 * low / hours:.2f} to {1000 * high / hours:.2f}), stated {chosen.rate:g}"
    )


if __name__ == "__main__":
    main()
