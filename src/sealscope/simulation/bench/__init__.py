"""Healthy machines drawn from a profile of nuisances."""
