"""Held-out evaluation: classifiers judged on measured tests that they were not fitted to."""
