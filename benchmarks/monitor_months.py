"""A month of watched actuators that drift: false alarms per 1000 operating hours, and delays of leaks.

    python benchmarks/monitor_months.py [--actuators 50] [--days 30] [--minutes-a-day 96] [--rate 1] [--stop-after 8]

Libraries of blocks' conductances are made from simulated recordings of the thesis's rig (20 min each, other noise in
each block), at three charge pressures and two levels of the pressures' noise. An operating hour is made of them: a
conductance g is added to what a block's own is off the level, and friction scales dp, and with it what noise makes of a
conductance. So an hour costs a third of a second in place of minutes, and no sample is shared with what the tests were
made on. Each actuator works in two shifts of 8 h a day. Of these, `--minutes-a-day` in one piece, drawn anew for each
day, are watched: time is compressed by that, and a delay is stated in watched hours too. Of the first day it is the
first shift, over which the baseline is learned. The conductance is

    g(t) = g_0 4^((T - 20 K)/30 K) (1 + slow(t)),

where the oil warms from 20 to 50 C with a time constant of 1 to 3 h each morning and cools at night, slow is an
Ornstein-Uhlenbeck process of 3 % and 40 min, friction (dp) another of 10 % and 3 h, charge pressure a third of 20 % and
6 h, and noise changes from one day to the next. g_0 is drawn for 0.0004 to 0.003 L/min of cold oil. Nobody says when a
leak begins; an alarm is false where none is there, and is dismissed as a person would.

Five of the actuators leak from the tenth day on: a growth from 0 to 0.005 L/min in a week, steps of 0.002, 0.0042 and
0.015 L/min, and 0.0042 L/min, at the charge pressure, past a rod seal to the outside. For the last, as its cause shows
in more than the conductance, the tenth day is a recording with that fault, sample by sample.

Each actuator is a row of `results/monitor_months.csv`; a second call goes on with those that are missing, and the sum
over all rows with the same settings is printed. Rows of other sources (`source`, a hash) are dropped.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.special import gammaincinv
from stored_rows import StoredRows
from threadpoolctl import threadpool_limits

import sealscope as ss
from sealscope.diagnosis.live.estimates import BlockEstimate
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.live_balance import BlockConductance, LiveBalance, NotJudged
from sealscope.diagnosis.priors.inference import INFERENCE

RESULTS = Path(__file__).parent / "results" / "monitor_months.csv"
SHIFT_S, DAY_S = 16 * 3600.0, 24 * 3600.0
LEARN_H = 8.0
STEPS = {"step 0.002": 0.002, "step 0.0042": 0.0042, "step 0.015": 0.015}
GROWTH, WEEK_LPM, OUTSIDE, OUTSIDE_LPM = "growth to 0.005 in a week", 0.005, "outside 0.0042", 0.0042
KINDS = (GROWTH, *STEPS, OUTSIDE)
#: The day on which leaks begin, in the midst of what is watched of it.
ONSET_DAY = 10
#: Duration of the recording with a leak to the outside, which begins in the midst [s].
OUTSIDE_S = 1200.0
#: Charge pressures [MPa] and factors of the pressures' noise of the libraries.
CHARGES, NOISES = (0.24, 0.3, 0.36), (1.0, 1.6)
NOISE_PSI = {"p_A": 0.92829, "p_B": 1.26445}
COLUMNS = (
    *("seed", "actuator", "kind"),
    *("operating_hours", "false_alarms", "by_test", "delay_h", "delay_watched_h", "test", "cause"),
    *("true_lpm", "stated_lpm", "stated_low_lpm", "stated_high_lpm"),
)
Libraries = dict[tuple[float, float], list[BlockConductance]]
WARMEST = INFERENCE.oil.warmest


def simulate(seed: int, duration: float, charge: float, noise: float, fault: str | None = None) -> ss.Recording:
    """Simulate the rig at a charge pressure [MPa]; `noise` is a factor of the pressures' noise."""
    return ss.simulate(
        command="3 sin(4t)",
        duration=duration,
        seed=seed,
        set={
            "makeup.check_valves": "present",  # else a leak to the outside empties the circuit
            "p_charge": f"{charge} MPa",
            **{f"sensors.{name}.noise": f"{noise * psi} psi" for name, psi in NOISE_PSI.items()},
        },
        fault=fault,
    ).only(("x", "theta", "p_A", "p_B"))


