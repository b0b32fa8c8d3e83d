"""Trend: what recordings of a single machine, in the order of their times, say of its leakage."""
