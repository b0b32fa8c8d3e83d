"""Pressures and command alone: the ringing after each reversal decays the faster, the more oil passes the piston.

At a reversal the piston sticks, breaks away, and p_A - p_B rings about its slow course. With two chambers of compliance
C = V/K and a piston of mass M and area A, chamber balance ``C p' = q - A v - G p`` (half of p each) and force balance
``M v' = A p - F(v)``, linear about the stroke's own speed v, give

    ring(tau) = exp(-int sigma) (a cos(omega tau) + b sin(omega tau)),
    sigma = dF/dv / (2 M) + G / C,    omega^2 = 2 A^2 / (C M):

a leak adds G/C, whatever the friction, and C follows from the ring's own frequency. Of the friction
``dF/dv = F_v - F_C (K_brk - 1) C_c exp(-C_c v)``, eq. (4.21), the part that falls with speed is known by shape from the
command, by size as a prior (`pressures.toml`); the rest is constant within a stroke, as G/C is, and its slow change is
what a test of onsets allows for. So each block has one damping g, and the ring's frequency, amplitude and phase wander
from block to block as random walks. Reversals of like command share amplitude and phase, each direction by itself. A
polynomial takes the slow course out of each window, and lines of the mains, whose frequency the sum p_A + p_B shows,
where nothing rings, are fitted beside the ring.

Factorisation: this is p(pressures | command). A provider that reads position and angle states p(position | pressures,
angle) and takes p_A and p_B as given, so that both may be added.

Source of the ring: Merritt, Hydraulic Control Systems, 1967, section 6.6 (valve-piston combination, hydraulic natural
frequency and damping by leakage).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.pressures.evidence import (
    WANDER_TIME,
    PressureEvidence,
    block_edges,
    eliminated,
    mains_lines,
    middles,
    pressure_evidence,
    priors,
    unusable,
    wander_of_conductance,
)
from sealscope.recordings.recording import Array, Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Bends of the slow course are sought over so many periods of the ring; it has one degree for so many, and
#: a window keeps so many off the bends.
_BEND, _DEGREE, _GUARD = 3.0, 12.0, 0.7
#: Commands of a class are alike within this logarithm of length and size.
_ALIKE = 0.1
#: The first look: dampings [1/s], relative drifts of the frequency, length of the transforms, frequencies, the highest
#: as a share of the rate, and turns of the phase over the recording.
_DAMPINGS, _DRIFTS, _LENGTH = (-6.0, -3.0, 0.0, 4.0, 10.0, 20.0), np.linspace(-0.05, 0.05, 21), 4096
_FREQUENCIES, _HIGHEST, _TURNS = 200, 0.42, 6.0
#: Steps of the fit, gain in log likelihood that ends it, largest change of a phase in a step [rad], ridge [1], largest
#: damping of a step [1], largest logarithm of a ring [Pa].
_STEPS, _ENOUGH, _TURN, _RIDGE, _DAMPED, _MOST_DAMPED, _LOUDEST = 15, 0.02, 1.5, 1e-9, 0.01, 1e6, 25.0
#: Shares of the windows that are fitted in turn.
_HEADS = (0.25, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class Machine:
    """What the rig's file says of the ring: `omega` [rad/s], slopes of the friction over 2 M [1/s], speed per volt."""

    omega: float
    viscous: float
    falling: float
    transition: float
    speed: float
    inertance: float

    @staticmethod
    def of(rig: Rig) -> Machine:
        """Return it at the rig's charge pressure."""
        cylinder, friction = rig.cylinder, rig.friction
        area = 0.5 * (cylinder.A_A + cylinder.A_B)
        coulomb = friction.F_pr + 2.0 * friction.F_cfr * rig.fluid.p_charge
        falling = coulomb * (friction.K_brk - 1.0) * friction.C_c
        return Machine(
            area * math.sqrt(2.0 * rig.fluid.K_oil / (cylinder.V * cylinder.M_eq)),
            friction.F_v / (2.0 * cylinder.M_eq),
            -falling / (2.0 * cylinder.M_eq),
            friction.C_c,
            rig.motor.omega_per_volt * rig.pump.q_b / (2.0 * math.pi) / area,
            cylinder.M_eq / (2.0 * area**2),
        )

    @property
    def period(self) -> float:
        """Period of the ring [s]."""
        return 2.0 * math.pi / self.omega


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows (r, n) of p_A - p_B [Pa] after r reversals of like command, as deviations from a slow polynomial.

    `values` in the sense of the motion; `tau` [s] from the window's place after the reversal; `slow`: time integral of
    exp(-C_c v) [s] over tau; `block` (r,); `basis` (n, d) of the polynomial; `lines` (2 m, r, n) of the mains.
    """

    values: Array
    tau: Array
    slow: Array
    block: NDArray[np.int64]
    basis: Array
    lines: Array

    def less_slow(self, rows: Array) -> Array:
        """Return rows (..., r, n) without their slow polynomial."""
        return _less(rows, self.basis)

    def head(self, n: int) -> Windows:
        """Return the first n samples of each window."""
        basis, _ = np.linalg.qr(self.basis[:n])
        rows = (_less(rows[..., :n], basis) for rows in (self.values, self.lines))
        values, lines = rows
        return Windows(values, self.tau[:, :n], self.slow[:, :n], self.block, basis, lines)

    @cached_property
    def occupied(self) -> NDArray[np.int64]:
        """Blocks that hold a window."""
        return np.unique(self.block)

    @cached_property
    def own(self) -> NDArray[np.int64]:
        """Place (r,) of each window's block among the occupied ones."""
        return np.searchsorted(self.occupied, self.block)


