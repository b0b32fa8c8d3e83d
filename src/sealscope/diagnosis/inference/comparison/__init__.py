"""Comparison of a recording's leakage with that of healthy recordings, whose scatter is estimated."""
