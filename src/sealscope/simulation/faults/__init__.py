"""Faults over time, as data and in words."""
