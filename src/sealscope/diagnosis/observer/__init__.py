"""Kalman filters with the leakage conductance among their states."""
