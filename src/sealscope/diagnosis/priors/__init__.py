"""Typed tables of each package's `priors.toml`, which states assumptions on machines before a recording is read.

A field without a unit is a number, unit [1] in the file. The file states value, unit and source of each.
"""
