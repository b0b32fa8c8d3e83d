"""The volume balance of a recording as curves over time: where the oil goes that the pump delivers.

The curves add up: the left side of the balance (`terms`), the pump's volume for a pump-controlled cylinder, is the sum
of its terms with the coefficients that fit the recording, and a residual. The leakage has the conductance of
`RecordedBalance.total_history` in each block; all other coefficients are least squares given this leakage. Called by
the workbench, which draws them beside the signals.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from sealscope.diagnosis.assumed_rig import assumed_rig
from sealscope.diagnosis.detectors.registry import limit_threads
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.equations.balances import (
    CLIPPED_DIFFERENCE,
    HOLE,
    absolute_offset,
    bridged_samples,
    derive_drive_signals,
    find_rest_limits,
)
from sealscope.diagnosis.inference.equations.terms import START, Flow, Signals
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.parameters import Rig
from sealscope.recordings.recording import Array, Recording

#: Chamber in the name of a term, such as that of "compliance A over the stroke".
_SIDE = re.compile(r"\b[AB]\b")
#: Part of the balance that a term belongs to, by the kind of its coefficient; others are `other`.
_PARTS = {"motion": "piston", "compliance": "compression", "air": "compression", "edge": "valve", "piston": "leakage"}


class FlowCurves(NamedTuple):
    """The volume balance of a recording over time.

    Parameters
    ----------
    t : array of float, shape (n,)
        Times of the samples [s].
    delivered : array of float, shape (n,)
        Left side of the balance as a volume since the first sample [m^3]: of the pump or the meter, of the piston
        behind a servo valve, or of the creep of a held load.
    source : {"pump", "piston", "creep"}
        Which of these it is.
    parts : mapping of str to array of float, shape (n,)
        Volumes of the terms since the first sample [m^3]: "piston", "valve", "compression A", "compression B",
        "compression" of the oil elsewhere, "leakage" and "other", as far as the balance has them, and "residual". Their
        sum is `delivered`.
    blocks : array of float, shape (k, 3)
        Begin and end [s] of each block, and the fraction of the information on the leakage that it carries.
    states_flow : bool
        Whether the volumes are true ones; else they are relative to the machine that is assumed.
    delay : Estimate, optional
        Time by which the recorded position lags behind the flow [s].
    offset : float
        Sensor offset of p_A - p_B [Pa] that the balance shows.
    """

    t: Array
    delivered: Array
    source: str
    parts: Mapping[str, Array]
    blocks: Array
    states_flow: bool
    delay: Estimate | None
    offset: float


def compute_flow_curves(
    recording: Recording, rig: Rig | None = None, chamber: Literal["A", "B"] = "A"
) -> FlowCurves | None:
    """Compute the volume balance of a recording as curves over time; None if its channels allow no balance.

    `rig` states the machine's sizes, as for `sealscope.diagnose`. Behind a servo valve each `chamber` has a balance;
    elsewhere there is one of both, which is that of "A", and None for "B".
    """
    part = inspect_recording(recording).part
    detector = VolumeBalance(assumed_rig(rig, recording)[0])
    with limit_threads(), np.errstate(all="ignore"):
        if detector.usable(part) is not None or (balance := detector.balance(part)) is None:
            return None
        number = "AB".index(chamber)
        if number >= len(balance.equations):
            return None
        equation, roles, blocks = balance.equations[number], balance.columns[number], balance.blocks
        needed = {name for term in equation.terms for name in term.needs} | set(part.channels)
        samples = bridged_samples(part, needed)
        samples = {name: values for name, values in samples.items() if name not in (HOLE, CLIPPED_DIFFERENCE)}
        if START in needed:  # a drive, whose command may give the flow
            samples = derive_drive_signals(samples, balance.rig, part.rate)
        limits = find_rest_limits(samples, part.rate, equation) if "x" in samples else None
        offsets = {name: absolute_offset(samples[name]) for name in ("p_A", "p_B")}
        signals = Signals(
            samples,
            part.rate,
            to_absolute=offsets,
            offset=float(blocks.zero[0]),
            rest_limits=limits,
        )
        history = balance.total_history.mean
        fitted = [column for column in roles.nuisance if column != roles.leak]
        gram = blocks.gram[:, number]
        precision = gram[:, fitted][:, :, fitted].sum(axis=0)
        moment = (gram[:, fitted, roles.left] - gram[:, fitted, roles.leak] * history[:, None]).sum(axis=0)
        coefficients = dict(zip(fitted, Gaussian(precision, moment).mean, strict=True))
        increments: dict[str, Array] = {}
        for column, term in enumerate(equation.terms):
            if column == roles.leak:
                values = np.interp(part.t[1:], blocks.time, history) * term.increments(signals)
            elif column in coefficients:
                values = coefficients[column] * term.increments(signals)
            else:
                continue
            name = _PARTS.get(term.drift, "other")
            if name == "compression" and (side := _SIDE.search(term.name)):
                name = f"compression {side[0]}"
            elif name == "other" and balance.flow is Flow.VALVE:  # what passes a servo valve at its null
                name = "valve"
            increments[name] = increments.get(name, 0.0) + np.nan_to_num(values)
        left = np.nan_to_num(equation.left(signals))
        explained = np.sum(list(increments.values()), axis=0)
        if left @ explained < 0.0:  # the flow is recorded with the other sign
            left = -left
        increments["residual"] = left - explained
        scale = balance.size.scale
        volumes = {name: _accumulate(scale * values) for name, values in increments.items()}
        information = np.maximum(balance.leak.precision.sum(axis=0), 0.0)
        running = balance.running_blocks
        shares = information / max(float(information.sum()), np.finfo(float).tiny)
        return FlowCurves(
            part.t,
            _accumulate(scale * left),
            "piston" if equation.flow is Flow.VALVE else "creep" if equation.flow is Flow.CREEP else "pump",
            volumes,
            np.column_stack([running.start, running.end, shares]),
            balance.size.stated,
            balance.position_delay,
            balance.pressure_offset,
        )


def _accumulate(increments: Array) -> Array:
    """Sum increments (n - 1,) to the values (n,) at the samples, beginning with 0."""
    return np.concatenate([[0.0], np.cumsum(increments)])
