"""What recordings tell of a machine's parameters, with intervals, and what they cannot."""

from sealscope.identification.estimate import Estimate as Estimate
from sealscope.identification.identify import Identification as Identification
from sealscope.identification.identify import identify as identify
from sealscope.identification.rig_file import identified_rig_text as identified_rig_text
