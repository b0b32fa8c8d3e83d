"""Headings: names and units of columns, their likely channels, and remarks on the recording."""
