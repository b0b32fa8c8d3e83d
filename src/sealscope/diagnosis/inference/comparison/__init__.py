"""Comparison of a recording's leakage with that of healthy recordings of the same machine, whose scatter is estimated.

- `recording_sums`: summary of one recording, from which all comparisons are made;
- `coefficients`: estimates from the Gram matrices of several recordings; `laws`: which law of a leak fits better;
- `levels`: rise of the leakage above the healthy level; `oil`, `conditions`, `population`: what it depends on;
- `rise`: the result, and its distribution in a healthy recording.
"""
