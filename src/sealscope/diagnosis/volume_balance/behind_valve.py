"""The balance of volumes behind a servo valve: what its edges pass and the piston does not displace has leaked.

No pump's angle is recorded there. With the pressures of supply and return the valve's law gives the flow of each edge,
and each chamber has a balance of its own. Over a block of it, signs turned for chamber B,

    integral of Q_in - Q_out = A dx + integral of (V/K) dp + G integral of (p_A - p_B).

A leak is nearly what a larger overlap of the edges would be, so that the level of G is not known; a change of it is,
since overlaps stand still. Of the machine are found: four overlaps, how far the spool is behind the rig's, and the
oil's stiffness; and, anew in each window of whole cycles, the gain of each edge, which takes the drift of the
transducers' zeros, and G.

Source: Merritt, Hydraulic Control Systems, 1967, section 5.2, general valve analysis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, DriftStep, find_step, findable_step
from sealscope.diagnosis.pressure_model.behind_valve import STALLED, stalled
from sealscope.diagnosis.verdict.evidence import (
    LEAK_WORTH_FINDING,
    NO_RIG,
    Evidence,
    LeakCourse,
    Passage,
    without_flow,
)
from sealscope.physics.leakage import leakage_series, orifice_over_laminar
from sealscope.physics.valve import spool_series
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

CHANNELS = ("x", "u", "p_A", "p_B", "p_1", "p_2")
#: Length of a block, least length of a window of whole cycles, half length of the averages at a block's ends [s]; parts
#: of a sample in which the spool is followed; most windows of a recording.
_BLOCK, _WINDOW, _HALF, _PARTS, _MOST = 0.25, 3.0, 0.01, 4, 60
#: Least share of a window's blocks that counts, and of a recording's windows.
_MOST_OF_A_WINDOW, _MOST_WINDOWS = 0.6, 0.7
#: How well is known, before the recording: overlaps as a share of the spool's stroke, its lateness [s], the oil's
#: stiffness as a share, an edge's gain, and how far it drifts about its mean (the zero of a transducer by 0.5 psi of
#: half of the supply's 7 MPa).
_OVERLAP, _LATE, _STIFFNESS, _GAIN, _DRIFT = 0.02, 1e-3, 0.3, 0.3, 5e-4
#: Turns of the fit, in which overlaps and lateness are linear.
_TURNS = 3
#: What is left over must be under this share of the swept volume; the edges' gains, within this of the rig's, are
#: those of the valve that is assumed.
_UNBALANCED, _OTHER_VALVE = 0.02, 0.3
#: How far volumes are known, as a share: area, scale of the position.
_SCALE = 0.03


@dataclass(frozen=True, eq=False)
class ValveWindows:
    """Conductance past the piston over n windows.

    `t` (n,) middles [s]; `seconds` of a window; `G` (n,) [m^3/(s Pa)] beyond an unknown level, `sd` (n,) its deviation;
    `flow` [m^3/s]: mean flow of the valve; `share` of the recording's windows that count; `stopped` [s]: since when the
    piston is at an end of its stroke now and then, None where it never is.
    """

    t: Array
    seconds: float
    G: Array
    sd: Array
    flow: float
    share: float
    stopped: float | None

    @property
    def left_out(self) -> str:
        """What the windows leave out, in words."""
        if self.stopped is None:
            return ""
        return (
            f"; the piston is at an end of its stroke, or a load holds it, at {self.stopped:.1f} s, which is left out"
        )


def unusable_behind_valve(recording: Recording) -> str | None:
    """Return None where a recording has what the balance behind a valve needs, else what is missing, in one line."""
    missing = [name for name in CHANNELS if name not in recording]
    if missing:
        return (
            f"needs {', '.join(missing)} as well (behind a servo valve: position, command, both chambers, supply p_1 "
            "and return p_2)"
        )
    for name in CHANNELS:
        unit = {"x": "m", "u": "V"}.get(name, "Pa")
        if recording.units[name] != unit:
            return f"needs {name} in its unit, [{unit}], got {recording.units[name]}"
    if not np.all(np.isfinite(recording["x"])) or float(np.ptp(recording["x"])) == 0.0:
        return "x is constant or has missing samples"
    return None


def examined(recording: Recording, rig: Rig, probability: float) -> Evidence:
    """Return the evidence of a rise of the conductance within a recording of a valve-controlled machine."""
    windows = conductances(recording, rig)
    if isinstance(windows, str):
        return Evidence("cannot tell", windows)
    step = find_step(windows.t, windows.G, windows.sd, probability)
    figures = f"score {step.score:.1f}, threshold {step.threshold:.1f}"
    dp = np.abs(recording["p_A"] - recording["p_B"])
    if not step.alarm:
        return _no_step(windows, step, probability, float(dp.mean()), figures)
    late = recording.t >= step.onset
    laminar = float(dp[late].mean()) / LITRE_PER_MINUTE
    other = laminar * orifice_over_laminar(dp[late])
    half = step.quantile * math.hypot(step.size_sd, _SCALE * step.size)
    lpm = 0.5 * (laminar + other) * step.size
    limits = max(0.0, step.size - half) * min(laminar, other), (step.size + half) * max(laminar, other)
    open_ = windows.t > step.onset
    reason = (
        f"what passes between the chambers rose by {lpm:.4f} L/min at {step.onset:.1f} s ({figures}){windows.left_out}"
    )
    lines = [np.where(open_, value, 0.0) for value in (lpm, *limits)]
    course = LeakCourse(windows.t, lines[0], lines[1], lines[2])
    leak = Evidence(
        "leak",
        reason,
        step.score,
        step.threshold,
        step.onset,
        step.onset_interval,
        lpm,
        limits,
        cause="piston leak",
        course=course,
        chance=step.chance,
        share=windows.share,
    )
    return leak if rig.states("cylinder.A_A", "cylinder.A_B") else without_flow(leak, NO_RIG)


def _no_step(windows: ValveWindows, step: DriftStep, probability: float, dp: float, figures: str) -> Evidence:
    smallest = findable_step(windows.t, windows.G, windows.sd, probability, step.noise) * dp
    share = smallest / windows.flow
    reason = (
        f"what passes between the chambers did not rise within the recording ({figures}); a leak from the start would "
        f"be hidden, the smallest step that would have shown is {smallest / LITRE_PER_MINUTE:.2g} L/min"
    )
    known = share <= LEAK_WORTH_FINDING
    if not known:
        reason += f", more than {LEAK_WORTH_FINDING:.0%} of the valve's flow, the smallest leak worth finding"
    reason += windows.left_out
    passage = Passage(None, None, dp, smallest / LITRE_PER_MINUTE, None, None, share)
    return Evidence(
        "no leak" if known else "cannot tell",
        reason,
        step.score,
        step.threshold,
        chance=step.chance,
        passage=passage,
        share=windows.share,
    )


def conductances(recording: Recording, rig: Rig) -> ValveWindows | str:
    """Return the conductance over windows of a recording that has `CHANNELS`, or why there is none."""
    rate, cycle = recording.rate, find_cycle(recording)
    window = max(_WINDOW, recording.duration / _MOST)
    window = window if cycle is None else cycle * max(1, math.ceil(window / cycle - 0.05))
    per = max(4, round(window / _BLOCK))
    half = max(1, round(_HALF * rate))
    count = math.floor((len(recording) - 2 * half - 1) / (window * rate) * (1.0 + 1e-12))
    if count < FEWEST:
        return f"too short for a balance: {count} windows of {window:.3g} s, {FEWEST} are needed"
    ends = half + np.round(np.arange(count * per + 1) * (window * rate / per)).astype(np.int64)
    chambers = [_ValveChamber.of(recording, rig, sign, ends, half) for sign in (1.0, -1.0)]
    dp = recording["p_A"] - recording["p_B"]
    supply = recording["p_1"] - recording["p_2"]
    held, at = np.abs(dp) > STALLED * float(np.median(supply)), stalled(dp, supply, rate)
    used = ~(np.logical_or.reduceat(held, ends[:-1]) | touched(recording, ends))
    filled = used.reshape(count, per).mean(axis=1) >= _MOST_OF_A_WINDOW
    share = float(filled.mean())
    if share < _MOST_WINDOWS:
        return (
            f"the piston is at an end of its stroke, a load holds it, or samples are missing, in {1.0 - share:.0%} of "
            "the recording"
        )
    used &= np.repeat(filled, per)
    numbers = np.repeat(np.arange(count), per)[used]
    numbers = np.searchsorted(np.flatnonzero(filled), numbers)
    fit = _fitted(chambers, rig, used, numbers)
    if isinstance(fit, str):
        return fit
    middles = (np.arange(count) + 0.5) * window + half / rate
    flow = float(np.mean([np.abs(chamber.swept[used]).mean() for chamber in chambers])) * per / window
    stopped = None if at is None else float(recording.t[at])
    return ValveWindows(float(recording.t[0]) + middles[filled], window, *fit, flow, share, stopped)


@dataclass(frozen=True, eq=False)
class _ValveChamber:
    """One chamber over b blocks.

    `sign` 1.0 of A, -1.0 of B; in the middles of the parts of each sample `way` (m,) of the spool [m], towards where
    oil comes in, and its `speed` (m,) [m/s]; `into`, `out` (m,) [m^2/s]: flow of the open edges for each metre of their
    way, by the rig's rated flow; `swept`, `pressed` (b,) [m^3]: A dx, and what the oil takes in at the rig's stiffness;
    `over` (b,) [Pa s].
    """

    sign: float
    way: Array
    speed: Array
    into: Array
    out: Array
    swept: Array
    pressed: Array
    over: Array
    means: NDArray[np.int64]
    part: float

    @classmethod
    def of(cls, recording: Recording, rig: Rig, sign: float, ends: NDArray[np.int64], half: int) -> _ValveChamber:
        c, v, rate, K = rig.cylinder, rig.valve, recording.rate, rig.fluid.K_oil
        p, area = (recording["p_A"], c.A_A) if sign > 0 else (recording["p_B"], c.A_B)
        V_0 = c.V + c.V_hose_A if sign > 0 else c.V - c.V_rod + c.V_hose_B
        means = ends[:, None] + np.arange(-half, half + 1)
        x, dp = recording["x"], recording["p_A"] - recording["p_B"]
        moves = sign * area if c.volumes == "position" else 0.0
        x_ends, p_ends = x[means].mean(axis=1), p[means].mean(axis=1)
        # integral of V dp by parts: the noise at the ends alone is left, and there it is averaged
        carried = np.concatenate([[0.0], np.cumsum(0.5 * (p[1:] + p[:-1]) * moves * np.diff(x))])
        pressed = np.diff((V_0 + moves * x_ends) * p_ends) - np.diff(carried[ends])
        area_under = np.concatenate([[0.0], np.cumsum(0.5 * (dp[1:] + dp[:-1]))]) / rate
        place = spool_series(recording["u"], v, rate, _PARTS)
        inside, supply, back = (_between(series) for series in (p, recording["p_1"], recording["p_2"]))
        unit = np.full(inside.size, v.Q_N / math.sqrt(v.dp_N) / v.x_max)
        into, out = (
            leakage_series(drop, np.zeros_like(unit), unit, v.dp_lam) for drop in (supply - inside, inside - back)
        )
        if moves and c.balance == "mass":
            into = into * np.exp((supply - inside) / K)
        way = sign * place
        speed = np.gradient(way) * (rate * _PARTS)
        swept = sign * area * np.diff(x_ends)
        return cls(
            sign, way, speed, into, out, swept, pressed / K, np.diff(area_under[ends]), means, 1.0 / (rate * _PARTS)
        )

    def columns(self, laps: Array, late: float) -> tuple[Array, Array]:
        """Return what is left over of each block (b,) [m^3], and what each unknown adds to it (b, 6).

        The unknowns: gain of the edge that lets in, of the edge that lets out (as shares), their overlaps `laps` (2,)
        [m], how `late` the spool is [s], the stiffness (as a share).
        """
        way = self.way - late * self.speed
        totals: list[Array] = []
        for opened, turned, law in ((way, self.speed, self.into), (-way, -self.speed, self.out)):
            beyond = opened - laps[len(totals) // 3]
            open_ = np.where(beyond > 0.0, law, 0.0)
            totals += [
                self._total(np.where(beyond > 0.0, beyond, 0.0) * law),
                self._total(open_),
                self._total(open_ * turned),
            ]
        flow_in, lap_in, late_in, flow_out, lap_out, late_out = totals
        left = flow_in - flow_out - self.swept - self.pressed
        return left, np.stack([-flow_in, flow_out, lap_in, -lap_out, late_in - late_out, self.pressed], axis=1)

    def _total(self, flow: Array) -> Array:
        """Return the integral over each block of a flow in the parts of the samples."""
        running = np.concatenate([[0.0], np.cumsum(flow.reshape(-1, _PARTS).sum(axis=1))]) * self.part
        return np.asarray(np.diff(running[self.means].mean(axis=1)))


def _between(series: Array) -> Array:
    """Return a series (n,) in the middles of the parts of its samples, evenly between them."""
    shares = (np.arange(_PARTS) + 0.5) / _PARTS
    return np.asarray((series[:-1, None] + np.diff(series)[:, None] * shares).ravel())


def _fitted(
    chambers: list[_ValveChamber], rig: Rig, used: NDArray[np.bool_], numbers: NDArray[np.int64]
) -> tuple[Array, Array] | str:
    """Return G and its deviation over the n windows, or why there is none.

    `used` (b,): blocks that count, `numbers`: the window of each of these.
    """
    count, v = int(numbers[-1]) + 1, rig.valve
    belongs = (numbers[:, None] == np.arange(count)).astype(float)
    laps, late, scatter = np.zeros((2, 2)), 0.0, 0.0
    overlap = _OVERLAP * v.x_max
    for _ in range(_TURNS):
        rests, rows, leaks = [], [], []
        for k, chamber in enumerate(chambers):
            left, own = chamber.columns(laps[k], late)
            rests.append(left[used])
            gains = [own[used, edge, None] * belongs for edge in (0, 1)]
            nothing = np.zeros_like(gains[0])
            fixed = np.zeros((int(used.sum()), 10))
            fixed[:, 2 * k : 2 * k + 2], fixed[:, 8:] = own[used, 2:4], own[used, 4:]
            fixed[:, 4 + 2 * k : 6 + 2 * k] = own[used, :2]
            leaks.append((chamber.sign * chamber.over[used])[:, None] * belongs)
            rows.append(np.hstack([*((nothing, nothing) * k), *gains, *((nothing, nothing) * (1 - k)), fixed]))
        prior = np.array([_DRIFT] * (4 * count) + [overlap] * 4 + [_GAIN] * 4 + [_LATE, _STIFFNESS])
        b, sd, scatter = _solved(np.concatenate(rests), np.vstack(rows), np.vstack(leaks), prior, scatter)
        alike = b[4 * count : 4 * count + 10]
        laps, late = laps + alike[:4].reshape(2, 2), late + float(alike[8])
    swept = float(np.sqrt(np.mean(np.concatenate([chamber.swept[used] for chamber in chambers]) ** 2)))
    off = float(np.max(np.abs(b[4 * count + 4 : 4 * count + 8])))
    if not (np.all(np.isfinite(b)) and scatter < _UNBALANCED * swept):
        return (
            f"the balance leaves {scatter / swept:.1%} of the swept volume unexplained, {_UNBALANCED:.0%} are allowed: "
            "the rig does not describe this machine"
        )
    if off > _OTHER_VALVE:
        return f"the edges' gains differ by {off:.0%} from those of the rig {rig.name}: another valve"
    return b[-count:], sd[-count:]


def _solved(y: Array, shared: Array, leaks: Array, prior: Array, scatter: float) -> tuple[Array, Array, float]:
    """Return the solution of y = [shared, leaks] b, its deviations, and the scatter of what is left.

    `prior`: deviations of the coefficients of `shared` about 0, in force where a `scatter` is known. The deviations of
    the last columns are beside the gains of their own windows alone: what windows share moves all of them alike.
    """
    X = np.hstack([shared, leaks])
    known = X.shape[1] - leaks.shape[1]
    size = np.sqrt(np.mean(X**2, axis=0))
    size[size == 0.0] = 1.0
    rows, right = X / size, y
    if scatter > 0.0:
        rows = np.vstack([rows, np.diag(scatter / (prior * size[:known])) @ np.eye(known, X.shape[1])])
        right = np.concatenate([y, np.zeros(known)])
    b, *_ = np.linalg.lstsq(rows, right, rcond=1e-12)
    rest = y - X @ (b / size)
    left = float(np.sqrt(rest @ rest / max(1, y.size - X.shape[1])))
    gains = shared[:, : shared.shape[1] - 10]
    basis, _ = np.linalg.qr(gains / np.maximum(np.sqrt(np.sum(gains**2, axis=0)), np.finfo(float).tiny))
    own = leaks - basis @ (basis.T @ leaks)
    sd = np.full(X.shape[1], np.nan)
    sd[known:] = left / np.maximum(np.sqrt(np.sum(own**2, axis=0)), np.finfo(float).tiny)
    return b / size, sd, left
