"""The interface of a controller, which computes a voltage from the measurements at each of its samples."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from sealscope.compiled import record_dtype, record_view
from sealscope.recordings.recording import Array


class Measured(NamedTuple):
    """The inputs of a controller at one of its samples: time, target and measurements."""

    t: float  # [s]
    target: float  # [m] of the piston's position
    target_speed: float  # [m/s] mean speed of the target while the computed voltage will act
    x: float  # [m] measured position from mid-stroke
    p_A: float  # [Pa] measured pressures of the two chambers
    p_B: float
    theta: float = 0.0  # [rad] measured angle of the motor


#: Compiled function that reads a `Measured` at the address that a compiled control law receives.
measured_at = record_view(record_dtype(*Measured._fields))


class CompiledLaw(NamedTuple):
    """A controller's control law as machine code, with its memory at the start of a run."""

    #: Address of a function ``double law(double *memory, double *measured)``, from numba.cfunc or a C compiler. It
    #: returns the voltage [V]; `measured` points to the fields of a `Measured` in their order.
    address: int
    #: Parameters and state (n,) of the control law, which each call updates; memory[0] is the leakage flow [m^3/s] that
    #: the controller compensates, or NaN if it reports none.
    memory: Array
    kept: Any = None  # object that must exist as long as the law, such as the `CompiledLaw` that the law calls


class Started:
    """A compiled control law that Python can call: it computes the voltage [V] for each `Measured`."""

    def __init__(self, law: CompiledLaw) -> None:
        self._law, self._measured = law, np.empty(len(Measured._fields))
        self._call = LAW(law.address)
        self._addresses = law.memory.ctypes.data, self._measured.ctypes.data

    def __call__(self, measured: Measured) -> float:
        """Compute the voltage [V] from the next sample; raise the exception with which a Python controller failed."""
        self._measured[:] = measured
        volts = float(self._call(*self._addresses))
        reraise_python_error(self._law)
        return volts

    @property
    def compensated(self) -> float:
        """Leakage flow [m^3/s] compensated at the last sample; AttributeError if the controller reports none."""
        flow = float(self._law.memory[0])
        if math.isnan(flow):
            raise AttributeError("compensated")  # `getattr` then finds none, as in a Python function without it
        return flow


#: The C type of a compiled law's function.
LAW = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p)


class _PythonLaw:
    """A control law for compiled code (`law`), which calls the function `voltage` of a controller written in Python."""

    def __init__(self, voltage: Callable[[Measured], float]) -> None:
        self._voltage, self._memory = voltage, np.full(1, math.nan)
        self.raised: BaseException | None = None  # the exception with which the controller failed
        self._function = LAW(self._call_voltage)
        address = ctypes.cast(self._function, ctypes.c_void_p).value
        assert address is not None  # for the type checker
        self.law = CompiledLaw(address, self._memory, self)

    def _call_voltage(self, _memory: int, measured: int) -> float:
        """Compute the controller's voltage [V] from the numbers of a `Measured` at the address `measured`.

        The result is NaN if the controller raises an exception. `_memory`: address of `self._memory`, not used.
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
    """Start a controller for one run; return its control law in the form that compiled code can call.

    This is the controller's machine code (`compiled`); if it has none, a law that calls the Python function of `start`.
    """
    law: CompiledLaw | None = controller.compiled() if hasattr(controller, "compiled") else None
    return _PythonLaw(controller.start()).law if law is None else law


def reraise_python_error(law: CompiledLaw) -> None:
    """Raise the exception, if any, of the Python controller that is called by `law` or by a law inside it."""
    innermost: Any = law
    while isinstance(innermost, CompiledLaw):  # `kept` is the inner law, or the Python controller
        innermost = innermost.kept
    if isinstance(innermost, _PythonLaw) and innermost.raised is not None:
        raise innermost.raised


class Controller(Protocol):
    """A sampled controller of the piston's position: the interface that a controller of your own must have.

    `rate` [Hz]: sampling rate, which is n/m times the rig's with whole numbers m and n, n <= 64; `delay`: number of
    whole samples from a measurement to the voltage computed from it. A run calls `start` once, and then calls the
    returned function once a sample. All state must be in this function: then a run can be repeated. The voltage is
    constant between samples, and limited to the converter's range. Make the controller a frozen dataclass: its fields
    identify the run.

    The function may have an attribute `compensated`, the leakage flow [m^3/s] that it compensated at its last sample.
    The recording then has it as channel `q_comp`; without it, control would hide the wear.

    A controller may also have a method `compiled` that returns a `CompiledLaw`. A run then calls no Python, and takes
    a fraction of the time; the body of `start` is ``return Started(self.compiled())``.

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
        """Number of samples from a measurement to the voltage computed from it."""
        ...

    def start(self) -> Callable[[Measured], float]:
        """Start a run of the controller, and return the function that computes the voltage [V] from each `Measured`."""
        ...
