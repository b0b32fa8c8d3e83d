"""The list of items to reproduce, and their making, storing and remaking."""
