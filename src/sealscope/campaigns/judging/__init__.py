"""Judging: thresholds from the scores of leak-free records, verdicts on the other records, and tables of results."""