def reversals(u: Array) -> tuple[Array, Array]:
    """Return where a command (n,) changes its sign [samples] and the sign afterwards, both (r,).

    A change counts between excursions beyond half of the command's rms, so that noise about zero is none.
    """
    level = 0.5 * float(np.sqrt(np.mean(u**2)))
    beyond = np.flatnonzero(np.abs(u) > level)
    turns = np.flatnonzero(np.diff(np.sign(u[beyond])))
    places = []
    for first, last in zip(beyond[turns], beyond[turns + 1], strict=True):
        part = u[first : last + 1]
        k = int(np.flatnonzero(part[:-1] * part[-1] <= 0.0)[-1])
        places.append(first + k + part[k] / (part[k] - part[k + 1]))
    return np.array(places), np.sign(u[beyond[turns + 1]])


def _plateau(course: Array, width: int) -> tuple[int, int] | None:
    """Return where the plateau of a half cycle's course (n,) begins and ends: its sharpest bends in either half."""
    line = np.arange(width) - 0.5 * (width - 1)
    slope = np.correlate(course, line / (line @ line), "valid")
    if slope.size < 2 * width + 2:
        return None
    bend, middle = slope[:-width] - slope[width:], course.size // 2 - width
    return int(np.argmax(bend[:middle])) + width, int(np.argmax(bend[middle:])) + middle + width


def windows_of(recording: Recording, machine: Machine, edges: NDArray[np.int64]) -> list[Windows]:
    """Return the windows of a recording in classes of like reversals; `edges` (K + 1,) of the blocks [samples]."""
    u, dp = recording["u"], recording["p_A"] - recording["p_B"]
    place, sense = reversals(u)
    if place.size < 2:
        return []
    sense = sense[:-1] * np.sign(np.mean(u * (dp - dp.mean())))
    span, cut = np.diff(place), place.astype(np.int64)
    size = np.sqrt(np.diff(np.concatenate([[0.0], np.cumsum(u**2)])[cut]) / span)
    keys = np.column_stack([sense, np.round(np.log(span) / _ALIKE), np.round(np.log(size) / _ALIKE)])
    _, kind = np.unique(keys, axis=0, return_inverse=True)
    cutting = _Cutting(
        recording, machine, edges, dp, 2.0 * np.pi * mains_lines(recording["p_A"] + recording["p_B"], recording.rate)
    )
    classes = []
    for k in range(int(kind.max()) + 1):
        chosen = np.flatnonzero((kind.ravel() == k) & (place[:-1] > place[0]))
        if chosen.size > 0:
            windows = cutting.windows(place[chosen], int(span[chosen].min()) - 1, sense[chosen])
            classes += [] if windows is None else [windows]
    return classes


