"""Detectors and their contract, the thesis's method, and the verdict on a recording."""
