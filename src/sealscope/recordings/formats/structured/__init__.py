"""Logs with a structure of their own, such as trees of signals, JSON and packets, and archives."""