def libraries(seed: int) -> tuple[ss.Recording, Libraries]:
    """Return a recording, and blocks, each with its own noise, by charge pressure and noise."""
    made, first = Libraries(), None
    keys = [(charge, noise) for charge in CHARGES for noise in NOISES]
    for number, (charge, noise) in enumerate(keys):
        recording = simulate(100 * seed + number, 1200.0, charge, noise)
        first = first or recording
        live = LiveBalance(ss.load_rig("thesis"), tuple(recording.channels))
        shown = live.take(SampleRun(recording.t, recording.channels, recording.rate, follows=False))
        made[charge, noise] = [block for blocks in shown if not isinstance(blocks, NotJudged) for block in blocks][25:]
    assert first is not None
    return first, made


def changed(block: BlockConductance, begin: float, g: float, friction: float, level: float) -> BlockConductance:
    """Return a block as of the clock `begin`, with g in place of a level of conductance, and with dp scaled."""
    conductance = g + (block.g - level) / friction
    return block._replace(
        begin=begin,
        end=begin + block.end - block.begin,
        g=conductance,
        total=conductance,
        sd=block.sd / friction,
        pressure=block.pressure * friction,
    )


class Wander:
    """An Ornstein-Uhlenbeck process."""

    def __init__(self, random: np.random.Generator, size: float, seconds: float) -> None:
        self._random, self._size, self._seconds = random, size, seconds
        self.value = size * random.standard_normal()

    def after(self, seconds: float) -> float:
        """Return the value after so many seconds."""
        decay = math.exp(-seconds / self._seconds)
        self.value = decay * self.value + self._size * math.sqrt(1.0 - decay**2) * self._random.standard_normal()
        return self.value


def warmed(warm: float, seconds: float, tau: float) -> float:
    """Return how warm the oil is, from 0 to 1, after so many seconds of work."""
    return 1.0 - (1.0 - warm) * math.exp(-seconds / tau)


class Life:
    """One actuator over a month."""

    def __init__(self, recording: ss.Recording, made: Libraries, chosen: argparse.Namespace, number: int) -> None:
        self.random = np.random.default_rng([chosen.seed, number])
        usual = made[CHARGES[1], NOISES[0]]
        self.seconds = usual[0].end - usual[0].begin
        self.flow = float(np.mean([block.lpm for block in usual]))
        self.levels = {key: float(np.mean([block.g for block in blocks])) for key, blocks in made.items()}
        self.made, self.chosen = made, chosen
        self.kind = KINDS[number] if number < len(KINDS) else ""
        self.watch = ss.watch("thesis", false_alarms_per_1000_h=chosen.rate, learn_hours=LEARN_H)
        self.watch.update(recording.between(0.0, 61.0))
        self.watch.relearn()

    def lpm(self, since: float) -> float:
        """Return the leak at so many seconds since its onset."""
        if since <= 0.0 or not self.kind:
            return 0.0
        return STEPS[self.kind] if self.kind in STEPS else min(1.0, since / (7 * DAY_S)) * WEEK_LPM

    def lived(self) -> dict[str, object]:
        """Return what happened."""
        random, watch, flow = self.random, self.watch, self.flow
        cold, tau = random.uniform(0.0004, 0.003) / flow, random.uniform(1.0, 3.0) * 3600.0
        slow, friction = Wander(random, 0.03, 2400.0), Wander(random, 0.1, 3 * 3600.0)
        charge, noise, warm, before = Wander(random, 0.2, 6 * 3600.0), NOISES[0], 0.0, 0.0
        onset = math.inf
        ran, leaked, false = 0.0, 0.0, Counter[str]()
        for day in range(round(self.chosen.days)):
            piece = 60.0 * self.chosen.minutes_a_day if day else 3600.0 * LEARN_H
            start = day * DAY_S + (random.uniform(0.0, SHIFT_S - piece) if day else 0.0)
            noise = NOISES[random.integers(len(NOISES))]
            if day:
                warm = math.exp((SHIFT_S - DAY_S) / tau) * warmed(warm, SHIFT_S - before % DAY_S, tau)
            warm = warmed(warm, start % DAY_S, tau)
            if day == ONSET_DAY:
                if self.kind == OUTSIDE:
                    return self.outside(1000.0 + start, ran, false)
                onset = start + 0.5 * piece
            for k in range(math.floor(piece / self.seconds)):
                clock = start + k * self.seconds
                passed = clock - before
                if k:
                    warm = warmed(warm, passed, tau)
                before = clock
                scaled = math.exp(friction.after(passed))
                level = CHARGES[1] * (1.0 + charge.after(passed))
                nearest = min(CHARGES, key=lambda value: abs(value - level))
                blocks = self.made[nearest, noise]
                lpm = self.lpm(clock - onset)
                g = cold * WARMEST**warm * (1.0 + slow.after(passed)) + lpm / flow
                drawn = blocks[random.integers(len(blocks))]
                estimate = watch.judge([changed(drawn, 1000.0 + clock, g, scaled, self.levels[nearest, noise])])
                leaked = ran if clock <= onset else leaked
                ran += self.seconds
                if watch.leak is None:
                    continue
                if self.kind and clock > onset:
                    return {
                        **self.row(ran, false),
                        "delay_h": (clock + self.seconds - onset) / 3600.0,
                        "delay_watched_h": (ran - leaked) / 3600.0,
                        "true_lpm": lpm * scaled,
                        **self.stated(estimate),
                    }
                false[watch.leak.test] += 1
                watch.dismiss()
        return self.row(ran, false)

    def outside(self, clock: float, ran: float, false: Counter[str]) -> dict[str, object]:
        """Return what happens on a day that is a recording with a leak to the outside."""
        seed = 100 * self.chosen.seed + len(self.made)
        onset = 0.5 * OUTSIDE_S
        recording = simulate(seed, OUTSIDE_S, CHARGES[1], NOISES[0], f"rod seal A {OUTSIDE_LPM} L/min from {onset:g} s")
        leaking = recording.between(onset, OUTSIDE_S)
        # stated at the charge pressure, it flows under that of its chamber
        true_lpm = OUTSIDE_LPM * float(leaking["p_A"].mean()) / (1e6 * CHARGES[1])
        samples = ss.Recording(
            clock + recording.t, recording.channels, recording.units, rate=recording.rate, provenance={}
        )
        raised = math.nan
        for estimate, leak in self.watch.each(samples):
            if leak is not None and estimate.t < clock + onset:
                false[leak.test] += 1
                self.watch.dismiss()
            elif leak is not None and math.isnan(raised):
                raised = estimate.t
        row = self.row(ran + OUTSIDE_S, false)
        if math.isnan(raised):
            return row
        delay = (raised - clock - onset) / 3600.0
        # stated when the cause has settled, at the end
        stated = self.stated(estimate)
        return {**row, "delay_h": delay, "delay_watched_h": delay, "true_lpm": true_lpm, **stated}

    def stated(self, estimate: BlockEstimate) -> dict[str, object]:
        """Return what is stated of the detected leak."""
        leak = self.watch.leak
        assert leak is not None
        low, high = estimate.leak_interval_lpm or ("", "")
        return {
            "test": leak.test,
            "cause": leak.cause,
            "stated_lpm": estimate.leak_lpm,
            "stated_low_lpm": low,
            "stated_high_lpm": high,
        }

    def row(self, ran: float, false: Counter[str]) -> dict[str, object]:
        """Return the columns of every actuator."""
        tests = " ".join(f"{test}:{count}" for test, count in sorted(false.items()))
        return {
            "kind": self.kind or "healthy",
            "operating_hours": f"{ran / 3600.0:.2f}",
            "false_alarms": false.total(),
            "by_test": tests,
        }


