"""What drives a run: command and leakage coefficients at the nodes of its steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.compiled import kernel
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import Sine, check_command
from sealscope.simulation.faults.faults import Leak

if TYPE_CHECKING:
    from sealscope.simulation.experiment import Experiment


@kernel
def sines_of_sums(
    sine: np.ndarray, cosine: np.ndarray, sine_off: np.ndarray, cosine_off: np.ndarray, amplitude: float, offset: float
) -> np.ndarray:
    """offset + amplitude sin(a + b) for all a (n,) and b (m,), from the sines and cosines of both: (n, m)."""
    out = np.empty((sine.size, sine_off.size))
    for k in range(sine.size):
        s, c = amplitude * sine[k], amplitude * cosine[k]
        for m in range(sine_off.size):
            out[k, m] = offset + (s * cosine_off[m] + c * sine_off[m])
    return out


class NodeSines:
    """A sine at the nodes of steps, block after block: the sines of a block's steps are taken once, and turned by the
    angle at which a block begins. Within some 1e-13 of the sine of each time, as that is by the rounding of its angle.
    """

    def __init__(self, omega: float, phase: float) -> None:
        self._omega, self._phase = omega, phase
        self._steps = np.empty(0)
        self._sine = self._cosine = np.empty(0)

    def at(self, start: Array, offsets: Array, amplitude: float, offset: float) -> Array:
        """offset + amplitude sin(omega t + phase) at t = start[:, None] + offsets [s], evenly spaced starts: (n, m)."""
        n = start.size
        length = float(start[-1] - start[0])
        if not (n <= self._steps.size and abs(self._steps[n - 1] - length) <= 1e-9 * (1e-3 + length)):
            self._steps = start - start[0]
            self._sine, self._cosine = np.sin(self._omega * self._steps), np.cos(self._omega * self._steps)
        angle, turn = self._omega * float(start[0]) + self._phase, self._omega * offsets
        s, c = np.sin(angle), np.cos(angle)
        sine = s * self._cosine[:n] + c * self._sine[:n]
        cosine = c * self._cosine[:n] - s * self._sine[:n]
        return np.asarray(sines_of_sums(sine, cosine, np.sin(turn), np.cos(turn), amplitude, offset))


class RunInputs:
    """Command and leakage of an experiment as `integrate` takes them; `leaks` have their coefficients."""

    def __init__(self, experiment: Experiment, leaks: tuple[Leak, ...]) -> None:
        self._experiment, self._leaks, self._command = experiment, leaks, experiment.commanded
        self._limit = experiment.rig.daq.u_max
        self._zero = np.zeros((0, 0))
        if isinstance(self._command, Sine):
            self._sines = NodeSines(self._command.omega, self._command.phase)

    def leakage(self, t: Array) -> tuple[Array, Array]:
        """The coefficients G and C at times `t`."""
        G, C = self._none(t.shape), self._none(t.shape)
        for leak in self._leaks:
            more = (leak.coefficient or 0.0) * leak.opening.share(t)
            G, C = (G + more, C) if leak.law == "laminar" else (G, C + more)
        return G, C

    def _none(self, shape: tuple[int, ...]) -> Array:
        if self._zero.shape != shape:
            self._zero = np.zeros(shape)
            self._zero.flags.writeable = False
        return self._zero

    def _checked(self, u: Array, t: Array) -> Array:
        limit = self._limit
        if np.abs(u).max(initial=0.0) <= limit:
            return u
        # between samples, or beyond the end, where the filter still looks
        check_command(self._command, t[t <= self._experiment.duration], limit)
        return np.clip(u, -limit, limit)

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Command [V], G and C at times `t` of any shape."""
        return self._checked(self._command.volts(t), t), *self.leakage(t)

    def at_nodes(self, start: Array, offsets: Array) -> tuple[Array, Array, Array]:
        """The same at start[:, None] + offsets, for evenly spaced starts."""
        command = self._command
        sine = isinstance(command, Sine) and abs(command.amplitude) + abs(command.offset) <= self._limit
        if not sine:
            return self(start[:, None] + offsets)
        assert isinstance(command, Sine)
        u = self._sines.at(start, offsets, command.amplitude, command.offset)
        if self._leaks:
            return u, *self.leakage(start[:, None] + offsets)
        return u, self._none(u.shape), self._none(u.shape)

    def largest(self, t: Array) -> tuple[float, float]:
        """The largest G and C at times `t`."""
        if not self._leaks:
            return 0.0, 0.0
        G, C = self.leakage(t)
        return float(G.max(initial=0.0)), float(C.max(initial=0.0))
