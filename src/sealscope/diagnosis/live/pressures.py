"""Watch an actuator from both chamber pressures and the command, without a position.

A model of the response of p_A - p_B to the command is fitted block by block
(`diagnosis.inference.pressures.response`). It follows changes of friction, stiffness and gain as the oil warms, so
that these are not taken for a leak. Only changes of the leakage conductance are stated, not its level. Blocks are not
compared across a pause, or after the fit was lost.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.diagnosis.inference.pressures.detector import RESPONSE, score_response_steps
from sealscope.diagnosis.inference.pressures.fit import Block, Joint
from sealscope.diagnosis.inference.pressures.leak import HIGH_LAW_RATIO, conductance_scale_error, states_flow
from sealscope.diagnosis.inference.pressures.reduced_rig import LAWS, PARAMETERS, G
from sealscope.diagnosis.inference.pressures.response import Follower, parameter_information
from sealscope.diagnosis.inference.pressures.samples import find_unmet_requirement
from sealscope.diagnosis.live.balance import BlockConductance, BlockResult, NotJudged
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.signals import MIN_BLOCKS, SignalWindow, append_row
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.errors import InputError
from sealscope.recordings.motion import describe_hold, find_holds, is_moving
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import SavedAttributes, require_part, restore_attributes, save_attributes

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRIORS = LIVE.response
#: Numbers of blocks until the simulated states have settled: at the start, and after a gap of at most `_PAUSE` [s].
_SETTLING, _RESUMING = _PRIORS.settling, _PRIORS.resuming
_PAUSE: float = LIVE.watch.pause
_READ = ("p_A", "p_B", "u")  # channels
#: Lowest sampling rate that is judged [Hz].
_MIN_RATE: float = PRESSURE.blocks.slowest
#: Rows of the stored samples that are pressures; row 0 is the time.
_PRESSURES = (1, 2)
#: Size of a block's Gram matrix: the residual, and its derivative by each parameter.
_N_SUMS = 1 + len(PARAMETERS)
#: Columns of a stored block: its end [s] and number of samples, then parameters, Gram matrix and scores of its fit.
_END, _SAMPLES = 0, 1
_THETA = slice(2, 2 + len(PARAMETERS))
_GRAM = slice(_THETA.stop, _THETA.stop + _N_SUMS**2)
_SCORES = slice(_GRAM.stop, None)
#: Standard deviation of the prior of the conductance [m^3/(s Pa)], below which an estimate is resolved in any case.
_MAX_SD: float = PRESSURE.response["G"][1]


class PressureEstimator(SavedAttributes):
    """Estimate changes of the leakage conductance from the response of the pressures to the command, block by block."""

    method = "pressures"  # name of the way of watching
    data = RESPONSE  # kind of data (`Observable.data`) from which the conductance is estimated
    states_level = False  # True if the level of the conductance is stated
    cause: Cause = "piston, pump or external leak"
    size_error = leak_error = conductance_scale_error()  # relative standard error of changes of the conductance
    # limits of the flow of any leak over that of a laminar one past the piston with the same estimated conductance
    max_law_ratio: float = HIGH_LAW_RATIO
    # least, usual and largest ratio of the flow of a leak to the outside to the estimated one
    outside_ratios: tuple[float, float, float] = LIVE.watch.outside_by_pressures
    min_law_ratio: float = outside_ratios[0]  # the leak may be one to the outside
    block_seconds: float = _PRIORS.seconds
    states_flow = staticmethod(states_flow)
    SAVED = ("_samples", "_held", "_end", "_restarts", "_settling", "_misfits", "_rows", "_signals")

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._samples = np.empty((1 + len(_READ), 0))  # times and channels since the last whole block
        self._follower: Follower | None = None
        self._held = np.full(len(_PRESSURES), math.nan)  # values that stuck pressure readings repeat, nan if not stuck
        self._end = math.nan  # end of the last block to which the model was fitted [s]
        self._restarts = False  # True if the next block is the first after a fit: no comparison with earlier blocks
        self._settling = _SETTLING  # number of next blocks in which the simulated states still depend on their start
        self._misfits = 0  # number of successive blocks that the model does not describe
        self._rows = np.empty((0, 0))  # one row per block: sums from which the leakage of the last blocks is estimated
        self._signals = SignalWindow()

    @property
    def has_begun(self) -> bool:
        """True once the machine has moved long enough for its response to be fitted."""
        return self._follower is not None or self._rows.size > 0  # the fit may be lost

    def take(self, run: SampleRun) -> Iterator[BlockResult]:
        """Process the next samples, and yield the result of each block that they complete.

        Before the first block, after a long pause and once the fit was lost, the model is fitted to `response.begins`
        (`priors.toml`) seconds of samples, from several starts: the filter alone, which may have wandered along with
        the oil, would stay in a wrong minimum. If these samples cannot be used, the reason is yielded, and the fit is
        tried again with their second half and as many new ones. Samples before a gap that do not fill a block are
        dropped.
        """
        if not run.follows:
            self._held[:] = math.nan  # no reading is stuck so far
            self._samples = self._samples[:, :0]
        samples = np.hstack([self._samples, [run.t, *(run.channels[name] for name in _READ)]])
        # numbers of samples: for the first fit, and in a block
        n_first, n_block = (round(seconds * run.rate) for seconds in (_PRIORS.begins, self.block_seconds))
        is_slow = run.rate < _MIN_RATE  # blocks are refused without a fit
        while samples.shape[1]:
            if not (is_slow or self._is_short_gap(float(samples[0, 0]) - self._end, run.rate)):
                self._follower = None
            if samples.shape[1] < (n_first if self._follower is None and not is_slow else n_block):
                break
            if self._follower is None and not is_slow:
                beginning = _make_recording(samples[:, :n_first], run.rate)
                if reason := find_unmet_requirement(beginning, self._rig) or describe_hold(beginning):
                    samples = samples[:, n_first // 2 :]
                    counter = f"half minutes before the first block: {reason}"  # half of a minute, `response.begins`
                    yield NotJudged(float(run.t[-1]), status="", counter=counter)
                else:
                    self._follower = Follower.fit_start(beginning, self._rig)
                    self._end, self._settling, self._restarts = float(beginning.t[0]), _SETTLING, True
            elif self._remove_holds(samples, n_block, run.rate):
                block = _make_recording(samples[:, :n_block], run.rate)
                samples = samples[:, n_block:]
                yield self._estimate_block(block)
            else:
                break
        self._samples = samples.copy()

    def _remove_holds(self, samples: Array, n_block: int, rate: float) -> bool:
        """Set stuck pressure readings in the first `n_block` columns of `samples` (time, p_A, p_B, command) to nan.

        The first reading of a hold is kept. If it is the last sample of a block, the hold counts as beginning with the
        next block, whose first sample is kept, too. Returns False, and changes nothing, if only later samples can show
        whether a reading is stuck; otherwise True.
        """
        holds = [find_holds(samples[row], rate, held) for row, held in zip(_PRESSURES, self._held, strict=True)]
        # `pending`: index of the first sample whose flag later samples may change
        if min(hold.pending for hold in holds) < n_block:
            return False
        for k, (row, hold) in enumerate(zip(_PRESSURES, holds, strict=True)):
            self._held[k] = samples[row, n_block - 1] if hold.flags[n_block - 1] else math.nan
            samples[row, :n_block][hold.flags[:n_block]] = math.nan
        return True

    def _estimate_block(self, block: Recording) -> BlockResult:
        """Estimate the leakage conductance in a block of samples, or return the reason why there is none."""
        begin, end = float(block.t[0]), float(block.t[-1]) + 1.0 / block.rate
        if self._follower is None or block.rate < _MIN_RATE:
            return NotJudged.with_count(end, f"sampled at less than {_MIN_RATE:g} Hz")
        if not all(np.isfinite(block[name]).all() for name in _READ):
            return NotJudged.with_count(end, "missing values")
        follower, has_other_rate = self._resume(self._follower, begin - self._end, block.rate)
        restarts, self._restarts = has_other_rate or self._restarts, False
        self._follower, self._end = follower, end
        is_settling = self._settling > 0
        self._settling = max(self._settling - 1, 0)
        if not self._follow(follower, block, is_settling):
            return self._reject(follower, end, is_settling, restarts)
        self._misfits = 0
        if is_settling:
            return NotJudged.with_count(end, "settling", restarts=restarts)
        # G: index of the conductance; the covariance is in units of the priors
        g, sd = float(follower.theta[G]), math.sqrt(follower.covariance[G, G]) * float(follower.priors.unit[G])
        if sd > _MAX_SD and WITHIN_95 * sd > abs(g):  # a large leak is known well enough if it is surely no 0
            status = "conductance not resolved" if is_moving(block["u"]) else "at standstill"
            return NotJudged.with_count(end, status, restarts=restarts)
        pressure = float(np.mean(np.abs(block["p_A"] - block["p_B"])))
        speed = self._rig.motor.omega_per_volt * float(np.mean(np.abs(block["u"])))
        pump_flow = speed * self._rig.pump.q_b / (2.0 * math.pi)
        # `offset`: deviation of the error that all blocks share; as large as the prior's, as only changes are measured
        return [BlockConductance(begin, end, g, sd, total=g, offset=_MAX_SD, pressure=pressure, pump_flow=pump_flow)]

    def _reject(self, follower: Follower, end: float, is_settling: bool, restarts: bool) -> NotJudged:
        """Report a block that the model of the pressures does not describe, and restart the fit if it is lost.

        It is lost after `response.lost` (`priors.toml`) such blocks in succession, or if a parameter is not finite. The
        next samples are then fitted as the first ones were (`take`). `is_settling`: True if the fit had not settled
        before this block; `restarts`: True if this block cannot be compared with earlier ones.
        """
        self._misfits += 1
        if self._misfits >= _PRIORS.lost or not np.isfinite(follower.theta).all():
            self._follower, self._misfits = None, 0
            return NotJudged.with_count(end, "not described by the model", restarts=True)
        self._settling = self._settling if is_settling else _RESUMING
        status = "settling" if is_settling else "not described by the model"
        return NotJudged.with_count(end, status, restarts=restarts)

    def _resume(self, follower: Follower, gap: float, rate: float) -> tuple[Follower, bool]:
        """Prepare the fit for a block that follows after a short `gap` [s], or with another sampling `rate` [Hz].

        Returns the fit to use, and True if the rate is another, so that blocks cannot be compared with earlier ones.
        """
        has_other_rate = follower.machine.rate != rate
        if has_other_rate:
            follower = follower.at_rate(self._rig, rate)
        elif abs(gap) < 0.5 / rate:
            return follower, False
        follower.interrupt(max(gap, 0.0))
        self._settling = max(self._settling, _RESUMING)
        return follower, has_other_rate

    @staticmethod
    def _is_short_gap(gap: float, rate: float) -> bool:
        """Return True if the fit continues after a `gap` [s] between samples, False for nan, before the first block."""
        return -1.0 / rate <= gap <= _PAUSE  # a rounded clock may be set back by a sample

    def _follow(self, follower: Follower, block: Recording, is_settling: bool) -> bool:
        """Fit the model of the pressures to a block, and store the block; return True if the model describes it.

        The usual variance of the residuals is updated, faster if the fit is settling or does not describe the block.
        """
        sums = follower.update(block)
        self._signals.take(float(block.t[0]), {name: block[name] for name in _READ}, block.rate)
        row = np.concatenate([[self._end, sums.samples], sums.theta, sums.gram.ravel(), sums.scores.ravel()])
        self._rows = append_row(self._rows, row)
        # `excess`: chi square of the block above its mean, in standard deviations
        is_described = bool(np.isfinite(follower.theta).all()) and follower.excess < _PRIORS.described
        variance = float(sums.gram[0, 0]) / max(sums.samples, 1.0)  # row 0 of the Gram matrix: residuals
        if math.isfinite(variance):
            # a geometric mean with fading memory; a block counts as at least 1 Pa^2, and as 0.1 to 10 times the mean
            ratio = float(np.clip(max(variance, 1.0) / follower.variance, 0.1, 10.0))
            n_blocks = _PRIORS.usual if is_described and not is_settling else _RESUMING
            follower.variance *= ratio ** (1.0 / n_blocks)
        return is_described

    def observables(self, since: float, end: float, onset: float) -> tuple[Observable, ...] | None:
        """Test the model's parameters and the signals of the last blocks, from `since` to `end` [s], for changes.

        The result is None if the stored blocks do not reach from the onset of the leakage's increase, `onset` [s], to
        `end`. It is empty if there are too few blocks, or if the fit to all blocks together fails.
        """
        rows, seconds = self._rows, self.block_seconds
        # no blocks, a last block that is not the one at `end`, or a first block that begins after the onset
        if not rows.size or rows[-1, _END] != end or rows[0, _END] - seconds > onset:
            return None
        rows = rows[rows[:, _END] > since + 0.5 * seconds]  # begin at `since` or later, to half a block
        if len(rows) < MIN_BLOCKS or self._follower is None:
            return ()
        blocks = [
            Block(row[_THETA], row[_GRAM].reshape(_N_SUMS, _N_SUMS), row[_SAMPLES], row[_SCORES].reshape(-1, _N_SUMS))
            for row in rows
        ]
        try:
            joint = Joint.fit(blocks, self._follower.priors, block_s=seconds, parameter=G)
            information = parameter_information(joint, rows[:, _END] - 0.5 * seconds, seconds * len(rows))
            response = score_response_steps(information)
        except np.linalg.LinAlgError:
            return ()
        return (*response, *self._signals.observables(since))

    def relearn(self, since: float = math.inf) -> None:
        """Make the learned parameters uncertain again; `since`, of use to `LiveBalance.relearn`, is ignored."""
        if self._follower is not None:
            self._follower.interrupt(math.inf)

    def state(self) -> dict[str, Any]:
        """Return the fit and the stored blocks as plain values for JSON, for `load_state`."""
        state = super().state()
        if (follower := self._follower) is None:
            return state | {"follower": None}
        machine = {"rate": follower.machine.rate, "law": follower.machine.law, "sense": follower.sense}
        return state | {"follower": save_attributes(follower, _FOLLOWER_ATTRIBUTES) | machine}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore, to the last bit, the values that `state` saved; raise InputError if one is missing or not valid."""
        super().load_state(state)
        if (saved := require_part(state, "follower", (Mapping, type(None)))) is None:
            return
        rate, sense = (float(require_part(saved, name, (float, int))) for name in ("rate", "sense"))
        if not rate > 0.0:
            raise InputError(f"saved state's rate must be > 0 Hz, got {rate}")
        if (law := require_part(saved, "law", str)) not in LAWS:
            raise InputError(f"saved state's law must be {' or '.join(LAWS)}, got {law!r}")
        self._follower = Follower(self._rig, rate, sense, law)
        restore_attributes(self._follower, _FOLLOWER_ATTRIBUTES, saved)


_FOLLOWER_ATTRIBUTES = ("theta", "covariance", "states", "variance", "last")


def _make_recording(rows: Array, rate: float) -> Recording:
    """Make a recording from stored samples (4, n), whose rows are time [s], p_A, p_B and u."""
    t, *channels = rows
    return Recording(t, dict(zip(_READ, channels, strict=True)), {name: CHANNEL_UNITS[name] for name in _READ}, rate)
