"""Compute the tables of thresholds that `changepoint.smooth_drift` and `changepoint.random_walk` interpolate, or check.

    python benchmarks/null_tables.py {smooth_drift,quiet_drift,overlapping_drift,random_walk} [--draws N]
        [--blocks N ...]
    python benchmarks/null_tables.py check [--draws N] [--blocks N ...]
    python benchmarks/null_tables.py beyond [--draws N] [--blocks N ...]

Each line of a table gives what the largest score of series without a step exceeds with the probabilities of the head
line. Seeds are the blocks' and the strength's numbers. It takes 20 to 60 minutes on one core.

smooth_drift: blocks, number of the strength of the drift. From 80 000 weighted draws (`tails.rare_draws`) a line, and
24 000 at 96 blocks; the probability with which a threshold is exceeded is right within 5 and 9 % (one standard
deviation), at 1e-6 and less within a factor of two or more for strong drifts. quiet_drift: the same for its strengths,
24 000 draws a line; overlapping_drift: of quiet blocks that overlap by half.
random_walk: blocks, number of the walk, expected walk. From 200 000 plain draws a line, and beyond a probability of
0.01 by a generalised Pareto tail fitted to that share of them (probability-weighted moments: Hosking & Wallis,
Technometrics 29 (1987) 339-349): within 3 % at 0.01, 6 % at 0.001, 12 % at 0.0001.
beyond: thresholds of `smooth_drift` at 1e-10 by weighted draws, beside the table's with `tails.RARER` beyond 1e-7.
check: shares of fresh series without a step that `find_step` and `find_leak_step` call one, with 95 % intervals.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.special import betaincinv

from sealscope.compiled import kernel
from sealscope.diagnosis.changepoint import random_walk, smooth_drift, tails

FOLDER = Path(tails.__file__).parent
DRIFT_BLOCKS = (16, 18, 20, 21, 24, 28, 34, 42, 52, 64, 78, 96)
QUIET_BLOCKS = (16, 20, 26, 34, 46, 64, 96)
DRIFT_PROBABILITIES = (0.2, 0.1, 0.05, 0.02, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6, 1e-7)
WALK_BLOCKS = (16, 20, 26, 36, 52, 78, 120)
EXPECTED = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
WALK_PROBABILITIES = (0.2, 0.1, 0.05, 0.02, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5)
#: Share of the draws that the generalised Pareto tail is fitted to.
TAIL = 0.01
CHUNK = 2000


def drift_lines(
    draws: int,
    blocks: tuple[int, ...],
    probabilities: tuple[float, ...] = DRIFT_PROBABILITIES,
    levels: int = 18,
    *,
    quiet: bool = False,
    halves: bool = False,
) -> Iterator[tuple[float, ...]]:
    """Yield the lines of the table of `smooth_drift`, or of `quiet` series, whose blocks may overlap by `halves`.

    So many `levels` of draws, each half a decade rarer.
    """
    rare = 0.3 * 10.0 ** (-0.5 * np.arange(levels))
    for n in blocks:
        length = 2.0 if halves else 1.0
        t, none = np.arange(n, dtype=np.float64), np.zeros((n, 1))
        family = smooth_drift.DriftFamily(t, np.ones(n), none, quiet=quiet, length=length)
        for number, drift in enumerate(family.drifts):
            scores, weights = [], []
            for chunk in range((draws if n < DRIFT_BLOCKS[-1] or quiet else draws * 3 // 10) // CHUNK):
                z, weight = tails.rare_draws(drift.steps @ drift.root, rare, CHUNK, 10**6 * n + 10**4 * number + chunk)
                scores.append(family.scores(drift.root @ z, 1)[0].max(axis=0))
                weights.append(weight)
            values, weight = np.concatenate(scores), np.concatenate(weights)
            yield (n, number, *(tails.weighted_quantile(values, weight, p) for p in probabilities))


@kernel
def largest(moved: np.ndarray, rest: np.ndarray, extra: np.ndarray, prior: np.ndarray, freedom: int) -> np.ndarray:
    """Return the largest t (e, m) over onsets, with the likeliest walk under each prior (w, e).

    `moved`, `rest` (w, k, m): moves and what is left of the sum of squares; `extra` (w, k): determinants.
    """
    walks, onsets, count = moved.shape
    t = np.zeros((prior.shape[1], count))
    deviance = np.empty(walks)
    for k in range(onsets):
        for m in range(count):
            for w in range(walks):
                deviance[w] = freedom * math.log(rest[w, k, m]) + extra[w, k]
            for e in range(prior.shape[1]):
                best = 0
                for w in range(1, walks):
                    if deviance[w] + prior[w, e] < deviance[best] + prior[best, e]:
                        best = w
                t[e, m] = max(t[e, m], moved[best, k, m] / math.sqrt(rest[best, k, m] / freedom))
    return t


def walk_lines(draws: int, blocks: tuple[int, ...]) -> Iterator[tuple[float, ...]]:
    """Yield the lines of the table of `random_walk`."""
    for n in blocks:
        scans = [random_walk.WalkScan(np.ones(n), expected) for expected in EXPECTED]
        scan, prior = scans[0], np.stack([each.prior for each in scans], axis=1)
        lengths = np.stack([walk.fit(np.zeros((n, 1)), scan.shapes)[2] for walk in scan.walks])
        extra = np.array([walk.log_det for walk in scan.walks])[:, None] + 2.0 * np.log(lengths)
        for number, walk in enumerate(scan.walks):
            random = np.random.default_rng((n, number))
            parts = []
            for _ in range(draws // CHUNK):
                y = walk.root @ random.standard_normal((n, CHUNK))
                fits = [each.fit(y, scan.shapes)[:2] for each in scan.walks]
                moved, rest = (np.stack([fit[k] for fit in fits]) for k in (0, 1))
                parts.append(largest(moved, rest, extra, prior, scan.freedom))
            values = np.sort(np.concatenate(parts, axis=1), axis=1)
            for expected, t in zip(EXPECTED, values, strict=True):
                yield (n, number, expected, *(pareto_quantile(t, p) for p in WALK_PROBABILITIES))


def pareto_quantile(t: np.ndarray, probability: float) -> float:
    """Return what the sorted values (m,) exceed with a probability: beyond `TAIL` by a generalised Pareto law."""
    if probability >= TAIL:
        return float(np.quantile(t, 1.0 - probability))
    start = float(np.quantile(t, 1.0 - TAIL))
    excess = t[t > start] - start
    first = excess.mean()
    second = float(np.mean(excess * (1.0 - (np.arange(excess.size) + 0.65) / excess.size)))
    shape = 2.0 - first / (first - 2.0 * second)
    scale = 2.0 * first * second / (first - 2.0 * second)
    return start + scale / shape * ((probability / TAIL) ** -shape - 1.0)


#: Series without a step: name, variance of the walk a block over the noise's, and the walk that the observer expects.
NULLS = (("noise", 0.0, 0.03), ("walk 0.03", 0.03, 0.03), ("walk 0.25", 0.25, 0.3), ("walk 3", 3.0, 3.0))
CHECKED = (0.05, 0.01, 1e-3, 1e-4)


def check(series: int, blocks: tuple[int, ...]) -> None:
    """Print nominal probabilities of a false alarm and the obtained shares."""
    heads = "".join(f"{f'{p:g}':>27}" for p in CHECKED)
    print(f"{'scan, blocks, series without a step':<42}{'series':>9}{heads}")
    for n in blocks:
        for name, strength, expected in NULLS:
            walk = np.sqrt(strength)
            for scan in ("smooth_drift", "random_walk"):
                alarms = np.zeros(len(CHECKED), dtype=np.int64)
                random = np.random.default_rng((n, round(1000 * strength)))
                for _ in range(series // CHUNK):
                    g = random.standard_normal((CHUNK, n))
                    g += walk * np.cumsum(random.standard_normal((CHUNK, n)), axis=1)
                    alarms += drift_alarms(g) if scan == "smooth_drift" else walk_alarms(g, expected)
                shares = "".join(f"{share(int(k), series):>27}" for k in alarms)
                print(f"{f'{scan}, {n}, {name}':<42}{series:>9}{shares}", flush=True)


def beyond(draws: int, blocks: tuple[int, ...]) -> None:
    """Print thresholds at 1e-10, drawn and extended, and how fast the drawn ones grow from 1e-7 on."""
    rarest = 1e-10
    growths, ratios = [], []
    for n, number, edge, drawn in drift_lines(draws, blocks, (DRIFT_PROBABILITIES[-1], rarest), levels=24):
        extended = tails.null_threshold("smooth_drift", rarest, n, number)
        growths.append((drawn - edge) / math.log(DRIFT_PROBABILITIES[-1] / rarest))
        ratios.append(drawn / extended)
        print(f"{n:g} blocks, strength {number:g}: drawn {drawn:.1f}, extended {extended:.1f}", flush=True)
    print(f"growth for each factor e: median {np.median(growths):.2f}, {min(growths):.2f} to {max(growths):.2f}")
    print(f"drawn over extended: median {np.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")


def share(alarms: int, series: int) -> str:
    """Return a share and its 95 % Clopper-Pearson interval."""
    low = betaincinv(alarms, series - alarms + 1, 0.025) if alarms else 0.0
    high = betaincinv(alarms + 1, series - alarms, 0.975)
    return f"{alarms / series:.2g} ({low:.2g} .. {high:.2g})"


def drift_alarms(g: np.ndarray) -> np.ndarray:
    """Count alarms at each probability among series g (m, n); only those that may raise one are looked at in full."""
    n = g.shape[1]
    t, sd = np.arange(n, dtype=np.float64), np.ones(n)
    family = smooth_drift.DriftFamily(t, sd, np.zeros((n, 1)))
    lowest = min(tails.null_threshold("smooth_drift", CHECKED[0], n, k) for k in range(len(smooth_drift.STRENGTHS)))
    alarms = np.zeros(len(CHECKED), dtype=np.int64)
    for candidate in g[family.scores(g.T, 1)[0].max(axis=0) > lowest]:
        for k, probability in enumerate(CHECKED):
            if not smooth_drift.find_step(t, candidate, sd, probability).alarm:
                break
            alarms[k] += 1
    return alarms


def walk_alarms(g: np.ndarray, expected: float) -> np.ndarray:
    """Count alarms at each probability among series g (m, n), as `drift_alarms` does."""
    n = g.shape[1]
    scan = random_walk.WalkScan(np.ones(n), expected)
    lowest = min(tails.null_threshold("random_walk", CHECKED[0], n, k, expected) for k in range(len(scan.walks)))
    alarms = np.zeros(len(CHECKED), dtype=np.int64)
    for candidate in g[scan.scores(g.T)[0].max(axis=0) > lowest]:
        for k, probability in enumerate(CHECKED):
            step = random_walk.find_leak_step(candidate, np.ones(n), probability, expected, wary=expected > 1.0)
            if not step.alarm:
                break
            alarms[k] += 1
    return alarms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "scan", choices=("smooth_drift", "quiet_drift", "overlapping_drift", "random_walk", "check", "beyond")
    )
    parser.add_argument("--draws", type=int)
    parser.add_argument("--blocks", type=int, nargs="+")
    chosen = parser.parse_args()
    if chosen.scan == "check":
        check(chosen.draws or 100_000, tuple(chosen.blocks or (40,)))
        return
    if chosen.scan == "beyond":
        beyond(chosen.draws or 24_000, tuple(chosen.blocks or (20,)))
        return
    if chosen.scan != "random_walk":
        halves, names = chosen.scan == "overlapping_drift", "blocks,strength"
        quiet = halves or chosen.scan == "quiet_drift"
        blocks = tuple(chosen.blocks or (QUIET_BLOCKS if quiet else DRIFT_BLOCKS))
        lines = drift_lines(chosen.draws or (24_000 if quiet else 80_000), blocks, quiet=quiet, halves=halves)
        head, form = ",".join([names, *(f"{p:g}" for p in DRIFT_PROBABILITIES)]), "%g,%g" + ",%.2f" * 12
    else:
        lines, names = walk_lines(chosen.draws or 200_000, tuple(chosen.blocks or WALK_BLOCKS)), "blocks,walk,expected"
        head, form = ",".join([names, *(f"{p:g}" for p in WALK_PROBABILITIES)]), "%g,%g,%g" + ",%.3f" * 10
    with (FOLDER / f"{chosen.scan}.csv").open("w") as table:
        print(head, file=table)
        for line in lines:
            print(form % line, file=table, flush=True)


if __name__ == "__main__":
    main()
