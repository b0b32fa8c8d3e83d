"""Diagnosis of leaks: detectors, the decision by their reports, the verdict, and the history of a machine."""