@dataclass(frozen=True, eq=False)
class _Cutting:
    """Cuts windows out of a recording's p_A - p_B (n,) [Pa]; `lines` [rad/s] of the mains."""

    recording: Recording
    machine: Machine
    edges: NDArray[np.int64]
    dp: Array
    lines: Array

    def windows(self, place: Array, length: int, sense: Array) -> Windows | None:
        """Return the windows after the reversals at `place` (r,), within `length` samples; None without a plateau."""
        rate, machine, u = self.recording.rate, self.machine, self.recording["u"]
        first, ring = np.ceil(place).astype(np.int64), machine.period * rate
        if self.recording.bridged is not None:
            missing = np.concatenate([[0], np.cumsum(self.recording.bridged)])
            whole = missing[first + length] == missing[first]
            first, place, sense = first[whole], place[whole], sense[whole]
        if first.size == 0:
            return None
        course = np.mean(self.dp[first[:, None] + np.arange(length)] * sense[:, None], axis=0)
        plateau, guard = _plateau(course, round(_BEND * ring)), round(_GUARD * ring)
        if plateau is None or plateau[1] - plateau[0] - 2 * guard < 2.0 * _BEND * ring:
            return None
        begin, n = plateau[0] + guard, plateau[1] - plateau[0] - 2 * guard
        rows = first[:, None] + begin + np.arange(n)
        degree = max(3, round(n / (_DEGREE * ring)))
        basis, _ = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), degree))
        slowness = np.exp(-machine.transition * machine.speed * np.abs(u[rows]))
        waves = np.exp(1j * self.lines[:, None, None] / rate * rows) * sense[:, None]
        return Windows(
            values=_less(self.dp[rows] * sense[:, None], basis),
            tau=((first - place)[:, None] + np.arange(n)) / rate,
            slow=np.cumsum(slowness, axis=1) / rate,
            block=np.clip(np.searchsorted(self.edges, first + begin + n // 2, "right") - 1, 0, self.edges.size - 2),
            basis=basis,
            lines=_less(np.concatenate([waves.real, waves.imag]), basis),
        )


def _less(rows: Array, basis: Array) -> Array:
    """Return rows (..., n) without their parts along the orthonormal columns of `basis` (n, d)."""
    return np.asarray(rows - (rows @ basis) @ basis.T)


class _Ring:
    """The fit of the ring to the windows: Gauss-Newton steps over all parameters together.

    Parameters: g (K,), omega (K,), then for each class logarithm of the amplitude and phase in the blocks that it is
    in, then the size of the friction's falling slope [1/s] and the amplitudes of the mains' lines.
    """

    def __init__(self, classes: list[Windows], machine: Machine, blocks: int, seconds: float, rate: float) -> None:
        self.classes, self.machine, self.blocks, self.rate = classes, machine, blocks, rate
        self.beliefs = priors("ring_down")
        starts = np.cumsum([2 * blocks, *(2 * each.occupied.size for each in classes)])
        self.begins, self.falling = [int(start) for start in starts[:-1]], int(starts[-1])
        self.size = self.falling + 1 + len(classes[0].lines)
        self.middle = (np.arange(blocks) + 0.5) / blocks - 0.5
        self.centre = np.zeros(self.size)
        self.centre[self.falling], self.centre[blocks : 2 * blocks] = machine.falling, machine.omega
        known = self.beliefs["frequency"]
        self.band = machine.omega * (
            known.value + 2.0 * known.width * np.array([-1.0, 1.0])
        )  # what else moves is no ring
        self.strain = self._strain(seconds)
        self.freedom = sum(each.values.size - each.block.size * each.basis.shape[1] for each in classes)

    def _strain(self, seconds: float) -> Array:
        """Return the precision (p, p) of the random walks, of the mean frequency and of the friction's slope."""
        strain = np.zeros((self.size, self.size))
        wide, K = self.beliefs, self.blocks
        walks = [(np.arange(K), np.arange(K), wide["damping_wander"].width)]
        walks.append((np.arange(K, 2 * K), np.arange(K), wide["frequency_wander"].width * self.machine.omega))
        for each, begin in zip(self.classes, self.begins, strict=True):
            m = each.occupied.size
            walks.append((np.arange(begin, begin + m), each.occupied, wide["amplitude_wander"].width))
            walks.append((np.arange(begin + m, begin + 2 * m), each.occupied, wide["phase_wander"].width))
        for places, block, width in walks:
            steps = np.diff(np.eye(places.size), axis=0)
            variance = width**2 * np.diff(block) * seconds / WANDER_TIME
            strain[np.ix_(places, places)] = steps.T @ (steps / variance[:, None])
        own = slice(K, 2 * K)
        strain[own, own] += 1.0 / (K * wide["frequency"].width * self.machine.omega) ** 2
        width = wide["friction_slope"].width * abs(self.machine.falling)
        strain[self.falling, self.falling] = 1.0 / max(width, np.finfo(float).tiny) ** 2
        return strain

    def start(self) -> Array:
        """Return parameters (p,) from the first look, with amplitudes and phases that change evenly."""
        machine, K, lines = self.machine, self.blocks, self._lines()
        free = [each.values - np.tensordot(lines, each.lines, 1) for each in self.classes]
        omega, drift, damping = self._strongest(free)
        slowness = np.mean([np.mean(each.slow[:, -1] / each.tau[:, -1]) for each in self.classes])
        x = np.zeros(self.size)
        x[:K] = damping - machine.falling * slowness
        x[K : 2 * K] = omega * (1.0 + drift * self.middle)
        x[self.falling], x[self.falling + 1 :] = machine.falling, lines
        for values, each, begin in zip(free, self.classes, self.begins, strict=True):
            wave, when = self._wave(x, each, begin), self.middle[each.block][:, None]
            rows = each.less_slow(np.array([wave.real, -wave.imag, wave.real * when, -wave.imag * when]))
            a = np.linalg.lstsq(rows.reshape(4, -1).T, values.ravel(), rcond=None)[0]
            course = (a[0] + 1j * a[1]) + (a[2] + 1j * a[3]) * self.middle[each.occupied]
            m = each.occupied.size
            x[begin : begin + m] = np.log(np.maximum(np.abs(course), np.finfo(float).tiny))
            x[begin + m : begin + 2 * m] = np.unwrap(np.angle(course))
        return x

    def _strongest(self, free: list[Array]) -> tuple[float, float, float]:
        """Return frequency [rad/s], its drift [1] and the damping [1/s] that gather most power of the windows `free`.

        Windows are summed over blocks of a steady amplitude, with phases that turn evenly over the recording.
        """
        K, bin_width = self.blocks, self.rate / _LENGTH
        around = np.linspace(self.band[0], self.band[1], _FREQUENCIES) / (2.0 * np.pi)
        around = around[around < _HIGHEST * self.rate]
        reach = 1.0 + 0.5 * float(np.max(np.abs(_DRIFTS)))
        first, last = math.floor(around[0] / reach / bin_width), math.ceil(around[-1] * reach / bin_width)
        bins, rows = np.arange(first, min(last + 2, _LENGTH // 2)), np.arange(K)[:, None]
        turns = np.abs(np.fft.fftfreq(4 * K, 1.0 / K)) <= _TURNS
        best, chosen = -1.0, (self.machine.omega, 0.0, 0.0)
        for damping in _DAMPINGS:
            sums = []
            for values, each in zip(free, self.classes, strict=True):
                decay = np.exp(-damping * np.arange(each.tau.shape[1]) / self.rate)
                shift = np.exp(-2j * np.pi * bin_width * bins * each.tau[:, :1])
                spectra = np.fft.rfft(values * (decay / np.linalg.norm(decay)), _LENGTH)[:, bins] * shift
                sums.append((each.block == rows) @ spectra / math.sqrt(each.block.size))
            for drift in _DRIFTS:
                at = np.rint(around * (1.0 + drift * self.middle[:, None]) / bin_width).astype(np.int64) - first
                power = np.zeros(around.size)
                for total in sums:
                    power += np.max(np.abs(np.fft.fft(total[rows, at], 4 * K, axis=0)[turns]) ** 2, axis=0)
                k = int(np.argmax(power))
                if power[k] > best:
                    best, chosen = float(power[k]), (2.0 * np.pi * float(around[k]), float(drift), damping)
        return chosen

    def _lines(self) -> Array:
        """Return the amplitudes (2 m,) of the mains' lines by themselves."""
        m = self.size - self.falling - 1
        rows = np.concatenate([each.lines.reshape(m, -1) for each in self.classes], axis=1)
        values = np.concatenate([each.values.ravel() for each in self.classes])
        return np.asarray(np.linalg.lstsq(rows @ rows.T, rows @ values, rcond=_RIDGE)[0])

    def _wave(self, x: Array, each: Windows, begin: int) -> NDArray[np.complex128]:
        """Return the ring (r, n) of a class as a complex wave, whose real part is seen."""
        m, K = each.occupied.size, self.blocks
        decay = x[:K][each.block, None] * each.tau + x[self.falling] * each.slow
        start = x[begin : begin + m][each.own] + 1j * x[begin + m : begin + 2 * m][each.own]
        turn = 1j * x[K : 2 * K][each.block, None] * each.tau
        return np.asarray(
            np.exp(np.clip(start.real[:, None] - decay, None, _LOUDEST) + 1j * start.imag[:, None] + turn)
        )

    def _residual(self, x: Array, each: Windows, wave: NDArray[np.complex128]) -> Array:
        return np.asarray(each.values - each.less_slow(wave.real) - np.tensordot(x[self.falling + 1 :], each.lines, 1))

    def squares(self, x: Array) -> float:
        """Return the sum of squares [Pa^2] that parameters (p,) leave."""
        pairs = zip(self.classes, self.begins, strict=True)
        left = [self._residual(x, each, self._wave(x, each, begin)) for each, begin in pairs]
        return float(sum(np.vdot(each, each) for each in left))

    def normal(self, x: Array) -> tuple[Array, Array, float, float]:
        """Return the normal matrix (p, p), right side (p,), squares left [Pa^2], and long-run over plain variance.

        The last is the mean square of the score of g in a window over what white residuals would give.
        """
        N, b, squares = np.zeros((self.size, self.size)), np.zeros(self.size), 0.0
        scores = expected = 0.0
        K, lines = self.blocks, np.arange(self.falling, self.size)
        for each, begin in zip(self.classes, self.begins, strict=True):
            wave, m = self._wave(x, each, begin), each.occupied.size
            real, turned = wave.real, -wave.imag
            columns = np.array([-each.tau * real, each.tau * turned, real, turned, -each.slow * real])
            columns = np.concatenate([each.less_slow(columns), each.lines])
            left = self._residual(x, each, wave)
            squares += float(np.vdot(left, left))
            scores += float(np.sum(np.einsum("rn,rn->r", columns[0], left) ** 2))
            expected += float(np.vdot(columns[0], columns[0]))
            for own, block in enumerate(each.occupied):
                here = each.block == block
                rows = columns[:, here].reshape(len(columns), -1)
                at = np.concatenate([[block, K + block, begin + own, begin + m + own], lines])
                N[np.ix_(at, at)] += rows @ rows.T
                b[at] += rows @ left[here].ravel()
        variance = squares / self.freedom
        return N, b, squares, scores / max(expected * variance, np.finfo(float).tiny)

    def descend(self, x: Array) -> Array:
        """Return likelier parameters (p,), by damped Gauss-Newton steps."""
        damping = _DAMPED
        for _ in range(_STEPS):
            N, b, squares, _ = self.normal(x)
            variance, off = squares / self.freedom, x - self.centre
            H, slope = N / variance + self.strain, b / variance - self.strain @ off
            cost, gained = squares / variance + float(off @ self.strain @ off), 0.0
            while damping < _MOST_DAMPED and gained <= 0.0:
                step = np.linalg.solve(H + np.diag(damping * np.diag(H) + _RIDGE), slope)
                largest = float(np.max(np.abs(step[2 * self.blocks : self.falling])))
                fresh = x + min(1.0, _TURN / max(largest, _RIDGE)) * step
                fresh[self.blocks : 2 * self.blocks] = np.clip(fresh[self.blocks : 2 * self.blocks], *self.band)
                off = fresh - self.centre
                gained = cost - self.squares(fresh) / variance - float(off @ self.strain @ off)
                damping = damping / 8.0 if gained > 0.0 else 8.0 * damping
            if gained > 0.0:
                x = fresh
            if gained < _ENOUGH:
                break
        return x

    def information(self, x: Array) -> tuple[Array, Array]:
        """Return precision (K, K) and vector (K,) of g about parameters (p,), all others eliminated.

        What is believed of g itself, which guided the descent, is taken out.
        """
        N, b, squares, inflation = self.normal(x)
        scale, strain = self.freedom / (squares * max(1.0, inflation)), self.strain.copy()
        strain[: self.blocks, : self.blocks] = 0.0
        own = np.arange(self.blocks)
        precision, vector = eliminated(N * scale + strain, b * scale - strain @ (x - self.centre), own)
        return precision, vector + precision @ x[: self.blocks]


@dataclass(frozen=True, eq=False)
class RingDown:
    """The ring of a recording, block by block between `edges` (K + 1,) [samples].

    `omega` (K,) [rad/s]; `stiffness` (K,): its square over that of the rig's own [1]; `precision` (K, K) and `vector`
    (K,) of the damping g [1/s]; `inertance` M/(2 A^2) [kg/m^4].
    """

    edges: NDArray[np.int64]
    omega: Array
    stiffness: Array
    precision: Array
    vector: Array
    inertance: float

    @property
    def compliance(self) -> float:
        """Compliance of a chamber and what is connected to it [m^3/Pa], from the ring: C = 2 A^2/(M omega^2)."""
        weight = np.maximum(np.diag(self.precision), np.finfo(float).tiny)
        return float(1.0 / (self.inertance * (weight @ self.omega / weight.sum()) ** 2))


def ring_down(recording: Recording, rig: Rig) -> RingDown | None:
    """Return the ring of a recording that is `usable`, computed once; None where no reversal leaves a plateau."""

    def compute(recording: Recording) -> RingDown | None:
        edges, rate = block_edges(recording), recording.rate
        machine = Machine.of(rig)
        lowest = 1.0 - 2.0 * priors("ring_down")["frequency"].width
        slow = machine.omega * lowest > 2.0 * math.pi * _HIGHEST * rate
        classes = [] if slow else windows_of(recording, machine, edges)
        if not classes:
            return None
        blocks = edges.size - 1
        size = blocks, recording.duration / blocks, rate
        x = _Ring(classes, machine, *size).start()
        for share in _HEADS:  # a phase that is lost late in a window is kept early in it
            rings = _Ring([each.head(math.ceil(share * each.tau.shape[1])) for each in classes], machine, *size)
            x = rings.descend(x)
        precision, vector = rings.information(x)
        omega = x[blocks : 2 * blocks]
        return RingDown(edges, omega, (omega / machine.omega) ** 2, precision, vector, machine.inertance)

    return remembered(recording, ("ring down", rig), compute, ("u", "p_A", "p_B"))


def evidence(recording: Recording, rig: Rig) -> PressureEvidence | None:
    """Return what the ringing says of the conductance past the piston, block by block.

    Parameters
    ----------
    recording : Recording
        p_A, p_B [Pa] and the command u [V] at a uniform rate; windows with bridged samples are left out.
    rig : Rig
        What is believed of the machine: friction's falling slope, mass over area squared, where the ring may be.

    Returns
    -------
    PressureEvidence or None
        None where the rig's piston has no two like areas, a valve drives it, or nothing rings after a reversal.
    """
    ring = ring_down(recording, rig) if unusable(recording, rig) is None else None
    if ring is None:
        return None
    laws = (1.0, priors("ring_down")["orifice"].value)
    C = ring.compliance
    time, reach = middles(recording, ring.edges), wander_of_conductance(recording.duration)
    information = Information(time, ring.precision / C**2, ring.vector / C, slope=reach, walk=reach)
    return pressure_evidence(recording, ring.edges, information, laws)