def main() -> None:
    """Watch, write a row an actuator, and print the sum."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--actuators", type=int, default=50)
    parser.add_argument("--days", type=float, default=30.0)
    parser.add_argument("--minutes-a-day", type=float, default=96.0, help="that are watched, of 16 hours of operation")
    parser.add_argument("--rate", type=float, default=1.0, help="stated false alarms per 1000 h")
    parser.add_argument("--stop-after", type=float, default=8.0, help="no actuator is begun after so many minutes")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    settings = {"rate": chosen.rate, "days": chosen.days, "minutes_a_day": chosen.minutes_a_day}
    stored = StoredRows(RESULTS, COLUMNS, **settings)
    with threadpool_limits(limits=1):
        watch_all(chosen, stored)
    rows = stored.select()
    hours = sum(float(row["operating_hours"]) for row in rows)
    false = sum(int(row["false_alarms"]) for row in rows)
    low = float(gammaincinv(false, 0.025)) if false else 0.0
    high = float(gammaincinv(false + 1, 0.975))
    print(
        f"{len(rows)} actuators: {false} false alarms in {hours:.0f} h: {1000 * false / hours:.2f} per 1000 h "
        f"(95 %: {1000 * low / hours:.2f} to {1000 * high / hours:.2f}), stated {chosen.rate:g}"
    )


def watch_all(chosen: argparse.Namespace, stored: StoredRows) -> None:
    """Watch the actuators that no row tells of yet."""
    left = [number for number in range(chosen.actuators) if not stored.select(seed=chosen.seed, actuator=number)]
    if not left:
        return
    began = time.monotonic()
    recording, made = libraries(chosen.seed)
    for number in left:
        if time.monotonic() - began > 60.0 * chosen.stop_after:
            break
        life = Life(recording, made, chosen, number)
        stored.add({"seed": chosen.seed, "actuator": number, **life.lived()})


if __name__ == "__main__":
    main()
