"""Print how small a leak can be told beside a pump whose own leakage drifts, under a load and with all channels.

    python benchmarks/drift_bounds.py [--plan bench-load] [--machines 8] [--draws 3000] [--seed 1]

For leak-free machines of each family: what passes the pump [L/min], how far that drifts within the record, the scatter
of a block of the balance (fourth differences), and the leak from the plan's onset on that is found in 9 of 10
records at 1 % by the best linear test, its onset known: ``(z_0.99 + z_0.9) / sqrt(s' C^-1 s)``, s what a step of 1
L/min makes of the blocks, C their covariance without one. `law known`: C is that of the scatter and of the bench's own
drifts of pump leakage, drawn anew. `twice integrated` and `integrated`: what the same drifts make of the test that
takes them for such a walk, as strong as explains them best (likelihood restricted to what offset and slope leave).
Blocks are of the volume balance, where one side carries throughout those half a block later as well, their scatter
taken for independent; holds or stretches of the cycle balance where the circuit of a single rod changes over. Medians
over the machines; it takes 5 s a machine.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from math import factorial

import numpy as np

from sealscope.campaigns.cases.bound import smallest_found
from sealscope.campaigns.cases.case import FAMILY, cases_of
from sealscope.campaigns.cases.machines import unsized
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.reader import load_plan
from sealscope.diagnosis.baseline.inspection import inspected
from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.over_cycles.detector import CycleBalance
from sealscope.diagnosis.volume_balance.search import scatter
from sealscope.parameters import Rig
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.units import LITRE_PER_MINUTE

PUMP = "pump.G_pump"
#: Instants a second at which drifts are drawn.
RATE = 10.0
#: Strengths of a walk that are tried, as shares of the level.
STRENGTHS = 10.0 ** np.arange(-14.0, 1.0, 0.5)
WALKS = {"twice integrated": 3, "integrated": 2}


def drifts(plan: SimulatedPlan, family: str, draws: int) -> Array:
    """Return drifts of the pump's leakage over its value (draws, m) at `RATE`, as the bench draws them."""
    t = np.arange(round(plan.duration_s * RATE)) / RATE
    rows = []
    for seed in range(draws):
        machine = draw(plan.profile, 10**6 + seed, rig=plan.rig, duration=plan.duration_s, family=family)
        rows.append(next(drift.shape for drift in machine.drifts if drift.parameter == PUMP).at(t))
    return np.array(rows)


def means(courses: Array, t: Array, seconds: float) -> Array:
    """Return means (., n) of courses (., m) at `RATE` over blocks of so many `seconds` about t (n,)."""
    sums = np.concatenate([np.zeros((len(courses), 1)), np.cumsum(courses, axis=1)], axis=1)
    first = np.clip(np.round((t - 0.5 * seconds) * RATE).astype(int), 0, courses.shape[1] - 1)
    last = np.clip(np.round((t + 0.5 * seconds) * RATE).astype(int), first + 1, courses.shape[1])
    return np.asarray((sums[:, last] - sums[:, first]) / (last - first))


def smallest(model: Array, covariance: Array, step: Array, free: Array) -> float:
    """Return the step that is found in 9 of 10 series at 1 %, beside the columns `free` (n, m) of unknown height.

    The series have this `covariance` (n, n); the test is the best one where they had that of the `model`.
    """
    root = np.linalg.cholesky(model)
    white, target = np.linalg.solve(root, free), np.linalg.solve(root, step)
    target = target - white @ np.linalg.lstsq(white, target, rcond=None)[0]
    weights = np.linalg.solve(root.T, target) / float(target @ target)
    return smallest_found(float(np.sqrt(weights @ covariance @ weights)), 0.01)


def walked(t: Array, order: int) -> Array:
    """Return the covariance (n, n) of a walk that is integrated `order` - 1 times, at times t (n,) over the last."""
    u = (t - t[0]) / (t[-1] - t[0])
    when = (np.arange(4000) + 0.5) / 4000
    reached = np.maximum(u[:, None] - when, 0.0) ** (order - 1) / factorial(order - 1)
    return np.asarray(reached @ reached.T / when.size)


