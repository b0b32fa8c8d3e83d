"""What recordings tell of a machine's parameters, with intervals, and what they cannot."""

from sealscope.control.identification.estimate import Estimate as Estimate
from sealscope.control.identification.identify import Identification as Identification
from sealscope.control.identification.identify import identify as identify
from sealscope.control.identification.rig_file import identified_rig_text as identified_rig_text
