"""Typed tables of each package's `priors.toml`: assumptions on machines before a recording is read."""
