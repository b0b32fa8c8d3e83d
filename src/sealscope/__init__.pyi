# What `import sealscope` exports, and from where: `__init__.py` loads each name from here when it is first used.
from sealscope.diagnosis.commissioned.machine import CommissionedMachine as CommissionedMachine
from sealscope.diagnosis.commissioned.machine import commission as commission
from sealscope.diagnosis.commissioned.machine_file import read_machine as read_machine
from sealscope.diagnosis.commissioned.machine_file import write_machine as write_machine
from sealscope.diagnosis.commissioned.scikit_learn import LeakDetector as LeakDetector
from sealscope.diagnosis.diagnose import diagnose as diagnose
from sealscope.diagnosis.hold.hold_test import hold_test as hold_test
from sealscope.diagnosis.hold.result import HoldResult as HoldResult
from sealscope.diagnosis.live.watch import Watch as Watch
from sealscope.diagnosis.live.watch import watch as watch
from sealscope.diagnosis.trend.machine_trend import Trend as Trend
from sealscope.diagnosis.trend.machine_trend import trend as trend
from sealscope.diagnosis.verdict.diagnosis import Diagnosis as Diagnosis
from sealscope.emit.export import export_controller as export_controller
from sealscope.fmu.build import write_fmu as write_fmu
from sealscope.fmu.build import write_sensor_fmu as write_sensor_fmu
from sealscope.fmu.recording import record_fmu as record_fmu
from sealscope.parameters import Rig as Rig
from sealscope.parameters import load_rig as load_rig
from sealscope.parameters.rig import rigs as rigs
from sealscope.recordings import Recording as Recording
from sealscope.recordings import inspect as inspect
from sealscope.recordings import read as read
from sealscope.recordings import read_parts as read_parts
from sealscope.recordings import write as write
from sealscope.reporting.page import report as report
from sealscope.simulation.experiment import Experiment as Experiment
from sealscope.simulation.simulate import prove as prove
from sealscope.simulation.simulate import simulate as simulate
from sealscope.simulation.simulate import simulate_with_truth as simulate_with_truth

__version__: str
