"""Diagnosis of leaks: detectors, the decision by their reports, the verdict, and the history of a machine.

Six words have one meaning here:

- *rest*: a time in which the commanded motion is 0, the pump turning or not.
- *hold*: a rest under load; where shut valves carry the load, only leakage moves the piston.
- *lowering*: a motion of the piston past the resting pump, which a valve lets through.
- *regime*: how the pump is connected to the chambers at a time: in motion, at rest, or shut off by valves.
- *level*: the mean of a quantity over a whole recording, such as the leakage that healthy recordings show.
- *rise*: the difference of a recording's level to that of the healthy recordings, as a leak there from the start shows.
"""
