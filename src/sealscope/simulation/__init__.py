"""Experiments, and how they are simulated, recorded and run side by side."""
