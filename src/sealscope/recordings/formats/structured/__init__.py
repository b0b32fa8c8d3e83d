"""Logs that are more than one table: trees of signals, JSON, packets."""
