"""Scans for a step in noise, in a smooth drift or in a random walk."""
