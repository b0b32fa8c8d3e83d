"""Experiments: their description, simulation, recording, and runs side by side."""
