"""Sealscope: find internal leakage in electro-hydrostatic actuators.

    import sealscope as ss
    recording = ss.simulate(command="3 sin(4t)", leak="0.0042 L/min from 90 s", seed=1)
    print(ss.diagnose(recording))

Names load when they are first used, so that importing the package is cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine as CommissionedMachine
    from sealscope.diagnosis.commissioned.machine import commission as commission
    from sealscope.diagnosis.commissioned.machine_file import load_machine as load_machine
    from sealscope.diagnosis.commissioned.machine_file import write_machine as write_machine
    from sealscope.diagnosis.commissioned.scikit_learn import LeakDetector as LeakDetector
    from sealscope.diagnosis.diagnose import diagnose as diagnose
    from sealscope.diagnosis.live.watch import Watch as Watch
    from sealscope.diagnosis.live.watch import watch as watch
    from sealscope.diagnosis.trend.trend import Trend as Trend
    from sealscope.diagnosis.trend.trend import trend as trend
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis as Diagnosis
    from sealscope.fmu.build import write_fmu as write_fmu
    from sealscope.fmu.build import write_sensor_fmu as write_sensor_fmu
    from sealscope.fmu.recording import record_fmu as record_fmu
    from sealscope.parameters import Rig as Rig
    from sealscope.parameters import load_rig as load_rig
    from sealscope.recordings import Recording as Recording
    from sealscope.recordings import inspect as inspect
    from sealscope.recordings import read as read
    from sealscope.recordings import read_parts as read_parts
    from sealscope.recordings import write as write
    from sealscope.reporting.page import write_page as write_page
    from sealscope.signals.streams import DetailStream as DetailStream
    from sealscope.signals.windows import RmsStream as RmsStream
    from sealscope.simulation.batch.batch import simulate_batch as simulate_batch
    from sealscope.simulation.experiment import Experiment as Experiment
    from sealscope.simulation.simulate import prove as prove
    from sealscope.simulation.simulate import simulate as simulate
    from sealscope.simulation.simulate import simulate_with_truth as simulate_with_truth

#: Module -> names that it is the home of.
_NAMES = {
    "diagnosis.commissioned.scikit_learn": "LeakDetector",
    "diagnosis.commissioned.machine": "CommissionedMachine commission",
    "diagnosis.commissioned.machine_file": "load_machine write_machine",
    "diagnosis.diagnose": "diagnose",
    "diagnosis.trend.trend": "Trend trend",
    "diagnosis.verdict.diagnosis": "Diagnosis",
    "fmu.build": "write_fmu write_sensor_fmu",
    "fmu.recording": "record_fmu",
    "diagnosis.live.watch": "Watch watch",
    "parameters": "Rig load_rig",
    "recordings": "inspect read read_parts write",
    "recordings.recording": "Recording",
    "reporting.page": "write_page",
    "signals.streams": "DetailStream",
    "signals.windows": "RmsStream",
    "simulation.batch.batch": "simulate_batch",
    "simulation.experiment": "Experiment",
    "simulation.simulate": "prove simulate simulate_with_truth",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}
# LeakDetector needs the extra `learn`, so it is in no `import *`
__all__ = list(sorted({*_HOMES, "__version__"} - {"LeakDetector"}))


def _load(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("sealscope")
    if name in _HOMES:
        return getattr(import_module(f"sealscope.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


if TYPE_CHECKING:
    __version__: str
else:
    __getattr__ = _load  # hidden from type checkers, so that they find a misspelt name


def __dir__() -> list[str]:
    return __all__
