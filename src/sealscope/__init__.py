"""Sealscope: find internal leakage in electro-hydrostatic actuators.

    import sealscope as ss
    recording = ss.simulate(command="3 sin(4t)", leak="0.0042 L/min from 90 s", seed=1)
    print(ss.diagnose(recording))

Names load when they are first used, so that importing the package is cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sealscope import datasets
    from sealscope.diagnosis.commissioned.estimator import LeakDetector as LeakDetector
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine, commission
    from sealscope.diagnosis.commissioned.machine_file import load_machine, write_machine
    from sealscope.diagnosis.diagnose import diagnose
    from sealscope.diagnosis.inference.live.stream import SequentialBalance
    from sealscope.diagnosis.trend.trend import Trend, trend
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis
    from sealscope.fmu.build import write_fmu, write_sensor_fmu
    from sealscope.fmu.recording import record_fmu
    from sealscope.monitor.stream.watch import Watch, watch
    from sealscope.parameters import Rig, load_rig
    from sealscope.recordings import Recording, inspect, read, read_parts, write
    from sealscope.reporting import write_page
    from sealscope.signals.streams import DetailStream
    from sealscope.signals.windows import RmsStream
    from sealscope.simulation.batch.batch import simulate_batch
    from sealscope.simulation.experiment import Experiment
    from sealscope.simulation.simulate import prove, simulate, simulate_with_truth

_HOMES = {
    "DetailStream": "signals.streams",
    "Diagnosis": "diagnosis.verdict.diagnosis",
    "Experiment": "simulation.experiment",
    "Recording": "recordings.recording",
    "Rig": "parameters",
    "CommissionedMachine": "diagnosis.commissioned.machine",
    "LeakDetector": "diagnosis.commissioned.estimator",  # in no `import *`: it needs the extra `learn`
    "RmsStream": "signals.windows",
    "SequentialBalance": "diagnosis.inference.live.stream",
    "Trend": "diagnosis.trend.trend",
    "Watch": "monitor.stream.watch",
    "commission": "diagnosis.commissioned.machine",
    "diagnose": "diagnosis.diagnose",
    "inspect": "recordings",
    "load_machine": "diagnosis.commissioned.machine_file",
    "load_rig": "parameters",
    "prove": "simulation.simulate",
    "read": "recordings",
    "read_parts": "recordings",
    "record_fmu": "fmu.recording",
    "simulate": "simulation.simulate",
    "simulate_batch": "simulation.batch.batch",
    "simulate_with_truth": "simulation.simulate",
    "trend": "diagnosis.trend.trend",
    "watch": "monitor.stream.watch",
    "write": "recordings",
    "write_fmu": "fmu.build",
    "write_sensor_fmu": "fmu.build",
    "write_machine": "diagnosis.commissioned.machine_file",
    "write_page": "reporting",
}

__all__ = [
    "CommissionedMachine",
    "DetailStream",
    "Diagnosis",
    "Experiment",
    "Recording",
    "Rig",
    "RmsStream",
    "SequentialBalance",
    "Trend",
    "Watch",
    "__version__",
    "commission",
    "datasets",
    "diagnose",
    "inspect",
    "load_machine",
    "load_rig",
    "prove",
    "read",
    "read_parts",
    "record_fmu",
    "simulate",
    "simulate_batch",
    "simulate_with_truth",
    "trend",
    "watch",
    "write",
    "write_fmu",
    "write_machine",
    "write_page",
    "write_sensor_fmu",
]


def _load(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("sealscope")
    if name == "datasets":
        return import_module("sealscope.datasets")
    if name in _HOMES:
        return getattr(import_module(f"sealscope.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


if TYPE_CHECKING:
    __version__: str
else:
    __getattr__ = _load  # hidden from type checkers, so that they find a misspelt name


def __dir__() -> list[str]:
    return sorted(__all__)
