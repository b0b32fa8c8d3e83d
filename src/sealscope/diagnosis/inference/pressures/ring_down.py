"""Pressures and command alone: the ringing after each reversal decays the faster, the more oil passes the piston.

At a reversal the piston sticks, breaks away, and p_A - p_B rings about its slow course. With two chambers of compliance
C = V/K and a piston of mass M and area A, chamber balance ``C p' = q - A v - G p`` (half of p each) and force balance
``M v' = A p - F(v)``, linear about the stroke's own speed v, give

    ring(tau) = exp(-int sigma) (a cos(omega tau) + b sin(omega tau)),
    sigma = dF/dv / (2 M) + G / C,    omega^2 = 2 A^2 / (C M):

a leak adds G/C, whatever the friction, and C follows from the ring's own frequency. Of the friction
``dF/dv = F_v - F_C (K_brk - 1) C_c exp(-C_c v)``, eq. (4.21), the part that falls with speed is known by shape from the
command, by size as a prior; the rest is constant within a stroke, as G/C is, and its slow change is what a test of
onsets allows for. Damping, frequency, amplitude and phase wander from block to block (`fit`). Reversals of like command
share amplitude and phase, each direction by itself. A polynomial takes the slow course out of each window.

Factorisation: this is p(pressures | command). A provider that reads position and angle states p(position | pressures,
angle) and takes p_A and p_B as given, so that both may be added.

Source of the ring: Merritt, Hydraulic Control Systems, 1967, section 6.6 (valve-piston combination, hydraulic natural
frequency and damping by leakage).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.pressures.evidence import (
    BELIEVED,
    PressureEvidence,
    block_edges,
    mains_waves,
    middles,
    unusable,
    wander_of_conductance,
)
from sealscope.diagnosis.inference.pressures.fit import STEPS, Beliefs, Block, Joint, Look, Normal, descend, strain_of
from sealscope.recordings.recording import Array, Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Parameters of a block: damping [1/s], frequency [rad/s], size of the friction's falling slope over 2 M [1/s]; then of
#: each class of reversals logarithm of the amplitude [Pa] and phase [rad].
DAMPING, OMEGA, SLOPE, RINGS = range(4)
_WINDOW = BELIEVED["window"]
#: Length of the transforms of the first look, and largest logarithm of a ring [Pa].
_LENGTH, _LOUDEST = 4096, 25.0


class Machine(NamedTuple):
    """What the rig's file says of the ring: `omega` [rad/s], slope of the friction over 2 M [1/s], speed per volt.

    `transition`: decay of the slope [s/m]; `inertance` M/(2 A^2) [kg/m^4].
    """

    omega: float
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
        return Machine(
            area * math.sqrt(2.0 * rig.fluid.K_oil / (cylinder.V * cylinder.M_eq)),
            -coulomb * (friction.K_brk - 1.0) * friction.C_c / (2.0 * cylinder.M_eq),
            friction.C_c,
            rig.motor.omega_per_volt * rig.pump.q_b / (2.0 * math.pi) / area,
            cylinder.M_eq / (2.0 * area**2),
        )


class Windows(NamedTuple):
    """Windows (r, n) of p_A - p_B [Pa] after r reversals of like command, as deviations from a slow polynomial.

    `values` in the sense of the motion; `tau` [s] from the window's place after the reversal; `slow`: time integral of
    exp(-C_c v) [s] over tau; `block` (r,); `basis` (n, d) of the polynomial.
    """

    values: Array
    tau: Array
    slow: Array
    block: NDArray[np.int64]
    basis: Array

    def less_slow(self, rows: Array) -> Array:
        """Return rows (..., r, n) without their slow polynomial."""
        return np.asarray(rows - (rows @ self.basis) @ self.basis.T)

    def head(self, share: float) -> Windows:
        """Return the first share of each window."""
        n = math.ceil(share * self.tau.shape[1])
        own = self._replace(tau=self.tau[:, :n], slow=self.slow[:, :n], basis=np.linalg.qr(self.basis[:n])[0])
        return own._replace(values=own.less_slow(self.values[:, :n]))


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


def _plateau(course: Array, ring: float) -> tuple[int, int] | None:
    """Return begin and length of what is straight in a half cycle's course (n,), by a ring's period [samples].

    It lies between the sharpest bends in either half; None where it is short.
    """
    width, guard = round(_WINDOW["bend"] * ring), round(_WINDOW["guard"] * ring)
    line = np.arange(width) - 0.5 * (width - 1)
    slope = np.correlate(course, line / (line @ line), "valid")
    if slope.size < 2 * width + 2:
        return None
    bend, middle = slope[:-width] - slope[width:], course.size // 2 - width
    begin, end = int(np.argmax(bend[:middle])) + width, int(np.argmax(bend[middle:])) + middle + width
    length = end - begin - 2 * guard
    return None if length < 2.0 * _WINDOW["bend"] * ring else (begin + guard, length)


def windows_of(recording: Recording, machine: Machine, edges: NDArray[np.int64]) -> list[Windows]:
    """Return the windows of a recording in classes of like reversals; `edges` (K + 1,) of the blocks [samples]."""
    u, dp, rate = recording["u"], recording["p_A"] - recording["p_B"], recording.rate
    place, sense = reversals(u)
    if place.size < 2:
        return []
    waves = mains_waves(recording["p_A"] + recording["p_B"], rate)
    dp = dp - (np.linalg.pinv(waves @ waves.T, hermitian=True) @ (waves @ dp)) @ waves
    first, span, ring = np.ceil(place[:-1]).astype(np.int64), np.diff(place), 2.0 * math.pi / machine.omega * rate
    size = np.sqrt(np.add.reduceat(u**2, place.astype(np.int64))[:-1] / span)
    keys = np.column_stack([sense[:-1], *(np.round(np.log(own) / _WINDOW["alike"]) for own in (span, size))])
    kind = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    kind[0] = -1  # the machine starts
    way = sense[:-1, None] * np.sign(np.mean(u * (dp - dp.mean())))
    missing = np.zeros(len(u) + 1) if recording.bridged is None else np.append(0, np.cumsum(recording.bridged))
    classes = []
    for k in range(int(kind.max()) + 1):
        length = int(span[kind == k].min(initial=len(u))) - 1
        alike = np.flatnonzero((kind == k) & (missing[np.minimum(first + length, len(u))] == missing[first]))
        if not alike.size:
            continue
        plateau = _plateau(np.mean(dp[first[alike, None] + np.arange(length)] * way[alike], axis=0), ring)
        if plateau is None:
            continue
        begin, n = plateau
        rows = first[alike, None] + begin + np.arange(n)
        degree = max(3, round(n / (_WINDOW["degree"] * ring)))
        own = Windows(
            values=dp[rows] * way[alike],
            tau=((first - place[:-1])[alike, None] + np.arange(n)) / rate,
            slow=np.cumsum(np.exp(-machine.transition * machine.speed * np.abs(u[rows])), axis=1) / rate,
            block=np.clip(np.searchsorted(edges, rows[:, n // 2], "right") - 1, 0, edges.size - 2),
            basis=np.asarray(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), degree), dtype=float),
        )
        classes.append(own.head(1.0))
    return classes


class Ring:
    """The model of the ring in the windows of a recording, fitted to all blocks together.

    `kinds`: parameters that each block has; `theta` is a block's after another's.
    """

    def __init__(self, classes: Sequence[Windows], machine: Machine, blocks: int, rate: float) -> None:
        self.classes, self.machine, self.rate = classes, machine, rate
        known = BELIEVED["ring"]
        rows = [known["damping"], np.multiply(known["frequency"], machine.omega)]
        rows += [np.multiply(known["slope"], [machine.falling, abs(machine.falling), abs(machine.falling)])]
        rows += [known["amplitude"], known["phase"]] * len(classes)
        self.beliefs = Beliefs(*np.maximum(np.array(rows, dtype=float).T, [[-np.inf], [1e-9], [1e-9]]))
        has = np.ones((len(rows), blocks), dtype=bool)
        for c, each in enumerate(classes):
            has[RINGS + 2 * c : RINGS + 2 * c + 2] = np.isin(np.arange(blocks), each.block)
        self.kinds = [np.flatnonzero(own) for own in has.T]
        self.kind = np.concatenate(self.kinds)
        self.place = np.full((blocks, len(rows)), -1)  # of each parameter in theta
        self.place[has.T] = np.arange(self.kind.size)
        self.place = self.place.T
        self.unit = self.beliefs.unit[self.kind]
        self.freedom = sum(each.values.size - each.block.size * each.basis.shape[1] for each in classes)
        off = 2.0 * self.beliefs.width[OMEGA] * np.array([-1.0, 1.0])
        self.band = self.beliefs.centre[OMEGA] + off  # what else moves is no ring
        self.middle = (np.arange(blocks) + 0.5) / blocks - 0.5

    def _wave(self, x: Array, c: int) -> NDArray[np.complex128]:
        """Return the ring (r, n) of a class as a complex wave, whose real part is seen."""
        each = self.classes[c]
        damping, omega, slope, size, phase = (
            x[self.place[k, each.block], None] for k in (0, 1, 2, 3 + 2 * c, 4 + 2 * c)
        )
        decay = np.minimum(size - damping * each.tau - slope * each.slow, _LOUDEST)
        return np.asarray(np.exp(decay + 1j * (phase + omega * each.tau)))

    def blocks(self, x: Array) -> list[Block]:
        """Return the sums of all blocks about parameters (P,), the scores in each window."""
        grams = [np.zeros((1 + kinds.size, 1 + kinds.size)) for kinds in self.kinds]
        scores: list[list[Array]] = [[] for _ in grams]
        samples = np.zeros(len(grams))
        for c, each in enumerate(self.classes):
            wave = self._wave(x, c)
            real, turned = wave.real, -wave.imag
            rows = np.array([-each.tau * real, each.tau * turned, -each.slow * real, real, turned])
            kinds = [DAMPING, OMEGA, SLOPE, RINGS + 2 * c, RINGS + 2 * c + 1]
            rows = each.less_slow(rows * self.beliefs.unit[kinds, None, None])
            rows = np.concatenate([(each.values - each.less_slow(real))[None], rows]).transpose(1, 0, 2)
            for block, products in zip(each.block, rows @ rows.transpose(0, 2, 1), strict=True):
                at = np.append(0, 1 + np.searchsorted(self.kinds[block], kinds))
                grams[block][np.ix_(at, at)] += products
                scores[block].append(np.zeros(len(grams[block])))
                scores[block][-1][at] = products[1 + DAMPING]
                samples[block] += each.values.shape[1] - each.basis.shape[1]
        theta = [x[own[own >= 0]] for own in self.place.T]
        pieces = [np.array(own).reshape(-1, len(gram)) for own, gram in zip(scores, grams, strict=True)]
        return [Block(*own) for own in zip(theta, self.kinds, grams, samples, pieces, strict=True)]

    def look(self, paths: Array) -> tuple[Look, Array]:
        """Return the look about the first of some sets (m, P), and the squares [Pa^2] that each leaves, (m,)."""
        blocks, rings = self.blocks(paths[0]), range(len(self.classes))
        gram = np.zeros((1 + self.kind.size, 1 + self.kind.size))
        gram[1:, 1:] = block_diag(*(block.gram[1:, 1:] for block in blocks))
        gram[0, 0], gram[0, 1:] = (
            sum(own.squares for own in blocks),
            np.concatenate([own.gram[0, 1:] for own in blocks]),
        )
        squares = [float(gram[0, 0])]
        for x in paths[1:]:
            left = (self.classes[c].values - self.classes[c].less_slow(self._wave(x, c).real) for c in rings)
            squares.append(sum(float(np.vdot(own, own)) for own in left))
        return Look(paths[0], gram), np.array(squares)

    def bounds(self, theta: Array) -> tuple[Array, Array]:
        """Return between which parameters a step may lead: a frequency of the machine."""
        of_ring = self.kind == OMEGA
        return np.where(of_ring, self.band[0], -np.inf), np.where(of_ring, self.band[1], np.inf)

    def spread(self, squares: float) -> float:
        """Return the variance of the noise [Pa^2] where so much is left."""
        return max(squares, 1.0) / float(self.freedom)

    def start(self) -> Array:
        """Return parameters (P,) from a first look, with amplitudes and phases that change evenly."""
        omega, drift, damping = self._strongest()
        slowness = np.mean([np.mean(each.slow[:, -1] / each.tau[:, -1]) for each in self.classes])
        x = np.zeros(self.kind.size)
        x[self.kind == DAMPING] = damping - self.machine.falling * slowness
        x[self.kind == OMEGA] = omega * (1.0 + drift * self.middle)
        x[self.kind == SLOPE] = self.machine.falling
        for c, each in enumerate(self.classes):
            wave, when = self._wave(x, c), self.middle[each.block][:, None]
            rows = each.less_slow(np.array([wave.real, -wave.imag, wave.real * when, -wave.imag * when]))
            a = np.linalg.lstsq(rows.reshape(4, -1).T, each.values.ravel(), rcond=None)[0]
            occupied = np.unique(each.block)
            course = (a[0] + 1j * a[1]) + (a[2] + 1j * a[3]) * self.middle[occupied]
            x[self.place[RINGS + 2 * c, occupied]] = np.log(np.maximum(np.abs(course), np.finfo(float).tiny))
            x[self.place[RINGS + 2 * c + 1, occupied]] = np.unwrap(np.angle(course))
        return x

    def _strongest(self) -> tuple[float, float, float]:
        """Return frequency [rad/s], its drift [1] and the damping [1/s] that gather most power of the windows.

        Windows are summed over blocks of a steady amplitude, with phases that turn evenly over the recording.
        """
        blocks, width = np.arange(self.middle.size)[:, None], 2.0 * np.pi * self.rate / _LENGTH
        drifts = _WINDOW["drift"] * np.linspace(-1.0, 1.0, 21)
        low, high = self.band / width
        around = np.arange(math.ceil(low), min(high, _WINDOW["highest"] * _LENGTH))
        bins = np.arange(math.floor(low * (1.0 + drifts[0])), min(math.ceil(high * (1.0 + drifts[-1])), _LENGTH // 2))
        turns = np.abs(np.fft.fftfreq(4 * blocks.size, 1.0 / blocks.size)) <= _WINDOW["turns"]
        best, chosen = -1.0, (self.machine.omega, 0.0, 0.0)
        for damping in _WINDOW["dampings"]:
            sums = []
            for each in self.classes:
                decay = np.exp(-damping * np.arange(each.tau.shape[1]) / self.rate)
                shift = np.exp(-1j * width * bins * each.tau[:, :1])
                spectra = np.fft.rfft(each.values * (decay / np.linalg.norm(decay)), _LENGTH)[:, bins] * shift
                sums.append((each.block == blocks) @ spectra / math.sqrt(each.block.size))
            for drift in drifts:
                at = np.rint(around * (1.0 + drift * self.middle[:, None])).astype(np.int64)
                at = np.minimum(at, bins[-1]) - bins[0]
                power = sum(
                    np.max(np.abs(np.fft.fft(total[blocks, at], 4 * blocks.size, axis=0)[turns]) ** 2, axis=0)
                    for total in sums
                )
                k = int(np.argmax(power))
                if power[k] > best:
                    best, chosen = float(power[k]), (width * float(around[k]), float(drift), damping)
        return chosen


class RingDown(NamedTuple):
    """The ring of a recording, block by block.

    `omega` (K,) [rad/s]; `information` of the damping [1/s]; `inertance` M/(2 A^2) [kg/m^4].
    """

    omega: Array
    information: Information
    inertance: float

    @property
    def compliance(self) -> float:
        """Compliance of a chamber and what is connected to it [m^3/Pa], from the ring: C = 2 A^2/(M omega^2)."""
        weight = np.maximum(np.diag(self.information.precision), np.finfo(float).tiny)
        return float(1.0 / (self.inertance * (weight @ self.omega / weight.sum()) ** 2))


def ring_down(recording: Recording, rig: Rig) -> RingDown | None:
    """Return the ring of a recording that is `usable`, computed once; None where no reversal leaves a plateau."""

    def compute(recording: Recording) -> RingDown | None:
        edges, rate, machine = block_edges(recording), recording.rate, Machine.of(rig)
        lowest = 1.0 - 2.0 * BELIEVED["ring"]["frequency"][1]
        slow = machine.omega * lowest > 2.0 * math.pi * _WINDOW["highest"] * rate
        classes = [] if slow else windows_of(recording, machine, edges)
        if not classes:
            return None
        blocks, seconds = edges.size - 1, recording.duration / (edges.size - 1)
        model = Ring(classes, machine, blocks, rate)
        belief = Normal(model.beliefs.centre[model.kind], strain_of(model.kinds, model.beliefs, seconds))
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                x = model.start()
                for share in _WINDOW["heads"]:
                    model = Ring([each.head(share) for each in classes], machine, blocks, rate)
                    x = descend(model, model.look(x[None])[0], belief, STEPS).theta
                joint = Joint.of(model.blocks(x), model.beliefs, seconds, DAMPING)
            except np.linalg.LinAlgError:
                return None
        information = joint.information(DAMPING, middles(recording, edges), np.inf)
        return RingDown(x[model.kind == OMEGA], information, machine.inertance)

    return remembered(recording, ("ring down", rig), compute, ("u", "p_A", "p_B"))


def evidence(recording: Recording, rig: Rig) -> PressureEvidence | None:
    """Return what the ringing says of the conductance; None where nothing rings, or the circuit is another."""
    ring = ring_down(recording, rig) if unusable(recording, rig) is None else None
    if ring is None:
        return None
    C, damping, reach = ring.compliance, ring.information, wander_of_conductance(recording.duration)
    own = Information(damping.time, damping.precision / C**2, damping.vector / C, slope=reach, walk=reach)
    return PressureEvidence.of("ring", recording, rig, {"G": own})