def likeliest(noise: Array, walk: Array, free: Array, series: Array) -> Array:
    """Return the covariance of noise and walk whose restricted likelihood for the series (n, k) is highest."""
    best, found = -np.inf, noise
    for strength in STRENGTHS:
        covariance = noise + strength * walk
        root = np.linalg.cholesky(covariance)
        basis, triangle = np.linalg.qr(np.linalg.solve(root, free), mode="complete")
        rest = basis[:, free.shape[1] :].T @ np.linalg.solve(root, series)
        logs = np.log(np.diag(root)).sum() + np.log(np.abs(np.diag(triangle))).sum()
        likelihood = -0.5 * float(np.mean(np.sum(rest**2, axis=0))) - float(logs)
        if likelihood > best:
            best, found = likelihood, covariance
    return found


def balanced(rig: Rig, recording: Recording) -> tuple[Array, float, Array] | None:
    """Return middles of blocks (n,), the seconds of one, and conductances (m,) whose scatter is theirs.

    Of the volume balance, or, where the circuit changes over, of holds or stretches of the cycle balance.
    """
    fit, _ = VolumeBalance(rig).fit(recording)
    if fit is not None and not fit.changes_over:
        t = fit.blocks.t if fit.between is None else np.sort(np.concatenate([fit.blocks.t, fit.between.t]))
        return t, fit.blocks.seconds, fit.g
    flows = CycleBalance(rig).flows(recording)
    return None if isinstance(flows, str) else (flows.t, flows.seconds, flows.flow / flows.dp)


def bounds(plan: SimulatedPlan, family: str, machines: int, draws: int, seed: int) -> list[list[float]]:
    """Return for each machine level, drift, scatter, and the smallest leaks [L/min]."""
    courses = drifts(plan, family, draws)
    rows = []
    own = replace(plan, seed=seed, factors={**plan.factors, FAMILY: (family,)})
    for case in [case for case in cases_of(own) if case.leak_lpm == 0 and not case.fault][:machines]:
        simulated = simulate_with_truth(unsized(own, case))
        blocks = balanced(plan.rig, inspected(simulated.recording).part)
        if blocks is None:
            continue
        t, seconds, g = blocks
        outputs = simulated.truth.outputs
        dp = float(np.mean(np.abs(outputs["p_A"] - outputs["p_B"])))
        level = float(unsized(own, case).rig[PUMP]) * dp / LITRE_PER_MINUTE
        noise = scatter(g) * dp / LITRE_PER_MINUTE
        drifting = level * means(courses, t, seconds)
        open_ = (np.arange(courses.shape[1]) / RATE >= plan.onset_s)[None].astype(float)
        step = means(open_, t, seconds)[0]
        white = noise**2 * np.eye(t.size)
        offset, sloped = np.ones((t.size, 1)), np.stack([np.ones(t.size), t], axis=1)
        true = white + np.cov(drifting.T)
        random = np.random.default_rng(seed)
        series = drifting.T[:, :500] + noise * random.standard_normal((t.size, min(500, draws)))
        walks = [likeliest(white, level**2 * walked(t, order), sloped, series) for order in WALKS.values()]
        least = [smallest(true, true, step, offset), *(smallest(walk, true, step, sloped) for walk in walks)]
        rows.append([level, float(np.median(np.ptp(drifting, axis=1))), noise, *least])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plan", default="bench-load")
    parser.add_argument("--machines", type=int, default=8)
    parser.add_argument("--draws", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    plan = load_plan(given.plan)
    if not isinstance(plan, SimulatedPlan) or not plan.profile:
        parser.error(f"{given.plan} draws no machines")
    heads = ["passes", "drifts", "scatter", "law known", *WALKS]
    print(f"{plan.name}: medians [L/min]\n{'family':<26}{'machines':>9}" + "".join(f"{head:>18}" for head in heads))
    for family in plan.factors.get(FAMILY, ("",)):
        rows = bounds(plan, str(family), given.machines, given.draws, given.seed)
        middle = np.median(np.array(rows), axis=0) if rows else []
        print(f"{family!s:<26}{len(rows):>9}" + "".join(f"{value:>18.6f}" for value in middle), flush=True)


if __name__ == "__main__":
    main()
