"""Controllers around a rig, with parameters of their own: what they assume of the machine, not what it is."""

from sealscope.control.controller import Controller as Controller
from sealscope.control.controller import Measured as Measured
from sealscope.control.position import PositionPI as PositionPI
