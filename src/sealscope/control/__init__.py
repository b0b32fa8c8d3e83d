"""Controllers of a rig's piston position; their parameters are assumptions and may differ from the rig's values."""

from sealscope.control.controller import CompiledLaw as CompiledLaw
from sealscope.control.controller import Controller as Controller
from sealscope.control.controller import Measured as Measured
from sealscope.control.controller import Started as Started
from sealscope.control.drive import Drive as Drive
from sealscope.control.drive import ValveDrive as ValveDrive
from sealscope.control.drive import drive_of as drive_of
from sealscope.control.fault_tolerant import FaultTolerant as FaultTolerant
from sealscope.control.flatness import Flatness as Flatness
from sealscope.control.leak_observer import Balance as Balance
from sealscope.control.margins import Margins as Margins
from sealscope.control.margins import margins as margins
from sealscope.control.position import PositionPI as PositionPI
from sealscope.control.registry import CONTROLLERS as CONTROLLERS
from sealscope.control.registry import controller_named as controller_named
