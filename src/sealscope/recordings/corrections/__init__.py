"""Corrections of a recording's samples before it is diagnosed: what loggers do to samples, and how it is undone."""
