"""Thresholds for a stated false-alarm probability from leak-free recordings."""
