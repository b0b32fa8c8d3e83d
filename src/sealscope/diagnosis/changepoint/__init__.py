"""Scans for a step in a series: in a smooth drift, in a random walk, in scattering vectors, beside an even drift."""
