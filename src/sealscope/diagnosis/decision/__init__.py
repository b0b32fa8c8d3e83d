"""From the tests of a recording to a verdict: calibration by healthy recordings, explanations by events, decision."""
