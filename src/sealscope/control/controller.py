"""The interface of a controller: at each of its samples it computes a voltage from its measurements."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from sealscope.compiled import record_dtype, record_view
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


#: The compiled function that reads a `Measured` at an address, the argument of a compiled law.
measured_at = record_view(record_dtype(*Measured._fields))


class CompiledLaw(NamedTuple):
    """A controller's law in machine code, for one run from its beginning.

    `address`: address of a function ``double law(double *memory, double *measured)``, from numba.cfunc or C, that
    returns the voltage [V] for the numbers of a `Measured`; `memory` (n,): its state and parameters; memory[0] is the
    compensated leakage flow [m^3/s], or NaN; `kept`: an object that must live as long as the law, None for none.
    """

    address: int
    memory: Array
    kept: Any = None


class Started:
    """A compiled law as a Python function that returns the voltage [V] for a `Measured`."""

    def __init__(self, law: CompiledLaw) -> None:
        self._law, self._measured = law, np.empty(len(Measured._fields))
        self._call = LAW(law.address)
        self._addresses = law.memory.ctypes.data, self._measured.ctypes.data

    def __call__(self, measured: Measured) -> float:
        """Compute the voltage [V] of the next sample."""
        self._measured[:] = measured
        volts = float(self._call(*self._addresses))
        reraise_python_error(self._law)
        return volts

    @property
    def compensated(self) -> float:
        """The compensated leakage flow [m^3/s]; AttributeError if the controller reports none."""
        flow = float(self._law.memory[0])
        if math.isnan(flow):
            raise AttributeError("compensated")
        return flow


#: The type of a law's function in C.
LAW = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p)


class _PythonLaw:
    """A controller written in Python, with an address at which compiled code calls it."""

    def __init__(self, voltage: Callable[[Measured], float]) -> None:
        """Make a C function that calls `voltage`, and the `CompiledLaw` with its address."""
        self._voltage, self._memory = voltage, np.full(1, math.nan)
        self.raised: BaseException | None = None
        self._function = LAW(self._call_voltage)
        address = ctypes.cast(self._function, ctypes.c_void_p).value
        assert address is not None
        self.law = CompiledLaw(address, self._memory, self)

    def _call_voltage(self, _memory: int, measured: int) -> float:
        """Compute the voltage [V] from the numbers of a `Measured` at the address `measured`.

        If the controller raises an exception, store it in `raised` and return NaN.
        """
        try:
            numbers = (ctypes.c_double * len(Measured._fields)).from_address(measured)
            volts = float(self._voltage(Measured(*numbers)))
            flow = getattr(self._voltage, "compensated", None)
            self._memory[0] = math.nan if flow is None else flow
        except BaseException as error:  # an exception cannot pass through C
            self.raised = error
            return math.nan
        return volts


def start_law(controller: Controller) -> CompiledLaw:
    """Start a controller for one run; return its law, in machine code if it has one, else in Python."""
    law: CompiledLaw | None = controller.compiled() if hasattr(controller, "compiled") else None
    return _PythonLaw(controller.start()).law if law is None else law


def reraise_python_error(law: CompiledLaw) -> None:
    """Raise the exception that a controller in Python raised when compiled code last called this law, if any."""
    innermost: Any = law
    while isinstance(innermost, CompiledLaw):  # a law that calls another keeps it
        innermost = innermost.kept
    if isinstance(innermost, _PythonLaw) and innermost.raised is not None:
        raise innermost.raised


class Controller(Protocol):
    """A sampled controller of the piston's position.

    `rate` [Hz]: a whole multiple or a whole fraction of the rig's sampling rate; `delay`: whole samples from a
    measurement to its voltage. A run calls `start`, and the function that it returns once a sample; all state is in
    that function, so that a run can be repeated. The voltage is constant between samples, and limited to the
    converter's range. Make the controller a frozen dataclass: its fields identify the run.

    If the function has an attribute `compensated`, the leakage flow [m^3/s] that it compensated at its last sample, the
    recording has it as channel `q_comp`: otherwise control would hide the wear.

    A controller may also have a method `compiled` that returns a `CompiledLaw`. Then a run calls no Python, and takes a
    fraction of the time; `start` is ``return Started(self.compiled())``.

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
        """Sampling rate of the controller [Hz]."""
        ...

    @property
    def delay(self) -> int:
        """Samples from a measurement to its voltage."""
        ...

    def start(self) -> Callable[[Measured], float]:
        """Start a run: return the function from a `Measured` to the voltage [V]."""
        ...
