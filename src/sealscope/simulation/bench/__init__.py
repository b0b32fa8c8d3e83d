"""Healthy machines drawn at random from a profile, which states how machines differ."""
