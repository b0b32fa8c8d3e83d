"""The observer on a stream of samples: estimates do not depend on how a recording is divided into pieces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.diagnosis.observer.estimates import BlockRows, Estimates
from sealscope.diagnosis.observer.model import (
    G_PRIOR,
    PARAMETERS,
    compliance,
    displacement,
    mean_area,
    start_parameters,
    walks,
)
from sealscope.diagnosis.observer.pressure_filter import MEMORY, SEARCH_SECONDS, PressureFilter, find_stiffness
from sealscope.diagnosis.observer.volume_filter import VolumeFilter
from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.physics.rig import RigNumbers

#: What the observer reads: `volume` angle (or speed) and position, no friction in it; `speed` on the pressures
#: and the angle or speed; `command` on the pressures and the command.
Formulation = Literal["volume", "speed", "command"]
#: Least noise of a reading: a tenth of a step of 14 bits over 3000 psi [Pa], and the square of it in volume [m^3].
LEAST_PRESSURE, LEAST_VOLUME = 100.0, 1e-10
#: Interval of the samples by which the channels' senses are compared [s].
SLOW_SECONDS = 0.02


def whole(recording: Recording, name: str) -> bool:
    """Return whether a channel is recorded in SI units, without a gap, and moves."""
    if name not in recording or recording.units[name] == "count":
        return False
    return moves(recording[name])


def formulation_of(recording: Recording) -> Formulation | None:
    """Return the formulation that a recording's channels allow; None where there is neither command nor speed.

    Without the position the command serves better than the speed, whose encoder's steps are noise in the flow.
    """
    turned = whole(recording, "theta") or whole(recording, "omega")
    if turned and whole(recording, "x"):
        return "volume"
    if whole(recording, "u"):
        return "command"
    return "speed" if turned else None


def channels_of(formulation: Formulation, recording: Recording) -> tuple[str, ...]:
    """Return the channels that a formulation reads, of those that a recording has."""
    turning = "theta" if whole(recording, "theta") else "omega"
    return {
        "volume": (*CHAMBERS, turning, "x"),
        "speed": (*CHAMBERS, turning),
        "command": (*CHAMBERS, "u"),
    }[formulation]


class ObserverStream:
    """The observer on a stream: `update` takes the next samples, `estimates` are those of all blocks so far.

    `a`: the assumed machine (`model.assume`); `channels`: as `channels_of` gives them; `rate` [Hz]; `block_s` [s]:
    length of a block, best a whole number of the duty's cycles; `start`: parameters (8,) of the pressures' formulations
    at the start, by default `start_parameters`. The first seconds (`SEARCH_SECONDS`) are stored until the readings'
    noise, the senses of the channels and the oil's stiffness are estimated; after that memory grows by one row a block,
    unless the rows are `drained`.

    Raises InputError for a rate or a block length that is not positive.
    """

    def __init__(
        self, a: RigNumbers, channels: Sequence[str], rate: float, block_s: float, start: Array | None = None
    ) -> None:
        if not (rate > 0 and block_s > 0):
            raise InputError(f"rate and block length must be > 0, got {rate} Hz and {block_s} s")
        self._numbers, self.rate = a, float(rate)
        self.channels = tuple(channels)
        self.block = max(2, round(block_s * rate))
        self.block_s = self.block / self.rate
        self._start = start
        self._stored: list[dict[str, Array]] = []
        self._count = 0
        self._last: dict[str, float] = {}
        self._filter: PressureFilter | VolumeFilter | None = None

    def update(self, block: Recording) -> Estimates:
        """Take the next samples, in order and without a gap; returns the estimates of all blocks so far.

        Raises InputError where a channel is missing or not finite.
        """
        samples = {name: block[name] for name in self.channels}
        for name, values in samples.items():
            if not np.all(np.isfinite(values)):
                raise InputError(f"channel {name} must be finite for the observer, got NaN or infinity")
        if len(block):
            self._take(samples)
        return self.estimates

    @property
    def estimates(self) -> Estimates:
        """Estimates of all blocks so far."""
        return BlockRows(1).estimates() if self._filter is None else self._filter.blocks.estimates()

    @property
    def begun(self) -> bool:
        """Whether the first seconds are over and the filter runs."""
        return self._filter is not None

    def drained(self) -> Estimates:
        """Return the estimates of the blocks since the last call, and keep them no longer."""
        estimates = self.estimates
        if self._filter is not None:
            self._filter.blocks.clear()
        return estimates

    def resume(self, gap_s: float) -> None:
        """Go on by the pressures after a gap [s]: the states begin anew, the parameters have walked on meanwhile."""
        before = self._filter
        if not isinstance(before, PressureFilter):
            return
        variances = np.diag(before.P)[-len(PARAMETERS) :] + walks(gap_s)
        variances[0] = G_PRIOR**2
        start = before.q.copy(), np.sqrt(variances)
        self._filter = PressureFilter(self._numbers, before.commanded, self.rate, self.block, start, before.noise)
        self._last = {}

    def memory(self) -> dict[str, dict[str, Array]]:
        """Return what a stream by the pressures knows, its rows drained: `recall` continues with the same bits."""
        begun = isinstance(self._filter, PressureFilter)
        return {
            "stored": {name: np.concatenate([piece[name] for piece in self._stored]) for name in self.channels}
            if self._stored
            else {},
            "last": {name: np.array([value]) for name, value in self._last.items()},
            "start": {} if self._start is None else {"q": self._start},
            "turn": {"turn": np.array([self._turn])} if begun else {},
            "filter": {name: getattr(self._filter, name) for name in ("noise", *MEMORY)} if begun else {},
        }

    def recall(self, memory: Mapping[str, Mapping[str, Array]]) -> None:
        """Continue from a `memory`; raises InputError where it does not fit."""
        try:
            self._start = memory["start"].get("q")
            stored = {name: memory["stored"][name] for name in self.channels} if memory["stored"] else {}
            self._stored = [stored] if stored else []
            self._count = stored["p_A"].size if stored else 0
            self._last = {name: float(value[0]) for name, value in memory["last"].items()}
            if memory["filter"]:
                self._turn = float(memory["turn"]["turn"][0])
                arrays = dict(memory["filter"])
                commanded = "u" in self.channels
                start = start_parameters(self._numbers)
                self._filter = PressureFilter(
                    self._numbers, commanded, self.rate, self.block, start, arrays.pop("noise").copy()
                )
                for name in MEMORY:
                    getattr(self._filter, name)[...] = arrays[name]
        except (KeyError, IndexError, ValueError) as error:
            raise InputError(f"the observer's memory does not fit: {error!r}") from None

    def _take(self, samples: dict[str, Array]) -> None:
        if self._filter is None:
            self._stored.append(samples)
            self._count += samples["p_A"].size
            if self._count < round(SEARCH_SECONDS * self.rate):
                return
            samples = {name: np.concatenate([piece[name] for piece in self._stored]) for name in self.channels}
            self._stored = []
            self._begin(samples)
        self._run(samples)

    def _begin(self, samples: dict[str, Array]) -> None:
        """Estimate noise, senses and stiffness from the first seconds alone."""
        a = self._numbers
        first = {name: values[: round(SEARCH_SECONDS * self.rate)] for name, values in samples.items()}
        stride = max(1, round(SLOW_SECONDS * self.rate))
        slow = {name: values[::stride] for name, values in first.items()}
        dp = (slow["p_A"] - slow["p_B"])[1:]
        if "x" in self.channels:
            forward = np.diff(slow["x"])
            self._turn = _sense(_speed(slow), forward)
            self._push = _sense(dp, forward)
            self._origin = {name: float(first[name][0]) for name in ("theta", "x") if name in first}
            theta, x, drop = self._volumes(first, remember=False)
            volume = displacement(a) * theta - mean_area(a) * x - compliance(a) * drop
            noise = max(_fine_rms(volume), LEAST_VOLUME) ** 2
            self._filter = VolumeFilter(a, self.rate, self.block, noise)
            return
        self._turn = _sense(slow["u"][1:] if "u" in slow else _speed(slow), dp)
        variances = np.array([max(_fine_rms(first[name]), LEAST_PRESSURE) ** 2 for name in CHAMBERS])
        start = start_parameters(a)
        if self._start is not None:
            start = self._start, start[1]
        drive = self._drive(first, remember=False)
        commanded = "u" in self.channels
        q, deviations = start[0].copy(), start[1].copy()
        q[3] = find_stiffness(a, commanded, self.rate, start, variances, (drive, first["p_A"], first["p_B"]))
        deviations[3] *= q[3]
        self._filter = PressureFilter(a, commanded, self.rate, self.block, (q, deviations), variances)

    def _run(self, samples: dict[str, Array]) -> None:
        if isinstance(self._filter, VolumeFilter):
            self._filter.update(*self._volumes(samples))
        elif self._filter is not None:
            self._filter.update(self._drive(samples), samples["p_A"], samples["p_B"])

    def _volumes(self, samples: dict[str, Array], remember: bool = True) -> tuple[Array, Array, Array]:
        """Return angle, position and pressure difference, counted from the start and in one sense."""
        dp = self._push * (samples["p_A"] - samples["p_B"])
        x = samples["x"] - self._origin["x"]
        if "theta" in samples:
            return self._turn * (samples["theta"] - self._origin["theta"]), x, dp
        omega = samples["omega"]
        before = self._last.get("omega", float(omega[0]))
        moved = 0.5 / self.rate * (omega + np.concatenate([[before], omega[:-1]]))
        if "omega" not in self._last:
            moved[0] = 0.0
        theta = np.cumsum(np.concatenate([[self._last.get("theta", 0.0)], moved]))[1:]
        if remember:
            self._last = {"omega": float(omega[-1]), "theta": float(theta[-1])}
        return self._turn * theta, x, dp

    def _drive(self, samples: dict[str, Array], remember: bool = True) -> Array:
        """Return the command, or the mean speed since the sample before, in the pressures' sense."""
        name = next(channel for channel in ("u", "theta", "omega") if channel in samples)
        values = samples[name]
        if name == "u":
            return np.asarray(self._turn * values)
        before = np.concatenate([[self._last.get(name, float(values[0]))], values[:-1]])
        if remember:
            self._last = {name: float(values[-1])}
        return np.asarray(self._turn * ((values - before) * self.rate if name == "theta" else 0.5 * (values + before)))


def _speed(slow: dict[str, Array]) -> Array:
    return np.diff(slow["theta"]) if "theta" in slow else slow["omega"][1:]


def _sense(a: Array, b: Array) -> float:
    """Return 1, or -1 where two channels count against each other."""
    return -1.0 if float(np.dot(a - a.mean(), b - b.mean())) < 0 else 1.0


def _fine_rms(values: Array) -> float:
    """Return the RMS of d1, the finest detail: a reading's white noise."""
    from sealscope.signals.filters import decomposition_filters

    high = decomposition_filters()[1]
    detail = np.convolve(values - values.mean(), high, "valid")
    return float(np.sqrt(np.mean(detail**2)))
