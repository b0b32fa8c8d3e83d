"""The interface of a controller: started with a run, it turns each sample of its measurements into a voltage."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from sealscope.compiled import layout_of, record_at
from sealscope.recordings.recording import Array


class Measured(NamedTuple):
    """A sample of a controller's target and measurements.

    Time [s]; target [m]; mean speed of the target [m/s] while the voltage will act; measured position [m] from
    mid-stroke; measured pressures of the chambers [Pa]; measured angle of the motor [rad].
    """

    t: float
    target: float
    target_speed: float
    x: float
    p_A: float
    p_B: float
    theta: float = 0.0


#: What is measured, at the pointer by which a compiled law is given it.
measured_at = record_at(layout_of(*Measured._fields))


class CompiledLaw(NamedTuple):
    """A controller's law in machine code, for one run from its beginning.

    `address` of a function ``double law(double *memory, double *measured)`` that returns the voltage [V] (numba.cfunc
    gives one, as C does); `memory` (n,): its state and its numbers. The first of them is the compensated leakage flow
    [m^3/s], NaN for a controller without one. `measured` holds the numbers of `Measured` in their order. `kept`: an
    object that must live as long as the law.
    """

    address: int
    memory: Array
    kept: Any = None


class Started:
    """A compiled law as a Python function from a `Measured` to the voltage [V]."""

    def __init__(self, law: CompiledLaw) -> None:
        self._law, self._measured = law, np.empty(len(Measured._fields))
        self._call = LAW(law.address)
        self._blocks = law.memory.ctypes.data, self._measured.ctypes.data

    def __call__(self, measured: Measured) -> float:
        """Compute the voltage [V] of the next sample."""
        self._measured[:] = measured
        volts = float(self._call(*self._blocks))
        raise_within(self._law)
        return volts

    @property
    def compensated(self) -> float:
        """Leakage flow that is made good [m^3/s]; AttributeError where none is."""
        flow = float(self._law.memory[0])
        if math.isnan(flow):
            raise AttributeError("compensated")
        return flow


#: The type of a law's function in C.
LAW = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p)


class _Called:
    """A controller written in Python, as a law that is called by its address."""

    def __init__(self, voltage: Callable[[Measured], float]) -> None:
        self._voltage, self._memory = voltage, np.full(1, math.nan)
        self.raised: BaseException | None = None
        self._function = LAW(self._volts)
        address = ctypes.cast(self._function, ctypes.c_void_p).value
        assert address is not None
        self.law = CompiledLaw(address, self._memory, self)

    def _volts(self, _memory: int, measured: int) -> float:
        try:
            numbers = (ctypes.c_double * len(Measured._fields)).from_address(measured)
            volts = float(self._voltage(Measured(*numbers)))
            flow = getattr(self._voltage, "compensated", None)
            self._memory[0] = math.nan if flow is None else flow
        except BaseException as error:  # an exception cannot pass through C
            self.raised = error
            return math.nan
        return volts


def law_of(controller: Controller) -> CompiledLaw:
    """Start a controller for one run: return its law in machine code, or in Python behind an address."""
    law: CompiledLaw | None = controller.compiled() if hasattr(controller, "compiled") else None
    return _Called(controller.start()).law if law is None else law


def raise_within(law: CompiledLaw) -> None:
    """Raise the exception that a controller in Python raised within this law."""
    kept: Any = law
    while isinstance(kept, CompiledLaw):
        kept = kept.kept
    if isinstance(kept, _Called) and kept.raised is not None:
        raise kept.raised


class Controller(Protocol):
    """A sampled controller of the piston's position.

    `rate` [Hz]: a whole multiple of, or a whole fraction of, the rig's sampling rate; `delay`: whole samples from a
    measurement to the voltage that it leads to. A run calls `start` and then the function that it returns once a
    sample; what that function remembers belongs to the run alone, so that a run can be begun anew. The voltage is held
    until the next, and held within the converter's range by the rig. A frozen dataclass tells runs apart by its fields.

    Where the function has an attribute `compensated`, the leakage flow [m^3/s] that it makes good at its last sample,
    the recording has it as the channel `q_comp`, so that control does not hide the wear.

    A controller may also have a method `compiled` that returns a `CompiledLaw`: then a run calls no Python, and takes a
    fraction of the time. `start` is ``return Started(self.compiled())`` then.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> import sealscope as ss
    >>> @dataclass(frozen=True)
    ... class Proportional:
    ...     gain: float  # [V/m]
    ...     rate: float = 500.0
    ...     delay: int = 1
    ...
    ...     def start(self):
    ...         return lambda measured: self.gain * (measured.target - measured.x)
    >>> recording = ss.simulate(command="position step 10 mm at 0.1 s", controller=Proportional(200.0), duration=1.0)
    >>> bool(recording["x"][-1] > 0.008)
    True
    """

    @property
    def rate(self) -> float:
        """Samples of the controller a second [Hz]."""
        ...

    @property
    def delay(self) -> int:
        """Whole samples from a measurement to its voltage."""
        ...

    def start(self) -> Callable[[Measured], float]:
        """Start a run: return the function from a `Measured` to the voltage [V]."""
        ...
