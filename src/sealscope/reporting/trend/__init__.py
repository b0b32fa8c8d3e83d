"""Texts and the page of a trend."""
