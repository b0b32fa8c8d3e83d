"""Trend: the leakage of a single machine over its recordings, in the order of their times."""
