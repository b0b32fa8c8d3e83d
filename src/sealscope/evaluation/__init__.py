"""Evaluation of alarms against truth: detection, false alarms, errors of estimates, each with its interval."""
