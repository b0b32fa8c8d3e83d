"""Judging: thresholds from leak-free rows, verdicts on the others, and the tables of a result."""
