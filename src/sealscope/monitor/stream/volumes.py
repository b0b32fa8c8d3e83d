"""An actuator watched by its balance of volumes: position, pump's angle or speed, and both chamber pressures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.volume_balance.blocks import (
    BLOCK_SECONDS,
    BalanceBlocks,
    Geometry,
    balance_channels,
    block_samples,
    cut_blocks,
)
from sealscope.diagnosis.volume_balance.evidence import trouble
from sealscope.diagnosis.volume_balance.fit import fit_balance
from sealscope.monitor.stream.decisions import WINDOW, ConductanceRise, step_of
from sealscope.monitor.stream.estimator import PAUSE_S, BlockConductance, NotJudged, RecentBlocks
from sealscope.monitor.stream.geometry import LEVEL, FrozenBalance, duty_of, in_motion
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import array_of, part_of, plain_array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Blocks that the frozen balance is fitted to, at most.
_FIT_BLOCKS = 60


class VolumeEstimator:
    """The frozen balance of volumes; see `estimator.ConductanceEstimator`."""

    levels, size_error, orifice, pace = True, LEVEL, 1.0, 1

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._used: tuple[str, ...] = ()
        self._balance: FrozenBalance | None = None
        self._window: BalanceBlocks | None = None
        self._shown: RecentBlocks | None = None  # what the window shows, once somebody has asked

    @classmethod
    def of(cls, rig: Rig) -> VolumeEstimator:
        """Return the estimator of a machine, of which nothing is known but areas and displacement."""
        areas = rig.cylinder.A_A, rig.cylinder.A_B
        return cls(Geometry(0.5 * sum(areas), rig.pump.q_b / (2.0 * np.pi), areas[0] != areas[1]))

    @property
    def litres(self) -> bool:
        """Whether L/min can be stated."""
        return self._balance is not None and self._balance.litres

    def seconds_of(self, first: Recording) -> float | None:
        """Return the length of a block [s], None where the piston does not move."""
        if not np.ptp(first["x"]) > 0.0:
            return None
        self._used = balance_channels(first)
        return block_samples(first, BLOCK_SECONDS) / first.rate

    def take(self, block: Recording, to_learn: int) -> Sequence[BlockConductance] | NotJudged:
        """Return what a block shows."""
        samples = {name: block[name] for name in self._used}
        return self.readings(cut_blocks(block.t, samples, len(block), block.rate, self._geometry), to_learn)

    def readings(self, cut: BalanceBlocks, to_learn: int) -> Sequence[BlockConductance] | NotJudged:
        """Return what a block that is cut already shows, none or one."""
        if len(cut) == 0 or not np.all(np.isfinite(cut.gram)):
            return _passed_over("missing values")
        if not in_motion(cut).all():
            return _passed_over("at rest")
        if self._balance is None:
            return self._learn(cut, to_learn)
        return self._reading(cut)

    def _learn(self, cut: BalanceBlocks, to_learn: int) -> Sequence[BlockConductance] | NotJudged:
        """Take a block until there are enough to fit the shared coefficients."""
        window = self._joined(cut)
        if len(window) < min(_FIT_BLOCKS, max(FEWEST, to_learn)):
            return NotJudged("learning")
        fit = fit_balance(window, metres=True, geometry=self._geometry)
        problem = trouble(fit)
        if problem is not None:
            half = len(window) // 2
            self._keep(window.chosen(slice(half, None)))
            return NotJudged(problem, "blocks: no balance can be fitted", half)
        self._balance = FrozenBalance.of(fit.without_slopes)
        self._keep(None)
        shown = [self._reading(window.chosen(np.array([k]))) for k in range(len(window))]
        return [block for blocks in shown if not isinstance(blocks, NotJudged) for block in blocks] or shown[-1]

    def _reading(self, cut: BalanceBlocks) -> Sequence[BlockConductance] | NotJudged:
        balance = self._balance
        assert balance is not None
        problem = balance.unusable(cut)
        if problem is not None:
            return _passed_over(problem)
        g, sd = balance.conductances(cut)
        t, first, deviation, offset, flow = (
            float(value[0]) for value in (cut.t, g, sd, balance.offset(cut), balance.flow(cut))
        )
        return [BlockConductance(t, first, deviation, offset, flow, duty_of(cut)[0], cut)]

    def _joined(self, cut: BalanceBlocks) -> BalanceBlocks:
        """Return the last blocks, this one included."""
        before = self._window
        if before is not None and not 0.0 < float(cut.t[0] - before.t[-1]) <= PAUSE_S:
            before = None  # a pause, or the clock was set back
        if before is not None and (before.samples, before.gram.shape[1]) != (cut.samples, cut.gram.shape[1]):
            before = None
        window = cut if before is None else BalanceBlocks.joined([before.chosen(slice(1 - WINDOW, None)), cut])
        self._keep(window)
        return window

    def _keep(self, window: BalanceBlocks | None) -> None:
        self._window, self._shown = window, None

    def append(self, block: BlockConductance) -> RecentBlocks:
        """Keep a block that is judged; return the last ones, up to a pause."""
        self._joined(block.source)
        return self.series()

    def series(self) -> RecentBlocks:
        """Return the last blocks."""
        window, balance = self._window, self._balance
        if window is None or balance is None:
            return RecentBlocks(np.empty(0), np.empty(0), np.empty(0))
        if self._shown is None:
            self._shown = RecentBlocks(window.t, balance.conductances(window)[0], balance.flow(window))
        return self._shown

    def step(self, probability: float, *, again: bool) -> tuple[ConductanceRise | None, str | None]:
        """Return the rise that the last blocks show, and what forbids to compare them."""
        assert self._window is not None
        return step_of(self._window, self.series().g, probability, self._geometry, again=again)

    def forget(self, keep: int = 0) -> None:
        """Compare with nothing before the last `keep` blocks."""
        window = self._window
        self._keep(None if window is None or not keep else window.chosen(slice(-keep, None)))

    def relearn(self) -> None:
        """Fit the balance again."""
        self._balance = None
        self.forget()

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        window, geometry = self._window, self._geometry
        return {
            "area": geometry.area,
            "displacement": geometry.displacement,
            "unequal": geometry.unequal,
            "used": list(self._used),
            "balance": None if self._balance is None else self._balance.state(),
            "window": None
            if window is None
            else {
                name: plain_array(value) if isinstance(value, np.ndarray) else value
                for name, value in ((field.name, getattr(window, field.name)) for field in fields(window))
            },
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> VolumeEstimator:
        """Return the estimator that `state` was of; raises InputError where it does not fit."""
        area, displacement = (float(part_of(state, name, (float, int))) for name in ("area", "displacement"))
        estimator = cls(Geometry(area, displacement, bool(part_of(state, "unequal", bool))))
        estimator._used = tuple(part_of(state, "used", list))
        balance, window = (part_of(state, name, (Mapping, type(None))) for name in ("balance", "window"))
        estimator._balance = None if balance is None else FrozenBalance.from_state(balance)
        estimator._window = None if window is None else _blocks_of(window)
        return estimator


def _passed_over(status: str) -> NotJudged:
    return NotJudged(status, f"blocks: {status}")


def _blocks_of(state: Mapping[str, Any]) -> BalanceBlocks:
    values: dict[str, Any] = {}
    for field in fields(BalanceBlocks):
        value = part_of(state, field.name, (Mapping, int, float))
        values[field.name] = array_of(value, field.name) if isinstance(value, Mapping) else value
    return BalanceBlocks(**values)
