"""Logs of more than one table: trees of signals, JSON, packets."""
