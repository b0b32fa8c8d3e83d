"""Detectors: the protocol that every detector follows, the list of detectors, and functions to run them."""
