"""Typed tables of each package's `priors.toml`, which states assumptions on machines before a recording is read.

The file states value, unit and source of each field. A field whose unit is stated neither in its comment nor in the
docstring of its table is a pure number.
"""
