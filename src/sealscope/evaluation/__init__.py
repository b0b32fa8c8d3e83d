"""Evaluate alarms and estimates against the truth: detection, false alarms and errors, with confidence intervals."""
